"""``check_filter``: checks of a filter against its contract, in slots and in continuous time."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import STEPS, Filter, commutes
from netkf.algorithms.registry import base_filter, built_in_class, own_attributes
from netkf.algorithms.traits import Needs, Timing, Weights
from netkf.core.contracts import is_netkf_class
from netkf.core.errors import ScenarioError
from netkf.engines.base import Engine
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel
from netkf.network.lives import Crashes
from netkf.network.losses import Bernoulli
from netkf.scenario.scenario import Scenario
from netkf.testing.observed import Seen
from netkf.testing.small_runs import kinds_of, make_systems, run, setups, small_scenario
from netkf.testing.watching import (
    ROUNDING,
    WatchedPart,
    checker,
    demand_kind,
    fail,
    is_number,
    make_part,
    scaled_difference,
)

MAX_DEGREE = 8  # weights are checked for all pairs of degrees up to it
SHIFT_TOLERANCE = 1e-9  # relative to the estimates before the shift is subtracted


@checker
def check_filter(filter: Any, /, same_as_parent: bool | None = None, **settings: Any) -> None:
    """Check a filter, or a class with its ``settings``, against its contract.

    It runs on small random systems of one to three states, in slots and in continuous time under
    each clock in ``clocks``, as far as the class supports them.

    Of every method: it does not change its arguments, states, payloads or the filter, then or
    later; the same arguments give the same result; no global generator is used. Estimates are
    (n,); covariances are None, or (n, n), symmetric and positive semidefinite after every step.
    Weights are not negative and sum to at most 1. Filter and states survive pickle. In continuous
    time ``predict`` composes over gaps. In slots the schedule is valid and an empty inbox is
    absorbed. An exchange without losses conserves the sums that ``conserved`` names. A class that
    defines ``shift`` must give shifted estimates from shifted data. A user's kernels must give the
    same numbers in both engines, in nine runs side by side, some messages of which are lost and
    whose node 0 is down at times.

    A class that derives from a built-in filter and overrides anything (methods, class variables,
    weights, the first slot, private helpers) is also compared with that filter, with the same
    settings, readings and messages, in slots and under the clocks that both support. A difference
    of estimates or covariances of more than 1e-6 of their size is an AssertionError that names the
    overridden attributes; it is a UserWarning if the class defines one of ``init``, ``predict``,
    ``update``, ``emit``, ``absorb`` or ``estimate``, because it may be by design. With
    ``same_as_parent=False``, for a difference by design, nothing is compared; with
    ``same_as_parent=True`` every difference is an AssertionError.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(filter, (Filter,), settings)
    demand_kind("same_as_parent", same_as_parent, bool)
    watched = WatchedPart(part)
    watched.pickle_copy()
    _check_flags(watched, "needs", part.needs, Needs)
    _check_flags(watched, "timing", part.timing, Timing)
    clocks = part.timing.clocks
    can_run = bool(clocks) or part.timing.schedule is not None or not part.timing.talks
    rule = "must name a clock where schedule is None: the filter could not run at all"
    watched.demand("timing.clocks", can_run, rule, clocks)
    if part.timing.talks:
        _check_weights(watched)
    if part.timing.schedule is not None:
        _check_schedule(watched)
    seen = [(run(watched, *setup)[0], setup) for setup in setups(part)]
    if commutes(part):
        for one, setup in seen:
            _check_shift(watched, one, run(watched.unchecked(), *setup, shifted=True)[0])
    watched.finish()
    check_kernels(watched)
    check_parent(watched, same_as_parent)


def _check_shift(watched: WatchedPart, seen: list[Seen], shifted: list[Seen]) -> None:
    # Simulations of growing states move the truth back to 0, and all estimates with it.
    rule = "a class that defines shift must commute with a shift of the truth"
    remedy = "correct shift, of states and of payloads, or do not define it"
    for one, other in zip(seen, shifted, strict=True):
        pairs = [("xhat", one.xhat, other.xhat, 1.0 + one.size + other.size)]
        if one.P is not None and other.P is not None:
            pairs.append(("P", one.P, other.P, 1.0 + float(np.abs(one.P).max())))
        for name, mine, moved, size in pairs:
            difference = float(np.abs(mine - moved).max())
            got = f"{name} of node {one.node} after {one.after} that differs by {difference:.3g}"
            got += " once truth, states and payloads are shifted"
            watched.demand("shift", difference <= SHIFT_TOLERANCE * size, rule, got, remedy)


def _check_flags(watched: WatchedPart, name: str, value: Any, kind: type[Any]) -> None:
    flags = [field.name for field in dataclasses.fields(kind) if isinstance(field.default, bool)]
    for flag in flags:
        got = getattr(value, flag)
        watched.demand(f"{name}.{flag}", isinstance(got, bool), "must be True or False", got)


def _check_schedule(watched: WatchedPart) -> None:
    schedule, demand = watched.part.timing.schedule, watched.demand
    rule = 'must have one "predict" and one "sense" at most'
    no_repeats = max(schedule.count("predict"), schedule.count("sense")) <= 1
    demand("timing.schedule", no_repeats, rule, schedule)
    if {"predict", "sense"} <= set(schedule):
        is_later = schedule.index("sense") < schedule.index("predict")
        rule = 'must be True where the schedule has "predict" after "sense", and False where before'
        remedy = "else estimates are compared with the state of another slot"
        got = watched.part.timing.predicts
        demand("timing.predicts", got is is_later, rule, got, remedy)
    for phase in range(schedule.count("exchange")):
        steps = watched.call("timing.steps", phase)
        is_count = isinstance(steps, int) and steps >= 1
        demand("timing.steps", is_count, "must be a whole number of at least 1", steps)
        redraws = watched.call("timing.redraws", phase, 0)
        rule, remedy = "must be True in step 0", "links have no outcome yet"
        demand("timing.redraws", redraws is True, rule, redraws, remedy)


def _check_weights(watched: WatchedPart) -> None:
    given, demand = watched.part.link_weights, watched.demand
    _check_flags(watched, "link_weights", given, Weights)
    largest = given.largest_degree
    demand("link_weights.largest_degree", largest >= 1.0, "must be at least 1", largest)
    if given.matrix is not None:
        _check_matrix(watched, np.asarray(given.matrix))
        return
    degrees = range(1, int(min(largest, MAX_DEGREE)) + 1)
    for degree in degrees:
        weights = [watched.call("link_weights.of", degree, peer_degree) for peer_degree in degrees]
        for peer_degree, weight in zip(degrees, weights, strict=True):
            rule = f"must be a number from 0 to 1 for {degree} and {peer_degree} links"
            is_weight = is_number(weight) and 0.0 <= weight <= 1.0
            demand("link_weights.of", is_weight, rule, weight)
        rule = "the weights of all messages that may arrive together must sum to at most 1"
        got = f"{degree * max(weights):.4g} at a node of {degree} links"
        remedy = "give smaller weights, or let largest_degree say how many links are allowed"
        demand("link_weights.of", degree * max(weights) <= 1.0 + 1e-9, rule, got, remedy)


def _check_matrix(watched: WatchedPart, weights: FloatArray) -> None:
    demand, where = watched.demand, "link_weights.matrix"
    is_square = weights.ndim == 2 and weights.shape[0] == weights.shape[1]
    demand(where, is_square, "must be a square matrix", str(weights.shape))
    demand(where, (weights >= 0.0).all(), "must not be negative", float(weights.min()))
    sums = weights.sum(axis=0)
    rule = "columns, the weights that a node gives, must sum to at most 1"
    remedy = "entry [l, i] is the weight node i gives to what node l sends"
    demand(where, (sums <= 1.0 + 1e-9).all(), rule, sums, remedy)


RUNS = range(9)
"""Runs that compare kernels: more than are side by side."""
DELIVERY, UP, DOWN = 0.6, 3.0, 1.0
"""Delivery probability, and mean times in ticks for which node 0 is up and down."""


def check_kernels(watched: WatchedPart) -> None:
    """Check that a user's kernels give the same numbers in both engines, and beside other runs."""
    part, compiled = watched.part, CompiledEngine()
    if part.kernels is None or is_netkf_class(type(part)):
        return
    for scenario in _kernel_scenarios(part):
        if compiled.refusal(scenario) is not None:
            continue
        alone, beside = (_simulate(engine, scenario) for engine in (SimpyEngine(), compiled))
        for name, one, other in zip(("xhat", "P"), alone, beside, strict=True):
            differences = [scaled_difference(*pair) for pair in zip(one, other, strict=True)]
            run = int(np.argmax(differences))
            rule = "must give each run what it has alone, in both engines"
            got = f"{name} that differs by {differences[run]:.2g} of its size in run {run}"
            remedy = "compute in all lanes: select by run.arrived, and leave messages as they are"
            watched.demand("kernels", differences[run] <= ROUNDING, rule, got, remedy)


def _kernel_scenarios(part: Any) -> Iterator[Scenario]:
    """Yield a scenario in slots, and one under clocks, that the filter accepts."""
    kinds, channel = kinds_of(part), Channel(loss=Bernoulli(DELIVERY))
    for slotted in (True, False):
        system = make_systems(part.needs.inverts or part.needs.inverts_under_clocks)[-1]
        kind = next((k for k in kinds if bool(k.slots) == slotted and not k.increments), None)
        if kind is None:
            continue
        kind = kind._replace(slots=4 * kind.slots)
        crashes = Crashes(nodes=(0,), mean_up=UP, mean_down=DOWN)
        try:
            yield small_scenario(part, system, kind, channel, (crashes,))
        except ScenarioError:  # it cannot be down
            yield small_scenario(part, system, kind, channel)


def _simulate(engine: Engine, scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Return xhat (R, T, F, n) and P (R, T, F, n, n) of all runs, without nan."""
    batches = list(engine.run_many(scenario, 0, RUNS))
    xhat, P = (np.concatenate([getattr(b, name) for b in batches]) for name in ("xhat", "P"))
    return np.nan_to_num(xhat), np.nan_to_num(P)


PARENT_TOLERANCE = 1e-6
"""Largest relative difference that another order of operations may cause."""
UNEQUAL = np.array([[0.5, 0.3, 0.2], [0.2, 0.5, 0.3], [0.3, 0.2, 0.5]])
"""Weights of three nodes whose rows and columns sum to 1, and are not the same."""


class EstimateDifference(NamedTuple):
    """A difference of estimates from those of the parent.

    relative : difference divided by the size of the quantity
    quantity : "xhat" or "P"
    where    : node and time, as text
    """

    relative: float
    quantity: str
    where: str


def check_parent(watched: WatchedPart, same_as_parent: bool | None) -> None:
    """Compare a filter that overrides something with its parent, in slots and under clocks.

    Raises AssertionError if estimates differ by more than PARENT_TOLERANCE; with ``same_as_parent``
    None, a class that defines one of the methods STEPS gets a UserWarning instead.
    """
    part = watched.part
    parent_class = built_in_class(part)
    overrides = own_attributes(part)
    if same_as_parent is False or parent_class is None or not overrides:
        return
    child, parent = watched.unchecked(), WatchedPart(base_filter(part)).unchecked()
    worst = largest_difference(child, parent)
    # Weights that are equal, or of the same matrix by rows and columns, say nothing of the order.
    if isinstance(getattr(parent.part, "weights", None), str):
        child, parent = (_with_weights(one, UNEQUAL) for one in (child, parent))
        worst = max(filter(None, (worst, largest_difference(child, parent))), default=None)
    if worst is None or worst.relative <= PARENT_TOLERANCE:
        return
    _forbid_transposed(watched.name, child, parent)
    size = f"{worst.quantity} differs by {worst.relative:.3g} of its size {worst.where}"
    rule = f"must have the numbers of {parent_class.__name__}, which it derives from"
    remedy = "say same_as_parent=False if it differs by design"
    text = f"{size}; its own: {', '.join(overrides)}"
    if same_as_parent is None and set(overrides) & set(STEPS):
        message = f"{watched.name}: {rule}, or say so; {text}; {remedy}"
        warnings.warn(message, UserWarning, stacklevel=4)
        return
    fail(f"{watched.name}.{overrides[0]}", rule, text, remedy)


def _with_weights(watched: WatchedPart, weights: FloatArray) -> WatchedPart:
    return WatchedPart(dataclasses.replace(watched.part, weights=weights)).unchecked()


def _forbid_transposed(name: str, child: WatchedPart, parent: WatchedPart) -> None:
    weights = getattr(parent.part, "weights", None)
    if not isinstance(weights, np.ndarray) or np.array_equal(weights, weights.T):
        return
    try:
        difference = largest_difference(child, _with_weights(parent, weights.T))
    except ScenarioError:  # columns that do not sum to 1 are no weights
        return
    if difference is not None and difference.relative <= PARENT_TOLERANCE:
        rule = "must give node i's weight for node l in entry [l, i]"
        remedy = "exchange rows and columns"
        fail(f"{name}.weights", rule, "the weights that node l gives to node i", remedy)


def largest_difference(child: WatchedPart, parent: WatchedPart) -> EstimateDifference | None:
    """Return the largest relative difference of two filters' estimates, or None."""
    found: list[EstimateDifference] = []
    # Where all nodes hear the same, weights of estimates show only if these differ at first.
    spread = 1.0 if isinstance(getattr(child.part, "weights", None), np.ndarray) else 0.0
    for system, kind in setups(child.part, parent.part):
        _, own = run(child, system, kind, spread=spread)
        try:
            _, other = run(parent, system, kind, spread=spread)
        except AssertionError:
            continue  # the parent requires more than the child, such as regular covariances
        if own.xhat.shape == other.xhat.shape:
            unit = "slot" if kind.slots else "round"
            found.append(_difference("xhat", own.xhat, other.xhat, unit))
            found.append(_difference("P", own.P, other.P, unit))
    return max(found, key=lambda one: one.relative, default=None)


def _difference(quantity: str, one: FloatArray, other: FloatArray, unit: str) -> EstimateDifference:
    """Return the largest difference of estimates (T, N, ...), 0 where they are nan."""
    rest = tuple(range(2, one.ndim))
    size = 1.0 + np.abs(one).max(axis=rest) + (np.abs(other).max(axis=rest) if one.ndim < 4 else 0)
    relative = np.nan_to_num(np.abs(one - other).max(axis=rest) / size)
    k, node = np.unravel_index(int(np.argmax(relative)), relative.shape)
    return EstimateDifference(
        float(relative[k, node]), quantity, f"at node {node} after {unit} {k}"
    )
