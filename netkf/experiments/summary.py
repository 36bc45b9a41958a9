"""What a run comes to: errors and covariances per node against what theory promises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory import central_covariance, covariance_bound, limit_covariance
from netkf.theory.coupled import not_promised
from netkf.trace.recorder import Sink
from netkf.trace.run import errors
from netkf.trace.schema import CODES

ROUNDING = 4.0 * np.finfo(float).eps


class SummarySink(Sink):
    """Keeps per sample and node what tables and pictures need: squared error, trace of P, NEES; and
    how many messages each link delivered. ``rounding_from`` is the first sample at which the state
    is so large that rounding blurs the errors (unstable plants over long horizons).
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.sq_error: list[FloatArray] = []
        self.trace: list[FloatArray] = []
        self.nees: list[FloatArray] = []
        self.delivered: dict[tuple[int, int], int] = {}
        self.rounding_from: float | None = None

    def events(self, rows: np.ndarray) -> None:
        """Deliveries of each link are counted, both directions together."""
        arrived = rows[rows["kind"] == CODES["deliver"]]
        ends = np.sort(np.column_stack([arrived["node"], arrived["peer"]]), axis=1)
        pairs, counts = np.unique(ends, axis=0, return_counts=True)
        for (i, j), count in zip(pairs.tolist(), counts.tolist(), strict=True):
            self.delivered[i, j] = self.delivered.get((i, j), 0) + count

    def states(self, t: float, x: FloatArray, xhat: FloatArray, P: FloatArray) -> None:
        """Reduced at once."""
        sq_error, nees = errors(x[None], xhat[None], P[None])
        self.times.append(t)
        self.sq_error.append(sq_error[0])
        self.nees.append(nees[0])
        self.trace.append(np.trace(P, axis1=1, axis2=2))
        deviation = np.sqrt(max(float(np.diagonal(P, axis1=1, axis2=2).min()), 0.0))
        blurred = ROUNDING * float(np.abs(x).max()) > 0.01 * deviation > 0.0
        if blurred and self.rounding_from is None:
            self.rounding_from = t


@dataclass(frozen=True, eq=False)
class Promise:
    """What H(12) and (13) say at the sample times; ``words`` says why where they say nothing.

    bound (T, N): trace of H(12); limit, central: traces of S and of the centralised covariance,
    nan where they do not exist.
    """

    bound: FloatArray | None
    limit: float
    central: float
    words: str


def promise(scenario: Scenario, times: FloatArray) -> Promise:
    """Computed for the sample times of a run."""
    bound, words = None, ""
    try:
        if len(times):
            bound = np.trace(covariance_bound(scenario, times), axis1=2, axis2=3)
    except TheoryError as error:
        words = str(error)
    return Promise(
        bound,
        _trace(limit_covariance, scenario),
        _trace(central_covariance, scenario),
        words or not_promised(scenario) or "",
    )


def _trace(function: Any, scenario: Scenario) -> float:
    try:
        return float(np.trace(function(scenario)))
    except TheoryError:
        return float("nan")


def summarise(
    scenario: Scenario, sink: SummarySink, promised: Promise, messages: dict[str, int]
) -> dict[str, Any]:
    """Per node and overall: time-averaged RMS error, mean trace of P, bound and their ratio, mean
    NEES over the samples after time 0; messages sent, delivered, lost and still on their way.
    """
    times = np.array(sink.times)
    used = times > 0.0 if (times > 0.0).any() else times >= 0.0
    with np.errstate(all="ignore"):
        mean_square = np.array(sink.sq_error)[used].mean(axis=0)
        trace = np.array(sink.trace)[used].mean(axis=0)
        nees = np.array(sink.nees)[used].mean(axis=0)
        bound = None if promised.bound is None else promised.bound[used].mean(axis=0)
        nodes = [
            _row(node, mean_square[k], trace[k], None if bound is None else bound[k], nees[k])
            for k, node in enumerate(scenario.nodes)
        ]
        overall = _row(
            -1,
            mean_square.mean(),
            trace.mean(),
            None if bound is None else bound.mean(),
            nees.mean(),
        )
    del overall["node"]
    return {
        "nodes": nodes,
        "overall": overall,
        "limit": promised.limit,
        "central": promised.central,
        "bound": promised.words or "H(12), promised by H Theorem 2",
        "rounding_from": sink.rounding_from,
        "messages": {
            **messages,
            "in_flight": messages["sent"] - messages["delivered"] - messages["lost"],
        },
    }


def conserved(sums: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """What exchanges should conserve, summed over all nodes: exact, at the last sample, and how far
    that is off, relative to the exact value.
    """
    return {
        name: {"exact": exact, "total": total, "drift": (total - exact) / exact}
        for name, (exact, total) in sums.items()
    }


def _row(node: int, mean_square: Any, trace: Any, bound: Any, nees: Any) -> dict[str, Any]:
    return {
        "node": node,
        "rms_error": float(np.sqrt(mean_square)),
        "mean_trace": float(trace),
        "bound": None if bound is None else float(bound),
        "ratio": None if bound is None else float(trace / bound),
        "mean_nees": float(nees),
    }
