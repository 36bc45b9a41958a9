"""Runs of one scenario whose ticks, paths and noise are drawn together.

What a short run costs beside its events is Python, call after call. Where it is known that the
replicas of a block come one after the other (``together``), the calls are made once for all of
them, and they share one workspace. Every number is what it is for a run alone.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property

from netkf.engines.compiled.draws import Noise, Paths, blocks_to_the_end
from netkf.engines.compiled.flow import Draws, Source, Workspace
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

LARGEST_LOT = 64
MOST_BYTES = 1 << 24
"""Of what is drawn for a lot."""

A_RUN, A_STEP, A_TICK = 5e-4, 1e-6, 1e-6
"""Seconds of a run, a sensor's step and a tick for each dimension of the state, on some machine."""


class OfLot:
    """The draws of one run of a batch: all at once."""

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


class Lots:
    """The runs of ``scenario`` with ``seed`` and a replica from ``first`` up to ``stop``, which are
    asked for one after the other.
    """

    def __init__(self, scenario: Scenario, seed: int, first: int, stop: int) -> None:
        self._scenario, self._seed = scenario, seed
        self._next, self._stop = first, stop
        self._draws: dict[int, OfLot] = {}
        self._taken = threading.Lock()

    @cached_property
    def _size(self) -> int:
        return lot_size(self._scenario)

    @cached_property
    def _drawn_together(self) -> bool:
        """Whether all that is random comes from link clocks and increments."""
        return uses_grid(self._scenario) and not self._scenario.sampled_sensors

    @cached_property
    def _workspace(self) -> Workspace:
        return Workspace(self._scenario)

    def take(self, scenario: Scenario, streams: Streams) -> bool:
        """Whether such runs are expected and the workspace was free; it is taken then, and a run in
        this one or in another thread has its own.
        """
        expected = scenario is self._scenario and streams.seed == self._seed
        return expected and type(streams) is Streams and self._taken.acquire(blocking=False)

    def leave(self) -> None:
        """The workspace is free again."""
        self._taken.release()

    def prepared(self, replica: int) -> tuple[Workspace, OfLot] | None:
        """For the run of a replica, once; None where it had better draw for itself."""
        drawn = replica in self._draws
        if (
            not self._drawn_together
            or self._size < 2
            or not (drawn or self._next <= replica < self._stop)
        ):
            return None
        if not drawn:
            self._draw(replica)
        return self._workspace, self._draws.pop(replica)

    def _draw(self, replica: int) -> None:
        count = min(self._size, self._stop - replica)
        streams = ReplicaStreams(self._seed, replica, count)
        scenario = self._scenario
        windows = schedules(scenario, streams)
        blocks = blocks_to_the_end(scenario)
        paths = Paths(scenario, streams, blocks)
        ticks = max(len(window.t) for window in windows)
        cuts = 16 + len(scenario.times) + 3 * ticks // len(scenario.nodes)
        noise = Noise(scenario, streams, blocks * BLOCK, cuts)
        noise.following()
        for run in range(count):
            noise.more_cuts(run)
        nothing = SampleTables(scenario, Streams(self._seed, replica), {}).instants
        self._draws = {
            replica + run: OfLot(
                window, path, noise, run, nothing, PathStates(scenario, paths.frame_times)
            )
            for run, (window, path) in enumerate(zip(windows, paths.following(), strict=True))
        }
        self._next = replica + count


def work_of(scenario: Scenario) -> tuple[float, int, float]:
    """Of one run: steps of the path, sensors, and ticks, nan where they are not known."""
    clock = scenario.network.activation
    period = scenario.truth.sensing_period if uses_grid(scenario) else None
    steps = 64.0 + len(scenario.times) + (0.0 if period is None else scenario.horizon / period)
    sensors, ticks = sum(len(placed) for placed in scenario.placed.values()), 0.0
    if scenario.hosted.talks and isinstance(clock, LinkClock):
        entities = clock.entities(scenario.topology)
        ticks = sum(clock.mean_rate(entity) for entity in entities) * scenario.horizon
    return steps, sensors, ticks


def lot_size(scenario: Scenario) -> int:
    """How many runs are drawn together, so that what is drawn is not too much to keep."""
    steps, sensors, ticks = work_of(scenario)
    rows = max((len(sensor.R) for sensor in scenario.sensors), default=0)
    numbers = steps * (8 * scenario.plant.n + 2 * sensors * rows) + 8.0 * ticks
    return int(min(LARGEST_LOT, MOST_BYTES / (8.0 * numbers)))


def guessed_seconds(scenario: Scenario, runs: int) -> float:
    """What so many runs of a scenario in continuous time take in lots; nan where nobody knows."""
    steps, sensors, ticks = work_of(scenario)
    one = A_RUN + A_STEP * steps * max(sensors, 1) + A_TICK * ticks
    return runs * one * scenario.plant.n


_expected: ContextVar[Lots | None] = ContextVar("expected", default=None)


@contextmanager
def together(scenario: Scenario, seed: int, first: int, stop: int) -> Iterator[None]:
    """Inside, runs of this scenario and seed with replicas from ``first`` up to ``stop`` are
    expected one after the other.
    """
    before = _expected.set(Lots(scenario, seed, first, stop))
    try:
        yield
    finally:
        _expected.reset(before)


@contextmanager
def at_a_workspace(scenario: Scenario, streams: Streams) -> Iterator[tuple[Workspace, Draws]]:
    """What a run works with: drawn with others where it was expected, else its own."""
    lots = _expected.get()
    if lots is None or not lots.take(scenario, streams):
        yield Workspace(scenario), Source(scenario, streams)
        return
    try:
        yield lots.prepared(streams.replica) or (Workspace(scenario), Source(scenario, streams))
    finally:
        lots.leave()
