"""How fast links must tick for H(12) to have a steady state (derived; not in the paper).

A steady state exists if and only if some gains make the linear part of H(12) stable. Gains may be
as large as they like, so the part of its error that node i observes by itself can be kept at zero,
and what arrives from neighbours can be measured perfectly in those directions. What remains lives
in the unobservable subspaces, x = N_i z, and obeys

    d X_i = A_i X_i + X_i A_i' - d_i X_i + sum_j c_ij E_ij X_j E_ij',   E_ij = (U_i - K_i O_i) T N_j

where U_i N_i = I, the rows of O_i span what vanishes on N_i, and the K_i are free. The least growth
rate over K is found by policy iteration: the Perron vector X for given K, then
``K_i = U_i W_i O_i' (O_i W_i O_i')^+`` with ``W_i = sum_j c_ij T N_j X_j N_j' T'``, which cannot
raise it. For one blind node it is the classical condition lambda pi > 2 a.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from netkf.core.arrays import FloatArray, symmetric
from netkf.theory.coupled import Coupled

DENSE = 400
LARGEST_FACTOR = 1e9


class _Hidden(NamedTuple):
    """One node's unobservable subspace: N (n, k), U (k, n), O (n - k, n) and A there (k, k)."""

    N: FloatArray
    U: FloatArray
    O: FloatArray  # noqa: E741
    A: FloatArray


def _hidden(A: FloatArray, G: FloatArray) -> _Hidden:
    n = len(A)
    seen = G / max(float(np.abs(G).max()), 1e-300)
    step = A / max(float(np.linalg.norm(A, 2)), 1e-300)
    rows = [seen]
    for _ in range(n - 1):
        rows.append(rows[-1] @ step)
    _, values, vectors = np.linalg.svd(np.concatenate(rows))
    rank = int((values > 1e-9 * max(values[0], 1e-300)).sum()) if np.abs(G).max() > 0.0 else 0
    N, O = vectors[rank:].T, vectors[:rank]  # noqa: E741
    return _Hidden(N, N.T, O, N.T @ A @ N)


def growth(equations: Coupled, factor: float) -> float:
    """The least growth rate (1/s) of H(12)'s linear part when all rates are ``factor`` times what
    they are; a steady state exists where it is negative. Minus infinity: no node needs help.
    """
    hidden = [_hidden(equations.A, G) for G in equations.G]
    gains = [np.zeros((len(h.A), len(h.O))) for h in hidden]
    coupling = factor * equations.coupling
    best = np.inf
    for _ in range(100):
        rate, X = _perron(equations, coupling, hidden, gains)
        if rate > best - 1e-9 * (1.0 + abs(best)):
            break
        best = rate
        gains = _improved(equations, coupling, hidden, X)
    return best


def _perron(
    equations: Coupled,
    coupling: scipy.sparse.csr_array,
    hidden: list[_Hidden],
    gains: list[FloatArray],
) -> tuple[float, list[FloatArray]]:
    sizes = [len(h.A) ** 2 for h in hidden]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    total = int(offsets[-1])
    if total == 0:
        return -np.inf, [np.zeros((0, 0))] * len(hidden)
    blocks: list[list[scipy.sparse.sparray | None]] = [[None] * len(hidden) for _ in hidden]
    leaving = np.asarray(coupling.sum(axis=1)).reshape(-1)
    entries = coupling.tocoo()
    for i, j, c in zip(entries.row, entries.col, entries.data, strict=True):
        E = (hidden[i].U - gains[i] @ hidden[i].O) @ equations.T @ hidden[j].N
        blocks[i][j] = scipy.sparse.coo_array(c * np.kron(E, E))
    for k, h in enumerate(hidden):
        eye = np.eye(len(h.A))
        own = np.kron(h.A, eye) + np.kron(eye, h.A) - leaving[k] * np.eye(len(h.A) ** 2)
        blocks[k][k] = scipy.sparse.coo_array(own)
    kept = [i for i, size in enumerate(sizes) if size]
    matrix = scipy.sparse.block_array([[blocks[i][j] for j in kept] for i in kept], format="csc")
    rate, vector = _rightmost(matrix)
    X = [
        symmetric(vector[offsets[i] : offsets[i + 1]].reshape(hidden[i].A.shape))
        for i in range(len(hidden))
    ]
    sign = np.sign(sum(float(np.trace(x)) for x in X)) or 1.0
    return rate, [sign * x for x in X]


def _rightmost(matrix: scipy.sparse.csc_array) -> tuple[float, FloatArray]:
    """The real eigenvalue with the largest real part and its vector (the Perron pair)."""
    if matrix.shape[0] > DENSE:
        try:
            values, vectors = scipy.sparse.linalg.eigs(matrix, k=1, which="LR", tol=1e-10)
            return float(values[0].real), np.asarray(vectors[:, 0].real)
        except scipy.sparse.linalg.ArpackError:
            pass
    values, vectors = scipy.linalg.eig(matrix.toarray())
    k = int(np.argmax(values.real))
    vector = vectors[:, k]
    return float(values[k].real), np.asarray((vector / vector[np.argmax(np.abs(vector))]).real)


def _improved(
    equations: Coupled,
    coupling: scipy.sparse.csr_array,
    hidden: list[_Hidden],
    X: list[FloatArray],
) -> list[FloatArray]:
    whole = np.stack([h.N @ x @ h.N.T for h, x in zip(hidden, X, strict=True)])
    sent = equations.T @ whole @ equations.T.T
    W = (coupling @ sent.reshape(len(X), -1)).reshape(sent.shape)
    return [
        h.U @ w @ h.O.T @ np.linalg.pinv(h.O @ w @ h.O.T, rcond=1e-10, hermitian=True)
        for h, w in zip(hidden, W, strict=True)
    ]


def threshold_factor(equations: Coupled) -> float | None:
    """The factor on all link rates from which on H(12) has a steady state, to 1e-6; None where no
    factor up to 1e9 helps.
    """
    low, high = 1.0, 2.0
    while growth(equations, high) >= 0.0:
        low, high = high, 2.0 * high
        if high > LARGEST_FACTOR:
            return None
    while high / low > 1.0 + 1e-7:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if growth(equations, middle) < 0.0 else (middle, high)
    return high
