"""The series that filters side by side need, one table for those that read and one for the others.

A prediction needs some dozen values that depend on the gap alone, and a reading as many gains.
Both are power series; here they are expanded around the same gaps, so that one sum serves both.
Values that are the same for all models and gaps - most of them 0, if axes of a plant are
independent - are summed once.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.root_flow import CELL_BYTES
from netkf.engines.compiled.kept import once_per_scenario
from netkf.engines.compiled.state import Filters, filters_at_start
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.lanes import LANES, aligned
from netkf.linalg.series import MANY_TERMS, NOTHING
from netkf.linalg.structs import Struct
from netkf.scenario.scenario import Scenario

ROUNDING = 2.0**-52
"""Of the largest term of an entry, what may be left out."""

PARTS = 4
"""Parts that a cell of FlowTable is divided into, since shorter cells need fewer terms; fewer parts
where the table of a model would be larger than CELL_BYTES.
"""

NEAR = 2
"""Cells so near to 0, where entries vanish, that their series need more terms."""


class LaneSeries(Struct):
    """Power series in cells of ``unit`` (M,) seconds: ``series`` (M, cells, terms, W) of columns,
    around 0 in cell 0 and around the middles of the others, of which those from NEAR on need
    ``far_terms`` only. Entry e of the values is column ``place[e]`` (E,). Model m of FlowTable is
    ``row[m]`` here.
    """

    series: FloatArray
    unit: FloatArray
    place: IntArray
    row: IntArray
    far_terms: int


@once_per_scenario
def series_of_lanes(scenario: Scenario) -> tuple[LaneSeries, LaneSeries]:
    """Return the series for nodes without sensors and for nodes that read increments."""
    filters = filters_at_start(scenario)
    period = float(scenario.truth.sensing_period or 0.0)
    return unobserved_series(filters), sensing_series(filters, period)


def most_moments(filters: Filters) -> int:
    """Return the largest number of moments that a node reads."""
    return int(filters.gains.moments.max())


def unobserved_series(filters: Filters) -> LaneSeries:
    """Return the series of Q_g and exp(A g), for nodes without sensors."""
    n, table = filters.xhat.shape[1], filters.table
    mine = table.sizes[:, 1] == 0
    width = n * (n + 1) // 2 + n * n
    return _united(table.series[mine][..., :width], table.unit[mine], mine)


def sensing_series(filters: Filters, period: float) -> LaneSeries:
    """Return the series of Q_g, exp(A g), F and G_g with the gains U, W and C, for gaps up to
    ``period`` seconds.
    """
    n, table = filters.xhat.shape[1], filters.table
    width, mine = n * (n + 1) + 2 * n * n, table.sizes[:, 1] > 0
    # Readings of more than a step of the sensing grid are never used at once.
    cells = min(table.series.shape[1], math.ceil(period / table.unit.min()) + 1)
    unit = table.unit[mine]
    flow = table.series[mine][:, :cells, :, :width]
    gains = padded_gains(filters)[mine[:-1]]  # the last model has no sensors
    terms = max(flow.shape[2], gains.shape[1])
    whole = np.zeros((*flow.shape[:2], terms, width + gains.shape[2]))
    whole[:, :, : flow.shape[2], : flow.shape[3]] = flow
    for k in range(len(whole)):
        for cell in range(cells):
            # Cell 0 is expanded at 0 and the others at their middles.
            middle = (cell + 0.5) * unit[k] if cell else 0.0
            whole[k, cell, : gains.shape[1], width:] = shifted(gains[k], middle)
    return _united(whole, unit, mine)


def shifted(series: FloatArray, middle: float) -> FloatArray:
    """The power series (terms, ...) around 0 as one around ``middle``."""
    terms = len(series)
    powers = np.longdouble(middle) ** np.arange(terms)
    # Coefficient k of the shifted series: sum over j >= k of binomial(j, k) middle^(j - k) c_j.
    shift = np.zeros((terms, terms), dtype=np.longdouble)
    for k in range(terms):
        for j in range(k, terms):
            shift[k, j] = math.comb(j, k) * powers[j - k]
    moved = shift @ series.reshape(terms, -1).astype(np.longdouble)
    return moved.astype(np.float64).reshape(series.shape)


def padded_gains(filters: Filters) -> FloatArray:
    """Return the series of the gains of all models (M, terms, 3 n q), padded with 0 to the most
    rows of any.
    """
    n, most, gains = filters.xhat.shape[1], most_moments(filters), filters.gains
    known = gains.series.shape[1]
    made = np.zeros((len(gains.series), known, 3 * n * most))
    for k, q in enumerate(gains.moments.tolist()):
        if not q:
            continue
        # First moments of all rows come before the second ones.
        columns = np.concatenate([np.arange(q // 2), most // 2 + np.arange(q // 2)])
        parts = np.split(gains.series[k, :, : 3 * n * q], 3, axis=1)
        whole = [np.zeros((known, n, most)), np.zeros((known, n, most)), np.zeros((known, most, n))]
        for target, part in zip(whole[:2], parts[:2], strict=True):
            target[:, :, columns] = part.reshape(known, n, q)
        whole[2][:, columns] = parts[2].reshape(known, q, n)
        made[k] = np.concatenate([part.reshape(known, -1) for part in whole], axis=1)
    return made


def _united(series: FloatArray, unit: FloatArray, mine: np.ndarray) -> LaneSeries:
    """The table of series (M, cells, terms, E), of the models that are ``mine``, with each column
    once and no more terms than cells of ``unit`` (M,) seconds need.
    """
    found: dict[bytes, int] = {}
    # 0.0 and not -0.0: they are the same number.
    columns = np.ascontiguousarray(np.moveaxis(series, -1, 0)) + 0.0
    place = np.array([found.setdefault(column.tobytes(), len(found)) for column in columns])
    first = np.unique(place, return_index=True)[1]
    series, unit = divided(np.moveaxis(columns[first], 0, -1), unit)
    needed = terms_needed(series, unit)
    terms = number_of_terms(needed, series.shape[2])
    series = series[:, :, :terms]
    # Whole lanes, see series.fill_row.
    width = -(-len(first) // LANES) * LANES
    made: FloatArray = aligned((*series.shape[:2], terms, width))
    made[:, :, : series.shape[2], : len(first)] = series
    return LaneSeries(
        series=made,
        unit=unit,
        place=place.astype(np.int64),
        row=np.cumsum(mine) - 1,
        far_terms=number_of_terms(needed[NEAR:], terms),
    )


def divided(series: FloatArray, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the series (M, cells, terms, E) in shorter cells, and the seconds of these."""
    models, cells, terms, entries = series.shape
    parts = PARTS
    while parts > 1 and cells * parts * MANY_TERMS[-1] * entries * series.itemsize > CELL_BYTES:
        parts //= 2
    if parts == 1:
        return series, unit
    made = np.empty((models, cells, parts, terms, entries))
    for k in range(models):
        for part in range(parts):
            share = (part + 0.5) / parts
            # Series of cell 0 are around its start, and those of the others around their middles.
            made[k, 0, part] = shifted(series[k, 0], share * unit[k] if part else 0.0)
            rest = shifted(np.moveaxis(series[k, 1:], 1, 0), (share - 0.5) * unit[k])
            made[k, 1:, part] = np.moveaxis(rest, 0, 1)
    return made.reshape(models, cells * parts, terms, entries), unit / parts


def terms_needed(series: FloatArray, unit: FloatArray) -> IntArray:
    """Return for each cell the number of terms after which no entry of any model has more than
    rounding left at the ends of the cell.
    """
    # From its middle a cell reaches half a unit, but the first one reaches a whole unit.
    spans = np.repeat(0.5 * unit[:, None], series.shape[1], axis=1)
    spans[:, :1] *= 2.0
    sizes = np.abs(series) * (spans[..., None] ** np.arange(series.shape[2]))[..., None]
    left = np.cumsum(sizes[:, :, ::-1], axis=2)[:, :, ::-1]
    largest = sizes.max(axis=2, keepdims=True)
    most = ROUNDING * largest + NOTHING * largest.max(axis=3, initial=0.0, keepdims=True)
    return np.asarray((left > most).any(axis=(0, 3)).sum(axis=1))


def number_of_terms(needed: IntArray, most: int) -> int:
    """Return how many terms to add up in cells that need so many, at most ``most``: a number that
    ``series.fill_row`` adds up fast if there is one.
    """
    least = int(needed.max(initial=0))
    return next((terms for terms in MANY_TERMS if terms >= least), most)
