"""Exact discretisation of ``dx = A x dt + B dw`` over gaps of any length."""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply, gauss_legendre, norm, product
from netkf.linalg.spectra import balanced_norm, growth_factor, growth_rate

UNIT_SIZE = 0.5  # largest balanced norm of A times a gap for which one power series is used
DEPENDENT = 1e-9  # a remainder below this share of the row's norm counts as rounding
_NODES, _WEIGHTS = gauss_legendre(10)  # exact to rounding for gaps of that size


class Transitions:
    """The discretisation ``x(t + g) = Phi x(t) + L z`` of ``A`` (n, n), ``B`` (n, m), z standard
    normal: ``Phi = e^{A g}`` and ``L L' = int_0^g e^{A s} B B' e^{A' s} ds``.

    L is lower triangular with a diagonal that is not negative; column k is zero if component k of
    the noise depends on those before it. Short gaps use a power series and Gauss quadrature, which
    keep the relative accuracy of entries of very different size (a chain of integrators over
    1e-9 s); longer gaps are reached by doubling. A law has the same bits beside any others.
    """

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        self.n = len(A)
        # In units of the states in which entries are alike: each doubling doubles the rounding.
        self._norm = balanced_norm(A)
        longest = A * (UNIT_SIZE / self._norm) if self._norm > 0.0 else A
        powers = [np.eye(self.n)]
        term = total = powers[0]
        # The terms A^k / k! that matter to any entry for gaps with |A| g <= UNIT_SIZE.
        while (np.abs(term) > 1e-19 * total).any():
            powers.append(product(powers[-1], A) / len(powers))
            term = product(term, longest) / (len(powers) - 1)
            total = total + np.abs(term)
        self._series = np.stack(powers)
        self._response = product(self._series, B)

    def laws(self, gaps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``Phi`` and ``L``, both (K, n, n), of K ``gaps`` (K,) in seconds, none below 0.

        Each gap is halved until the power series applies, then doubled:
        Phi(2 g) = Phi(g)^2 and L(2 g) L(2 g)' = [L, Phi L] [L, Phi L]'.
        """
        doublings = self._doublings(gaps)
        units = np.ldexp(gaps, -doublings)
        Phi = self._unit_transition(units)
        L, _ = noise_factors(self._unit_noise(units))
        with np.errstate(over="ignore", invalid="ignore"):  # unstable A over a very long gap
            for level in range(int(doublings.max(initial=0))):
                k = np.flatnonzero(doublings > level)
                L[k], _ = noise_factors(np.concatenate([L[k], product(Phi[k], L[k])], axis=2))
                Phi[k] = product(Phi[k], Phi[k])
        return Phi, L

    def law(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """Return ``Phi`` and the noise covariance ``L L'``, both (n, n), of one ``gap`` in seconds,
        in a quarter of the time of ``laws``.
        """
        gaps = np.array([gap])
        doublings = self._doublings(gaps)
        units = np.ldexp(gaps, -doublings)
        Phi, noise = self._unit_transition(units)[0], self._unit_noise(units)[0]
        W = noise @ noise.T
        for _ in range(int(doublings[0])):
            Phi, W = Phi @ Phi, W + Phi @ W @ Phi.T
        return Phi, W

    def transitions(self, gaps: FloatArray) -> FloatArray:
        """Return only ``Phi = e^{A g}`` (K, n, n) of the K ``gaps`` g (K,) in seconds."""
        distinct, index = np.unique(gaps, return_inverse=True)
        doublings = self._doublings(distinct)
        Phi = self._unit_transition(np.ldexp(distinct, -doublings))
        with np.errstate(over="ignore", invalid="ignore"):
            for level in range(int(doublings.max(initial=0))):
                k = np.flatnonzero(doublings > level)
                Phi[k] = product(Phi[k], Phi[k])
        return np.asarray(Phi[index])

    def _doublings(self, gaps: FloatArray) -> np.ndarray:
        """Return the halvings (K,) after which the power series applies to ``gaps`` (K,)."""
        # The least d with |A| g / 2^d <= UNIT_SIZE.
        sizes = np.maximum(gaps * (self._norm / UNIT_SIZE), 1.0)
        return np.ceil(np.log2(sizes)).astype(np.int64)

    def _unit_transition(self, gaps: FloatArray) -> FloatArray:
        """Return exp(A g) (K, n, n) by its power series, for K short ``gaps``."""
        n, terms = self.n, len(self._series)
        powers = _powers(gaps, terms)
        return product(powers, self._series.reshape(terms, n * n)).reshape(-1, n, n)

    def _unit_noise(self, gaps: FloatArray) -> FloatArray:
        """Return a factor (K, n, 10 m) of the noise covariance over K short ``gaps``."""
        terms, n, m = self._response.shape
        powers = _powers(gaps[:, None] * _NODES, terms)
        response = product(powers, self._response.reshape(terms, n * m))
        response = response.reshape(-1, len(_NODES), n, m)
        response *= np.sqrt(gaps[:, None] * _WEIGHTS)[:, :, None, None]
        return np.asarray(np.moveaxis(response, 1, 2).reshape(-1, n, len(_NODES) * m))


def noise_factors(noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``S`` (K, n, n), lower triangular, and ``D`` (K, n, c) with orthonormal rows and ``S D
    = noise`` (K, n, c); where a row of ``noise`` depends on those before it, its row of D and
    column of S are zero. Gram-Schmidt, each row twice (Kahan and Parlett): Householder reflections
    would give such a row a direction made of rounding errors.
    """
    count, n, columns = noise.shape
    S, D = np.zeros((count, n, n)), np.zeros((count, n, columns))
    for k in range(n):
        row = noise[:, k]
        scale = np.abs(row).max(axis=1, initial=0.0)
        scale[scale == 0.0] = 1.0  # scaled rows: the squares of small numbers do not underflow
        remainder = row / scale[:, None]
        row_norm = norm(remainder)
        # Subtract the components along the rows of D so far, and then those left by rounding.
        for _ in range(2):
            components = apply(D[:, :k], remainder)
            S[:, k, :k] += components * scale[:, None]
            remainder = remainder - apply(np.swapaxes(D[:, :k], 1, 2), components)
        length = norm(remainder)
        independent = length > DEPENDENT * row_norm
        S[independent, k, k] = (length * scale)[independent]
        D[independent, k] = remainder[independent] / length[independent, None]
    return S, D


def _powers(gaps: FloatArray, terms: int) -> FloatArray:
    """Return the powers g^0 .. g^(terms - 1), (K, c, terms), of ``gaps`` g."""
    # By multiplication: the last bit of numpy's power depends on the CPU.
    gaps = gaps if gaps.ndim > 1 else gaps[:, None]
    factors = np.ones((*gaps.shape, terms))
    factors[:, :, 1:] = gaps[:, :, None]
    return np.asarray(np.multiply.accumulate(factors, axis=2))


GROWTH = 10.0 * math.log(2.0)
"""Logarithm of the factor by which an unstable state may grow within a frame, 2^10. A frame is an
interval after which states are taken relative to a new origin, so that errors keep their digits.
"""
LONGEST_FRAME = 1e18
"""Seconds; horizons have at most 1e15 ticks of at most a second."""


def frame_period(A: FloatArray) -> float | None:
    """Return the length of a frame in seconds, 1, 2 or 5 times a power of ten, in which states of
    ``dx = A x dt``, ``A`` (n, n) in 1/s, grow at most 2^10-fold; None if they do not grow, or so
    slowly that no run is as long as a frame.
    """
    rate = growth_rate(A)
    return decimal_below(GROWTH / rate) if rate > GROWTH / LONGEST_FRAME else None


def decimal_below(bound: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten up to ``bound``, but for rounding."""
    power = 10.0 ** math.floor(math.log10(bound))
    digit = next(d for d in (5.0, 2.0, 1.0) if d * power <= bound * (1.0 + 1e-9))
    # Rounded, since the product may differ from the decimal number in its last bit.
    return float(f"{digit * power:.12g}")


def frame_slots(F: FloatArray) -> int | None:
    """Return the length of a frame in slots, in which states of ``x[k+1] = F x[k]``, F (n, n), grow
    at most 2^10-fold, or 1; None if they do not grow.
    """
    factor = growth_factor(F)
    # Frames must not depend on the last bits of an eigenvalue, which differ between machines.
    return max(1, int(float(f"{GROWTH / math.log(factor):.9g}"))) if factor > 1.0 else None
