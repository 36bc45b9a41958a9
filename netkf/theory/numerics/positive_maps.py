"""Linear maps on symmetric matrices that keep them positive semidefinite: radius and fixed point.

A map T takes and gives a stack (S, M, M) of symmetric matrices, such as second moments in each of S
modes. Its spectral radius is an eigenvalue with a semidefinite stack (Krein and Rutman), and below
1 if and only if ``X = T(X) + Q`` has a semidefinite solution for a positive definite Q.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric

PositiveMap = Callable[[FloatArray], FloatArray]

MAX_DENSE = 40
"""Numbers in a stack up to which T is a dense matrix."""
KRYLOV_VECTORS, RESTARTS = 24, 200
RESIDUAL, MAX_ROUNDS = 1e-11, 20


def spectral_radius(T: PositiveMap, shape: tuple[int, ...]) -> float:
    """Return the spectral radius of a positive map on stacks of a ``shape`` (S, M, M).

    Raises TheoryError if the iteration does not converge.
    """
    start = np.broadcast_to(np.eye(shape[-1]), shape).ravel()
    if len(start) <= MAX_DENSE:
        columns = [_apply(T, shape)(unit) for unit in np.eye(len(start))]
        return float(np.abs(np.linalg.eigvals(np.stack(columns, axis=1))).max())
    try:
        values = scipy.sparse.linalg.eigs(
            _operator(_apply(T, shape), len(start)),
            k=1,
            which="LR",  # an eigenvalue, so that none has a larger real part
            v0=start,
            ncv=KRYLOV_VECTORS,
            maxiter=RESTARTS,
            tol=1e-10,
            return_eigenvectors=False,
        )
    except scipy.sparse.linalg.ArpackError as error:
        raise TheoryError(f"the mean-square radius was not found: {error}") from None
    return float(values[0].real)


def fixed_point(T: PositiveMap, Q: FloatArray, radius: float) -> FloatArray:
    """Return the solution (S, M, M) of ``X = T(X) + Q`` by GMRES with refinement, for a positive
    map of spectral ``radius`` below 1.

    Its residual is below RESIDUAL times 1 - radius, relative to the largest entry of X. Raises
    TheoryError if that is not reached.
    """
    apply, X = _apply(T, Q.shape), np.array(Q)
    operator = _operator(lambda x: x - apply(x), Q.size)
    for _ in range(MAX_ROUNDS):
        rest = Q + T(X) - X
        # The error of the solution is up to 1 / (1 - radius) times the residual.
        if np.abs(rest).max() <= RESIDUAL * max(1.0 - radius, 1e-3) * np.abs(X).max():
            return symmetric(X)
        step, _ = scipy.sparse.linalg.gmres(
            operator, rest.ravel(), rtol=1e-8, atol=0.0, restart=KRYLOV_VECTORS, maxiter=20
        )
        X = X + symmetric(np.asarray(step).reshape(Q.shape))
    raise TheoryError(f"the mean squares were solved to {np.abs(rest).max():.1e} only")


def _apply(T: PositiveMap, shape: tuple[int, ...]) -> Callable[[FloatArray], FloatArray]:
    """Return T on vectors; what is not symmetric in a vector does not count."""
    return lambda x: np.asarray(T(symmetric(np.reshape(x, shape))).ravel())


def _operator(
    apply: Callable[[FloatArray], FloatArray], size: int
) -> scipy.sparse.linalg.LinearOperator:
    return scipy.sparse.linalg.LinearOperator((size, size), matvec=apply, dtype=np.float64)
