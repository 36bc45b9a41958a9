"""Run all trials of a filter, and check that it commutes with a shift of the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from netkf.algorithms.adapters import SlotAdapter
from netkf.linalg.arrays import FloatArray
from netkf.testing.clocked import ClockTrial
from netkf.testing.slotted import SlotTrial
from netkf.testing.systems import systems
from netkf.testing.trials import CheckedEstimate, Trial
from netkf.testing.watching import Watched, demand

# Large beside the estimates, so that an error of one percent shows.
SHIFT = np.array([7.0, -11.0, 5.0])
ROUNDING = 1e-9  # relative to the estimates before they are moved back


def all_trials(watched: Watched, shift: FloatArray | None = None) -> Iterator[Trial]:
    """Yield a trial of every kind that the class supports, on every system."""
    part = watched.part
    drawn = systems(part.inverts)
    clocks: list[str | None] = list(part.clocks) if part.talks else [None]
    if isinstance(part, SlotAdapter):
        clocks = []
    for system in drawn:
        moved = None if shift is None else shift[: len(system.M)]
        if part.schedule is not None:
            yield SlotTrial(watched, system, moved)
        for clock in clocks:
            # What depends on the system shows under one clock as under another.
            if clock == clocks[0] or system is drawn[-1]:
                yield from ClockTrial.each_reading(watched, system, moved, clock)


def check_shift(watched: Watched, plain: Sequence[Trial]) -> None:
    """Run everything again with a truth that is shifted on the way: estimates must be shifted like
    it from those of the ``plain`` runs, covariances stay what they are.
    """
    for before, shifted in zip(plain, all_trials(watched.once(), SHIFT), strict=True):
        shifted.run()
        _compare(watched, before, shifted)


def _compare(watched: Watched, plain: Trial, shifted: Trial) -> None:
    """Check that all estimates of two trials are equal, one of which was shifted."""
    # The shift itself shows each node once more.
    moved = [estimate for estimate in shifted.estimates if estimate.after != "shift"]
    for one, other in zip(plain.estimates, moved, strict=True):
        for name, apart, size in differences(one, other):
            demand(
                apart <= ROUNDING * size,
                f"{watched.name}.shift",
                "a class that defines shift must commute with a shift of the truth",
                f"{name} of node {one.node} after {one.after} that differs by {apart:.3g} "
                "once truth, states and payloads are shifted",
                "correct shift or shift_payload, or define neither of them",
            )


def differences(one: CheckedEstimate, other: CheckedEstimate) -> list[tuple[str, float, float]]:
    """Return for xhat and P by how much two estimates differ, and the size of their entries."""
    found = [("xhat", _largest_difference(one.xhat, other.xhat), 1.0 + one.size + other.size)]
    if one.P is not None and other.P is not None:
        found.append(("P", _largest_difference(one.P, other.P), 1.0 + float(np.abs(one.P).max())))
    return found


def _largest_difference(one: FloatArray, other: FloatArray) -> float:
    """Return the largest difference of two arrays."""
    return float(np.abs(one - other).max())
