"""Power series in the gap for filters in lanes: a table with increment sensors, and one without.

A prediction needs some dozen values that depend on the gap alone (Q_g, exp(A g), F and G_g, see
kernels.root_flow), and a reading as many gains (kernels.gains). Both are power series; here they
are expanded around the same gaps, so that one evaluation serves both. Equal columns - most of them
0, if the axes of a plant are independent - are evaluated once.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.root_flow import CELL_BYTES, USED_BLOCKS
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.state import Filters, filters_at_start
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.lanes import LANES, aligned
from netkf.linalg.series import MANY_TERMS, NOTHING
from netkf.linalg.structs import Struct
from netkf.scenario.scenario import Scenario

ROUNDING = 2.0**-52
"""Share of the largest term of an entry below which terms are left out."""

PARTS = 4
"""Parts into which a cell of FlowTable is divided, since shorter cells need fewer terms; fewer
parts if the table of a model would be larger than CELL_BYTES.
"""

NEAR = 2
"""Number of first cells whose series need more terms, since entries vanish at 0."""


class LaneSeries(Struct):
    """Power series of E values for M models, in W columns of distinct values.

    series : (M, cells, terms, W) coefficients of W columns, around 0 in cell 0 and around the
             middles of the other cells
    unit : (M,), length of a cell, seconds
    column : (E,), value e is this column; equal values share one
    row : model m of a FlowTable is model ``row[m]`` here
    far_terms : number of terms that cells from NEAR on need
    """

    series: FloatArray
    unit: FloatArray
    column: IntArray
    row: IntArray
    far_terms: int


@once_per_scenario
def series_of_lanes(scenario: Scenario) -> tuple[LaneSeries, LaneSeries]:
    """Return the power series by which nodes are predicted side by side (one in each SIMD lane):
    those for nodes without increment sensors, and those for nodes that read increments.
    """
    filters = filters_at_start(scenario)
    period = float(scenario.diffusion.sensing_period or 0.0)
    n, table = filters.xhat.shape[1], filters.table
    # Models without a sensor.
    selected = table.sizes[:, USED_BLOCKS] == 0
    width = n * (n + 1) // 2 + n * n
    # Q_g, the covariance of the noise over the gap g (a triangle), and exp(A g).
    unobserved = _united(table.series[selected][..., :width], table.unit[selected], selected)
    return unobserved, sensing_series(filters, period)


def max_moments(filters: Filters) -> int:
    """Return the largest number q of moments that a node reads over an interval: each of its p rows
    of increments gives two, weighted by 1 and by the Legendre polynomial P_1 of the interval.
    """
    return int(filters.gains.moments.max())


def sensing_series(filters: Filters, period: float) -> LaneSeries:
    """Return the power series in the gap g, up to ``period`` seconds, of all models with increment
    sensors. A model is the matrices with which a node predicts and reads. The order of values:

    Q_g, exp(A g), F, G_g : noise, transition without readings, transition and information of the
        readings (Q_g and G_g as lower triangles); P moves to ``Q_g + F P (I + G_g P)^-1 F'``
    U, W, C : gains by which the q moments of a reading correct the mean, 3 n q values
        (kernels.gains)
    """
    n, table = filters.xhat.shape[1], filters.table
    width, selected = n * (n + 1) + 2 * n * n, table.sizes[:, USED_BLOCKS] > 0
    # Readings of more than a step of the sensing grid are never used at once.
    cells = min(table.series.shape[1], math.ceil(period / table.unit.min()) + 1)
    unit = table.unit[selected]
    flow = table.series[selected][:, :cells, :, :width]
    gains = padded_gains(filters)[selected[:-1]]  # the last model, without sensors, has none
    terms = max(flow.shape[2], gains.shape[1])
    # One series of all values: prediction first, gains behind it.
    combined = np.zeros((*flow.shape[:2], terms, width + gains.shape[2]))
    combined[:, :, : flow.shape[2], : flow.shape[3]] = flow
    for k in range(len(combined)):
        for cell in range(cells):
            # Cell 0 is expanded at 0 and the others at their middles.
            middle = (cell + 0.5) * unit[k] if cell else 0.0
            combined[k, cell, : gains.shape[1], width:] = expand_around(gains[k], middle)
    return _united(combined, unit, selected)


def expand_around(series: FloatArray, middle: float) -> FloatArray:
    """Return the coefficients (terms, ...) around ``middle`` of the power series with the
    coefficients ``series`` (terms, ...) around 0. Cells of the gap other than the first are
    expanded around their middles, where fewer terms suffice.
    """
    terms = len(series)
    powers = np.longdouble(middle) ** np.arange(terms)
    # Coefficient k of the shifted series: sum over j >= k of binomial(j, k) middle^(j - k) c_j.
    shift = np.zeros((terms, terms), dtype=np.longdouble)
    for k in range(terms):
        for j in range(k, terms):
            shift[k, j] = math.comb(j, k) * powers[j - k]
    result = shift @ series.reshape(terms, -1).astype(np.longdouble)
    return result.astype(np.float64).reshape(series.shape)


def padded_gains(filters: Filters) -> FloatArray:
    """Return the series (M, terms, 3 n q) of the gains U, W and C of all M models (matrices by
    which nodes predict and read), padded with zeros to the largest number q of moments: lanes of
    different models can then be computed together. U (n, q) and W (n, q) correct the mean by the
    moments of a reading, with K = U + P W; C (q, n) predicts these moments.
    """
    n, max_rows, gains = filters.xhat.shape[1], max_moments(filters), filters.gains
    terms = gains.series.shape[1]
    padded = np.zeros((len(gains.series), terms, 3 * n * max_rows))
    for k, q in enumerate(gains.moments.tolist()):
        if not q:
            continue
        # First moments of all rows come before the second ones.
        columns = np.concatenate([np.arange(q // 2), max_rows // 2 + np.arange(q // 2)])
        parts = np.split(gains.series[k, :, : 3 * n * q], 3, axis=1)
        padded_parts = [
            np.zeros((terms, n, max_rows)),
            np.zeros((terms, n, max_rows)),
            np.zeros((terms, max_rows, n)),
        ]
        for target, part in zip(padded_parts[:2], parts[:2], strict=True):
            target[:, :, columns] = part.reshape(terms, n, q)
        padded_parts[2][:, columns] = parts[2].reshape(terms, q, n)
        padded[k] = np.concatenate([part.reshape(terms, -1) for part in padded_parts], axis=1)
    return padded


def _united(series: FloatArray, unit: FloatArray, selected: np.ndarray) -> LaneSeries:
    """Return ``series`` with equal columns stored once, in shorter cells of fewer terms."""
    # Number the distinct columns in the order in which they first occur.
    indices: dict[bytes, int] = {}
    # 0.0 and not -0.0: they are the same number.
    columns = np.ascontiguousarray(np.moveaxis(series, -1, 0)) + 0.0
    column = np.array([indices.setdefault(values.tobytes(), len(indices)) for values in columns])
    first = np.unique(column, return_index=True)[1]
    series, unit = divide_cells(np.moveaxis(columns[first], 0, -1), unit)
    needed = terms_needed(series, unit)
    terms = number_of_terms(needed, series.shape[2])
    series = series[:, :, :terms]
    # A multiple of the lanes, see series.fill_row.
    width = -(-len(first) // LANES) * LANES
    padded: FloatArray = aligned((*series.shape[:2], terms, width))
    padded[:, :, : series.shape[2], : len(first)] = series
    return LaneSeries(
        series=padded,
        unit=unit,
        column=column.astype(np.int64),
        # Meaningful for selected models only: the number of selected ones before each.
        row=np.cumsum(selected) - 1,
        far_terms=number_of_terms(needed[NEAR:], terms),
    )


def divide_cells(series: FloatArray, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the series (M, cells, terms, E) of E values in M models in shorter cells, and the
    length (M,) of these in seconds; ``unit`` (M,) is the length of the present cells of ``series``.
    A shorter cell needs fewer terms for the same accuracy.
    """
    models, cells, terms, entries = series.shape
    parts = PARTS
    while parts > 1 and cells * parts * MANY_TERMS[-1] * entries * series.itemsize > CELL_BYTES:
        parts //= 2
    if parts == 1:
        return series, unit
    divided = np.empty((models, cells, parts, terms, entries))
    for k in range(models):
        for part in range(parts):
            share = (part + 0.5) / parts
            # Series of cell 0 are around its start, and those of the others around their middles.
            divided[k, 0, part] = expand_around(series[k, 0], share * unit[k] if part else 0.0)
            other_cells = expand_around(np.moveaxis(series[k, 1:], 1, 0), (share - 0.5) * unit[k])
            divided[k, 1:, part] = np.moveaxis(other_cells, 0, 1)
    return divided.reshape(models, cells * parts, terms, entries), unit / parts


def terms_needed(series: FloatArray, unit: FloatArray) -> IntArray:
    """Return the number of terms (cells,) that each cell needs of ``series`` (M, cells, terms, E),
    whose cells are ``unit`` (M,) seconds long: what follows is below rounding at the ends of the
    cell, for all E entries of all M models. A cell is an interval with an expansion of its own.
    """
    # Largest distance from the expansion point: half a unit from the middle of a cell, a whole unit
    # in the first cell, which is expanded around its start.
    spans = np.repeat(0.5 * unit[:, None], series.shape[1], axis=1)
    spans[:, :1] *= 2.0
    sizes = np.abs(series) * (spans[..., None] ** np.arange(series.shape[2]))[..., None]
    remainder = np.cumsum(sizes[:, :, ::-1], axis=2)[:, :, ::-1]
    largest = sizes.max(axis=2, keepdims=True)
    # Relative to each entry, and for entries that are nearly 0 relative to the largest one.
    tolerance = ROUNDING * largest + NOTHING * largest.max(axis=3, initial=0.0, keepdims=True)
    return np.asarray((remainder > tolerance).any(axis=(0, 3)).sum(axis=1))


def number_of_terms(needed: IntArray, max_terms: int) -> int:
    """Return the number of terms to evaluate in all cells, which need ``needed`` (cells,), at most
    ``max_terms``: the next number for which ``series.fill_row`` is unrolled, if there is one.
    """
    min_terms = int(needed.max(initial=0))
    return next((terms for terms in MANY_TERMS if terms >= min_terms), max_terms)
