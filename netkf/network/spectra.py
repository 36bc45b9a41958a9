"""Eigenvalues and components of graphs."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from netkf.linalg.arrays import FloatArray

MAX_DENSE = 400
"""The largest number of nodes for which all eigenvalues are computed."""
LOOK, RESIDUAL = 20, 1e-6
"""Steps of the Lanczos method between two looks at its residual, and the relative residual at which
it ends, which leaves 1e-10 in the eigenvalue.
"""


def largest_laplacian_eigenvalue(degrees: FloatArray, ends: np.ndarray) -> float:
    """Return the largest eigenvalue of the Laplacian of an undirected graph with ``degrees`` (N,)
    and ``ends`` (L, 2) of links, as indices.
    """
    if not len(ends):
        return 0.0
    if len(degrees) > MAX_DENSE:
        largest = _largest_sparse(degrees, ends)
    else:
        L = np.diag(degrees)
        L[ends[:, 0], ends[:, 1]] = L[ends[:, 1], ends[:, 0]] = -1.0
        largest = float(np.linalg.eigvalsh(L)[-1])
    # Rational eigenvalues of a matrix of integers are integers: rounding, which depends on the
    # order of nodes, must not decide whether a gain equals one.
    return float(round(largest)) if abs(largest - round(largest)) < 1e-9 * largest else largest


def _largest_sparse(degrees: FloatArray, ends: np.ndarray) -> float:
    import scipy.sparse
    from scipy.linalg import eigh_tridiagonal

    size = len(degrees)
    entries = np.full(len(ends), -1.0)
    upper = scipy.sparse.coo_array((entries, (ends[:, 0], ends[:, 1])), shape=(size, size))
    L = (upper + upper.T + scipy.sparse.diags_array(degrees)).tocsr()
    # Lanczos without orthogonalisation, of which the largest eigenvalue has no need: ARPACK, with
    # it and with restarts, took ten times as long.
    before, v = np.zeros(size), np.random.default_rng(0).standard_normal(size)
    v /= np.linalg.norm(v)
    diagonal, beside, largest = [], [0.0], 0.0
    for k in range(size):
        w = L @ v - beside[-1] * before
        diagonal.append(float(v @ w))
        w -= diagonal[-1] * v
        beside.append(float(np.linalg.norm(w)))
        if k % LOOK == LOOK - 1 or k == size - 1 or beside[-1] == 0.0:
            values, vectors = eigh_tridiagonal(
                diagonal, beside[1:-1], select="i", select_range=(k, k)
            )
            largest = float(values[0])
            if beside[-1] * abs(vectors[-1, 0]) <= RESIDUAL * largest:
                break
        before, v = v, w / beside[-1]
    return largest


def connected_parts(graph: Any, connection: Literal["strong", "weak"]) -> tuple[int, np.ndarray]:
    """Return in how many parts the edges (i, j), entries (N, N) that are not 0 of a full or sparse
    matrix, join the nodes, and the part of each node (N,).
    """
    if not isinstance(graph, np.ndarray):
        import scipy.sparse

        count, part = scipy.sparse.csgraph.connected_components(graph, connection=connection)
        return int(count), np.asarray(part)
    joined = (graph != 0.0) | np.eye(len(graph), dtype=bool)
    reached = (joined | joined.T if connection == "weak" else joined).astype(np.float32)
    for _ in range(len(graph).bit_length()):  # paths of twice the length
        reached = (reached @ reached > 0.0).astype(np.float32)
    _, parts = np.unique((reached * reached.T > 0.0).argmax(axis=1), return_inverse=True)
    return int(parts.max(initial=-1)) + 1, parts
