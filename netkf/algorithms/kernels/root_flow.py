"""The Riccati flow on roots: covariances ``P = S S'`` that stay right however wide they are.

Over a gap g, ``P(g) = Q_g + F P (I + G_g P)^-1 F'`` and ``x(g) = exp(A g) x``. With
``G_g = Gamma' Gamma`` and ``Q_g = T T'`` the root moves in three steps that subtract nothing:
each row of Gamma is a scalar observation of unit noise (root_update.rotate_out), F moves the root,
and one elimination adds the columns of T.

The rounding of G times a P of 1e12 would be information that no sensor gave, so Gamma is not a
root of a computed G. ``dG/dg = F(s)' H' R^-1 H F(s)``, hence with the coefficients c_j of
``R^-1/2 H F(s)`` in the Legendre polynomials of [0, g],

    Gamma = sqrt(g) [c_0; c_1 / sqrt(3); c_2 / sqrt(5); ...],   c_j of order g^j.

c_j is a power series in g, and as many of them are used as P and g need.

API. :func:`flow_table` tabulates one model, :func:`stack_tables` puts the tables of several
models side by side (a table is a stack of one), and m says which of a stack is meant. Kernels
work in place on place ``k`` of root (K, n, n) (lower triangular, nothing above the diagonal is
read or written) and x (K, n), with room from :func:`flow_room`:

    move_root(table, m, root, x, k, gap, room)            any gap > 0
    information_rate(table, m, root, k) -> trace(P G)     1/s, see flow.stretch
    gain_root(moments, series, root, x, k, gap, values)   readings of a gap, see gains.py

and for Python, one node at a time, ``flow_root(table, root, x, gap)`` and
``gain_update_root(gains, root, x, moments, gap)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.gains import GainTable
from netkf.algorithms.kernels.riccati import exponential_series, hamiltonian
from netkf.algorithms.kernels.root_update import rotate_out
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.series import fill_polynomial, with_reach

TERMS = 27  # of the power series: enough for |M| unit <= UNIT, odd
UNIT = 0.25
BLOCKS = 13  # Legendre coefficients at most: what is left is below 1e-40 of the first
UNSEEN = 1e-18  # trace(P dG) of information that may be left out
GROWTH = 2.0**8  # of F over one level at most, where something is observed
PIVOT = 2.0**-48  # least pivot of Q_g, relative to its diagonal

WIDE = np.longdouble


class FlowTable(NamedTuple):
    """All that depends on M models and not on P or the gap, side by side.

    unit   : (M,) gap that the series cover, seconds
    sizes  : (M, 4) rows q of a block of Gamma, number of blocks (0: nothing is observed), whether
             there is noise, number of levels
    reach  : (M, terms) up to which gap the terms so far are enough, see linalg/series
    series : (M, terms, width) Taylor coefficients: Q_g (lower triangle by rows), exp(A g) and,
             where something is observed, F
    gamma  : (M, blocks, terms, 1 + q n) the reach of ``c_j / (g^j sqrt(2 j + 1))``, and its terms
    bound  : (M, blocks) bounds of ``|row block j of Gamma|^2 / g^(2 j + 1)``
    levels : (M, levels, 4, n, n) ``exp(A g)``, F, Gamma (upper) and T (lower triangular) for
             ``g = unit 2^level``
    seen   : (M, q, n) ``R^-1/2 H``, whose square is G
    """

    unit: FloatArray
    sizes: np.ndarray
    reach: FloatArray
    series: FloatArray
    gamma: FloatArray
    bound: FloatArray
    levels: FloatArray
    seen: FloatArray


class FlowRoom(NamedTuple):
    """Room to work in: values of the series, ``wide`` (n, n), ``T`` (n, n), rows (q, n), an
    observation (1, n), its gain (1, n).
    """

    values: FloatArray
    wide: FloatArray
    T: FloatArray
    rows: FloatArray
    observed: FloatArray
    gain: FloatArray


def flow_room(table: FlowTable) -> FlowRoom:
    """Room for all models of a table."""
    n, q = table.levels.shape[-1], table.seen.shape[1]
    return FlowRoom(
        np.zeros(table.series.shape[2]),
        np.zeros((n, n)),
        np.zeros((n, n)),
        np.zeros(max(q, 1) * n),
        np.zeros((1, n)),
        np.zeros((1, n)),
    )


# Tables.


def flow_table(
    A: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray, longest: float
) -> FlowTable:
    """Tabulate one model for gaps up to ``longest`` seconds (longer ones take longer).

    ``A, Q`` (n, n), ``H`` (p, n), ``R`` (p, p); p may be 0.
    """
    n = len(A)
    seen = whitened(H, R)
    M, scale = hamiltonian(A, Q, seen.T @ seen)
    size = np.abs(A)
    norm = float(size.sum(axis=0).max() + size.sum(axis=1).max())  # exp(A s) Q exp(A' s)
    if len(seen):
        norm = max(norm, float(np.abs(M).sum(axis=0).max()))
    unit = 2.0 ** np.floor(np.log2(min(UNIT / max(norm, 1e-300), longest)))
    E, F, grown = transition_series(A, Q, seen)
    lower = np.tril_indices(n)
    parts = [grown[:, lower[0], lower[1]], E.reshape(TERMS, -1)]
    if len(seen):
        parts.append(F.reshape(TERMS, -1))
    series = with_reach(np.concatenate(parts, axis=1).astype(np.float64), unit)
    blocks, bound = information_blocks(seen, F, unit)
    # The reach comes first: a table that is padded to a common width still has it there.
    gamma = [np.roll(with_reach(block.astype(np.float64), unit), 1, axis=1) for block in blocks]
    levels = doubled(E, F, grown, blocks, scale, unit, max(1, int(longest / unit).bit_length()))
    sizes = (len(seen), len(blocks), int(bool(np.any(Q))), len(levels))
    return FlowTable(
        unit=np.array([unit]),
        sizes=np.array([sizes], dtype=np.int64),
        reach=series[None, :, -1].copy(),
        series=series[None, :, :-1].copy(),
        gamma=np.array(gamma).reshape(1, len(gamma), TERMS, len(seen) * n + 1),
        bound=bound[None],
        levels=levels[None],
        seen=seen[None],
    )


def whitened(H: FloatArray, R: FloatArray) -> FloatArray:
    """``R^-1/2 H`` as at most n rows (q, n)."""
    p, n = H.shape
    if p == 0:
        return np.zeros((0, n))
    rows = np.linalg.solve(np.linalg.cholesky(R), H)
    return np.asarray(rows if p <= n else np.linalg.qr(rows, mode="r"))


def transition_series(
    A: FloatArray, Q: FloatArray, seen: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(TERMS, n, n) each: coefficients of exp(A g), F and Q_g, in extended precision.

    ``dF = (A - Q_g G) F`` and ``dQ_g = A Q_g + Q_g A' + Q - Q_g G Q_g`` from I and 0 on.
    """
    n = len(A)
    A, Q, seen = A.astype(WIDE), Q.astype(WIDE), seen.astype(WIDE)
    E = exponential_series(A, TERMS)
    F, grown = np.zeros_like(E), np.zeros_like(E)
    drain = np.zeros_like(E)  # Q_g G
    F[0] = np.eye(n)
    for k in range(TERMS - 1):
        moved = A @ grown[k]
        change = moved + moved.T + (Q if k == 0 else 0.0)
        grown[k + 1] = symmetric(change - _convolved(drain, grown, k)) / (k + 1)
        F[k + 1] = (A @ F[k] - _convolved(drain, F, k)) / (k + 1)
        drain[k + 1] = (grown[k + 1] @ seen.T) @ seen
    return E, F, grown


def _convolved(a: FloatArray, b: FloatArray, k: int) -> FloatArray:
    return np.asarray((a[: k + 1] @ b[k::-1]).sum(axis=0))


def information_blocks(
    seen: FloatArray, F: FloatArray, unit: float
) -> tuple[list[FloatArray], FloatArray]:
    """Blocks (TERMS, q n) of the series of ``c_j / (g^j sqrt(2 j + 1))``, and their bounds."""
    q, n = seen.shape
    blocks: list[FloatArray] = []
    bounds: list[float] = []
    rows = seen.astype(WIDE) @ F  # (TERMS, q, n)
    for j in range(min(BLOCKS, TERMS) if q else 0):
        block = np.zeros((TERMS, q * n), dtype=WIDE)
        for k in range(j, TERMS):
            block[k - j] = legendre_moment(k, j) * math.sqrt(2 * j + 1) * rows[k].ravel()
        sizes = (np.abs(block) * WIDE(unit) ** np.arange(TERMS)[:, None]).sum(axis=0)
        blocks.append(block)
        bounds.append(float((sizes**2).sum()))
    return blocks, np.array(bounds)


def legendre_moment(k: int, j: int) -> float:
    """``int_0^1 u^k P_j(2 u - 1) du`` = k!^2 / ((k - j)! (k + j + 1)!)."""
    value = math.factorial(k) ** 2
    return value / (math.factorial(k - j) * math.factorial(k + j + 1))


def doubled(
    E: FloatArray,
    F: FloatArray,
    grown: FloatArray,
    blocks: list[FloatArray],
    scale: float,
    unit: float,
    levels: int,
) -> FloatArray:
    """(levels, 4, n, n) exp(A g), F, Gamma and T over ``unit 2^level`` seconds.

    Doubling also doubles relative errors, so it works in extended precision, and on roots, so that
    what is not observed stays so.
    """
    n = E.shape[1]
    powers = WIDE(unit) ** np.arange(TERMS)
    jump, move, Q = (np.tensordot(powers, part, 1) for part in (E, F, grown))
    rows = [WIDE(unit) ** (j + WIDE(0.5)) * (powers @ block) for j, block in enumerate(blocks)]
    gamma = upper_root(np.concatenate([row.reshape(-1, n) for row in rows] or [np.zeros((0, n))]))
    T, eye = cholesky_root(Q), np.eye(n, dtype=WIDE)
    root_scale = np.sqrt(WIDE(scale))
    gamma, T = gamma * root_scale, T / root_scale
    table = np.zeros((levels, 4, n, n))
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable plant overflows late
        for level in range(levels):
            table[level] = jump, move, gamma / root_scale, T * root_scale
            cross = gamma @ T
            upper = upper_root(np.concatenate([eye, cross])).T
            middle, share = substitute(upper, T.T).T, substitute(upper, cross.T)
            lost = substitute(upper_root(np.concatenate([eye, cross.T])).T, gamma)
            T = upper_root(np.concatenate([(move @ middle).T, T.T])).T
            # F (I + Q G)^-1 F without an inverse: Q G may be 1e9 beside the I.
            move, closed = move @ (move - middle @ (share @ (gamma @ move))), move
            gamma = upper_root(np.concatenate([gamma, lost @ closed]))
            jump = jump @ jump
            # What F magnifies, rounding in the middle included, the readings of the same level can
            # not reduce again: go in steps of the last level then.
            if gamma.any() and not np.abs(move).max() < GROWTH:
                return table[: level + 1].copy()
    return table


def upper_root(rows: FloatArray) -> FloatArray:
    """U (n, n), upper triangular with ``U' U = rows' rows``, in the precision of ``rows``."""
    n = rows.shape[1]
    work = np.concatenate([rows, np.zeros((n, n))]).astype(WIDE)
    for i in range(n):
        best = i + int(np.argmax(np.abs(work[i:, i])))
        work[[i, best]] = work[[best, i]]
        column = work[i:, i].copy()
        length = np.sqrt((column * column).sum())
        if not length > 0.0:
            continue
        column[0] += np.copysign(length, column[0])
        scale = 2.0 / (column * column).sum()
        work[i:, i:] -= np.outer(column, scale * (column @ work[i:, i:]))
        work[i + 1 :, i] = 0.0
    U = work[:n]
    return np.asarray(U * np.where(np.diag(U) < 0.0, -1.0, 1.0)[:, None])


def cholesky_root(Q: FloatArray) -> FloatArray:
    """Lower triangular root of Q (n, n); pivots that are rounding count as 0."""
    n = len(Q)
    L = np.zeros_like(Q)
    for j in range(n):
        column = Q[j:, j] - L[j:, :j] @ L[j, :j]
        if column[0] > np.finfo(Q.dtype).eps * 16 * Q[j, j]:
            L[j:, j] = column / np.sqrt(column[0])
    return L


def substitute(lower: FloatArray, right: FloatArray) -> FloatArray:
    """``lower^-1 right`` by forward substitution, in the precision of both."""
    out = np.zeros_like(right)
    for i in range(len(lower)):
        out[i] = (right[i] - lower[i, :i] @ out[:i]) / lower[i, i]
    return out


def stack_tables(tables: Sequence[FlowTable]) -> FlowTable:
    """One table for all models, in their order."""

    def padded(parts: list[FloatArray], fill: float) -> FloatArray:
        shape = np.max([part.shape for part in parts], axis=0)
        out = np.full((sum(len(part) for part in parts), *shape[1:]), fill, dtype=parts[0].dtype)
        row = 0
        for part in parts:
            out[(slice(row, row + len(part)), *map(slice, part.shape[1:]))] = part
            row += len(part)
        return out

    return FlowTable(*(padded(list(parts), 0.0) for parts in zip(*tables, strict=True)))


# Kernels.


@kernel
def move_root(
    table: FlowTable,
    m: int,
    root: FloatArray,
    x: FloatArray,
    k: int,
    gap: float,
    room: FlowRoom,
) -> None:
    """Move place ``k`` over ``gap`` seconds by model ``m``."""
    whole = int(gap / table.unit[m])
    rest = gap - whole * table.unit[m]
    level, levels = 0, table.sizes[m, 3]
    while whole > 0:
        if whole & 1 or level == levels - 1:
            move_level(table, m, level, root, x, k, room)
            whole -= 1
        if level < levels - 1:
            whole >>= 1
            level += 1
    if rest > 0.0:
        move_part_of_unit(table, m, root, x, k, rest, room)


@kernel
def move_level(
    table: FlowTable,
    m: int,
    level: int,
    root: FloatArray,
    x: FloatArray,
    k: int,
    room: FlowRoom,
) -> None:
    """``move_root`` over ``unit 2^level`` seconds."""
    n, levels, T, observed = x.shape[1], table.levels, room.T, room.observed
    if table.sizes[m, 1] > 0:
        for r in range(n):
            for j in range(n):
                total = 0.0
                for i in range(max(r, j), n):
                    total += levels[m, level, 2, r, i] * root[k, i, j]
                observed[0, j] = total
            rotate_out(root, k, observed, 0, room.gain, 1.0)
    for i in range(n):
        for j in range(i + 1):
            T[i, j] = levels[m, level, 3, i, j]
    values, flow = room.values, 0 if table.sizes[m, 1] == 0 else 1
    for i in range(n):
        for j in range(n):
            values[i * n + j] = levels[m, level, flow, i, j]
    transform(root, k, values, 0, room.wide, T, table.sizes[m, 2] > 0)
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += levels[m, level, 0, i, j] * x[k, j]
        room.gain[0, i] = total
    for i in range(n):
        x[k, i] = room.gain[0, i]


@kernel
def move_part_of_unit(
    table: FlowTable,
    m: int,
    root: FloatArray,
    x: FloatArray,
    k: int,
    gap: float,
    room: FlowRoom,
) -> None:
    """``move_root`` over less than a unit."""
    n, values, T = x.shape[1], room.values, room.T
    lower = n * (n + 1) // 2
    begin = lower
    if table.sizes[m, 1] > 0:
        use_readings(table, m, root, k, gap, room)
        begin = lower + n * n
    fill_series(values, table.series, table.reach, m, begin + n * n, gap)
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += values[lower + i * n + j] * x[k, j]
        room.gain[0, i] = total
    for i in range(n):
        x[k, i] = room.gain[0, i]
    noisy = table.sizes[m, 2] > 0
    if noisy:
        take_root(T, values)
    transform(root, k, values, begin, room.wide, T, noisy)


@kernel
def fill_series(
    out: FloatArray, series: FloatArray, reach: FloatArray, m: int, size: int, gap: float
) -> None:
    """Write the first ``size`` entries of the sum of model ``m``, see linalg/series."""
    for j in range(size):
        out[j] = series[m, 0, j]
    k, even = 0, 1.0
    while gap > reach[m, k]:
        odd = even * gap
        even = odd * gap
        for j in range(size):
            out[j] += odd * series[m, k + 1, j] + even * series[m, k + 2, j]
        k += 2


@kernel
def use_readings(
    table: FlowTable, m: int, root: FloatArray, k: int, gap: float, room: FlowRoom
) -> None:
    """Use the information Gamma' Gamma of a gap of less than a unit."""
    n, q, rows, observed = root.shape[1], table.sizes[m, 0], room.rows, room.observed
    gamma, width = table.gamma, q * n
    size = 0.0
    for i in range(n):
        for j in range(i + 1):
            size += root[k, i, j] * root[k, i, j]
    factor = math.sqrt(gap)
    for block in range(table.sizes[m, 1]):
        if table.bound[m, block] * factor * factor * size < UNSEEN:
            break
        for j in range(width):
            rows[j] = gamma[m, block, 0, j + 1]
        term, even = 0, 1.0
        while gap > gamma[m, block, term, 0]:
            odd = even * gap
            even = odd * gap
            for j in range(width):
                rows[j] += odd * gamma[m, block, term + 1, j + 1]
                rows[j] += even * gamma[m, block, term + 2, j + 1]
            term += 2
        for r in range(q):
            for j in range(n):
                total = 0.0
                for i in range(j, n):
                    total += rows[r * n + i] * root[k, i, j]
                observed[0, j] = factor * total
            rotate_out(root, k, observed, 0, room.gain, 1.0)
        factor *= gap


@kernel
def take_root(T: FloatArray, packed: FloatArray) -> None:
    """Cholesky's root of a lower triangle packed by rows; pivots that are rounding count as 0."""
    n = T.shape[0]
    for j in range(n):
        for i in range(j, n):
            total = packed[i * (i + 1) // 2 + j]
            for r in range(j):
                total -= T[i, r] * T[j, r]
            T[i, j] = total
        pivot = T[j, j]
        inverse = 0.0
        if pivot > PIVOT * packed[j * (j + 1) // 2 + j]:
            inverse = 1.0 / math.sqrt(pivot)
        for i in range(j, n):
            T[i, j] *= inverse


@kernel
def transform(  # noqa: PLR0912 - loops are what the compiler wants
    root: FloatArray,
    k: int,
    F: FloatArray,
    begin: int,
    wide: FloatArray,
    T: FloatArray,
    noisy: bool,
) -> None:
    """Make place ``k`` the lower triangular root of ``F P F' + T T'``; F lies by rows from
    ``begin`` on, T is used up.
    """
    n = root.shape[1]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(j, n):
                total += F[begin + i * n + r] * root[k, r, j]
            wide[i, j] = total
    # Householder's reflections, row by row, of F S and of the columns of T that reach the row.
    for i in range(n):
        size = 0.0
        for j in range(i + 1, n):
            size += wide[i, j] * wide[i, j]
        if noisy:
            for j in range(i + 1):
                size += T[i, j] * T[i, j]
        pivot = wide[i, i]
        length = math.sqrt(pivot * pivot + size)
        root[k, i, i] = length
        if length > 0.0:
            first = pivot + length if pivot >= 0.0 else pivot - length
            sign = -1.0 if pivot >= 0.0 else 1.0
            scale = 1.0 / (length * abs(first))
            for r in range(i + 1, n):
                total = first * wide[r, i]
                for j in range(i + 1, n):
                    total += wide[i, j] * wide[r, j]
                if noisy:
                    for j in range(i + 1):
                        total += T[i, j] * T[r, j]
                total *= scale
                root[k, r, i] = sign * (wide[r, i] - total * first)
                for j in range(i + 1, n):
                    wide[r, j] -= total * wide[i, j]
                if noisy:
                    for j in range(i + 1):
                        T[r, j] -= total * T[i, j]
        else:
            for r in range(i + 1, n):
                root[k, r, i] = wide[r, i]


@kernel
def information_rate(table: FlowTable, m: int, root: FloatArray, k: int) -> float:
    """``trace(P G)`` in 1/s."""
    n, rate = root.shape[1], 0.0
    for r in range(table.sizes[m, 0]):
        for j in range(n):
            total = 0.0
            for i in range(j, n):
                total += table.seen[m, r, i] * root[k, i, j]
            rate += total * total
    return rate


@kernel
def gain_root(
    moments: FloatArray,
    series: FloatArray,
    root: FloatArray,
    x: FloatArray,
    k: int,
    gap: float,
    values: FloatArray,
) -> None:
    """Use the ``moments`` (2p,) of the readings of a gap, which become innovations, at its end:
    ``x += (U + S S' W) innovations``. ``series`` is that of a GainTable, ``values`` room for a row.
    """
    n, q = x.shape[1], len(moments)
    fill_polynomial(values, series, gap)
    for m in range(q):
        for j in range(n):
            moments[m] -= values[(2 * q + m) * n + j] * x[k, j]
    # C is not needed any more, and q >= 1: its room holds W innovations, and S' times that.
    first = 2 * q * n
    for i in range(n):
        total = 0.0
        for m in range(q):
            x[k, i] += values[i * q + m] * moments[m]
            total += values[(n + i) * q + m] * moments[m]
        values[first + i] = total
    for j in range(n):  # S' w: place j is not read again
        total = 0.0
        for i in range(j, n):
            total += root[k, i, j] * values[first + i]
        values[first + j] = total
    for i in range(n):
        for j in range(i + 1):
            x[k, i] += root[k, i, j] * values[first + j]


# For Python.


@kernel
def move_alone(
    unit: FloatArray,
    sizes: np.ndarray,
    reach: FloatArray,
    series: FloatArray,
    gamma: FloatArray,
    bound: FloatArray,
    levels: FloatArray,
    seen: FloatArray,
    values: FloatArray,
    work: FloatArray,
    root: FloatArray,
    x: FloatArray,
    gap: float,
) -> None:
    """``move_root`` of one node and a table of one model, ``work`` (2 n + 2, n): numba takes plain
    arrays from Python ten times faster than it takes named ones.
    """
    n = x.shape[1]
    rows = values[series.shape[2] :]
    parts = work[:n], work[n : 2 * n], work[2 * n : 2 * n + 1], work[2 * n + 1 : 2 * n + 2]
    table = FlowTable(unit, sizes, reach, series, gamma, bound, levels, seen)
    move_root(
        table, 0, root, x, 0, gap, FlowRoom(values, parts[0], parts[1], rows, parts[2], parts[3])
    )


def flow_root(
    table: FlowTable, root: FloatArray, x: FloatArray, gap: float
) -> tuple[FloatArray, FloatArray]:
    """Root (n, n) and x (n,) of one node ``gap`` >= 0 seconds later, by a table of one model."""
    n = len(x)
    roots, means = root.reshape(1, n, n).copy(), x.reshape(1, n).copy()
    if gap > 0.0:
        values = np.empty(table.series.shape[2] + table.seen.shape[1] * n)
        move_alone(*table, values, np.empty((2 * n + 2, n)), roots, means, gap)
    return roots[0], means[0]


def gain_update_root(
    table: GainTable, root: FloatArray, x: FloatArray, moments: FloatArray, gap: float
) -> FloatArray:
    """``xhat(b)`` (n,) from the open-loop prediction ``x``, the root at b and the moments (2p,)."""
    if table.moments == 0:
        return x
    n = len(x)
    means, values = x.reshape(1, n).copy(), np.zeros(table.series.shape[1] - 1)
    gain_root(moments.copy(), table.series, root.reshape(1, n, n), means, 0, gap, values)
    return np.asarray(means[0])
