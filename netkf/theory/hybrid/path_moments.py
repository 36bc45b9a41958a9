"""Mean squared errors of the hybrid filters given the messages of a run, by quadrature.

As ``netkf.theory.error_covariance``, to some six digits instead of rounding and a hundred times
faster, for filters in continuous time whose messages take no time and whose sensors give
increments. Averages over runs need no more.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.kernels.error_moments import run_moments
from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

STEP = 0.1  # step of the integration (seconds) times the fastest rate (1/s)
MAX_ERRORS = 120  # of all nodes together


def expected_squares(scenario: Scenario, run: Run) -> FloatArray:
    """Return E|x - xhat_i|^2 (T, N) at ``run.times``, given the messages of the run.

    Raises TheoryError for filters, sensors and channels for which it is not known in this way.
    """
    _require_exact_model(scenario)
    A, Q = scenario.belief
    nodes = scenario.nodes
    G, true_G = np.zeros((2, len(nodes), *A.shape))
    for i, node in enumerate(nodes):
        H, R = scenario.observation_matrices(node, believed=True)
        gain = np.linalg.solve(R, H).T
        G[i], true_G[i] = gain @ H, gain @ scenario.observation_matrices(node)[1] @ gain.T
    P = np.array([scenario.initial_estimate(node)[1] for node in nodes], dtype=np.float64)
    # All estimates start at known means: their first errors are x(0) less a constant.
    means = (
        np.array([scenario.initial_estimate(node)[0] for node in nodes]) - scenario.plant.start_mean
    )
    S = np.einsum("ia,jb->ijab", means, means) + np.asarray(scenario.plant.start_cov)
    instants, ends, rows, columns, weights = _arrivals_in_order(scenario, run)
    fastest = max(float(np.abs(p @ g).max()) for p in P for g in G) + float(np.abs(A).max())
    plain = [np.ascontiguousarray(x, dtype=np.float64) for x in (A, Q, scenario.diffusion.Q)]
    model = (*plain, G, true_G)
    squares = np.empty((len(run.times), len(nodes)))
    step = STEP / max(fastest, 1e-9)
    run_moments(P, S, model, instants, ends, rows, columns, weights, run.times, step, squares)
    if not np.isfinite(squares).all():
        raise TheoryError("the mean squares grow too fast for their quadrature")
    return squares


def _require_exact_model(scenario: Scenario) -> None:
    """Raise TheoryError unless the quadrature holds: increments, messages without delay."""
    if scenario.slotted or scenario.sampled_sensors or not scenario.is_random:
        raise TheoryError("mean squares by quadrature are for random increments")
    kernels = scenario.node_filter.kernels
    if kernels is None or not kernels.is_convex or overridden(scenario.filter.algorithm):
        raise TheoryError("mean squares by quadrature are for the hybrid filter")
    if scenario.network.channel.delay.fixed != 0.0:
        raise TheoryError("mean squares by quadrature are for messages that take no time")
    if not np.array_equal(scenario.belief[0], scenario.diffusion.A):
        raise TheoryError("the filters' A differs from the plant's: the error follows the state")
    if len(scenario.nodes) * scenario.plant.n > MAX_ERRORS:
        raise TheoryError(f"mean squares by quadrature are for at most {MAX_ERRORS} errors")


def _arrivals_in_order(
    scenario: Scenario, run: Run
) -> tuple[FloatArray, np.ndarray, np.ndarray, np.ndarray, FloatArray]:
    """Return instants (T,), first messages (T + 1,), and receivers, senders, weights (M,)."""
    rows = run.log[run.log["kind"] == CODES["deliver"]]
    index = scenario.topology.index
    index_of = np.zeros(max(index) + 1, dtype=np.int64)
    index_of[list(index)] = list(index.values())
    pairs, order = np.unique(
        np.stack([rows["node"], rows["peer"]], axis=1), axis=0, return_inverse=True
    )
    table = np.array([scenario.weight(int(i), int(j)) for i, j in pairs], dtype=np.float64)
    instants, starts = np.unique(rows["t"], return_index=True)
    ends = np.append(starts, len(rows)).astype(np.int64)
    weights = table[order.reshape(-1)] if len(pairs) else np.zeros(0)
    return instants, ends, index_of[rows["node"]], index_of[rows["peer"]], weights
