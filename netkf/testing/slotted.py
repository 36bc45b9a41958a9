"""Trials of a filter in slots."""

from __future__ import annotations

from typing import Any

from netkf.algorithms.filter import Exchange, Message
from netkf.algorithms.models import SlotModel
from netkf.testing.trials import Trial

# Slots with exchanges, steps of an exchange and slots before the first one at most: few, because
# every method is called for every node and step.
SLOTS, MAX_STEPS, MAX_FIRST_SLOT = 5, 5, 20
SLOTS_AFTER_SHIFT = 3  # enough for every kind of message after the shift
PERIOD = 1.0  # seconds of a slot


def trial_slots(part: Any) -> int:
    """Return the number of slots of a trial: SLOTS from the first one with exchanges on."""
    return min(int(part.timing.first_exchange), MAX_FIRST_SLOT) + SLOTS


class SlotTrial(Trial):
    """A trial of a few slots; in the last one all messages are lost.

    ``slots`` is the number of slots; 0: that of :func:`trial_slots`.
    """

    slots = 0

    def model(self, has_sensor: bool) -> SlotModel:
        """Return the model of a node in slots of PERIOD seconds: F and Q (n, n), H (p, n) and R
        (p, p), with p = 0 unless it ``has_sensor``.
        """
        return SlotModel(self.system.M, self.system.Q, *self.matrices(has_sensor), PERIOD)

    def run(self) -> None:
        """Run the phases of the filter's schedule in all slots; the truth, and with it all states,
        is shifted near the end: before the slot for filters that predict, whose estimates are of
        its start, else after it.
        """
        part, slots = self.part, self.slots or trial_slots(self.part)
        for slot in range(slots):
            if part.timing.predicts and slot == slots - SLOTS_AFTER_SHIFT:
                self.shift_truth()
            self._run_slot(slot, lost=slot == slots - 1)
            if not part.timing.predicts and slot == slots - SLOTS_AFTER_SHIFT:
                self.shift_truth()
            self.record_end()

    def _run_slot(self, slot: int, lost: bool) -> None:
        part, phase = self.part, 0
        for kind in part.timing.schedule:
            if kind == "exchange":
                if part.timing.talks and slot >= part.timing.first_exchange:
                    for step in range(min(part.timing.steps(phase), MAX_STEPS)):
                        self._exchange(Exchange(PERIOD * slot, phase, step, slot), lost)
                phase += 1
            elif (
                slot > 0 or part.timing.predicts
            ):  # else the first estimate is that before any reading
                self._advance(kind, slot)

    def _advance(self, kind: str, slot: int) -> None:
        part = self.part
        update_predicts = kind == "sense" and "predict" not in part.timing.schedule
        if kind == "predict" or (update_predicts and not part.timing.predicts):
            self.offset = self.system.M @ self.offset
        if kind == "predict":
            for node in self.nodes:
                self.step(node, "predict", PERIOD)
            return
        readings = [self.sample(node, PERIOD * slot) for node in self.nodes]
        if update_predicts and part.timing.predicts:
            self.offset = self.system.M @ self.offset
        for node, reading in zip(self.nodes, readings, strict=True):
            self.step(node, "update", reading)

    def _exchange(self, exchange: Exchange, lost: bool) -> None:
        before = self.conserved_sums()
        payloads = {node: self.emit(node, exchange) for node in self._talking_nodes(exchange.slot)}
        for node, senders in enumerate(self._choose_senders(exchange.slot)):
            # Ages of 0.01, 0.02, ... seconds: different for each sender.
            inbox = [
                Message(k, float(self.weights[k, node]), payloads[k], 0.01 * (k + 1))
                for k in senders
                if not lost and payloads[k] is not None
            ]
            self.absorb(node, inbox, exchange)
        self.check_conserved(before, "all" if lost else "none")

    def _choose_senders(self, slot: int) -> list[list[int]]:
        if not self.part.timing.pairwise:
            return [[k for k in self.nodes if k != node] for node in self.nodes]
        pair = self._talking_nodes(slot)
        return [[k for k in pair if k != node] if node in pair else [] for node in self.nodes]

    def _talking_nodes(self, slot: int) -> list[int]:
        count = len(self.nodes)
        if not self.part.timing.pairwise:
            return list(self.nodes)
        return sorted({slot % count, (slot + 1) % count})
