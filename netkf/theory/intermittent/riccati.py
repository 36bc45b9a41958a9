"""Intermittent observations: the random Riccati equation P_{t+1} = f_gamma(P_t) of R.

``f_0(P) = F P F' + Q`` without the reading, ``f_1`` with it, R (15)-(18). P is the one-step
prediction covariance and ``delivery`` the probability that a reading arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from netkf.algorithms.kernels.chains import advance, alphabet
from netkf.algorithms.kernels.square_root import predict_root, update_root
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray, square_root, symmetric
from netkf.rng.streams import Streams
from netkf.theory.numerics.matrices import RESIDUAL, as_covariance, as_numbers, as_square, as_whole

DEEPEST, MAX_POLICIES = 22, 40
COALESCED = 1e-9
FIRST_PAST, LONGEST_PAST = 32, 100_000
BLOCK = 20_000  # draws at once


class SlotSystem(NamedTuple):
    """Checked F (n, n), Q (n, n), H (p, n), R (p, p)."""

    F: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray


def check_system(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike) -> SlotSystem:
    """The matrices as checked arrays; raises TheoryError."""
    F_ = as_square("F", F)
    n = len(F_)
    H_ = _observation(H, n)
    R_ = as_covariance("R", R, len(H_))
    if len(R_) and not np.linalg.eigvalsh(R_)[0] > 0.0:
        raise TheoryError("R must be positive definite")
    return SlotSystem(F_, as_covariance("Q", Q, n), H_, R_)


def _observation(H: ArrayLike, n: int) -> FloatArray:
    array = as_numbers("H", H)
    if array.ndim != 2 or array.shape[1] != n or not np.isfinite(array).all():
        raise TheoryError(f"H must be a finite matrix of {n} columns, its shape is {array.shape}")
    return array


def lyapunov_step(P: ArrayLike, F: ArrayLike, Q: ArrayLike) -> FloatArray:
    """``f_0(P) = F P F' + Q`` (n, n), R (15): a slot without a reading."""
    transition = as_square("F", F)
    n = len(transition)
    return symmetric(
        transition @ as_covariance("P", P, n) @ transition.T + as_covariance("Q", Q, n)
    )


def riccati_step(
    P: ArrayLike, F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike
) -> FloatArray:
    """``f_1(P) = F P F' + Q - F P H' (H P H' + R)^-1 H P F'`` (n, n), R (16): a slot with one.

    Computed from square roots by an orthogonal triangularisation, without a subtraction.
    """
    system = check_system(F, Q, H, R)
    start = as_covariance("P", P, len(system.F))
    root, _ = update_root(_root(start), system.F, square_root(system.Q), system.H, _root(system.R))
    return symmetric(root @ root.T)


def _root(P: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    except np.linalg.LinAlgError:  # singular
        return square_root(P)


def steady_covariance(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike) -> FloatArray:
    """P* (n, n), the stabilising fixed point of f_1.

    Raises TheoryError, naming the mode, where (F, H) is not detectable, and where what was found
    does not solve the equation or does not stabilise the filter.
    """
    F, Q, H, R = check_system(F, Q, H, R)
    hidden = undetectable_slot_mode(F, H)
    if hidden is not None:
        raise TheoryError(f"(F, H) is not detectable: the mode with eigenvalue {hidden:.6g}")
    try:
        P = np.zeros_like(F)  # without readings the step below finds all
        if len(H):
            P = symmetric(np.asarray(scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)))
        # One step of Newton's method takes what is left of the residual away.
        K = _gain(P, F, H, R)
        P = symmetric(np.asarray(scipy.linalg.solve_discrete_lyapunov(F - K @ H, Q + K @ R @ K.T)))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise TheoryError(f"no stabilising fixed point of f_1: {error}") from None
    residual = np.abs(riccati_step(P, F, Q, H, R) - P).max()
    if not residual <= RESIDUAL * np.abs(P).max():
        raise TheoryError(f"P* was solved to {residual:.1e} only")
    if not np.abs(np.linalg.eigvals(F - _gain(P, F, H, R) @ H)).max() < 1.0:
        raise TheoryError("the fixed point found does not stabilise the filter")
    return P


def filtered_covariance(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """(n, n): the steady covariance after a reading, where P* is that before it; P (12)."""
    P = steady_covariance(F, Q, H, R)
    information = H.T @ np.linalg.solve(R, H)
    return symmetric(np.asarray(np.linalg.solve(np.eye(len(P)) + P @ information, P)))


def _gain(P: FloatArray, F: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(H @ P @ H.T + R, H @ P @ F.T).T)


def undetectable_slot_mode(F: FloatArray, H: FloatArray) -> complex | None:
    """An eigenvalue of F on or outside the unit circle whose mode H does not see, or None."""
    size = max(float(np.linalg.norm(F, 2)), 1e-300)
    seen = H / max(float(np.abs(H).max(initial=0.0)), 1e-300) * size
    for value in np.linalg.eigvals(F):
        if abs(value) < 1.0 - 1e-12:
            continue
        pencil = np.concatenate([F - value * np.eye(len(F)), seen])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-9 * size:
            return complex(value)
    return None


class Critical(NamedTuple):
    """Bounds on the delivery probability above which the mean covariance stays bounded.

    lower : R (31), necessary, not sufficient
    upper : R (32), from there on sufficient
    gain  : (n, p) K with spectral radius below 1 of ``(1-g) F x F + g (F+KH) x (F+KH)`` at
            ``g = upper + 1e-6``: proves the upper bound
    perron: (n, n) X >= 0 with ``min over K of (1-g) F X F' + g (F+KH) X (F+KH)' >= X`` at
            ``g = upper - 1e-6``: proves that no gain will do there
    """

    lower: float
    upper: float
    gain: FloatArray
    perron: FloatArray


def critical_probability(F: ArrayLike, H: ArrayLike) -> tuple[float, float]:
    """(lower, upper) bounds on the critical delivery probability, R (31) and (32).

    The upper one is the smallest g for which some K makes the mean of the Kronecker squares
    contract; it is found by policy iteration over K inside a root search over g, to about 1e-12.
    Raises TheoryError where (F, H) is not detectable: then no probability will do.
    """
    found = critical_certificate(F, H)
    return found.lower, found.upper


def critical_certificate(F: ArrayLike, H: ArrayLike) -> Critical:
    """The bounds of critical_probability with what proves the upper one from both sides."""
    transition = as_square("F", F)
    n = len(transition)
    observation = _observation(H, n)
    hidden = undetectable_slot_mode(transition, observation)
    if hidden is not None:
        raise TheoryError(
            f"(F, H) is not detectable: the mode with eigenvalue {hidden:.6g} is never seen"
        )
    alpha = float(np.abs(np.linalg.eigvals(transition)).max())
    lower = max(0.0, 1.0 - 1.0 / alpha**2) if alpha > 0.0 else 0.0
    search = _Contraction(transition, (observation[:0], observation))

    def radius(g: float) -> float:
        return search.best((1.0 - g, g))[0]

    if alpha <= 1.0:
        upper = lower
    elif np.linalg.matrix_rank(observation) == 1:
        growing = np.maximum(np.abs(np.linalg.eigvals(transition)), 1.0)
        upper = float(-np.expm1(-2.0 * np.log(growing).sum()))  # R (32) in closed form
    elif radius(lower) <= 1.0 + 1e-13:
        upper = lower
    elif not radius(1.0) < 1.0:
        raise TheoryError("R (32) was not found: the system is too close to an undetectable one")
    else:
        upper = float(scipy.optimize.brentq(lambda g: np.log(radius(g)), lower, 1.0, xtol=1e-14))
    above, below = min(1.0, upper + 1e-6), max(0.0, upper - 1e-6)
    _, gains, _ = search.best((1.0 - above, above))
    _, _, perron = search.best((1.0 - below, below))
    return Critical(lower, upper, gains[1], perron)


def contraction_radius(F: FloatArray, arrivals: Sequence[tuple[float, FloatArray]]) -> float:
    """The least spectral radius, over gains K_s, of ``X -> sum_s p_s (F + K_s H_s) X (F + K_s
    H_s)'``, for sets s of readings, ``H_s`` (p, n) together, that arrive with probability p_s.

    Below 1 the mean of the covariance stays bounded (R (32), derived for several links).
    """
    return _Contraction(F, [H for _, H in arrivals]).best([p for p, _ in arrivals])[0]


class _Contraction:
    """min over K_s of the spectral radius of ``X -> sum_s p_s (F + K_s H_s) X (F + K_s H_s)'``."""

    def __init__(self, F: FloatArray, readings: Sequence[FloatArray]) -> None:
        self._F, self._readings = F, readings
        n = len(F)
        rows, columns = np.triu_indices(n)
        # vec of a symmetric matrix from its upper triangle, and the triangle of a vec
        self._expand = np.zeros((n * n, len(rows)))
        self._expand[rows * n + columns, np.arange(len(rows))] = 1.0
        self._expand[columns * n + rows, np.arange(len(rows))] = 1.0
        self._pick = rows * n + columns

    def best(self, chances: Sequence[float]) -> tuple[float, list[FloatArray], FloatArray]:
        """The least spectral radius, the gains that reach it and the Perron matrix."""
        n = len(self._F)
        gains = self._improved([np.zeros((n, len(H))) for H in self._readings], np.eye(n))
        gains = self._lowered(chances, gains)
        best, X = self._perron(chances, gains)
        for _ in range(500):
            following = self._improved(gains, X)
            rho, X_new = self._perron(chances, following)
            if not rho < best * (1.0 - 1e-15):
                break
            best, X, gains = rho, X_new, following
        return best, gains, X

    def _lowered(self, chances: Sequence[float], gains: list[FloatArray]) -> list[FloatArray]:
        """Gains near the best ones, whatever the first: policy iteration with the resolvent
        ``X = (s - L)^-1 I`` at s above the radius of L in place of its Perron matrix, which may be
        singular and say nothing about a direction. X > 0, so each step lowers the radius below s.
        """
        best = self._perron(chances, gains)[0]
        for excess in (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
            for _ in range(MAX_POLICIES):
                X = self._resolvent(chances, gains, best * (1.0 + excess) + 1e-300)
                if X is None:
                    break
                following = self._improved(gains, X)
                rho = self._perron(chances, following)[0]
                if not rho < best:
                    break
                gains, before, best = following, best, rho
                if best > before * (1.0 - 0.01 * excess):
                    break
        return gains

    def _resolvent(
        self, chances: Sequence[float], gains: list[FloatArray], s: float
    ) -> FloatArray | None:
        n, whole = len(self._F), self._operator(chances, gains)
        identity = np.eye(n).reshape(-1)[self._pick]
        try:
            X = self._expand @ np.linalg.solve(s * np.eye(len(whole)) - whole, identity)
        except np.linalg.LinAlgError:
            return None
        matrix = symmetric(X.reshape(n, n))
        positive = np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 0.0
        return matrix if positive else None

    def _improved(self, gains: list[FloatArray], X: FloatArray) -> list[FloatArray]:
        # Where X says nothing about a direction, what is known of it is kept.
        found = []
        for K, H in zip(gains, self._readings, strict=True):
            S = H @ X @ H.T
            wanted = -(self._F @ X @ H.T) - K @ S
            found.append(np.asarray(K + wanted @ np.linalg.pinv(S, rcond=1e-13, hermitian=True)))
        return found

    def _operator(self, chances: Sequence[float], gains: list[FloatArray]) -> FloatArray:
        whole = np.zeros((len(self._F) ** 2,) * 2)
        for p, K, H in zip(chances, gains, self._readings, strict=True):
            closed = self._F + K @ H
            whole += p * np.kron(closed, closed)
        return np.asarray(whole[self._pick] @ self._expand)

    def _perron(
        self, chances: Sequence[float], gains: list[FloatArray]
    ) -> tuple[float, FloatArray]:
        values, vectors = np.linalg.eig(self._operator(chances, gains))
        k = int(np.argmax(values.real))
        vector = (self._expand @ vectors[:, k]).real
        X = symmetric(vector.reshape(self._F.shape))
        return float(np.abs(values).max()), X * np.sign(np.trace(X))


def support(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike, depth: int) -> FloatArray:
    """(2^depth, n, n): all words of ``depth`` letters over {f_0, f_1} applied to P*, right to left.

    Entry k belongs to the word whose letters are the binary digits of k, the first (applied last)
    leading. R Theorem 10: the closure of these points over all depths is the support of the
    invariant law; f_1(P*) = P*, so each depth holds the ones before. Raises TheoryError for a depth
    outside 0 .. 22 and where P* does not exist.
    """
    depth = as_whole("depth", depth, 0, DEEPEST)
    F, Q, H, R = check_system(F, Q, H, R)
    roots = _root(steady_covariance(F, Q, H, R))[None]
    root_Q, root_R = square_root(Q), _root(R)
    for _ in range(depth):
        without = predict_root(roots, F, root_Q)
        with_reading, _gain = update_root(roots, F, root_Q, H, root_R)
        roots = np.concatenate([without, with_reading])
    return symmetric(roots @ np.swapaxes(roots, -1, -2))


def invariant_samples(
    F: ArrayLike,
    Q: ArrayLike,
    H: ArrayLike,
    R: ArrayLike,
    delivery: float,
    samples: int,
    seed: int,
) -> FloatArray:
    """(samples, n, n): independent draws from the invariant law of the random Riccati equation.

    Coupling from the past (Propp and Wilson, 1996): each draw has its own arrivals, drawn backwards
    from now; the equation runs through the last T of them from P*, the least point of the support,
    and from a covariance a million times larger. Where the two ends differ by more than 1e-9, T is
    doubled. Both then show what every start in the infinite past leads to; stopping a chain when it
    has forgotten its start would prefer draws with recent arrivals. Raises TheoryError where no
    invariant law exists or that does not happen. Much faster with the extra ``fast``.
    """
    F, Q, H, R = check_system(F, Q, H, R)
    if as_numbers("delivery", delivery).size != 1 or not 0.0 < delivery <= 1.0:
        raise TheoryError(f"delivery must lie in (0, 1], got {delivery!r}")
    samples, seed = as_whole("samples", samples, 1), as_whole("seed", seed, 0)
    n, P = len(F), steady_covariance(F, Q, H, R)
    random = Streams(seed).generator("arrivals")
    letters = alphabet([(H[:0], R[:0, :0]), (H, R)], n)
    starts = np.stack([_root(P), 1e3 * _root(P + np.trace(P) * np.eye(n))])
    drawn = np.empty((samples, n, n))
    for first in range(0, samples, BLOCK):
        some = min(BLOCK, samples - first)
        drawn[first : first + some] = _coupled(
            lambda K, T: random.random((K, T)) < delivery,
            lambda roots, words: advance(roots, words, F, square_root(Q), letters),
            starts,
            some,
        )
    return drawn


def _coupled(
    draw: Callable[[int, int], np.ndarray],
    advanced: Callable[[FloatArray, np.ndarray], FloatArray],
    starts: FloatArray,
    samples: int,
) -> FloatArray:
    """(samples, n, n) by coupling from the past; ``draw(K, T)`` gives earlier letters."""
    out = np.empty((samples, *starts.shape[1:]))
    left = np.arange(samples)
    words = draw(samples, FIRST_PAST)
    while len(left):
        ends = advanced(
            np.repeat(starts, len(left), axis=0), np.concatenate([words, words])
        ).reshape(2, len(left), *starts.shape[1:])
        pair = ends @ np.swapaxes(ends, -1, -2)
        if not np.isfinite(pair).all():
            break
        apart = np.abs(pair[0] - pair[1]).max(axis=(-1, -2))
        met = apart <= COALESCED * np.abs(pair[0]).max(axis=(-1, -2))
        out[left[met]] = symmetric(pair[0, met])
        left, words = left[~met], words[~met]
        if 2 * words.shape[1] > LONGEST_PAST:
            break
        words = np.concatenate([draw(*words.shape), words], axis=1)
    if len(left):
        raise TheoryError("the equation does not forget its start: no invariant law was reached")
    return out
