"""Runs of one scenario in continuous time whose ticks, paths and noise are drawn together.

Beside its events, a short run costs the calls of Python that draw and prepare it. Here they are
made once for all runs of a batch, which share one workspace. Every number is what it is for a run
alone.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator

import numpy as np

from netkf.engines.base import batch_sink, silent
from netkf.engines.compiled.batch_loop import BatchArrays, simulate_batch
from netkf.engines.compiled.draws import Noise, Paths, blocks_to_the_end
from netkf.engines.compiled.flow import Draws, FlowRun, Source, Workspace
from netkf.engines.compiled.kept import once_per_scenario
from netkf.engines.compiled.poisson import all_ticks, window_of
from netkf.engines.compiled.sample_tables import SampleTables
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.state import Filters, Instants, PathBlock
from netkf.engines.compiled.truth import PathStates, States
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.plants.paths import BLOCK
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.sampling import uses_grid
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import Recorder
from netkf.trace.schema import KINDS

LARGEST_BATCH = 256
MOST_BYTES = 1 << 24
"""Bytes that are drawn for a batch, and that its samples take."""


def flow_batches(scenario: Scenario, seed: int, replicas: range) -> Iterator[RunBatch]:
    """Yield the runs of consecutive replicas, as many at a time as memory allows."""
    size = batch_size(scenario)
    workspace = _workspace(scenario) if size > 1 else Workspace(scenario)
    for first in range(replicas.start, replicas.stop, size):
        yield _simulate(scenario, workspace, seed, range(first, min(first + size, replicas.stop)))


_kept = threading.local()


def _workspace(scenario: Scenario) -> Workspace:
    """Return the workspace of this thread, kept from one block of a scenario's runs to the next."""
    # Identity, not equality: the tables belong to this very scenario object.
    known, workspace = getattr(_kept, "last", (None, None))
    if workspace is None or known is not scenario:
        workspace = Workspace(scenario)
        _kept.last = scenario, workspace
    return workspace


def _simulate(scenario: Scenario, workspace: Workspace, seed: int, replicas: range) -> RunBatch:
    with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
        if not drawn_together(scenario):
            sources = (Source(scenario, Streams(seed, replica)) for replica in replicas)
            return _run_by_run(scenario, workspace, sources, replicas)
        draws = BatchDraws(scenario, seed, replicas)
        # Both have state outside the Simulation, which simulate_batch() does not carry. Origins are
        # moved by Python, run by run.
        special = scenario.hosted.combination in ("sums", "readings")
        if len(draws.paths.frame_times) or special:
            return _run_by_run(scenario, workspace, draws.runs(), replicas)
        return _all_at_once(scenario, workspace, draws)


def _run_by_run(
    scenario: Scenario, workspace: Workspace, draws: Iterable[Draws], replicas: range
) -> RunBatch:
    """Simulate runs that call Python on their way: to move the origin, or for samples."""
    sink = batch_sink(scenario, replicas)
    for mine in draws:
        recorder = Recorder([sink], counts_only=True)
        run = FlowRun(scenario, workspace, mine, recorder, silent)
        sink.finish(recorder, run.to_the_end())
    return sink.batch()


def _all_at_once(scenario: Scenario, workspace: Workspace, draws: BatchDraws) -> RunBatch:
    """Simulate all runs by ``simulate_batch``."""
    # All runs start from the same filters: the arrays hold the start once.
    arrays = draws.arrays(workspace.filters)
    simulate_batch(workspace.begin(draws.first_run(), traced=False), arrays)
    x = draws.sampled_states(scenario.times)
    return RunBatch(
        replicas=draws.replicas,
        times=scenario.times,
        x=x,
        xhat=arrays.shown_xhat,
        P=arrays.shown_P,
        # No origin moves in these runs: local and absolute states are the same.
        error=x[:, :, None] - arrays.shown_xhat,
        lengths=arrays.lengths,
        counts=arrays.counts,
        status=np.where(arrays.diverged > 0, DIVERGED, COMPLETE),
        exact_errors=scenario.exact_errors,
    )


def drawn_together(scenario: Scenario) -> bool:
    """Tell if all that is random comes from link clocks, channels and increments."""
    return uses_grid(scenario) and not scenario.sampled_sensors


@once_per_scenario
def batch_size(scenario: Scenario) -> int:
    """Number of runs that are drawn and kept together, at least 1."""
    if not drawn_together(scenario):
        return 1
    # An estimate of what one run draws and shows, in floats.
    n, period = scenario.plant.n, scenario.truth.sensing_period
    filters = 1 if scenario.hosted.pooled else len(scenario.nodes)
    # One piece for each step, and one more for each sample that cuts a step.
    steps = BLOCK + len(scenario.times) + (scenario.horizon / period if period else 0.0)
    sensors = sum(len(placed) for placed in scenario.placed.values())
    rows = max((len(sensor.R) for sensor in scenario.sensors), default=0)
    # Per piece: two states, two moments and the four coefficients of the cubic, of n entries each;
    # per step the two moments of each sensor's noise.
    drawn = steps * (8 * n + 2 * sensors * rows) + 8.0 * _expected_ticks(scenario)
    samples = len(scenario.times) * filters * n * (n + 2)
    # At least one run, however large it is.
    return max(1, int(min(LARGEST_BATCH, MOST_BYTES / (8.0 * (drawn + samples)))))


def _expected_ticks(scenario: Scenario) -> float:
    """Ticks of all clocks of one run; many where a clock does not tell its rate."""
    clock = scenario.network.activation
    if not (scenario.hosted.talks and isinstance(clock, LinkClock)):
        return 0.0
    entities = clock.entities(scenario.topology)
    ticks = sum(clock.mean_rate(entity) for entity in entities) * scenario.horizon
    return ticks if ticks < MOST_BYTES else MOST_BYTES / 64.0


class BatchDraws:
    """Everything random of some runs, drawn up to the horizon."""

    def __init__(self, scenario: Scenario, seed: int, replicas: range) -> None:
        streams = ReplicaStreams(seed, replicas.start, len(replicas))
        self._scenario, self.replicas, blocks = scenario, replicas, blocks_to_the_end(scenario)
        self.ticks = all_ticks(scenario, streams)
        self.paths = Paths(scenario, streams, blocks)
        self._block = self.paths.of_all_runs()
        # Largest number of ticks of any run.
        most = int(np.diff(self.ticks.first).max())
        # A guess: samples cut steps, and each tick perhaps three, spread over the nodes. The loop
        # asks for more if that is too few.
        cuts = 16 + len(scenario.times) + 3 * most // len(scenario.nodes)
        self._noise = Noise(scenario, streams, blocks * BLOCK, cuts)
        # One stretch of noise reaches the horizon: it is drawn once.
        self._noise.following()
        # An empty table: increment sensors have no samples.
        self._no_samples = SampleTables(scenario, Streams(seed, replicas.start), {}).instants

    def runs(self) -> Iterator[RunDraws]:
        """Yield the draws of each run."""
        return (self._run(window_of(self.ticks, run), run) for run in range(len(self.replicas)))

    def first_run(self) -> RunDraws:
        """The draws of the first run, in arrays with space for the ticks of any other."""
        ticks, sent = (
            int(np.diff(first).max()) for first in (self.ticks.first, self.ticks.first_delay)
        )
        # Contents do not matter: begin_run() overwrites the ticks before each run.
        entity, at = (np.zeros(ticks, dtype=np.int64) for _ in range(2))
        return self._run(Window(math.inf, np.empty(ticks), entity, at, np.empty(sent)), 0)

    def _run(self, window: Window, run: int) -> RunDraws:
        states = PathStates(self._scenario, self.paths.frame_times)
        path = self.paths.of_run(self._block, run)
        return RunDraws(window, path, self._noise, run, self._no_samples, states)

    def arrays(self, start: Filters) -> BatchArrays:
        """The draws of all runs with space for their samples; ``start``: filters at time 0."""
        (filters, n), runs = start.xhat.shape, len(self.replicas)
        samples, block = (runs, len(self._scenario.times), filters), self._block
        noise, cuts = self._noise.of_all_runs
        return BatchArrays(
            nodes=start.nodes,
            xhat=start.xhat,
            root=start.root,
            x_start=np.ascontiguousarray(block.x_start),
            x_stop=np.ascontiguousarray(block.x_end),
            moments=np.ascontiguousarray(block.moments),
            cubic=np.ascontiguousarray(block.cubic),
            noise=noise,
            cuts=cuts,
            **self.ticks._asdict(),
            shown_xhat=np.zeros((*samples, n)),
            shown_P=np.zeros((*samples, n, n)),
            lengths=np.zeros(runs, dtype=np.int64),
            counts=np.zeros((runs, len(KINDS)), dtype=np.int64),
            diverged=np.zeros(runs, dtype=np.int64),
            carriers=len(self._scenario.nodes) // filters,
        )

    def sampled_states(self, times: FloatArray) -> FloatArray:
        """(R, T, n) states at the sample times, where no origin moves."""
        block = self._block
        # Times of samples are ends of pieces or, at time 0, the start of the first.
        pieces = np.searchsorted(block.end, times)
        ends = (times == block.end[pieces])[:, None]
        return np.where(ends, block.x_end[:, pieces], block.x_start[:, pieces])


class RunDraws:
    """The draws of one run of a batch: all at once, but for cuts."""

    def __init__(
        self,
        window: Window,
        path: PathBlock,
        noise: Noise,
        run: int,
        instants: Instants,
        states: States,
    ) -> None:
        self._window, self._path, self._noise, self._run = window, path, noise, run
        self.sensing, self.instants, self.states = noise.sensing(run), instants, states

    def window(self) -> Window:
        """All ticks."""
        return self._window

    def path(self) -> PathBlock:
        """All steps."""
        return self._path

    def more_cuts(self) -> None:
        """Draw new normals for cuts, as many as before."""
        self._noise.more_cuts(self._run)
