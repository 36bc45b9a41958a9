"""The exact covariance of all errors of one run, given when its messages arrived.

Given the events, covariances P_i and gains are deterministic, and the errors e_i = x - xhat_i are
linear in the noises. Their joint covariance Sigma therefore follows without simulation, from the
filter's own verbs (theory/common/slot_columns.py, theory/common/clock_columns.py).
"""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.replay import ErrorLaw, replay_covariances, replay_law
from netkf.trace.run import Run


def error_covariance(scenario: Scenario, run: Run, stacked: bool = False) -> FloatArray:
    """Return the covariance (T, N, n, n) of x - xhat_i at ``run.times``, given the run's events.

    With ``stacked``, (T, N n, N n): the errors of all nodes together. Paper H (10) says that each
    block stays below P_i, which this shows without Monte Carlo. Regressors are those of the run;
    delays, losses and filter models that differ from the truth are included; recorded states and
    readings are treated as if they had the law that the scenario gives them. Raises TheoryError for
    filters that are not affine and for those whose verbs are plain Python, also where a user's
    subclass overrides one.
    """
    joint = _replay_nodes(scenario, run)
    return joint if stacked else diagonal_blocks(joint, len(scenario.nodes))


def error_squares(scenario: Scenario, run: Run) -> FloatArray:
    """Return E[(x - xhat_i)(x - xhat_i)'] (T, N, n, n) at ``run.times``, given the run's events:
    :func:`error_covariance` and the square of the mean error, which is not 0 where filters start
    elsewhere than the plant. Raises the errors of that function.
    """
    return diagonal_blocks(_replay_nodes(scenario, run, about_mean=False), len(scenario.nodes))


def diagonal_blocks(stacked: FloatArray, nodes: int) -> FloatArray:
    """Return the diagonal blocks (T, N, n, n) of T stacked covariances (T, N n, N n).

    ``nodes`` is N; block (t, i) is the covariance of the error of node i at time t.
    """
    n = stacked.shape[-1] // nodes
    # Entry (t, i, a, j, b) is the covariance of entry a of e_i and entry b of e_j.
    blocks = stacked.reshape(len(stacked), nodes, n, nodes, n)
    return np.ascontiguousarray(np.einsum("tiaib->tiab", blocks))


def error_law(scenario: Scenario, run: Run) -> ErrorLaw:
    """Return the joint Gaussian law of all errors at all T ``run.times``, given the run's events,
    and P_i by the filter's equations, independently of the engine.

    Of M filters of n states: mean (T M n,), covariance (T M n, T M n) and P (T, M, n, n). Unlike
    :func:`error_covariance` it relates different times, and includes the mean that errors have
    where filters start elsewhere than the plant. Nodes that share one pooled filter count once.
    Raises the errors of :func:`error_covariance`.
    """
    _require_same_run(scenario, run)
    return replay_law(scenario, run)


def _require_same_run(scenario: Scenario, run: Run) -> None:
    """Raise TheoryError unless ``run`` has the nodes and the number of states of the scenario."""
    if not isinstance(run, Run):
        raise TheoryError(
            f"run must be a netkf.Run, as netkf.simulate returns it, got a {type(run).__name__}"
        )
    if run.nodes != scenario.nodes or run.x.shape[1] != scenario.plant.n:
        raise TheoryError("the run is of another scenario: its nodes or its state differ")


def _replay_nodes(scenario: Scenario, run: Run, about_mean: bool = True) -> FloatArray:
    """Return the joint error covariance (T, N n, N n) of all N nodes at the T ``run.times``, or the
    second moments unless ``about_mean``.

    Raises TheoryError if the run is of another scenario.
    """
    _require_same_run(scenario, run)
    joint, nodes = replay_covariances(scenario, run, about_mean), len(scenario.nodes)
    # A pooled filter is replayed once; all nodes share its estimate, and so its error.
    shared = joint.shape[-1] < nodes * scenario.plant.n
    return np.tile(joint, (1, nodes, nodes)) if shared else joint
