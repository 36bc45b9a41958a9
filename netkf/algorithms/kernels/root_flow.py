"""The Riccati flow on roots: covariances ``P = S S'`` stay accurate however large they are.

By it Kalman-Bucy filters move from event to event, in both engines, for a plant ``dx = A x dt +
noise`` of covariance Q per second and sensors ``dy = H x dt + dv`` with noise of covariance R.

Over a gap g, ``P(g) = Q_g + F P (I + G_g P)^-1 F'`` and ``x(g) = exp(A g) x``, where G_g is the
information that the sensors give during the gap. With ``G_g = Gamma' Gamma`` and ``Q_g = T T'``
the root moves in three steps that subtract nothing: each row of Gamma is a scalar observation of
unit noise (estimates.rotate), F multiplies the root, and one elimination adds T.

If P is 1e12, rounding errors of G times P would act like information that no sensor gave. So Gamma
is not computed as a root of G. ``dG/dg = F(s)' H' R^-1 H F(s)``, hence with the coefficients c_j of
``R^-1/2 H F(s)`` in the Legendre polynomials of [0, g],

    Gamma = sqrt(g) [c_0; c_1 / sqrt(3); c_2 / sqrt(5); ...],   c_j of order g^j.

c_j is a power series in g, and as many of them are used as P and g need. P is called *wide* for a
gap that needs this, and *narrow* if P G is small enough for the rounding to be harmless, which is
nearly always so (NARROW). Then a gap takes one step instead: with ``I + S' G_g S = V V'`` and V
upper triangular, S V^-T is triangular and a root of ``P (I + G_g P)^-1``. Gaps are divided into
cells of length ``unit``; Q_g, F and G_g are power series around the middle of the cell that the gap
lies in. Longer gaps take tabulated steps of 1, 2, 4, ... units, the levels.

API. :func:`flow_table` tabulates one model, :func:`stack_tables` puts the tables of several
models side by side (a table is a stack of one); m is the index of a model in the stack. Kernels
work in place on entry ``k`` of root (K, n, n) (lower triangular, nothing above the diagonal is
read or written) and x (K, n), with scratch arrays from :func:`flow_scratch`:

    propagate_root(table, m, root, x, k, gap, scratch)            any gap > 0
    information_rate(lanes, size, whitened_H, S)                  trace(P G) in 1/s
    gain_root(size, moments, series, ...)                         readings of a gap, see gains.py

    lanes : ONE for a single run or MANY for L runs side by side, see linalg.lanes; arrays of lanes
            have a last axis L. size : has the length n, which a compiler may know (linalg.structs)

and for Python, one node at a time, ``flow_root(table, root, x, gap)`` and
``gain_update_root(gains, root, x, moments, gap)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.kernels.estimates import rotate
from netkf.algorithms.kernels.gains import GainTable
from netkf.algorithms.kernels.riccati import (
    WIDE,
    change_units,
    flow_triple,
    hamiltonian,
    state_units,
    wide_exponential,
)
from netkf.algorithms.kernels.square_root import triangularise
from netkf.linalg.arrays import FloatArray, IntArray, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, ONE, Lanes, aligned, load, root_of, select, spread, store
from netkf.linalg.local import local_matrix, local_vector
from netkf.linalg.series import fill_series, with_reach
from netkf.linalg.structs import Size, Struct, sized

CELLS, CELL_BYTES = 32, 1 << 18  # of one model at most: the tables should fit a processor's cache
NARROW = 64.0  # trace(P) trace(G) of a gap up to which rounding of G is harmless: P is narrow
TERMS = 27  # of the power series: enough for |M| unit <= UNIT, odd
CELL_TERMS = 13  # about as many as a cell needs
UNIT = 0.125  # largest norm of M over a unit, a cell's length, M the Hamiltonian
BLOCKS = 13  # Legendre coefficients at most: the next one is below 1e-40 of the first
NEGLIGIBLE = 1e-18  # trace(P dG) of information that may be left out
GROWTH = 2.0**8  # of F over one level at most, where something is observed
PIVOT = 2.0**-48  # least pivot of Q_g, relative to its diagonal
ROWS, USED_BLOCKS, USED_LEVELS, OCTAVES = range(4)
"""Columns of ``FlowTable.sizes``."""


class FlowTable(Struct):
    """Tables of M models: everything that depends neither on P nor on the gap.

    unit   : (M,) length of a cell, seconds
    sizes  : (M, 4) rows q of a block of Gamma, number of blocks (0: nothing is observed), number of
             levels, and the level that is as long as all cells together: ROWS, USED_BLOCKS, ...
    rate   : (M,) trace of G, 1/s
    reach  : (M, cells, terms, 1) up to which gap the terms so far are enough, see linalg/series
    series : (M, cells, terms, width) Taylor coefficients: Q_g (lower triangle by rows), exp(A g)
             and, if something is observed, F and G_g; then zeros up to a multiple of the lanes
    gamma  : (M, blocks, terms, 1 + q n) the reach of ``c_j / (g^j sqrt(2 j + 1))``, and its terms
    bound  : (M, blocks) bounds of ``|row block j of Gamma|^2 / g^(2 j + 1)``
    levels : (M, levels, 4, n, n) ``exp(A g)``, F, Gamma (upper) and T (lower triangular) for
             ``g = unit 2^level``
    whitened_H : (M, q, n) ``R^-1/2 H``, so that ``G = whitened_H' whitened_H``
    """

    unit: FloatArray
    sizes: IntArray
    rate: FloatArray
    reach: FloatArray
    series: FloatArray
    gamma: FloatArray
    bound: FloatArray
    levels: FloatArray
    whitened_H: FloatArray


class FlowScratch(Struct):
    """The ``size`` n of states, and scratch arrays: ``values`` of the series at a gap; ``S``,
    ``wide`` and ``T`` (n, n); ``mean`` and ``moved`` (n,); ``rows`` (q n,) of Gamma; ``observed``
    (1, n), a row of Gamma times S, and its ``gain`` (1, n).
    """

    size: Size
    values: FloatArray
    S: FloatArray
    wide: FloatArray
    T: FloatArray
    mean: FloatArray
    moved: FloatArray
    rows: FloatArray
    observed: FloatArray
    gain: FloatArray


def flow_scratch(table: FlowTable, unrolled: bool = False) -> FlowScratch:
    """Return scratch for all models of a table; ``unrolled``: its types know n if it is small."""
    n, q = table.levels.shape[-1], table.whitened_H.shape[1]
    cls = FlowScratch.of_size(n) if unrolled else FlowScratch
    # ``values`` also takes the n n entries of a level, which are fewer.
    return cls(
        size=sized(n) if unrolled else np.zeros(n),
        values=aligned((table.series.shape[3],)),
        S=np.zeros((n, n)),
        wide=np.zeros((n, n)),
        T=np.zeros((n, n)),
        mean=np.zeros(n),
        moved=np.zeros(n),
        rows=np.zeros(max(q, 1) * n),
        observed=np.zeros((1, n)),
        gain=np.zeros((1, n)),
    )


# Tables.


def flow_table(
    A: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray, longest: float
) -> FlowTable:
    """Return the table of one model, the flow of the covariance of a Kalman-Bucy filter: ``A, Q``
    (n, n), ``H`` (p, n), ``R`` (p, p); p may be 0.

    The table is fast for gaps up to ``longest`` seconds; longer ones take several steps.
    """
    whitened_H = whiten_observation(H, R)
    # In units in which entries are of about the same size: limits and lengths of steps go by the
    # largest ones. Units are powers of 2, so that nothing is rounded.
    units = state_units(A, Q, whitened_H.T @ whitened_H)
    table = _tabulate(*change_units(units, A, Q, whitened_H), longest)
    ratios, products = units[:, None] / units, units[:, None] * units
    scales = np.stack([ratios, ratios, products, 1.0 / products])
    table.series[:] *= pack_series(scales[:, None, None], len(whitened_H) > 0)[0, 0]
    table.gamma[..., 1:] /= np.tile(units, len(whitened_H))
    table.levels[:, :, :2] *= ratios
    table.levels[:, :, 2] /= units
    table.levels[:, :, 3] *= units[:, None]
    table.whitened_H[0], table.rate[0] = whitened_H, (whitened_H * whitened_H).sum()
    # The triangle inequality over the terms bounds each entry for every gap up to the unit.
    powers = table.unit ** np.arange(TERMS)
    table.bound[:] = ((np.abs(table.gamma[..., 1:]) * powers[:, None]).sum(axis=2) ** 2).sum(axis=2)
    return table


def _tabulate(A: FloatArray, Q: FloatArray, whitened_H: FloatArray, longest: float) -> FlowTable:
    """Return the table of one model, but for bounds and rates, in the given units of states."""
    n = len(A)
    M, scale = hamiltonian(A, Q, whitened_H.T @ whitened_H)
    size = np.abs(A)
    # Q_g = int exp(A s) Q exp(A' s) ds grows by A from both sides.
    norm = float(size.sum(axis=0).max() + size.sum(axis=1).max())
    if len(whitened_H):
        norm = max(norm, float(np.abs(M).sum(axis=0).max()))
    # A power of two, so that multiples of the unit and its halves are exact.
    unit = 2.0 ** np.floor(np.log2(min(UNIT / max(norm, 1e-300), longest)))
    # Binary digits of the longest gap in units.
    count = max(1, int(longest / unit).bit_length())
    # Entries of a packed Q_g and exp(A g), and of F and a packed G_g where something is observed.
    width = n * (n + 1) // 2 * (1 + (len(whitened_H) > 0)) + n * n * (1 + (len(whitened_H) > 0))
    # As many cells as fit the cache budget. Cell k covers [k, k + 1) units around its middle. The
    # first is expanded at 0, where Q_g = 0 and short gaps lose no digits.
    octaves = max(1, min(CELLS, CELL_BYTES // (8 * CELL_TERMS * width))).bit_length() - 1
    middles = unit * (np.arange(2 ** min(octaves, count - 1)) + 0.5)
    middles[0] = 0.0
    starts = transitions_at(A, Q, whitened_H, middles)
    first = transition_series(A, Q, whitened_H, starts[:, :1])
    E, F, Q_g = first[:3, 0]
    blocks = information_blocks(whitened_H, F)
    # The reach comes first: a table that is padded to a common width still has it there.
    gamma = [np.roll(with_reach(block.astype(np.float64), unit), 1, axis=1) for block in blocks]
    levels = double_levels(E, F, Q_g, blocks, scale, unit, count)
    # No cell lies beyond the longest level.
    octaves = min(octaves, len(levels) - 1)
    # From its middle a cell reaches half a unit, but the first one reaches a whole unit.
    cells = [with_reach(pack_series(first, len(whitened_H) > 0)[0], unit)]
    if octaves > 0:
        cells += later_cells(A, Q, whitened_H, starts[:, 1 : 2**octaves], 0.5 * unit)
    series = np.stack(cells)
    series, reach = series[:, :, :-1], series[:, :, -1]
    # Drop the terms that no gap in any cell needs.
    last_term = max(int(np.searchsorted(row[:-1], row[:-1].max(initial=0.0))) for row in reach)
    last_term += last_term % 2  # two terms at a time, see linalg/series
    reach[:, last_term] = np.inf
    sizes = (len(whitened_H), len(blocks), len(levels), octaves)
    return FlowTable(
        unit=np.array([unit]),
        sizes=np.array([sizes], dtype=np.int64),
        rate=np.zeros(1),
        reach=reach[None, :, : last_term + 1, None].copy(),
        series=series[None, :, : last_term + 1].copy(),
        gamma=np.array(gamma).reshape(1, len(gamma), TERMS, len(whitened_H) * n + 1),
        bound=np.zeros((1, len(blocks))),
        levels=levels[None],
        whitened_H=whitened_H[None].copy(),
    )


def later_cells(
    A: FloatArray, Q: FloatArray, whitened_H: FloatArray, starts: FloatArray, longest: float
) -> list[FloatArray]:
    """Return the series of cells with their reach, (TERMS, width + 1) each, for gaps of at most
    ``longest`` seconds around their middles, with ``starts`` (4, C, n, n) as of transitions_at.
    """
    observed = len(whitened_H) > 0
    for terms in (CELL_TERMS + 2, TERMS):
        series = pack_series(transition_series(A, Q, whitened_H, starts, terms), observed)
        cells = [with_reach(cell, longest) for cell in series]
        # Two terms that nothing needs show that those left out are not needed either.
        if all(cell[-3, -1] == cell[:-1, -1].max() for cell in cells):
            break
    rest = np.zeros((TERMS - terms, series.shape[2] + 1))
    for k, cell in enumerate(cells):
        rest[:, -1] = cell[-1, -1] = cell[:-1, -1].max()
        cells[k] = np.concatenate([cell, rest])
        cells[k][-1, -1] = np.inf
    return cells


def pack_series(parts: FloatArray, observed: bool) -> FloatArray:
    """Return the series (C, terms, width) of a FlowTable for C cells from those of exp(A g), F,
    Q_g and G_g in ``parts`` (4, C, terms, n, n), a row for each term; F and G_g if ``observed``.
    """
    E, F, Q_g, G = parts
    rows, columns = np.tril_indices(E.shape[2])
    packed = [Q_g[:, :, rows, columns], E.reshape(*E.shape[:2], -1)]
    if observed:
        packed += [F.reshape(*F.shape[:2], -1), G[:, :, rows, columns]]
    # Zeros up to a multiple of the lanes, see series.fill_row.
    padding = -sum(part.shape[2] for part in packed) % LANES
    packed.append(wide_zeros(*packed[0].shape[:2], padding))
    return np.concatenate(packed, axis=2).astype(np.float64)


def whiten_observation(H: FloatArray, R: FloatArray) -> FloatArray:
    """Return ``R^-1/2 H`` (p, n); if p > n, n rows with the same ``H' R^-1 H``."""
    p, n = H.shape
    if p == 0:
        return np.zeros((0, n))
    # L^-1 H with R = L L'; more rows than states are compressed by QR, since only H' R^-1 H counts.
    rows = np.linalg.solve(np.linalg.cholesky(R), H)
    return np.asarray(rows if p <= n else np.linalg.qr(rows, mode="r"))


def transition_series(
    A: FloatArray, Q: FloatArray, whitened_H: FloatArray, starts: FloatArray, terms: int = TERMS
) -> FloatArray:
    """Return Taylor coefficients (4, C, terms, n, n) of exp(A g), the transition F, the noise Q_g
    and the information G_g of the readings over gaps around the middles of C cells, in extended
    precision, for A and Q (n, n) and ``whitened_H`` (q, n), from ``starts`` (4, C, n, n).

    ``dF = (A - Q_g G) F``, ``dQ_g = A Q_g + Q_g A' + Q - Q_g G Q_g`` and ``dG_g = F' G F``, with
    the information rate ``G = whitened_H' whitened_H``.
    """
    n, count = len(A), starts.shape[1]
    A, Q, whitened_H = A.astype(WIDE), Q.astype(WIDE), whitened_H.astype(WIDE)
    series = wide_zeros(4, count, terms, n, n)
    # H F and H Q_g have q rows, often far fewer than n, or none.
    rows, of_noise = wide_zeros(2, count, terms, len(whitened_H), n)
    series[:, :, 0] = starts
    E, F, Q_g, G = series
    # Power-series recursion: the coefficient k + 1 follows from coefficient k of the right-hand
    # side, and products of series are Cauchy products.
    for k in range(terms - 1):
        rows[:, k], of_noise[:, k] = whitened_H @ F[:, k], whitened_H @ Q_g[:, k]
        gains = np.swapaxes(of_noise, 2, 3)
        A_Q_g = A @ Q_g[:, k]
        # Q is constant: it enters the coefficient of g^0 only.
        derivative = A_Q_g + np.swapaxes(A_Q_g, 1, 2) + (Q if k == 0 else 0.0)
        Q_g[:, k + 1] = symmetric(derivative - _convolved(gains, of_noise, k)) / (k + 1)
        F[:, k + 1] = (A @ F[:, k] - _convolved(gains, rows, k)) / (k + 1)
        # dG/dg = F' G F = rows' rows, with rows = R^-1/2 H F.
        G[:, k + 1] = _convolved(np.swapaxes(rows, 2, 3), rows, k) / (k + 1)
        E[:, k + 1] = A @ E[:, k] / (k + 1)
    return np.asarray(series)


def _convolved(a: FloatArray, b: FloatArray, k: int) -> FloatArray:
    """Return coefficient ``k`` (C, r, c) of the product of two power series of matrices."""
    return np.asarray((a[:, : k + 1] @ b[:, k::-1]).sum(axis=1))


def transitions_at(
    A: FloatArray, Q: FloatArray, whitened_H: FloatArray, middles: FloatArray
) -> FloatArray:
    """Return exp(A g), the transition F, the noise Q_g and the information G_g of the readings
    (4, C, n, n) at the ``middles`` (C,) g = 0 and 3/2, 5/2, ... units of C cells, in seconds, from
    the exponential exp(M g) of the Hamiltonian M of A and Q (n, n) and ``whitened_H`` (q, n).
    """
    n, count = len(A), len(middles)
    A, Q, whitened_H = A.astype(WIDE), Q.astype(WIDE), whitened_H.astype(WIDE)
    E, F, Q_g, G = starts = wide_zeros(4, count, n, n)
    E[0] = F[0] = np.eye(n)
    # A single cell is expanded at 0, whose values are already there.
    if count == 1:
        return np.asarray(starts)
    M, scale = hamiltonian(A, Q, whitened_H.T @ whitened_H)
    # exp over half a unit, which is a third of the first middle (3/2 units): all middles are odd
    # multiples of it.
    half_unit, half_unit_A = (wide_exponential(part, middles[1] / WIDE(3.0)) for part in (M, A))
    E_M, E[1:] = half_unit, half_unit_A
    # Each middle is two halves of a unit after the one before it; the first step goes from 1/2 to
    # 3/2 units.
    for k in range(1, count):
        E_M = half_unit @ half_unit @ E_M
        E[k] = half_unit_A @ half_unit_A @ (E[k - 1] if k > 1 else half_unit_A)
        F[k], G[k], Q_g[k] = flow_triple(E_M)
    # M belongs to P / scale.
    starts[2:] = symmetric(Q_g) * scale, symmetric(G) / scale
    return np.asarray(starts)


def wide_zeros(*shape: int) -> Any:
    """Return zeros of this ``shape`` in extended precision (not "wide" in the sense of P), in which
    tables are computed before they are rounded to double.
    """
    return np.zeros(shape, dtype=WIDE)


def information_blocks(whitened_H: FloatArray, F: FloatArray) -> list[FloatArray]:
    """Return the power series (TERMS, q n) of ``c_j / (g^j sqrt(2 j + 1))``, one block for each j.
    ``F`` (TERMS, n, n) is the series around 0, and ``whitened_H`` (q, n) is R^-1/2 H.
    """
    q, n = whitened_H.shape
    blocks: list[FloatArray] = []
    rows = whitened_H.astype(WIDE) @ F  # (TERMS, q, n)
    # No sensor: no block, and nothing is observed.
    for j in range(min(BLOCKS, TERMS) if q else 0):
        block = np.zeros((TERMS, q * n), dtype=WIDE)
        # Moments of u^k with P_j vanish for k < j, so block j starts at g^j, which is factored out.
        for k in range(j, TERMS):
            block[k - j] = legendre_moment(k, j) * math.sqrt(2 * j + 1) * rows[k].ravel()
        blocks.append(block)
    return blocks


def legendre_moment(k: int, j: int) -> float:
    """Return ``int_0^1 u^k P_j(2 u - 1) du`` = k!^2 / ((k - j)! (k + j + 1)!) for k >= j: what the
    term u^k of a power series adds to its Legendre coefficient c_j, apart from the factor 2 j + 1.
    """
    return math.factorial(k) ** 2 / (math.factorial(k - j) * math.factorial(k + j + 1))


def double_levels(
    E: FloatArray,
    F: FloatArray,
    Q_g: FloatArray,
    blocks: list[FloatArray],
    scale: float,
    unit: float,
    levels: int,
) -> FloatArray:
    """Return exp(A g), F, Gamma and T (levels, 4, n, n) for ``g = unit 2^level`` seconds, from the
    series around 0 of exp(A g) = ``E``, ``F`` and ``Q_g``, (TERMS, n, n) each, and of Gamma,
    ``blocks`` (TERMS, q n). There are fewer ``levels`` if F grows too much.

    Each level follows from the one below by the doubling formulas (Anderson 1978). Doubling also
    doubles relative errors, so it works in extended precision, and on roots, so that directions
    that are not observed keep exactly no information. ``scale`` is that of ``hamiltonian``.
    """
    n = E.shape[1]
    powers = WIDE(unit) ** np.arange(TERMS)
    # exp(A unit), F and Q_g over one unit, from the series around 0.
    transition, F_level, Q = (np.tensordot(powers, part, 1) for part in (E, F, Q_g))
    # Gamma by blocks: sqrt(g) g^j times the series of c_j / (g^j sqrt(2 j + 1)).
    rows = [WIDE(unit) ** (j + WIDE(0.5)) * (powers @ block) for j, block in enumerate(blocks)]
    gamma = upper_root(np.concatenate([row.reshape(-1, n) for row in rows] or [np.zeros((0, n))]))
    T, eye = cholesky_root(Q), np.eye(n, dtype=WIDE)
    # P / scale balances G against Q; their roots scale with its square root.
    root_scale = np.sqrt(WIDE(scale))
    gamma, T = gamma * root_scale, T / root_scale
    table = np.zeros((levels, 4, n, n))
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable plant overflows late
        for level in range(levels):
            table[level] = transition, F_level, gamma / root_scale, T * root_scale
            # With U U' = I + T' G T, middle = T U^-T is a root of Q (I + G Q)^-1.
            gamma_T = gamma @ T
            U = upper_root(np.concatenate([eye, gamma_T])).T
            middle, gain = substitute(U, T.T).T, substitute(U, gamma_T.T)
            # Z' Z = G (I + Q G)^-1: the information of the second half, less what the noise of the
            # first half takes from it.
            Z = substitute(upper_root(np.concatenate([eye, gamma_T.T])).T, gamma)
            # Q <- Q + F Q (I + G Q)^-1 F' as one triangularisation.
            T = upper_root(np.concatenate([(F_level @ middle).T, T.T])).T
            # F (I + Q G)^-1 F without an inverse: Q G may be 1e9 beside the I.
            F_level, F_half = F_level @ (F_level - middle @ (gain @ (gamma @ F_level))), F_level
            # G <- G + F' G (I + Q G)^-1 F, with the F of half the gap.
            gamma = upper_root(np.concatenate([gamma, Z @ F_half]))
            transition = transition @ transition
            # If F grows, it magnifies rounding errors that the readings of the same level do not
            # reduce: end the table here, so that longer gaps take steps of this level.
            if gamma.any() and not np.abs(F_level).max() < GROWTH:
                return table[: level + 1].copy()
    return table


def upper_root(rows: FloatArray) -> FloatArray:
    """Return upper triangular U (n, n) with ``U' U = rows' rows`` (k, n), in extended precision."""
    n = rows.shape[1]
    work = np.concatenate([rows, np.zeros((n, n))]).astype(WIDE)
    for i in range(n):
        # Row pivoting keeps rows of very different sizes apart.
        pivot_row = i + int(np.argmax(np.abs(work[i:, i])))
        work[[i, pivot_row]] = work[[pivot_row, i]]
        column = work[i:, i].copy()
        length = np.sqrt((column * column).sum())
        if not length > 0.0:
            continue
        # Householder reflection that zeroes column i below the diagonal; the sign avoids
        # cancellation.
        column[0] += np.copysign(length, column[0])
        scale = 2.0 / (column * column).sum()
        work[i:, i:] -= np.outer(column, scale * (column @ work[i:, i:]))
        work[i + 1 :, i] = 0.0
    U = work[:n]
    # Nonnegative diagonal, so that the root is unique.
    return np.asarray(U * np.where(np.diag(U) < 0.0, -1.0, 1.0)[:, None])


def cholesky_root(Q: FloatArray) -> FloatArray:
    """Return the lower triangular root of Q (n, n), as precise; pivots like rounding count as 0."""
    n = len(Q)
    L = np.zeros_like(Q)
    for j in range(n):
        column = Q[j:, j] - L[j:, :j] @ L[j, :j]
        if column[0] > np.finfo(Q.dtype).eps * 16 * Q[j, j]:
            L[j:, j] = column / np.sqrt(column[0])
    return L


def substitute(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``lower^-1 right`` (n, c) by forward substitution, in the precision of both, for a
    lower triangular ``lower`` (n, n) and ``right`` (n, c).
    """
    out = np.zeros_like(right)
    for i in range(len(lower)):
        out[i] = (right[i] - lower[i, :i] @ out[:i]) / lower[i, i]
    return out


def stack_tables(tables: Sequence[FlowTable]) -> FlowTable:
    """Return one table of all M models of ``tables``, in their order, stacked along axis 0."""

    def padded(parts: list[FloatArray], fill: float) -> FloatArray:
        """Return the arrays ``parts`` (M_i, ...) of several tables stacked along their first axis,
        that of models, each padded to the largest shape with ``fill``.
        """
        # The padding is never read: ``sizes`` and the infinite last reach end every loop before it.
        shape = np.max([part.shape for part in parts], axis=0)
        out: FloatArray = aligned((sum(len(part) for part in parts), *shape[1:]), parts[0].dtype)
        out[:] = fill
        row = 0
        for part in parts:
            out[(slice(row, row + len(part)), *map(slice, part.shape[1:]))] = part
            row += len(part)
        return out

    names = FlowTable.struct_fields
    parts: Any = {n: padded([getattr(table, n) for table in tables], 0.0) for n in names}
    return FlowTable(**parts)


# Kernels.


@kernel
def propagate_root(
    table: FlowTable, m: int, root: FloatArray, x: FloatArray, k: int, gap: float, work: FlowScratch
) -> None:
    """Propagate estimate ``k`` in place over ``gap`` seconds: ``P <- F P (I + G_g P)^-1 F' + Q_g``
    for any P, and the mean by exp(A gap), without the readings.
    """
    # The cells cover 2^octaves units. Of a longer gap, first take whole steps
    # of the level of that length.
    octaves, values = table.sizes[m, OCTAVES], work.values
    if gap >= table.unit[m] * (1 << octaves):
        gap = propagate_by_levels(table, m, octaves, root, x, k, gap, work)
    if not gap > 0.0:
        return
    # Without observation (no block of Gamma) any P is narrow.
    observed = table.sizes[m, USED_BLOCKS] > 0
    trace = trace_of_root(ONE, work.size, root[k]) if observed else 0.0
    if is_narrow(table, m, gap, trace):
        cell, since = cell_of(table.unit[m], gap)
        width = table.series.shape[3]
        fill_series(values, width, table.series[m, cell], table.reach[m, cell], 0, since)
        propagate_by_series(table, m, root, x, k, True, work)
        return
    # P is wide: take whole units by levels, and use the rest of the gap row by row of Gamma, which
    # replaces G_g.
    gap = propagate_by_levels(table, m, 0, root, x, k, gap, work)
    if gap > 0.0:
        use_information(table, m, root, k, gap, work)
        width = table.series.shape[3]
        fill_series(values, width, table.series[m, 0], table.reach[m, 0], 0, gap)
        propagate_by_series(table, m, root, x, k, False, work)


@kernel(inlined=True)
def is_narrow(table: FlowTable, m: int, gap: float, trace: float) -> bool:
    """Return True if a P of this ``trace`` is small enough to be moved over ``gap`` seconds in one
    step by model ``m`` of the table: the rounding of G_g times P is harmless.
    """
    # ``not >=``: a nan counts as narrow, so that it takes the short way.
    return not table.rate[m] * gap * trace >= NARROW


@kernel(inlined=True)
def takes_one_step(table: FlowTable, m: int, gap: float, trace: float) -> bool:
    """Return True if ``propagate_root`` moves a P of this ``trace`` over ``gap`` seconds in one
    step, by the series of a cell, with model ``m`` of the table: then SIMD lanes can do so.
    """
    longest = table.unit[m] * (1 << table.sizes[m, OCTAVES])
    return bool(gap < longest and is_narrow(table, m, gap, trace))


@kernel(inlined=True)
def trace_of_root(lanes: Lanes, size: Size, S: FloatArray) -> Any:
    """Return ``trace(P)`` (L,) of P = S S' for lower triangular roots S (n, n, L) of L runs."""
    total = spread(lanes, 0.0)
    # |S|_F^2 = trace(S S').
    for i in range(len(size)):
        for j in range(i + 1):
            total += load(lanes, S, i, j) * load(lanes, S, i, j)
    return total


@kernel
def propagate_by_levels(
    table: FlowTable,
    m: int,
    level: int,
    root: FloatArray,
    x: FloatArray,
    k: int,
    gap: float,
    scratch: FlowScratch,
) -> float:
    """Propagate estimate ``k`` in place over the whole multiples of ``unit 2^level`` seconds in a
    ``gap``; return the rest of the gap, seconds.
    """
    length, levels = table.unit[m] * (1 << level), table.sizes[m, USED_LEVELS]
    steps = int(gap / length)
    rest: float = gap - steps * length
    while steps > 0:
        # A step for each binary digit of their number that is 1; steps beyond the highest level
        # are taken one by one.
        if steps & 1 or level == levels - 1:
            propagate_level(table, m, level, root, x, k, scratch)
            steps -= 1
        if level < levels - 1:
            steps >>= 1
            level += 1
    return rest


@kernel
def propagate_level(
    table: FlowTable, m: int, level: int, root: FloatArray, x: FloatArray, k: int, work: FlowScratch
) -> None:
    """Propagate estimate ``k`` over ``unit 2^level`` s by the tabulated exp(A g), F, Gamma, T."""
    # Index in the third axis of levels: 0 exp(A g), 1 F, 2 Gamma, 3 T.
    size, n, levels, T = work.size, len(work.size), table.levels, work.T
    values, row, observed = work.values, work.observed, table.sizes[m, USED_BLOCKS] > 0
    # Gamma_r S for each row r of Gamma, both triangular, as an observation of unit noise.
    for r in range(n if observed else 0):
        for j in range(n):
            total = 0.0
            for i in range(max(r, j), n):
                total += levels[m, level, 2, r, i] * root[k, i, j]
            row[0, j] = total
        rotate(ONE, size, root, k, row[0], work.gain[0])
    # exp(A g) and F where the series of a gap has them.
    begin, flow = n * (n + 1) // 2, offset_of_F(n, observed)
    for i in range(n):
        for j in range(n):
            values[begin + i * n + j] = levels[m, level, 0, i, j]
            if observed:
                values[flow + i * n + j] = levels[m, level, 1, i, j]
        # A copy, since predict_root_lanes() overwrites T.
        for j in range(i + 1):
            T[i, j] = levels[m, level, 3, i, j]
    propagate_mean(ONE, size, x[k], values, work.moved)
    predict_root_lanes(ONE, size, root[k], values, flow, work.wide, T)


@kernel(inlined=True)
def cell_of(unit: float, gap: float) -> tuple[int, float]:
    """Return the index of the cell, ``unit`` seconds long, that a ``gap`` in seconds lies in, and
    the gap minus the point that the series of this cell is expanded at, seconds.
    """
    # Cell 0 is expanded at 0 and the others at their middles.
    cell = int(gap / unit)
    return cell, gap if cell == 0 else gap - (cell + 0.5) * unit


@kernel(inlined=True)
def width_of(n: int, observed: bool) -> int:
    """Return the number of entries of Q_g and exp(A g) and, if ``observed``, F and G_g for n
    states; of the symmetric Q_g and G_g only one triangle counts.
    """
    width = n * (n + 1) // 2 + n * n
    return 2 * width if observed else width


@kernel
def propagate_by_series(
    table: FlowTable,
    m: int,
    root: FloatArray,
    x: FloatArray,
    k: int,
    reads: bool,
    scratch: FlowScratch,
) -> None:
    """Propagate estimate ``k`` in place over the gap of which ``scratch.values`` holds the noise
    Q_g, exp(A g) and, if something is observed, F and G_g, symmetric matrices as lower triangles by
    rows. ``reads``: use G_g first; otherwise the caller has done so.
    """
    # Work on copies that the compiler can keep in registers (local_matrix), and store them last.
    size, n, observed = scratch.size, len(scratch.size), table.sizes[m, USED_BLOCKS] > 0
    S, mean = local_matrix(size, scratch.S), local_vector(size, scratch.mean)
    for i in range(n):
        mean[i] = x[k, i]
        for j in range(i + 1):
            S[i, j] = root[k, i, j]
    V, T = local_matrix(size, scratch.wide), local_matrix(size, scratch.T)
    moved = local_vector(size, scratch.moved)
    if observed and reads:
        condition_root(ONE, size, S, scratch.values, V)
    propagate_mean(ONE, size, mean, scratch.values, moved)
    cholesky_in_lanes(ONE, size, T, scratch.values)
    predict_root_lanes(ONE, size, S, scratch.values, offset_of_F(n, observed), V, T)
    for i in range(n):
        x[k, i] = mean[i]
        for j in range(i + 1):
            root[k, i, j] = S[i, j]


@kernel(inlined=True)
def offset_of_F(n: int, observed: bool) -> int:
    """Return the index at which F begins in the values of a gap, for n states: behind exp(A g) if
    something is ``observed``, else at exp(A g), which F then equals.
    """
    # Without sensors F = exp(A g), and the series holds it once.
    return n * (n + 1) // 2 + (n * n if observed else 0)


@kernel(inlined=True, fused=True)
def propagate_mean(
    lanes: Lanes, size: Size, x: FloatArray, values: FloatArray, moved: FloatArray
) -> None:
    """Compute ``x = exp(A g) x`` (n, L) in place in L lanes; ``values`` (>= width, L)
    holds exp(A g) by rows behind Q_g, and ``moved`` (n, L) is scratch.
    """
    n, begin = len(size), len(size) * (len(size) + 1) // 2
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(n):
            total += load(lanes, values, begin + i * n + j) * load(lanes, x, j)
        store(lanes, moved, i, total)
    for i in range(n):
        store(lanes, x, i, load(lanes, moved, i))


@kernel(inlined=True, fused=True)
def condition_root(lanes: Lanes, size: Size, S: FloatArray, row: FloatArray, V: FloatArray) -> None:
    """Replace S (n, n, L), a lower triangular root of P in each of L lanes, by one of
    ``P (I + G P)^-1``: the update with the information G of the readings of a gap. ``row``
    (>= width, L) holds the triangle of G by rows behind Q_g, exp(A g), F; V (n, n, L) is scratch.
    """
    n = len(size)
    begin = n * (n + 1) // 2 + 2 * n * n
    # V = I + S' G S by columns: G S first, whose column j is not needed by the ones before.
    for j in range(n):
        for i in range(n):
            total = spread(lanes, 0.0)
            for r in range(j, n):
                # G is symmetric and packed: (i, r) and (r, i) are one entry.
                g = i * (i + 1) // 2 + r if r <= i else r * (r + 1) // 2 + i
                total += load(lanes, row, begin + g) * load(lanes, S, r, j)
            store(lanes, V, i, j, total)
        for i in range(j + 1):
            total = spread(lanes, 1.0 if i == j else 0.0)
            for r in range(i, n):
                total += load(lanes, S, r, i) * load(lanes, V, r, j)
            store(lanes, V, i, j, total)
    # Factor it in place into V V' with V upper triangular, from the last column on.
    for j in range(n - 1, -1, -1):
        # The reciprocal is stored on the diagonal: the substitution below multiplies by it.
        pivot = 1.0 / root_of(load(lanes, V, j, j))
        store(lanes, V, j, j, pivot)
        for i in range(j):
            store(lanes, V, i, j, load(lanes, V, i, j) * pivot)
        for i in range(j):
            for r in range(i + 1):
                product = load(lanes, V, r, j) * load(lanes, V, i, j)
                store(lanes, V, r, i, load(lanes, V, r, i) - product)
    # S <- S V^-T row by row: (S V^-T) (S V^-T)' = S (I + S' G S)^-1 S' = P (I + G P)^-1.
    for i in range(n):
        for j in range(i, -1, -1):
            total = load(lanes, S, i, j)
            for r in range(j + 1, i + 1):
                total -= load(lanes, S, i, r) * load(lanes, V, j, r)
            store(lanes, S, i, j, total * load(lanes, V, j, j))


@kernel
def use_information(
    table: FlowTable, m: int, root: FloatArray, k: int, gap: float, scratch: FlowScratch
) -> None:
    """Update root ``k`` in place with the information Gamma' Gamma of the readings of a ``gap``
    below one unit, row by row of Gamma, as observations of unit noise. Block j of q rows is
    ``gap^(j + 1/2)`` times a power series in gap.
    """
    n, q, rows, observed = len(scratch.size), table.sizes[m, ROWS], scratch.rows, scratch.observed
    gamma, width = table.gamma, q * n
    trace = trace_of_root(ONE, scratch.size, root[k])
    factor = math.sqrt(gap)
    for block in range(table.sizes[m, USED_BLOCKS]):
        # The information of block j shrinks with g^(2 j + 1): stop when it is below rounding.
        if table.bound[m, block] * factor * factor * trace < NEGLIGIBLE:
            break
        for j in range(width):
            rows[j] = gamma[m, block, 0, j + 1]
        # The power series of this block at the gap, two terms at a time: ``odd`` and ``even`` are
        # powers of the gap; column 0 tells whether the terms so far are enough.
        term, even = 0, 1.0
        while gap > gamma[m, block, term, 0]:
            odd = even * gap
            even = odd * gap
            for j in range(width):
                rows[j] += odd * gamma[m, block, term + 1, j + 1]
                rows[j] += even * gamma[m, block, term + 2, j + 1]
            term += 2
        # Each row of Gamma is a scalar observation with unit noise: sqrt(g) g^j c_j S.
        for r in range(q):
            for j in range(n):
                total = 0.0
                for i in range(j, n):
                    total += rows[r * n + i] * root[k, i, j]
                observed[0, j] = factor * total
            rotate(ONE, scratch.size, root, k, observed[0], scratch.gain[0])
        # sqrt(g) g^j for the next j.
        factor *= gap


@kernel(inlined=True, fused=True)
def cholesky_in_lanes(lanes: Lanes, size: Size, T: FloatArray, packed: FloatArray) -> None:
    """Write the lower triangular Cholesky factor T (n, n, L) of the symmetric matrices whose lower
    triangles are ``packed`` (>= n (n + 1) / 2, L) by rows; pivots at the level of rounding are 0.
    """
    n = len(size)
    for j in range(n):
        for i in range(j, n):
            total = load(lanes, packed, i * (i + 1) // 2 + j)
            for r in range(j):
                total -= load(lanes, T, i, r) * load(lanes, T, j, r)
            store(lanes, T, i, j, total)
        # T_jj = pivot^1/2 and T_ij = total_i / T_jj.
        pivot = load(lanes, T, j, j)
        is_positive = pivot > PIVOT * load(lanes, packed, j * (j + 1) // 2 + j)
        inverse = select(is_positive, 1.0 / root_of(select(is_positive, pivot, 1.0)), 0.0)
        for i in range(j, n):
            store(lanes, T, i, j, load(lanes, T, i, j) * inverse)


@kernel(inlined=True, fused=True)
def predict_root_lanes(
    lanes: Lanes, size: Size, S: FloatArray, F: FloatArray, begin: int, W: FloatArray, T: FloatArray
) -> None:
    """Replace S (n, n, L) by the lower triangular root of ``F S S' F' + T T'`` in each of L lanes.
    ``F`` (>= begin + n n, L) holds F by rows from index ``begin`` on; T (n, n, L), lower
    triangular, is overwritten; ``W`` (n, n, L) is scratch.
    """
    n = len(size)
    # W = F S; S is lower triangular, so the sum begins at r = j.
    for i in range(n):
        for j in range(n):
            total = spread(lanes, 0.0)
            for r in range(j, n):
                total += load(lanes, F, begin + i * n + r) * load(lanes, S, r, j)
            store(lanes, W, i, j, total)
    triangularise(lanes, size, S, W, T)


@kernel(inlined=True, fused=True)
def information_rate(lanes: Lanes, size: Size, whitened_H: FloatArray, S: FloatArray) -> Any:
    """Return the rate of information ``trace(P G)`` (L,) in 1/s, of roots S (n, n, L) and of
    ``whitened_H`` (q, n, L) = R^-1/2 H. By it the compiled engine decides how long an interval may
    be whose readings are used at once.
    """
    # |R^-1/2 H S|_F^2 = trace(S' G S).
    n, rate = len(size), spread(lanes, 0.0)
    for r in range(len(whitened_H)):
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                total += load(lanes, whitened_H, r, i) * load(lanes, S, i, j)
            rate += total * total
    return rate


@kernel
def gain_root(
    size: Size,
    moments: FloatArray,
    series: FloatArray,
    reach: FloatArray,
    column: int,
    root: FloatArray,
    x: FloatArray,
    k: int,
    gap: float,
    values: FloatArray,
) -> None:
    """Correct the prediction ``x[k]`` (n,) at the end of a ``gap`` in seconds, entry ``k`` of x
    (K, n), in place by the Legendre ``moments`` (2 p,) of its readings, which are overwritten with
    ``moments - C x``: ``x += (U + S S' W) innovations``, with the root S = ``root[k]`` (n, n).

    U and W (n, 2 p) and C (2 p, n) are power series in the gap, the rows of ``series`` (terms, ...)
    of a GainTable; ``reach[:, column]`` (terms,) is the longest gap for which the terms so far
    suffice. ``values`` (>= row length) is scratch.
    """
    fill_series(values, min(series.shape[1], len(values)), series, reach, column, gap)
    use_moments(ONE, size, root[k], x[k], values, moments)


@kernel(inlined=True, fused=True)
def use_moments(
    lanes: Lanes, size: Size, S: FloatArray, x: FloatArray, values: FloatArray, moments: FloatArray
) -> None:
    """Correct the predictions x (n, L) of L lanes in place by the Legendre ``moments`` (q, L) of
    their readings (gains.py), which are overwritten with the innovations ``moments - C x``:
    ``x += (U + S S' W) innovations``, with lower triangular roots S (n, n, L).

    ``values`` (3 q n, L) holds U and W (n, q) and C (q, n) at the gap; C is overwritten.
    """
    n, q = len(size), len(moments)
    # Innovations: the moments minus C x.
    for m in range(q):
        total = load(lanes, moments, m)
        for j in range(n):
            total -= load(lanes, values, (2 * q + m) * n + j) * load(lanes, x, j)
        store(lanes, moments, m, total)
    # C is not needed any more, and q >= 1: its memory takes w = W innovations, then S' w.
    first = 2 * q * n
    for i in range(n):
        mean, total = load(lanes, x, i), spread(lanes, 0.0)
        for m in range(q):
            mean += load(lanes, values, i * q + m) * load(lanes, moments, m)
            total += load(lanes, values, (n + i) * q + m) * load(lanes, moments, m)
        store(lanes, x, i, mean)
        store(lanes, values, first + i, total)
    # S' w in place: entry j is not read again.
    for j in range(n):
        total = spread(lanes, 0.0)
        for i in range(j, n):
            total += load(lanes, S, i, j) * load(lanes, values, first + i)
        store(lanes, values, first + j, total)
    # x += S (S' W innovations), the part of the gain that depends on P.
    for i in range(n):
        total = load(lanes, x, i)
        for j in range(i + 1):
            total += load(lanes, S, i, j) * load(lanes, values, first + j)
        store(lanes, x, i, total)


# For Python.


def flow_root(
    table: FlowTable, root: FloatArray, x: FloatArray, gap: float
) -> tuple[FloatArray, FloatArray]:
    """Return the root (n, n) and x (n,) of one node ``gap`` >= 0 seconds later, by a table of one
    model: the root counts the readings of the gap, ``x`` does not. The arguments are not changed.
    """
    n = len(x)
    roots, means = root.reshape(1, n, n).copy(), x.reshape(1, n).copy()
    if gap > 0.0:
        propagate_root(table, 0, roots, means, 0, gap, flow_scratch(table))
    return roots[0], means[0]


def gain_update_root(
    table: GainTable, root: FloatArray, x: FloatArray, moments: FloatArray, gap: float
) -> FloatArray:
    """Return ``xhat(b)`` (n,) at the end b of an interval of ``gap`` seconds, from the open-loop
    prediction ``x`` (n,), the ``root`` (n, n) at b, the Legendre ``moments`` (2 p,) of the readings
    of the interval and the ``table`` of the node's gains. The arguments are not changed.
    """
    if table.moments == 0:
        return x
    n = len(x)
    means, values = x.reshape(1, n).copy(), np.zeros(table.series.shape[1] - 1)
    series, last = table.series, table.series.shape[1] - 1
    roots, innovations = root.reshape(1, n, n), moments.copy()
    gain_root(x, innovations, series, series, last, roots, means, 0, gap, values)
    return np.asarray(means[0])
