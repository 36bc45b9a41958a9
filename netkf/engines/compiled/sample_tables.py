"""All samples of a run as tables: at which instants, by which sensors, and what they read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.engines.compiled.state import Instants
from netkf.linalg.arrays import FloatArray
from netkf.plants.sampling import Samples
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario


class SampledSensor(NamedTuple):
    """One sensor: the ``times`` (K,) of its samples, what reads them, the indices (K,) of
    its samples among all, and its own order among sensors.
    """

    times: FloatArray
    samples: Samples
    indices: np.ndarray
    order: int


class SampleTables:
    """The samples of one run. What is read is filled in once the state is known: a state does not
    depend on estimates, nor do readings.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams, times: dict[tuple[int, int], FloatArray]
    ) -> None:
        placed = [
            (n, placed_sensor)
            for n, some in scenario.sampled_sensors.items()
            for placed_sensor in some
        ]
        counts = [len(times[node, placed_sensor.ordinal]) for node, placed_sensor in placed]
        # All samples of all sensors in one list, sensor by sensor.
        t = np.concatenate(
            [np.empty(0), *(times[n, placed_sensor.ordinal] for n, placed_sensor in placed)]
        )
        sensor = np.repeat(np.arange(len(placed)), counts)
        # Sorted by (time, sensor), the order in which one update stacks them.
        order = np.lexsort((sensor, t))
        # The inverse permutation: where the samples of each sensor have gone.
        back = np.empty(len(t), dtype=np.int64)
        back[order] = np.arange(len(t))
        cuts = np.cumsum(counts)[:-1]
        parts = np.split(back, cuts) if placed else []
        self._sensors = [
            SampledSensor(
                times[node, placed_sensor.ordinal],
                scenario.sample_path(streams, node, placed_sensor),
                some,
                k,
            )
            for k, ((node, placed_sensor), some) in enumerate(zip(placed, parts, strict=True))
        ]
        self.instants = _make_instants(scenario, placed, t[order], sensor[order])
        self._matrices: list[FloatArray] = []

    def read(self, states: FloatArray, times: FloatArray, after: float, until: float) -> None:
        """Fill in the samples taken in (``after``, ``until``], from the states (T, n) at ``times``
        (T,).
        """
        given = self.instants
        for sensor in self._sensors:
            # (after, until]: a time at the border of two blocks is read once.
            first, last = np.searchsorted(sensor.times, [after, until], side="right")
            if first == last:
                continue
            here = sensor.times[first:last]
            # The state at each sample; ``times`` contains all of them.
            x = states[np.searchsorted(times, here)]
            y, H = sensor.samples.several(range(first, last), x)
            indices, p = sensor.indices[first:last], y.shape[1]
            given.y[indices, :p] = y
            if given.matrix[indices[0]] >= len(given.rows):  # a sensor with an H for each sample
                given.H[given.matrix[indices], :p] = H


def _make_instants(
    scenario: Scenario, placed: list[tuple[int, PlacedSensor]], t: FloatArray, sensor: np.ndarray
) -> Instants:
    """Return the instants at which nodes have samples, from the sorted times ``t`` (K,) and the
    index of the ``sensor`` (K,) of each sample.
    """
    index = scenario.topology.index if placed else {}
    pooled, n = scenario.hosted.pooled, scenario.plant.n
    node = np.array([node for node, _ in placed], dtype=np.int64)
    filters = np.array([0 if pooled else index[k] for k in node.tolist()], dtype=np.int64)
    parts = [(scenario.sensors[p.entry], scenario.noise(p.entry, believed=True)) for _, p in placed]
    rows = np.array([len(R) for _, R in parts], dtype=np.int64)
    most = int(rows.max(initial=1))
    root, H = np.zeros((len(parts), most, most)), np.zeros((len(parts), most, n))
    # The Cholesky factor of the R that filters believe, once for each sensor.
    for k, (part, R) in enumerate(parts):
        root[k, : len(R), : len(R)], H[k, : len(R)] = np.linalg.cholesky(R), part.H
    # Sensors whose H varies get a matrix for each sample, behind the fixed ones.
    own = np.array([part.varying for part, _ in parts], dtype=bool)
    matrix, varying = sensor.copy(), own[sensor] if parts else np.zeros(0, dtype=bool)
    matrix[varying] = len(parts) + np.arange(int(varying.sum()))
    H = np.concatenate([H, np.zeros((int(varying.sum()), most, n))])
    whose = filters[sensor] if parts else sensor
    # Samples of one node at one time are one instant, and one update.
    begins = np.ones(len(t), dtype=bool)
    begins[1:] = (np.diff(t) != 0.0) | (np.diff(whose) != 0)
    first = np.flatnonzero(begins)
    return Instants(
        t=t[first],
        index=whose[first],
        first=np.append(first, len(t)),
        node=node[sensor] if parts else sensor,
        y=np.zeros((len(t), most)),
        sensor=sensor,
        matrix=matrix,
        rows=rows,
        root=root,
        H=H,
    )
