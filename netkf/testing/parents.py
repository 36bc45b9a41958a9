"""Comparison of a user's filter with the built-in class that it derives from."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from netkf.algorithms.filter import STEPS
from netkf.algorithms.registry import base_filter, built_in_class, own_attributes
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.testing.clocked import ClockTrial
from netkf.testing.shifts import estimate_differences
from netkf.testing.slotted import SlotTrial, trial_slots
from netkf.testing.systems import System, make_systems
from netkf.testing.trials import Trial
from netkf.testing.watching import WatchedPart, fail

TOLERANCE = 1e-6
"""Largest relative difference that another order of operations may cause."""
UNEQUAL = np.array([[0.5, 0.3, 0.2], [0.2, 0.5, 0.3], [0.3, 0.2, 0.5]])
"""Weights of three nodes whose rows and columns sum to 1, and are not the same."""


class Difference(NamedTuple):
    """A difference of estimates from those of the parent.

    relative : difference divided by the size of the quantity
    quantity : "xhat" or "P"
    where    : node and time, as text
    """

    relative: float
    quantity: str
    where: str


def check_parent(watched: WatchedPart, same_as_parent: bool | None) -> None:
    """Compare the estimates of a filter with those of the built-in class that it derives from.

    Both run with the same settings, readings and messages, in slots and under the clocks that both
    support. Nothing is compared if the class overrides nothing or ``same_as_parent`` is False.

    Raises AssertionError if estimates differ by more than TOLERANCE; with ``same_as_parent`` None,
    a class that defines one of the methods STEPS gets a UserWarning instead.
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
    if worst is None or worst.relative <= TOLERANCE:
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
    changed = dataclasses.replace(watched.part, weights=weights)
    return WatchedPart(changed).unchecked()


def _forbid_transposed(name: str, child: WatchedPart, parent: WatchedPart) -> None:
    weights = getattr(parent.part, "weights", None)
    if not isinstance(weights, np.ndarray) or np.array_equal(weights, weights.T):
        return
    try:
        difference = largest_difference(child, _with_weights(parent, weights.T))
    except ScenarioError:  # columns that do not sum to 1 are no weights
        return
    if difference is not None and difference.relative <= TOLERANCE:
        rule = "must give node i's weight for node l in entry [l, i]"
        remedy = "exchange rows and columns"
        fail(f"{name}.weights", rule, "the weights that node l gives to node i", remedy)


def largest_difference(child: WatchedPart, parent: WatchedPart) -> Difference | None:
    """Return the largest relative difference of the estimates of two filters at the end of any slot
    or round; None if they cannot run in the same kind of time.
    """
    worst: Difference | None = None
    for child_trial, parent_trial, unit in _trial_pairs(child, parent):
        child_trial.run()
        try:
            parent_trial.run()
        except AssertionError:
            continue  # the parent requires more than the child, such as regular covariances
        ends = zip(child_trial.ends, parent_trial.ends, strict=False)
        for k, (child_end, parent_end) in enumerate(ends):
            for node in child_end.keys() & parent_end.keys():
                where = f"at node {node} after {unit} {k}"
                quantities = estimate_differences(child_end[node], parent_end[node])
                for quantity, difference, size in quantities:
                    relative = difference / size
                    if worst is None or relative > worst.relative:
                        worst = Difference(relative, quantity, where)
    return worst


def _trial_pairs(child: WatchedPart, parent: WatchedPart) -> Iterator[tuple[Trial, Trial, str]]:
    parts = child.part, parent.part
    slots = None
    if all(part.timing.schedule is not None for part in parts):
        slots = max(map(trial_slots, parts))
    clocks: list[str | None] = [None]
    if any(part.timing.talks for part in parts):
        clocks = [clock for clock in child.part.timing.clocks if clock in parent.part.timing.clocks]
    systems = make_systems(any(part.needs.inverts for part in parts))
    if isinstance(getattr(child.part, "weights", None), np.ndarray):
        systems = [system._replace(spread=1.0) for system in systems]
    for system in systems:
        if slots is not None:
            pair = SlotTrial(child, system), SlotTrial(parent, system)
            for trial in pair:
                trial.slots = slots
            if len(pair[0].nodes) == len(pair[1].nodes):
                yield *pair, "slot"
        # All clocks on one system only: a fault that depends on the system shows under any clock.
        for clock in clocks if system is systems[-1] else clocks[:1]:
            yield from _clock_trial_pairs(child, parent, system, clock)


def _clock_trial_pairs(
    child: WatchedPart, parent: WatchedPart, system: System, clock: str | None
) -> Iterator[tuple[Trial, Trial, str]]:
    # The clock "readings" ticks when a node has taken a sample.
    needs_samples = child.part.needs.samples or parent.part.needs.samples or clock == "readings"
    for increments in (False,) if needs_samples else (False, True):
        first, second = (
            ClockTrial(watched, system, shift=None, clock=clock, increments=increments)
            for watched in (child, parent)
        )
        if len(first.nodes) == len(second.nodes):
            yield first, second, "round"
