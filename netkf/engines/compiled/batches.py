"""Batches of runs in continuous time, whose ticks, paths and noise are drawn together.

For a short run the calls of Python that draw and prepare it cost as much as its events. Here they
are made once for all runs of a batch, which share one workspace. Every number is the same as in a
run that is simulated alone.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from netkf.core.memory import keep_freed_memory
from netkf.engines.base import batch_sink, silent
from netkf.engines.compiled.agenda import is_immediate, simulate_together, together
from netkf.engines.compiled.batch_arrays import BatchArrays
from netkf.engines.compiled.draws import Noise, Paths, blocks_to_the_end, steps_to_the_end
from netkf.engines.compiled.flow import Draws, FlowRun, Source, Workspace, empty_samples
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.sample_tables import no_instants
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.state import Filters, PathBlock, Sensing
from netkf.engines.compiled.ticks import all_ticks, window_of
from netkf.engines.compiled.truth import PathStates, States
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES
from netkf.linalg.portable import apply
from netkf.network.clocks import LinkClock
from netkf.plants.paths import BLOCK
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.sampling import uses_grid
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import Recorder
from netkf.trace.schema import KINDS

MAX_BATCH_RUNS = 512  # runs of a batch
QUICK_VISITS = 1 << 18
"""Visits of nodes that take some thirty milliseconds; preparing a batch takes one or two."""
MAX_BATCH_BYTES = 1 << 25
"""Limit of the bytes that are drawn for a batch, samples included."""


def flow_batches(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
) -> Iterator[RunBatch]:
    """Yield the results of consecutive replicas (numbers of runs) in continuous time, as many runs
    at a time as memory allows; ``seed`` is that of all their random numbers. With ``fingerprint``,
    the first batch is the first run alone, and has the fingerprint of its events.
    """
    keep_freed_memory()
    size, start, workspace = batch_size(scenario), replicas.start, _workspace(scenario)
    if fingerprint and replicas:
        yield _simulate(scenario, workspace, seed, replicas[:1], rows=True)
        start += 1
    for first in range(start, replicas.stop, size):
        yield _simulate(scenario, workspace, seed, range(first, min(first + size, replicas.stop)))


_thread = threading.local()


def _workspace(scenario: Scenario) -> Workspace:
    """Return the workspace of this thread, reused for all blocks of runs of a scenario."""
    # Identity, not equality: the tables belong to this very scenario object.
    cached_scenario, workspace = getattr(_thread, "last", (None, None))
    if workspace is None or cached_scenario is not scenario:
        workspace = Workspace(scenario)
        _thread.last = scenario, workspace
    return workspace


def _simulate(
    scenario: Scenario, workspace: Workspace, seed: int, replicas: range, rows: bool = False
) -> RunBatch:
    """Draw and simulate the runs ``replicas``; with ``rows`` also fingerprint the first."""
    with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
        # Runs that are drawn together write no rows.
        if rows or not drawn_together(scenario):
            sources = (Source(scenario, Streams(seed, replica)) for replica in replicas)
            return _run_by_run(scenario, workspace, sources, replicas, rows)
        draws = BatchDraws(scenario, seed, replicas)
        # Conserved sums, longer pasts and moves of the origin need Python, run by run.
        clocked = workspace.clocked
        if clocked is not None and (clocked.needs_python or len(draws.paths.frame_times)):
            return _run_by_run(scenario, workspace, draws.runs(), replicas)
        return _all_at_once(scenario, workspace, draws)


def _run_by_run(
    scenario: Scenario,
    workspace: Workspace,
    draws: Iterable[Draws],
    replicas: range,
    rows: bool = False,
) -> RunBatch:
    """Simulate runs that need Python one after the other, and return their results."""
    sink = batch_sink(scenario, replicas)
    for run_draws in draws:
        recorder = Recorder([sink], counts_only=not rows)
        run = FlowRun(scenario, workspace, run_draws, recorder, silent)
        sink.finish(recorder, run.to_the_end())
    return sink.batch()


def _all_at_once(scenario: Scenario, workspace: Workspace, draws: BatchDraws) -> RunBatch:
    """Simulate the R runs of ``draws`` in one call of a kernel, and return their results."""
    start, runs = workspace.filters, len(draws.replicas)
    # np.empty: runs that diverge go on to the end, so that all samples are written.
    buffer = empty_samples((runs, len(scenario.times), *start.xhat.shape), make=np.empty)
    arrays = _batch_arrays(scenario, start, draws)
    # Messages that take no time: several runs side by side in SIMD lanes.
    if is_immediate(scenario):
        group = together(len(start.nodes), runs)
        state = workspace.begin(draws, traced=False, buffer=buffer, together=group)
        simulate_together(state, workspace.visits(group), arrays, group)
    else:
        assert workspace.clocked is not None
        workspace.clocked.simulate(workspace.begin(draws, traced=False, buffer=buffer), arrays)
    if len(draws.paths.frame_times):
        local = arrays.x.copy()
        arrays.x += draws.origins(scenario.times)
        # As in a run alone, to the last bit.
        buffer.xhat += (arrays.x - local)[:, :, None]
        if not np.isfinite(arrays.x).all():
            # A run ends where its states overflow.
            return _run_by_run(scenario, workspace, draws.runs(), draws.replicas)
    return RunBatch(
        replicas=draws.replicas,
        times=scenario.times,
        x=arrays.x,
        xhat=buffer.xhat,
        P=buffer.P,
        error=arrays.error,
        lengths=arrays.lengths,
        counts=arrays.counts,
        status=np.where(arrays.diverged > 0, DIVERGED, COMPLETE),
        exact_errors=scenario.exact_errors,
    )


def _batch_arrays(scenario: Scenario, start: Filters, draws: BatchDraws) -> BatchArrays:
    """Return where each run of a batch begins, and space for the results of all."""
    runs, x = len(draws.replicas), draws.sampled_states(scenario.times)
    return BatchArrays(
        nodes=start.nodes,
        xhat=start.xhat,
        root=start.root,
        first=draws.ticks.first,
        first_delay=draws.ticks.first_delay,
        x=x,
        error=np.empty((*x.shape[:2], *start.xhat.shape)),
        lengths=np.zeros(runs, dtype=np.int64),
        counts=np.zeros((runs, len(KINDS)), dtype=np.int64),
        diverged=np.zeros(runs, dtype=np.int64),
        carriers=len(scenario.nodes) // len(start.nodes),
        has_bits=int(draws.ticks.bits),
    )


def drawn_together(scenario: Scenario) -> bool:
    """Return True if the runs of a batch can be drawn together: paths are drawn on the sensing
    grid, and no sensor takes samples.
    """
    return uses_grid(scenario) and not scenario.sampled_sensors


@once_per_scenario
def batch_size(scenario: Scenario) -> int:
    """Return the number of runs of a batch, at least 1: as many as fit MAX_BATCH_BYTES with their
    random numbers and samples.
    """
    n = scenario.plant.n
    filters = 1 if scenario.node_filter.timing.pooled else len(scenario.nodes)
    sample_floats = len(scenario.times) * filters * n * (n + 2)
    # Runs that are drawn one by one: as many as statistics process side by side.
    if not drawn_together(scenario):
        return LANES if 8.0 * LANES * sample_floats < MAX_BATCH_BYTES else 1
    # An estimate of the floats that one run draws and stores as samples.
    period = scenario.diffusion.sensing_period
    # One piece for each step, and one more for each sample that cuts a step.
    steps = BLOCK + len(scenario.times) + (scenario.horizon / period if period else 0.0)
    sensors = sum(len(placed) for placed in scenario.placed_sensors.values())
    rows = max((len(sensor.R) for sensor in scenario.sensors), default=0)
    # Per piece: two states, two moments and the three coefficients of the cubic, of n entries each;
    # per step the two moments of each sensor's noise.
    floats = steps * (7 * n + 2 * sensors * rows) + 8.0 * _expected_ticks(scenario)
    # At least one run, however large it is. A multiple of L, since statistics process L runs side
    # by side and fewer take as long.
    size = max(1, int(min(MAX_BATCH_RUNS, MAX_BATCH_BYTES / (8.0 * (floats + sample_floats)))))
    return min(MAX_BATCH_RUNS, -(-size // LANES) * LANES) if size > LANES // 2 else size


@once_per_scenario
def quick_runs(scenario: Scenario) -> int:
    """Return the number of runs, a power of two, that take some thirty milliseconds together: a
    batch of fewer would spend too large a part of its time on preparations.
    """
    if not (drawn_together(scenario) and is_immediate(scenario)):
        return 1
    steps, nodes = steps_to_the_end(scenario), len(scenario.nodes)
    visits = steps * len(scenario.increment_sensors) + nodes * len(scenario.times)
    max_runs = int(QUICK_VISITS / (visits + _expected_ticks(scenario)))
    return 1 << max(0, min(max_runs, batch_size(scenario)).bit_length() - 1)


def _expected_ticks(scenario: Scenario) -> float:
    """Return the expected number of ticks of a run, large if a clock has no finite rate."""
    clock = scenario.network.activation
    if not (scenario.node_filter.timing.talks and isinstance(clock, LinkClock)):
        return 0.0
    entities = clock.entities(scenario.topology)
    ticks = sum(clock.mean_rate(entity) for entity in entities) * scenario.horizon
    return ticks if ticks < MAX_BATCH_BYTES else MAX_BATCH_BYTES / 64.0


class BatchDraws:
    """All random numbers of a batch of runs, drawn up to the horizon. ``replicas`` are the numbers
    of its R runs and ``seed`` is that of all their streams.
    """

    def __init__(self, scenario: Scenario, seed: int, replicas: range) -> None:
        """Draw ticks, paths and noise of the R runs ``replicas`` (their numbers) up to the horizon,
        from streams of ``seed``.
        """
        streams = ReplicaStreams(seed, replicas.start, len(replicas))
        self._scenario, self.replicas, blocks = scenario, replicas, blocks_to_the_end(scenario)
        self.paths = Paths(scenario, streams, blocks)
        self.ticks = all_ticks(scenario, streams, is_immediate(scenario))
        steps = steps_to_the_end(scenario)
        self._block = self.paths.following(steps)
        noise = Noise(scenario, streams, steps)
        # One block of noise reaches the horizon.
        noise.following()
        self.sensing = noise.sensing
        self.instants = no_instants(scenario)
        self.states: States = PathStates(scenario, self.paths.frame_times)

    def window(self) -> Window:
        """Return the ticks of all R runs, one run after the other in each array, in the form that a
        single run has its ticks in.
        """
        ticks = self.ticks
        return Window(
            end=math.inf,
            t=ticks.t,
            entity=ticks.entity,
            first_outcome=ticks.first_outcome,
            delay=ticks.delay,
            # The same array holds the indices of outcomes or, if no message takes time, the bits.
            arrival_bits=ticks.first_outcome if ticks.bits else None,
        )

    def path(self, together: int = 1) -> PathBlock:
        """Return all steps of the paths of all R runs, for an event loop that simulates
        ``together`` runs at a time.
        """
        return self.paths.block(self._block, together)

    def runs(self) -> Iterator[RunDraws]:
        """Yield the draws of each of the R runs, for runs that are simulated one by one."""
        return (RunDraws(self, self._scenario, run) for run in range(len(self.replicas)))

    def path_of(self, run: int) -> PathBlock:
        """Return all steps of the path of the true state in run number ``run`` (0 to R - 1)."""
        block, one = self._block, slice(run, run + 1)
        names = ("x_start", "x_end", "moments", "cubic")
        own: dict[str, Any] = {name: getattr(block, name)[one] for name in names}
        return self.paths.block(block._replace(**own))

    def sampled_states(self, times: FloatArray) -> FloatArray:
        """Return the states (R, T, n) of all R runs at the T sample ``times`` (T,) in seconds,
        relative to the origin of their frame.
        """
        block = self._block
        # Times of samples are ends of pieces or, at time 0, the start of the first.
        pieces = np.searchsorted(block.end, times)
        x, starts = block.x_end.take(pieces, axis=1), times != block.end[pieces]
        x[:, starts] = block.x_start[:, pieces[starts]]
        # The origin has moved to the state where a frame begins.
        x[:, np.isin(times, self.paths.frame_times)] = 0.0
        return x

    def origins(self, times: FloatArray) -> FloatArray:
        """Return the origins (R, T, n) to which the states of ``sampled_states`` are relative."""
        frame_times, moves = self.paths.frame_times, self._scenario.diffusion.moves
        starts = np.concatenate([[0.0], frame_times])
        offsets = self._block.x_end[:, np.searchsorted(self._block.end, frame_times)]
        origin = np.zeros(offsets[:, :1].shape)
        positions, Phi = [origin[:, 0]], moves.transitions(np.diff(starts))
        for k in range(len(frame_times)):
            # The first origin is 0, and its transition may overflow.
            moved = apply(Phi[k], positions[k]) if k else positions[k]
            positions.append(moved + offsets[:, k])
        frame = np.searchsorted(frame_times, times, side="right")
        shift = apply(
            moves.transitions(times - starts[frame]), np.stack(positions, axis=1)[:, frame]
        )
        shift[:, frame == 0] = 0.0
        return shift


class RunDraws:
    """The draws of one run of a batch. ``run`` is its number in the batch, from 0."""

    def __init__(self, batch: BatchDraws, scenario: Scenario, run: int) -> None:
        """Take views of the draws of run number ``run`` (0 to R - 1) of a batch, for the event loop
        of a single run.
        """
        self._batch, self._run, self.instants = batch, run, batch.instants
        self.states: States = PathStates(scenario, batch.paths.frame_times)
        shared, count = batch.sensing, len(batch.sensing.rows)
        fields = {name: getattr(shared, name) for name in Sensing.struct_fields}
        # Streams are in the order of the runs.
        fields["cuts"] = shared.cuts[run * count :][:count]
        fields["noise"] = shared.noise[run * count * shared.steps :][: count * shared.steps]
        self.sensing = Sensing(**fields)

    def window(self) -> Window:
        """Return all ticks of the run."""
        return window_of(self._batch.ticks, self._run)

    def path(self, together: int = 1) -> PathBlock:
        """Return all steps of the path of this run; ``together`` is not used."""
        return self._batch.path_of(self._run)
