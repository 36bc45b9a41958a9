"""Runs in slots: messages, truth and readings of many slots are drawn, then the filters follow.

A call of a kernel takes S slots of R runs at a time, which are side by side in B blocks of L lanes
(linalg.lanes). Where channels or clocks are a user's own, or messages take time, the messages of
one run are made in Python (engines.compiled.slot_events).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.slots import (
    ARRIVING,
    SENDING,
    WHOLE,
    ReadingBlock,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    slot_scratch,
)
from netkf.core.memory import LentMemory, keep_freed_memory
from netkf.engines.base import Progress
from netkf.engines.compiled.samples import record_samples
from netkf.engines.compiled.slot_events import SlotEvents
from netkf.engines.compiled.slot_messages import (
    Channels,
    Drawn,
    Hearing,
    Matchings,
    Rows,
    SlotTimes,
    ask_all,
    ask_pairs,
    count_events,
    draw_broadcasts,
    draw_matched,
    draw_uniforms,
    make_rows,
)
from netkf.engines.compiled.slot_setup import BATCH_BYTES, AssignedSensor, SlotSetup, slot_setup
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, aligned, blocks_of, by_run, in_lanes, unset
from netkf.linalg.portable import solve_lower
from netkf.network.graphs import Link
from netkf.plants.slot_paths import Path, draw_paths, draw_readings, draw_starts
from netkf.rng.draws import StreamBatch
from netkf.rng.numbers import normal_ziggurat
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import LONG, Recorder
from netkf.trace.run import StateSamples
from netkf.trace.schema import EVENT, KINDS

NEVER = np.iinfo(np.int64).max
_samples = LentMemory(BATCH_BYTES)


class SampledStates(NamedTuple):
    """Samples of R runs in the coordinates of the plant.

    x : (R, T, n)
    xhat, error : (R, T, H, n)
    P : (R, T, H, n, n)
    """

    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


class SlotBlock(NamedTuple):
    """Results of S slots of R runs: the slots that are ``sampled`` (T,), and what was ``reported``
    there.
    """

    sampled: np.ndarray
    reported: SampledStates
    times: SlotTimes
    drawn: Drawn


class SlotRuns:
    """R runs of one scenario, side by side."""

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, whole: bool = False
    ) -> None:
        self.setup: SlotSetup = slot_setup(scenario)
        self._scenario, self._streams = scenario, streams
        self._first = Streams(streams.seed, streams.replica)
        # One run, or the replicas of a batch.
        self.runs = 1 if isinstance(streams, Streams) else streams.count
        self._slot = 0
        setup, runs = self.setup, self.runs
        # Samples of the whole runs if so many are wanted at once, else those of a block.
        self.reported = self._empty_samples(len(setup.samples)) if whole else None
        self._blocks = blocks = blocks_of(runs)
        self._total = aligned((blocks, LANES))
        self._nodes = SlotNodes(
            in_lanes(setup.xhat, blocks),
            in_lanes(setup.root, blocks),
            setup.F,
            setup.root_Q,
            setup.rows,
        )
        self._room = slot_scratch(setup.estimators, setup.n)
        self._extra = setup.algorithm.slot_arrays(setup.states, setup.infos, runs)
        # No slot reaches it: a node that never stops.
        self._stopped = np.full((blocks, setup.estimators, LANES), NEVER)
        self._conserved = aligned((blocks, setup.estimators, 2, LANES))
        self._sent = np.zeros(len(setup.directions), dtype=np.int64)
        self.counts = np.zeros((runs, len(KINDS)), dtype=np.int64)
        self._begin_truth()
        self._begin_readings()
        self._events = None if setup.is_drawn else SlotEvents(scenario, self._first, setup)
        self._begin_messages()

    def _begin_truth(self) -> None:
        """Draw the first states of all runs, or make the recorded truth."""
        plant, setup = self._scenario.slot_plant, self.setup
        self._truth: Any = None
        self._path: Path | None = None
        # A recorded truth is the same in all runs.
        if not plant.is_random:
            self._truth = self._scenario.slot_truth(self._first)
            return
        self._plant_states = StreamBatch(self._streams, "plant", [()]).states
        x, origin = (aligned((self._blocks, setup.n, LANES)) for _ in range(2))
        # Arrays of one kind, whatever the plant, for which kernels are compiled once.
        mean, F, root, noise = (
            np.array(part, order="C")
            for part in (plant.start_mean, plant.F, plant.start_root, plant.noise_root)
        )
        scratch = np.zeros((setup.n, LANES))
        draw_starts(MANY, self._plant_states, normal_ziggurat(), mean, root, scratch, x)
        self._path = Path(F, noise, setup.frame, x, origin)

    def _begin_readings(self) -> None:
        """Make the random streams and paths from which readings are drawn."""
        setup, streams = self.setup, self._streams
        entities = [(s.node, s.placed_sensor.ordinal) for s in setup.drawn]
        # One stream for each drawn sensor of each run.
        self._noise = StreamBatch(streams, "noise", entities).states
        self._regressors: list[tuple[Path, np.ndarray]] = []
        for s, (A, drive, start) in zip(setup.driven, setup.regressors, strict=True):
            x = in_lanes(start, self._blocks)
            # No frame: regressors do not grow as an unstable plant does.
            path = Path(A, drive, 0, x, np.zeros(x.shape))
            states = StreamBatch(streams, "regressor", [(s.node, s.placed_sensor.ordinal)]).states
            self._regressors.append((path, states))
        scenario, first = self._scenario, self._first
        self._recorded: list[tuple[AssignedSensor, Any]] = [
            (s, scenario.slot_path(first, s.node, s.placed_sensor)) for s in setup.recorded
        ]

    def _begin_messages(self) -> None:
        """Make the channels and matchings of all runs, and their random streams."""
        setup, streams, links = self.setup, self._streams, len(self.setup.ends)
        # Empty arrays tell the kernels to draw nothing.
        nothing = np.zeros((0, 0, 4, LANES), dtype=np.uint64)
        drawn = setup.is_drawn and links > 0
        loss = drawn and not setup.loss.deterministic
        shape = self._blocks, len(setup.entities), LANES
        chain: Any = setup.loss if setup.is_chain else None
        to_bad, to_good = chain.transitions if chain is not None else (0.0, 1.0)
        entities = setup.entities
        self._channels = Channels(
            setup.ends,
            setup.delivery,
            self._in_lanes("loss", entities) if loss else nothing,
            self._in_lanes("weather", entities) if loss and setup.is_chain else nothing,
            # -1 marks numbers that are not drawn yet and states without a past.
            np.full(shape, -1.0),
            np.full(shape, -1.0),
            np.full(shape, -1, dtype=np.int64),
            to_bad,
            to_good,
            setup.talks,
            setup.directions_per_link,
            setup.streams,
        )
        protocol, probability, first, members = setup.matching
        # numpy's generator keeps half a 64-bit draw for small integers: two words more than the
        # state.
        states = np.zeros((self.runs, 6), dtype=np.uint64)
        if drawn and protocol >= 0:
            states[:, :4] = StreamBatch(streams, "matching", [()]).states
        if setup.algorithm.randomised:
            nodes = StreamBatch(streams, "trigger", [(node,) for node in setup.nodes.tolist()])
            self._triggers = nodes.in_lanes(self.runs)
        order, busy = (np.zeros(size, dtype=np.int64) for size in (links, len(setup.nodes)))
        self._matchings = Matchings(protocol, probability, states, first, members, order, busy)

    def _in_lanes(self, purpose: str, entities: list[Link]) -> np.ndarray:
        """Return the states (B, K, 4, L) of the random streams of K entities in each run."""
        return StreamBatch(self._streams, purpose, entities).in_lanes(self.runs)

    @property
    def over(self) -> bool:
        """Return True if all slots are done."""
        return self._slot >= self.setup.slots

    def following(self, rows: int, timed: bool = True) -> SlotBlock:
        """Simulate the next slots, about ``rows`` events at most (0: any number); events need slots
        that are ``timed``.
        """
        setup = self.setup
        times, drawn = self._next_messages(rows, timed)
        local, absolute, rebased = self._next_states(len(times.start))
        readings = self._draw_readings(times, local, rebased)
        sampled = np.flatnonzero(times.sample >= 0)
        reported = self.reported if self.reported is not None else self._empty_samples(len(sampled))
        # Blocks without a sample have empty arrays, of which reshape cannot tell the last length.
        x, xhat, P, error = (
            part.reshape(*part.shape[:2], math.prod(part.shape[2:])) for part in reported
        )
        samples = SlotSamples(
            x, xhat, P, error, self._stopped, self._conserved, absolute, local, setup.frame > 0,
            self._total,
        )  # fmt: skip
        plan = SlotPlan(
            self._slot, times.sensed, times.exchanged, times.sample, drawn.up, drawn.sent,
            self._draw_uniforms(drawn.sent), WHOLE,
        )  # fmt: skip
        count, algorithm = len(times.start), setup.algorithm
        extra = algorithm.slot_gains(setup.states, self._extra, self._slot, count)
        given, kernel = (setup.links, samples, self._room, *extra), algorithm.slot_kernel
        unread = self._missed_readings(drawn, count)
        if self._events is not None and setup.decides:
            kernel(self._nodes, readings, plan._replace(part=SENDING), *given)
            drawn.sent[:, unread] = 0
            _, up = self._events.following(rows, drawn.sent[0, 0, :, :, 0])
            drawn.up[..., 0], plan = up, plan._replace(part=ARRIVING)
        kernel(self._nodes, readings, plan, *given)
        if len(drawn.sent):
            # Only now: filters decide for all nodes that are asked.
            drawn.sent[:, unread] = 0
        self._slot += count
        return SlotBlock(sampled, reported, times, drawn)

    def _next_messages(self, rows: int, timed: bool) -> tuple[SlotTimes, Drawn]:
        """Return the next slots, up to about ``rows`` events, and their messages."""
        setup, events = self.setup, self._events
        if events is None:
            # The kernels draw the messages of many slots and runs at once.
            count = min(setup.block_slots(self.runs, rows), setup.slots - self._slot)
            times = self._next_times(count, timed)
            return times, self._draw_messages(times)
        if setup.decides:
            # One slot, and the filters say who sends before Python makes the messages.
            sent = events.asked()
            up = np.zeros((1, 1, len(sent), len(setup.directions)), dtype=np.uint8)
            return self._next_times(1, True), _pack_messages(up, sent[None, None])
        # As many slots as gave about so many rows.
        count, up = events.following(rows, None)
        return self._next_times(count, True), _pack_messages(up, np.zeros((0,) * 4, dtype=np.uint8))

    def _empty_samples(self, count: int) -> SampledStates:
        """Return empty arrays for ``count`` samples."""
        runs, estimators, n = self.runs, self.setup.estimators, self.setup.n
        shape = runs, count, estimators, n
        shapes = (runs, count, n), shape, (*shape, n), shape
        ends = np.cumsum([math.prod(each) for each in shapes])
        # One piece of memory: numpy asks for huge pages for large ones, which cost little to get.
        parts = np.split(_samples.array(int(ends[-1])), ends[:-1])
        return SampledStates(
            *(part.reshape(each) for part, each in zip(parts, shapes, strict=True))
        )

    @property
    def broken(self) -> np.ndarray:
        """(R,) bool: runs whose estimates or covariances have grown beyond all numbers, or whose
        sum has.
        """
        return np.asarray(~np.isfinite(by_run(self._total, self.runs)))

    def _next_times(self, count: int, wanted: bool) -> SlotTimes:
        """Return flags, samples and, if ``wanted``, start times of the next ``count`` slots."""
        setup, algorithm, plant = self.setup, self.setup.algorithm, self._scenario.slot_plant
        slots = np.arange(self._slot, self._slot + count)
        noted = slots < setup.last
        # At the horizon a filter that predicts shows what it predicted, and does nothing else.
        acts = noted | (not algorithm.predicts)
        # Filters that do not predict begin with their start, before any reading.
        sensed = acts & ((slots > 0) | algorithm.predicts)
        exchanged = acts & (slots >= algorithm.first_slot) & algorithm.talks
        sample = np.full(count, -1, dtype=np.int64)
        first, last = np.searchsorted(setup.samples, (self._slot, self._slot + count))
        # Counted from the first sample of the run, or of these slots.
        here = np.arange(first, last) - (first if self.reported is None else 0)
        sample[setup.samples[first:last] - self._slot] = here
        start = np.zeros(count)
        # Times are computed only if rows are wanted: a batch has none.
        if wanted:
            start = np.array([plant.slot_time(slot) for slot in slots.tolist()])
        return SlotTimes(self._slot, start, noted, sensed, exchanged, sample, algorithm.predicts)

    def _draw_messages(self, times: SlotTimes) -> Drawn:
        """Return the pairs and messages of a block of slots, drawn for all runs."""
        setup = self.setup
        steps, pairs = (len(times.start), len(setup.fresh)), setup.most_pairs
        masked = setup.decides or setup.may_miss
        # Without matchings nobody looks at pairs.
        matched = self.runs if setup.matching[0] >= 0 else 0
        drawn = Drawn(
            np.zeros((self._blocks, *steps, len(setup.directions), LANES), dtype=np.uint8),
            np.empty((matched, *steps, pairs), dtype=np.int64),
            np.zeros((matched, *steps), dtype=np.int64),
            np.zeros(
                (self._blocks, *steps, len(setup.nodes), LANES) if masked else (0,) * 5,
                dtype=np.uint8,
            ),
        )
        if not len(setup.directions):
            return drawn
        channels, exchanged, fresh = self._channels, times.exchanged, setup.fresh
        # Two kernels: a run compiles only the one that it needs.
        if matched:
            draw_matched(MANY, channels, self._matchings, exchanged, fresh, *drawn[:3])
        else:
            draw_broadcasts(MANY, channels, exchanged, fresh, drawn.up)
        if masked and matched:
            ask_pairs(MANY, channels, drawn.active, drawn.pairs, drawn.sent)
        elif masked:
            ask_all(MANY, channels, exchanged, drawn.sent)
        return drawn

    def _missed_readings(self, drawn: Drawn, count: int) -> np.ndarray:
        """Take the messages of nodes that have no reading to send in the next slots out of ``up``;
        return who they are, (S, E, N).
        """
        setup = self.setup
        if not setup.may_miss:
            return np.zeros((count, len(setup.fresh), len(setup.nodes)), dtype=bool)
        unread = setup.unread(self._slot, count)
        senders = setup.ends[:, : setup.directions_per_link].reshape(-1)
        drawn.up[:, unread[:, :, senders]] = 0
        return unread

    def _draw_uniforms(self, sent: np.ndarray) -> FloatArray:
        """Return uniform numbers (B, S, E, N, L) of the nodes that are asked, empty if the filter
        needs none.
        """
        if not self.setup.algorithm.randomised or not self.setup.decides:
            return np.zeros((0,) * 5)
        uniform = np.zeros(sent.shape)
        draw_uniforms(self._triggers, sent, uniform)
        return uniform

    def _next_states(self, count: int) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return local and absolute states (B, S, n, L) of the next slots, and where the origin
        moves (S,).
        """
        setup = self.setup
        slots = range(self._slot, self._slot + count)
        rebased = np.zeros(count, dtype=bool)
        if self._path is None:
            x = np.stack([self._truth.state(slot) for slot in slots])
            # One truth for all runs.
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
        """Draw a block of a path into ``local`` and ``absolute`` (B, S, n, L)."""
        scratch = aligned((2, max(path.root.shape), LANES))
        draw_paths(MANY, path, states, normal_ziggurat(), self._slot, scratch, local, absolute)

    def _draw_readings(
        self, times: SlotTimes, local: FloatArray, rebased: np.ndarray
    ) -> ReadingBlock:
        """Return the readings of a block of slots at the states ``local`` (B, S, n, L)."""
        setup, count = self.setup, local.shape[1]
        shape = self._blocks, count, setup.estimators, setup.p
        y: FloatArray = unset((*shape, LANES))
        H: FloatArray = setup.H
        if setup.varies:
            H = unset((*shape, setup.n, LANES))
            H[:] = setup.H
        x = local
        if rebased.any() and setup.algorithm.predicts:  # read in the frame that begins there
            x = local.copy()
            x[:, rebased] = 0.0
        k = setup.sensors.C.shape[2]
        driven: FloatArray = unset((len(self._regressors), self._blocks, count, k, LANES))
        for path, (steps, states) in zip(driven, self._regressors, strict=True):
            self._draw_path(steps, states, path, path)
        noise, scratch = self._noise, np.zeros((setup.p, LANES))
        draw_readings(MANY, setup.sensors, noise, normal_ziggurat(), x, driven, scratch, y, H)
        if not self._recorded or not times.sensed.any():
            return ReadingBlock(y, H, local, rebased)
        slots = (self._slot + np.flatnonzero(times.sensed)).tolist()
        for s, path in self._recorded:
            some = slice(s.row, s.row + len(s.root))
            values, matrices = path.several(slots, x[0, times.sensed, :, 0])
            # Whitened with the R that filters believe; all runs read the same.
            white = solve_lower(s.root, values.T).T, solve_lower(s.root, matrices)
            y[:, times.sensed, s.estimator, some] = white[0][..., None]
            H[:, times.sensed, s.estimator, some] = white[1][..., None]
        return ReadingBlock(y, H, local, rebased)

    def events(self, block: SlotBlock) -> tuple[np.ndarray, np.ndarray]:
        """Return the EVENT rows of a block of one run, and the number before each sample."""
        if self._events is not None:
            return self._events.rows(self._stopped[0, :, 0])
        at_sample = np.zeros(len(block.sampled), dtype=np.int64)
        return self._rows(block, 0, len(block.times.start), at_sample), at_sample

    def first_events(self, block: SlotBlock) -> Iterator[np.ndarray]:
        """Yield the EVENT rows of the first run of a batch, of some slots at a time."""
        size = max(1, LONG // max(1, self.setup.rows_of(1)))
        # Samples of a batch are counted from the first of the run.
        at_sample = np.zeros(len(self.setup.samples), dtype=np.int64)
        count = len(block.times.start)
        for first in range(0, count, size):
            yield self._rows(block, first, min(first + size, count), at_sample)

    def _rows(self, block: SlotBlock, first: int, stop: int, at_sample: np.ndarray) -> np.ndarray:
        """Return the EVENT rows of the first run in the slots ``first`` to ``stop`` of a block;
        write the number of rows before each sample into ``at_sample`` (T,).
        """
        setup = self.setup
        # Space for the largest number of rows.
        table = np.empty(setup.rows_of(stop - first), dtype=EVENT)
        # Kernels write the columns where the records have them.
        columns: Any = [table[name] for name in ROW_COLUMNS]
        count = make_rows(
            setup.stages, block.times, self._channels, self._make_hearing(), block.drawn,
            setup.algorithm.pairwise, first, stop, Rows._make([*columns, at_sample]),
        )  # fmt: skip
        return table[:count]

    def count_events(self, block: SlotBlock) -> None:
        """Add the events of a block to ``counts``."""
        setup = self.setup
        count_events(
            MANY, setup.stages, block.times, self._channels, self._make_hearing(), block.drawn,
            setup.algorithm.pairwise, aligned((len(KINDS), LANES)), self.counts,
        )  # fmt: skip

    def _make_hearing(self) -> Hearing:
        """Return the links and nodes as the kernels of messages need them."""
        setup, heard = self.setup, self.setup.links
        return Hearing(
            setup.nodes, setup.sensing, heard.first, heard.sender, heard.direction, self._sent,
            self._stopped,
        )  # fmt: skip

    def conserved(self) -> dict[str, FloatArray]:
        """Return the sums over all nodes that exchanges conserve, (R, 2) at the start and the last
        sample.
        """
        given: list[Any] = [self.setup.algorithm.conserved(s) for s in self.setup.states]
        found, sums = {}, by_run(self._conserved, self.runs)
        for k, name in enumerate(given[0]):
            # fsum: the check is of the exchanges, and not of its own rounding.
            start = math.fsum(np.concatenate([np.atleast_1d(values[name]) for values in given]))
            now = [math.fsum(column) for column in sums[:, :, k].tolist()]
            found[name] = np.array([[start, value] for value in now])
        return found


def _pack_messages(up: np.ndarray, sent: np.ndarray) -> Drawn:
    """Return the messages (1, S, E, W) of one run, which Python made, and who sends, as kernels
    need them.
    """
    wide = [np.zeros((*part.shape, LANES), dtype=np.uint8) for part in (up, sent)]
    for lanes, part in zip(wide, (up, sent), strict=True):
        lanes[..., 0] = part
    active, pairs = (np.zeros((0,) * d, dtype=np.int64) for d in (4, 3))
    return Drawn(wide[0], active, pairs, wide[1])


ROW_COLUMNS = ("t", "kind", "node", "peer", "message", "phase", "age")


def run_slots(scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress) -> str:
    """Simulate one run in slots up to the horizon; return complete or diverged."""
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
    """Simulate and record some slots; return True if all estimates are sound."""
    # A block of about so many rows: memory does not grow with the run.
    block = runs.following(MAX_EVENT_ROWS)
    rows, before = runs.events(block)
    if len(block.sampled):
        sums = runs.conserved()
        recorder.sums = {name: (float(v[0, 0]), float(v[0, 1])) for name, v in sums.items()}
    x, xhat, P, error = (part[0] for part in block.reported)
    times = block.times.start[block.sampled]

    def pass_rows_on(k: int) -> None:
        """Pass on the rows up to sample ``k``, the first one that is not finite."""
        # The rows up to the first broken sample, if there is one.
        recorder.extend(rows[: before[k]])

    samples = StateSamples(times, x, xhat, P, error)
    fine = record_samples(scenario, recorder, progress, samples, pass_rows_on)
    if fine:
        recorder.extend(rows)
    return fine


MAX_EVENT_ROWS = 1 << 15
"""Rows of events that are made at once."""


def slot_batches(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
) -> Iterator[RunBatch]:
    """Yield the runs of consecutive replicas in order, the first with its ``fingerprint``."""
    keep_freed_memory()
    setup = slot_setup(scenario)
    # As many runs side by side as fit the memory.
    size = setup.batch_runs()
    for first in range(replicas.start, replicas.stop, size):
        count = min(size, replicas.stop - first)
        recorded = fingerprint and first == replicas.start
        yield slot_batch(scenario, seed, range(first, first + count), recorded)


def slot_batch(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
) -> RunBatch:
    """Simulate consecutive replicas side by side; a run that diverges goes on to the end with
    invalid numbers, which ``with_ends`` replaces.
    """
    runs = SlotRuns(scenario, ReplicaStreams(seed, replicas.start, len(replicas)), whole=True)
    assert runs.reported is not None
    # That of trace.recorder: the rows of one run only pass by.
    passed = hashlib.sha256()
    while not runs.over:
        with np.errstate(over="ignore", invalid="ignore"):
            block = runs.following(0, timed=fingerprint)
        runs.count_events(block)
        for rows in runs.first_events(block) if fingerprint else ():
            passed.update(rows.data)
    x, xhat, P, error = runs.reported
    return RunBatch(
        replicas=replicas,
        times=runs.setup.sample_times,
        x=x,
        xhat=xhat,
        P=P,
        error=error,
        lengths=np.full(len(replicas), x.shape[1]),
        counts=runs.counts,
        status=np.where(runs.broken, DIVERGED, COMPLETE),
        sums=runs.conserved(),
        exact_errors=scenario.exact_errors,
        fingerprint=passed.hexdigest() if fingerprint else "",
    )


def with_ends(batch: RunBatch, alone: Callable[[range, bool], Iterator[RunBatch]]) -> RunBatch:
    """Return the batch in which every run that diverges is replaced by the same run ``alone``, up
    to its end; that takes replicas and whether their fingerprint is wanted.
    """
    # A run that diverges goes on in a batch; its true end is that of the run alone.
    for r in np.flatnonzero(batch.diverged).tolist():
        fingerprint = r == 0 and bool(batch.fingerprint)
        (one,) = alone(batch.replicas[r : r + 1], fingerprint)
        if fingerprint:
            batch = replace(batch, fingerprint=one.fingerprint)
        for name in ("x", "xhat", "P", "error", "lengths", "counts", "status"):
            getattr(batch, name)[r] = getattr(one, name)[0]
        for name, values in batch.sums.items():
            values[r] = one.sums[name][0]
    return batch
