"""The condition for the covariances of H to have a variance: second moments of an upper bound.

With the constant gains of the steady bound calP every node's covariance obeys a linear recursion
that has mean calP and dominates P on every path (derived). Its second moments obey a linear
equation, ``dY = L Y + Y L' + sum over outcomes of an activation, rate (J Y J' - Y)``; they stay
finite, and so does the variance of P, if that equation is stable. For one scalar node without a
sensor, of growth rate a, this is rate > 4 a / (pi (2 - pi)) with pi its weight on the message.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import Poisson
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.steady import steady_covariance_bound

MAX_ENTRIES = 200  # entries of all covariances together


def second_moment_rate(scenario: Scenario) -> float:
    """Return the growth rate (1/s) of second moments of an upper bound on P; below 0 intervals for
    the mean of P hold. Raises TheoryError except for Poisson clocks of links with independent
    losses and no delay, without a steady bound, and for very large networks.
    """
    channel = scenario.network.channel
    if not isinstance(scenario.network.activation, Poisson):
        raise TheoryError("the second moments of P are known for Poisson clocks only")
    if scenario.network.activation.at != "links" or scenario.sampled_sensors:
        raise TheoryError("the second moments of P are known for clocks of links and increments")
    if not channel.loss.independent or channel.delay.fixed != 0.0:
        raise TheoryError("the second moments of P are known without bursts and delays only")
    nodes, n = len(scenario.nodes), scenario.plant.n
    size = nodes * n * n
    if size > MAX_ENTRIES:
        raise TheoryError(f"the second moments of P have {size:,}^2 entries, too many to decide")
    equation = _SecondMomentEquation(scenario, steady_covariance_bound(scenario))
    # Arnoldi's method needs at least three rows.
    if size == 1:
        return float(equation(np.ones(1))[0])
    operator = scipy.sparse.linalg.LinearOperator((size**2, size**2), equation, dtype=float)
    # The equation preserves positive semidefinite Y: start inside that cone.
    start = np.tile(np.eye(n).reshape(-1), nodes)
    first = np.outer(start, start).reshape(-1)
    if size < 3:
        dense = np.stack([equation(column) for column in np.eye(size**2)], axis=1)
        return float(np.linalg.eigvals(dense).real.max())
    try:
        values = scipy.sparse.linalg.eigs(
            operator, k=1, which="LR", v0=first, tol=1e-6, return_eigenvectors=False
        )
    except scipy.sparse.linalg.ArpackNoConvergence:
        raise TheoryError("the growth of the second moments of P was not found") from None
    return float(values.real.max())


class _SecondMomentEquation:
    """The right-hand side, per second, for second moments Y (N n n, N n n), as a function of flat
    arrays.

    Axes of Y are those of the stacked vec(P_i), node by node; ``bound`` (N, n, n) is calP, whose
    constant gains the recursion uses.
    """

    def __init__(self, scenario: Scenario, bound: FloatArray) -> None:
        """Take the gains of the steady ``bound`` (N, n, n) of the scenario's N nodes."""
        n, index = scenario.plant.n, scenario.topology.index
        self._shape = (len(index), n * n, len(index), n * n)
        eye = np.eye(n)
        closed = [
            model.A - P @ model.H.T @ np.linalg.solve(model.R, model.H)
            for P, model in zip(bound, scenario.models, strict=True)
        ]
        # vec of d P_i / dt = (A - P G) P_i + P_i (A - P G)' between events.
        self._drift_maps = np.array([np.kron(M, eye) + np.kron(eye, M) for M in closed])
        self._mixing = np.zeros((len(index), len(index)))
        self._outcomes: list[tuple[int, int, float, float, float]] = []
        for i, j in scenario.topology.links:
            self._add_link(scenario, i, j, index[i], index[j])

    def _add_link(self, scenario: Scenario, i: int, j: int, a: int, b: int) -> None:
        """Add the outcomes of an activation of link (i, j) between the nodes a and b."""
        clock, channel = scenario.network.activation, scenario.network.channel
        assert isinstance(clock, Poisson)
        rate, loss = clock.mean_rate((i, j)), channel.loss
        # One activation has three outcomes with an effect: either message arrives alone, or both.
        to_j = loss.mean_delivery((i, j), scenario.table_probability((i, j)))
        to_i = loss.mean_delivery((j, i), scenario.table_probability((j, i)))
        # Symmetric losses are lost together, others independently.
        both_arrive = min(to_i, to_j) if channel.symmetric else to_i * to_j
        at_i, at_j = scenario.weight(i, j), scenario.weight(j, i)
        for x, y, probability, weight in ((a, b, to_i, at_i), (b, a, to_j, at_j)):
            self._mixing[x, y] += rate * probability * weight
            self._mixing[x, x] -= rate * probability * weight
        self._outcomes += [
            (a, b, rate * (to_i - both_arrive), at_i, 0.0),
            (a, b, rate * (to_j - both_arrive), 0.0, at_j),
            (a, b, rate * both_arrive, at_i, at_j),
        ]

    def __call__(self, flat: FloatArray) -> FloatArray:
        Y = np.asarray(flat, dtype=np.float64).reshape(self._shape)
        # L Y + Y L'
        change = np.einsum("aij,ajbk->aibk", self._drift_maps, Y)
        change += np.einsum("ac,cibk->aibk", self._mixing, Y)
        transposed_change = np.einsum("bkl,aibl->aibk", self._drift_maps, Y)
        transposed_change += np.einsum("bc,aick->aibk", self._mixing, Y)
        result = change + transposed_change
        for a, b, rate, at_a, at_b in self._outcomes:
            if rate == 0.0:
                continue
            # (J - I) Y (J - I)', where J - I moves a towards b and b towards a
            core = Y[a, :, a] - Y[a, :, b] - Y[b, :, a] + Y[b, :, b]
            result[a, :, a] += rate * at_a * at_a * core
            result[b, :, b] += rate * at_b * at_b * core
            result[a, :, b] -= rate * at_a * at_b * core
            result[b, :, a] -= rate * at_a * at_b * core
        return np.asarray(result.reshape(-1))
