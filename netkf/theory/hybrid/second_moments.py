"""The condition for the covariances of H to have a variance: second moments of an upper bound.

With the constant gains of the steady bound calP every node's covariance obeys a linear recursion
that has mean calP and dominates P on every path (derived). Its second moments obey a linear
equation, ``dY = L Y + Y L' + sum over outcomes of an activation, rate (J Y J' - Y)``; they stay
finite, and so does the variance of P, if that equation is stable. For one scalar node without a
sensor, of growth rate a, this is rate > 4 a / (pi (2 - pi)) with pi its weight on the message.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal, row_units
from netkf.network.clocks import LinkClock
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import no_channel_law
from netkf.theory.common.jumps import ClockJumps
from netkf.theory.common.random_links import directions_of, poisson_ticks
from netkf.theory.hybrid.steady import steady_covariance_bound

MAX_ENTRIES = 200  # entries of all covariances together


def second_moment_rate(scenario: Scenario) -> float:
    """Return the growth rate (1/s) of second moments of an upper bound on P: below 0 intervals for
    the mean of P hold. Raises TheoryError but for Poisson clocks, independent losses, no delay.
    """
    channel = scenario.network.channel
    clock = scenario.network.activation
    if not (isinstance(clock, LinkClock) and clock.memoryless):
        raise TheoryError("the second moments of P are known for Poisson clocks only")
    if clock.at != "links" or scenario.sampled_sensors:
        raise TheoryError("the second moments of P are known for clocks of links and increments")
    if scenario.network_changes:
        raise TheoryError(no_channel_law(scenario))
    if not channel.independent or channel.delay.fixed != 0.0:
        raise TheoryError("the second moments of P are known without bursts and delays only")
    nodes, n = len(scenario.nodes), scenario.plant.n
    size = nodes * n * n
    if size > MAX_ENTRIES:
        raise TheoryError(f"the second moments of P have {size:,}^2 entries, too many to decide")
    system = _linear_recursion(scenario, steady_covariance_bound(scenario))

    def equation(flat: FloatArray) -> FloatArray:
        Y = np.asarray(flat, dtype=np.float64).reshape(system.shape)
        half = system.flows @ Y
        other = Y @ np.swapaxes(system.flows, 1, 2)
        return np.asarray(half + other + system.inflow(Y)).reshape(-1)

    operator = scipy.sparse.linalg.LinearOperator((size**2, size**2), equation, dtype=float)
    # The equation preserves positive semidefinite Y: start inside that cone.
    start = np.tile(np.eye(n).reshape(-1), nodes)
    first = np.outer(start, start).reshape(-1)
    if size < 3:  # too few rows for Arnoldi's method
        dense = np.stack([equation(column) for column in np.eye(size**2)], axis=1)
        return float(np.linalg.eigvals(dense).real.max())
    try:
        values = scipy.sparse.linalg.eigs(
            operator, k=1, which="LR", v0=first, tol=1e-6, return_eigenvectors=False
        )
    except scipy.sparse.linalg.ArpackNoConvergence:
        raise TheoryError("the growth of the second moments of P was not found") from None
    return float(values.real.max())


def _linear_recursion(scenario: Scenario, bound: FloatArray) -> ClockJumps:
    """Return the recursion of stacked vec(P_i) with the gains of ``bound``, a system with jumps."""
    eye, drifts = np.eye(scenario.plant.n), []
    units = row_units(np.diagonal(bound, axis1=1, axis2=2).max(axis=0))
    for P, model in zip(bound, scenario.models, strict=True):
        # vec of d P_i / dt = (A - P G) P_i + P_i (A - P G)' between events.
        closed = model.A - P @ model.H.T @ np.linalg.solve(model.R, model.H)
        closed = closed * units / units[:, None]  # where Arnoldi's method loses no digits
        drifts.append(np.kron(closed, eye) + np.kron(eye, closed))
    drift, links = block_diagonal(drifts), scenario.topology.directions
    weights = {(i, j): scenario.weight(j, i) * np.eye(eye.size) for i, j in links}
    directions = directions_of(scenario, weights, math.inf) if weights else None
    ticks = poisson_ticks(scenario, list(weights))
    return ClockJumps(len(bound), drift, np.zeros_like(drift), (), directions, ticks)
