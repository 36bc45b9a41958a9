"""Mean squares of the errors of the push-sum filter, exactly: P steps 4-5 at asymptotic gains.

The stacked error obeys ``e+ = (M (x) I)(diag(A_i) e + h)`` with independent M, P (25), so that its
covariance X obeys the linear, positive map ``T(X) = E[(M (x) I) diag(A_i) X diag(A_i)' (M (x) I)']``:
X+ = T(X) + T_h. Its spectral radius is an eigenvalue with a semidefinite X (Krein and Rutman).
Small systems are solved by dense eigenvalues on symmetric X, large ones by Arnoldi's method; there
an X that is positive definite proves by ``T(X) <= c X`` that the radius is at most c (Collatz).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.sparse.csgraph
import scipy.sparse.linalg

from netkf.core.arrays import FloatArray, symmetric
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory.averaging import Averaging
from netkf.theory.push_sum import EstimationSteps, averaging_law, estimation_steps

FEW = 40  # rows of X up to which the map is written out
RESIDUAL = 1e-10
SLACK = 1e-6  # relative, of the radius where an X proves it
BASIS = 24  # vectors that Arnoldi's method keeps
MOST_ROUNDS = 20


def push_sum_radius(scenario: Scenario) -> float:
    """Spectral radius of the mean-square error dynamics of P steps 4-5 at the asymptotic gains.

    Below 1 if and only if the errors stay bounded in the mean square (given a noise that drives
    every mode); that a simulation blows up needs more. Exact: through the mean Kronecker square of
    one averaging step raised to gamma, or of all gamma steps together for held links. Failures are
    independent between links, with the probabilities of the channel. Raises TheoryError where the
    links have no such law, the gains do not exist, or held links are too many to enumerate.
    """
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
    """The spectral radius of T; the largest over groups of states that do not mix."""
    return max(_radius(steps.averaging, closed) for closed in _groups(steps.closed))


def mean_radius(steps: EstimationSteps) -> float:
    """Spectral radius of the mean dynamics, P (30): below 1 the estimates become unbiased."""
    mean, worst = steps.averaging.mean, 0.0
    for closed in _groups(steps.closed):
        N, n, _ = closed.shape
        whole = np.einsum("ij,jab->iajb", mean, closed).reshape(N * n, N * n)
        worst = max(worst, float(np.abs(np.linalg.eigvals(whole)).max()))
    return worst


def _groups(closed: FloatArray) -> list[FloatArray]:
    """The A_i of each set of states that no A_i mixes with others, such as the axes of a plane.

    The cross covariance of two groups grows no faster than the geometric mean of their own.
    """
    size = np.abs(closed).max(axis=0)
    linked = size > 1e-14 * size.max()
    _, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    return [closed[np.ix_(range(len(closed)), g, g)] for g in map(np.flatnonzero, _sets(label))]


def _sets(label: np.ndarray) -> list[np.ndarray]:
    return [label == k for k in range(label.max() + 1)]


def _radius(law: Averaging, closed: FloatArray) -> float:
    if closed.shape[0] * closed.shape[1] <= FEW:
        return float(np.abs(np.linalg.eigvals(_written_out(law, closed))).max())
    return _arnoldi(law, closed)


def _written_out(law: Averaging, closed: FloatArray) -> FloatArray:
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


def _mapping(law: Averaging, closed: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """T on symmetric (N n, N n) matrices."""
    N, n, _ = closed.shape

    def left(X: FloatArray) -> FloatArray:
        return np.asarray(closed @ X.reshape(N, n, N * n)).reshape(X.shape)

    return lambda X: symmetric(law.second_moment(left(left(X).T)))


def _arnoldi(law: Averaging, closed: FloatArray) -> float:
    """The rightmost eigenvalue, which is the radius because T is positive.

    The start, an identity, has a part in the wanted direction for certain. An X that is positive
    definite beyond the residual proves the value; else a second search must find it again.
    """
    size = closed.shape[0] * closed.shape[1]
    T = _mapping(law, closed)
    value, X = _rightmost(T, np.eye(size), "LR")
    spectrum = np.linalg.eigvalsh(X)
    rest = float(np.linalg.norm(T(X) - value * X, 2))
    if not rest <= RESIDUAL * value * spectrum[-1] or spectrum[0] < -1e-8 * spectrum[-1]:
        raise TheoryError(f"the radius is near {value:.6g}, found with a residual of {rest:.1e} only")
    if rest <= SLACK * value * spectrum[0]:
        return value
    again, _ = _rightmost(T, X + np.diag(np.linspace(0.5, 1.5, size)) * spectrum[-1], "LM")
    if not abs(again - value) <= 1e-8 * value:
        raise TheoryError(f"two searches found different radii, {value:.8g} and {again:.8g}")
    return value


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
            operator, k=1, which=which, v0=start.ravel(), ncv=BASIS, tol=1e-13
        )
    except scipy.sparse.linalg.ArpackNoConvergence as error:
        raise TheoryError(f"the radius was not found: {error}") from None
    X = symmetric(vectors[:, 0].real.reshape(size, size))
    return float(values[0].real), X * np.sign(np.trace(X))


def push_sum_error_covariance(scenario: Scenario) -> FloatArray:
    """(N, n, n): exact steady covariance of x - xhat at every node, in the order of the nodes.

    Of P steps 4-5 at the asymptotic gains, over noises and links. The filters' Q and R may differ
    from the truth. Raises TheoryError where ``push_sum_radius`` is not below 1 or does not exist.
    """
    steps = estimation_steps(scenario)
    found = radius(steps)
    if not found < 1.0:
        raise TheoryError(
            f"no steady error covariance: the mean-square radius is {found:.6g}, not below 1; "
            "raise gamma or the delivery probability"
        )
    N, n, _ = steps.closed.shape
    scale = np.sqrt(np.diagonal(steps.limits.P)).clip(1e-150)
    closed = steps.closed * (scale / scale[:, None])
    every = np.tile(scale, N)
    noise = symmetric(steps.averaging.second_moment(steps.noise / np.outer(every, every)))
    X = _fixed_point(steps.averaging, closed, noise)
    each = np.arange(N)
    blocks = X.reshape(N, n, N, n)[each, :, each]
    return symmetric(blocks * np.outer(scale, scale))


def _fixed_point(law: Averaging, closed: FloatArray, noise: FloatArray) -> FloatArray:
    """X = T(X) + noise, with a residual that is small beside the variances of its row and column."""
    T, X = _mapping(law, closed), noise
    if len(noise) <= FEW:
        rows, columns = np.triu_indices(len(noise))
        matrix = np.eye(len(rows)) - _written_out(law, closed)
        X = np.zeros_like(noise)
        X[rows, columns] = X[columns, rows] = np.linalg.solve(matrix, noise[rows, columns])
    for _ in range(MOST_ROUNDS):
        rest = noise + T(X) - X
        variances = np.sqrt(np.abs(np.diagonal(X)))
        if (np.abs(rest) <= RESIDUAL * np.outer(variances, variances)).all():
            return X
        X = X + _krylov(T, rest)
    raise TheoryError(f"the steady covariance was solved to {np.abs(rest).max():.1e} only")


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
