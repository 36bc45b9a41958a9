"""Exact mean squares of the errors of the push-sum filter: paper P steps 4-5 at asymptotic gains,
and their limits for gamma to infinity, paper P Lemma 4 and Theorem 4.

The stacked error obeys ``e+ = (M (x) I)(A e + h)``, A = diag(A_i), with independent M,
paper P (25); its covariance ``X+ = T(X) + E[(M (x) I) cov(h) (M (x) I)']`` with the linear,
positive map ``T(X) = E[(M (x) I) A X A' (M (x) I)']`` (theory/numerics/positive_maps.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.spectra import contracts, growth_factor
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.matrices import as_list
from netkf.theory.numerics.positive_maps import PositiveMap, fixed_point, spectral_radius
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.estimation_steps import EstimationSteps, averaging_law, estimation_steps
from netkf.theory.push_sum.limits import consensus_gain_bound

MAX_ROWS = 500  # of X; twice as many rows take four times the work and memory
DENSE_ROWS = 300  # of the mean dynamics; up to these all eigenvalues are computed
# Arnoldi's method for the mean, whose vectors are small, unlike those of second moments.
MEAN_KRYLOV_VECTORS, MEAN_RESTARTS = 40, 60


def push_sum_radius(scenario: Scenario) -> float:
    """Return the spectral radius of the mean-square error dynamics, paper P steps 4-5.

    At the asymptotic gains. Below 1 if and only if the errors stay bounded in the mean square (for
    a noise that drives every mode); single paths may stay bounded above 1. Exact: from the mean
    Kronecker square of one averaging step raised to gamma, or of all gamma steps together for held
    links. Links fail independently, with the probabilities of the channel. Raises TheoryError if
    the links have no such law, the gains do not exist, or the network is too large.
    """
    return _cached_radius(scenario)


@lru_cache(maxsize=8)
def _cached_radius(scenario: Scenario) -> float:
    return radius(estimation_steps(scenario))


def push_sum_stability(
    scenario: Scenario, gammas: Sequence[int], deliveries: Sequence[float]
) -> FloatArray:
    """Return ``push_sum_radius`` (G, D) for each of G ``gammas`` and D ``deliveries``,
    probabilities that all links have; the stability map.
    """
    steps = estimation_steps(scenario, averaging_law(scenario, 1.0))
    gammas, deliveries = as_list("gammas", gammas), as_list("deliveries", deliveries)
    radii = np.empty((len(gammas), len(deliveries)))
    for column, delivery in enumerate(deliveries):
        law = averaging_law(scenario, delivery)
        for row, gamma in enumerate(gammas):
            radii[row, column] = radius(replace(steps, averaging=law).with_gamma(gamma))
    return radii


def radius(steps: EstimationSteps) -> float:
    """Return the largest radius of second moments over groups of states; TheoryError if large."""
    return max(_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def mean_radius(steps: EstimationSteps) -> float:
    """Return the radius of mean errors, paper P (30): unbiased in the end if below 1."""
    return max(_mean_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def _mean_radius(law: Averaging, closed: FloatArray) -> float:
    """Return the radius of the mean errors, per slot, with loops ``closed`` (N, n, n)."""
    N, n, _ = closed.shape
    if N * n > DENSE_ROWS and not law.enumerated:
        return _mean_radius_by_arnoldi(law, closed)
    # (E[M^gamma] (x) I) diag(A_j)
    mean_map = np.einsum("ij,jab->iajb", law.mean, closed).reshape(N * n, N * n)
    return growth_factor(mean_map)


def _mean_radius_by_arnoldi(law: Averaging, closed: FloatArray) -> float:
    """Return the same for large networks by Arnoldi's method; raises TheoryError."""
    N, n, _ = closed.shape

    def step(e: FloatArray) -> FloatArray:
        """Return the mean errors (N n,) of all nodes one slot after ``e`` (N n,)."""
        errors = (closed @ e.reshape(N, n, 1))[:, :, 0]
        for _ in range(law.gamma):
            errors = law.mean_step @ errors
        return np.asarray(errors.ravel())

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
    """Return the closed loops (N, k, k) of each group of states that no loop mixes with others."""
    # The cross covariance of two groups grows no faster than the geometric mean of their own.
    size = np.abs(closed).max(axis=0)
    # Two states mix if some A_i has an entry between them.
    linked = size > 1e-13 * size.max()
    _, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    return [closed[:, group[:, None], group] for group in groups]


def _radius(law: Averaging, closed: FloatArray) -> float:
    if law.deterministic:  # M is fixed, so that T is the square of the mean dynamics
        return _mean_radius(law, closed) ** 2
    size = closed.shape[0] * closed.shape[1]
    if size > MAX_ROWS:
        raise TheoryError(
            f"mean squares of {size:,} errors that mix are {size:,}^2 numbers; they are computed "
            f"for at most {MAX_ROWS} errors, so take a smaller network"
        )
    return spectral_radius(second_moment_map(law, closed), (1, size, size))


def second_moment_map(law: Averaging, closed: FloatArray) -> PositiveMap:
    """Return ``T(X) = E[M diag(A_j) X diag(A_j)' M']`` of (1, N n, N n), loops ``closed``."""
    N, n, _ = closed.shape

    def left(X: FloatArray) -> FloatArray:
        """Return the product diag(A_j) X (N n, N n) with X (N n, N n), of block diagonal A_j."""
        return np.asarray(closed @ X.reshape(N, n, N * n)).reshape(X.shape)

    return lambda X: symmetric(law.second_moment(left(left(X[0]).T)))[None]


def push_sum_error_covariance(scenario: Scenario) -> FloatArray:
    """Return the exact steady covariance (N, n, n) of x - xhat, in the order of the nodes.

    The mean is over noises and links, for paper P steps 4-5 at the asymptotic gains. The filter's
    gains converge to these if links fail in both directions together and no gain is frozen early (P
    Theorem 2). The filters' Q and R may differ from the truth. Raises TheoryError if
    ``push_sum_radius`` is not below 1 or does not exist.
    """
    return _covariance(estimation_steps(scenario), push_sum_radius(scenario))


def _covariance(steps: EstimationSteps, value: float) -> FloatArray:
    """Return the steady covariance (N, n, n); raises TheoryError unless ``value`` is below 1."""
    if not contracts(value):
        raise TheoryError(
            f"no steady error covariance: the mean-square radius is {value:.6g}, not below 1; "
            "raise gamma or the delivery probability"
        )
    N, n, _ = steps.closed.shape
    scale = steps.scale
    scales = np.tile(scale, N)
    # States in units of P_inf's deviations; then the stacked second moments X of all nodes solve
    # X = T(X) + E[(M (x) I) cov(h) (M (x) I)'] with M the averaging and h the noises of a slot.
    noise = symmetric(steps.averaging.second_moment(steps.noise / np.outer(scales, scales)))
    X = fixed_point(second_moment_map(steps.averaging, steps.scaled), noise[None], value)[0]
    nodes = np.arange(N)
    blocks = X.reshape(N, n, N, n)[nodes, :, nodes]
    return symmetric(blocks * np.outer(scale, scale))


class LargeGamma(NamedTuple):
    """Limits for gamma to infinity: nodes average until they agree in every slot.

    noise      : (N n, N n) covariance of the transformed noise, P Lemma 4: zero but for the first
                 block, that of the direction in which all nodes agree
    covariance : (n, n) of the steady error of every node, P Theorem 4: P_inf of the central filter
                 if the filters know the plant and the sensors
    """

    noise: FloatArray
    covariance: FloatArray


def large_gamma_limits(scenario: Scenario) -> LargeGamma:
    """Return the limits for ever more averaging steps in a slot (gamma to infinity): the covariance
    (N n, N n) of the noise that averaging leaves, paper P Lemma 4, and that of the steady errors
    (n, n), which is the same at all nodes, paper P Theorem 4.

    The scenario's own gamma is ignored. Raises TheoryError where they do not hold: a graph that is
    not connected, links that are held over the steps or fail in one direction, a delta at or below
    half of rho(L).
    """
    steps = estimation_steps(scenario)
    _require_averaging(scenario, steps)
    N, n, _ = steps.closed.shape
    # v' (x) I of the noise at all nodes, v = (1, .., 1) / sqrt(N): the rest is averaged away.
    block = steps.noise.reshape(N, n, N, n).sum(axis=(0, 2)) / N
    noise = np.zeros((N * n, N * n))
    noise[:n, :n] = symmetric(block)
    # X = A_C X A_C' + noise, with A_C the mean closed loop, in units of P_inf's deviations.
    covariance = np.outer(steps.scale, steps.scale)
    X = scipy.linalg.solve_discrete_lyapunov(steps.scaled.mean(axis=0), block / N / covariance)
    return LargeGamma(noise, symmetric(np.asarray(X)) * covariance)


def push_sum_noise(scenario: Scenario, gammas: Sequence[int]) -> FloatArray:
    """Return the exact covariance (len(gammas), N n, N n) of the transformed noise of paper P (29).

    ``(T' (x) I) E[(M (x) I) cov(h) (M (x) I)'] (T (x) I)``, where (x) is the Kronecker product, M
    (N, N) the random product of gamma averaging steps, h (N n,) the stacked noises of the plant and
    the sensors, and ``T = (v W)`` of paper P (75) with v = (1, .., 1) / sqrt(N) and W any
    orthonormal complement. Paper P Lemma 4 says what it tends to. Raises TheoryError as
    ``large_gamma_limits`` does.
    """
    steps = estimation_steps(scenario)
    _require_averaging(scenario, steps)
    N, n, _ = steps.closed.shape
    # The orthogonal factor of (v, e_1, ..): its first column is v up to a sign.
    T = np.linalg.qr(np.column_stack([np.ones(N), np.eye(N)[:, : N - 1]]))[0]
    transform = np.kron(T * np.sign(T[0, 0]), np.eye(n))
    covariances = []
    for gamma in as_list("gammas", gammas):
        moment = steps.with_gamma(gamma).averaging.second_moment(steps.noise)
        covariances.append(symmetric(transform.T @ moment @ transform))
    return np.array(covariances)


def push_sum_covariances(scenario: Scenario, gammas: Sequence[int]) -> FloatArray:
    """Return the exact steady error covariances (G, N, n, n) of all nodes for each of G ``gammas``.

    Gamma is the number of averaging steps in a slot. The gains are those that the filters reach
    after a long time; nan where the errors of a gamma grow without limit in mean square. With
    gamma they tend to P_inf, the covariance of the central filter (push-sum paper, Theorem 4).
    Raises TheoryError if such gains do not exist or the links are not drawn independently.
    """
    steps = estimation_steps(scenario)
    N, n, _ = steps.closed.shape
    cases = [steps.with_gamma(gamma) for gamma in as_list("gammas", gammas)]
    covariances = np.full((len(cases), N, n, n), np.nan)
    for k, moved in enumerate(cases):
        try:
            covariances[k] = _covariance(moved, radius(moved))
        except TheoryError:
            continue
    return covariances


def _require_averaging(scenario: Scenario, steps: EstimationSteps) -> None:
    law = steps.averaging
    if law.held and not law.deterministic:
        raise TheoryError('P Theorem 4 needs links = "fresh": a draw that is held cuts the network')
    if not np.array_equal(law.hears.min(axis=1), law.both):
        raise TheoryError("P Theorem 4 needs failures of both directions together")
    if law.nodes > 1 and not law.both.min(initial=1.0) > 0.0:
        raise TheoryError("P Theorem 4 needs links that are up with a positive probability")
    half = 0.5 * consensus_gain_bound(scenario).radius
    if not law.delta > half:
        raise TheoryError(f"averaging diverges: delta must be above rho(L)/2 = {half:.6g}")
