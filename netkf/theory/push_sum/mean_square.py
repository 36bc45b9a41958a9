"""Exact mean squares of the errors of the push-sum filter: P steps 4-5 at asymptotic gains.

The stacked error obeys ``e+ = (M (x) I)(A e + h)``, A = diag(A_i), with independent M, P (25); its
covariance ``X+ = T(X) + E[(M (x) I) cov(h) (M (x) I)']`` with the linear, positive map
``T(X) = E[(M (x) I) A X A' (M (x) I)']``. The radius of T is an eigenvalue with a semidefinite X
(Krein and Rutman): the rightmost one, which Arnoldi's method computes and a positive definite X
proves (Collatz and Wielandt). If X is singular and proves nothing, small systems are solved by
dense eigenvalues.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.sparse.csgraph
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.scenario.scenario import Scenario
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.estimation_steps import EstimationSteps, averaging_law, estimation_steps

MAX_DENSE, MAX_DENSE_FALLBACK = 10, 40  # rows of X up to which T is a dense matrix: always, or
# if the iteration fails
PROOF_TOLERANCE = 1e-6  # relative, between the radius and the bound that X proves
KRYLOV_VECTORS = 24  # of Arnoldi's method
MAX_ROWS = 500  # of X; with twice as many rows a step takes four times the work and memory
DENSE_ROWS = 300  # of the mean dynamics up to which all eigenvalues are computed
MEAN_KRYLOV_VECTORS, MEAN_RESTARTS = 40, 60


def push_sum_radius(scenario: Scenario) -> float:
    """Return the spectral radius of the mean-square error dynamics, P steps 4-5.

    At the asymptotic gains. Below 1 if and only if the errors stay bounded in the mean square (for
    a noise that drives every mode); single paths may stay bounded above 1. Exact: from the mean
    Kronecker square of one averaging step raised to gamma, or of all gamma steps together for held
    links. Links fail independently, with the probabilities of the channel. Raises TheoryError if
    the links have no such law, the gains do not exist, or the network is too large.
    """
    return _cached_radius(scenario)


@lru_cache(maxsize=8)
def _cached_radius(scenario: Scenario) -> float:
    """Return the radius, cached: assumptions, promises and the error covariance all use it."""
    return radius(estimation_steps(scenario))


def push_sum_stability(
    scenario: Scenario, gammas: Sequence[int], deliveries: Sequence[float]
) -> FloatArray:
    """Return ``push_sum_radius`` (len(gammas), len(deliveries)), the stability map."""
    steps = estimation_steps(scenario, averaging_law(scenario, 1.0))
    found = np.empty((len(gammas), len(deliveries)))
    for column, delivery in enumerate(deliveries):
        law = averaging_law(scenario, delivery)
        for row, gamma in enumerate(gammas):
            if int(gamma) != gamma or gamma < 1:
                raise TheoryError(f"gamma must be a positive integer, got {gamma!r}")
            found[row, column] = radius(replace(steps, averaging=replace(law, gamma=int(gamma))))
    return found


def radius(steps: EstimationSteps) -> float:
    """Return the spectral radius of T, the largest over groups of states that do not mix.

    Raises TheoryError for networks with more than MAX_ROWS states in a group.
    """
    return max(_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def mean_radius(steps: EstimationSteps) -> float:
    """Return the spectral radius of the mean dynamics, P (30); unbiased estimates if below 1."""
    return max(_mean_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def _mean_radius(law: Averaging, closed: FloatArray) -> float:
    N, n, _ = closed.shape
    if N * n > DENSE_ROWS and not law.enumerated:
        return _mean_radius_by_arnoldi(law, closed)
    # (E[M^gamma] (x) I) diag(A_j)
    whole = np.einsum("ij,jab->iajb", law.mean, closed).reshape(N * n, N * n)
    return float(np.abs(np.linalg.eigvals(whole)).max())


def _mean_radius_by_arnoldi(law: Averaging, closed: FloatArray) -> float:
    """Return the radius of the mean dynamics of a large network; raises TheoryError."""
    N, n, _ = closed.shape

    def step(e: FloatArray) -> FloatArray:
        moved = (closed @ e.reshape(N, n, 1))[:, :, 0]
        for _ in range(law.gamma):
            moved = law.mean_step @ moved
        return np.asarray(moved.ravel())

    operator = scipy.sparse.linalg.LinearOperator((N * n, N * n), matvec=step, dtype=np.float64)
    try:
        values = scipy.sparse.linalg.eigs(
            operator,
            k=2,  # a leading eigenvalue may be one of a complex pair
            which="LM",
            v0=np.linspace(1.0, 2.0, N * n),
            ncv=MEAN_KRYLOV_VECTORS,
            tol=1e-9,
            maxiter=MEAN_RESTARTS,
            return_eigenvectors=False,
        )
    except scipy.sparse.linalg.ArpackError as error:
        raise TheoryError(f"the radius of the mean was not found: {error}") from None
    return float(np.abs(values).max())


def _groups(closed: FloatArray) -> list[FloatArray]:
    """Return the A_i of each group of states that no A_i mixes with others, such as plane axes.

    The cross covariance of two groups grows no faster than the geometric mean of their own.
    """
    size = np.abs(closed).max(axis=0)
    # Two states mix if some A_i has an entry between them.
    linked = size > 1e-13 * size.max()
    _, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    return [closed[:, group[:, None], group] for group in groups]


def _radius(law: Averaging, closed: FloatArray) -> float:
    """Return the spectral radius of T for one group of states; raises TheoryError."""
    if law.deterministic:  # M is fixed, so that T is the square of the mean dynamics
        return _mean_radius(law, closed) ** 2
    size = closed.shape[0] * closed.shape[1]
    if size > MAX_ROWS:
        raise TheoryError(
            f"mean squares of {size:,} errors that mix are {size:,}^2 numbers; they are computed "
            f"for at most {MAX_ROWS} errors, so take a smaller network"
        )
    if size > MAX_DENSE:
        value, proved = _arnoldi(law, closed)
        if proved or size > MAX_DENSE_FALLBACK:
            return value
    return float(np.abs(np.linalg.eigvals(dense_mapping(law, closed))).max())


def dense_mapping(law: Averaging, closed: FloatArray) -> FloatArray:
    """Return T as a matrix on the upper triangles of symmetric X (N n, N n)."""
    N, n, _ = closed.shape
    kron = law.kron.reshape(N, N, N, N)
    rows, columns = np.triu_indices(N * n)
    (i, a), (j, b) = np.divmod(rows, n), np.divmod(columns, n)
    # Entry ((i,a),(j,b)) from ((k,c),(l,d)) is kron[i,j,k,l] A_k[a,c] A_l[b,d].
    to_i, to_a, to_j, to_b = (x[:, None] for x in (i, a, j, b))
    straight = kron[to_i, to_j, i, j] * closed[i, to_a, a] * closed[j, to_b, b]
    mirrored = kron[to_i, to_j, j, i] * closed[j, to_a, b] * closed[i, to_b, a]
    return np.asarray(straight + np.where(rows == columns, 0.0, mirrored))


def mapping(law: Averaging, closed: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return T as a function of symmetric matrices (N n, N n)."""
    N, n, _ = closed.shape

    def left(X: FloatArray) -> FloatArray:
        return np.asarray(closed @ X.reshape(N, n, N * n)).reshape(X.shape)

    return lambda X: symmetric(law.second_moment(left(left(X).T)))


def _arnoldi(law: Averaging, closed: FloatArray) -> tuple[float, bool]:
    """Return the rightmost eigenvalue, the radius of the positive map T, and True if X proves it.

    X proves it if it is positive definite beyond the residual. The search starts at the identity,
    which always has a component along X. Without a proof for a large system a second search, from
    another start, must find the same value; raises TheoryError if not.
    """
    size = closed.shape[0] * closed.shape[1]
    T = mapping(law, closed)
    value, X = _rightmost(T, np.eye(size), "LR")
    proved = _least_factor(T, X) <= value * (1.0 + PROOF_TOLERANCE)
    if proved or size <= MAX_DENSE_FALLBACK:
        return value, proved
    # A different search, for the largest modulus from another start, must agree.
    again, _ = _rightmost(T, X + np.diag(np.linspace(0.5, 1.5, size)) * np.trace(X), "LM")
    if not abs(again - value) <= 1e-8 * value:
        raise TheoryError(f"the radius is not certain: searches found {value:.8g} and {again:.8g}")
    return value, False


def _least_factor(T: Callable[[FloatArray], FloatArray], X: FloatArray) -> float:
    """Return the least c with T(X) <= c X, which bounds the radius; inf if X is not definite."""
    try:
        root = scipy.linalg.cholesky(X, lower=True)
    except np.linalg.LinAlgError:
        return np.inf
    half = scipy.linalg.solve_triangular(root, T(X), lower=True)
    # The largest eigenvalue of L^-1 T(X) L^-T with X = L L'.
    scaled = scipy.linalg.solve_triangular(root, half.T, lower=True)
    return float(np.linalg.eigvalsh(symmetric(scaled))[-1])


def _rightmost(
    T: Callable[[FloatArray], FloatArray], start: FloatArray, which: Literal["LR", "LM"]
) -> tuple[float, FloatArray]:
    """Return an extreme eigenvalue of T and its X (N n, N n), of positive trace."""
    size = len(start)
    operator = scipy.sparse.linalg.LinearOperator(
        (size**2, size**2),
        matvec=lambda x: T(symmetric(x.reshape(size, size))).ravel(),
        dtype=np.float64,
    )
    try:
        values, vectors = scipy.sparse.linalg.eigs(
            operator, k=1, which=which, v0=start.ravel(), ncv=KRYLOV_VECTORS, tol=1e-12, maxiter=200
        )
    except scipy.sparse.linalg.ArpackError as error:
        if size <= MAX_DENSE_FALLBACK:
            return 0.0, np.zeros((size, size))  # proves nothing
        raise TheoryError(f"the radius was not found: {error}") from None
    X = symmetric(vectors[:, 0].real.reshape(size, size))
    return float(values[0].real), X * np.sign(np.trace(X))
