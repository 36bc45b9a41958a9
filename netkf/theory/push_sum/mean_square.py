"""Exact mean squares of the errors of the push-sum filter: paper P steps 4-5 at asymptotic gains.

The stacked error obeys ``e+ = (M (x) I)(A e + h)``, A = diag(A_i), with independent M,
paper P (25); its covariance ``X+ = T(X) + E[(M (x) I) cov(h) (M (x) I)']`` with the linear,
positive map ``T(X) = E[(M (x) I) A X A' (M (x) I)']`` (theory/numerics/positive_maps.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import scipy.sparse.csgraph
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.spectra import growth_factor
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.positive_maps import PositiveMap, spectral_radius
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.estimation_steps import EstimationSteps, averaging_law, estimation_steps

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
    radii = np.empty((len(gammas), len(deliveries)))
    for column, delivery in enumerate(deliveries):
        law = averaging_law(scenario, delivery)
        for row, gamma in enumerate(gammas):
            if int(gamma) != gamma or gamma < 1:
                raise TheoryError(f"gamma must be a positive integer, got {gamma!r}")
            radii[row, column] = radius(replace(steps, averaging=replace(law, gamma=int(gamma))))
    return radii


def radius(steps: EstimationSteps) -> float:
    """Return the spectral radius of the map of second moments over a slot, the largest over groups
    of states that do not mix. Raises TheoryError for more than MAX_ROWS states in a group.
    """
    return max(_radius(steps.averaging, closed) for closed in _groups(steps.scaled))


def mean_radius(steps: EstimationSteps) -> float:
    """Return the spectral radius of the mean errors' dynamics, paper P (30): if it is below 1,
    estimates become unbiased.
    """
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
    """Return the mean-square radius for one group of n states; raises TheoryError."""
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
    """Return the map ``T(X) = E[M diag(A_j) X diag(A_j)' M']`` of stacks (1, N n, N n) of symmetric
    matrices: one slot of filters with the closed loops A_j, ``closed`` (N, n, n), and averaging M.
    """
    N, n, _ = closed.shape

    def left(X: FloatArray) -> FloatArray:
        """Return the product diag(A_j) X (N n, N n) with X (N n, N n), of block diagonal A_j."""
        return np.asarray(closed @ X.reshape(N, n, N * n)).reshape(X.shape)

    return lambda X: symmetric(law.second_moment(left(left(X[0]).T)))[None]
