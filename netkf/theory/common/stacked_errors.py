"""Errors of all estimates of a run in one stack, the roots of their P, and how time moves them.

An estimate is a node's, a copy of it under way, or what a node's will be once a reading has come;
names are any hashable values, a node's is its place. The state itself is kept where the errors
follow it, since the filters' A (or F) differs from the plant's.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.gaps import Drift, Flow, Gap, lower_root, state_over
from netkf.theory.numerics.moves import Seen, kalman
from netkf.theory.numerics.stack import Stack

STATE = "state"
Part = tuple[Hashable, FloatArray]


class Errors:
    """``roots`` has P of each estimate; ``owner`` the node whose increments it uses, None for an
    estimate under way, which is only predicted.
    """

    def __init__(self, scenario: Scenario, hosts: int) -> None:
        self.n, self.hosts = scenario.plant.n, hosts
        self.stack = Stack(self.n)
        self.roots: dict[Hashable, FloatArray] = {}
        self.owner: dict[Hashable, int | None] = {}
        first = square_root(np.asarray(scenario.plant.start_cov))
        columns = self.stack.inputs(first.shape[1])
        self._state(scenario, first, columns)
        for host, node in enumerate(scenario.nodes[:hosts]):
            self.stack.put(host, np.zeros((self.n, 0)))
            self.stack.add(host, columns, first)
            self.roots[host] = square_root(np.asarray(scenario.start(node)[1]))
            self.owner[host] = host

    def _state(self, scenario: Scenario, first: FloatArray, columns: slice) -> None:
        if scenario.slotted:
            differs = not np.array_equal(scenario.slot_belief[0], scenario.slot_plant.F)
        else:
            differs = not np.array_equal(scenario.belief[0], scenario.truth.A)
        self.follows = differs
        if differs:
            self.stack.put(STATE, np.zeros((self.n, 0)))
            self.stack.add(STATE, columns, first)

    def covariance(self) -> FloatArray:
        """(M n, M n) of the errors of the M hosts."""
        return self.stack.covariance(range(self.hosts))

    def covariances(self) -> FloatArray:
        """(M, n, n): P of the hosts."""
        S = np.stack([self.roots[host] for host in range(self.hosts)])
        return np.asarray(S @ np.swapaxes(S, 1, 2))

    def copy(self, name: Hashable, new: Hashable, owner: int | None) -> None:
        """A further estimate that starts as another one is."""
        self.stack.put(new, self.stack.form(name))
        self.roots[new], self.owner[new] = self.roots[name], owner

    def drop(self, names: Sequence[Hashable]) -> None:
        """Forget estimates."""
        self.stack.drop(names)
        for name in names:
            del self.roots[name], self.owner[name]

    def replace(self, name: Hashable, other: Hashable) -> None:
        """``name`` becomes ``other``, which keeps its owner."""
        self.stack.rename(name, other)
        self.roots[other] = self.roots.pop(name)
        del self.owner[name]

    def readings(self, seen: Mapping[int, Seen]) -> dict[int, slice]:
        """The inputs that are the noises of readings, by node; to be used before any other move."""
        ends = np.cumsum([0, *(len(one.H) for one in seen.values())]).tolist()
        columns = self.stack.inputs(ends[-1])
        begin = columns.start
        return {
            node: slice(begin + a, begin + b)
            for node, a, b in zip(seen, ends, ends[1:], strict=False)
        }

    def update(self, name: Hashable, seen: Seen, columns: slice) -> None:
        """Use a reading whose noise is ``seen.root`` times the inputs in ``columns``."""
        if not len(seen.H):
            return
        left, K, root = kalman(self.roots[name], seen)
        self.move(name, left, root)
        self.stack.add(name, columns, -K @ seen.root)

    def move(self, name: Hashable, matrix: FloatArray, root: FloatArray) -> None:
        """Multiply an error by a matrix."""
        self.stack.put(name, matrix @ self.stack.form(name))
        self.roots[name] = root

    def combine(self, changes: Mapping[Hashable, tuple[FloatArray, Sequence[Part]]]) -> None:
        """Give estimates new roots and errors ``sum W e`` of values from before, all at once."""
        forms = {
            name: np.asarray(sum(W @ self.stack.form(source) for source, W in parts))
            for name, (_, parts) in changes.items()
        }
        self.stack.put_all(forms)
        self.roots.update({name: root for name, (root, _) in changes.items()})

    def predict(self, gap: Gap) -> slice:
        """Move everything over a gap without increments; returns the inputs of the plant."""
        columns = self.stack.inputs(gap.error_noise.shape[1])
        names = list(self.roots)
        moved = gap.error @ self.stack.forms(names)
        if self.follows:
            x = self.stack.form(STATE)
            moved += gap.follow @ x
            self.stack.put(STATE, gap.state @ x)
            self.stack.add(STATE, columns, gap.state_noise)
        moved[:, :, columns] += gap.error_noise
        self.stack.put_all(dict(zip(names, moved, strict=True)))
        known: dict[int, FloatArray] = {}
        for name in names:  # copies share their roots, which are then moved once
            S = self.roots[name]
            if id(S) not in known:
                known[id(S)] = _predicted(S, gap)
        self.roots = {name: known[id(S)] for name, S in self.roots.items()}
        return columns


def _predicted(S: FloatArray, gap: Gap) -> FloatArray:
    whole = np.concatenate([gap.error @ S, gap.root], axis=1)
    return lower_root(whole)


class Increments(NamedTuple):
    """The flows of a run with increment sensors: of each host, and of what is under way."""

    hosts: list[Flow]
    blind: Flow
    plant: tuple[FloatArray, FloatArray]


class Clock:
    """Moves errors through continuous time."""

    def __init__(self, scenario: Scenario, errors: Errors) -> None:
        self._errors, self._now = errors, 0.0
        self._flows = _increments(scenario, errors.hosts)
        A, B = scenario.truth.A, scenario.truth.B
        A_f, Q_f = scenario.belief
        B_f = B if np.array_equal(B @ B.T, Q_f) else square_root(Q_f)
        self.drift = Drift(A, B, A_f, B_f)

    def advance(self, time: float) -> tuple[float, slice | None, FloatArray | None]:
        """To a time; the gap, and where there are no increments the plant's inputs over it and
        what they add to the state.
        """
        gap = time - self._now
        if gap <= 0.0:
            return 0.0, None, None
        self._now = time
        if self._flows is None:
            move = self.drift(gap)
            return gap, self._errors.predict(move), move.state_noise
        unit = min(flow.unit for flow in (*self._flows.hosts, self._flows.blind))
        steps = math.ceil(gap / unit)
        for _ in range(steps):
            self._step(gap / steps)
        return gap, None, None

    def _step(self, gap: float) -> None:
        flows, errors = self._flows, self._errors
        assert flows is not None
        groups: dict[int, tuple[Flow, list[Hashable]]] = {}
        for name, owner in errors.owner.items():
            flow = flows.blind if owner is None else flows.hosts[owner]
            groups.setdefault(id(flow), (flow, []))[1].append(name)
        n, common = errors.n, 8 * flows.plant[1].shape[1]
        columns = errors.stack.inputs(common + n * len(errors.roots))
        shared = slice(columns.start, columns.start + common)
        x = errors.stack.form(STATE) if errors.follows else None
        place = shared.stop
        for flow, names in groups.values():
            moved = flow.move(np.stack([errors.roots[name] for name in names]), gap)
            forms = moved.transition @ errors.stack.forms(names)
            if x is not None:
                forms += moved.follow @ x
            forms[:, :, shared] += moved.response
            for k, name in enumerate(names):
                # a version of a node's estimate has the increments of the node
                forms[k, :, place : place + moved.own.shape[2]] += moved.own[k]
                place += n
                errors.roots[name] = moved.root[k]
            errors.stack.put_all(dict(zip(names, forms, strict=True)))
        if x is not None:
            F, response = state_over(flows.plant, gap)
            errors.stack.put(STATE, F @ x)
            errors.stack.add(STATE, shared, response)


def _increments(scenario: Scenario, hosts: int) -> Increments | None:
    """None where all readings are samples."""
    from netkf.theory.common.observed import increments

    seen = increments(scenario)
    if not any(len(one.H) for one in seen):
        return None
    A, Q = scenario.belief
    plant = (scenario.truth.A, scenario.truth.B)
    B = plant[1] if np.array_equal(plant[1] @ plant[1].T, Q) else square_root(Q)
    made: dict[bytes, Flow] = {}

    def flow(one: Seen) -> Flow:
        key = b"|".join(part.tobytes() for part in one)
        if key not in made:
            made[key] = Flow(A, B, one.H, one.R, one.root, plant)
        return made[key]

    empty = np.zeros((0, 0))
    blind = flow(Seen(np.zeros((0, scenario.plant.n)), empty, empty))
    return Increments([flow(one) for one in seen[:hosts]], blind, plant)
