"""Batches of runs in continuous time, whose ticks, paths and noise are drawn together.

For a short run the calls of Python that draw and prepare it cost as much as its events. Here they
are made once for all runs of a batch. Every number is as in a run that is simulated alone.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator

import numpy as np

from netkf.core.memory import keep_freed_memory
from netkf.engines.base import batch_sink, silent
from netkf.engines.compiled.agenda import is_immediate, simulate_together, together
from netkf.engines.compiled.batch_arrays import BatchArrays
from netkf.engines.compiled.draws import (
    Noise,
    Paths,
    blocks_to_the_end,
    no_path,
    no_sensing,
    steps_to_the_end,
)
from netkf.engines.compiled.flow import FlowRun, Source, Workspace, empty_samples
from netkf.engines.compiled.life_tables import NO_LIVES
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.sample_tables import KernelSamples, kernel_sensors, no_instants
from netkf.engines.compiled.senders import senders_of
from netkf.engines.compiled.state import Filters, PathBlock, TickArrays
from netkf.engines.compiled.ticks import NO_LINKS, Schedule
from netkf.engines.compiled.truth import PathStates
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.network.node_clocks import NodeTime
from netkf.plants.paths import BLOCK
from netkf.plants.transitions import frame_period
from netkf.plants.truth import WithoutFrames
from netkf.rng.streams import Streams
from netkf.scenario.sampling import uses_grid
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import Recorder
from netkf.trace.schema import KINDS

MAX_BATCH_RUNS, ALONE = 512, 8  # runs of a batch, and of one whose runs are drawn one by one
QUICK_VISITS = 1 << 18
"""Visits of nodes that take some thirty milliseconds; preparing a batch takes one or two."""
MAX_BATCH_BYTES = 1 << 25
"""Limit of the bytes that are drawn for a batch, samples included."""


def flow_batches(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
) -> Iterator[RunBatch]:
    """Yield the results of consecutive replicas in continuous time, as many runs at a time as
    memory allows. With ``fingerprint``, the first batch is the first run alone.
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
    # Identity, not equality: the tables belong to this very scenario object.
    cached_scenario, workspace = getattr(_thread, "last", (None, None))
    if workspace is None or cached_scenario is not scenario:
        workspace = Workspace(scenario)
        _thread.last = scenario, workspace
    return workspace


def _simulate(
    scenario: Scenario, workspace: Workspace, seed: int, replicas: range, rows: bool = False
) -> RunBatch:
    with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
        # Runs that are drawn together write no rows. Longer pasts and moves of the origin of
        # filters with messages under way need Python, run by run.
        together, clocked = drawn_together(scenario) and not rows, workspace.clocked
        if together and clocked is not None:
            frames = scenario.exact_errors and frame_period(scenario.diffusion.A) is not None
            together = not (clocked.kernels.remembers or frames)
        batch = _all_at_once(scenario, workspace, seed, replicas) if together else None
        if batch is None:
            batch = _run_by_run(scenario, workspace, seed, replicas, rows)
        return batch


def _run_by_run(
    scenario: Scenario, workspace: Workspace, seed: int, replicas: range, rows: bool
) -> RunBatch:
    sink = batch_sink(scenario, replicas)
    for replica in replicas:
        recorder = Recorder([sink], counts_only=not rows)
        source = Source(scenario, Streams(seed, replica))
        run = FlowRun(scenario, workspace, source, recorder, silent)
        sink.finish(recorder, run.to_the_end())
    return sink.batch()


def _all_at_once(
    scenario: Scenario, workspace: Workspace, seed: int, replicas: range
) -> RunBatch | None:
    """Simulate the runs in one call; None if one of them must be simulated alone."""
    draws = BatchDraws(scenario, seed, replicas)
    start, runs = workspace.filters, len(replicas)
    # np.empty: runs that diverge go on to the end, so that all samples are written.
    buffer = empty_samples((runs, len(scenario.times), *start.xhat.shape), make=np.empty)
    arrays, sums = _batch_arrays(scenario, start, draws), {}
    # Messages that take no time: several runs side by side in SIMD lanes.
    if is_immediate(scenario):
        group = together(len(start.nodes), runs)
        state = workspace.begin(draws, traced=False, buffer=buffer, together=group)
        simulate_together(state, workspace.visits(group), arrays, group)
    else:
        assert workspace.clocked is not None
        state = workspace.begin(draws, traced=False, buffer=buffer)
        sums = workspace.clocked.simulate(state, arrays)
        if sums and arrays.diverged.any():
            return None
    for k in range(len(draws.states.frame_times)):
        draws.states.rebase(k)
    local, absolute = draws.states.of_runs(scenario.times)
    if absolute is not local:
        arrays.x[:] = absolute
        # As in a run alone, to the last bit.
        buffer.xhat += (absolute - local)[:, :, None]
        # A run ends where its states overflow.
        if not np.isfinite(absolute).all():
            return None
    return RunBatch(
        replicas=replicas,
        times=scenario.times,
        x=arrays.x,
        xhat=buffer.xhat,
        P=buffer.P,
        error=arrays.error,
        lengths=arrays.lengths,
        counts=arrays.counts,
        status=np.where(arrays.diverged > 0, DIVERGED, COMPLETE),
        sums=sums,
        exact_errors=scenario.exact_errors,
    )


def _batch_arrays(scenario: Scenario, start: Filters, draws: BatchDraws) -> BatchArrays:
    x = draws.states.local(scenario.times)
    runs = len(x)
    return BatchArrays(
        nodes=start.nodes,
        xhat=start.xhat,
        root=start.root,
        first=draws.ticks.first,
        first_delay=draws.ticks.first_delay,
        first_instant=draws.first_instant,
        x=x,
        error=np.empty((*x.shape[:2], *start.xhat.shape)),
        lengths=np.zeros(runs, dtype=np.int64),
        counts=np.zeros((runs, len(KINDS)), dtype=np.int64),
        diverged=np.zeros(runs, dtype=np.int64),
        carriers=len(scenario.nodes) // len(start.nodes),
        has_bits=int(draws.ticks.bits),
    )


def drawn_together(scenario: Scenario) -> bool:
    """Return True if runs are drawn together, for filters of one state of a plant that does not
    change, and nodes that do not move: by increments alone, or by kernels' samples alone.
    """
    if scenario.views is not None or len(scenario.plant.changes) or scenario.links_move:
        return False
    if scenario.network.lives or scenario.network.clocks or scenario.network.quantise:
        return False
    if senders_of(scenario).at == "readings":
        return False
    if not scenario.sampled_sensors:
        return uses_grid(scenario)
    is_free = scenario.plant.is_random and scenario.plant.linear and not uses_grid(scenario)
    return is_free and scenario.input_responses is None and kernel_sensors(scenario) is not None


@once_per_scenario
def batch_size(scenario: Scenario) -> int:
    """Return the number of runs of a batch: as many as fit MAX_BATCH_BYTES."""
    n = scenario.plant.n
    filters = 1 if scenario.node_filter.timing.pooled else len(scenario.nodes)
    sample_floats = len(scenario.times) * filters * n * (n + 2)
    # Runs that are drawn one by one gain only from fewer calls for their statistics.
    if not drawn_together(scenario):
        return ALONE if 8.0 * ALONE * sample_floats < MAX_BATCH_BYTES else 1
    # An estimate of the floats that one run draws and stores as samples.
    sensors = kernel_sensors(scenario)
    rows = max((len(sensor.R) for sensor in scenario.sensors), default=0)
    if sensors is not None:
        # Per sample its time, state, value and a few indices.
        taken = sum(float(entry.rates.sum()) for entry in sensors.clocks) * scenario.horizon
        floats = taken * (8 + n + rows)
    else:
        period = scenario.diffusion.sensing_period
        # One piece for each step, and one more for each sample that cuts a step.
        steps = BLOCK + len(scenario.times) + (scenario.horizon / period if period else 0.0)
        reading = sum(len(placed) for placed in scenario.placed_sensors.values())
        # Per piece: two states, two moments and the three coefficients of the cubic, of n entries
        # each; per step the two moments of each sensor's noise.
        floats = steps * (7 * n + 2 * reading * rows)
    floats += 8.0 * _expected_ticks(scenario)
    # At least one run, however large it is.
    return max(1, int(min(MAX_BATCH_RUNS, MAX_BATCH_BYTES / (8.0 * (floats + sample_floats)))))


@once_per_scenario
def quick_runs(scenario: Scenario) -> int:
    """Return the number of runs, a power of two, that take some thirty milliseconds."""
    if not drawn_together(scenario):
        return 1
    visits = len(scenario.nodes) * len(scenario.times) + _expected_ticks(scenario)
    if uses_grid(scenario):
        visits += steps_to_the_end(scenario) * len(scenario.increment_sensors)
    # Those of the other loop are not computed side by side.
    max_runs = int(QUICK_VISITS / (visits if is_immediate(scenario) else 2 * visits))
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
    """All random numbers of the R runs ``replicas``, drawn up to the horizon from ``seed``."""

    lives, dither = NO_LIVES, None

    def __init__(self, scenario: Scenario, seed: int, replicas: range) -> None:
        self.clocks: dict[int, NodeTime] = {}
        streams = Streams(seed, replicas.start, len(replicas))
        self.ticks = Schedule(scenario, streams, is_immediate(scenario)).all()
        self._paths: Paths | None = None
        self.states: PathStates | KnownStates
        if uses_grid(scenario):
            self._paths = Paths(scenario, streams, blocks_to_the_end(scenario))
            steps = steps_to_the_end(scenario)
            self._block = self._paths.following(steps)
            noise = Noise(scenario, streams, steps)
            # One block of noise reaches the horizon.
            noise.following()
            self.sensing, self.instants = noise.sensing, no_instants(scenario)
            self.first_instant = np.zeros(len(replicas), dtype=np.int64)
            self.states = PathStates(scenario, self._paths.frame_times, self.path())
            return
        samples = KernelSamples(scenario, streams)
        self.sensing, self.instants = no_sensing(scenario), samples.instants
        self._no_path = no_path(scenario.plant.n)
        never = np.flatnonzero(np.isinf(samples.instants.t))
        self.first_instant = np.append(0, never + 1)[: len(replicas)]
        times, probes = np.split(samples.t, samples.edges[1:-1]), scenario.times
        x = scenario.diffusion.sampled_states(
            streams, [np.concatenate([probes, own]) for own in times], scenario.horizon
        )
        samples.read_from(0, np.concatenate([states[len(probes) :] for states in x]))
        self.states = KnownStates(np.stack([states[: len(probes)] for states in x]))

    def window(self) -> TickArrays:
        """Return the ticks of all R runs, one run after the other in each array."""
        ticks = self.ticks
        return TickArrays(
            end=math.inf,
            t=ticks.t,
            entity=ticks.entity,
            first_outcome=ticks.first_outcome,
            delay=ticks.delay,
            # The same array holds the indices of outcomes or, if no message takes time, the bits.
            arrival_bits=ticks.first_outcome if ticks.bits else np.zeros_like(ticks.entity),
            owner=NO_LINKS.owner,
            link=NO_LINKS.link,
        )

    def path(self, together: int = 1) -> PathBlock:
        """Return all steps of the paths of all R runs, of which ``together`` run at a time."""
        if self._paths is None:
            return self._no_path
        return self._paths.block(self._block, together)


class KnownStates(WithoutFrames):
    """The states ``x`` (R, T, n) of R runs at all sample times, whose origin does not move."""

    def __init__(self, x: FloatArray) -> None:
        self._x = x

    def local(self, _: FloatArray) -> FloatArray:
        """Return the states."""
        return self._x

    def of_runs(self, _: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the states, local and absolute ones."""
        return self._x, self._x
