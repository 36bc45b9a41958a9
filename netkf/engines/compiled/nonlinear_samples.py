"""Samples under clocks that are not linear, linearised where their node uses them.

Until then the table of samples holds their values themselves, and in place of H what they are
measured from (``kernels.nonlinear_rows``); the node writes the whitened linear readings there.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.nonlinear_rows import (
    LINEAR,
    NonlinearRows,
    copy_sensor,
    linear_rows,
    linearise_reading,
    no_nonlinear,
)
from netkf.algorithms.kernels.pairs import Pairs
from netkf.algorithms.kernels.run import Estimates
from netkf.core.places import Place
from netkf.engines.compiled.nonlinear_rows import NonlinearSetup
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.samples import entries_of
from netkf.engines.compiled.slot_pairs import PairColumns
from netkf.engines.compiled.state import NOBODY
from netkf.linalg.addresses import reads_only
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size, Struct
from netkf.scenario.scenario import Scenario


class NonlinearTable(Struct):
    """What the S samples of a run need of sensors that are not linear.

    sensor, noise : (S,), the number of a sample in ``known``, -1 if it is linear, and of its R
    R : (M, p, p), covariances of noise
    origin : (S or 1, N), where the states of the plant are counted from at each sample
    known : NonlinearRows of all sensors
    first, block, matrix, values, matrices : fields of the samples' Instants, of which ``values``
        and ``matrices`` are y and H
    rows, size, y, H, first_y : scratch for the samples of one instant: one filter, with as many
                                rows as these have, and what is read of it as in a run
    """

    sensor: IntArray
    noise: IntArray
    R: FloatArray
    origin: FloatArray
    known: NonlinearRows
    first: IntArray
    block: IntArray
    matrix: IntArray
    values: FloatArray
    matrices: FloatArray
    rows: NonlinearRows
    size: Size
    y: FloatArray
    H: FloatArray
    first_y: int


@kernel
def linearise_instant(record: Any, h: int, instant: int, table: NonlinearTable) -> None:
    """Replace nonlinear samples of an ``instant`` by whitened linear ones at ``h``'s estimate."""
    rows, p = table.rows, 0
    for i in range(rows.kind.shape[1]):
        rows.kind[0, i] = LINEAR
    for s in range(table.first[instant], table.first[instant + 1]):
        if table.sensor[s] >= 0 and table.block[s] == -1:
            count = copy_sensor(rows, 0, p, table.known, table.sensor[s])
            for i in range(count):
                table.y[0, p + i, 0] = table.values[s, i]
                for j in range(len(table.size)):
                    table.H[0, p + i, j, 0] = table.matrices[table.matrix[s], i, j]
                for j in range(p + count):
                    noise = table.R[table.noise[s], i, j - p] if j >= p else 0.0
                    rows.R[0, 0, p + i, j] = rows.R[0, 0, j, p + i] = noise
            copy_origin(rows, table, s)
            p += count
    if p == 0:
        return
    linearise_reading(rows, record, h, table, 0, 0, 0)
    p = 0
    for s in range(table.first[instant], table.first[instant + 1]):
        if table.sensor[s] >= 0 and table.block[s] == -1:
            for i in range(table.known.kind.shape[1]):
                if table.known.kind[table.sensor[s], i] != LINEAR:
                    table.values[s, i] = table.y[0, p, 0]
                    for j in range(len(table.size)):
                        table.matrices[table.matrix[s], i, j] = table.H[0, p, j, 0]
                    p += 1


reads_only(Estimates, linearise_instant)


@kernel
def copy_origin(rows: NonlinearRows, table: NonlinearTable, s: int) -> None:
    """Let the states of ``rows`` be counted from where they are at sample ``s``."""
    for j in range(rows.origin.shape[1]):
        rows.origin[0, j] = table.origin[min(s, len(table.origin) - 1), j]


@kernel
def set_pair(pairs: Pairs, k: int, table: NonlinearTable, s: int) -> None:
    """Make pair number ``k`` of a run what sample ``s`` reads, which is not linear."""
    rows, matrix = pairs.rows, table.matrix[s]
    count = copy_sensor(rows, k, 0, table.known, table.sensor[s])
    for i in range(count):
        for j in range(count):
            rows.R[0, k, i, j] = table.R[table.noise[s], i, j]
        for j in range(table.matrices.shape[2]):
            pairs.places[k, i, j, 0] = table.matrices[matrix, i, j]
    pairs.sensor[k] = table.sensor[s]
    copy_origin(rows, table, s)


@kernel
def set_linear(pairs: Pairs, k: int) -> None:
    """Make pair number ``k`` of a run a linear one, whose rows are white."""
    for i in range(pairs.rows.kind.shape[1]):
        pairs.rows.kind[k, i] = LINEAR
        for j in range(pairs.rows.kind.shape[1]):
            pairs.rows.R[0, k, i, j] = 1.0 if i == j else 0.0


class NonlinearSensors(NamedTuple):
    """What kernels know of the S sampled sensors of a scenario: of number k those of its readings
    that are of what its filter estimates, of number S + k those that are of another block too. With
    the ``R`` (S, p, p) that filters believe, the sensors, each with its node (id) and the index of
    its filter, and the anchor of which such a block is; where there are more they are alike.
    """

    setup: NonlinearSetup
    columns: PairColumns
    R: FloatArray
    sensors: list[tuple[Any, int, int]]
    anchors: list[int]

    def of_pairs(self, method: str) -> tuple[NonlinearRows, FloatArray]:
        """Return the rows of all sensors as kernels take them, which linearise by a ``method``, and
        from where readings of pairs are measured, (2 S, p, n, 1).
        """
        count, (p, n) = len(self.sensors), (self.R.shape[1], self.columns.width)
        made = np.zeros((2 * count, p, n, 1))
        for k, (sensor, node, _) in enumerate(self.sensors):
            if self.setup.kind[count + k, 0] != LINEAR:
                anchor = node if self.anchors[k] < 0 else self.anchors[k]
                made[count + k, :, :, 0] = self.setup.reference(sensor, anchor, count + k)
        return self.setup.tables(method, 1), made


@once_per_scenario
def nonlinear_sensors(scenario: Scenario) -> NonlinearSensors:
    """Return what kernels know of the sampled sensors of a scenario."""
    index, pooled = scenario.topology.index, scenario.node_filter.timing.pooled
    placed = [(node, p) for node, many in scenario.sampled_sensors.items() for p in many]
    columns = PairColumns(scenario, entries_of(scenario))
    believed = [scenario.noise_covariance(p.entry, believed=True) for _, p in placed]
    count, p, w = len(placed), max(map(len, believed), default=1), columns.entries.shape[1]
    sensors = [
        (scenario.located_sensors[p.entry], node, 0 if pooled else index[node])
        for node, p in placed
    ]
    others = [columns.others(h, sensor, node) for sensor, node, h in sensors]
    entries, R = np.full((2 * count, columns.width), -1), np.zeros((count, p, p))
    for k, (noise, (_, _, h)) in enumerate(zip(believed, sensors, strict=True)):
        entries[[k, count + k], :w], R[k, : len(noise), : len(noise)] = columns.entries[h], noise
        for place in list(others[k].values())[:1]:
            entries[count + k, w : w + place.n] = np.arange(place.first, place.first + place.n)
    setup = NonlinearSetup(2 * count, p, entries)
    for k, (sensor, _, _) in enumerate(sensors):
        # In a record each row may be about another block.
        if not sensor.linear and (not others[k] or sensor.record is not None):
            setup.add(sensor, k, 0, believed[k])
        if not sensor.linear and others[k]:
            setup.add(sensor, count + k, 0, believed[k])
    anchors = [next(iter(other), -1) for other in others]
    return NonlinearSensors(setup, columns, R, sensors, anchors)


def nonlinear_table(
    scenario: Scenario, sensor: IntArray, t: FloatArray, instants: dict[str, Any]
) -> NonlinearTable:
    """Return the table of samples by these numbers of sensors (S,), at the times ``t`` (S,), with
    these fields of their ``instants``. Writes what they are measured from, and recorded values.
    """
    if all(one.linear for one in scenario.sensors):
        return no_table()
    known, method = nonlinear_sensors(scenario), scenario.filter.linearise
    tables = known.setup.tables(method, 1)
    is_linear = np.array([one.linear for one, _, _ in known.sensors], dtype=bool)
    believed = scenario.origin_response
    n, w, width = scenario.plant.n, known.columns.entries.shape[1], known.columns.width
    most = max(1, known.R.shape[1] * int(np.diff(instants["first"]).max(initial=1)))
    rows = linear_rows(1, most, np.full((1, width), -1))
    rows.center, rows.origin = tables.center, np.zeros((1, n))
    made = NonlinearTable(
        sensor=np.where(is_linear[sensor], -1, sensor),
        noise=sensor.copy(),
        R=known.R,
        origin=np.zeros((1, n)) if believed is None else np.array(believed.states(t), order="C"),
        known=tables,
        rows=rows,
        size=np.zeros(w),
        y=np.zeros((1, most, 1)),
        H=np.zeros((1, most, width, 1)),
        first_y=0,
        **instants,
    )
    for k in np.flatnonzero(~is_linear).tolist():
        _fill(made, known, k, np.flatnonzero(sensor == k))
    return made


@cache
def no_table() -> NonlinearTable:
    """Return the table of samples that are all linear."""
    none = np.zeros(0, dtype=np.int64)
    fields: dict[str, Any] = {
        **dict.fromkeys(("sensor", "noise", "first", "block", "matrix"), none),
        **dict.fromkeys(("known", "rows"), no_nonlinear()),
        **dict.fromkeys(("R", "y", "matrices"), np.zeros((0, 0, 0))),
        **dict.fromkeys(("origin", "values"), np.zeros((0, 0))),
    }
    return NonlinearTable(**fields, size=np.zeros(0), H=np.zeros((0, 0, 0, 0)), first_y=0)


def _fill(table: NonlinearTable, known: NonlinearSensors, k: int, samples: IntArray) -> None:
    """Write what the ``samples`` of sensor number ``k`` are measured from, and recorded values."""
    (sensor, node, h), columns, p = known.sensors[k], known.columns, len(known.sensors[k][0].R)
    rows = None if sensor.record is None else sensor.record.rows(node)
    noises = []
    for m, s in enumerate(samples.tolist()):
        anchor = -1 if rows is None else int(rows.anchors[m])
        place = columns.of_reading(h, sensor, anchor)
        table.block[s] = block_of(columns, place)
        if place is not None:
            # The other block comes behind the filter's own states, whichever it is.
            table.sensor[s], anchor = len(known.sensors) + k, known.anchors[k]
        of = known.setup.reference(sensor, node if anchor < 0 else anchor, table.sensor[s])
        of = of[: table.matrices.shape[2]]
        table.matrices[table.matrix[s], :p, : len(of)] = of
        if rows is not None:
            noise, there = known.R[k].copy(), np.flatnonzero(np.isfinite(rows.y[m]))
            noise[np.ix_(there, there)] = rows.covariance(m, known.R[k, :p, :p])
            table.values[s, :p] = rows.y[m]
            noises.append(noise)
    if noises:
        table.noise[samples] = len(table.R) + np.arange(len(noises))
        table.R = np.concatenate([table.R, noises])


def block_of(columns: PairColumns, place: Place | None) -> int:
    """Return the number of the block that a sample is also about, see ``Instants.block``."""
    number = columns.number(place)
    return number if place is None or number >= 0 else NOBODY
