"""Averages of the random Riccati equation: over one path, and bounds on the mean over all paths.

P is the one-step prediction covariance of the Kalman filter with intermittent observations. In each
slot a reading arrives with the probability ``delivery``; without one ``P+ = F P F' + Q``. R (140)
and the like are equations of the paper R (theory/intermittent/riccati.py); R alone is a matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.chains import reading_modes, trace_paths
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray, square_root, symmetric
from netkf.rng.streams import Streams
from netkf.theory.intermittent.riccati import (
    SlotSystem,
    check_delivery,
    check_system,
    covariance_root,
    lyapunov_step,
    riccati_step,
    steady_covariance,
)
from netkf.theory.numerics.matrices import as_covariance, as_integer

BATCHES = 50  # parts of a path (batch means), whose averages are nearly independent
MAX_ENTRIES = 2_000_000  # entries of the covariances in memory at once


class PathAverage(NamedTuple):
    """The average of a function of P over the slots of one path.

    mean  : of the function
    error : standard error of ``mean``, from the averages of 50 successive parts of the path
    slots : length of the path
    """

    mean: float
    error: float
    slots: int


def path_average(
    function: Callable[[FloatArray], ArrayLike],
    F: ArrayLike,
    Q: ArrayLike,
    H: ArrayLike,
    R: ArrayLike,
    delivery: float,
    slots: int,
    seed: int,
    start: ArrayLike | None = None,
) -> PathAverage:
    """Return the average of ``function`` of P, the one-step prediction covariance, over ``slots``
    slots of one simulated path, paper R (140).

    F and Q are (n, n), H (p, n), R (p, p); readings arrive with probability ``delivery``, drawn
    with ``seed``. By paper R Proposition 25 the average converges to the integral of the function
    over the invariant law, for almost every start by that law; the paper recommends a point of its
    support. ``start`` (n, n) is P_0, by default P*, the steady covariance if all readings arrive.
    ``function`` maps covariances (K, n, n) to K numbers. It must be integrable: below the critical
    probability the average of P itself diverges, and the standard error says nothing then. Raises
    TheoryError for wrong arguments or if P* does not exist.
    """
    system, g = check_system(F, Q, H, R), check_delivery(delivery)
    slots, seed = as_integer("slots", slots, BATCHES), as_integer("seed", seed, 0, np.inf)
    n = len(system.F)
    P = steady_covariance(*system) if start is None else as_covariance("start", start, n)
    arrived = Streams(seed).generator("arrivals").random(slots) < g
    values = np.concatenate(list(_evaluate(function, system, covariance_root(P), arrived)))
    batch_means = [float(part.mean()) for part in np.array_split(values, BATCHES)]
    error = float(np.std(batch_means, ddof=1)) / float(np.sqrt(BATCHES))
    return PathAverage(float(values.mean()), error, slots)


def _evaluate(
    f: Callable[[FloatArray], ArrayLike], system: SlotSystem, root: FloatArray, arrived: np.ndarray
) -> list[FloatArray]:
    """Return values of ``f`` at P_0, P_1, ..., in pieces (K,) of limited size."""
    F, Q, H, R = system
    modes, root_Q = reading_modes([(H[:0], R[:0, :0]), (H, R)], len(F)), square_root(Q)
    piece, values_of_pieces = max(1, MAX_ENTRIES // len(F) ** 2), []
    for first in range(0, len(arrived), piece):
        word = arrived[first : first + piece].astype(np.uint8)
        roots = next(trace_paths(root[None], word[None], F, root_Q, modes))
        # R (140) averages over P_0 .. P_{t-1}: each covariance before its own slot.
        roots_before = np.concatenate([root[None], roots[:-1]])
        P, root = roots_before @ np.swapaxes(roots_before, 1, 2), roots[-1]
        values = np.asarray(f(P), dtype=np.float64)
        if values.shape != (len(P),):
            raise TheoryError(
                f"the function must give one number per covariance, not {values.shape}"
            )
        values_of_pieces.append(values)
    return values_of_pieces


class MeanBounds(NamedTuple):
    """Bounds lower <= E[P_t] <= upper, (slots + 1, n, n) each, for t = 0 .. slots."""

    lower: FloatArray
    upper: FloatArray


def mean_covariance_bounds(
    F: ArrayLike,
    Q: ArrayLike,
    H: ArrayLike,
    R: ArrayLike,
    delivery: float,
    slots: int,
    start: ArrayLike,
) -> MeanBounds:
    """Return bounds on the mean of the one-step prediction covariance P_t for t = 0 .. ``slots``,
    from P_0 = ``start`` (n, n) on.

    F and Q are (n, n), H (p, n), R (p, p); readings arrive with probability g = ``delivery``. A
    slot maps P to ``f_0(P) = F P F' + Q`` without a reading, and to ``f_1(P)``, the step of the
    Riccati equation, with one.

    The lower bound S counts slots without a reading only, ``S+ = (1 - g) F S F' + Q``; the upper
    one X applies Jensen's inequality to the concave f_1, ``X+ = (1 - g) f_0(X) + g f_1(X)``. The
    lower one grows without bound if (1 - g) alpha^2 >= 1 for the largest modulus alpha of the
    eigenvalues of F, as equations 29 and 31 of the paper on intermittent observations say. The
    upper one stays bounded for g above that paper's upper bound, equation 32, on the critical
    probability. Raises TheoryError for wrong arguments.
    """
    system, g = check_system(F, Q, H, R), check_delivery(delivery)
    first = as_covariance("start", start, len(system.F))
    lower, upper = [first], [first]
    for _ in range(as_integer("slots", slots, 0)):
        S, X = lower[-1], upper[-1]
        lower.append(symmetric((1.0 - g) * system.F @ S @ system.F.T + system.Q))
        arrived, lost = riccati_step(X, *system), lyapunov_step(X, system.F, system.Q)
        upper.append(symmetric((1.0 - g) * lost + g * arrived))
    return MeanBounds(np.array(lower), np.array(upper))
