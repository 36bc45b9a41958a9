"""Whether a filter in slots keeps its contract."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.algorithms.slot import Reading, Role, SlotModel
from netkf.core.streams import Streams
from netkf.testing.filters import System, check_estimate, check_state_pickles, systems
from netkf.testing.watching import Watched, demand

SLOTS, MOST_STEPS, NODES = 4, 5, 3
CONSERVED = 1e-9


def check_slot_filter(watched: Watched) -> None:
    """Its programme for a few slots on every system; see check_filter."""
    _programme(watched)
    for system in systems(watched.part.inverts):
        _Trial(watched, system).run()


def _programme(watched: Watched) -> None:
    part = watched.part
    known = isinstance(part.programme, tuple) and set(part.programme) <= {"exchange", "sense"}
    rule = 'must be a tuple of "exchange" and "sense" with one "sense"'
    demand(
        known and part.programme.count("sense") == 1,
        f"{watched.name}.programme",
        rule,
        part.programme,
    )
    for phase in range(part.programme.count("exchange")):
        steps = watched.call("steps", phase)
        whole = isinstance(steps, int) and steps >= 1
        demand(whole, f"{watched.name}.steps", "must be a whole number of at least 1", steps)
        demand(
            watched.call("redraws", phase, 0) is True,
            f"{watched.name}.redraws",
            "must be True in step 0",
            part.redraws(phase, 0),
            "links have no earlier fate",
        )


class _Trial:
    """Nodes in a triangle (or as many as ``pair_weights`` asks for), the second of them blind."""

    def __init__(self, watched: Watched, system: System) -> None:
        self._watched, self._part = watched, watched.part
        self._random = Streams(0).generator("testing")
        given = self._part.pair_weights
        count = NODES if given is None else len(given)
        self._n, self._nodes = len(system.M), range(count)
        self._models = [_model(system, sees=node != 1) for node in self._nodes]
        information = np.sum([model.information for model in self._models], axis=0)
        self._own, self._weights = _weights(self._part, count)
        self._states: list[Any] = []
        for node, model in enumerate(self._models):
            state = watched.call("init", model, system.mean, system.cov)
            check_estimate(watched, state, self._n, "init")
            role = Role(node, count - 1, count, information, self._own[node])
            self._states.append(watched.call("place", state, role))
            check_estimate(watched, self._states[-1], self._n, "place")
        check_state_pickles(watched, self._states[0])

    def run(self) -> None:
        """The programme, slot after slot; everything is lost in the last one."""
        part = self._part
        for slot in range(SLOTS):
            phase = 0
            for kind in part.programme:
                if kind == "sense":
                    if slot > 0 or part.predicts:
                        self._sense()
                    continue
                if part.talks and slot >= part.first_slot:
                    for _ in range(min(part.steps(phase), MOST_STEPS)):
                        self._exchange(phase, slot, lost=slot == SLOTS - 1)
                phase += 1

    def _sense(self) -> None:
        for node, model in enumerate(self._models):
            y = self._random.normal(size=len(model.H))
            reading = Reading(y, model.H, model.R)
            self._states[node] = self._watched.call("sense", self._states[node], reading)
            if self._part.programme[-1] == "sense":  # else the slot is not over
                check_estimate(self._watched, self._states[node], self._n, "sense")

    def _exchange(self, phase: int, slot: int, lost: bool) -> None:
        payloads = [self._watched.call("emit", state, phase) for state in self._states]
        before = self._conserved()
        for node, senders in enumerate(self._senders(slot)):
            inbox = [
                (self._weights[sender, node], payloads[sender], 0.01 * (sender + 1))
                for sender in senders
                if not lost and payloads[sender] is not None
            ]
            if inbox or not self._part.pairwise or lost:
                state = self._watched.call("absorb", self._states[node], phase, inbox)
                self._states[node] = state
            stopped = self._watched.call("stopped", self._states[node])
            demand(
                stopped is True or stopped is False,
                f"{self._watched.name}.stopped",
                "must be True or False",
                stopped,
            )
            check_estimate(self._watched, self._states[node], self._n, "absorb")
        self._compare(before, self._conserved(), "none" if not lost else "all")

    def _senders(self, slot: int) -> list[list[int]]:
        """Everybody hears everybody, or pairs that change from slot to slot."""
        if not self._part.pairwise:
            return [[k for k in self._nodes if k != node] for node in self._nodes]
        left_out = slot % len(self._nodes)
        one, other, *_ = [k for k in self._nodes if k != left_out]
        return [[other] if k == one else [one] if k == other else [] for k in self._nodes]

    def _conserved(self) -> dict[str, float]:
        where = f"{self._watched.name}.conserved"
        parts = [self._watched.call("conserved", state) for state in self._states]
        alike = all(isinstance(p, dict) and p.keys() == parts[0].keys() for p in parts)
        demand(alike, where, "must name the same quantities at every node", parts[0])
        return {name: math.fsum(part[name] for part in parts) for name in parts[0]}

    def _compare(self, before: dict[str, float], after: dict[str, float], lost: str) -> None:
        for name, total in before.items():
            off = abs(after[name] - total)
            demand(
                off <= CONSERVED * max(abs(total), 1.0),
                f"{self._watched.name}.conserved",
                f"the sum of {name} over all nodes must survive an exchange with {lost} lost",
                f"{total:.6g} before and {after[name]:.6g} after",
                "let absorb give to one node what it takes from another",
            )


def _model(system: System, sees: bool) -> SlotModel:
    H, R = (system.H, system.R) if sees else (system.H[:0], system.R[:0, :0])
    return SlotModel(system.M, system.Q, H, R)


def _weights(part: Any, count: int) -> tuple[list[float], Any]:
    """What is left to each node, and [l, i], what node i gives to what l sends."""
    given = part.pair_weights
    links = count - 1
    if given is None:
        given = np.full((count, count), part.weight(links, links))
    others = given * (1.0 - np.eye(count))
    return [max(0.0, 1.0 - float(total)) for total in others.sum(axis=0)], others
