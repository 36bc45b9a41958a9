"""The engine that defines the meaning of a scenario, by SimPy processes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from netkf.algorithms.kernels.maps import spread_of
from netkf.algorithms.models import MapModel, RateModel
from netkf.engines.base import Engine, Progress, Rank, broken
from netkf.engines.reach import Reach
from netkf.engines.simpy.clocks import clock_processes
from netkf.engines.simpy.driven import DrivenModel
from netkf.engines.simpy.nodes import ClockedNode, Node, View, distinct
from netkf.engines.simpy.sensors import increment_sensors, sensor_processes
from netkf.engines.simpy.slots import FIRST_RANK, SlotClock, SlotNode, SlotSchedule
from netkf.engines.simpy.timeline import Process, Timeline
from netkf.engines.simpy.transmission import Transmitter
from netkf.engines.soundness import sound_mask, stack_estimates
from netkf.linalg.arrays import FloatArray
from netkf.linalg.plain import announce_plain
from netkf.network.lives import Lifetime, lifetimes
from netkf.network.node_clocks import node_time
from netkf.plants.linear import Readings
from netkf.plants.readings import readings_of
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES, SENSE


class DivergedError(Exception):
    """A covariance or an estimate is no longer finite."""


@dataclass
class SimpyEngine(Engine):
    """Runs every scenario: sensors, clocks and samplers are processes; messages that take time and
    absorptions are events. ``arrange`` may reorder the processes before they start, which changes
    no result. The recorder's ``stats`` count processes and events.
    """

    arrange: Callable[[list[Process]], list[Process]] = list
    name = "simpy"

    def refusal(self, scenario: Scenario) -> str | None:
        """Return None: this engine runs every scenario."""
        return None

    def announce(self, scenario: Scenario) -> None:
        """Say on stderr that runs are slow where kernels are not compiled."""
        announce_plain()

    def run(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> str:
        """Simulate a scenario, see ``Engine.run``; ``progress`` is called at each sample."""
        with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
            simulation = _Simulation(scenario, streams, recorder, progress)
            # Slots and clocks share the timeline, but no process.
            processes = simulation.slots() if scenario.slotted else simulation.clocks()
            timeline = simulation.timeline
            # Any order will do: every event has an explicit time, rank and entity.
            for process in self.arrange(processes):
                timeline.start(process)
            try:
                timeline.run()
            except DivergedError:
                return "diverged"
            finally:
                # Also after an error, so that the trace has all events so far.
                recorder.stats = {"processes": timeline.processes, "events": timeline.events}
                recorder.flush()
        return "complete"


class _Simulation:
    """The objects that the processes of one run share."""

    def __init__(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> None:
        self.timeline = Timeline()
        self._scenario, self._streams = scenario, streams
        self._recorder, self._progress = recorder, progress
        self._membership = _Membership(scenario, streams, recorder)
        self._transmitter = Transmitter(
            scenario, streams, self.timeline, recorder, self._membership.up
        )
        recorder.exact_errors, recorder.unknown = scenario.exact_errors, scenario.unknown_samples

    def clocks(self) -> list[Process]:
        """Return the SimPy processes of a scenario in continuous time."""
        scenario, streams, timeline = self._scenario, self._streams, self.timeline
        truth = scenario.continuous_truth(streams)
        self._begin_reach(truth)

        def make_node(node: int, entity: int, sensing: tuple[int, ...]) -> ClockedNode:
            # A pooled filter has the increment sensors of all nodes.
            placed = [(k, p) for k in sensing for p in scenario.increment_sensors.get(k, ())]
            sensors = increment_sensors(scenario, streams, placed)
            clock = node_time(scenario, streams, node)
            response = scenario.origin_response if scenario.network.clocks else None
            own = _node_arguments(scenario, node, entity, clock.shows(0.0))
            return ClockedNode(timeline, self._recorder, truth, sensors, clock, response, **own)

        nodes = _nodes(scenario, make_node)
        self._begin_origins(nodes)
        # The conserved sums at the start, before any exchange.
        sums = _Sums(distinct(nodes))
        shared = (scenario, streams, timeline, self._recorder)
        return [
            self._sampling(truth, nodes, sums),
            self._moving_origin(truth, nodes),
            *self._changing(distinct(nodes)),
            *self._membership.processes(timeline, nodes),
            *sensor_processes(*shared, truth, nodes, self._membership.up),
            *clock_processes(*shared, self._transmitter, nodes),
        ]

    def _begin_reach(self, truth: Any) -> None:
        if self._scenario.links_move:
            self._transmitter.reach = Reach(self._scenario, truth, self._append)

    def _begin_origins(self, nodes: dict[int, Any]) -> None:
        scenario, believed = self._scenario, self._scenario.origin_response
        if believed is None:
            return

        def origin_at(sender: int, when: float) -> FloatArray:
            states = believed.states(np.array([when]))[0]
            return np.asarray(states[scenario.model_view(scenario.topology.index[sender])])

        self._transmitter.origin_at = origin_at
        self._transmitter.estimates_at = lambda sender: nodes[sender].estimates_at

    def _append(self, row: Any) -> None:
        # A recorder that pauses has another ``append``.
        self._recorder.append(row)

    def _sampling(self, truth: Any, nodes: dict[int, ClockedNode], sums: _Sums) -> Process:
        for time in self._scenario.times.tolist():
            yield self.timeline.at(time, Rank.PROBE, 0)
            # Events predict only the nodes that take part; a sample needs all nodes at one time.
            for node in distinct(nodes):
                node.predict_to(time)
            self._record(time, time, truth, nodes, sums)

    def _moving_origin(self, truth: Any, nodes: dict[int, ClockedNode]) -> Process:
        for k, time in enumerate(truth.frame_times.tolist()):
            yield self.timeline.at(time, Rank.REBASE, 0)
            for node in distinct(nodes):
                node.predict_to(time)
            # The new origin is the local state: subtract it from all estimates.
            offset = -truth.rebase(k)
            for node in distinct(nodes):
                node.shift(offset)
            # Payloads under way refer to the old origin too.
            self._transmitter.shift(self._scenario.node_filter, offset)

    def _changing(self, nodes: list[ClockedNode]) -> Iterator[Process]:
        """Yield a process for each node whose model changes, at times by its clock."""
        changes = self._scenario.followed_changes
        for node in nodes if len(changes) else ():
            yield self._change(node, changes[node.moving_model.piece :])

    def _change(self, node: ClockedNode, changes: FloatArray) -> Process:
        times = node.times_of(changes)
        for time in times[times < self._scenario.horizon].tolist():
            yield self.timeline.at(time, Rank.REBASE, node.entity)
            node.predict_to(time)
            node.moving_model.begin(node.moving_model.piece + 1)

    def slots(self) -> list[Process]:
        """Return the SimPy processes of a scenario in slots."""
        scenario, streams, recorder = self._scenario, self._streams, self._recorder
        truth = scenario.slot_truth(streams)
        self._begin_reach(truth)
        schedule, period = SlotSchedule(scenario), scenario.slot_plant.period

        def make(node: int, entity: int, _: tuple[int, ...]) -> SlotNode:
            own = _node_arguments(scenario, node, entity)
            return SlotNode(recorder, schedule, period, streams, **own)

        nodes = _nodes(scenario, make)
        self._begin_origins(nodes)
        # Filters, readers and the clock are processes that meet by time and rank only.
        processes = [node.run_process(self.timeline) for node in distinct(nodes)]
        processes += self._membership.processes(self.timeline, nodes)
        for node, placed in scenario.placed_sensors.items():
            sensors = [
                (
                    scenario.slot_path(streams, node, sensor),
                    scenario.noise_covariance(sensor.entry, believed=True),
                )
                for sensor in placed
            ]
            processes.append(self._reading_slots(truth, schedule, node, nodes[node], sensors))
        if scenario.node_filter.timing.talks:
            clock = SlotClock(scenario, streams, recorder, schedule, self._transmitter, nodes)
            processes.append(clock.run_process(self.timeline))
        return [self._sampling_slots(truth, schedule, nodes, _Sums(distinct(nodes))), *processes]

    def _reading_slots(
        self,
        truth: Any,
        schedule: SlotSchedule,
        node: int,
        carrier: SlotNode,
        sensors: list[tuple[Readings, FloatArray]],
    ) -> Process:
        """Read all ``sensors`` of a node, each with the R (p, p) that its filter believes."""
        slot, entity = 0, self._scenario.topology.index[node]
        while schedule.runs(slot):
            for stage in schedule.stages(slot):
                if stage.kind == "read":
                    yield self.timeline.at(stage.time, stage.rank, entity)
                    up = self._membership.up(node)
                    if up:
                        self._recorder.append((stage.time, SENSE, node, -1, -1, -1, NAN))
                    # In the coordinates of the estimates, as H x is.
                    x = truth.local(slot)
                    for sensor, R in sensors:
                        for reading in readings_of(sensor, slot, x, R):
                            if up:
                                carrier.read(node, *reading)
            slot += 1

    def _sampling_slots(
        self, truth: Any, schedule: SlotSchedule, nodes: dict[int, SlotNode], sums: _Sums
    ) -> Process:
        predicts, recorder, slot = self._scenario.node_filter.timing.predicts, self._recorder, 0

        def sample() -> None:
            if schedule.sampled(slot):
                self._record(schedule.start(slot), slot, truth, nodes, sums)
            # The origin moves after the sample, which still refers to the old one.
            if truth.frame_slots and slot and slot % truth.frame_slots == 0:
                offset = -truth.rebase(slot)
                for node in distinct(nodes):
                    node.shift(offset)

        while True:
            # A slot at the horizon exists only if it is sampled.
            last = schedule.over(slot)
            if last and not schedule.sampled(slot):
                return
            # First rank of a slot: before its stages.
            yield self.timeline.at(schedule.start(slot), FIRST_RANK, 0)
            if predicts:
                sample()
            elif last:
                recorder.pause()  # the horizon is half open: this slot makes its sample only
            # A filtered state is sampled after all stages of the slot.
            if not predicts:
                yield self.timeline.at(*schedule.end(slot), 0)
                recorder.resume()
                sample()
            if last:
                return
            recorder.flush_if_full()
            slot += 1

    def _record(
        self, time: float, when: float, truth: Any, nodes: dict[int, Any], sums: _Sums
    ) -> None:
        """Record the states at ``time``; ``when`` is that time, or its slot."""
        scenario, recorder = self._scenario, self._recorder
        x, local = truth.absolute(when), truth.local(when)
        # Half open: links are not looked at at the horizon.
        now, reach = self.timeline.now, self._transmitter.reach
        if reach is not None and now < scenario.horizon:
            reach.look_at_all(int(when) if scenario.slotted else None, now)
        # By identity: a pooled filter is asked once, and its estimate serves all nodes.
        estimate_by_state = {id(n): n.reported(now) for n in distinct(nodes)}
        estimates = [estimate_by_state[id(nodes[node])] for node in scenario.nodes]
        # The trace has absolute states. Adding the origin loses digits, so the error is computed
        # from local ones.
        origin = np.zeros(len(x))
        if x is not local:
            origin = scenario.origins(np.array([when]), local[None], x[None])[0]
        if scenario.views is not None:
            self._record_views(time, (x, local, origin), nodes, estimates)
            return
        local_estimates, P, has_no_P = stack_estimates(estimates)
        xhat = local_estimates if x is local else local_estimates + origin
        error = local - local_estimates
        recorder.sample(time, x, xhat, P, error)
        # Sums are taken at samples only: summing over all nodes at every event would be quadratic.
        if sums.start:
            recorder.sums = sums.pairs()
        # An estimate that is not sound ends the run; it is noticed at samples only.
        self._end_sample(time, broken(scenario, xhat, P, error, without=has_no_P))

    def _record_views(
        self,
        time: float,
        states: tuple[FloatArray, FloatArray, FloatArray],
        nodes: dict[int, Any],
        estimates: list[tuple[FloatArray, FloatArray | None]],
    ) -> None:
        """Record a sample of nodes that estimate different parts of the state, nan beyond them."""
        scenario, diverged, (x, local, origin) = self._scenario, list[int](), states
        N, width = len(scenario.nodes), scenario.width
        xhat, error = (np.full((N, width), np.nan) for _ in range(2))
        P = np.full((N, width, width), np.nan)
        for k, (node, (mean, cov)) in enumerate(zip(scenario.nodes, estimates, strict=True)):
            view = scenario.view(k)
            # A pooled filter estimates all.
            chosen = view if nodes[node].view is None else slice(len(view))
            n, own = len(view), mean[chosen]
            error[k, :n] = local[view] - own
            xhat[k, :n] = own + origin[view]
            if cov is not None:
                P[k, :n, :n] = cov[chosen][:, chosen]
            known = error[k, :n] if scenario.plant.truth_known else None
            if not sound_mask(xhat[k, :n], P[k, :n, :n], cov is None, known):
                diverged.append(node)
        self._recorder.sample(time, x, xhat, P, error)
        self._end_sample(time, diverged)

    def _end_sample(self, time: float, diverged: list[int]) -> None:
        recorder = self._recorder
        recorder.flush_if_full()
        self._progress(time)
        # Recorded after the sample, which has the diverged estimate.
        recorder.end_as_diverged(time, diverged)
        if diverged:
            raise DivergedError


def _nodes(scenario: Scenario, make: Callable[[int, int, tuple[int, ...]], Any]) -> dict[int, Any]:
    nodes = scenario.nodes
    if scenario.node_filter.timing.pooled:
        return dict.fromkeys(nodes, make(-1, 0, scenario.sensing_nodes))
    return {node: make(node, entity, (node,)) for entity, node in enumerate(nodes)}


def _node_arguments(scenario: Scenario, node: int, entity: int, start: float = 0) -> dict[str, Any]:
    """Return the arguments of Node for ``node`` (id, -1: pooled) with index ``entity``, whose clock
    shows ``start`` seconds, or slots, at time 0.
    """
    views = scenario.model_views
    view = None if node < 0 or views is None else views[entity]
    common = {i: entries for (i, j), entries in scenario.common_entries.items() if j == node}
    # -1: the pooled filter, which is not a node of the graph.
    model = scenario.model_of(entity)
    if not scenario.slotted and len(changes := scenario.followed_changes):
        model.begin(int((changes <= start).sum()))
    if scenario.tells_models:
        model = DrivenModel(scenario, model, view)
    if isinstance(model, MapModel | RateModel):
        # It follows the time of one run.
        model = dataclasses.replace(model)
    states = scenario.plant.n if view is None else len(view)
    return {
        "algorithm": scenario.node_filter,
        "node": node,
        "entity": entity,
        "model": model,
        "start": scenario.fresh_estimate(scenario.nodes[entity], start),
        "info": scenario.node_infos[entity],
        "points": spread_of(scenario.filter.linearise, states),
        "view": None if view is None else View(view, scenario.layout.places, common),
        "gate": scenario.filter.gate,
    }


class _Sums:
    """The conserved quantities of exchanges, summed over all nodes at the start and now."""

    def __init__(self, nodes: list[Node]) -> None:
        self._nodes = nodes
        self.start = self._compute()

    def _compute(self) -> dict[str, float]:
        parts = [node.algorithm.analysis.conserved(node.state) for node in self._nodes]
        # fsum: rounding of this sum would look like a loss.
        return {
            name: math.fsum(np.concatenate([np.atleast_1d(part[name]) for part in parts]))
            for name in parts[0]
        }

    def pairs(self) -> dict[str, tuple[float, float]]:
        """Return the sums (at the start, now) by name."""
        now = self._compute()
        return {name: (first, now[name]) for name, first in self.start.items()}


class _Membership:
    """Which nodes are up now; all of them without ``network.lives``."""

    def __init__(self, scenario: Scenario, streams: Streams, recorder: Recorder) -> None:
        self._recorder, self._index = recorder, scenario.topology.index
        self._fresh_estimate, self._horizon = scenario.fresh_estimate, scenario.horizon
        self._lives = lifetimes(scenario, streams)
        self._down = {node for node, life in self._lives.items() if not life.up}

    def up(self, *nodes: int) -> bool:
        """Return True if one of these nodes (ids) is up."""
        return not self._down.issuperset(nodes)

    def processes(self, timeline: Timeline, nodes: dict[int, Any]) -> list[Process]:
        """Return a process for each node that goes up or down in the run."""
        for node in self._down:
            nodes[node].set_up(False, 0.0)
        return [
            self._live(timeline, node, life, nodes[node])
            for node, life in self._lives.items()
            if life.changes
        ]

    def _live(self, timeline: Timeline, node: int, life: Lifetime, carrier: Any) -> Process:
        for change in life.changes:
            # Before anything else of this instant, but for a move of the origin.
            yield timeline.at(change.time, Rank.LIFE, self._index[node])
            code = CODES[change.kind]
            if change.time < self._horizon:
                self._recorder.append((change.time, code, node, -1, -1, -1, NAN))
            carrier.set_up(change.up, change.time)
            if change.up:
                self._down.remove(node)
                if life.forgets:
                    carrier.restart(change.time, partial(self._fresh_estimate, node))
            else:
                self._down.add(node)
                carrier.inbox.clear()
