"""Runs in slots: draw the messages, truth and readings of many slots, then simulate the filters.

A call of a kernel takes S slots of R runs, which are side by side in B blocks of L lanes
(linalg.lanes). Where channels or clocks are a user's own, or messages take time, numpy makes the
messages of one run at a time (engines.compiled.slot_tables).
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.kernels.nonlinear_rows import NonlinearRows, add_values
from netkf.core.memory import ReusableMemory, keep_freed_memory
from netkf.engines.base import Progress
from netkf.engines.compiled.gates import with_clips, with_refusals
from netkf.engines.compiled.outcomes import channel_streams, demand_probabilities
from netkf.engines.compiled.own_sensors import read_whitened
from netkf.engines.compiled.quantiser import dither_of
from netkf.engines.compiled.samples import by_node, record_samples
from netkf.engines.compiled.slot_filters import SlotFilters
from netkf.engines.compiled.slot_loop import WHOLE, SlotSamples
from netkf.engines.compiled.slot_messages import (
    EventRows,
    SlotChannels,
    SlotMessages,
    SlotTimes,
    TracedNodes,
    Tracing,
    count_arrivals,
    count_sends,
    draw_by_link,
    draw_messages,
    draw_pairs,
    draw_uniforms,
    make_rows,
    mark_senders,
)
from netkf.engines.compiled.slot_pairs import matrix_of
from netkf.engines.compiled.slot_setup import BATCH_BYTES, AssignedSensor, SlotSetup, slot_setup
from netkf.engines.compiled.slot_steps import StepTimes, absent, step_times
from netkf.engines.compiled.slot_tables import COLUMNS, SlotTables
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, aligned, blocks_of, by_run, in_lanes, unset
from netkf.linalg.portable import cholesky, solve_lower
from netkf.network.deliveries import Deliveries
from netkf.plants.faults import FaultyReadings
from netkf.plants.maps import NonlinearPlant
from netkf.plants.slot_paths import (
    MapPaths,
    Path,
    draw_map_paths,
    draw_paths,
    draw_readings,
    draw_starts,
)
from netkf.rng.numbers import normal_ziggurat
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import LONG, Recorder
from netkf.trace.run import StateSamples
from netkf.trace.schema import (
    ABSORB,
    CLIP,
    DELIVER,
    EVENT,
    KINDS,
    LOST,
    REFUSE,
    ROUND,
    SEND,
    SENSE,
    STOP,
    SWAP,
    TICK,
)

CACHED = 1 << 18  # bytes of the processor's cache for arrival bits
NEVER, _ALL = np.iinfo(np.int64).max, np.zeros((0, 0), dtype=np.int64)
_samples = ReusableMemory(BATCH_BYTES)


class SampledStates(NamedTuple):
    """T samples of R runs with H filters each, in the coordinates of the plant.

    x : (R, T, n), states of the plant
    xhat, error : (R, T, H, w), estimates and x - xhat, nan where a filter has fewer states than w
    P : (R, T, H, w, w)
    """

    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


class SlotBlock(NamedTuple):
    """Results of S slots of R runs: indices ``sampled`` (T,) of the slots with a sample, the
    ``samples`` of these slots or of all slots so far, the times of the slots, their messages, and
    ``SlotPlan.refused`` and ``clipped``.
    """

    sampled: np.ndarray
    samples: SampledStates
    times: SlotTimes
    messages: SlotMessages
    refused: np.ndarray
    clipped: np.ndarray


class SlotRuns:
    """R runs of one scenario, simulated side by side, some slots at a time. ``store_all``: keep the
    samples of all slots, for the results of a batch.
    """

    def __init__(self, scenario: Scenario, streams: Streams, store_all: bool = False) -> None:
        self.setup: SlotSetup = slot_setup(scenario)
        self._scenario, self._streams = scenario, streams
        self._first = Streams(streams.seed, streams.replica)
        # One run, or the replicas of a batch.
        self.runs = streams.runs
        self._slot = 0
        setup, runs = self.setup, self.runs
        # A batch stores the samples of the whole runs, a single run those of a block at a time.
        self.samples = self._empty_samples(len(setup.samples)) if store_all else None
        self._blocks = blocks = blocks_of(runs)
        self._total = aligned((blocks, LANES))
        kernels = compiled_kernels(setup.algorithm, clocked=False)
        assert kernels is not None
        method, active = scenario.filter.linearise, min(runs, LANES)
        self._pairs = None if setup.pairs is None else setup.pairs.tables(method, active)
        self._filters = SlotFilters(setup, kernels, blocks, active=active, pairs=self._pairs)
        self._nonlinear: NonlinearRows | None = None
        if setup.nonlinear is not None:
            self._nonlinear = self._drawn = setup.nonlinear.tables(method, active)
            if setup.drawn is not setup.nonlinear:
                self._drawn = setup.drawn.tables(method, active)
            self._filters.set_rows(self._nonlinear)
        arrays = self._filters.records.arrays
        # A node that never stops does so in a slot that no run reaches.
        never = np.full((blocks, setup.estimators, LANES), NEVER)
        self._stopped = arrays.get("stopped", never)
        self._conserved = arrays.get("conserved", aligned((blocks, setup.estimators, 2, LANES)))
        if setup.conserved_names:
            self._filters.observe()
        self._at_start = self._sums(1)
        self._sent = np.zeros(len(setup.directions), dtype=np.int64)
        self.counts = np.zeros((runs, len(KINDS)), dtype=np.int64)
        self._begin_truth()
        self._begin_readings()
        self._filters.quantiser.with_streams(dither_of(scenario, streams))
        # Of each run, where kernels cannot draw the messages.
        self._tables: list[SlotTables] = []
        if not setup.is_drawn:
            self._tables = [SlotTables(scenario, one, setup) for one in streams.per_replica]
        self._begin_messages()

    def _begin_truth(self) -> None:
        plant, setup = self._scenario.slot_plant, self.setup
        self._truth: Any = None
        self._path: Path | MapPaths | None = None
        # A recorded truth is the same in all runs.
        if not plant.is_random:
            self._truth = self._scenario.slot_truth(self._first)
            return
        self._plant_states = self._streams.states("plant", [()])
        x, origin = (aligned((self._blocks, setup.n, LANES)) for _ in range(2))
        # C-contiguous copies, whatever the plant gives: kernels are compiled for one memory layout.
        mean, root = (np.array(part, order="C") for part in (plant.start_mean, plant.start_root))
        scratch = np.zeros((setup.n, LANES))
        draw_starts(MANY, self._plant_states, normal_ziggurat(), mean, root, scratch, x)
        if isinstance(plant, NonlinearPlant):
            self._map = plant.functions[0]
            self._path = MapPaths(
                self._map.address, plant.inputs(setup.slots + 1), plant.period,
                np.stack(plant.noise_roots),
                np.array(plant.noise_slots, dtype=np.int64), x, *np.zeros((2, setup.n)),
            )  # fmt: skip
            return
        F = np.array(self._scenario.linear_plant.F, order="C")
        self._path = Path(F, np.array(plant.noise_root, order="C"), setup.frame, x, origin)
        self._changes = {
            slot: (np.array(piece.F, order="C"), np.array(piece.noise_root, order="C"))
            for slot, piece in zip(plant.change_slots, plant.pieces[1:], strict=True)
        }

    def _begin_readings(self) -> None:
        setup, streams = self.setup, self._streams
        entities = [(s.node, s.placed_sensor.ordinal) for s in setup.kernel_sensors]
        # One stream for each drawn sensor of each run.
        self._noise = streams.states("noise", entities)
        self._regressors: list[tuple[Path, np.ndarray]] = []
        for s, (A, drive, start) in zip(setup.regressor_sensors, setup.regressors, strict=True):
            x = in_lanes(start, self._blocks)
            # Frame 0: the origin never moves, as regressors do not grow as an unstable plant does.
            path = Path(A, drive, 0, x, np.zeros(x.shape))
            states = streams.states("regressor", [(s.node, s.placed_sensor.ordinal)])
            self._regressors.append((path, states))
        scenario, first = self._scenario, self._first
        self._recorded: list[tuple[AssignedSensor, Any]] = [
            (s, scenario.slot_path(first, s.node, s.placed_sensor)) for s in setup.recorded_sensors
        ]
        # One path for each run.
        self._own: list[tuple[AssignedSensor, list[Any]]] = [
            (s, [scenario.slot_path(r, s.node, s.placed_sensor) for r in streams.per_replica])
            for s in setup.own_sensors
        ]
        # What is not linear is read by kernels: what a bad sensor gives instead, in each run.
        given, when = scenario.given_readings, scenario.slot_plant.slot_time
        self._bad: list[tuple[AssignedSensor, list[FaultyReadings]]] = [
            (s, [given(None, r, s.node, s.placed_sensor, when) for r in streams.per_replica])
            for s in setup.nonlinear_sensors
            if scenario.fault_of(s.node, s.placed_sensor) is not None
        ]

    def _begin_messages(self) -> None:
        setup, streams = self.setup, self._streams
        self._calls_law = setup.is_drawn and setup.law_in_kernels
        first = [self._scenario.transmission(w) for w in setup.directions if self._calls_law]
        channels = channel_streams(
            setup.channel, streams, setup.senders, setup.delivery, first=first
        )
        # -1: nothing drawn yet.
        uniform = np.full(len(channels.bad), -1.0)
        self._channels = SlotChannels(
            channels, uniform, setup.ends, setup.talks, np.zeros((0, 0)), setup.directions_per_link
        )
        # Draws of all links, anew in each slot, with probabilities that stay, may be made link by
        # link: in as many slots as have arrival bits in the processor's cache.
        self._units: FloatArray | None = None
        keeps = len(channels.state) or self._calls_law or not setup.fresh[:1].any()
        if len(channels.loss) and setup.matching.protocol < 0 and not keeps:
            steps, bits = len(setup.fresh), len(setup.fresh) * len(setup.directions) * LANES
            self._units = np.empty(steps * max(1, CACHED // bits))
        if setup.algorithm.timing.randomised:
            self._triggers = streams.states("trigger", [(node,) for node in setup.nodes.tolist()])
        self._matchings = setup.matchings(streams.states("matching", [()]))

    @property
    def over(self) -> bool:
        """Return True if all slots have been simulated."""
        return self._slot >= self.setup.slots

    def following(self, max_events: int, timed: bool = True) -> SlotBlock:
        """Simulate the next slots in all R runs, with about ``max_events`` events at most (0: no
        limit). ``timed``: compute the times of slots, which event rows need.
        """
        times, messages = self._next_messages(max_events, timed)
        local, absolute, rebased = self._next_states(len(times.start))
        drawn, responses = self._path is not None, self._scenario.input_responses
        y, H = self._draw_readings(times, local, rebased)
        sampled = np.flatnonzero(times.sample >= 0)
        samples = self.samples if self.samples is not None else self._empty_samples(len(sampled))
        # Kernels take flat entries for each sample. Explicit lengths, since reshape(-1) fails for
        # the empty arrays of a block without a sample.
        x, xhat, P, error = (a.reshape(*a.shape[:2], math.prod(a.shape[2:])) for a in samples)
        kernel_samples = SlotSamples(
            x=x, xhat=xhat, P=P, error=error, absolute=absolute, local=local,
            framed=drawn and absolute is not local, total=self._total,
            **self._filters.sample_scratch,
            entries=np.maximum(self.setup.entries, 0) if self.setup.views is not None else _ALL,
        )  # fmt: skip
        decided = self._simulate(times, messages, (y, H, rebased), kernel_samples)
        if not drawn and responses is not None and responses.believed is not None:
            # Recorded states may be unknown, where coordinates begin is not.
            moved = responses.believed.states(times.first + sampled)[:, self.setup.entries]
            samples.xhat[:, times.sample[sampled]] += moved
        return SlotBlock(sampled, samples, times, messages, *decided)

    def _simulate(
        self,
        times: SlotTimes,
        messages: SlotMessages,
        readings: tuple[FloatArray, FloatArray, np.ndarray],
        samples: SlotSamples,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate the filters; return ``refused`` and ``clipped`` of ``SlotPlan``."""
        filters, count, (y, H, rebased) = self._filters, len(times.start), readings
        gated = sum(map(len, self.setup.gated_parts)) if self.setup.gate is not None else 0
        unread, begin = self._missed_readings(messages, count), WHOLE
        speaks = self._find_senders(times, messages, unread)
        drawn: dict[str, Any] = {
            "first": self._slot,
            "sensed": times.sensed,
            "exchanged": times.exchanged,
            "sample": times.sample,
            "rebased": rebased,
            "up": messages.up,
            "sent": messages.sent,
            "uniform": self._draw_uniforms(messages.sent),
            "refused": np.zeros((self._blocks, count, gated, LANES), dtype=np.uint8),
            "speaks": speaks,
            "clipped": np.zeros(speaks.shape, dtype=np.int32),
        }
        # Nodes begin again before the first slot of a block.
        for h in self._tables[0].restarts.get(self._slot, ()) if self._tables else ():
            # By how much its prior differs in the coordinates of this slot.
            start = self._slot - (not self.setup.algorithm.timing.predicts)
            filters.restart(h, self._scenario.prior_shift(self.setup.infos[h].node, start))

        def decided(step: int, up: np.ndarray) -> np.ndarray:
            nonlocal begin
            messages.up[0, 0, ..., 0] = up
            filters.simulate(y, H, samples, **drawn, begin=begin, stop=step)
            begin = step
            sent: np.ndarray = messages.sent[0, 0, step, :, 0] & ~unread[0, step]
            return sent

        # Filters decide who sends, and Python makes the messages: step by step.
        if self._tables and self.setup.decides:
            messages.up[0, ..., 0] = self._tables[0].following(self._step_times(1), decided)
        filters.simulate(y, H, samples, **drawn, begin=begin, stop=WHOLE)
        if len(messages.sent):
            # Only now, since the kernel decides for all nodes that are asked, readings or not.
            messages.sent[:, unread] = 0
        if self.setup.pairs is not None:
            self.setup.pairs.nonlinear.raise_error()
        self._slot += count
        return drawn["refused"], drawn["clipped"]

    def _find_senders(
        self, times: SlotTimes, messages: SlotMessages, unread: np.ndarray
    ) -> np.ndarray:
        """Return (B, S, E, N, L) 1 where nodes have links to send on; empty if all is exact."""
        if self._scenario.network.quantise is None:
            # Five dimensions, as kernels are compiled for.
            return np.zeros((0,) * 5, dtype=np.uint8)
        speaks = np.zeros((self._blocks, *unread.shape, LANES), dtype=np.uint8)
        for r, tables in enumerate(self._tables):
            speaks[r // LANES, ..., r % LANES] = tables.speaks
        if not self._tables:
            mark_senders(self._channels, messages, times.exchanged, self.runs, speaks)
            speaks[:, unread] = 0
        return speaks

    def _next_messages(self, max_events: int, timed: bool) -> tuple[SlotTimes, SlotMessages]:
        setup, tables = self.setup, self._tables
        if tables and setup.decides:
            # One slot at a time: the filters decide who sends before the messages are made.
            asked = tables[0].asked(self._step_times(1))[None]
            up = np.zeros((*asked.shape[:2], len(setup.directions)), dtype=np.uint8)
            return self._next_times(1, True), _pack_messages([up], [asked])
        count = min(setup.block_slots(self.runs, max_events), setup.slots - self._slot)
        if not tables:
            # The kernels draw the messages of many slots and runs at once.
            times = self._next_times(count, timed)
            return times, self._draw_messages(times)
        # Nodes begin again before the first slot of a block.
        ends = (slot - self._slot for slot in tables[0].restarts if slot > self._slot)
        count = min([count, *ends]) if setup.forgets else count
        steps = self._step_times(count)
        arrived = [one.following(steps) for one in tables]
        return self._next_times(count, True), _pack_messages(arrived, [one.awake for one in tables])

    def _step_times(self, count: int) -> StepTimes:
        return step_times(self._scenario, self.setup, self._slot, count)

    def _empty_samples(self, count: int) -> SampledStates:
        """Return space for ``count`` samples of all R runs, in memory that is reused."""
        runs, setup = self.runs, self.setup
        filter_shape = runs, count, setup.estimators, setup.width
        shapes = (runs, count, setup.n), filter_shape, (*filter_shape, setup.width), filter_shape
        offsets = np.cumsum([math.prod(shape) for shape in shapes])
        # One allocation for all: numpy requests huge pages for large ones, which are cheap to get.
        arrays = np.split(_samples.array(int(offsets[-1])), offsets[:-1])
        return SampledStates(*(a.reshape(shape) for a, shape in zip(arrays, shapes, strict=True)))

    @property
    def broken(self) -> np.ndarray:
        """(R,) bool: runs with an estimate or covariance that is not finite."""
        return np.asarray(~np.isfinite(by_run(self._total, self.runs)))

    def _next_times(self, count: int, timed: bool) -> SlotTimes:
        """Return what happens in the next ``count`` slots, and, if ``timed``, when they begin."""
        setup, algorithm, plant = self.setup, self.setup.algorithm, self._scenario.slot_plant
        slots = np.arange(self._slot, self._slot + count)
        recorded, active, exchanged = setup.activity(slots)
        # Filters that do not predict use no reading in slot 0: its sample is their initial state.
        sensed = active & ((slots > 0) | algorithm.timing.predicts)
        sample = np.full(count, -1, dtype=np.int64)
        first, last = np.searchsorted(setup.samples, (self._slot, self._slot + count))
        # Indices count from the first sample of the run, or of these slots.
        indices = np.arange(first, last) - (first if self.samples is None else 0)
        sample[setup.samples[first:last] - self._slot] = indices
        start = np.zeros(count)
        # Only event rows need the times: a batch without them saves the loop.
        if timed:
            start = np.array([plant.slot_time(slot) for slot in slots.tolist()])
        return SlotTimes(
            first=self._slot, start=start, recorded=recorded, sensed=sensed, exchanged=exchanged,
            sample=sample, predicts=algorithm.timing.predicts,
        )  # fmt: skip

    def _draw_messages(self, times: SlotTimes) -> SlotMessages:
        setup = self.setup
        shape, pairs = (len(times.start), len(setup.fresh)), setup.max_pairs
        decided = setup.decides or setup.may_miss
        # Without matchings the arrays of pairs stay empty.
        matched = self.runs if setup.matching.protocol >= 0 else 0
        messages = SlotMessages(
            up=np.zeros((self._blocks, *shape, len(setup.directions), LANES), dtype=np.uint8),
            active=np.empty((matched, *shape, pairs), dtype=np.int64),
            pair_count=np.zeros((matched, *shape), dtype=np.int64),
            # Empty if every node sends that is asked.
            sent=np.zeros(
                (self._blocks, *shape, len(setup.nodes), LANES) if decided else (0,) * 5,
                dtype=np.uint8,
            ),
        )
        if not len(setup.directions):
            return messages
        if matched:
            draw_pairs(
                self._matchings, setup.ends, times.exchanged, messages.active, messages.pair_count
            )
        channels = self._channels
        if self._calls_law:
            begin = step_times(self._scenario, setup, times.first, len(times.start)).begin
            channels = channels._replace(begin=np.ascontiguousarray(begin))
        if self._units is not None:
            up, fresh = messages.up, setup.fresh
            draw_by_link(MANY, channels, times.exchanged, fresh, up, self._units, self.runs)
        else:
            draw_messages(MANY, channels, times.exchanged, setup.fresh, messages, self.runs)
        demand_probabilities(setup.channel.loss, channels.channels, setup.directions)
        if decided:
            self._mark_senders(messages, times.exchanged)
        # No chosen messages at all: the run as it was.
        if setup.deliveries is not None and setup.deliveries.chosen != frozenset():
            self._deliver_chosen(setup.deliveries, times, messages)
        return messages

    def _mark_senders(self, messages: SlotMessages, exchanged: np.ndarray) -> None:
        """Write 1 into ``messages.sent`` for the nodes that are asked for a message."""
        ends = self.setup.ends
        if not len(messages.pair_count):
            linked = np.isin(np.arange(len(self.setup.nodes)), ends)
            messages.sent[:, exchanged] = linked[:, None]
            return
        pairs = np.arange(self.setup.max_pairs) < messages.pair_count[..., None]
        r, s, e, a = (index[:, None] for index in np.nonzero(pairs))
        nodes = ends[messages.active[r[:, 0], s[:, 0], e[:, 0], a[:, 0]]]
        messages.sent[r // LANES, s, e, nodes, r % LANES] = 1

    def _deliver_chosen(
        self, deliveries: Deliveries, times: SlotTimes, messages: SlotMessages
    ) -> None:
        """Write 1 into ``messages.up`` for the messages that a replay delivers anyway."""
        setup, each = self.setup, self.setup.directions_per_link
        # (S, E, W): in which steps each directed link carries a message.
        is_sent = np.zeros(messages.up.shape[1:4], dtype=bool)
        is_sent[times.exchanged] = setup.talks
        if len(messages.active):
            is_active = np.zeros((*is_sent.shape[:2], len(setup.ends)), dtype=bool)
            for step in np.ndindex(*is_sent.shape[:2]):
                pairs = messages.active[(0, *step)][: messages.pair_count[(0, *step)]]
                is_active[(*step, pairs)] = True
            is_sent &= np.repeat(is_active, each, axis=2)
        if deliveries.chosen is None:
            messages.up[0, ..., 0][is_sent] = 1
            return
        for sender, receiver, number in deliveries.chosen:
            w = setup.index_of_direction[sender, receiver]
            # The messages of this direction in the block, in order, by slot and step.
            sent_slots, sent_steps = np.nonzero(is_sent[:, :, w])
            # Messages are numbered from the beginning of the run: ``_sent`` came in earlier blocks.
            k = number - int(self._sent[w])
            if 0 <= k < len(sent_slots):
                messages.up[0, sent_slots[k], sent_steps[k], w, 0] = 1

    def _missed_readings(self, messages: SlotMessages, count: int) -> np.ndarray:
        """Return (S, E, N) bool: nodes without a reading to send; drop their messages."""
        setup = self.setup
        if not setup.may_miss:
            return np.zeros((count, len(setup.fresh), len(setup.nodes)), dtype=bool)
        unread = setup.unread(self._slot, count)
        senders = setup.ends[:, : setup.directions_per_link].reshape(-1)
        messages.up[:, unread[:, :, senders]] = 0
        return unread

    def _draw_uniforms(self, sent: np.ndarray) -> FloatArray:
        """Return uniform numbers (B, S, E, N, L) for decisions; empty if none is needed."""
        if not self.setup.algorithm.timing.randomised or not self.setup.decides:
            # Five dimensions, as kernels are compiled for.
            return np.zeros((0,) * 5)
        uniform = np.zeros(sent.shape)
        draw_uniforms(MANY, self._triggers, sent, uniform, self.runs)
        return uniform

    def _next_states(self, count: int) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return local and absolute states (B, S, n, L), and (S,) where the origin moves."""
        setup = self.setup
        slots = range(self._slot, self._slot + count)
        rebased = np.zeros(count, dtype=bool)
        if self._path is None:
            # A recorded truth is the same in all runs; of a drawn one slots come in order.
            given = [(self._truth.local(slot), self._truth.absolute(slot)) for slot in slots]
            local, absolute = (
                in_lanes(np.stack(part), self._blocks) for part in zip(*given, strict=True)
            )
            return local, absolute, rebased
        # At the end of a frame the origin moves to the state.
        if setup.frame:
            rebased = np.array([slot > 0 and slot % setup.frame == 0 for slot in slots])
        if isinstance(self._path, MapPaths):
            local = unset((self._blocks, count, setup.n, LANES))
            scratch = aligned((self._path.roots.shape[2], LANES))
            first, states = self._slot, self._plant_states
            draw_map_paths(MANY, self._path, states, normal_ziggurat(), first, scratch, local)
            self._map.raise_error()
            return local, local, rebased
        stop = self._slot + count
        cuts = [slot for slot in self._changes if self._slot < slot < stop]
        ends = itertools.pairwise([self._slot, *cuts, stop])
        parts = [self._piece_of_path(*part) for part in ends]
        local, absolute = parts[0]
        # Plants that change have no frames.
        if len(parts) > 1:
            local = absolute = unset((self._blocks, count, setup.n, LANES))
            np.concatenate([part for part, _ in parts], axis=1, out=local)
        if (responses := self._scenario.input_responses) is not None:
            believed, surprise = (
                None if one is None else one.states(np.array(slots))[..., None] for one in responses
            )
            if surprise is not None:
                local += surprise
            if believed is not None:
                absolute = absolute + believed
        return local, absolute, rebased

    def _piece_of_path(self, first: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (B, S, n, L) of slots between two changes."""
        assert isinstance(self._path, Path)
        if first in self._changes:
            F, root = self._changes[first]
            self._path = self._path._replace(F=F, root=root)
        shape = self._blocks, stop - first, self.setup.n, LANES
        local: FloatArray = unset(shape)
        # Without frames both are the same array.
        absolute: FloatArray = unset(shape) if self.setup.frame else local
        self._draw_path(self._path, self._plant_states, local, absolute, first)
        return local, absolute

    def _draw_path(
        self,
        path: Path,
        states: np.ndarray,
        local: FloatArray,
        absolute: FloatArray,
        first: int = 0,
    ) -> None:
        scratch = aligned((2, max(path.root.shape), LANES))
        draw_paths(MANY, path, states, normal_ziggurat(), first, scratch, local, absolute)

    def _draw_readings(
        self, times: SlotTimes, local: FloatArray, rebased: np.ndarray
    ) -> tuple[FloatArray, FloatArray]:
        """Draw whitened readings (B, S, H, p, L) at states ``local`` (B, S, n, L), and their H."""
        setup, count = self.setup, local.shape[1]
        shape = self._blocks, count, setup.estimators, setup.p
        y: FloatArray = unset((*shape, LANES))
        H: FloatArray = setup.H
        if setup.varies:
            H = unset((*shape, setup.columns.width, LANES))
            H[:] = setup.H
        x = local
        if rebased.any() and setup.algorithm.timing.predicts:
            # The origin moves before the reading: the state in the new frame is 0.
            x = local.copy()
            x[:, rebased] = 0.0
        # The states from which sensors with a random H draw it.
        k = setup.sensors.C.shape[2]
        regressors: FloatArray = unset((len(self._regressors), self._blocks, count, k, LANES))
        for path, (steps, states) in zip(regressors, self._regressors, strict=True):
            self._draw_path(steps, states, path, path)
        noise, scratch = self._noise, np.zeros((setup.p, LANES))
        draw_readings(MANY, setup.sensors, noise, normal_ziggurat(), x, regressors, scratch, y, H)
        if self._nonlinear is not None and setup.nonlinear is not None:
            responses = self._scenario.input_responses
            if responses is not None and responses.believed is not None:
                slots_of_all = np.arange(self._slot, self._slot + count)
                origin = responses.believed.states(slots_of_all)
                self._nonlinear.origin = self._drawn.origin = origin
                if self._pairs is not None:
                    self._pairs.rows.origin = origin
            flat_y = y.reshape(-1, *y.shape[3:])
            add_values(self._drawn, x, flat_y, setup.places, setup.drawn.drawn)
            setup.nonlinear.raise_error()
        self._give_bad_readings(times, y)
        if (self._recorded or self._own) and times.sensed.any():
            self._read_in_python(times, x, y, H)
        if self._scenario.network.lives:
            self._silence(y, H)
        return y, H

    def _give_bad_readings(self, times: SlotTimes, y: FloatArray) -> None:
        """Write what sensors that are bad, and not linear, give in place of their readings."""
        for k in np.flatnonzero(times.sensed).tolist() if self._bad else ():
            for s, given in self._bad:
                readings = y[:, k, s.estimator, s.row : s.row + s.rows]
                for run, bad in enumerate(given):
                    b, lane = divmod(run, LANES)
                    healthy = readings[b, :, lane].copy()
                    readings[b, :, lane] = bad.given(self._slot + k, healthy)

    def _silence(self, y: FloatArray, H: FloatArray) -> None:
        """Take away the readings of nodes that are down."""
        setup, times = self.setup, self._step_times(y.shape[1])
        for r, tables in enumerate(self._tables):
            down = absent(setup, tables.lives, times)
            b, lane = divmod(r, LANES)
            for s in setup.assigned:
                gone = down[:, self._scenario.topology.index[s.node]]
                rows = slice(s.row, s.row + s.rows)
                # What is not linear is read at estimates, unless there is no value.
                y[b, :, s.estimator, rows, lane][gone] = (
                    np.nan if s in setup.nonlinear_sensors else 0.0
                )
                H[b, :, s.estimator, rows, :, lane][gone] = 0.0

    def _read_in_python(
        self, times: SlotTimes, x: FloatArray, y: FloatArray, H: FloatArray
    ) -> None:
        """Write what recorded sensors and those of users read in S slots."""
        setup, count = self.setup, len(times.start)
        slots = (self._slot + np.flatnonzero(times.sensed)).tolist()
        self._clear_pairs(count)
        is_recorded = [s for s, _ in self._recorded if s in setup.nonlinear_sensors]
        if self._nonlinear is not None and is_recorded and len(self._nonlinear.R) != count:
            self._nonlinear.R = np.repeat(self._nonlinear.R[:1], count, axis=0)
        for s, paths in self._own:
            rows = slice(s.row, s.row + s.rows)
            y[:, times.sensed, s.estimator, rows] = 0.0  # in lanes without a run
            place = setup.block_beside(s)
            for run, path in enumerate(paths):
                b, lane = divmod(run, LANES)
                read, of_all = read_whitened(path, slots, x[b, times.sensed, :, lane], s.R, s.root)
                own = read, setup.columns.of(s.estimator, of_all, place)
                for out, values in zip((y, H), own, strict=True):
                    out[b, times.sensed, s.estimator, rows, ..., lane] = values
        for s, path in self._recorded:
            rows = slice(s.row, s.row + s.rows)
            if s.pair >= 0:
                self._read_pairs(s, path, times.sensed, y, H)
                continue
            if s in setup.nonlinear_sensors:
                self._read_nonlinear(s, path, times.sensed, y, H)
                continue
            # L^-1 y and L^-1 H, with the R = L L' that filters believe; all runs read the same.
            whitened_y, whitened_H = path.whitened(slots, s.R, s.rows)
            y[:, times.sensed, s.estimator, rows] = whitened_y[..., None]
            own_H = setup.columns.of(s.estimator, whitened_H)
            H[:, times.sensed, s.estimator, rows] = own_H[..., None]

    def _clear_pairs(self, count: int) -> None:
        """Make room for the pairs of ``count`` slots, of which records have none so far."""
        pairs = self._pairs
        if pairs is None or all(s.pair < 0 for s, _ in self._recorded):
            return
        pairs.block = np.repeat(pairs.block[:1], count, axis=0)
        pairs.rows.R = np.repeat(pairs.rows.R[:1], count, axis=0)
        for s, _ in self._recorded:
            pairs.block[:, s.pair : s.pair + s.rows // len(s.R) if s.pair >= 0 else s.pair] = -1

    def _read_pairs(
        self, s: AssignedSensor, path: Any, sensed: np.ndarray, y: FloatArray, H: FloatArray
    ) -> None:
        """Write the recorded values of a sensor that reads pairs."""
        setup, pairs, scenario, h = self.setup, self._pairs, self._scenario, s.estimator
        assert pairs is not None
        assert setup.pairs is not None
        sensor: Any = scenario.located_sensors[s.placed_sensor.entry]
        p, believed = len(s.R), scenario.input_responses and scenario.input_responses.believed
        rows = slice(s.row, s.row + s.rows)
        y[:, sensed, h, rows] = 0.0 if sensor.linear else np.nan
        for k in np.flatnonzero(sensed).tolist():
            for m, (values, anchor, R) in enumerate(path.readings_at(self._slot + k, s.R)):
                place = setup.columns.of_reading(h, sensor, anchor)
                pair, first = s.pair + m, s.row + m * p
                if place is not None:
                    first = int(pairs.row[pair])
                    pairs.block[k, pair] = setup.columns.number(place)
                if sensor.linear:
                    there = np.isfinite(values)
                    matrix = matrix_of(sensor, anchor, setup.n)
                    z = values
                    if believed is not None:
                        z = values - matrix @ believed.states(np.array([self._slot + k]))[0]
                    both = np.column_stack([z, matrix])[there]
                    white = solve_lower(cholesky(R[there][:, there]), both)
                    y[:, k, h, first : first + p], H[:, k, h, first : first + p] = 0.0, 0.0
                    rows = slice(first, first + len(white))
                    y[:, k, h, rows] = white[:, :1]
                    H[:, k, h, rows] = setup.columns.of(h, white[:, 1:], place)[..., None]
                elif place is None:
                    self._write_nonlinear(s, k, first, (values, anchor, R), y, H)
                else:
                    y[:, k, h, first : first + p] = values[:, None]
                    pairs.rows.R[k, pair, :p, :p] = R

    def _read_nonlinear(
        self, s: AssignedSensor, path: Any, sensed: np.ndarray, y: FloatArray, H: FloatArray
    ) -> None:
        """Write recorded values of a nonlinear sensor, their origins, and covariances."""
        y[:, sensed, s.estimator, s.row : s.row + s.rows] = np.nan
        for k in np.flatnonzero(sensed).tolist():
            for m, reading in enumerate(path.readings_at(self._slot + k, s.R)):
                self._write_nonlinear(s, k, s.row + m * len(s.R), reading, y, H)

    def _write_nonlinear(
        self,
        s: AssignedSensor,
        k: int,
        first: int,
        reading: tuple[FloatArray, int, FloatArray],
        y: FloatArray,
        H: FloatArray,
    ) -> None:
        """Write a ``reading`` of slot k, values, anchor and R, into the rows from ``first`` on."""
        (values, anchor, R), setup, nonlinear = reading, self.setup.nonlinear, self._nonlinear
        assert nonlinear is not None
        assert setup is not None
        sensor: Any = self._scenario.located_sensors[s.placed_sensor.entry]
        rows = slice(first, first + len(s.R))
        place = setup.reference(sensor, s.node if anchor < 0 else anchor, s.estimator)
        y[:, k, s.estimator, rows] = values[:, None]
        H[:, k, s.estimator, rows, : len(place)] = place[:, None]
        nonlinear.R[k, s.estimator, rows, rows] = R

    def events(self, block: SlotBlock) -> tuple[np.ndarray, np.ndarray]:
        """Return a run's EVENT rows (K,) of a block, and how many precede each sample, (T,)."""
        if self._tables:
            # Tables know the events, but not in which slot nodes stopped, and what gates refused.
            rows, before_sample = self._tables[0].events(block.sampled, self._stopped[0, :, 0])
        else:
            before_sample = np.zeros(len(block.sampled), dtype=np.int64)
            rows = self._rows(block, 0, len(block.times.start), before_sample)
        return self._with_decisions(block, rows, before_sample)

    def _with_decisions(
        self, block: SlotBlock, rows: np.ndarray, before_sample: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return EVENT rows with those of gates and of clipped messages, see ``events``."""
        times, scenario = block.times, self._scenario
        rows, before = with_refusals(scenario, times, block.refused, rows, before_sample)
        if not block.clipped.any():
            return rows, before
        steps = step_times(scenario, self.setup, times.first, len(times.start))
        return with_clips(self.setup, steps, block.clipped, rows, before)

    def first_events(self, block: SlotBlock) -> Iterator[np.ndarray]:
        """Yield the EVENT rows of the first run of a batch in a block, for some slots at a time."""
        if self._tables:
            yield self.events(block)[0]
            return
        size = max(1, LONG // max(1, self.setup.rows_of(1)))
        # Samples of a batch are counted from the first of the run.
        before_sample = np.zeros(len(self.setup.samples), dtype=np.int64)
        count = len(block.times.start)
        for first in range(0, count, size):
            rows = self._rows(block, first, min(first + size, count), before_sample)
            yield self._with_decisions(block, rows, before_sample)[0]

    def _rows(self, block: SlotBlock, first: int, stop: int, before: np.ndarray) -> np.ndarray:
        setup = self.setup
        # Space for the largest number of rows.
        table = np.empty(setup.rows_of(stop - first), dtype=EVENT)
        # Kernels write the columns where the records have them.
        columns: Any = [table[name] for name in COLUMNS]
        nodes = TracedNodes(setup.nodes, setup.sensing, setup.links, self._sent, self._stopped)
        trace = Tracing(
            setup.stages, block.times, self._channels, nodes, block.messages,
            EventRows._make([*columns, before]), setup.algorithm.timing.pairwise,
        )  # fmt: skip
        count = make_rows(trace, first, stop)
        return table[:count]

    def count_events(self, block: SlotBlock) -> None:
        """Add the events of a block to ``self.counts`` (R, KINDS)."""
        setup, times, counts = self.setup, block.times, self.counts
        for r, tables in enumerate(self._tables):
            counts[r] += tables.take_counts()
        if not self._tables:
            self._count_drawn(block)
        refused = block.refused[:, times.recorded & times.sensed]
        counts[:, REFUSE] += by_run(refused.sum(axis=(1, 2), dtype=np.int64), self.runs)
        if block.clipped.size:
            clipped = block.clipped[:, times.recorded] > 0
            counts[:, CLIP] += by_run(clipped.sum(axis=(1, 2, 3), dtype=np.int64), self.runs)
        if setup.stages.stopping >= 0:
            since = by_run(self._stopped, self.runs) - times.first
            counts[:, STOP] += ((since >= 0) & (since < times.recorded.sum())).sum(axis=1)

    def _count_drawn(self, block: SlotBlock) -> None:
        setup, times, messages, counts = self.setup, block.times, block.messages, self.counts
        recorded, pairwise = times.recorded, setup.algorithm.timing.pairwise
        sensed, exchanged = recorded & times.sensed, recorded & times.exchanged
        sensing = len(setup.sensing) * int((setup.stages.step < 0).sum())
        counts[:, SENSE] += sensing * int(sensed.sum())
        if pairwise:
            counts[:, TICK] += messages.pair_count[:, recorded].sum(axis=(1, 2))
        else:
            counts[:, ROUND] += len(setup.fresh) * int(exchanged.sum())
        if pairwise or len(messages.sent):
            sends = np.zeros(self.runs, dtype=np.int64)
            count_sends(self._channels, messages, exchanged, sends)
            counts[:, SEND] += sends
        else:
            counts[:, SEND] += int(setup.talks.sum()) * int(exchanged.sum())
        arrivals = aligned((self._blocks, 2, LANES))
        count_arrivals(MANY, setup.links, messages.up, recorded, arrivals)
        arrived, receiving = by_run(arrivals, self.runs).astype(np.int64).T
        counts[:, DELIVER] += arrived
        counts[:, LOST] = counts[:, SEND] - counts[:, DELIVER]
        counts[:, SWAP if pairwise else ABSORB] += arrived if pairwise else receiving

    def conserved(self) -> dict[str, FloatArray]:
        """Return by name the sums that exchanges conserve: (R, 2), at the start and at the end."""
        # All runs start alike.
        return {
            name: np.array([[*self._at_start[name], value] for value in now])
            for name, now in self._sums(self.runs).items()
        }

    def _sums(self, runs: int) -> dict[str, list[float]]:
        """Return by name the sums that exchanges conserve at the last sample, of so many runs."""
        sums = by_run(self._conserved, runs)
        # fsum, so that the sums add no rounding of their own to that of the exchanges.
        return {
            name: [math.fsum(column) for column in sums[:, :, k].tolist()]
            for k, name in enumerate(self.setup.conserved_names)
        }


def _pack_messages(up: list[np.ndarray], sent: list[np.ndarray]) -> SlotMessages:
    """Return the messages of runs as those of lanes."""
    lane_arrays = []
    for of_runs in (up, sent):
        blocks = blocks_of(len(of_runs)) if len(of_runs[0]) else 0
        lanes = np.zeros((blocks, *of_runs[0].shape, LANES), dtype=np.uint8)
        for r, values in enumerate(of_runs if blocks else ()):
            lanes[r // LANES, ..., r % LANES] = values
        lane_arrays.append(lanes)
    # The arrays of matched pairs stay empty: only kernels that draw messages use them.
    active, pairs = (np.zeros((0,) * d, dtype=np.int64) for d in (4, 3))
    return SlotMessages(up=lane_arrays[0], active=active, pair_count=pairs, sent=lane_arrays[1])


def run_slots(scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress) -> str:
    """Simulate one run in slots, see ``Engine.run``."""
    runs = SlotRuns(scenario, streams)
    recorder.exact_errors, recorder.unknown = scenario.exact_errors, scenario.unknown_samples
    try:
        while not runs.over:
            if not _record_block(scenario, runs, recorder, progress):
                return DIVERGED
    finally:
        recorder.flush()
    return COMPLETE


def _record_block(
    scenario: Scenario, runs: SlotRuns, recorder: Recorder, progress: Progress
) -> bool:
    # A limited number of rows at a time: memory does not grow with the length of the run.
    block = runs.following(MAX_EVENT_ROWS)
    rows, rows_before = runs.events(block)
    if len(block.sampled):
        # Start and present value of each conserved sum.
        sums = runs.conserved()
        recorder.sums = {name: (float(v[0, 0]), float(v[0, 1])) for name, v in sums.items()}
    # One run: index 0 of all arrays.
    x, xhat, P, error = (values[0] for values in block.samples)
    xhat, P, error = by_node(scenario, xhat, P, error)
    times = block.times.start[block.sampled]

    def pass_rows_on(k: int) -> None:
        recorder.extend(rows[: rows_before[k]])

    samples = StateSamples(times, x, xhat, P, error)
    sound = record_samples(scenario, recorder, progress, samples, pass_rows_on)
    if sound:
        recorder.extend(rows)
    return sound


MAX_EVENT_ROWS = 1 << 15
"""Rows of events of a block of slots, about."""


def slot_batches(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool
) -> Iterator[RunBatch]:
    """Yield the results of consecutive ``replicas``, as many runs at a time as fit the memory; with
    ``fingerprint`` the hash of the events of the first run.
    """
    keep_freed_memory()
    setup = slot_setup(scenario)
    # As many runs side by side as fit the memory.
    size = setup.batch_runs()
    for first in range(replicas.start, replicas.stop, size):
        count = min(size, replicas.stop - first)
        with_fingerprint = fingerprint and first == replicas.start
        yield slot_batch(scenario, seed, range(first, first + count), with_fingerprint)


def slot_batch(scenario: Scenario, seed: int, replicas: range, fingerprint: bool) -> RunBatch:
    """Simulate R consecutive ``replicas`` side by side. A run that diverges goes on to the end with
    invalid numbers, which ``with_ends`` replaces.
    """
    runs = SlotRuns(scenario, Streams(seed, replicas.start, len(replicas)), store_all=True)
    assert runs.samples is not None
    # The hash that trace.recorder computes: the rows of the first run are hashed, not stored.
    events_hash = hashlib.sha256()
    while not runs.over:
        with np.errstate(over="ignore", invalid="ignore"):
            block = runs.following(max_events=0, timed=fingerprint)
        runs.count_events(block)
        for rows in runs.first_events(block) if fingerprint else ():
            events_hash.update(rows.data)
    x, xhat, P, error = runs.samples
    broken = runs.broken
    if scenario.plant.truth_known:
        with np.errstate(over="ignore", invalid="ignore"):
            broken |= ~np.isfinite(np.einsum("rtfn,rtfn->r", error, error))
    xhat, P, error = by_node(scenario, xhat, P, error)
    return RunBatch(
        replicas=replicas,
        times=runs.setup.sample_times,
        x=x,
        xhat=xhat,
        P=P,
        error=error,
        lengths=np.full(len(replicas), x.shape[1]),
        counts=runs.counts,
        status=np.where(broken, DIVERGED, COMPLETE),
        sums=runs.conserved(),
        exact_errors=scenario.exact_errors,
        fingerprint=events_hash.hexdigest() if fingerprint else "",
    )


def with_ends(batch: RunBatch, alone: Callable[[range, bool], Iterator[RunBatch]]) -> RunBatch:
    """Return the batch with every run that diverges replaced by the same run simulated
    ``alone(replicas, fingerprint)``, which ends where it diverges.
    """
    for r in np.flatnonzero(batch.diverged).tolist():
        # Only the first run of a batch has a fingerprint.
        fingerprint = r == 0 and bool(batch.fingerprint)
        (single,) = alone(batch.replicas[r : r + 1], fingerprint)
        if fingerprint:
            batch = replace(batch, fingerprint=single.fingerprint)
        for name in ("x", "xhat", "P", "error", "lengths", "counts", "status"):
            getattr(batch, name)[r] = getattr(single, name)[0]
        for name, values in batch.sums.items():
            values[r] = single.sums[name][0]
    return batch
