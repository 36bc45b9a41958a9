"""The path and the noise of all sensors, drawn in blocks of steps of the sensing grid."""

from __future__ import annotations

import numpy as np

from netkf.core.streams import Streams
from netkf.engines.compiled.replay import Stretch
from netkf.engines.compiled.tables import Sensing
from netkf.plants.diffusion import Step
from netkf.plants.sensors import step_noise
from netkf.scenario.scenario import Scenario

STEPS = 64  # of the sensing grid at once
CUTS = 64  # normals that a sensor has ready


class Path:
    """The path of one run as stretches of ``STEPS`` steps."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        self._path = scenario.truth.path(
            streams.generator("plant"), streams.generator("probe"), scenario.times
        )
        self._senses = bool(scenario.sensing)
        self._horizon, self._done = scenario.horizon, 0
        self._series = np.array(self._path.series)

    def following(self) -> Stretch:
        """The next stretch; the last one reaches beyond the horizon."""
        first = self._done
        pieces: list[Step] = []
        steps: list[int] = []
        while self._done < first + STEPS:
            parts = self._path.following()
            pieces += parts
            steps += [self._done - first] * len(parts)
            self._done += 1
            if pieces[-1].end >= self._horizon:
                break
        ends = [self._path.grid(k) for k in range(first + 1, self._done + 1)]
        waking = [time for time in ends if time < self._horizon] if self._senses else []
        order = np.array(steps, dtype=np.int64)
        return Stretch(
            end=ends[-1],
            start=np.array([piece.start for piece in pieces]),
            stop=np.array([piece.end for piece in pieces]),
            x_start=np.array([piece.x_start for piece in pieces]),
            x_stop=np.array([piece.x_end for piece in pieces]),
            moments=np.array([piece.moments for piece in pieces]),
            cubic=np.array([piece.cubic for piece in pieces]),
            step=order,
            last=np.array(ends)[order],
            grid=np.array(waking),
            series=self._series,
        )


class Noise:
    """The noise of all sensors, stretch by stretch."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        placed = [(node, place) for node in scenario.sensing for place in scenario.placed[node]]
        sensors = [scenario.sensors[place.entry] for _, place in placed]
        keys = [(node, place.ordinal) for node, place in placed]
        self._noise = [streams.generator("noise", *key) for key in keys]
        self._cuts = [streams.generator("cut", *key) for key in keys]
        assert scenario.truth.sensing_period is not None
        self._period = scenario.truth.sensing_period
        n, count = scenario.plant.n, len(sensors)
        self._rows = [len(sensor.R) for sensor in sensors]
        most = max(self._rows, default=0)
        H, root = np.zeros((count, most, n)), np.zeros((count, most, most))
        for k, sensor in enumerate(sensors):
            p = self._rows[k]
            H[k, :p], root[k, :p, :p] = sensor.H, np.linalg.cholesky(sensor.R)
        index, pooled = scenario.topology.index, scenario.filter.algorithm.pooled
        hosts = [0 if pooled else index[node] for node in scenario.sensing]
        self.sensing = Sensing(
            rows=np.array(self._rows, dtype=np.int64),
            H=H,
            root=root,
            rest=np.zeros((count, 2, most)),
            step=np.full(count, -1, dtype=np.int64),
            noise=np.zeros((count, STEPS, 2, most)),
            normals=np.zeros((count, CUTS, 2, most)),
            used=np.full(count, CUTS, dtype=np.int64),
            host=np.array(hosts, dtype=np.int64),
            node=np.array(scenario.sensing, dtype=np.int64),
        )

    def following(self) -> None:
        """Draw the noise of the next stretch."""
        sensing = self.sensing
        for k, (random, p) in enumerate(zip(self._noise, self._rows, strict=True)):
            sensing.noise[k, :, :, :p] = random.standard_normal((STEPS, 2, p))
        sensing.noise[:] = step_noise(sensing.noise, self._period)
        sensing.step[:] = -1

    def more_cuts(self) -> None:
        """Draw new normals where they are used up."""
        sensing = self.sensing
        for k in np.flatnonzero(sensing.used == CUTS):
            p = self._rows[k]
            sensing.normals[k, :, :, :p] = self._cuts[k].standard_normal((CUTS, 2, p))
            sensing.used[k] = 0
