"""Runs in slots: draw the messages, truth and readings of many slots, then simulate the filters.

A call of a kernel takes S slots of R runs, which are side by side in B blocks of L lanes
(linalg.lanes). Where channels or clocks are a user's own, or messages take time, Python makes the
messages of one run at a time (engines.compiled.slot_events).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.core.memory import ReusableMemory, keep_freed_memory
from netkf.engines.base import Progress
from netkf.engines.compiled.own_sensors import read_whitened
from netkf.engines.compiled.samples import record_samples
from netkf.engines.compiled.slot_events import SlotEvents
from netkf.engines.compiled.slot_filters import SlotFilters
from netkf.engines.compiled.slot_loop import WHOLE, SlotSamples
from netkf.engines.compiled.slot_messages import (
    Channels,
    Matchings,
    Rows,
    SlotMessages,
    SlotTimes,
    TracedNodes,
    count_events,
    draw_broadcasts,
    draw_matched,
    draw_uniforms,
    make_rows,
    mark_all_senders,
    mark_paired_senders,
)
from netkf.engines.compiled.slot_setup import BATCH_BYTES, AssignedSensor, SlotSetup, slot_setup
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, aligned, blocks_of, by_run, in_lanes, unset
from netkf.network.deliveries import Deliveries
from netkf.plants.slot_paths import Path, draw_paths, draw_readings, draw_starts
from netkf.rng.draws import states_in_lanes
from netkf.rng.numbers import normal_ziggurat
from netkf.rng.streams import WIDTH, ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import LONG, Recorder
from netkf.trace.run import StateSamples
from netkf.trace.schema import EVENT, KINDS

NEVER = np.iinfo(np.int64).max
_samples = ReusableMemory(BATCH_BYTES)


class SampledStates(NamedTuple):
    """T samples of R runs with H filters each, in the coordinates of the plant.

    x : (R, T, n), states of the plant
    xhat, error : (R, T, H, n), estimates and x - xhat
    P : (R, T, H, n, n)
    """

    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


class ReadingBlock(NamedTuple):
    """Whitened readings ``y = H x + v`` of S slots in B blocks of L runs; H filters have at most p
    rows each. A recorded sensor without a reading in a slot has rows of zeros, which change
    nothing.

    y : (B, S, H, p, L)
    H : (B, S, H, p, n, L), or (1, 1, H, p, n, L) if it is fixed
    rebased : flags (S,) of the slots in which the origin of coordinates moves
    """

    y: FloatArray
    H: FloatArray
    rebased: np.ndarray


class SlotBlock(NamedTuple):
    """Results of S slots of R runs: indices ``sampled`` (T,) of the slots with a sample, the
    ``samples`` of these slots or of all slots so far, the times of the slots, and their messages.
    """

    sampled: np.ndarray
    samples: SampledStates
    times: SlotTimes
    messages: SlotMessages


class SlotRuns:
    """R runs of one scenario, simulated side by side, some slots at a time. ``store_all``: keep the
    samples of all slots, for the results of a batch.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, store_all: bool = False
    ) -> None:
        """Set up R runs, one for each replica of ``streams``, at slot 0: filters, truth, readings
        and messages. ``store_all``: keep the samples of all slots in ``samples``.
        """
        self.setup: SlotSetup = slot_setup(scenario)
        self._scenario, self._streams = scenario, streams
        self._first = Streams(streams.seed, streams.replica)
        # One run, or the replicas of a batch.
        self.runs = 1 if isinstance(streams, Streams) else streams.count
        self._slot = 0
        setup, runs = self.setup, self.runs
        # A batch stores the samples of the whole runs, a single run those of a block at a time.
        self.samples = self._empty_samples(len(setup.samples)) if store_all else None
        self._blocks = blocks = blocks_of(runs)
        self._total = aligned((blocks, LANES))
        kernels = compiled_kernels(setup.algorithm, clocked=False)
        assert kernels is not None
        self._filters = SlotFilters(setup, kernels, blocks)
        arrays, never = self._filters.records.arrays, (blocks, setup.estimators, LANES)
        # NEVER: a slot that no run reaches, for a node that never stops.
        self._stopped = arrays.get("stopped", np.full(never, NEVER))
        self._conserved = arrays.get("conserved", aligned((blocks, setup.estimators, 2, LANES)))
        self._sent = np.zeros(len(setup.directions), dtype=np.int64)
        self.counts = np.zeros((runs, len(KINDS)), dtype=np.int64)
        self._begin_truth()
        self._begin_readings()
        self._events = None if setup.is_drawn else SlotEvents(scenario, self._first, setup)
        self._begin_messages()

    def _begin_truth(self) -> None:
        """Create what true states are drawn from, or load those of a plant without noise."""
        plant, setup = self._scenario.slot_plant, self.setup
        self._truth: Any = None
        self._path: Path | None = None
        # A recorded truth is the same in all runs.
        if not plant.is_random:
            self._truth = self._scenario.slot_truth(self._first)
            return
        self._plant_states = self._streams.states("plant", [()])
        x, origin = (aligned((self._blocks, setup.n, LANES)) for _ in range(2))
        # C-contiguous copies, whatever the plant gives: kernels are compiled for one memory layout.
        mean, F, root, noise = (
            np.array(part, order="C")
            for part in (plant.start_mean, plant.F, plant.start_root, plant.noise_root)
        )
        scratch = np.zeros((setup.n, LANES))
        draw_starts(MANY, self._plant_states, normal_ziggurat(), mean, root, scratch, x)
        self._path = Path(F, noise, setup.frame, x, origin)

    def _begin_readings(self) -> None:
        """Create what readings are drawn from: streams, regressors and recorded sensors."""
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

    def _begin_messages(self) -> None:
        """Create what messages are drawn from: channels, matchings and triggers."""
        setup, streams, links = self.setup, self._streams, len(self.setup.ends)
        # Empty arrays tell the kernels to draw nothing.
        no_streams = np.zeros((0, 0, LANES, WIDTH), dtype=np.uint64)
        is_drawn = setup.is_drawn and links > 0
        random_loss = is_drawn and not setup.loss.deterministic
        shape = self._blocks, len(setup.entities), LANES
        chain: Any = setup.loss if setup.is_chain else None
        to_bad, to_good = chain.transitions if chain is not None else (0.0, 1.0)
        entities = setup.entities
        draws_states = random_loss and setup.is_chain
        self._channels = Channels(
            ends=setup.ends,
            delivery=setup.delivery,
            loss_streams=self._in_lanes("loss", entities) if random_loss else no_streams,
            state_streams=self._in_lanes("weather", entities) if draws_states else no_streams,
            # -1: nothing drawn yet, and no channel state yet.
            loss_uniform=np.full(shape, -1.0),
            state_uniform=np.full(shape, -1.0),
            bad=np.full(shape, -1, dtype=np.int64),
            to_bad=to_bad,
            to_good=to_good,
            talks=setup.talks,
            directions_per_link=setup.directions_per_link,
            streams_per_link=setup.streams_per_link,
        )
        protocol, probability, first, members = setup.matching
        if setup.algorithm.timing.randomised:
            self._triggers = self._in_lanes("trigger", [(node,) for node in setup.nodes.tolist()])
        states = streams.states("matching", [()])
        order, busy = (np.zeros(size, dtype=np.int64) for size in (links, len(setup.nodes)))
        self._matchings = Matchings(protocol, probability, states, first, members, order, busy)

    def _in_lanes(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return the states (B, K, L, WIDTH) of the random streams of K entities in each run."""
        return states_in_lanes(self._streams.states(purpose, entities), self.runs)

    @property
    def over(self) -> bool:
        """Return True if all slots have been simulated."""
        return self._slot >= self.setup.slots

    def following(self, max_events: int, timed: bool = True) -> SlotBlock:
        """Simulate the next slots in all R runs, with about ``max_events`` events at most (0: no
        limit), and return their results: draw messages, true states and readings, then run the
        filters' kernel on them. ``timed``: compute the times of slots, which event rows need.
        """
        setup, self._max_events = self.setup, max_events
        times, messages = self._next_messages(max_events, timed)
        local, absolute, rebased = self._next_states(len(times.start))
        readings = self._draw_readings(times, local, rebased)
        sampled = np.flatnonzero(times.sample >= 0)
        samples = self.samples if self.samples is not None else self._empty_samples(len(sampled))
        # Kernels take flat entries for each sample. Explicit lengths, since reshape(-1) fails for
        # the empty arrays of a block without a sample.
        x, xhat, P, error = (
            part.reshape(*part.shape[:2], math.prod(part.shape[2:])) for part in samples
        )
        kernel_samples = SlotSamples(
            x, xhat, P, error, absolute, local, setup.frame > 0, self._total,
            *self._filters.sample_scratch, np.zeros(LANES, dtype=np.int64),
        )  # fmt: skip
        self._simulate(times, messages, readings, kernel_samples)
        return SlotBlock(sampled, samples, times, messages)

    def _simulate(
        self,
        times: SlotTimes,
        messages: SlotMessages,
        readings: ReadingBlock,
        samples: SlotSamples,
    ) -> None:
        """Simulate the slots of ``times``: write ``samples`` and who sends."""
        filters, count = self._filters, len(times.start)
        drawn: dict[str, Any] = {
            "first": self._slot,
            "sensed": times.sensed,
            "exchanged": times.exchanged,
            "sample": times.sample,
            "rebased": readings.rebased,
            "up": messages.up,
            "sent": messages.sent,
            "uniform": self._draw_uniforms(messages.sent),
        }
        unread, begin = self._missed_readings(messages, count), WHOLE

        def decided(step: int, up: np.ndarray) -> np.ndarray:
            """Return the nodes (N,) that send in a step, given ``up`` (E, W) of those before it."""
            nonlocal begin
            messages.up[0, 0, ..., 0] = up
            filters.simulate(readings.y, readings.H, samples, **drawn, begin=begin, stop=step)
            begin = step
            sent: np.ndarray = messages.sent[0, 0, step, :, 0] & ~unread[0, step]
            return sent

        # Filters decide who sends, and Python makes the messages: step by step.
        if self._events is not None and self.setup.decides:
            _, up = self._events.following(self._max_events, decided)
            messages.up[..., 0] = up
        filters.simulate(readings.y, readings.H, samples, **drawn, begin=begin, stop=WHOLE)
        if len(messages.sent):
            # Only now, since the kernel decides for all nodes that are asked, readings or not.
            messages.sent[:, unread] = 0
        self._slot += count

    def _next_messages(self, max_events: int, timed: bool) -> tuple[SlotTimes, SlotMessages]:
        """Return times and messages of the next slots, of one if filters decide in Python."""
        setup, events = self.setup, self._events
        if events is None:
            # The kernels draw the messages of many slots and runs at once.
            count = min(setup.block_slots(self.runs, max_events), setup.slots - self._slot)
            times = self._next_times(count, timed)
            return times, self._draw_messages(times)
        if setup.decides:
            # One slot at a time: the filters decide who sends before Python makes the messages.
            sent = events.asked()
            up = np.zeros((1, 1, len(sent), len(setup.directions)), dtype=np.uint8)
            return self._next_times(1, True), _pack_messages(up, sent[None, None])
        count, up = events.following(max_events, None)
        return self._next_times(count, True), _pack_messages(up, np.zeros((0,) * 4, dtype=np.uint8))

    def _empty_samples(self, count: int) -> SampledStates:
        """Return space for ``count`` samples of all R runs, in memory that is reused."""
        runs, estimators, n = self.runs, self.setup.estimators, self.setup.n
        filter_shape = runs, count, estimators, n
        shapes = (runs, count, n), filter_shape, (*filter_shape, n), filter_shape
        offsets = np.cumsum([math.prod(shape) for shape in shapes])
        # One allocation for all: numpy requests huge pages for large ones, which are cheap to get.
        arrays = np.split(_samples.array(int(offsets[-1])), offsets[:-1])
        return SampledStates(
            *(part.reshape(shape) for part, shape in zip(arrays, shapes, strict=True))
        )

    @property
    def broken(self) -> np.ndarray:
        """(R,) bool: runs with an estimate or covariance that is not finite (or their
        sum is not).
        """
        return np.asarray(~np.isfinite(by_run(self._total, self.runs)))

    def _next_times(self, count: int, timed: bool) -> SlotTimes:
        """Return what happens in the next ``count`` slots, and, if ``timed``, when they begin."""
        setup, algorithm, plant = self.setup, self.setup.algorithm, self._scenario.slot_plant
        slots = np.arange(self._slot, self._slot + count)
        recorded = slots < setup.last
        # At the horizon a filter that predicts is only sampled: its prediction is the result.
        active = recorded | (not algorithm.timing.predicts)
        # Filters that do not predict use no reading in slot 0: its sample is their initial state.
        sensed = active & ((slots > 0) | algorithm.timing.predicts)
        exchanged = active & (slots >= algorithm.timing.first_exchange) & algorithm.timing.talks
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
            first=self._slot,
            start=start,
            recorded=recorded,
            sensed=sensed,
            exchanged=exchanged,
            sample=sample,
            predicts=algorithm.timing.predicts,
        )

    def _draw_messages(self, times: SlotTimes) -> SlotMessages:
        """Draw which nodes exchange in the S slots of ``times``, and what arrives."""
        setup = self.setup
        shape, pairs = (len(times.start), len(setup.fresh)), setup.max_pairs
        decided = setup.decides or setup.may_miss
        # Without matchings the arrays of pairs stay empty.
        matched = self.runs if setup.matching[0] >= 0 else 0
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
        channels, exchanged, fresh = self._channels, times.exchanged, setup.fresh
        # Separate kernels, so that a run compiles only the one that it needs.
        if matched:
            draw_matched(MANY, channels, self._matchings, exchanged, fresh, *messages[:3])
        else:
            draw_broadcasts(MANY, channels, exchanged, fresh, messages.up)
        if decided and matched:
            mark_paired_senders(MANY, channels, messages.active, messages.pair_count, messages.sent)
        elif decided:
            mark_all_senders(MANY, channels, exchanged, messages.sent)
        # No chosen messages at all: the run as it was.
        if setup.deliveries is not None and setup.deliveries.chosen != frozenset():
            self._deliver_chosen(setup.deliveries, times, messages)
        return messages

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
        draw_uniforms(self._triggers, sent, uniform)
        return uniform

    def _next_states(self, count: int) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return local and absolute states (B, S, n, L), and (S,) where the origin moves."""
        setup = self.setup
        slots = range(self._slot, self._slot + count)
        rebased = np.zeros(count, dtype=bool)
        if self._path is None:
            x = np.stack([self._truth.state(slot) for slot in slots])
            # A recorded truth is the same in all runs.
            x = in_lanes(x, self._blocks)
            return x, x, rebased
        # At the end of a frame the origin moves to the state.
        if setup.frame:
            rebased = np.array([slot > 0 and slot % setup.frame == 0 for slot in slots])
        shape = self._blocks, count, setup.n, LANES
        local: FloatArray = unset(shape)
        # Without frames both are the same array.
        absolute: FloatArray = unset(shape) if setup.frame else local
        self._draw_path(self._path, self._plant_states, local, absolute)
        return local, absolute, rebased

    def _draw_path(
        self, path: Path, states: np.ndarray, local: FloatArray, absolute: FloatArray
    ) -> None:
        """Draw the next slots of a ``path`` into ``local`` and ``absolute`` (B, S, n, L)."""
        scratch = aligned((2, max(path.root.shape), LANES))
        draw_paths(MANY, path, states, normal_ziggurat(), self._slot, scratch, local, absolute)

    def _draw_readings(
        self, times: SlotTimes, local: FloatArray, rebased: np.ndarray
    ) -> ReadingBlock:
        """Draw the whitened readings of S slots at the states ``local`` (B, S, n, L)."""
        setup, count = self.setup, local.shape[1]
        shape = self._blocks, count, setup.estimators, setup.p
        y: FloatArray = unset((*shape, LANES))
        H: FloatArray = setup.H
        if setup.varies:
            H = unset((*shape, setup.n, LANES))
            H[:] = setup.H
        x = local
        if rebased.any() and setup.algorithm.timing.predicts:
            # The origin moves before the reading: the state in the new frame is 0.
            x = local.copy()
            x[:, rebased] = 0.0
        # The states from which sensors with a random H draw it.
        k = setup.sensors.C.shape[2]
        regressor_states: FloatArray = unset((len(self._regressors), self._blocks, count, k, LANES))
        for path, (steps, states) in zip(regressor_states, self._regressors, strict=True):
            self._draw_path(steps, states, path, path)
        noise, scratch = self._noise, np.zeros((setup.p, LANES))
        draw_readings(
            MANY, setup.sensors, noise, normal_ziggurat(), x, regressor_states, scratch, y, H
        )
        if not (self._recorded or self._own) or not times.sensed.any():
            return ReadingBlock(y, H, rebased)
        slots = (self._slot + np.flatnonzero(times.sensed)).tolist()
        for s, paths in self._own:
            rows = slice(s.row, s.row + s.rows)
            y[:, times.sensed, s.estimator, rows] = 0.0  # in lanes without a run
            for run, path in enumerate(paths):
                b, lane = divmod(run, LANES)
                own = read_whitened(path, slots, x[b, times.sensed, :, lane], s.R)
                for out, values in zip((y, H), own, strict=True):
                    out[b, times.sensed, s.estimator, rows, ..., lane] = values
        for s, path in self._recorded:
            rows = slice(s.row, s.row + s.rows)
            # L^-1 y and L^-1 H, with the R = L L' that filters believe; all runs read the same.
            whitened_y, whitened_H = path.whitened(slots, s.R, s.rows)
            y[:, times.sensed, s.estimator, rows] = whitened_y[..., None]
            H[:, times.sensed, s.estimator, rows] = whitened_H[..., None]
        return ReadingBlock(y, H, rebased)

    def events(self, block: SlotBlock) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows (K,) of the table of events, of dtype EVENT, of a block of slots of one
        run, and for each of the T samples in it the number of rows before it, (T,), with which a
        run ends that diverges there.
        """
        # Where Python made the messages it knows the events, but not in which slot nodes stopped.
        if self._events is not None:
            return self._events.rows(self._stopped[0, :, 0])
        before_sample = np.zeros(len(block.sampled), dtype=np.int64)
        return self._rows(block, 0, len(block.times.start), before_sample), before_sample

    def first_events(self, block: SlotBlock) -> Iterator[np.ndarray]:
        """Yield the rows (K,) of the table of events, of dtype EVENT, of the first run of a batch
        in a block of slots, for some slots at a time, so that their memory stays small: they are
        hashed for the fingerprint of the batch.
        """
        size = max(1, LONG // max(1, self.setup.rows_of(1)))
        # Samples of a batch are counted from the first of the run.
        before_sample = np.zeros(len(self.setup.samples), dtype=np.int64)
        count = len(block.times.start)
        for first in range(0, count, size):
            yield self._rows(block, first, min(first + size, count), before_sample)

    def _rows(
        self, block: SlotBlock, first: int, stop: int, before_sample: np.ndarray
    ) -> np.ndarray:
        """Return the events of the first run in some slots of a block, in the order of time."""
        setup = self.setup
        # Space for the largest number of rows.
        table = np.empty(setup.rows_of(stop - first), dtype=EVENT)
        # Kernels write the columns where the records have them.
        columns: Any = [table[name] for name in ROW_COLUMNS]
        count = make_rows(
            setup.stages, block.times, self._channels, self._traced_nodes(), block.messages,
            setup.algorithm.timing.pairwise, first, stop, Rows._make([*columns, before_sample]),
        )  # fmt: skip
        return table[:count]

    def count_events(self, block: SlotBlock) -> None:
        """Add the events of a block of slots to ``self.counts`` (R, KINDS), by run and kind, of all
        R runs.
        """
        setup = self.setup
        count_events(
            MANY, setup.stages, block.times, self._channels, self._traced_nodes(), block.messages,
            setup.algorithm.timing.pairwise, aligned((len(KINDS), LANES)), self.counts,
        )  # fmt: skip

    def _traced_nodes(self) -> TracedNodes:
        """Return the nodes and incoming links as arrays."""
        setup, links = self.setup, self.setup.links
        return TracedNodes(
            nodes=setup.nodes,
            sensing=setup.sensing,
            first=links.first,
            sender=links.sender,
            direction=links.direction,
            sent=self._sent,
            stopped=self._stopped,
        )

    def conserved(self) -> dict[str, FloatArray]:
        """Return by name the sums over all nodes that exchanges conserve, such as the total weight
        of push-sum: (R, 2), their values at the start and at the last sample of R runs.
        """
        conserved, sums = {}, by_run(self._conserved, self.runs)
        for k, (name, start) in enumerate(self.setup.conserved_at_start.items()):
            # fsum, so that the sums add no rounding of their own to that of the exchanges.
            now = [math.fsum(column) for column in sums[:, :, k].tolist()]
            conserved[name] = np.array([[start, value] for value in now])
        return conserved


def _pack_messages(up: np.ndarray, sent: np.ndarray) -> SlotMessages:
    """Return messages and senders of one run, which Python made, in lane 0."""
    lane_arrays = [np.zeros((*values.shape, LANES), dtype=np.uint8) for values in (up, sent)]
    for lanes, values in zip(lane_arrays, (up, sent), strict=True):
        lanes[..., 0] = values
    # The arrays of matched pairs stay empty: only kernels that draw messages use them.
    active, pairs = (np.zeros((0,) * d, dtype=np.int64) for d in (4, 3))
    return SlotMessages(up=lane_arrays[0], active=active, pair_count=pairs, sent=lane_arrays[1])


ROW_COLUMNS = ("t", "kind", "node", "peer", "message", "phase", "age")


def run_slots(scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress) -> str:
    """Simulate one run in slots up to the horizon, and pass its events and samples to ``recorder``;
    ``progress`` is called with the simulated seconds. Return "complete" or "diverged".
    """
    runs = SlotRuns(scenario, streams)
    recorder.exact_errors = scenario.exact_errors
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
    """Simulate the next slots of one run, and pass their events and samples to ``recorder``."""
    # A limited number of rows at a time: memory does not grow with the length of the run.
    block = runs.following(MAX_EVENT_ROWS)
    rows, rows_before = runs.events(block)
    if len(block.sampled):
        # Start and present value of each conserved sum.
        sums = runs.conserved()
        recorder.sums = {name: (float(v[0, 0]), float(v[0, 1])) for name, v in sums.items()}
    # One run: index 0 of all arrays.
    x, xhat, P, error = (values[0] for values in block.samples)
    times = block.times.start[block.sampled]

    def pass_rows_on(k: int) -> None:
        """Record the events before sample number ``k`` of the block, the first one that is not
        finite.
        """
        recorder.extend(rows[: rows_before[k]])

    samples = StateSamples(times, x, xhat, P, error)
    sound = record_samples(scenario, recorder, progress, samples, pass_rows_on)
    if sound:
        recorder.extend(rows)
    return sound


MAX_EVENT_ROWS = 1 << 15
"""Rows of events of a block of slots, about."""


def slot_batches(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
) -> Iterator[RunBatch]:
    """Yield the results of consecutive ``replicas`` in order, as many runs at a time as fit the
    memory, with random numbers from ``seed``; ``fingerprint``: with the hash of the events of the
    first run.
    """
    keep_freed_memory()
    setup = slot_setup(scenario)
    # As many runs side by side as fit the memory.
    size = setup.batch_runs()
    for first in range(replicas.start, replicas.stop, size):
        count = min(size, replicas.stop - first)
        with_fingerprint = fingerprint and first == replicas.start
        yield slot_batch(scenario, seed, range(first, first + count), with_fingerprint)


def slot_batch(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
) -> RunBatch:
    """Simulate R consecutive ``replicas`` (numbers of runs) side by side, with random numbers from
    ``seed``, and return their results. A run that diverges goes on to the end with invalid numbers,
    which ``with_ends`` replaces. ``fingerprint``: with the SHA-256 hash of the event rows of the
    first run.
    """
    runs = SlotRuns(scenario, ReplicaStreams(seed, replicas.start, len(replicas)), store_all=True)
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
    """Return the batch with every run that diverges replaced, in its arrays, by the same run
    simulated ``alone``: in a batch it went on with invalid numbers, alone it ends where it
    diverges, as its results demand.

    ``alone(replicas, fingerprint)`` simulates runs one by one and yields a batch of each;
    ``fingerprint``: with the SHA-256 hash of the event rows.
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
