"""One run in continuous time: Python draws the random numbers, the compiled event loop simulates.

Python draws ticks, outcomes, the path and the noise in blocks, from the streams that the SimPy
engine uses. The loop handles events one by one, and stops when it needs the next block or space.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.kernels.root_flow import FlowScratch
from netkf.algorithms.traits import CLOCKS
from netkf.core.interrupts import defer_signals
from netkf.engines.base import Progress
from netkf.engines.compiled.agenda import is_immediate, simulate_single_run
from netkf.engines.compiled.clock_filters import ClockFilters
from netkf.engines.compiled.draws import Noise, Paths, blocks_at_once, no_path, no_sensing
from netkf.engines.compiled.events import (
    DONE,
    WANT_LIFE,
    WANT_MESSAGES,
    WANT_PAST,
    WANT_REBASE,
    WANT_ROWS,
    WANT_STEPS,
    WANT_TICKS,
)
from netkf.engines.compiled.lane_series import series_of_lanes
from netkf.engines.compiled.life_tables import LifeTable, life_table, remove_samples
from netkf.engines.compiled.pair_exchange import pair_exchange
from netkf.engines.compiled.quantiser import PayloadQuantiser, dither_of
from netkf.engines.compiled.sample_tables import samples_of
from netkf.engines.compiled.samples import by_node, entries_of, record_samples
from netkf.engines.compiled.senders import senders_of
from netkf.engines.compiled.state import (
    Instants,
    PathBlock,
    SampleBuffer,
    Scratch,
    Sensing,
    Simulation,
    TickArrays,
    add_messages,
    empty_pool,
    entity_records,
    filters_at_start,
    scratch_arrays,
)
from netkf.engines.compiled.ticks import Schedule
from netkf.engines.compiled.truth import PathStates
from netkf.engines.compiled.visits import Visits, empty_visits
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.lanes import with_spare
from netkf.linalg.structs import sized
from netkf.network.node_clocks import NodeTime, node_times
from netkf.plants.driven import DrivenTruth
from netkf.plants.paths import BLOCK
from netkf.rng.streams import Streams
from netkf.scenario.sampling import uses_grid
from netkf.scenario.scenario import Scenario
from netkf.trace import recorder as recording
from netkf.trace import schema
from netkf.trace.recorder import Recorder
from netkf.trace.run import StateSamples
from netkf.trace.schema import EVENT

# Entries at the start of a run: the pool of messages, and event rows.
FIRST_MESSAGES, FIRST_ROWS = 64, 4096
# Most samples in the buffer of a run, and most float64 in their covariances together.
MAX_BUFFERED_SAMPLES, MAX_BUFFERED_FLOATS = 256, 1 << 18
AT_START = (
    *("run", "first_run", "first_delay", "frame_at", "piece", "grid_at", "wake_at", "instant_at"),
    *("life_at", "tick_at", "link_at", "probe_at", "row", "first_free", "in_flight", "order"),
    *("receivers", "absorbing", "clipped", "samples"),
)
"""Integer fields of a Simulation that are 0 when a run begins."""


class Draws(Protocol):
    """The random numbers of a run, or of several that are simulated together.

    sensing, instants : increments and samples of sensors
    states : the true states, a PathStates or the like
    clocks : what the clocks of nodes show, by index; {} if all are right
    """

    sensing: Sensing
    instants: Instants
    states: Any
    clocks: dict[int, NodeTime]

    @property
    def lives(self) -> LifeTable:
        """When nodes are down."""

    @property
    def dither(self) -> np.ndarray | None:
        """Streams of the dither of messages of few bits; None if messages are exact."""

    def window(self) -> TickArrays:
        """Return the next window of ticks."""

    def path(self, together: int = 1) -> PathBlock:
        """Return the next steps of the paths of so many runs."""


class Source:
    """The random numbers of a run that is simulated alone. The path is drawn block by block on the
    sensing grid, with the samples on it; without a grid (no sensor reads increments) the states at
    all samples are drawn at once. ``states`` is a PathStates, or a truth of ``plants.truth``.
    """

    states: Any

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        self._samples = samples = samples_of(scenario, streams)
        self._sampled = sampled = samples.sampled
        self.instants = samples.instants
        self._grid = uses_grid(scenario)
        self._read_until, no_block = -math.inf, no_path(scenario.plant.n)
        if self._grid:
            blocks = blocks_at_once(scenario)
            self._noise = Noise(scenario, streams, blocks * BLOCK)
            self.sensing = self._noise.sensing
            # Cut the path where a state is sampled: it is drawn there from its own stream.
            self._paths = Paths(scenario, streams, blocks, sampled)
            self.states = PathStates(scenario, self._paths.frame_times, no_block)
        else:
            self.sensing, self._no_block = no_sensing(scenario), no_block
            self.states = scenario.continuous_truth(streams, sampled=sampled)
            # The truth is complete, so that all samples are read at once.
            states = self.states
            # Where an input moves the plant takes longer to tell.
            is_driven = isinstance(states, DrivenTruth)
            x = states.local_states(sampled) if is_driven else states.states(sampled)[0]
            samples.read(x, sampled, -math.inf, math.inf)
        self.lives = life_table(scenario, streams)
        if not self.lives.in_nodes:
            remove_samples(samples.instants, self.lives, scenario.topology.index)
        index = scenario.topology.index
        self.clocks = {index[i]: c for i, c in node_times(scenario, streams).items()}
        known = {"instants": samples.instants, "truth": self.states, "lives": self.lives}
        self._ticks = Schedule(scenario, streams, **known)
        self.dither = dither_of(scenario, streams)

    def window(self) -> TickArrays:
        """Return the next window of ticks."""
        return self._ticks.following()

    def path(self, together: int = 1) -> PathBlock:
        """Return the next steps of the path; without a sensing grid one piece for the whole run."""
        if not self._grid:
            return self._no_block
        # Noise and path advance together, a block of steps at a time.
        block = self._paths.following()
        self._noise.following(len(block.ends))
        path = self._paths.block(block, together)
        self.states.path = path
        # Samples in (read_until, end]: a time at the border of two blocks is read once.
        first, last = np.searchsorted(self._sampled, [self._read_until, path.end], side="right")
        if first < last:
            times = self._sampled[first:last]
            self._samples.read(self.states.local(times)[0], times, self._read_until, path.end)
        self._read_until = path.end
        return path


class Workspace:
    """The tables of a scenario and the arrays of a run, reused for one run after another."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario, self._senders = scenario, senders_of(scenario)
        self.filters = filters_at_start(scenario)
        self._entities, directions = entity_records(scenario)
        # A copy, since directed links count the messages of a run.
        self._directions = directions.copy()
        # By receiver and sender: the order in which filters add up messages.
        order = np.lexsort((directions["sender"], directions["receiver"]))
        self._incoming = np.argsort(order, kind="stable")
        self._waiting = np.zeros(len(self.filters.nodes), dtype=np.int64)
        size, n = self.filters.xhat.shape
        self._pool, self._heap = empty_pool(FIRST_MESSAGES)
        self._probes = np.array(scenario.times, dtype=np.float64)
        # Space for many samples, within a budget of floats.
        samples = max(1, min(MAX_BUFFERED_SAMPLES, MAX_BUFFERED_FLOATS // (size * n * n)))
        self._buffer = empty_samples((1, samples, size, n))
        self._visits: Visits | None = None
        self._scratch: tuple[Scratch, FlowScratch] | None = None
        kernels = compiled_kernels(scenario.node_filter, clocked=True)
        assert kernels is not None
        self._kernels = kernels
        self.clocked: ClockFilters | None = None
        if not is_immediate(scenario):
            self.clocked = ClockFilters(scenario, kernels, self.filters, FIRST_MESSAGES)
        self._quantiser = self.clocked.quantiser if self.clocked else PayloadQuantiser()
        # The event loop is compiled once for all n: its verbs alone have loops over the states.
        self._unrolled = kernels.unrolled and self.clocked is None

    def visits(self, together: int = 1) -> Visits:
        """Return an empty queue of visits, with space for all nodes of ``together`` runs."""
        capacity = together * len(self.filters.nodes)
        if self._visits is None or len(self._visits.level) < capacity:
            series, weights = series_of_lanes(self._scenario), self._directions["weight"]
            exchange = pair_exchange(self._scenario, self._kernels, weights)
            self._visits = empty_visits(self.filters, weights, capacity, series, exchange)
        return self._visits

    def _begin_estimates(self, instants: Instants, together: int) -> tuple[FloatArray, FloatArray]:
        if self.clocked is not None:
            self.clocked.begin(instants)
            return self.clocked.estimates
        nodes, n = self.filters.xhat.shape
        xhat, root = with_spare((together * nodes, n)), with_spare((together * nodes, n, n))
        xhat[:] = np.tile(self.filters.xhat, (together, 1))
        root[:] = np.tile(self.filters.root, (together, 1, 1))
        return xhat, root

    def begin(
        self, draws: Draws, traced: bool, buffer: SampleBuffer | None = None, together: int = 1
    ) -> Simulation:
        """Return the state at time 0 of ``together`` runs with the random numbers of ``draws``, a
        Source or ``batches.BatchDraws``, which write samples into ``buffer`` (None: the workspace's
        own), and rows if ``traced``.
        """
        start, instants, window = self.filters, draws.instants, draws.window()
        changes = np.array(self._scenario.followed_changes)
        # Records of links belong to the workspace: the numbers of their messages start again.
        self._directions["messages"] = 0
        # All messages are free: a linked list in the order of the pool.
        self._pool["next"] = np.arange(1, len(self._pool) + 1)
        if self._scratch is None:
            self._scratch = scratch_arrays(
                start.table, start.gains, self._unrolled, self._scenario.plant.n
            )
        scratch, flow_arrays = self._scratch
        nodes, n = self._begin_nodes(draws), start.xhat.shape[1]
        xhat, root = self._begin_estimates(instants, together)
        state: Simulation = (Simulation.of_size(n) if self._unrolled else Simulation)(
            size=sized(n) if self._unrolled else np.zeros(n),
            plant=sized(n) if self._unrolled else np.zeros(self._scenario.plant.n),
            nodes=nodes,
            xhat=xhat,
            root=root,
            now=self._scenario.time_grid.snap(np.resize(nodes["offset"], len(xhat))),
            table=start.table,
            gains=start.gains,
            entities=self._entities,
            outgoing=self._senders.outgoing,
            directions=self._directions,
            incoming=self._incoming,
            pool=self._pool,
            heap=self._heap,
            waiting=self._waiting,
            instants=instants,
            sensing=draws.sensing,
            path=draws.path(together),
            ticks=window,
            ticks_stop=len(window.t),
            # Plants that change have no frames.
            frames=draws.states.frame_times if not len(changes) else changes,
            lives=draws.lives.t,
            waking=self._begin_reading(draws.lives),
            quantiser=self._quantiser.with_streams(draws.dither),
            probes=self._probes,
            buffer=self._buffer if buffer is None else buffer,
            # The recorder keeps the rows of a traced run, so the next one gets others.
            rows=np.empty(FIRST_ROWS if traced else 0, dtype=EVENT),
            counts=np.zeros(len(schema.KINDS), dtype=np.int64),
            scratch=scratch,
            flow_scratch=flow_arrays,
            traced=traced,
            **self._scalar_fields(instants),
            **dict.fromkeys(AT_START, 0),
        )
        return state

    def _begin_nodes(self, draws: Draws) -> Any:
        """Return the records of nodes, with who is down and what clocks show in a run."""
        nodes = self.filters.nodes.copy()
        nodes["down"] = draws.lives.filters_down
        for place, clock in draws.clocks.items():
            nodes["offset"][place], nodes["pace"][place] = clock.offset, clock.pace
        return nodes

    def _begin_reading(self, lives: LifeTable) -> IntArray:
        """Let nodes that are down at first read no increments; return ``Simulation.waking``."""
        waking = [self._scenario.topology.index[node] for node in self._scenario.waking_nodes]
        for h in waking:
            assert self.clocked is not None
            self.clocked.set_reading(h, not lives.down[h])
        return np.where(np.isin(lives.node, waking), lives.node, -1)

    def _scalar_fields(self, instants: Instants) -> dict[str, Any]:
        algorithm = self._scenario.node_filter
        max_messages = int(np.diff(self._senders.first).max(initial=0))
        of_instant = 1 if self._scenario.filter.gate is None else 2
        return {
            "clock_kind": CLOCKS.index(self._senders.at),
            "newest_only": algorithm.timing.newest_only,
            "most_messages": max_messages,
            "free_count": len(self._pool),
            # Each message of a tick leaves a "send", its outcome and perhaps an "absorb", and the
            # tick or transmission two rows more, and payloads of few bits of both ends two; an
            # instant of samples leaves one row per sensing node, and a gate one per sample.
            "most_rows": (2 if self._scenario.network.quantise is None else 4)
            + 3 * max_messages
            + of_instant * int(np.diff(instants.first).max(initial=0))
            # Links that come up or go down.
            + len(self._scenario.topology.links) * self._scenario.links_move,
            "horizon": self._scenario.horizon,
            "per_second": self._scenario.time_grid.per_second,
            "age_limit": algorithm.timing.max_age,
            "inbox_time": 0.0,
        }


def empty_samples(
    shape: tuple[int, int, int, int], make: Callable[..., Any] = np.zeros
) -> SampleBuffer:
    """Return space for samples of ``shape`` (R, B, N, n), in arrays from ``make``."""
    runs, count, _, n = shape
    return SampleBuffer(
        xhat=make(shape),
        P=make((*shape, n)),
        rows=np.zeros((runs, count), dtype=np.int64),
        counts=np.zeros((runs, count, len(schema.KINDS)), dtype=np.int64),
    )


class FlowRun:
    """One run in continuous time, recorded by ``recorder``. ``draws`` gives its random numbers,
    ``workspace`` its arrays, and ``progress`` is called with the simulated seconds.
    """

    def __init__(
        self,
        scenario: Scenario,
        workspace: Workspace,
        draws: Source,
        recorder: Recorder,
        progress: Progress,
    ) -> None:
        self._scenario, self._recorder, self._progress = scenario, recorder, progress
        recorder.exact_errors, recorder.unknown = scenario.exact_errors, scenario.unknown_samples
        self._draws, self._state = draws, workspace.begin(draws, not recorder.counts_only)
        self._visits = workspace.visits() if is_immediate(scenario) else None
        self._clocked = workspace.clocked
        self._entries = np.maximum(entries_of(scenario), 0)

    def to_the_end(self) -> str:
        """Simulate up to the horizon, or to an estimate that is not finite; return the status."""
        try:
            # Any value but DONE.
            request = WANT_ROWS
            while request != DONE:
                request = self._run_events()
                # Samples first: the run ends at the first one that is not finite, with the rows
                # before it.
                if not self._record_samples():
                    return "diverged"
                self._fulfil(request)
        finally:
            # Ctrl-C between the two calls would lose rows of the loop.
            with defer_signals():
                try:
                    self._record_rows(self._state.row, self._state.counts)
                finally:
                    self._recorder.flush()
        return "complete"

    def _run_events(self) -> int:
        if self._clocked is not None:
            return self._clocked.advance(self._state)
        assert self._visits is not None
        return simulate_single_run(self._state, self._visits)

    def _fulfil(self, request: int) -> None:
        state = self._state
        if request == WANT_TICKS:
            state.ticks, state.tick_at = self._draws.window(), 0
            state.ticks_stop = len(state.ticks.t)
        elif request == WANT_STEPS:
            state.path = self._draws.path()
            # Positions are relative to the new block.
            state.piece = state.grid_at = 0
        elif request == WANT_MESSAGES:
            add_messages(state, state.most_messages)
            if self._clocked is not None:
                self._clocked.grow(len(state.pool))
        elif request == WANT_ROWS:
            self._record_rows(state.row, state.counts)
            length = max(recording.BLOCK, 2 * state.most_rows)
            if len(state.rows) < length:
                state.rows = np.empty(length, dtype=EVENT)
        elif request == WANT_PAST and self._clocked is not None:
            self._clocked.grow_past()
        elif request == WANT_REBASE:
            self._rebase()
        elif request == WANT_LIFE:
            self._change_life()

    def _rebase(self) -> None:
        state, k = self._state, self._state.frame_at
        if len(self._scenario.followed_changes):
            assert self._clocked is not None
            self._clocked.begin_piece(k + 1)
            state.frame_at = k + 1
            return
        offset = -self._draws.states.rebase(k)
        if self._clocked is not None:
            self._clocked.shift(self._scenario, state, offset)
        else:
            # No message is under way, and covariances refer to no origin.
            state.xhat[:] += offset
        state.frame_at = k + 1

    def _change_life(self) -> None:
        state, lives, k = self._state, self._draws.lives, self._state.life_at
        time, h, kind = float(lives.t[k]), int(lives.node[k]), int(lives.kind[k])
        node = self._scenario.nodes[h]
        state.life_at = k + 1
        if state.traced:
            state.rows[state.row] = time, kind, node, -1, -1, -1, math.nan
            state.row += 1
        else:
            state.counts[kind] += 1
        if lives.in_nodes:
            state.nodes["down"][h] ^= 1
        if state.waking[k] >= 0:
            assert self._clocked is not None
            self._clocked.set_reading(h, not state.nodes["down"][h])
        if lives.restarts[k]:
            assert self._clocked is not None
            self._clocked.restart(h, self._scenario.prior_shift(node, time))
            clock = self._draws.clocks.get(h)
            state.now[h] = time if clock is None else clock.shows(time)

    def _record_rows(self, count: int, counts: np.ndarray) -> None:
        state, recorder = self._state, self._recorder
        if not state.traced:
            recorder.add_counts(counts)
            # Counts go on from zero, because the recorder has added them.
            state.counts[:] = 0
            return
        rows = state.rows
        state.row = 0
        recorder.extend(rows[:count])
        # A new buffer, since the recorder keeps the old one.
        state.rows = np.empty(len(rows), dtype=EVENT)

    def _record_samples(self) -> bool:
        """Pass the samples in the buffer on; return False at one that is not finite."""
        state, buffer = self._state, self._state.buffer
        count, state.samples = state.samples, 0
        if not count:
            return True
        times = state.probes[state.probe_at - count : state.probe_at].copy()
        local, x = self._draws.states.states(times)

        def pass_rows_on(k: int) -> None:
            self._record_rows(int(buffer.rows[0, k]), buffer.counts[0, k])

        # Copies: the loop writes the next samples into the same space.
        xhat, P = buffer.xhat[0, :count].copy(), buffer.P[0, :count].copy()
        # Relative to the moving origin: a difference of large absolute states would lose digits.
        entries = self._entries
        error = local[:, entries] - xhat
        if local is not x:
            xhat += self._scenario.origins(times, local, x)[:, entries]
        xhat, P, error = by_node(self._scenario, xhat, P, error)
        samples = StateSamples(times, x, xhat, P, error)
        finite = record_samples(
            self._scenario, self._recorder, self._progress, samples, pass_rows_on
        )
        if self._clocked is not None:
            self._recorder.sums = self._clocked.sums()
        return finite
