"""Kernels for square roots of covariances, ``P = S S'``, and for the linear forms of errors.

An error is a linear form of independent standard normal inputs, its coefficients (n, C). Roots are
updated by orthogonal triangularisation (Kailath, Sayed and Hassibi 2000, Linear Estimation, chapter
12), in which no subtraction cancels digits.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.kernels.square_root import reflect
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import add_matmul, copy_matrix, matmul, solve


@kernel
def triangularise(factor: FloatArray, n: int, columns: int) -> None:
    """Overwrite the first n columns of ``factor`` by the lower triangular S (n, n) with ``S S' =
    factor factor'`` of its first ``columns`` columns; the others are scratch.
    """
    # Householder reflections from the right leave factor factor' unchanged.
    for i in range(n):
        reflect(factor, i, n, columns)
        # Exact zeros right of the diagonal, and in columns that are not part of the product.
        for c in range(min(i + 1, columns), max(n, columns)):
            factor[i, c] = 0.0


@kernel
def divide_by_transpose(rows: FloatArray, L: FloatArray, count: int, n: int) -> None:
    """Replace ``rows`` (count, n) by ``rows L^-T`` in place, for a lower triangular L (n, n)."""
    for r in range(count):
        for j in range(n):
            total = rows[r, j]
            for k in range(j):
                total -= rows[r, k] * L[j, k]
            rows[r, j] = total / L[j, j]


@kernel(allocates=True)
def root_of(factor: FloatArray, columns: int) -> FloatArray:
    """Return the lower triangular S (n, n) of ``triangularise``, which overwrites ``factor``."""
    n = factor.shape[0]
    triangularise(factor, n, columns)
    root = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            root[i, j] = factor[i, j]
    return root


@kernel(allocates=True)
def identity(n: int) -> FloatArray:
    """Return the unit matrix (n, n)."""
    unit = np.zeros((n, n))
    for i in range(n):
        unit[i, i] = 1.0
    return unit


@kernel(allocates=True)
def exponential(series: FloatArray, share: float) -> FloatArray:
    """Return ``sum_k share^k series[k]`` (d, d) of a power ``series`` (T, d, d) by Horner."""
    d = series.shape[1]
    E = np.empty((d, d))
    for i in range(d):
        for j in range(d):
            total = 0.0
            for term in range(len(series) - 1, -1, -1):
                total = total * share + series[term, i, j]
            E[i, j] = total
    return E


@kernel(allocates=True)
def flow_blocks(
    series: FloatArray, unit: float, scale: float, gap: float, nodes: FloatArray
) -> FloatArray:
    """Return the transposes (K + 1, 4, n, n) of the blocks of exp(M s) at the ``nodes`` (K,) of a
    gap and at its end; ``series`` (T, 2 n, 2 n) are the terms of exp(M s) in s / unit for
    covariances in units of ``scale``.
    """
    n, count = series.shape[1] // 2, len(nodes)
    out = np.empty((count + 1, 4, n, n))
    for k in range(count + 1):
        E = exponential(series, (nodes[k] if k < count else 1.0) * gap / unit)
        for i in range(n):
            for j in range(n):
                out[k, 0, i, j] = E[j, i]
                out[k, 1, i, j] = E[j, n + i] / scale
                out[k, 2, i, j] = E[n + j, i] * scale
                out[k, 3, i, j] = E[n + j, n + i]
    return out


@kernel(allocates=True)
def flow_gramian(
    blocks: FloatArray, whitened: FloatArray, root_weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return F = ``X(g)^-T`` (n, n) for P = 0 at the start of a gap, and Gamma (K p, n), with
    Gamma' Gamma the information of its readings about the state at its start, for ``whitened``
    R^-1/2 H (p, n).
    """
    count, (p, n) = len(root_weights), whitened.shape
    Gamma = np.empty((count * p, n))
    for k in range(count):
        rows = matmul(whitened, solve(blocks[k, 0], identity(n)))
        for i in range(p):
            for j in range(n):
                Gamma[k * p + i, j] = root_weights[k] * rows[i, j]
    # F = X(g)^-T, and block 0 is X^T.
    return solve(blocks[count, 0], identity(n)), Gamma


@kernel(allocates=True)
def flow_start(
    F: FloatArray, blocks: FloatArray, B: FloatArray, gain: FloatArray, root_weights: FloatArray
) -> FloatArray:
    """Return the root (n, n) of P at the end of a gap from P = 0, of noise ``B``, ``gain``."""
    count, n, m, p = len(root_weights), B.shape[0], B.shape[1], gain.shape[1]
    factor = np.zeros((n, max(n, count * (m + p))))
    for k in range(count):
        first = k * (m + p)
        _add_product(factor, first, matmul(F, blocks[k, 0]), B, root_weights[k])
        _add_product(factor, first + m, matmul(F, blocks[k, 2]), gain, root_weights[k])
    return root_of(factor, count * (m + p))


@kernel
def _add_product(out: FloatArray, first: int, a: FloatArray, b: FloatArray, scale: float) -> None:
    """Add ``scale a b`` (r, c) to the columns of ``out`` from ``first`` on."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, first + j] += scale * total


@kernel(allocates=True)
def flow_over_gap(
    F: FloatArray, Gamma: FloatArray, start: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``F J``, ``F J P`` and the root of P at the end of a gap, (n, n) each, with ``J = (I +
    P Gamma' Gamma)^-1`` and P = root root' at its start; ``start`` is that of ``flow_start``.
    """
    n, rows = F.shape[0], Gamma.shape[0]
    GS, SL = matmul(Gamma, root), root.copy()
    triangle = np.zeros((n, n + rows))
    for i in range(n):
        triangle[i, i] = 1.0
        for k in range(rows):
            triangle[i, n + k] = GS[k, i]
    # L L' = I + S' G S, so that J = I - S (L L')^-1 S' G and S L^-T is a root of J P.
    triangularise(triangle, n, n + rows)
    divide_by_transpose(SL, triangle, n, n)
    divide_by_transpose(GS, triangle, rows, n)
    J = identity(n)
    _add_product(J, 0, matmul(SL, GS.T), Gamma, -1.0)
    FSZ, factor = matmul(F, SL), np.empty((n, 2 * n))
    for i in range(n):
        for j in range(n):
            factor[i, j], factor[i, n + j] = FSZ[i, j], start[i, j]
    return matmul(F, J), matmul(FSZ, SL.T), root_of(factor, 2 * n)


@kernel(allocates=True)
def flow_estimates(
    errors: FloatArray,
    roots: FloatArray,
    columns: tuple[int, int],
    flow: tuple[FloatArray, ...],
    exponential: tuple[FloatArray, float, float],
    gap: float,
    quadrature: tuple[FloatArray, FloatArray],
) -> None:
    """Propagate the forms of K ``errors`` (K, n, C) of filters with the same continuous readings,
    and the ``roots`` (K, n, n) of their P, over a ``gap`` of at most one unit, in seconds; changes
    both.

    flow        : R^-1/2 H (p, n), the filters' gain factors H' R^-1/2 and H' R^-1 times a root of
                  the true noise (n, p), the filters' B and the plant's B (n, m)
    exponential : terms (T, 2 n, 2 n) of the series of exp(M s), its unit in seconds and the scale
                  of covariances
    quadrature  : nodes and weights (K,) on [0, 1]
    columns     : the first of the K m inputs of the plant, and the first of the n inputs of each
                  error's own noise, which are there if p > 0
    """
    whitened, gain, noise, B, plant = flow
    nodes, weights = quadrature
    root_weights = np.sqrt(weights * gap)
    blocks = flow_blocks(exponential[0], exponential[1], exponential[2], gap, nodes)
    F, Gamma = flow_gramian(blocks, whitened, root_weights)
    start = flow_start(F, blocks, B, gain, root_weights)
    count, n, p = len(nodes), F.shape[0], whitened.shape[0]
    for e in range(len(errors)):
        form = errors[e]
        FJ, FC, root = flow_over_gap(F, Gamma, start, roots[e])
        copy_matrix(form, matmul(FJ, form))
        reading_noise = np.zeros((n, max(n, count * p)))
        for k in range(count):
            # Phi(g, s) = X(g)^-T X(s)^T, and Phi(g, s) L(s) with the gain L of the filter at s.
            phi = add_matmul(matmul(FJ, blocks[k, 0]), FC, blocks[k, 1])
            _add_product(form, columns[0] + k * plant.shape[1], phi, plant, root_weights[k])
            phi = add_matmul(matmul(FJ, blocks[k, 2]), FC, blocks[k, 3])
            _add_product(reading_noise, k * p, phi, noise, root_weights[k])
        if p > 0:
            own = root_of(reading_noise, max(n, count * p))
            for i in range(n):
                for j in range(i + 1):
                    form[i, columns[1] + e * n + j] += own[i, j]
        copy_matrix(roots[e], root)
