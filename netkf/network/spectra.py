"""Eigenvalues of a topology."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from netkf.network.graphs import Topology

MAX_DENSE = 400
"""The most nodes for which all eigenvalues are computed."""


def laplacian_radius(topology: Topology) -> float:
    """rho(L), the largest eigenvalue of the Laplacian of all links."""
    if not topology.links:
        return 0.0
    index, degrees = topology.index, topology.degrees
    ends = np.array([(index[i], index[j]) for i, j in topology.links])
    degree = np.array([float(degrees[node]) for node in topology.nodes])
    if len(degree) > MAX_DENSE:
        return _largest_sparse(ends, degree)
    L = np.diag(degree)
    L[ends[:, 0], ends[:, 1]] = L[ends[:, 1], ends[:, 0]] = -1.0
    return float(np.linalg.eigvalsh(L)[-1])


def _largest_sparse(ends: np.ndarray, degree: np.ndarray) -> float:
    import scipy.sparse
    import scipy.sparse.linalg

    one = np.full(len(ends), -1.0)
    half = scipy.sparse.coo_array((one, (ends[:, 0], ends[:, 1])), shape=(len(degree),) * 2)
    L = (half + half.T + scipy.sparse.diags_array(degree)).tocsr()
    start = np.random.default_rng(0).standard_normal(len(degree))
    return float(scipy.sparse.linalg.eigsh(L, k=1, v0=start, return_eigenvectors=False)[0])
