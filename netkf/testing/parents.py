"""Run a filter beside the built-in class that it derives from, and compare their numbers."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import NamedTuple

from netkf.algorithms.filter import STEPS
from netkf.algorithms.registry import base_filter, built_in_class, own_attributes
from netkf.testing.clocked import ClockTrial
from netkf.testing.shifts import differences
from netkf.testing.slotted import SlotTrial, slots_of
from netkf.testing.systems import System, systems
from netkf.testing.trials import Trial
from netkf.testing.watching import Watched, demand

TOLERANCE = 1e-6
"""Differences in units of the size of an estimate that count as another order of operations."""


class Difference(NamedTuple):
    """The largest difference from the parent: relative to the size of ``what``, and where."""

    apart: float
    what: str
    where: str


def check_parent(watched: Watched, same_as_parent: bool | None) -> None:
    """Compare a class with the built-in one that it derives from, with the same settings, on the
    same readings and messages, in slots and under the clocks that both know.

    Raises AssertionError if numbers differ, unless ``same_as_parent`` is False; if it is None,
    classes that define one of the methods STEPS warn instead.
    """
    part = watched.part
    known = built_in_class(part)
    own = own_attributes(part)
    if same_as_parent is False or known is None or not own:
        return
    found = largest_difference(watched.once(), Watched(base_filter(part)).once())
    if found is None or found.apart <= TOLERANCE:
        return
    size = f"{found.what} differs by {found.apart:.3g} of its size {found.where}"
    listed = ", ".join(own)
    rule = f"must have the numbers of {known.__name__}, which it derives from"
    remedy = "say same_as_parent=False if it differs by design"
    text = f"{size}; its own: {listed}"
    if same_as_parent is None and set(own) & set(STEPS):
        message = f"{watched.name}: {rule}, or say so; {text}; {remedy}"
        warnings.warn(message, UserWarning, stacklevel=4)
        return
    demand(False, f"{watched.name}.{own[0]}", rule, text, remedy)


def largest_difference(own: Watched, parent: Watched) -> Difference | None:
    """Return the largest difference at the end of any slot or round; None if they have no kind of
    time in common.
    """
    worst: Difference | None = None
    for one, other, kind in _pairs(own, parent):
        one.run()
        try:
            other.run()
        except AssertionError:
            continue  # the parent asks for more than its heir, such as regular covariances
        for k, (mine, theirs) in enumerate(zip(one.ends, other.ends, strict=False)):
            for node in mine.keys() & theirs.keys():
                for what, apart, size in differences(mine[node], theirs[node]):
                    found = Difference(apart / size, what, f"at node {node} after {kind} {k}")
                    worst = found if worst is None or found.apart > worst.apart else worst
    return worst


def _pairs(own: Watched, parent: Watched) -> Iterator[tuple[Trial, Trial, str]]:
    """Yield trials of both classes on the same systems, with the same readings and messages."""
    mine, theirs = own.part, parent.part
    slots = None
    if mine.schedule is not None and theirs.schedule is not None:
        slots = max(slots_of(mine), slots_of(theirs))
    clocks: list[str | None] = [clock for clock in mine.clocks if clock in theirs.clocks]
    clocks = clocks if mine.talks or theirs.talks else [None]
    drawn = systems(mine.inverts or theirs.inverts)
    for system in drawn:
        if slots is not None:
            pair = SlotTrial(own, system), SlotTrial(parent, system)
            for trial in pair:
                trial.slots = slots
            if len(pair[0].nodes) == len(pair[1].nodes):
                yield *pair, "slot"
        # What depends on the system shows under one clock as under another.
        for clock in clocks if system is drawn[-1] else clocks[:1]:
            yield from _clocked_pairs(own, parent, system, clock)


def _clocked_pairs(
    own: Watched, parent: Watched, system: System, clock: str | None
) -> Iterator[tuple[Trial, Trial, str]]:
    """Yield trials of a class and of its parent under clocks, with the unit of their comparison."""
    increments = not (own.part.needs_samples or parent.part.needs_samples or clock == "readings")
    for with_increments in (False, True) if increments else (False,):
        pair = tuple(ClockTrial(w, system, None, clock, with_increments) for w in (own, parent))
        if len(pair[0].nodes) == len(pair[1].nodes):
            yield pair[0], pair[1], "round"
