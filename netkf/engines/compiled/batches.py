"""Runs of one scenario in continuous time whose ticks, paths and noise are drawn together.

Beside its events, a short run costs the calls of Python that draw and prepare it. Here they are
made once for all runs of a batch, which share one workspace. Every number is what it is for a run
alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from netkf.engines.base import batch_sink, silent
from netkf.engines.compiled.draws import Noise, Paths, blocks_to_the_end
from netkf.engines.compiled.flow import Draws, FlowRun, Source, Workspace
from netkf.engines.compiled.poisson import schedules
from netkf.engines.compiled.sample_tables import SampleTables
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.state import Instants, PathBlock
from netkf.engines.compiled.truth import PathStates, States
from netkf.network.clocks import LinkClock
from netkf.plants.paths import BLOCK
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.sampling import uses_grid
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import RunBatch
from netkf.trace.recorder import Recorder

LARGEST_BATCH = 256
MOST_BYTES = 1 << 24
"""Bytes that are drawn for a batch, and that its samples take."""


def flow_batches(scenario: Scenario, seed: int, replicas: range) -> Iterator[RunBatch]:
    """Yield the runs of consecutive replicas, as many at a time as memory allows."""
    workspace = Workspace(scenario)
    size = batch_size(scenario)
    for first in range(replicas.start, replicas.stop, size):
        yield _simulate(scenario, workspace, seed, range(first, min(first + size, replicas.stop)))


def _simulate(scenario: Scenario, workspace: Workspace, seed: int, replicas: range) -> RunBatch:
    sink = batch_sink(scenario, replicas)
    with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
        for draws in _draws(scenario, seed, replicas):
            recorder = Recorder([sink], counts_only=True)
            run = FlowRun(scenario, workspace, draws, recorder, silent)
            sink.finish(recorder, run.to_the_end())
    return sink.batch()


def _draws(scenario: Scenario, seed: int, replicas: range) -> Iterator[Draws]:
    """Yield the draws of each run, made for all at once where that can be."""
    if len(replicas) > 1:
        yield from BatchDraws(scenario, seed, replicas).runs
    else:
        yield from (Source(scenario, Streams(seed, replica)) for replica in replicas)


def drawn_together(scenario: Scenario) -> bool:
    """Tell if all that is random comes from link clocks, channels and increments."""
    return uses_grid(scenario) and not scenario.sampled_sensors


def batch_size(scenario: Scenario) -> int:
    """Number of runs that are drawn and kept together, at least 1."""
    if not drawn_together(scenario):
        return 1
    n, period = scenario.plant.n, scenario.truth.sensing_period
    filters = 1 if scenario.hosted.pooled else len(scenario.nodes)
    steps = BLOCK + len(scenario.times) + (scenario.horizon / period if period else 0.0)
    sensors = sum(len(placed) for placed in scenario.placed.values())
    rows = max((len(sensor.R) for sensor in scenario.sensors), default=0)
    drawn = steps * (8 * n + 2 * sensors * rows) + 8.0 * _expected_ticks(scenario)
    samples = len(scenario.times) * filters * n * (n + 2)
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
    """Everything random of some runs, drawn up to the horizon; ``runs`` are those of each."""

    def __init__(self, scenario: Scenario, seed: int, replicas: range) -> None:
        streams = ReplicaStreams(seed, replicas.start, len(replicas))
        windows, blocks = schedules(scenario, streams), blocks_to_the_end(scenario)
        paths = Paths(scenario, streams, blocks)
        ticks = max(len(window.t) for window in windows)
        cuts = 16 + len(scenario.times) + 3 * ticks // len(scenario.nodes)
        noise = Noise(scenario, streams, blocks * BLOCK, cuts)
        noise.following()
        nothing = SampleTables(scenario, Streams(seed, replicas.start), {}).instants
        self.runs = [
            RunDraws(window, path, noise, run, nothing, PathStates(scenario, paths.frame_times))
            for run, (window, path) in enumerate(zip(windows, paths.following(), strict=True))
        ]


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
        self.sensing, self.instants, self.states = noise.sensing[run], instants, states

    def window(self) -> Window:
        """All ticks."""
        return self._window

    def path(self) -> PathBlock:
        """All steps."""
        return self._path

    def more_cuts(self) -> None:
        """As many more."""
        self._noise.more_cuts(self._run)
