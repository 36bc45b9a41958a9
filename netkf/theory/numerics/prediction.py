"""Propagation of errors and of the true state between events of nodes that read increments.

Let M be the Hamiltonian of the Riccati equation, ``E(s) = exp(M s)`` and ``[X; Y](s) = E(s) [I;
P]``. Over a gap g the error's transition from s is ``Phi(g, s) = X(g)^-T X(s)^T``, and that of the
filter's gain L ``Phi(g, s) L(s) = X(g)^-T Y(s)^T H' R^-1``. Both are entire functions of s, which
eight Gauss-Legendre nodes integrate to machine precision over steps of |M| g <= 1/2.

Covariances are passed as roots ``P = S S'``, since ``(I + P G)^-1`` loses all digits if the
eigenvalues of P differ by orders of magnitude. Roots are updated by orthogonal triangularisation
(Kailath, Sayed and Hassibi 2000, Linear Estimation, chapter 12), in which no subtraction cancels
digits. An error is a linear form of independent standard normal inputs, its coefficients (n, C).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from netkf.algorithms.kernels.riccati import exponential_series, hamiltonian
from netkf.algorithms.kernels.square_root import lower_triangular
from netkf.linalg.arrays import FloatArray, block_diagonal

# Eight nodes integrate e^{A s} to rounding within one unit; mapped from [-1, 1] to [0, 1].
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS
MAX_NORM, TERMS = 0.5, 22  # largest |M| s, and terms, of exp(M s); the remainder is 0.5^22 / 22!


class ShortExponential:
    """``exp(M s)`` (d, d) by its Taylor series for 0 <= s <= ``unit`` seconds, at which |M| s =
    MAX_NORM in the 1-norm, for M (d, d) per second.
    """

    def __init__(self, M: FloatArray) -> None:
        self.unit = MAX_NORM / max(float(np.abs(M).sum(axis=0).max(initial=0.0)), 1e-300)
        self._terms = exponential_series(M * self.unit, TERMS)

    def __call__(self, times: FloatArray) -> FloatArray:
        """Return exp(M s) (K, d, d) at K ``times`` s in seconds, each at most ``unit``."""
        powers = (np.asarray(times)[:, None] / self.unit) ** np.arange(TERMS)
        return np.asarray(np.tensordot(powers, self._terms, 1))


class ErrorFlow:
    """Errors of filters with the same continuous readings H (p, n); p = 0 for filters without any.

    Transitions are over at most ``unit`` seconds. They are computed in ``units`` (n,) of states, in
    which |M| is small and no digits are lost, whatever those of the plant.
    """

    def __init__(
        self,
        A: FloatArray,
        B: FloatArray,
        H: FloatArray,
        R: FloatArray,
        noise: FloatArray,
        plant: FloatArray,
        units: FloatArray,
    ) -> None:
        """Take A (n, n), B (n, m), H (p, n) and R (p, p) as the filters assume them, a root
        ``noise`` (p, p) of the true R, and the true B of the ``plant``; A is the true one.
        """
        self.units, rows = units, units[:, None]
        A, B, H, plant = A * units / rows, B / rows, H * units, plant / rows
        root_R, weight = np.linalg.cholesky(R), np.linalg.solve(R, H).T
        self._H = np.linalg.solve(root_R, H)
        # What enters errors by X' and Y': noises as filters assume them, and true ones.
        self._assumed = block_diagonal([B, weight @ root_R])
        self._true, self._m = block_diagonal([plant, weight @ noise]), plant.shape[1]
        # The Hamiltonian of dP = A P + P A' + Q - P G P, scaled to balance its off-diagonal blocks.
        M, self._scale = hamiltonian(A, B @ B.T, self._H.T @ self._H)
        self._exponential = ShortExponential(M)
        self.unit = self._exponential.unit
        # A long gap is many equal steps.
        self._over = lru_cache(maxsize=1)(self._matrices_over)

    def _matrices_over(self, gap: float) -> tuple[FloatArray, ...]:
        """Return what depends on the ``gap`` (s) alone: at the nodes [X', Y'] = upper + P lower;
        from P = 0 F = X(gap)^-T, the information Gamma' Gamma of readings, and a root of P(gap).
        """
        n, weights = len(self._H.T), np.sqrt(WEIGHTS * gap)[:, None, None]
        E = self._exponential(np.append(NODES, 1.0) * gap).swapaxes(1, 2).copy()
        E[:, :n, n:] *= self._scale
        E[:, n:, :n] /= self._scale
        upper, lower, inverse = E[:-1, :n], E[:-1, n:], np.linalg.inv(E[:, :n, :n])
        F, Gamma = inverse[-1], (weights * (self._H @ inverse[:-1])).reshape(-1, n)
        start = _narrowed(_side_by_side(weights * (F @ upper @ self._assumed)))
        return upper, lower, F, Gamma, start

    def move(
        self, errors: FloatArray, roots: FloatArray, gap: float, columns: tuple[int, int]
    ) -> None:
        """Propagate the forms of K ``errors`` (K, n, C) and the lower triangular ``roots``
        (K, n, n) of their P in place over ``gap`` seconds, at most ``unit``; ``columns``: the first
        of the plant's 8 m inputs, and the first of n inputs of each error.
        """
        n, weights = errors.shape[1], np.sqrt(WEIGHTS * gap)[:, None, None]
        rows = self.units[:, None]
        errors /= rows
        roots /= rows
        upper, lower, F, Gamma, start = self._over(gap)
        # L L' = I + S' G S, so that J = (I + P G)^-1 = I - S (L L')^-1 S' G and S L^-T is a root of
        # J P.
        SG = np.swapaxes(Gamma @ roots, 1, 2)
        eye = np.broadcast_to(np.eye(n), roots.shape)
        L = lower_triangular(np.concatenate([eye, SG], axis=2))
        solved = np.linalg.solve(L, np.concatenate([np.swapaxes(roots, 1, 2), SG], axis=2))
        FSL = F @ np.swapaxes(solved[..., :n], 1, 2)
        FJ, FJP = F - FSL @ solved[..., n:] @ Gamma, FSL @ solved[..., :n]
        beginnings = np.broadcast_to(start, (len(roots), *start.shape))
        roots[...] = lower_triangular(np.concatenate([FSL, beginnings], axis=2))
        errors[...] = FJ @ errors
        noises = weights * ((FJ[:, None] @ upper + FJP[:, None] @ lower) @ self._true)
        moved = _side_by_side(noises[..., : self._m])
        errors[:, :, columns[0] : columns[0] + moved.shape[2]] += moved
        for e, own in enumerate(_narrowed(_side_by_side(noises[..., self._m :]))):
            first = columns[1] + e * n
            errors[e, :, first : first + own.shape[1]] += own
        errors *= rows
        roots *= rows


def _side_by_side(parts: FloatArray) -> FloatArray:
    """Return the matrices (..., n, 8 m) of 8 ``parts`` (..., 8, n, m) each."""
    moved = np.swapaxes(parts, -3, -2)
    return moved.reshape(*moved.shape[:-2], -1)


def _narrowed(factor: FloatArray) -> FloatArray:
    """Return matrices with the products of ``factor`` (..., n, c), of at most n columns."""
    return factor if factor.shape[-1] <= factor.shape[-2] else lower_triangular(factor)


class StateFlow:
    """The true state dx = A x dt + B dw over gaps of at most ``unit`` seconds; A (n, n), B (n, m).
    Transitions are computed in ``units`` (n,).

    inputs : 8 m, the m of the noise at each of 8 quadrature nodes (instants of the gap)
    """

    def __init__(self, A: FloatArray, B: FloatArray, units: FloatArray) -> None:
        """Take A (n, n), per second, and B (n, m) of m noises of variance 1 per second."""
        self._units, self._B = units, B / units[:, None]
        self._exp = ShortExponential(A * units / units[:, None])
        self.unit = self._exp.unit
        self.inputs = len(NODES) * B.shape[1]
        self._over = lru_cache(maxsize=1)(self._matrices_over)

    def __call__(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """Return transition (n, n) and response (n, 8 m) to inputs over a short ``gap`` (s)."""
        return self._over(gap)

    def _matrices_over(self, gap: float) -> tuple[FloatArray, FloatArray]:
        E = self._exp(np.append((1.0 - NODES) * gap, gap))
        root_weights = np.sqrt(WEIGHTS * gap)[:, None, None]
        response, rows = _side_by_side(root_weights * (E[:-1] @ self._B)), self._units[:, None]
        return E[-1] * rows / self._units, response * rows
