"""Tables of all samples of a run: instants, sensors and values."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from netkf.engines.compiled.own_sensors import is_own, read_many
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.state import Instants
from netkf.linalg.arrays import FloatArray
from netkf.plants.sampling import Samples
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario


class SampledSensor(NamedTuple):
    """One sensor: the ``times`` (K,) in seconds of its ``samples``, their ``indices`` (K,) among
    all samples of the run, and whether each has an H of its own.
    """

    times: FloatArray
    samples: Samples
    indices: np.ndarray
    varying: bool


class SampleTables:
    """The samples of one run. Their values are filled in by ``read`` once the states are drawn,
    which do not depend on estimates. ``times`` (K,) in seconds are the sample times of each sensor,
    by (node id, number of the sensor at the node).
    """

    def __init__(
        self, scenario: Scenario, streams: Streams, times: dict[tuple[int, int], FloatArray]
    ) -> None:
        """Sort the samples of all sensors by time into ``instants`` (each a time at which a node
        takes samples and uses them in one update), without their values; ``times`` (K,) in seconds
        are those of each sensor, by (node id, number of the sensor at the node).
        """
        if not scenario.sampled_sensors:
            self._sensors, self.instants = [], _no_instants(scenario)
            return
        placed = _placed_sensors(scenario)
        counts = [len(times[node, placed_sensor.ordinal]) for node, placed_sensor in placed]
        # All samples of all sensors in one list, sensor by sensor.
        t = np.concatenate([times[n, placed_sensor.ordinal] for n, placed_sensor in placed])
        sensor = np.repeat(np.arange(len(placed)), counts)
        # Sorted by (time, sensor), the order in which one update stacks them.
        order = np.lexsort((sensor, t))
        # The inverse permutation: where the samples of each sensor have gone.
        position = np.empty(len(t), dtype=np.int64)
        position[order] = np.arange(len(t))
        parts = np.split(position, np.cumsum(counts)[:-1])
        self._sensors = [
            SampledSensor(
                times[node, placed_sensor.ordinal],
                scenario.sample_path(streams, node, placed_sensor),
                indices,
                bool(varies),
            )
            for (node, placed_sensor), indices, varies in zip(
                placed, parts, _sensor_tables(scenario).varying, strict=True
            )
        ]
        self.instants = _make_instants(scenario, t[order], sensor[order])
        for (_, placed_sensor), sampled in zip(placed, self._sensors, strict=True):
            if sampled.varying and hasattr(sampled.samples, "covariance"):
                R = scenario.noise_covariance(placed_sensor.entry, believed=True)
                _add_noises(self.instants, sampled.samples, sampled.indices, R)

    def read(self, states: FloatArray, times: FloatArray, after: float, until: float) -> None:
        """Fill in the values ``instants.y`` (and H, where it varies) of the samples taken in
        (``after``, ``until``] seconds, from the states (T, n) at T ``times`` (T,), which contain
        their times.
        """
        instants = self.instants
        for sensor in self._sensors:
            # (after, until]: a time at the border of two blocks is read once.
            first, last = np.searchsorted(sensor.times, [after, until], side="right")
            if first == last:
                continue
            sample_times = sensor.times[first:last]
            # The state at each sample; ``times`` contains all of them.
            x = states[np.searchsorted(times, sample_times)]
            y, H = read_many(sensor.samples, range(first, last), x)
            indices, p = sensor.indices[first:last], y.shape[1]
            instants.y[indices, :p] = y
            if sensor.varying:
                instants.H[instants.matrix[indices], :p] = H


def _add_noises(instants: Instants, samples: Any, indices: np.ndarray, R: FloatArray) -> None:
    """Set rows and noise of each sample of a sensor that has its own: values may be missing."""
    p, first = instants.root.shape[1], len(instants.rows)
    root = np.zeros((len(indices), p, p))
    rows = np.zeros(len(indices), dtype=np.int64)
    for k in range(len(indices)):
        own = np.linalg.cholesky(samples.covariance(k, R))
        rows[k] = len(own)
        root[k, : len(own), : len(own)] = own
    instants.root = np.concatenate([instants.root, root])
    instants.rows = np.concatenate([instants.rows, rows])
    instants.sensor[indices] = first + np.arange(len(indices))


@once_per_scenario
def _no_instants(scenario: Scenario) -> Instants:
    """Return the instants of all runs of a scenario without sampled sensors: none."""
    return _make_instants(scenario, np.empty(0), np.empty(0, dtype=np.int64))


class SensorTables(NamedTuple):
    """What a scenario says of its S sampling sensors, of up to p rows: ``node`` (id) and ``filter``
    (index) of each (S,), ``rows`` (S,), whether its H varies, the Cholesky factor ``root``
    (S, p, p) of the R that filters believe, and H (S, p, n).
    """

    node: np.ndarray
    filter: np.ndarray
    rows: np.ndarray
    varying: np.ndarray
    root: FloatArray
    H: FloatArray


@once_per_scenario
def _placed_sensors(scenario: Scenario) -> list[tuple[int, PlacedSensor]]:
    """Return (node, sensor) of all sensors that sample."""
    return [(node, placed) for node, many in scenario.sampled_sensors.items() for placed in many]


@once_per_scenario
def _sensor_tables(scenario: Scenario) -> SensorTables:
    """Return the tables of all sensors that sample, in the order of ``_placed_sensors``."""
    placed = _placed_sensors(scenario)
    index = scenario.topology.index if placed else {}
    pooled, n = scenario.node_filter.timing.pooled, scenario.plant.n
    parts = [
        (scenario.sensors[p.entry], scenario.noise_covariance(p.entry, believed=True))
        for _, p in placed
    ]
    rows = np.array([len(R) for _, R in parts], dtype=np.int64)
    max_rows = int(rows.max(initial=1))
    root, H = np.zeros((len(parts), max_rows, max_rows)), np.zeros((len(parts), max_rows, n))
    for k, (part, R) in enumerate(parts):
        root[k, : len(R), : len(R)], H[k, : len(R)] = np.linalg.cholesky(R), part.matrix_of(n)
    return SensorTables(
        node=np.array([node for node, _ in placed], dtype=np.int64),
        filter=np.array([0 if pooled else index[node] for node, _ in placed], dtype=np.int64),
        rows=rows,
        varying=np.array([part.varying or is_own(part) for part, _ in parts], dtype=bool),
        root=root,
        H=H,
    )


def _make_instants(scenario: Scenario, t: FloatArray, sensor: np.ndarray) -> Instants:
    """Return the instants: times at which a node uses one or several samples at once."""
    tables = _sensor_tables(scenario)
    # Sensors whose H varies get a matrix for each sample, behind the fixed ones.
    varying, count = tables.varying[sensor], len(tables.rows)
    own = int(varying.sum())
    matrix, H = sensor.copy(), tables.H
    if own:
        matrix[varying] = count + np.arange(own)
        H = np.concatenate([H, np.zeros((own, *H.shape[1:]))])
    filters = tables.filter[sensor]
    # Samples of one node at one time are one instant, and one update.
    begins = np.ones(len(t), dtype=bool)
    begins[1:] = (np.diff(t) != 0.0) | (np.diff(filters) != 0)
    first = np.flatnonzero(begins)
    return Instants(
        t=t[first],
        index=filters[first],
        first=np.append(first, len(t)),
        node=tables.node[sensor],
        y=np.zeros((len(t), tables.H.shape[1])),
        sensor=sensor,
        matrix=matrix,
        rows=tables.rows,
        root=tables.root,
        H=H,
    )
