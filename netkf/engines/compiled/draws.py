"""The path and the noise of all sensors, drawn in blocks of steps of the sensing grid."""

from __future__ import annotations

import numpy as np

from netkf.core.streams import Streams
from netkf.engines.compiled.readings import Stretch
from netkf.engines.compiled.tables import Sensing
from netkf.plants.paths import BLOCK
from netkf.plants.sensors import step_noise
from netkf.scenario.scenario import Scenario

CUTS = 64  # normals that a sensor has ready


class Path:
    """The path of one run as stretches of BLOCK steps."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        self._path = scenario.truth.path(
            streams.generator("plant"), streams.generator("probe"), scenario.times
        )
        self._senses, self._horizon = bool(scenario.sensing), scenario.horizon

    def following(self) -> Stretch:
        """The next stretch; the last one reaches beyond the horizon."""
        block = self._path.following()
        waking = block.ends[block.ends < self._horizon] if self._senses else np.empty(0)
        return Stretch(
            end=float(block.ends[-1]),
            start=block.start,
            stop=block.end,
            x_start=block.x_start,
            x_stop=block.x_end,
            moments=block.moments,
            cubic=block.cubic,
            step=block.step,
            last=block.ends[block.step],
            grid=waking,
            series=self._path.series,
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
            noise=np.zeros((count, BLOCK, 2, most)),
            normals=np.zeros((count, CUTS, 2, most)),
            used=np.full(count, CUTS, dtype=np.int64),
            host=np.array(hosts, dtype=np.int64),
            node=np.array(scenario.sensing, dtype=np.int64),
        )

    def following(self) -> None:
        """Draw the noise of the next stretch."""
        sensing = self.sensing
        for k, (random, p) in enumerate(zip(self._noise, self._rows, strict=True)):
            sensing.noise[k, :, :, :p] = random.standard_normal((BLOCK, 2, p))
        sensing.noise[:] = step_noise(sensing.noise, self._period)
        sensing.step[:] = -1

    def more_cuts(self) -> None:
        """Draw new normals where they are used up."""
        sensing = self.sensing
        for k in np.flatnonzero(sensing.used == CUTS):
            p = self._rows[k]
            sensing.normals[k, :, :, :p] = self._cuts[k].standard_normal((CUTS, 2, p))
            sensing.used[k] = 0
