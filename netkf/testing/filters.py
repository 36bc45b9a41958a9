"""``check_filter``: checks of a filter against its contract, in slots and in continuous time."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, commutes
from netkf.algorithms.traits import Needs, Timing, Weights
from netkf.linalg.arrays import FloatArray
from netkf.testing.kernels import check_kernels
from netkf.testing.observed import Seen
from netkf.testing.parents import check_parent
from netkf.testing.small_runs import run, setups
from netkf.testing.watching import WatchedPart, checker, demand_kind, is_number, make_part

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
    _check_values(watched)
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


def _check_values(watched: WatchedPart) -> None:
    part, demand = watched.part, watched.demand
    _check_flags(watched, "needs", part.needs, Needs)
    _check_flags(watched, "timing", part.timing, Timing)
    clocks = part.timing.clocks
    can_run = bool(clocks) or part.timing.schedule is not None or not part.timing.talks
    rule = "must name a clock where schedule is None: the filter could not run at all"
    demand("timing.clocks", can_run, rule, clocks)


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
