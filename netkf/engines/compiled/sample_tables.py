"""Tables of all samples of a run: instants, sensors and values.

Those of linear sensors with built-in clocks are drawn in compiled code, others sensor by sensor in
Python; the numbers are those that the SimPy engine draws.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from netkf.engines.compiled.nonlinear_samples import block_of, nonlinear_table
from netkf.engines.compiled.own_sensors import is_own
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.samples import entries_of
from netkf.engines.compiled.slot_pairs import PairColumns
from netkf.engines.compiled.state import Instants
from netkf.engines.compiled.ticks import clocks_of, draw_instants, is_kernel_clock
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.portable import cholesky
from netkf.network.clocks import LinkClock
from netkf.plants import sampling
from netkf.plants.readings import read_many
from netkf.plants.sensors import LinearSensor
from netkf.rng.draws import Ziggurat, ziggurat
from netkf.rng.numbers import next_normal, normal_ziggurat
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.sampling import all_sample_times
from netkf.scenario.scenario import Scenario

ONE_RUN: np.ndarray = np.zeros(2, dtype=np.int64)


class SampledSensor(NamedTuple):
    """One sensor: the ``times`` (K,) in seconds of its ``samples``, their ``indices`` (K,) among
    all samples of the run, whether each has an H of its own, the index of its filter, and whether
    it is linear and read from a record.
    """

    times: FloatArray
    samples: sampling.Samples
    indices: np.ndarray
    varying: bool
    filter: int
    linear: bool
    recorded: bool


class SampleInstants(Protocol):
    """The samples of one run, sorted by time into ``instants`` (each a time at which a node takes
    samples and uses them in one update); ``sampled`` (T,) are all their times, in seconds.
    """

    instants: Instants
    sampled: FloatArray

    def read(self, states: FloatArray, times: FloatArray, after: float, until: float) -> None:
        """Fill in the values ``instants.y`` (and H, where it varies) of the samples taken in
        (``after``, ``until``] seconds, from the states (T, n) at T ``times`` (T,), which contain
        their times; they do not depend on estimates.
        """


def samples_of(scenario: Scenario, streams: Streams) -> SampleInstants:
    """Return the samples of a run, drawn in compiled code if possible."""
    cls = KernelSamples if kernel_sensors(scenario) is not None else SampleTables
    return cls(scenario, streams)


class EntryClock(NamedTuple):
    """The clock of K sensors of one entry: their ``indices`` (K,), the ``keys`` of their streams,
    and their ``rates`` (K,) in 1/s.
    """

    clock: LinkClock
    indices: np.ndarray
    keys: list[tuple[int, int]]
    rates: FloatArray


class KernelSensors(NamedTuple):
    """What is drawn of S linear sensors, in the order of ``_placed_sensors``: the ``clocks`` of
    their entries, the ``keys`` of their streams, and the Cholesky factors ``root`` (S, p, p) of the
    true R.
    """

    clocks: list[EntryClock]
    keys: list[tuple[int, int]]
    root: FloatArray


@once_per_scenario
def kernel_sensors(scenario: Scenario) -> KernelSensors | None:
    """Return what kernels need to draw the samples of a scenario; None if they cannot."""
    placed, tables = _placed_sensors(scenario), _sensor_tables(scenario)
    parts = [scenario.sensors[p.entry] for _, p in placed]
    # By exact type: a subclass may override the law.
    if (
        not placed
        or scenario.network.clocks
        or any(
            type(part) is not LinearSensor or is_own(part) or not is_kernel_clock(part.sampling)
            for part in parts
        )
    ):
        return None
    keys, entries = [(node, p.ordinal) for node, p in placed], [p.entry for _, p in placed]
    clocks, root = [], np.zeros_like(tables.root)
    for entry in dict.fromkeys(entries):
        indices = np.flatnonzero(np.array(entries) == entry)
        clock: Any = parts[indices[0]].sampling
        own = [keys[k] for k in indices]
        rates = np.array([clock.mean_rate(key) for key in own])
        clocks.append(EntryClock(clock, indices, own, rates))
        R = cholesky(parts[indices[0]].R)
        root[indices, : len(R), : len(R)] = R
    return KernelSensors(clocks, keys, root)


class KernelSamples:
    """The samples of linear sensors with built-in clocks, of one run or of several. Those of run r
    are number ``edges[r]`` to ``edges[r + 1]`` - 1 of all, taken at ``t`` (K,), seconds.
    """

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        sensors = kernel_sensors(scenario)
        assert sensors is not None
        self._tables, self._root = _sensor_tables(scenario), sensors.root
        parts = [self._times(scenario, streams, entry) for entry in sensors.clocks]
        t, stream = (np.concatenate(column) for column in zip(*parts, strict=True))
        # Streams are numbered run by run.
        run, sensor = np.divmod(stream, len(sensors.keys))
        order = np.lexsort((sensor, t, run))
        self.t, self._stream = t[order], stream[order]
        self.edges = np.searchsorted(run[order], np.arange(streams.runs + 1))
        self.instants = _make_instants(scenario, self.t, sensor[order], self.edges)
        self.sampled = np.unique(self.t)
        self._noise = streams.states("noise", sensors.keys)

    @staticmethod
    def _times(
        scenario: Scenario, streams: Streams, entry: EntryClock
    ) -> tuple[FloatArray, np.ndarray]:
        """Return times (K,) and numbers of streams (K,) of all samples of one entry."""
        clock, indices, keys, rates = entry
        expected = scenario.horizon * float(rates.sum()) * streams.runs
        space = int(expected + 8.0 * math.sqrt(expected)) + len(keys) * streams.runs + 8
        numbers = indices + len(_placed_sensors(scenario)) * np.arange(streams.runs)[:, None]
        purposes, per_second = ("sampling", "sampling phase"), scenario.time_grid.per_second
        while True:
            clocks = clocks_of(clock, keys, rates, streams, purposes, per_second)
            t, entity = np.empty(space), np.empty(space, dtype=np.int64)
            tables = ziggurat(), normal_ziggurat()
            count = draw_instants(clocks, scenario.horizon, *tables, t, entity)
            if count >= 0:
                return t[:count], numbers.ravel()[entity[:count]]
            space *= 2

    def read(self, states: FloatArray, times: FloatArray, after: float, until: float) -> None:
        """Fill in the values of the samples taken in (``after``, ``until``], see SampleInstants."""
        first, last = np.searchsorted(self.t, [after, until], side="right")
        self.read_from(first, states[np.searchsorted(times, self.t[first:last])])

    def read_from(self, first: int, states: FloatArray) -> None:
        """Fill in the values of the samples number ``first`` and on, taken in ``states`` (K, n)."""
        tables = self._tables
        draw_samples(
            self._noise, normal_ziggurat(), first, self._stream, tables.rows, self._root,
            tables.H, np.ascontiguousarray(states), self.instants.y,
        )  # fmt: skip


@kernel(allocates=True)
def draw_samples(
    noise: np.ndarray,
    ziggurat: Ziggurat,
    first: int,
    stream: IntArray,
    rows: IntArray,
    root: FloatArray,
    H: FloatArray,
    states: FloatArray,
    y: FloatArray,
) -> None:
    """Write the samples ``y[first:]`` (K, p) of the next K of all, taken in ``states`` (K, n):
    H x + v, with v the ``root`` (S, p, p) times the next normals of the states of streams ``noise``
    (R S, WIDTH) number ``stream[first:]``, that of the sensor in its run, run by run.
    """
    z = np.empty(H.shape[1])
    for k in range(len(states)):
        s, x = stream[first + k] % len(rows), states[k]
        for i in range(rows[s]):
            z[i] = next_normal(noise, stream[first + k], ziggurat)
        for i in range(rows[s]):
            value, drawn = 0.0, 0.0
            for j in range(len(x)):
                value += H[s, i, j] * x[j]
            for j in range(rows[s]):
                drawn += root[s, i, j] * z[j]
            y[first + k, i] = value + drawn


class SampleTables:
    """The samples of any sensors, see SampleInstants."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        times = scenario.sample_times(streams)
        self.sampled = all_sample_times(times)
        if not scenario.sampled_sensors:
            self._sensors, self.instants = [], no_instants(scenario)
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
                int(h),
                scenario.sensors[placed_sensor.entry].linear,
                scenario.sensors[placed_sensor.entry].record is not None,
            )
            for (node, placed_sensor), indices, varies, h in zip(
                placed,
                parts,
                _sensor_tables(scenario).varying,
                _sensor_tables(scenario).filter,
                strict=True,
            )
        ]
        self._columns = None if scenario.views is None else _sensor_tables(scenario).columns
        self.instants = _make_instants(scenario, t[order], sensor[order])
        for (_, placed_sensor), sampled in zip(placed, self._sensors, strict=True):
            has_noise = sampled.varying and hasattr(sampled.samples, "covariance")
            if has_noise and sampled.linear:
                R = scenario.noise_covariance(placed_sensor.entry, believed=True)
                _add_noises(self.instants, sampled.samples, sampled.indices, R)

    def read(self, states: FloatArray, times: FloatArray, after: float, until: float) -> None:
        """Fill in the values of the samples taken in (``after``, ``until``], see SampleInstants."""
        instants = self.instants
        for sensor in self._sensors:
            # (after, until]: a time at the border of two blocks is read once.
            first, last = np.searchsorted(sensor.times, [after, until], side="right")
            if first == last:
                continue
            sample_times = sensor.times[first:last]
            # The state at each sample; ``times`` contains all of them.
            x = states[np.searchsorted(times, sample_times)]
            if not sensor.linear:
                # Recorded values are in the table already.
                for k in range(first, last if not sensor.recorded else first):
                    y = sensor.samples.reading(k, x[k - first])[0]
                    instants.y[sensor.indices[k], : len(y)] = y
                continue
            y, H = read_many(sensor.samples, range(first, last), x)
            indices, p = sensor.indices[first:last], y.shape[1]
            instants.y[indices, :p] = y
            if sensor.varying:
                if self._columns is None:
                    instants.H[instants.matrix[indices], :p] = H
                else:
                    self._set_matrices(self._columns, sensor, indices, H)

    def _set_matrices(
        self, columns: PairColumns, sensor: SampledSensor, indices: np.ndarray, H: FloatArray
    ) -> None:
        """Write the H (K, p, N) of samples, and of which block beside their filter's they are."""
        instants, p = self.instants, H.shape[1]
        for k, matrix in zip(indices.tolist(), H, strict=True):
            place = columns.other(sensor.filter, np.flatnonzero(matrix.any(axis=0)))
            instants.H[instants.matrix[k], :p] = columns.of(sensor.filter, matrix, place)
            instants.block[k] = block_of(columns, place)


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
def no_instants(scenario: Scenario) -> Instants:
    """Return the instants of all runs of a scenario without sampled sensors: none."""
    return _make_instants(scenario, np.empty(0), np.empty(0, dtype=np.int64))


class SensorTables(NamedTuple):
    """What a scenario says of its S sampling sensors, of up to p rows: ``node`` (id) and ``filter``
    (index) of each (S,), ``rows`` (S,), whether its H varies, the Cholesky factor ``root``
    (S, p, p) of the R that filters believe, and H (S, p, n); ``columns`` are those of filters, and
    ``own`` and ``block`` H in them (S, p, w) and ``Instants.block`` (S,).
    """

    node: np.ndarray
    filter: np.ndarray
    rows: np.ndarray
    varying: np.ndarray
    root: FloatArray
    H: FloatArray
    columns: PairColumns
    own: FloatArray
    block: np.ndarray


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
        # Nonlinear ones are whitened where they are used.
        of_noise = np.linalg.cholesky(R) if part.linear else np.eye(len(R))
        root[k, : len(R), : len(R)], H[k, : len(R)] = of_noise, part.matrix_of(n)
    filters = [0 if pooled else index[node] for node, _ in placed]
    columns = PairColumns(scenario, entries_of(scenario))
    places = [
        columns.other(h, np.flatnonzero(matrix.any(axis=0)))
        for h, matrix in zip(filters, H, strict=True)
    ]
    own = [columns.of(*parts) for parts in zip(filters, H, places, strict=True)]
    return SensorTables(
        node=np.array([node for node, _ in placed], dtype=np.int64),
        filter=np.array(filters, dtype=np.int64),
        rows=rows,
        varying=np.array([part.varying or is_own(part) for part, _ in parts], dtype=bool),
        root=root,
        H=H,
        columns=columns,
        own=np.reshape(own, (len(parts), max_rows, columns.width)),
        block=np.array([block_of(columns, place) for place in places], dtype=np.int64),
    )


def _make_instants(
    scenario: Scenario, t: FloatArray, sensor: np.ndarray, edges: np.ndarray = ONE_RUN
) -> Instants:
    """Return times of samples; one that never comes ends each run, of those between ``edges``."""
    tables = _sensor_tables(scenario)
    # Sensors whose H varies get a matrix for each sample, behind the fixed ones.
    varying, count = tables.varying[sensor], len(tables.rows)
    own = int(varying.sum())
    matrix, H = sensor.copy(), tables.own
    if own:
        matrix[varying] = count + np.arange(own)
        H = np.concatenate([H, np.zeros((own, *H.shape[1:]))])
    filters = tables.filter[sensor]
    # Samples of one node at one time are one instant, and one update.
    begins = np.ones(len(t), dtype=bool)
    begins[1:] = (np.diff(t) != 0.0) | (np.diff(filters) != 0)
    if len(edges) > 2:
        begins[edges[edges < len(t)]] = True
    first, block = np.flatnonzero(begins), tables.block[sensor]
    times, index = t[first], filters[first]
    if len(edges) > 2:
        places = np.searchsorted(first, edges[1:])
        times, index = np.insert(times, places, math.inf), np.insert(index, places, 0)
        first = np.insert(first, places, edges[1:])
    y, after = np.zeros((len(t), tables.H.shape[1])), np.append(first, len(t))
    read = {"first": after, "block": block, "matrix": matrix, "values": y, "matrices": H}
    return Instants(
        t=times,
        index=index,
        first=after,
        node=tables.node[sensor],
        y=y,
        sensor=sensor,
        matrix=matrix,
        block=block,
        rows=tables.rows,
        root=tables.root,
        H=H,
        scale=np.ones(0 if scenario.filter.gate is None else len(t)),
        nonlinear=nonlinear_table(scenario, sensor, t, read),
    )
