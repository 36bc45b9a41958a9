"""Mean squares of the errors of the push-sum filter, exactly: P steps 4-5 at asymptotic gains.

The stacked error obeys ``e+ = (M (x) I)(A e + h)``, A = diag(A_i), with independent M, P (25); its
covariance ``X+ = T(X) + E[(M (x) I) cov(h) (M (x) I)']`` with the linear, positive map
``T(X) = E[(M (x) I) A X A' (M (x) I)']``. The radius of T is an eigenvalue with a semidefinite X
(Krein and Rutman): the rightmost one, which Arnoldi's method finds and a positive definite X proves
(Collatz and Wielandt); where X proves nothing, small systems are solved by dense eigenvalues.
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

TINY, FEW = 10, 40  # rows of X up to which T is written out at once, or where nothing else helps
SLACK = 1e-6  # relative, of the radius where an X proves it
BASIS = 24  # vectors that Arnoldi's method keeps
MAX_ROWS = 500  # of X; with twice as many rows a step takes four times the work and memory
DENSE_ROWS = 300  # of the mean dynamics up to which all eigenvalues are computed
MEAN_BASIS, MEAN_RESTARTS = 40, 60


def push_sum_radius(scenario: Scenario) -> float:
    """Spectral radius of the mean-square error dynamics of P steps 4-5 at the asymptotic gains.

    Below 1 if and only if the errors stay bounded in the mean square (given a noise that drives
    every mode); that a simulation blows up needs more. Exact: through the mean Kronecker square of
    one averaging step raised to gamma, or of all gamma steps together for held links. Failures are
    independent between links, with the probabilities of the channel. Raises TheoryError where the
    links have no such law, the gains do not exist, or held links are too many to enumerate.
    """
    return _radius_of(scenario)


@lru_cache(maxsize=8)
def _radius_of(scenario: Scenario) -> float:
    """Kept, because assumptions, promises and the error covariance ask for it one by one."""
    return radius(estimation_steps(scenario))


def push_sum_stability(
    scenario: Scenario, gammas: Sequence[int], deliveries: Sequence[float]
) -> FloatArray:
    """(len(gammas), len(deliveries)) of ``push_sum_radius``: the stability map."""
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
    """The spectral radius of T; the largest over groups of states that do not mix. Raises
    TheoryError for networks with more than MAX_ROWS states in a group.
    """
    return max(_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def mean_radius(steps: EstimationSteps) -> float:
    """Spectral radius of the mean dynamics, P (30): below 1 the estimates become unbiased."""
    return max(_mean_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def _mean_radius(law: Averaging, closed: FloatArray) -> float:
    N, n, _ = closed.shape
    if N * n > DENSE_ROWS and not law.enumerated:
        return _iterated_mean_radius(law, closed)
    whole = np.einsum("ij,jab->iajb", law.mean, closed).reshape(N * n, N * n)
    return float(np.abs(np.linalg.eigvals(whole)).max())


def _iterated_mean_radius(law: Averaging, closed: FloatArray) -> float:
    """By Arnoldi's method with sparse averaging steps, for large networks."""
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
            k=2,
            which="LM",
            v0=np.linspace(1.0, 2.0, N * n),
            ncv=MEAN_BASIS,
            tol=1e-9,
            maxiter=MEAN_RESTARTS,
            return_eigenvectors=False,
        )
    except scipy.sparse.linalg.ArpackError as error:
        raise TheoryError(f"the radius of the mean was not found: {error}") from None
    return float(np.abs(values).max())


def _groups(closed: FloatArray) -> list[FloatArray]:
    """The A_i of each set of states that no A_i mixes with others, such as the axes of a plane.

    The cross covariance of two groups grows no faster than the geometric mean of their own.
    """
    size = np.abs(closed).max(axis=0)
    linked = size > 1e-13 * size.max()
    _, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    return [closed[:, group[:, None], group] for group in groups]


def _radius(law: Averaging, closed: FloatArray) -> float:
    if law.certain:  # no spread, so that T moves the mean's outer products
        return _mean_radius(law, closed) ** 2
    size = closed.shape[0] * closed.shape[1]
    if size > MAX_ROWS:
        raise TheoryError(
            f"mean squares of {size:,} errors that mix are {size:,}^2 numbers; they are computed "
            f"for at most {MAX_ROWS} errors, so take a smaller network"
        )
    if size > TINY:
        value, proved = _arnoldi(law, closed)
        if proved or size > FEW:
            return value
    return float(np.abs(np.linalg.eigvals(written_out(law, closed))).max())


def written_out(law: Averaging, closed: FloatArray) -> FloatArray:
    """T as a matrix on the upper triangles of symmetric X."""
    N, n, _ = closed.shape
    kron = law.kron.reshape(N, N, N, N)
    rows, columns = np.triu_indices(N * n)
    (i, a), (j, b) = np.divmod(rows, n), np.divmod(columns, n)
    # entry ((i,a),(j,b)) from ((k,c),(l,d)) is kron[i,j,k,l] A_k[a,c] A_l[b,d]
    to_i, to_a, to_j, to_b = (x[:, None] for x in (i, a, j, b))
    straight = kron[to_i, to_j, i, j] * closed[i, to_a, a] * closed[j, to_b, b]
    mirrored = kron[to_i, to_j, j, i] * closed[j, to_a, b] * closed[i, to_b, a]
    return np.asarray(straight + np.where(rows == columns, 0.0, mirrored))


def mapping(law: Averaging, closed: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """T on symmetric (N n, N n) matrices."""
    N, n, _ = closed.shape

    def left(X: FloatArray) -> FloatArray:
        return np.asarray(closed @ X.reshape(N, n, N * n)).reshape(X.shape)

    return lambda X: symmetric(law.second_moment(left(left(X).T)))


def _arnoldi(law: Averaging, closed: FloatArray) -> tuple[float, bool]:
    """The rightmost eigenvalue, which is the radius because T is positive, and whether its X is
    positive definite beyond the residual, which proves it.

    The start, an identity, has a part in the wanted direction for certain. Where nothing is proved
    of a large system, a second search from elsewhere must find the value again.
    """
    size = closed.shape[0] * closed.shape[1]
    T = mapping(law, closed)
    value, X = _rightmost(T, np.eye(size), "LR")
    proved = _least_factor(T, X) <= value * (1.0 + SLACK)
    if proved or size <= FEW:
        return value, proved
    again, _ = _rightmost(T, X + np.diag(np.linspace(0.5, 1.5, size)) * np.trace(X), "LM")
    if not abs(again - value) <= 1e-8 * value:
        raise TheoryError(f"the radius is not certain: searches found {value:.8g} and {again:.8g}")
    return value, False


def _least_factor(T: Callable[[FloatArray], FloatArray], X: FloatArray) -> float:
    """The least c with T(X) <= c X, which bounds the radius; inf where X is not definite."""
    try:
        root = scipy.linalg.cholesky(X, lower=True)
    except np.linalg.LinAlgError:
        return np.inf
    half = scipy.linalg.solve_triangular(root, T(X), lower=True)
    whole = scipy.linalg.solve_triangular(root, half.T, lower=True)
    return float(np.linalg.eigvalsh(symmetric(whole))[-1])


def _rightmost(
    T: Callable[[FloatArray], FloatArray], start: FloatArray, which: Literal["LR", "LM"]
) -> tuple[float, FloatArray]:
    """An extreme eigenvalue of T and its X, of positive trace."""
    size = len(start)
    operator = scipy.sparse.linalg.LinearOperator(
        (size**2, size**2),
        matvec=lambda x: T(symmetric(x.reshape(size, size))).ravel(),
        dtype=np.float64,
    )
    try:
        values, vectors = scipy.sparse.linalg.eigs(
            operator, k=1, which=which, v0=start.ravel(), ncv=BASIS, tol=1e-12, maxiter=200
        )
    except scipy.sparse.linalg.ArpackError as error:
        if size <= FEW:
            return 0.0, np.zeros((size, size))  # proves nothing
        raise TheoryError(f"the radius was not found: {error}") from None
    X = symmetric(vectors[:, 0].real.reshape(size, size))
    return float(values[0].real), X * np.sign(np.trace(X))
