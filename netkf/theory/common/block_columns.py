"""Exact errors of affine filters in plain Python, from their own verbs.

Given the events of a run, estimates of such a filter (``Analysis.affine``) are affine in the first
state and in all noises. Its verbs run once, on estimates and readings of C columns: their means,
and one for each noise. Nodes may estimate different blocks of the state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, cast

import numpy as np

from netkf.algorithms.filter import Exchange, Message, PairReading, Reading
from netkf.algorithms.models import ChangingFlowModel, ChangingSlotModel, SlotModel
from netkf.algorithms.translation import Common, state_before
from netkf.engines.simpy.nodes import View
from netkf.engines.simpy.slots import SlotSchedule, Stage
from netkf.linalg.arrays import FloatArray, block_diagonal, square_root
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import Step, arrivals_in_slots
from netkf.theory.common.columns import ErrorColumns, LoggedColumns
from netkf.theory.common.forms import MEAN, NOISE
from netkf.theory.common.kernel_columns import KernelColumns
from netkf.theory.common.observations import Observation, slot_observations, timed_observations
from netkf.trace.nees import without_padding
from netkf.trace.run import Run
from netkf.trace.schema import ABSORB, DELIVER, LATE, LOST, SEND, SENSE, TRANSMIT

SPARE = 1024
"""Columns beyond twice the number of states: more than any matrix of a filter has, so that an array
with as many columns as the true state is known to be one of columns.
"""
Link = tuple[int, int, int]
"""Sender and receiver (ids) of a message, and its number on their link."""


class ColumnModel:
    """The model of a node, which predicts estimates of several columns (n, C)."""

    def __init__(self, model: Any) -> None:
        self.moving = model

    def __getattr__(self, name: str) -> Any:
        """Return what does not depend on estimates."""
        return getattr(self.__dict__["moving"], name)

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (n, C) and the root (n, n) ``gap`` seconds later."""
        nothing = np.zeros(len(xhat))
        root = self.moving.predict(nothing, root, gap)[1]
        return self.moving.transition(nothing, gap) @ xhat, root

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (n, C) and the root (n, n) after ``age`` seconds, as in slots."""
        nothing = np.zeros(len(xhat))
        if age <= 0.0 or isinstance(self.moving, SlotModel):
            return xhat, root
        root = self.moving.extrapolate(nothing, root, age)[1]
        return self.moving.transition(nothing, age) @ xhat, root


class BlockColumns(ErrorColumns):
    """The errors of nodes that estimate blocks; ``_x`` (n, C) is the true state of all blocks."""

    def __init__(self, scenario: Scenario, run: Run) -> None:
        super().__init__()
        self._scenario, self._run, algorithm = scenario, run, scenario.node_filter
        self._filter: Any = algorithm if algorithm.kernels is None else KernelColumns(algorithm)
        self.estimators, self.n = len(scenario.nodes), scenario.width
        plant = cast(Any, scenario.plant)
        self._used: int = NOISE + plant.start_root.shape[1]
        self._x = np.zeros((plant.n, 2 * plant.n + SPARE))
        self._x[:, MEAN], self._x[:, NOISE : self._used] = plant.start_mean, plant.start_root
        self._views: list[View | None] = [None] * self.estimators
        for h, view in enumerate(scenario.model_views or ()):
            self._views[h] = View(view, scenario.layout.places, {})
        self._models = [ColumnModel(scenario.model_of(h)) for h in range(self.estimators)]
        self._states = [self._begin(h) for h in range(self.estimators)]
        # What is under way, by whatever names it.
        self._messages: dict[Any, Any] = {}

    def _begin(self, h: int) -> Any:
        mean, cov = self._scenario.initial_estimate(self._scenario.nodes[h])
        xhat = np.zeros((len(mean), self._x.shape[1]))
        xhat[:, MEAN] = mean
        return self._filter.init(self._models[h], xhat, cov, self._scenario.node_infos[h])

    def _inputs(self, count: int) -> int:
        if self._used + count > self._x.shape[1]:
            self._reduce(count)
        first, self._used = self._used, self._used + count
        return first

    def _reduce(self, count: int) -> None:
        """Turn columns of noises into as few as their rank allows, with room for ``count``."""
        width, used = self._x.shape[1], self._used
        held = self._x, self._states, self._messages, self._kept
        found: dict[int, FloatArray] = {}
        replace_columns(held, width, lambda array: found.setdefault(id(array), array))
        stack = np.concatenate([a.reshape(-1, width)[:, NOISE:used] for a in found.values()])
        if len(stack) < stack.shape[1]:
            # stack' = Q R, and stack Q = R' has the same products.
            stack = cast(FloatArray, np.linalg.qr(stack.T, mode="r")).T
        self._used = NOISE + stack.shape[1]
        new, first = {}, 0
        for key, array in found.items():
            rows = array.size // width
            whole = np.zeros((rows, 2 * self._used + count + SPARE))
            whole[:, MEAN] = array.reshape(-1, width)[:, MEAN]
            whole[:, NOISE : self._used] = stack[first : first + rows]
            new[key] = whole.reshape(*array.shape[:-1], whole.shape[1])
            first += rows
        held = replace_columns(held, width, lambda array: new[id(array)])
        self._x, self._states, self._messages, self._kept = held

    def _move(self, F: FloatArray, root: FloatArray, times: Sequence[float]) -> None:
        """Move the true state by F and a noise with ``root`` between two ``times``."""
        first = self._inputs(root.shape[1])
        self._x = F @ self._x
        self._x[:, first : self._used] = root
        if self._scenario.surprise is not None:
            before, after = self._scenario.surprise.states(np.array(times))
            self._x[:, MEAN] += after - F @ before

    def _update(self, h: int, readings: Sequence[Observation], time: float) -> None:
        first, view = self._inputs(sum(o.root.shape[1] for o in readings)), self._views[h]
        samples, pairs = list[Any](), list[Any]()
        for observation in readings:
            y, width = observation.H @ self._x, observation.root.shape[1]
            y[:, first : first + width] += observation.root
            first += width
            whole = [(y, *observation[:2])]
            parts = whole if view is None else view.readings(*whole[0])
            for part in parts:
                (pairs if isinstance(part, PairReading) else samples).append(part)
        n = len(self._x) if view is None else len(view.entries)
        y = np.concatenate([self._x[:0], *(y for y, *_ in samples)])
        H = np.concatenate([np.empty((0, n)), *(H for _, H, _ in samples)])
        reading = Reading(y, H, block_diagonal([R for *_, R in samples]), time, tuple(pairs))
        self._states[h] = self._filter.update(self._states[h], reading)

    def _emit(self, h: int, exchange: Exchange) -> Any:
        self._states[h], payload = self._filter.emit(self._states[h], exchange)
        return payload

    def _absorb(self, h: int, heard: Sequence[tuple[int, Any, float]], exchange: Exchange) -> None:
        """Let node number ``h`` absorb messages: sender (id), key among ``_messages``, age."""
        weight, node = self._scenario.weight, self._scenario.nodes[h]
        common, own = self._scenario.common_entries, None
        if common:
            own = self._filter.emit(self._states[h], exchange)[1]
        messages = []
        for sender, key, age in heard:
            payload = self._messages[key]
            if (entries := common.get((sender, node))) is not None:
                before = partial(state_before, self._models[h], age=age)
                translate = self._scenario.node_filter.needs.translate
                payload = translate(payload, own, Common(*entries, before))
            messages.append(Message(sender, weight(node, sender), payload, age))
        self._states[h] = self._filter.absorb(self._states[h], messages, exchange)

    def _forms(self) -> FloatArray:
        """Return the errors (M n, C): those of states that a node does not estimate are 0."""
        forms = np.zeros((self.estimators, self.n, self._x.shape[1]))
        for h, state in enumerate(self._states):
            x = self._x[self._scenario.view(h)]
            forms[h, : len(x)] = x - self._filter.estimate(state)[0][: len(x)]
        return forms.reshape(-1, self._x.shape[1])

    def covariances(self) -> FloatArray:
        """Return P (M, n, n), with the variance 1 of states that a node does not estimate."""
        P = np.full((self.estimators, self.n, self.n), np.nan)
        for h, state in enumerate(self._states):
            n = int(self._scenario.sizes[h])
            P[h, :n, :n] = cast(FloatArray, self._filter.estimate(state)[1])[:n, :n]
        return without_padding(np.diagonal(P, axis1=1, axis2=2), P)[1]


class SlotBlocks(BlockColumns):
    """The errors of such a filter in slots."""

    def __init__(self, scenario: Scenario, run: Run) -> None:
        super().__init__(scenario, run)
        self._laws = [(piece.F, square_root(piece.Q)) for piece in scenario.linear_plant.pieces]
        self._observe = slot_observations(scenario, run, _apart)
        # By slot, phase and step what each receiver heard: sender (twice) and age.
        self._arrivals: dict[Step, dict[int, list[tuple[int, int, float]]]] = {}
        for step, sender, receiver, _, age in arrivals_in_slots(scenario, run):
            heard = self._arrivals.setdefault(step, {}).setdefault(receiver, [])
            heard.append((sender, sender, age))
        links = scenario.topology.links if scenario.node_filter.timing.talks else ()
        self._talking = sorted({node for link in links for node in link})

    def replay(self) -> Iterator[None]:
        """Follow the stages of slots; yield at each of ``run.times``."""
        scenario, schedule, slot = self._scenario, SlotSchedule(self._scenario), 0
        predicts = scenario.node_filter.timing.predicts
        for until in scenario.slot_plant.slots_of(self._run.times).tolist():
            # A filtered estimate is sampled after its slot, a prediction before.
            while slot < until + (not predicts):
                for stage in schedule.stages(slot):
                    self._perform(stage, slot, slot - (not predicts))
                slot += 1
            yield

    def _perform(self, stage: Stage, slot: int, start: int) -> None:
        """Go through a stage of a slot, whose prediction begins in the slot ``start``."""
        scenario, exchange = self._scenario, Exchange(stage.time, stage.phase, stage.step, slot)
        if stage.kind == "predict":
            piece = sum(change <= start for change in scenario.slot_plant.change_slots)
            self._move(*self._laws[piece], (start, start + 1))
            for h, model in enumerate(self._models):
                if isinstance(model.moving, ChangingSlotModel):
                    model.moving.move_to(start)
                period = scenario.slot_plant.period
                self._states[h] = self._filter.predict(self._states[h], period)
        elif stage.kind == "update":
            observations = self._observe(slot)
            for h in range(self.estimators):
                self._update(h, observations.get(h, []), stage.time)
        elif stage.kind == "send":
            index = scenario.topology.index
            self._messages = {node: self._emit(index[node], exchange) for node in self._talking}
        elif stage.kind == "absorb":
            heard = self._arrivals.get((slot, stage.phase, stage.step), {})
            for h, node in enumerate(scenario.nodes):
                self._absorb(h, sorted(heard.get(node, [])), exchange)


class ClockBlocks(BlockColumns, LoggedColumns):
    """The errors of such a filter under clocks, along the log of a run."""

    def __init__(self, scenario: Scenario, run: Run) -> None:
        super().__init__(scenario, run)
        self._samples = timed_observations(scenario, Streams(run.seed, run.replica), _apart)
        self._now, self._times = 0.0, [0.0] * self.estimators
        plant = cast(Any, scenario.plant)
        self._changes = plant.changes[plant.changes < scenario.horizon].tolist()
        self._begin_piece(0)
        names = ("t", "kind", "node", "peer", "message", "age")
        self._log = list(zip(*(run.log[name].tolist() for name in names), strict=True))
        self._receivers: dict[tuple[float, int], tuple[int, ...]] = {}
        for t, kind, node, peer, *_ in self._log:
            if kind == SEND:
                self._receivers[t, node] = (*self._receivers.get((t, node), ()), peer)
        self._inboxes: dict[int, list[tuple[int, Link, float]]] = {}
        clock = cast(Any, scenario.network.activation)
        self._shared = clock is not None and clock.at in ("nodes", "readings")

    def _begin_piece(self, piece: int) -> None:
        self._lay_laws(piece)
        for model in self._models:
            if isinstance(model.moving, ChangingFlowModel) and piece < len(model.moving.pieces):
                model.moving.begin(piece)

    def _move_all(self, time: float) -> None:
        self._move_truth(time)
        for h in range(self.estimators):
            self._predict(h, time)

    def _move_truth(self, time: float) -> None:
        gap = time - self._now
        if gap > 0.0:
            self._move(*self._law(gap), (self._now, time))
            self._now = time

    def _predict(self, h: int, time: float) -> None:
        gap, self._times[h] = time - self._times[h], time
        if isinstance(self._models[h].moving, ChangingFlowModel):
            self._models[h].moving.move_to(time)
        if gap > 0.0:
            self._states[h] = self._filter.predict(self._states[h], gap)

    def _apply(
        self, time: float, kind: int, node: int, peer: int, message: int, age: float
    ) -> None:
        h, inboxes = self._scenario.topology.index.get(node, -1), self._inboxes
        if kind == SENSE:
            self._move_truth(time)
            self._predict(h, time)
            self._update(h, self._samples.get(time, {}).get(h, []), time)
        elif kind == TRANSMIT and self._shared:
            self._messages[node] = self._emit_now(h, time, self._receivers.get((time, node), ()))
        elif kind == SEND:
            payload = self._messages[node] if self._shared else self._emit_now(h, time, (peer,))
            self._messages[node, peer, message] = payload
        elif kind in (LOST, LATE):
            sender, receiver = (node, peer) if kind == LOST else (peer, node)
            self._messages.pop((sender, receiver, message), None)
        elif kind == DELIVER:
            inboxes.setdefault(node, []).append((peer, (peer, node, message), age))
        elif kind == ABSORB:
            self._predict(h, time)
            arrived = sorted(inboxes.pop(node, []), key=lambda m: (m[0], -m[2], m[1]))
            heard = arrived
            if self._filter.timing.newest_only:
                heard = list({message[0]: message for message in arrived}.values())
            self._absorb(h, heard, Exchange(time=time))
            for _, key, _ in arrived:
                del self._messages[key]

    def _emit_now(self, h: int, time: float, receivers: tuple[int, ...]) -> Any:
        self._predict(h, time)
        return self._emit(h, Exchange(time=time, receivers=receivers))


def _apart(readings: list[Observation], _: int) -> list[Observation]:
    """Return readings of several sensors as they are: each may be of another block."""
    return readings


def replace_columns(value: Any, width: int, replace: Callable[[FloatArray], FloatArray]) -> Any:
    """Return a value in which every array (.., ``width``) inside of it has been replaced."""
    if isinstance(value, np.ndarray):
        return replace(value) if value.ndim and value.shape[-1] == width else value
    if isinstance(value, dict):
        return {key: replace_columns(one, width, replace) for key, one in value.items()}
    if isinstance(value, list | tuple):
        parts = [replace_columns(one, width, replace) for one in value]
        if isinstance(value, list):
            return parts
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value
