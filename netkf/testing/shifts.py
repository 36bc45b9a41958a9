"""All trials of a filter, and the check that it commutes with a shift of the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.testing.clocked import ClockTrial
from netkf.testing.slotted import SlotTrial
from netkf.testing.systems import make_systems
from netkf.testing.trials import CheckedEstimate, Trial
from netkf.testing.watching import WatchedPart, demand

# Large compared with the estimates, so that an error of one percent shows.
SHIFT = np.array([7.0, -11.0, 5.0])
TOLERANCE = 1e-9  # relative to the estimates before the shift is subtracted


def make_trials(watched: WatchedPart, shift: FloatArray | None = None) -> Iterator[Trial]:
    """Yield the trials of a filter, each a short run of a few connected nodes on one small random
    system: in slots and under each kind of clock, as far as the filter supports them.

    In each trial of a system of n states the truth is shifted by the first n components of
    ``shift`` (k,), unless that is None.
    """
    part = watched.part
    systems = make_systems(part.needs.inverts)
    clocks: list[str | None] = list(part.timing.clocks) if part.timing.talks else [None]
    for system in systems:
        system_shift = None if shift is None else shift[: len(system.M)]
        if part.timing.schedule is not None:
            yield SlotTrial(watched, system, system_shift)
        for clock in clocks:
            # All clocks on one system only: a fault that depends on it shows under any clock.
            if clock == clocks[0] or system is systems[-1]:
                yield from ClockTrial.make_per_sensor_kind(watched, system, system_shift, clock)


def check_shift(watched: WatchedPart, trials: Sequence[Trial]) -> None:
    """Check that a filter commutes with a shift of the truth, on which simulations of growing
    states rely: they move the truth back to 0 from time to time, and all estimates with it.

    Each of the ``trials``, which have run, is repeated with a truth that is shifted on the way:
    estimates must be shifted like the truth, and covariances must be the same.
    """
    for trial, shifted in zip(trials, make_trials(watched.unchecked(), SHIFT), strict=True):
        shifted.run()
        _compare_trials(watched, trial, shifted)


def _compare_trials(watched: WatchedPart, trial: Trial, shifted: Trial) -> None:
    # The shift itself adds an estimate of each node.
    others = [estimate for estimate in shifted.estimates if estimate.after != "shift"]
    for one, other in zip(trial.estimates, others, strict=True):
        for name, difference, size in estimate_differences(one, other):
            demand(
                difference <= TOLERANCE * size,
                f"{watched.name}.shift",
                "a class that defines shift must commute with a shift of the truth",
                f"{name} of node {one.node} after {one.after} that differs by {difference:.3g} "
                "once truth, states and payloads are shifted",
                "correct shift, of states and of payloads, or do not define it",
            )


def estimate_differences(
    one: CheckedEstimate, other: CheckedEstimate
) -> list[tuple[str, float, float]]:
    """Return ("xhat" or "P", largest difference of the entries, size of the entries) for each of
    them that both estimates have.
    """
    differences = [("xhat", _largest_difference(one.xhat, other.xhat), 1.0 + one.size + other.size)]
    if one.P is not None and other.P is not None:
        size = 1.0 + float(np.abs(one.P).max())
        differences.append(("P", _largest_difference(one.P, other.P), size))
    return differences


def _largest_difference(one: FloatArray, other: FloatArray) -> float:
    return float(np.abs(one - other).max())
