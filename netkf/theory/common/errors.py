"""The exact covariance of all errors of one run, given when its messages arrived.

Given the events, covariances P_i and gains are deterministic and the errors e_i = x - xhat_i are
linear in the noises, so their joint covariance Sigma follows without any simulation: one recursion
for slots and for clocks (theory/replay.py), with what each filter does in theory/moves.py.
"""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.replay import replay
from netkf.trace.run import Run


def error_covariance(scenario: Scenario, run: Run, stacked: bool = False) -> FloatArray:
    """(T, N, n, n): covariance of x - xhat_i at ``run.times``, given the run's events and its
    regressors.

    With ``stacked``, (T, N n, N n): the errors of all nodes together. H (10) says that each block
    stays below P_i, which this shows without Monte Carlo. With delays, losses and models that
    differ from the truth; where states or readings are recorded, as if they had the law that the
    scenario gives them. Raises TheoryError for a user's subclass that does more than choose its
    weights, and for the push-sum filter with frozen or asymptotic gains.
    """
    whole, _ = _replayed(scenario, run)
    return whole if stacked else diagonal_blocks(whole, len(scenario.nodes))


def diagonal_blocks(stacked: FloatArray, nodes: int) -> FloatArray:
    """(T, N, n, n) of (T, N n, N n)."""
    n = stacked.shape[-1] // nodes
    blocks = stacked.reshape(len(stacked), nodes, n, nodes, n)
    return np.ascontiguousarray(np.einsum("tiaib->tiab", blocks))


def replayed_covariances(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, N, n, n): P_i as the filter's equations make it of the run's events, computed here and
    not by the engine; (T, N n, N n): the covariance of all x - xhat_i together, as
    :func:`error_covariance`.
    """
    whole, P = _replayed(scenario, run)
    return P, whole


def _replayed(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, N n, N n) and (T, N, n, n)."""
    if not isinstance(run, Run):
        raise TheoryError(
            f"run must be a netkf.Run, as netkf.simulate returns it, got a {type(run).__name__}"
        )
    if run.nodes != scenario.nodes or run.x.shape[1] != scenario.plant.n:
        raise TheoryError("the run is of another scenario: its nodes or its state differ")
    whole, P = replay(scenario, run)
    nodes, n = len(scenario.nodes), scenario.plant.n
    if whole.shape[-1] < nodes * n:
        whole, P = np.tile(whole, (1, nodes, nodes)), np.tile(P, (1, nodes, 1, 1))
    return whole, P
