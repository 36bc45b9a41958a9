"""Trials of a filter in slots."""

from __future__ import annotations

from typing import Any

from netkf.algorithms.filter import Exchange, Message
from netkf.algorithms.models import SlotModel
from netkf.testing.trials import Trial

# Few, since every method is called for every node and step.
SLOTS, MAX_STEPS, MAX_WAIT = 5, 5, 20
SHIFTED = 3  # slots before the end: enough for every kind of message after the shift
PERIOD = 1.0


def slots_of(part: Any) -> int:
    """Return the number of slots of a trial: some with exchanges."""
    return min(int(part.first_slot), MAX_WAIT) + SLOTS


class SlotTrial(Trial):
    """The schedule for a few slots (``slots`` of them if it is not 0); everything is lost in the
    last one.
    """

    slots = 0

    def model(self, sees: bool) -> SlotModel:
        """Return the model of a node in slots of one second."""
        return SlotModel(self.system.M, self.system.Q, *self.matrices(sees), PERIOD)

    def run(self) -> None:
        """Carry out slot after slot, each from just before nodes exchange."""
        part, slots = self.part, self.slots or slots_of(self.part)
        for slot in range(slots):
            if part.predicts and slot == slots - SHIFTED:
                self.shift()
            self._run_slot(slot, lost=slot == slots - 1)
            if not part.predicts and slot == slots - SHIFTED:
                self.shift()
            self.end()

    def _run_slot(self, slot: int, lost: bool) -> None:
        """Carry out the phases of a slot, with all messages delivered or ``lost``."""
        part, phase = self.part, 0
        for kind in part.schedule:
            if kind == "exchange":
                if part.talks and slot >= part.first_slot:
                    for step in range(min(part.exchange_steps(phase), MAX_STEPS)):
                        self._exchange(Exchange(PERIOD * slot, phase, step, slot), lost)
                phase += 1
            elif slot > 0 or part.predicts:  # a filtered one starts from before any reading
                self._advance(kind, slot)

    def _advance(self, kind: str, slot: int) -> None:
        """Predict, or use readings; the truth moves on where the filter does."""
        part = self.part
        alone = kind == "sense" and "predict" not in part.schedule
        if kind == "predict" or (alone and not part.predicts):
            self.offset = self.system.M @ self.offset
        if kind == "predict":
            for node in self.nodes:
                self.step(node, "predict", PERIOD)
            return
        readings = [self.sample(node, PERIOD * slot) for node in self.nodes]
        if alone and part.predicts:
            self.offset = self.system.M @ self.offset
        for node, reading in zip(self.nodes, readings, strict=True):
            self.step(node, "update", reading)

    def _exchange(self, exchange: Exchange, lost: bool) -> None:
        """Carry out one step of an exchange, and check conserved sums."""
        before = self.sums()
        payloads = {node: self.emit(node, exchange) for node in self._talking_nodes(exchange.slot)}
        for node, senders in enumerate(self._choose_senders(exchange.slot)):
            inbox = [
                Message(k, float(self.weights[k, node]), payloads[k], 0.01 * (k + 1))
                for k in senders
                if not lost and payloads[k] is not None
            ]
            self.absorb(node, inbox, exchange)
        self.compare(before, "all" if lost else "none")

    def _choose_senders(self, slot: int) -> list[list[int]]:
        """Return the senders that each node hears: all others, or its partner in this slot."""
        if not self.part.pairwise:
            return [[k for k in self.nodes if k != node] for node in self.nodes]
        paired = self._talking_nodes(slot)
        return [[k for k in paired if k != n] if n in paired else [] for n in self.nodes]

    def _talking_nodes(self, slot: int) -> list[int]:
        """Return all nodes, or the pair of this slot."""
        count = len(self.nodes)
        if not self.part.pairwise:
            return list(self.nodes)
        return sorted({slot % count, (slot + 1) % count})
