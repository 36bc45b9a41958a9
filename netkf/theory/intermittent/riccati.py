"""Intermittent observations: the random Riccati equation P_{t+1} = f_gamma(P_t) of R.

In a slot without a reading ``f_0(P) = F P F' + Q``, with one ``f_1``, paper R (15)-(18). P is the
one-step prediction covariance, ``delivery`` the probability that a reading arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from netkf.algorithms.kernels.chains import move_roots, reading_modes
from netkf.algorithms.kernels.riccati import change_units, state_units
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray, square_root, symmetric
from netkf.linalg.spectra import FACTOR, eigenvalues, growth_factor, hidden_mode
from netkf.rng.streams import Streams
from netkf.theory.numerics.matrices import (
    RESIDUAL,
    as_covariance,
    as_integer,
    as_number,
    as_numbers,
    as_square,
)

MAX_DEPTH = 22  # of the tree of compositions: 4 million covariances
MAX_POLICIES = 40  # policy iterations at one value of s
COALESCENCE_TOLERANCE = 1e-9  # relative difference of coupled chains that have met
FIRST_PAST, MAX_PAST = 32, 100_000  # slots
MAX_SAMPLES_AT_ONCE = 20_000  # bounds the memory of the arrays


class SlotSystem(NamedTuple):
    """Checked F (n, n), Q (n, n), H (p, n), R (p, p)."""

    F: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray


def check_system(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike) -> SlotSystem:
    """Return F, Q (n, n), H (p, n), R (p, p); raises TheoryError for wrong shapes or signs."""
    F_ = as_square("F", F)
    n = len(F_)
    H_ = _check_observation(H, n)
    R_ = as_covariance("R", R, len(H_))
    # R (17) inverts H P H' + R also where P is singular.
    if len(R_) and not np.linalg.eigvalsh(R_)[0] > 0.0:
        raise TheoryError("R must be positive definite")
    return SlotSystem(F_, as_covariance("Q", Q, n), H_, R_)


def _check_observation(H: ArrayLike, n: int) -> FloatArray:
    """Return H as a finite array (p, n); raises TheoryError otherwise."""
    array = as_numbers("H", H)
    if array.ndim != 2 or array.shape[1] != n or not np.isfinite(array).all():
        raise TheoryError(f"H must be a finite matrix of {n} columns, its shape is {array.shape}")
    return array


def check_delivery(delivery: float) -> float:
    """Return the delivery probability; raises TheoryError unless it lies in (0, 1]."""
    delivery = as_number("delivery", delivery)
    if not 0.0 < delivery <= 1.0:
        raise TheoryError(f"delivery must lie in (0, 1], got {delivery!r}")
    return delivery


def lyapunov_step(P: ArrayLike, F: ArrayLike, Q: ArrayLike) -> FloatArray:
    """Return ``f_0(P) = F P F' + Q`` (n, n), paper R (16), for P, F and Q (n, n): a slot without a
    reading.

    Raises TheoryError if shapes or definiteness are wrong.
    """
    transition = as_square("F", F)
    n = len(transition)
    return symmetric(
        transition @ as_covariance("P", P, n) @ transition.T + as_covariance("Q", Q, n)
    )


def riccati_step(
    P: ArrayLike, F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike
) -> FloatArray:
    """Return ``f_1(P) = F P F' + Q - F P H' (H P H' + R)^-1 H P F'`` (n, n), paper R (17).

    A slot with a reading; P, F and Q are (n, n), H (p, n), R (p, p). Computed from square roots by
    an orthogonal triangularisation, which subtracts nothing. Raises TheoryError if shapes or
    definiteness are wrong.
    """
    system = check_system(F, Q, H, R)
    start = as_covariance("P", P, len(system.F))
    modes = reading_modes([(system.H, system.R)], len(start))
    first = np.zeros((1, 1), dtype=np.uint8)
    root = move_roots(covariance_root(start)[None], first, system.F, square_root(system.Q), modes)[
        0
    ]
    return symmetric(root @ root.T)


def covariance_root(P: FloatArray) -> FloatArray:
    """Return a root (n, n) of a covariance P, lower triangular if it is positive definite."""
    try:
        return np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    except np.linalg.LinAlgError:  # semidefinite: a root from eigenvalues
        return square_root(P)


def steady_covariance(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike) -> FloatArray:
    """Return P* (n, n), the steady one-step prediction covariance with a reading in every slot: the
    stabilising fixed point of the Riccati step f_1, for F and Q (n, n), H (p, n), R (p, p).

    Raises TheoryError if (F, H) is not detectable, with the mode, and if the computed P* fails the
    check of its residual or does not stabilise the filter.
    """
    F, Q, H, R = check_system(F, Q, H, R)
    hidden = undetectable_slot_mode(F, H)
    if hidden is not None:
        raise TheoryError(f"(F, H) is not detectable: the mode with eigenvalue {hidden:.6g}")
    units = state_units(F, Q, H.T @ np.linalg.solve(R, H))
    P = _stabilising(*change_units(units, F, Q, H), R)
    return np.asarray(P * units * units[:, None])


def _stabilising(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """Return ``steady_covariance`` of a detectable plant in balanced units of states."""
    try:
        P = np.zeros_like(F)
        # Else the step below solves the equation, where P* may be 0 and rounding all of P.
        if len(H) and (Q.any() or not growth_factor(F) < 1.0):
            P = symmetric(np.asarray(scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)))
        # One step of Newton's method (Hewer) removes the rounding error of the solver:
        # P+ = (F - K H) P+ (F - K H)' + Q + K R K'.
        K = _optimal_gain(P, F, H, R)
        if not growth_factor(F - K @ H) < 1.0:
            # The equation of that step is singular then.
            raise TheoryError("the fixed point found does not stabilise the filter")
        P = symmetric(np.asarray(scipy.linalg.solve_discrete_lyapunov(F - K @ H, Q + K @ R @ K.T)))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise TheoryError(f"no stabilising fixed point of f_1: {error}") from None
    # The solver does not report inaccuracy: check that P is a fixed point and stabilises.
    residual = np.abs(riccati_step(P, F, Q, H, R) - P).max()
    if not residual <= RESIDUAL * np.abs(P).max():
        raise TheoryError(f"P* was solved to {residual:.1e} only")
    if not growth_factor(F - _optimal_gain(P, F, H, R) @ H) < 1.0:
        raise TheoryError("the fixed point found does not stabilise the filter")
    return P


def steady_gain(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """Return the gain (n, p) of readings at P*. Raises TheoryError if P* does not exist."""
    if not len(H):
        return np.zeros((len(F), 0))
    P = steady_covariance(F, Q, H, R)
    return np.asarray(np.linalg.solve(H @ P @ H.T + R, H @ P).T)


def filtered_covariance(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """Return the steady covariance (n, n) after a reading, P (12); TheoryError without P*."""
    P = steady_covariance(F, Q, H, R)
    information = H.T @ np.linalg.solve(R, H)
    # (P^-1 + G)^-1 = (I + P G)^-1 P, which needs no inverse of P.
    return symmetric(np.asarray(np.linalg.solve(np.eye(len(P)) + P @ information, P)))


def _optimal_gain(P: FloatArray, F: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """Return the predictor's gain ``F P H' (H P H' + R)^-1`` (n, p)."""
    return np.asarray(np.linalg.solve(H @ P @ H.T + R, H @ P @ F.T).T)


def undetectable_slot_mode(F: FloatArray, H: FloatArray) -> complex | None:
    """Return an eigenvalue of F on or outside the unit circle that H does not observe, or None."""
    return hidden_mode(F, H, FACTOR)


class CriticalProbability(NamedTuple):
    """Bounds on the delivery probability above which the mean covariance stays bounded.

    lower  : paper R (31), necessary, not sufficient
    upper  : paper R (32), sufficient from there on
    gain   : (n, p) K with spectral radius below 1 of ``(1-g) F x F + g (F+KH) x (F+KH)`` at
             ``g = upper + 1e-6``: proves the upper bound
    perron : (n, n) X >= 0 with ``min over K of (1-g) F X F' + g (F+KH) X (F+KH)' >= X`` at
             ``g = upper - 1e-6``: proves that no gain suffices there
    """

    lower: float
    upper: float
    gain: FloatArray
    perron: FloatArray


def critical_probability(F: ArrayLike, H: ArrayLike) -> tuple[float, float]:
    """Return the bounds (lower, upper) on the critical delivery probability, above which the mean
    of P stays bounded: R (31) and (32) of the paper on intermittent observations.

    F is (n, n), H (p, n). The upper bound is the smallest g for which some K makes the mean of the
    Kronecker squares contract. Policy iteration over K inside a root search over g finds it to
    about 1e-12. Raises TheoryError if (F, H) is not detectable: then no probability suffices.
    """
    bounds = critical_certificate(F, H)
    return bounds.lower, bounds.upper


def critical_certificate(F: ArrayLike, H: ArrayLike) -> CriticalProbability:
    """Return the bounds of paper R (31) and (32) on the critical delivery probability of the system
    with F (n, n) and H (p, n), with a proof of the upper one from both sides.

    The upper bound g is the least probability at which some gain makes errors contract in the mean
    square: the result has a gain (n, p) that does so at g + 1e-6, and a matrix (n, n) that shows
    that no gain does at g - 1e-6. Raises TheoryError if (F, H) is not detectable.
    """
    transition = as_square("F", F)
    observation = _check_observation(H, len(transition))
    hidden = undetectable_slot_mode(transition, observation)
    if hidden is not None:
        raise TheoryError(
            f"(F, H) is not detectable: the mode with eigenvalue {hidden:.6g} is never seen"
        )
    search = _GainSearch(transition, (observation[:0], observation))
    lower, upper = _critical_bounds(transition, observation, search)
    above, below = min(1.0, upper + 1e-6), max(0.0, upper - 1e-6)
    _, gains, _ = search.best((1.0 - above, above))
    _, _, perron = search.best((1.0 - below, below))
    return CriticalProbability(lower, upper, gains[1] / _row_sizes(observation), perron)


def _critical_bounds(F: FloatArray, H: FloatArray, search: _GainSearch) -> tuple[float, float]:
    """Return the bounds R (31), R (32) on the critical probability; raises TheoryError."""
    moduli, alpha = np.abs(eigenvalues(F)), growth_factor(F)
    lower = max(0.0, 1.0 - 1.0 / alpha**2) if alpha > 0.0 else 0.0

    def radius(g: float) -> float:
        """Return the least spectral radius over gains if readings arrive with probability ``g``."""
        return search.best((1.0 - g, g))[0]

    # Without a mode outside the unit circle the mean is bounded for every positive probability.
    if alpha <= 1.0:
        return lower, lower
    relative = H / _row_sizes(H.T)  # neither units of states nor of outputs change a rank
    if np.linalg.matrix_rank(relative / _row_sizes(relative)[:, None]) == 1:
        # Closed form for one output: 1 - 1 / (product of the squares of unstable eigenvalues).
        growing = np.maximum(moduli, 1.0)
        upper = float(-np.expm1(-2.0 * np.log(growing).sum()))
        return lower, max(lower, upper)  # equal, but for rounding, if one mode grows
    # The lower bound suffices: both bounds are equal, and the radius has no root above it.
    if radius(lower) <= 1.0 + 1e-13:
        return lower, lower
    if not radius(1.0) < 1.0:
        raise TheoryError("R (32) was not found: the system is too close to an undetectable one")
    # It takes 0.3 s to import.
    import scipy.optimize

    root = scipy.optimize.brentq(lambda g: np.log(radius(g)), lower, 1.0, xtol=1e-14)
    return lower, float(root)


def contraction_radius(F: FloatArray, arrivals: Sequence[tuple[float, FloatArray]]) -> float:
    """Return the least spectral radius over gains of ``X -> sum_s p_s (F + K_s H_s) X (F + K_s
    H_s)'``: below 1 the mean of P stays bounded (R (32), derived).
    """
    return _GainSearch(F, [H for _, H in arrivals]).best([p for p, _ in arrivals])[0]


def _row_sizes(H: FloatArray) -> FloatArray:
    """Return the largest entries (p,) of the rows of H (p, n), 1 for rows of zeros."""
    sizes = np.abs(H).max(axis=1, initial=0.0)
    return np.asarray(np.where(sizes > 0.0, sizes, 1.0))


class _GainSearch:
    """Minimises the spectral radius of ``L: X -> sum_s p_s (F + K_s H_s) X (F + K_s H_s)'``.

    F is (n, n), ``readings`` the H_s (p, n), one for each set s of readings that may arrive, of
    which p can differ. Policy iteration over the gains K_s: L is a positive map, so that its radius
    is an eigenvalue with a semidefinite X, and gains that minimise L(X) for this X do not raise the
    radius. Gains are those of rows of H_s in units of their largest entries.
    """

    def __init__(self, F: FloatArray, readings: Sequence[FloatArray]) -> None:
        self._F, self._readings = F, [H / _row_sizes(H)[:, None] for H in readings]
        n = len(F)
        rows, columns = np.triu_indices(n)
        # The matrix that maps the upper triangle of a symmetric X to vec(X), and the indices of
        # the triangle in vec(X).
        self._expand = np.zeros((n * n, len(rows)))
        self._expand[rows * n + columns, np.arange(len(rows))] = 1.0
        self._expand[columns * n + rows, np.arange(len(rows))] = 1.0
        self._pick = rows * n + columns

    def best(self, probabilities: Sequence[float]) -> tuple[float, list[FloatArray], FloatArray]:
        """Return the least radius over all gains, these gains, and the Perron matrix (n, n)."""
        n = len(self._F)
        gains = self._improve([np.zeros((n, len(H))) for H in self._readings], np.eye(n))
        gains = self._first_gains(probabilities, gains)
        radius, X = self._perron(probabilities, gains)
        for _ in range(500):
            following = self._improve(gains, X)
            rho, X_new = self._perron(probabilities, following)
            if not rho < radius * (1.0 - 1e-15):
                break
            radius, X, gains = rho, X_new, following
        return radius, gains, X

    def _first_gains(
        self, probabilities: Sequence[float], gains: list[FloatArray]
    ) -> list[FloatArray]:
        """Return gains (n, p) close to the best ones, by policy iteration with the resolvent."""
        # X = (s - L)^-1 I > 0 in place of the Perron matrix, which may leave gains undetermined;
        # the radius of the improved gains is below s, which is lowered step by step.
        radius = self._perron(probabilities, gains)[0]
        for excess in (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
            for _ in range(MAX_POLICIES):
                X = self._resolvent(probabilities, gains, radius * (1.0 + excess) + 1e-300)
                if X is None:
                    break
                following = self._improve(gains, X)
                rho = self._perron(probabilities, following)[0]
                if not rho < radius:
                    break
                gains, previous, radius = following, radius, rho
                if radius > previous * (1.0 - 0.01 * excess):
                    break
        return gains

    def _resolvent(
        self, probabilities: Sequence[float], gains: list[FloatArray], s: float
    ) -> FloatArray | None:
        """Return (s - L)^-1 I (n, n), scaled to a trace of about 1; None if not positive."""
        n, operator = len(self._F), self._operator(probabilities, gains)
        identity = np.eye(n).reshape(-1)[self._pick]
        try:
            # (s - L) X = I on upper triangles
            X = np.linalg.solve(s * np.eye(len(operator)) - operator, identity)
        except np.linalg.LinAlgError:
            return None
        with np.errstate(invalid="ignore"):
            X = self._expand @ X
        matrix = symmetric(X.reshape(n, n))
        if not np.isfinite(matrix).all() or not np.linalg.eigvalsh(matrix)[0] > 0.0:
            return None
        # With gains that make L = 0, X is about 1e300, and its products with H would overflow.
        return np.asarray(np.ldexp(matrix, -np.frexp(np.trace(matrix))[1]))

    def _improve(self, gains: list[FloatArray], X: FloatArray) -> list[FloatArray]:
        """Return K_s = -F X H_s' (H_s X H_s')^-1, the gains that minimise L(X)."""
        # In the kernel of H X H' any gain is optimal: the pseudo-inverse keeps the present one.
        improved = []
        for K, H in zip(gains, self._readings, strict=True):
            S = H @ X @ H.T
            change = -(self._F @ X @ H.T) - K @ S
            improved.append(np.asarray(K + change @ np.linalg.pinv(S, rcond=1e-13, hermitian=True)))
        return improved

    def _operator(self, probabilities: Sequence[float], gains: list[FloatArray]) -> FloatArray:
        """Return the mean-square dynamics L as a matrix (m, m) on upper triangles."""
        kron = np.zeros((len(self._F) ** 2,) * 2)
        for p, K, H in zip(probabilities, gains, self._readings, strict=True):
            closed = self._F + K @ H
            kron += p * np.kron(closed, closed)
        return np.asarray(kron[self._pick] @ self._expand)

    def _perron(
        self, probabilities: Sequence[float], gains: list[FloatArray]
    ) -> tuple[float, FloatArray]:
        """Return the radius of L and its Perron matrix X (n, n), semidefinite of positive trace."""
        values, vectors = np.linalg.eig(self._operator(probabilities, gains))
        k = int(np.argmax(values.real))
        vector = (self._expand @ vectors[:, k]).real
        X = symmetric(vector.reshape(self._F.shape))
        return float(np.abs(values).max()), X * np.sign(np.trace(X))


def support(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike, depth: int) -> FloatArray:
    """Return all compositions (2^depth, n, n) of ``depth`` maps, each f_0 (a slot without a
    reading) or f_1 (one with it), applied to P*, the fixed point of f_1.

    F and Q are (n, n), H (p, n), R (p, p). The binary digits of the index k are the maps of entry
    k, the leading digit being applied last. By paper R Theorem 10 the closure of these points over
    all depths is the support of the invariant law; f_1(P*) = P*, so that each depth contains the
    ones before. Raises TheoryError for a depth outside 0 .. 22 and if P* does not exist.
    """
    depth = as_integer("depth", depth, 0, MAX_DEPTH)
    F, Q, H, R = check_system(F, Q, H, R)
    roots = covariance_root(steady_covariance(F, Q, H, R))[None]
    root_Q, modes = square_root(Q), reading_modes([(H[:0], R[:0, :0]), (H, R)], len(F))
    for _ in range(depth):
        one_slot = (np.full((len(roots), 1), mode, dtype=np.uint8) for mode in (0, 1))
        roots = np.concatenate([move_roots(roots, mode, F, root_Q, modes) for mode in one_slot])
    return symmetric(roots @ np.swapaxes(roots, -1, -2))


def invariant_samples(
    F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike, delivery: float, samples: int, seed: int
) -> FloatArray:
    """Return independent draws (samples, n, n) from the invariant law of the random Riccati
    equation, to which the one-step prediction covariance tends.

    F and Q are (n, n), H (p, n), R (p, p); readings arrive with probability ``delivery``. Coupling
    from the past (Propp and Wilson, 1996): each draw has its own arrivals, drawn backwards from the
    present; the equation runs through the last T of them from P*, the least point of the support,
    and from a million times P* + tr(P*) I. T is doubled until the two ends differ by at most 1e-9,
    relative: then every start in the infinite past leads there. (A forward chain that stops when it
    has forgotten its start would favour draws with recent arrivals.) Raises TheoryError if no
    invariant law exists or the ends do not meet.
    """
    F, Q, H, R = check_system(F, Q, H, R)
    delivery = check_delivery(delivery)
    samples, seed = as_integer("samples", samples, 1), as_integer("seed", seed, 0, np.inf)
    n, P = len(F), steady_covariance(F, Q, H, R)
    random = Streams(seed).generator("arrivals")
    modes = reading_modes([(H[:0], R[:0, :0]), (H, R)], n)
    # f_0 and f_1 are monotone: every start between these two ends between their ends.
    starts = np.stack([covariance_root(P), 1e3 * covariance_root(P + np.trace(P) * np.eye(n))])
    draws = np.empty((samples, n, n))
    for first in range(0, samples, MAX_SAMPLES_AT_ONCE):
        count = min(MAX_SAMPLES_AT_ONCE, samples - first)
        # A slot without a reading is mode 0, one with a reading mode 1.
        draws[first : first + count], _ = couple_from_the_past(
            lambda following, T: random.random((len(following), T)) < delivery,
            lambda roots, arrivals: move_roots(roots, arrivals, F, square_root(Q), modes),
            starts,
            np.zeros((count, 0), dtype=bool),
        )
    return draws


def couple_from_the_past(
    draw: Callable[[np.ndarray, int], np.ndarray],
    propagate: Callable[[FloatArray, np.ndarray], FloatArray],
    starts: FloatArray,
    empty: np.ndarray,
) -> tuple[FloatArray, np.ndarray]:
    """Return K exact draws (K, n, n) from the invariant law of a switched Riccati recursion, and
    their last modes (K,) (Propp and Wilson 1996). ``draw(following, T)`` returns T modes before
    ``following`` (K, S), ``propagate(roots, modes)`` applies modes (K, T); ``empty`` (K, 0) fixes K
    and type. Chains from both ``starts`` (2, n, n) run until they meet; TheoryError after MAX_PAST
    slots.
    """
    out = np.empty((len(empty), *starts.shape[1:]))
    last = np.empty(len(empty), dtype=empty.dtype)
    open_chains = np.arange(len(empty))
    modes = draw(empty, FIRST_PAST)
    while len(open_chains):
        ends = propagate(
            np.repeat(starts, len(open_chains), axis=0), np.concatenate([modes, modes])
        ).reshape(2, len(open_chains), *starts.shape[1:])
        covariances = ends @ np.swapaxes(ends, -1, -2)
        if not np.isfinite(covariances).all():
            break
        distance = np.abs(covariances[0] - covariances[1]).max(axis=(-1, -2))
        # Chains that met are finished; the others need a longer past.
        met = distance <= COALESCENCE_TOLERANCE * np.abs(covariances[0]).max(axis=(-1, -2))
        out[open_chains[met]] = symmetric(covariances[0, met])
        last[open_chains[met]] = modes[met, -1]
        open_chains, modes = open_chains[~met], modes[~met]
        if 2 * modes.shape[1] > MAX_PAST:
            break
        # The past is extended at its far end: the modes drawn so far stay the last ones.
        modes = np.concatenate([draw(modes, modes.shape[1]), modes], axis=1)
    if len(open_chains):
        raise TheoryError("the equation does not forget its start: no invariant law was reached")
    return out, last
