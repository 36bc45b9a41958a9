"""The steps of the exchanges in slots: when they are, and who is down then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.engines.compiled.life_tables import LifeTable
from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario


class StepTimes(NamedTuple):
    """Times in seconds of S slots from number ``first`` on, with E steps each.

    start : (S,), when the slots begin
    begin, end : (S, E), when the steps of their exchanges do, and when inboxes close
    exchanged, recorded : (S,) bool, whether nodes exchange, and whether events are recorded
    """

    first: int
    start: FloatArray
    begin: FloatArray
    end: FloatArray
    exchanged: np.ndarray
    recorded: np.ndarray

    def of_stage(self, setup: SlotSetup, stage: int) -> FloatArray:
        """Return (S,) when the readings are made that are a ``stage`` of the slots."""
        before = setup.stages.step[:stage].max(initial=-1)
        if before < 0:
            return self.start
        return np.where(self.exchanged, self.end[:, before], self.start)

    def of_reading(self, setup: SlotSetup) -> FloatArray:
        """Return (S,) when the first readings of the slots are made."""
        return self.of_stage(setup, int(np.argmax(setup.stages.step < 0)))


def step_times(scenario: Scenario, setup: SlotSetup, first: int, count: int) -> StepTimes:
    """Return the times of ``count`` slots."""
    slots = np.arange(first, first + count)
    start = scenario.slot_plant.slot_times(slots)
    # The ends of steps are counted from the start of the slot.
    end = scenario.time_grid.snap(start[:, None] + setup.stages.end[setup.stages.step >= 0])
    begin = np.concatenate([start[:, None], end[:, :-1]], axis=1)[:, : end.shape[1]]
    recorded, _, exchanged = setup.activity(slots)
    return StepTimes(first, start, begin, end, exchanged, recorded)


def absent(setup: SlotSetup, lives: LifeTable, times: StepTimes) -> np.ndarray:
    """Return (S, N) bool: nodes that are down when the others read."""
    return lives.is_down(np.arange(len(setup.nodes)), times.of_reading(setup)[:, None])


def slot_restarts(scenario: Scenario, lives: LifeTable) -> dict[int, list[int]]:
    """Return by slot the indices of the nodes that begin again when it begins."""
    found: dict[int, list[int]] = {}
    slots = scenario.slot_plant.slots_of(lives.t[lives.restarts])
    for slot, h in zip(slots.tolist(), lives.node[lives.restarts].tolist(), strict=True):
        found.setdefault(slot, []).append(h)
    return found
