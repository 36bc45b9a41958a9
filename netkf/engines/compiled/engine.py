"""The compiled engine: schedules made beforehand, and one compiled replay that carries the states.

Python draws - ticks, fates, the path, the noise - in blocks from the streams that the processes
engine uses, and the replay does everything that happens an event at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from netkf.algorithms.baselines import Central, Local
from netkf.algorithms.covariance_intersection import CovarianceIntersection
from netkf.algorithms.hybrid import Hybrid
from netkf.core import compiling
from netkf.core.fields import Part
from netkf.core.streams import Streams
from netkf.engines.base import Engine, Progress, broken
from netkf.engines.compiled.draws import Noise, Path
from netkf.engines.compiled.replay import (
    DONE,
    WANT_CUTS,
    WANT_MAIL,
    WANT_ROWS,
    WANT_STEPS,
    WANT_TICKS,
    Cursor,
    Samples,
    intersecting,
    replay,
)
from netkf.engines.compiled.schedule import Schedule, Window
from netkf.engines.compiled.slotted import KERNELS, SlotRun
from netkf.engines.compiled.tables import (
    GRID_AT,
    PLACES,
    PROBE_AT,
    ROW,
    SHOWN,
    STEP_AT,
    TICK_AT,
    empty_mail,
    host_tables,
    larger,
    link_tables,
    room_for,
    room_for_parts,
)
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.recorded import RecordedPlant, RecordedSensor, UnknownPlant
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sensors import LinearSensor
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.trace import recorder as recording
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES, EVENT

KNOWN = (
    *(Diffusion, LinearPlant, RecordedPlant, UnknownPlant),
    *(LinearSensor, RegressorSensor, RecordedSensor),
    *(Hybrid, CovarianceIntersection, Local, Central, *KERNELS),
)
DIVERGED = CODES["diverged"]
FIRST_MAIL, FIRST_ROWS = 1024, 4096
MOST_SAMPLES, SAMPLES_ROOM = 256, 1 << 18


@dataclass(frozen=True)
class CompiledEngine(Engine):
    """Runs all built-in plants, sensors and filters; clocks and channels may be anybody's, since
    schedules are made in Python.
    """

    name = "compiled"

    def refusal(self, scenario: Scenario) -> str | None:
        """Why this engine cannot run the scenario, with the remedy; None where it can."""
        remedy = 'use engine="processes", or "auto", which chooses'
        if not compiling.available():
            remedy = 'install it (pip install "netkf[fast]") or use engine="processes"'
            return f'engine "compiled" needs numba, which is not installed; {remedy}'
        parts: list[tuple[str, Part]] = [("plant", scenario.plant)]
        parts += [("sensor", sensor) for sensor in scenario.sensors]
        parts += [("filter", scenario.filter.algorithm)]
        for family, part in parts:
            if type(part) not in KNOWN:
                return (
                    f'engine "compiled" cannot run the {family} {name_of(family, part)!r}; {remedy}'
                )
        return None

    def run(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> str:
        """Simulate up to the horizon; returns complete or diverged."""
        run = SlotRun if scenario.slotted else FlowRun
        with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
            return run(scenario, streams, recorder, progress).to_the_end()


class Windows(Protocol):
    """Where a run gets its ticks from."""

    def following(self) -> Window:
        """The next window; its end is infinite where nothing comes after it."""


class FlowRun:
    """One run in continuous time: what the replay works on, and what it is given when it stops."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        recorder: Recorder,
        progress: Progress,
        schedule: Windows | None = None,
    ) -> None:
        self._scenario, self._recorder, self._progress = scenario, recorder, progress
        intersects = isinstance(scenario.filter.algorithm, CovarianceIntersection)
        self._replay = compiling.announced(intersecting if intersects else replay)
        assert self._replay is not None
        self._hosts, self._models = host_tables(scenario)
        self._links, self._mail = link_tables(scenario), empty_mail(self._hosts, FIRST_MAIL)
        self._room = room_for(self._models)
        self._parts = room_for_parts(self._links, self._hosts) if intersects else None
        self._cursor = Cursor(np.zeros(PLACES, dtype=np.int64), np.zeros(1))
        self._schedule = schedule or Schedule(scenario, streams)
        self._path = Path(scenario, streams)
        self._noise = Noise(scenario, streams)
        self._window = self._schedule.following()
        self._stretch = self._path.following()
        self._noise.following()
        self._rows = np.empty(FIRST_ROWS, dtype=EVENT)
        self._probes = np.array(scenario.times, dtype=np.float64)
        size, n = self._hosts.xhat.shape
        room = max(1, min(MOST_SAMPLES, SAMPLES_ROOM // (size * n * n)))
        self._samples = Samples(
            xhat=np.zeros((room, size, n)),
            P=np.zeros((room, size, n, n)),
            rows=np.zeros(room, dtype=np.int64),
            piece=np.zeros(room, dtype=np.int64),
        )

    def to_the_end(self) -> str:
        """Simulate up to the horizon; returns complete or diverged."""
        try:
            wanted = WANT_ROWS
            while wanted != DONE:
                wanted = self._go_on()
                if not self._take_samples():
                    return "diverged"
                self._give(wanted)
        finally:
            self._pass_rows_on(int(self._cursor.place[ROW]))
            self._recorder.flush()
        return "complete"

    def _go_on(self) -> int:
        assert self._replay is not None
        return int(
            self._replay(
                self._hosts,
                self._models,
                self._noise.sensing,
                self._links,
                self._mail,
                self._cursor,
                self._window,
                self._stretch,
                self._probes,
                self._samples,
                float(self._scenario.horizon),
                self._rows,
                self._room,
                self._parts,
            )
        )

    def _give(self, wanted: int) -> None:
        place = self._cursor.place
        if wanted == WANT_TICKS:
            self._window, place[TICK_AT] = self._schedule.following(), 0
        elif wanted == WANT_STEPS:
            self._stretch = self._path.following()
            place[STEP_AT] = place[GRID_AT] = 0
            self._noise.following()
        elif wanted == WANT_CUTS:
            self._noise.more_cuts()
        elif wanted == WANT_MAIL:
            self._mail = larger(self._mail)
        elif wanted == WANT_ROWS:
            self._pass_rows_on(int(place[ROW]))

    def _pass_rows_on(self, used: int) -> None:
        self._cursor.place[ROW] = 0
        self._recorder.extend(self._rows[:used])
        if len(self._rows) < recording.BLOCK or not self._recorder.counted:
            self._rows = np.empty(recording.BLOCK, dtype=EVENT)

    def _take_samples(self) -> bool:
        """Record the samples that are there; False where one of them is no longer finite."""
        place = self._cursor.place
        count, place[SHOWN] = int(place[SHOWN]), 0
        times = self._probes[place[PROBE_AT] - count : place[PROBE_AT]].tolist()
        taken = self._samples.xhat[:count], self._samples.P[:count]
        finite = all(bool(np.isfinite(part).all()) for part in taken)
        return all(self._sample(time, k, finite) for k, time in enumerate(times))

    def _sample(self, time: float, k: int, finite: bool) -> bool:
        path, piece = self._stretch, int(self._samples.piece[k])
        x = path.x_stop[piece] if time == path.stop[piece] else path.x_start[piece]
        xhat, P = self._samples.xhat[k].copy(), self._samples.P[k].copy()
        if self._scenario.filter.algorithm.pooled:
            count = len(self._scenario.nodes)
            xhat, P = np.repeat(xhat, count, axis=0), np.repeat(P, count, axis=0)
        self._recorder.sample(time, x.copy(), xhat, P)
        self._progress(time)
        nodes = [] if finite else broken(self._scenario, xhat, P)
        if nodes:
            # What happened after this sample did not happen.
            self._pass_rows_on(int(self._samples.rows[k]))
        for node in nodes:
            self._recorder.append((time, DIVERGED, node, -1, -1, -1, NAN))
        return not nodes
