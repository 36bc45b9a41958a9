"""Power series of matrices in a gap, summed up to as many terms as the gap needs.

A table (terms, size + 1) has the coefficients of ``size`` series in its rows; the last column has
the longest gap in seconds for which the rows up to this one suffice.
"""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, load, store

ROUNDING = 2.0**-56  # negligible remainder, relative to the largest term of an entry (eps / 16)
NOTHING = 1e-30  # the same relative to the largest entry, for entries that vanish
# Tuples whose length is the order of a polynomial, which the compiler knows from their type.
ORDER_7, ORDER_8, ORDER_9, ORDER_12, ORDER_16 = (0,) * 7, (0,) * 8, (0,) * 9, (0,) * 12, (0,) * 16
MANY_TERMS = (8, 10)  # numbers of terms for which fill_row() has unrolled loops
OCTAVES, STEPS = 8, 4  # gaps that are tried: halvings of the longest, and steps for each halving


def exponential_terms(size: float) -> int:
    """Return the number of terms of the power series of exp(M), at least 8, that are needed for a
    norm ``size`` of M: size^k / k!, which bounds the rest of the series, is then below rounding.
    """
    terms, term = 1, 1.0
    while term > 1e-18 or terms < 8:
        term *= size / terms
        terms += 1
    return terms


def with_reach(series: FloatArray, longest: float) -> FloatArray:
    """Return a table (terms, size + 1) for ``sum_k gap^k series[k]`` with ``series`` (terms, size),
    for gaps up to ``longest`` seconds.

    The last column has for each k the longest gap, in seconds, for which all terms after k are
    below rounding. The number of terms is made odd by a term of zeros.
    """
    # add_terms() takes two rows after the first at a time.
    if len(series) % 2 == 0:
        series = np.concatenate([series, np.zeros((1, series.shape[1]))])
    terms = len(series)
    # Gaps in quarter octaves, from the longest down to 2^-8 of it.
    gaps = longest * 2.0 ** (-np.arange(OCTAVES * STEPS + 1)[::-1] / STEPS)
    sizes = np.abs(series) * (gaps[:, None] ** np.arange(terms))[:, :, None]
    # Sum of the sizes of all later terms, for each gap, term and entry.
    remainder = np.cumsum(sizes[:, ::-1], axis=1)[:, ::-1] - sizes
    largest = sizes.max(axis=1)
    # Rounding is relative to each entry, with a floor relative to the largest, for entries that
    # vanish.
    limit = ROUNDING * largest + NOTHING * largest.max(axis=1, initial=0.0)[:, None]
    # Number of terms after which the rest of some entry is still above rounding, for each gap.
    needed = (remainder > limit[:, None]).any(axis=2).sum(axis=1)
    # maximum.accumulate: a longer gap must not need fewer terms because of rounding here.
    counts = np.searchsorted(np.maximum.accumulate(needed), np.arange(terms), side="right")
    reach = np.concatenate([[0.0], gaps])[counts]
    # The last row is always enough, so that loops end there.
    reach[-1:] = np.inf
    return np.column_stack([series, reach])


@kernel
def fill_series(
    out: FloatArray, width: int, series: FloatArray, reach: FloatArray, column: int, gap: float
) -> None:
    """Write the first ``width`` entries of ``sum_k gap^k series[k]`` at ``gap`` (seconds) into
    ``out`` (>= width,); ``series`` is (terms, >= width).

    ``reach`` (terms, ...) has in ``column`` the longest abs(gap) for which the terms up to each k
    suffice. Widths that are multiples of the lanes take the least time.
    """
    terms, distance = len(reach), abs(gap)
    # A number of terms known at compile time keeps the sums of entries in registers.
    if terms > 8 and distance <= reach[8, column]:
        horner(ORDER_8, out, width, series, gap)
    elif terms > 12 and distance <= reach[12, column]:
        horner(ORDER_12, out, width, series, gap)
    elif terms > 16 and distance <= reach[16, column]:
        horner(ORDER_16, out, width, series, gap)
    else:
        add_terms(out, width, series, reach, column, gap)


@kernel(inlined=True, fused=True)
def horner(
    order: tuple[int, ...], out: FloatArray, width: int, series: FloatArray, gap: float
) -> None:
    """Write ``sum_{k <= K} gap^k series[k]`` at ``gap`` (seconds) into ``out`` (width,), by
    Horner's scheme; ``order`` is a tuple of length K, which is then known when the kernel is
    compiled, and ``series`` is (> K, >= width).
    """
    whole = width - width % LANES
    for j in range(0, whole, LANES):
        block = load(MANY, series, len(order), j)
        for k in range(len(order) - 1, -1, -1):
            block = load(MANY, series, k, j) + gap * block
        store(MANY, out, j, block)
    for j in range(whole, width):
        total = series[len(order), j]
        for k in range(len(order) - 1, -1, -1):
            total = series[k, j] + gap * total
        out[j] = total


@kernel
def add_terms(
    out: FloatArray, width: int, series: FloatArray, reach: FloatArray, column: int, gap: float
) -> None:
    """Write ``sum_k gap^k series[k]`` at ``gap`` (seconds) into ``out`` (width,), with as many
    terms of ``series`` (terms, >= width) as ``reach`` (terms, ...) requires in this ``column``.
    """
    for j in range(width):
        out[j] = series[0, j]
    k, even = 0, 1.0
    while abs(gap) > reach[k, column]:  # two rows at a time, which halves the passes over ``out``
        odd = even * gap
        even = odd * gap
        for j in range(width):
            out[j] += odd * series[k + 1, j] + even * series[k + 2, j]
        k += 2


@kernel(inlined=True)
def fill_row(
    out: FloatArray, row: int, series: FloatArray, terms: int, m: int, cell: int, gap: float
) -> None:
    """Write the sum of ``gap^k series[m, cell, k]`` (W,) over k < ``terms`` into row ``row`` of
    ``out`` (L, W), for model ``m`` and cell ``cell``, an interval of gaps, at ``gap`` seconds from
    the gap that the cell is expanded around: 0 in the first cell, the middle in the others.

    ``series`` (M, cells, K, W) has K >= ``terms`` coefficients for each of M models; its width W is
    a multiple of L lanes. The numbers of terms in MANY_TERMS have unrolled loops.
    """
    if terms == len(ORDER_7) + 1:
        fill_blocks(ORDER_7, out, row, series, m, cell, gap)
    elif terms == len(ORDER_9) + 1:
        fill_blocks(ORDER_9, out, row, series, m, cell, gap)
    else:
        for j in range(0, series.shape[3], LANES):
            total = load(MANY, series, m, cell, terms - 1, j)
            for k in range(terms - 2, -1, -1):
                total = load(MANY, series, m, cell, k, j) + gap * total
            store(MANY, out, row, j, total)


@kernel(inlined=True, fused=True)
def fill_blocks(
    order: tuple[int, ...],
    out: FloatArray,
    row: int,
    series: FloatArray,
    m: int,
    cell: int,
    gap: float,
) -> None:
    """Write ``sum_k gap^k series[m, cell, k]`` (W,) over k <= len(order) into row ``row`` of
    ``out`` (L, W), by Horner's scheme for blocks of L entries at a time; ``series`` is
    (M, cells, K, W), with K coefficients of W entries for each of M models and each cell (interval)
    of gaps; ``m`` and ``cell`` choose one, and ``gap`` is in seconds from the centre of the cell.
    """
    for j in range(0, series.shape[3], LANES):
        total = load(MANY, series, m, cell, len(order), j)
        for k in range(len(order) - 1, -1, -1):
            total = load(MANY, series, m, cell, k, j) + gap * total
        store(MANY, out, row, j, total)


@kernel(allocates=True)
def polynomial(series: FloatArray, gap: float) -> FloatArray:
    """Return ``sum_k gap^k series[k]`` (size,) at ``gap`` (seconds), of a table ``series``
    (terms, size + 1) from with_reach(), as a new array.
    """
    # The last column of the table is the reach, not a coefficient.
    size = series.shape[1] - 1
    out = np.empty(size)
    fill_series(out, size, series, series, size, gap)
    return out
