"""One run in continuous time: what the compiled replay works on and is given when it stops.

Python draws - ticks, fates, the path, the noise - from the streams that the processes engine uses,
and the replay does everything that happens an event at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from netkf.algorithms.covariance_intersection import CovarianceIntersection
from netkf.core.compiling import demanded
from netkf.core.interrupts import undisturbed
from netkf.core.streams import Streams
from netkf.engines.base import Progress
from netkf.engines.compiled.draws import Noise, Paths, sizes
from netkf.engines.compiled.poisson import schedule
from netkf.engines.compiled.readings import Stretch
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
from netkf.engines.compiled.samples import recorded
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.tables import (
    GRID_AT,
    PLACES,
    PROBE_AT,
    ROW,
    SHOWN,
    STEP_AT,
    TICK_AT,
    Sensing,
    empty_mail,
    host_tables,
    larger,
    link_tables,
    room_for,
    room_for_parts,
)
from netkf.plants.paths import BLOCK
from netkf.scenario.scenario import Scenario
from netkf.trace import recorder as recording
from netkf.trace.recorder import Recorder
from netkf.trace.schema import EVENT

FIRST_MAIL, FIRST_ROWS = 1024, 4096
MOST_SAMPLES, SAMPLES_ROOM = 256, 1 << 18


class Windows(Protocol):
    """Where ticks come from."""

    def following(self) -> Window:
        """The next window; its end is infinite where nothing comes after it."""


class Draws(Protocol):
    """What is drawn for one run, given out as the run goes on."""

    sensing: Sensing

    def window(self) -> Window:
        """The next ticks."""

    def stretch(self) -> Stretch:
        """The next stretch of the path; the noise of its steps is in ``sensing``."""

    def more_cuts(self) -> None:
        """New normals for cuts in ``sensing``."""


class Source:
    """Draws as they are wanted."""

    def __init__(
        self, scenario: Scenario, streams: Streams, windows: Windows | None = None
    ) -> None:
        self._windows = windows or schedule(scenario, streams)
        blocks, cuts = sizes(scenario)
        self._paths = Paths(scenario, streams, blocks)
        self._noise = Noise(scenario, streams, blocks * BLOCK, cuts)
        self.sensing = self._noise.sensing[0]

    def window(self) -> Window:
        """Some ticks for each link."""
        return self._windows.following()

    def stretch(self) -> Stretch:
        """A block of steps."""
        self._noise.following()
        return self._paths.following()[0]

    def more_cuts(self) -> None:
        """A block for each sensor that has none left."""
        self._noise.more_cuts(0)


def replay_for(scenario: Scenario) -> Callable[..., int]:
    """What is compiled for the filters of a scenario."""
    intersects = isinstance(scenario.filter.algorithm, CovarianceIntersection)
    return intersecting if intersects else replay


class Desk:
    """The tables of a scenario, and where the states of a run are; serves one run after another."""

    def __init__(self, scenario: Scenario) -> None:
        function = replay_for(scenario)
        self.replay = demanded(function)
        self.hosts, self.models = host_tables(scenario)
        self._xhat, self._P = self.hosts.xhat.copy(), self.hosts.P.copy()
        self.links, self.mail = link_tables(scenario), empty_mail(self.hosts, FIRST_MAIL)
        self.room = room_for(self.models)
        self.parts = room_for_parts(self.links, self.hosts) if function is intersecting else None
        self.cursor = Cursor(np.zeros(PLACES, dtype=np.int64), np.zeros(1))
        self.rows = np.empty(FIRST_ROWS, dtype=EVENT)
        self.probes = np.array(scenario.times, dtype=np.float64)
        size, n = self.hosts.xhat.shape
        room = max(1, min(MOST_SAMPLES, SAMPLES_ROOM // (size * n * n)))
        self.samples = Samples(
            xhat=np.zeros((room, size, n)),
            P=np.zeros((room, size, n, n)),
            rows=np.zeros(room, dtype=np.int64),
            piece=np.zeros(room, dtype=np.int64),
        )

    def clear(self) -> None:
        """Put everything where it is at time 0."""
        hosts, mail = self.hosts, self.mail
        hosts.xhat[:], hosts.P[:] = self._xhat, self._P
        hosts.now[:], hosts.inbox[:], hosts.least[:] = 0.0, -1, 0.0
        self.links.messages[:], mail.next[:] = 0, np.arange(1, len(mail.next) + 1)
        self.cursor.place[:], self.cursor.mailed[:] = 0, 0.0


class FlowRun:
    """One run."""

    def __init__(
        self,
        scenario: Scenario,
        desk: Desk,
        draws: Draws,
        recorder: Recorder,
        progress: Progress,
    ) -> None:
        self._scenario, self._recorder, self._progress = scenario, recorder, progress
        self._desk, self._draws = desk, draws
        self._window, self._stretch = draws.window(), draws.stretch()

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
            with undisturbed():
                try:
                    self._pass_rows_on(int(self._desk.cursor.place[ROW]))
                finally:
                    self._recorder.flush()
        return "complete"

    def _go_on(self) -> int:
        desk = self._desk
        return int(
            desk.replay(
                desk.hosts,
                desk.models,
                self._draws.sensing,
                desk.links,
                desk.mail,
                desk.cursor,
                self._window,
                self._stretch,
                desk.probes,
                desk.samples,
                float(self._scenario.horizon),
                desk.rows,
                desk.room,
                desk.parts,
            )
        )

    def _give(self, wanted: int) -> None:
        place = self._desk.cursor.place
        if wanted == WANT_TICKS:
            self._window, place[TICK_AT] = self._draws.window(), 0
        elif wanted == WANT_STEPS:
            self._stretch = self._draws.stretch()
            place[STEP_AT] = place[GRID_AT] = 0
        elif wanted == WANT_CUTS:
            self._draws.more_cuts()
        elif wanted == WANT_MAIL:
            self._desk.mail = larger(self._desk.mail)
        elif wanted == WANT_ROWS:
            self._pass_rows_on(int(place[ROW]))
            if len(self._desk.rows) < recording.BLOCK:
                self._desk.rows = np.empty(recording.BLOCK, dtype=EVENT)

    def _pass_rows_on(self, used: int) -> None:
        desk, recorder = self._desk, self._recorder
        desk.cursor.place[ROW] = 0
        recorder.extend(desk.rows[:used])
        if not recorder.counted:  # they are the recorder's now
            desk.rows = np.empty(len(desk.rows), dtype=EVENT)

    def _take_samples(self) -> bool:
        """Record the samples that are there; False where one of them is no longer finite."""
        place, path, taken = self._desk.cursor.place, self._stretch, self._desk.samples
        count, place[SHOWN] = int(place[SHOWN]), 0
        times = self._desk.probes[place[PROBE_AT] - count : place[PROBE_AT]]
        piece = taken.piece[:count]
        ends = (times == path.stop[piece])[:, None]
        x = np.where(ends, path.x_stop[piece], path.x_start[piece])
        return recorded(
            self._scenario,
            self._recorder,
            self._progress,
            times.copy(),
            x,
            x,
            taken.xhat[:count].copy(),
            taken.P[:count].copy(),
            lambda k: self._pass_rows_on(int(taken.rows[k])),
        )
