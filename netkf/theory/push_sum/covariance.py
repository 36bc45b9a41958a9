"""The exact steady error covariance of the push-sum filter at every node."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.scenario.scenario import Scenario
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.estimation_steps import EstimationSteps, estimation_steps
from netkf.theory.push_sum.mean_square import (
    KRYLOV_VECTORS,
    MAX_DENSE,
    MAX_DENSE_FALLBACK,
    dense_mapping,
    mapping,
    push_sum_radius,
    radius,
)

MAX_ROUNDS = 20
RESIDUAL = 1e-10


def push_sum_error_covariance(scenario: Scenario) -> FloatArray:
    """Return the exact steady covariance (N, n, n) of x - xhat, in the order of the nodes.

    The mean is over noises and links, for P steps 4-5 at the asymptotic gains. The filter's gains
    converge to these if links fail in both directions together and no gain is frozen early (P
    Theorem 2). The filters' Q and R may differ from the truth. Raises TheoryError if
    ``push_sum_radius`` is not below 1 or does not exist.
    """
    return _covariance(estimation_steps(scenario), push_sum_radius(scenario))


def steady_error_covariance(steps: EstimationSteps) -> FloatArray:
    """Return the covariance (N, n, n) of ``push_sum_error_covariance`` for given steps 4 and 5."""
    return _covariance(steps, radius(steps))


def _covariance(steps: EstimationSteps, found: float) -> FloatArray:
    """Return the steady covariance (N, n, n) of steps with mean-square radius ``found``."""
    if not found < 1.0:
        raise TheoryError(
            f"no steady error covariance: the mean-square radius is {found:.6g}, not below 1; "
            "raise gamma or the delivery probability"
        )
    N, n, _ = steps.closed.shape
    scale = steps.scale
    every = np.tile(scale, N)
    # E[(M (x) I) cov(h) (M (x) I)'], the constant term of the equation
    noise = symmetric(steps.averaging.second_moment(steps.noise / np.outer(every, every)))
    # The error of the solution is up to 1 / (1 - radius) times the residual.
    tolerance = RESIDUAL * max(1.0 - found, 1e-3)
    X = _fixed_point(steps.averaging, steps.scaled, noise, tolerance)
    each = np.arange(N)
    blocks = X.reshape(N, n, N, n)[each, :, each]
    return symmetric(blocks * np.outer(scale, scale))


def _fixed_point(
    law: Averaging, closed: FloatArray, noise: FloatArray, tolerance: float
) -> FloatArray:
    """Return the solution X (N n, N n) of X = T(X) + noise.

    Its residual is at most ``tolerance``, relative to the standard deviations of row and column.
    Raises TheoryError if that is not reached.
    """
    T, X = mapping(law, closed), noise
    for _ in range(MAX_ROUNDS):
        rest = noise + T(X) - X
        deviations = np.sqrt(np.abs(np.diagonal(X)))
        # Small variances must be accurate too, beside large ones of other states.
        allowed = np.outer(deviations, deviations) + 1e-6 * deviations.max(initial=0.0) ** 2
        if (np.abs(rest) <= tolerance * allowed).all():
            return X
        X = _dense(law, closed, noise) if len(noise) <= MAX_DENSE else X + _krylov(T, rest)
    if len(noise) <= MAX_DENSE_FALLBACK:
        return _dense(law, closed, noise)
    raise TheoryError(f"the steady covariance was solved to {np.abs(rest).max():.1e} only")


def _dense(law: Averaging, closed: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the solution of X = T(X) + noise by elimination on upper triangles."""
    rows, columns = np.triu_indices(len(noise))
    matrix = np.eye(len(rows)) - dense_mapping(law, closed)
    X = np.zeros_like(noise)
    X[rows, columns] = X[columns, rows] = np.linalg.solve(matrix, noise[rows, columns])
    return X


def _krylov(T: Callable[[FloatArray], FloatArray], right: FloatArray) -> FloatArray:
    """Return an approximate solution (N n, N n) of X - T(X) = right by GMRES."""
    size = len(right)

    def matvec(x: FloatArray) -> FloatArray:
        X = symmetric(x.reshape(size, size))
        return np.asarray((X - T(X)).ravel())

    operator = scipy.sparse.linalg.LinearOperator(
        (size**2, size**2), matvec=matvec, dtype=np.float64
    )
    x, _ = scipy.sparse.linalg.gmres(
        operator, right.ravel(), rtol=1e-8, atol=0.0, restart=KRYLOV_VECTORS, maxiter=10
    )
    return symmetric(np.asarray(x).reshape(size, size))
