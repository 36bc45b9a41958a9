"""The Kalman-consensus filter: Olfati-Saber, "Kalman-consensus filter: optimality, stability, and
performance", CDC 2009, Algorithm 1 (first proposed in CDC 2007, Algorithm 3).

With predictions xbar_j, the readings heard and a consensus term give ``xhat = xbar + M (y - S xbar)
+ gamma P sum_j (xbar_j - xbar)``: y and S are sums of H' R^-1 y and H' R^-1 H over these readings,
P is the covariance of xbar, M = (P^-1 + S)^-1, and gamma = epsilon / (1 + |P|).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import add_covariance_product
from netkf.algorithms.kernels.run import (
    carry,
    copy_estimate,
    predict_estimate,
    shift_prior,
    use_reading,
)
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.fields import boolean, field, number
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, load_flags, root_of, select, spread, store


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``, and keep the prediction, which is sent."""
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    copy_estimate(run, record.prior, record.prior_root, h, record.xhat, record.root, h, True)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send the prediction; the reading of this instant goes with it."""
    payload = record.payload
    copy_estimate(run, payload.xhat, payload.root, m, record.prior, record.prior_root, h, True)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Use the readings heard, and add the consensus term, in which the predictions heard count."""
    lanes, payload = run.lanes, record.payload
    # (u, U) of Algorithm 1: readings themselves, row by row.
    for k in range(run.count):
        # A late reading belongs to another instant.
        if record.share == 1 and run.heard[k] >= 0 and run.age[k] <= 0.0:
            arrived = load_flags(lanes, run.arrived, k)
            use_reading(run, record.xhat, record.root, h, run.heard[k], arrived)
    # sum_j (xbar_j - xbar)
    for k in range(run.count):
        carry(run.model, run, payload.xhat, payload.root, run.message[k], run.age[k])
    for i in range(len(run.size)):
        total = spread(lanes, 0.0)
        for k in range(run.count):
            arrived = load_flags(lanes, run.arrived, k)
            offset = load(lanes, payload.xhat, run.message[k], i) - load(lanes, record.prior, h, i)
            total += select(arrived, offset, 0.0)
        store(lanes, run.row, i, total)
    add_consensus_term(record, h, run)


@kernel
def add_consensus_term(record: Any, h: int, run: Any) -> None:
    """Add ``epsilon / (1 + |P|) P d`` to the estimate of node ``h``, with d in ``run.row`` and P of
    its prediction; |P| is the Frobenius norm.
    """
    lanes, n, S, square = run.lanes, len(run.size), record.prior_root, spread(run.lanes, 0.0)
    for i in range(n):
        for j in range(i + 1):
            entry = spread(lanes, 0.0)
            for m in range(j + 1):
                entry += load(lanes, S, h, i, m) * load(lanes, S, h, j, m)
            # An entry off the diagonal counts twice.
            square += entry * entry if i == j else 2.0 * entry * entry
    gain = record.epsilon / (1.0 + root_of(square))
    add_covariance_product(lanes, run.size, record.xhat, h, gain, S, run.row, run.gains)


def kcf_record(filtering: Kcf, _infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return predictions of nodes, (xbar, root) in messages, and the settings."""
    estimate = {"xhat": (n := len(models[0].information),), "root": (n, n)}
    return Record(
        node={"prior": (n,), "prior_root": (n, n)},
        payload=estimate,
        settings={"epsilon": filtering.epsilon, "share": filtering.share_readings},
    )


def begin_kcf(_: Any, node: Mapping[str, np.ndarray], _info: NodeInfo, _model: Any) -> None:
    """Take the first estimate for a prediction."""
    node["prior"][:], node["prior_root"][:] = node["xhat"], node["root"]


@built_in("kcf")
@dataclass(frozen=True, eq=False)
class Kcf(Filter):
    """Kalman update with the node's own and its neighbours' readings, plus a consensus term on
    predictions, ``epsilon / (1 + |P|) P sum_j (xbar_j - xbar)``, Algorithm 1.

    epsilon         the strength of the consensus term
    share_readings  whether nodes send their readings beside their predictions (Algorithm 1); if
                    not, the update is with the node's own alone

    P counts the readings and leaves the consensus term out: it is no bound on the error. Under
    clocks a reading is used only by nodes that receive it without delay.
    """

    epsilon: float = field(number(low=0.0), default=0.1)
    share_readings: bool = field(boolean, default=True)

    timing = Timing(clocks=("directions", "nodes", "readings"))
    needs = Needs(one_way=True, samples=True)
    kernels = Kernels(
        predict=predict,
        emit=emit,
        absorb=absorb,
        shift=shift_prior,  # the consensus term is made of differences
        sends_readings=True,
        record=kcf_record,
        begin=begin_kcf,
    )

    @property
    def analysis(self) -> Analysis:
        """Its paper, and the size of a message."""
        return Analysis(paper="kalman_consensus", payload_numbers=self._message_size)

    def _message_size(self, n: int, rows: int, phase: int) -> int:
        """Return the size in 64-bit numbers of (u, U, xbar), or of xbar alone."""
        return 2 * n + n * (n + 1) // 2 if rows and self.share_readings else n

    shift = Filter.shift  # the class commutes with a shift, by its kernel
