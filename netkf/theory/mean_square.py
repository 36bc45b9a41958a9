"""Exact steady mean squares of errors over random losses, bursts and clocks.

Where the gains of a filter do not depend on data or on what happens in the network, its errors are
a linear system with jumps (theory/common/jumps.py), which the folder of the paper makes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.records import Kernels
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.linalg.spectra import contracts
from netkf.scenario.registry import kind_name
from netkf.scenario.scenario import Scenario
from netkf.theory.common.delayed_jumps import DelayedJumps
from netkf.theory.common.evidence import require_every_reading
from netkf.theory.common.jumps import SlotJumps
from netkf.theory.errors import diagonal_blocks, require_known_filter
from netkf.theory.folders import LinearErrors, theory_of
from netkf.theory.intermittent.riccati import steady_gain
from netkf.theory.numerics.positive_maps import fixed_point, spectral_radius

MAX_ERRORS = 200
"""Largest number of errors of all nodes; a step then takes milliseconds, a solution seconds."""
MAX_NUMBERS, QUICK_NUMBERS = 4_000_000, 40_000
"""Largest number of entries of the second moments of all modes, and that up to which a solution
takes a second.
"""


def mean_square_radius(scenario: Scenario) -> float:
    """Return the spectral radius of the mean-square dynamics, which is below 1 if and only if
    errors stay bounded in the mean square.

    In slots it is the growth factor of second moments per slot. In continuous time it is that of
    the map from second moments to those that their jumps maintain, of which only the comparison
    with 1 has a meaning; inf if errors grow between jumps, or in the mean. Raises TheoryError if
    the gains are not constant or the network has no known law.
    """
    if _choose_solver(scenario) is None:
        system = _make_system(scenario)
        if isinstance(system, DelayedJumps):
            return (
                spectral_radius(system.apply_jumps, system.shape)
                if system.mean_is_stable
                else np.inf
            )
    return _solve(scenario)[0]


def steady_error_covariance(scenario: Scenario) -> FloatArray:
    """Return the exact steady mean (N, n, n) of ``(x - xhat_i)(x - xhat_i)'``, over noises, losses
    and clocks, in the order of the nodes; in slots as samples show it.

    By one generalised Lyapunov equation, for filters whose gains are constant: ``constant-gain``,
    ``kcf`` in slots with its own readings or without losses, ``track-fusion`` by
    cross-covariances, ``local`` and ``central`` in slots. Losses may be independent, by link or
    bursty (Gilbert-Elliott, few links),
    delays none or fixed (not beside bursts under Poisson clocks; below the period of periodic
    clocks; in slots a message that is late is lost), clocks Poisson, or periodic and all together
    (the mean is then that at exchanges, after them); at most 200 errors of all nodes together.
    Delays under Poisson clocks are solved to about 1e-10, in a second or two for 100 errors and six
    for 200; ``mean_square_radius`` takes some twenty times as long then. Raises TheoryError with
    the reason where there is no such mean, or it is not known.
    """
    radius, covariance = _solve(scenario)
    if covariance is None:
        raise TheoryError(
            f"no steady mean square: its radius is {radius:.6g}, not below 1, and errors grow in "
            "the mean square"
        )
    return covariance.copy()


@lru_cache(maxsize=8)
def _solve(scenario: Scenario) -> tuple[float, FloatArray | None]:
    """Return the radius and the steady covariances (N, n, n), None unless it is below 1."""
    solve = _choose_solver(scenario)
    if solve is not None:
        _require_known_law(scenario)
        solved: tuple[float, FloatArray | None] = solve(scenario)
        return solved
    system = _make_system(scenario)
    if isinstance(system, DelayedJumps):
        # The radius takes many times as long as the covariance, whose existence proves it below 1.
        radius = (
            0.0 if system.mean_is_stable and system.is_bounded else mean_square_radius(scenario)
        )
        if not contracts(radius):
            return radius, None
        X = system.covariance
    else:
        T, Q = system.maps()
        radius = spectral_radius(T, system.shape) if Q is not None else np.inf
        if Q is None or not contracts(radius):
            return float(radius), None
        X = fixed_point(T, Q, radius)
    X = X.sum(axis=0)
    covariances = diagonal_blocks(X[None], system.nodes)[0]
    # Nodes that share one filter share its error.
    return radius, np.repeat(covariances, len(scenario.nodes) // system.nodes, axis=0)


@lru_cache(maxsize=8)
def _make_system(scenario: Scenario) -> LinearErrors:
    system = linear_errors(scenario)
    _require_size(system.shape)
    return system


def linear_errors(scenario: Scenario) -> LinearErrors:
    """Return the errors as a linear system with jumps; TheoryError if gains follow events."""
    _require_known_law(scenario)
    make = _system_maker(scenario)
    if make is None:
        filter_name = kind_name(scenario.filter.algorithm)
        raise TheoryError(
            f"exact steady mean squares are not known for the {filter_name} filter "
            f"{'in slots' if scenario.slotted else 'under clocks'}, whose gains follow what "
            "happens"
        )
    system: LinearErrors = make(scenario)
    return system


def _require_known_law(scenario: Scenario) -> None:
    """Raise TheoryError if the errors have no law: records, own equations, another model."""
    require_known_filter(scenario)
    require_every_reading(scenario)
    if not scenario.is_random:
        raise TheoryError("the state or readings are recorded: their law is not known")
    believed, true = (
        (scenario.slot_belief[0], scenario.linear_plant.F)
        if scenario.slotted
        else (scenario.belief[0], scenario.diffusion.A)
    )
    if not np.array_equal(believed, true):
        raise TheoryError("the filters' plant is not the true one: errors follow the state")
    if scenario.surprise is not None:
        raise TheoryError("the filters do not know the input of the plant: errors follow it")


def has_linear_errors(scenario: Scenario) -> bool:
    """Return True if filters of this class have constant gains in some scenarios."""
    return _system_maker(scenario) is not None or _choose_solver(scenario) is not None


def is_quickly_solved(scenario: Scenario) -> bool:
    """Return True if the mean squares of a scenario with constant gains take a second or so."""
    if _choose_solver(scenario) is not None:
        return len(scenario.nodes) * scenario.plant.n <= MAX_ERRORS
    system = linear_errors(scenario)
    S, M, _ = system.shape
    # With delays, moments between errors at all collocation points of the delay are solved for.
    times = system.points + 1 if isinstance(system, DelayedJumps) else 1
    return S * M * M * times <= QUICK_NUMBERS


def _choose_solver(
    scenario: Scenario,
) -> Callable[[Scenario], tuple[float, FloatArray | None]] | None:
    is_exact = scenario.node_filter.analysis.P_by_design[0] == "equal"
    return theory_of(scenario).steady_slots if scenario.slotted and is_exact else None


def _system_maker(scenario: Scenario) -> Callable[[Scenario], LinearErrors] | None:
    node_filter, paper = scenario.node_filter, theory_of(scenario)
    if not scenario.slotted:
        return paper.clock_jumps
    # A Kalman filter on own readings, and nothing else.
    if compiled_kernels(node_filter, clocked=False) == Kernels() and not node_filter.timing.talks:
        return silent_jumps
    return paper.slot_jumps


def _require_size(shape: tuple[int, int, int]) -> None:
    S, M, _ = shape
    if M > MAX_ERRORS:
        raise TheoryError(
            f"{M} errors of all nodes together; exact mean squares are computed for at most "
            f"{MAX_ERRORS}"
        )
    if S * M * M > MAX_NUMBERS:
        raise TheoryError(
            f"{S} joint states of the links with {M} errors are {S * M * M:,} numbers; at most "
            f"{MAX_NUMBERS:,} are computed"
        )


def silent_jumps(scenario: Scenario) -> SlotJumps:
    """Return the errors of silent Kalman filters in slots; one block if they share a filter."""
    F, Q = scenario.slot_belief
    if scenario.node_filter.timing.pooled:
        model = scenario.pooled_slot_model
        sensors = [(model.H, model.R)]
        true = [block_diagonal([scenario.observation_matrices(node)[1] for node in scenario.nodes])]
    else:
        sensors = [scenario.observation_matrices(node, believed=True) for node in scenario.nodes]
        true = [scenario.observation_matrices(node)[1] for node in scenario.nodes]
    gains = [steady_gain(F, Q, *sensor) for sensor in sensors]
    closed = np.stack([np.eye(len(F)) - K @ H for K, (H, _) in zip(gains, sensors, strict=True)])
    noise = block_diagonal([K @ R @ K.T for K, R in zip(gains, true, strict=True)])
    return SlotJumps(
        scenario.linear_plant.F, scenario.linear_plant.Q, closed, noise, directions=None
    )
