"""The exact steady error covariance of the push-sum filter at every node, without a simulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.scenario.scenario import Scenario
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.estimation_steps import estimation_steps
from netkf.theory.push_sum.mean_square import (
    BASIS,
    FEW,
    TINY,
    mapping,
    push_sum_radius,
    written_out,
)

MAX_ROUNDS = 20
RESIDUAL = 1e-10


def push_sum_error_covariance(scenario: Scenario) -> FloatArray:
    """(N, n, n): exact steady covariance of x - xhat at every node, in the order of the nodes.

    Of P steps 4-5 at the asymptotic gains, over noises and links: those that the filter comes to
    where links fail in both directions together and no gain is frozen early (P Theorem 2). The
    filters' Q and R may differ from the truth. Raises TheoryError where ``push_sum_radius`` is not
    below 1 or does not exist.
    """
    found, steps = push_sum_radius(scenario), estimation_steps(scenario)
    if not found < 1.0:
        raise TheoryError(
            f"no steady error covariance: the mean-square radius is {found:.6g}, not below 1; "
            "raise gamma or the delivery probability"
        )
    N, n, _ = steps.closed.shape
    scale = steps.scale
    every = np.tile(scale, N)
    noise = symmetric(steps.averaging.second_moment(steps.noise / np.outer(every, every)))
    # what is left over grows by 1 / (1 - radius) in the solution
    tolerance = RESIDUAL * max(1.0 - found, 1e-3)
    X = _fixed_point(steps.averaging, steps.scaled, noise, tolerance)
    each = np.arange(N)
    blocks = X.reshape(N, n, N, n)[each, :, each]
    return symmetric(blocks * np.outer(scale, scale))


def _fixed_point(
    law: Averaging, closed: FloatArray, noise: FloatArray, tolerance: float
) -> FloatArray:
    """X = T(X) + noise; its residual is small beside the variances of the row and the column."""
    T, X = mapping(law, closed), noise
    for _ in range(MAX_ROUNDS):
        rest = noise + T(X) - X
        deviations = np.sqrt(np.abs(np.diagonal(X)))
        allowed = np.outer(deviations, deviations) + 1e-6 * deviations.max(initial=0.0) ** 2
        if (np.abs(rest) <= tolerance * allowed).all():
            return X
        X = _dense(law, closed, noise) if len(noise) <= TINY else X + _krylov(T, rest)
    if len(noise) <= FEW:
        return _dense(law, closed, noise)
    raise TheoryError(f"the steady covariance was solved to {np.abs(rest).max():.1e} only")


def _dense(law: Averaging, closed: FloatArray, noise: FloatArray) -> FloatArray:
    rows, columns = np.triu_indices(len(noise))
    matrix = np.eye(len(rows)) - written_out(law, closed)
    X = np.zeros_like(noise)
    X[rows, columns] = X[columns, rows] = np.linalg.solve(matrix, noise[rows, columns])
    return X


def _krylov(T: Callable[[FloatArray], FloatArray], right: FloatArray) -> FloatArray:
    """An approximate solution of X - T(X) = right by generalised minimal residuals."""
    size = len(right)

    def matvec(x: FloatArray) -> FloatArray:
        X = symmetric(x.reshape(size, size))
        return np.asarray((X - T(X)).ravel())

    operator = scipy.sparse.linalg.LinearOperator(
        (size**2, size**2), matvec=matvec, dtype=np.float64
    )
    x, _ = scipy.sparse.linalg.gmres(
        operator, right.ravel(), rtol=1e-8, atol=0.0, restart=BASIS, maxiter=10
    )
    return symmetric(np.asarray(x).reshape(size, size))
