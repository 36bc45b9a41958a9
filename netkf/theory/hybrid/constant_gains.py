"""The bound with constant gains, which the time-varying gains of H improve (H Remark 1, (15)).

    dP_i/dt = (A - L_i H_i) P_i + P_i (A - L_i H_i)' + L_i R_i L_i' + Q + sum_j c_ij (P_j - P_i)

With the gains ``L_i = P_i H_i' R_i^-1`` of H(12) itself the right-hand side is smallest, so that
the solution for any other gains stays above that of H(12) from the same start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import increment_observations
from netkf.theory.hybrid.coupled import at_nodes, coupled_riccati
from netkf.theory.hybrid.linearised import is_stable, solve_map
from netkf.theory.hybrid.packed import LinearisedRiccati, PackedRiccati
from netkf.theory.hybrid.steady import steady_covariance_bound
from netkf.theory.numerics.matrices import as_list, as_numbers, as_times

MAX_DENSE = 500  # unknowns up to which the exponential of the whole map is computed
MAX_STEP = 30.0  # norm of the map over a step beyond that


def constant_gain_bound(
    scenario: Scenario, times: Any = None, gains: Sequence[ArrayLike] | None = None
) -> FloatArray:
    """Return the upper bound (T, N, n, n) on the mean of each filter's P over the ticks of the
    links, at T ``times``, which H(12) would be with constant ``gains``.

    times : (T,) in seconds, increasing; for None the steady state (N, n, n) is returned
    gains : L_i (n, p_i) for each of N nodes, or for the one filter of all; by default those of the
            steady state of H(12)

    The bound is the mean of P_i itself if every node uses its L_i (derived). Raises TheoryError for
    sampled sensors, delays and wrong shapes, and if there is no steady state.
    """
    linear, constant, units = _linear_equation(scenario, gains)
    packed, scale = linear.packed, np.outer(units, units)
    if times is None:
        if not is_stable(linear):
            raise TheoryError("constant gains do not stabilise the filters: no steady state")
        return at_nodes(scenario, packed.unpack(solve_map(linear, constant)) * scale)
    moments = as_times(times)
    # An entry that stays 1 makes the constant term part of a linear map.
    column = scipy.sparse.csc_array(constant.reshape(-1, 1))
    above = scipy.sparse.hstack([linear.matrix(), column])
    below = scipy.sparse.csr_array((1, constant.size + 1))
    all_times = scipy.sparse.csc_array(scipy.sparse.vstack([above, below]))
    size = float(abs(all_times).sum(axis=0).max())  # scipy 1.13 has no norm of sparse arrays
    y, bounds = np.append(packed.start.reshape(-1), 1.0), []
    for gap in np.diff(moments, prepend=0.0):
        if all_times.shape[0] <= MAX_DENSE:
            with np.errstate(over="ignore", invalid="ignore"):
                y = scipy.linalg.expm(all_times.toarray() * gap) @ y
        elif gap > 0.0:
            # For longer steps scipy estimates norms with numpy's global generator.
            steps = int(np.ceil(gap * size / MAX_STEP))
            for _ in range(steps):
                y = scipy.sparse.linalg.expm_multiply(all_times * (gap / steps), y)
        if not np.isfinite(y).all():
            raise TheoryError(f"the bound overflows within {gap:g} s: give earlier times")
        bounds.append(packed.unpack(y[:-1].reshape(constant.shape)) * scale)
    return at_nodes(scenario, np.array(bounds))


def _linear_equation(
    scenario: Scenario, gains: Sequence[ArrayLike] | None
) -> tuple[LinearisedRiccati, FloatArray, FloatArray]:
    """Return map and constant of dP/dt = map(P) + ``L_i R_i L_i' + Q`` in natural units of states,
    and these (n,); raises TheoryError.
    """
    equations = coupled_riccati(scenario)
    if equations.samples or equations.jumps or equations.delay:
        raise TheoryError("constant gains are for sensors in continuous time and no delay")
    n = len(equations.A)
    observations = [(o.H, o.R) for o in increment_observations(scenario)]
    if gains is None:
        P = steady_covariance_bound(scenario)[: len(observations)]
        gains = [p @ np.linalg.solve(R, H).T for p, (H, R) in zip(P, observations, strict=True)]
    gain_matrices = [as_numbers("gains", L) for L in as_list("gains", gains)]
    if [L.shape for L in gain_matrices] != [(n, len(H)) for H, _ in observations]:
        shared = len(observations) < len(scenario.nodes)
        whose = "the filter of all nodes" if shared else "each node"
        raise TheoryError(f"gains must have one (n, p_i) array for {whose}")
    equations, units = equations.in_natural_units()
    pairs = [
        (L / units[:, None], (H * units, R))
        for L, (H, R) in zip(gain_matrices, observations, strict=True)
    ]
    corrections = np.array([L @ H for L, (H, _) in pairs])
    packed = PackedRiccati(equations)
    constant = packed.pack(np.array([L @ R @ L.T for L, (_, R) in pairs]) + equations.Q)
    return packed.linear_with_gains(corrections), constant, units
