"""Exact discretisation of ``dx = A x dt + B dw`` over gaps of any length."""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply, gauss_legendre, norm, product

UNIT_SIZE = 0.5  # largest norm of A times a gap for which one power series is used
DEPENDENT = 1e-9  # share of a row's norm below which what is left of it counts as rounding
KNOWN = 32
"""Sets of gaps whose laws are kept."""
_NODES, _WEIGHTS = gauss_legendre(10)  # exact to rounding for gaps of that size


class Transitions:
    """``x(t + g) = Phi x(t) + L z`` for ``A`` (n, n), ``B`` (n, m): z is standard normal and
    ``L L' = int_0^g e^{A s} B B' e^{A' s} ds``.

    L is lower triangular with a diagonal that is not negative, and column k is zero where
    component k depends on those before it. Short gaps use a power series and Gauss quadrature,
    which keep the relative accuracy of entries of very different size (a chain of integrators over
    1e-9 s); longer ones are doubled from there. Every law is the same to the last bit whichever
    others are worked out with it.
    """

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        self.n = len(A)
        self._norm = float(np.abs(A).sum(axis=0).max())
        powers = [np.eye(self.n)]
        last, k = 1.0, 1
        while last > 1e-19:
            last *= UNIT_SIZE / k
            powers.append(product(powers[-1], A) / k)
            k += 1
        self._series = np.stack(powers)
        self._response = product(self._series, B)
        # Runs that are sampled at the same times ask for the same gaps again.
        self._known: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def laws(self, gaps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``Phi`` and ``L``, both (K, n, n), of K gaps in seconds, none below 0."""
        distinct, index = np.unique(gaps, return_inverse=True)
        key = distinct.tobytes()
        if key not in self._known:
            if len(self._known) >= KNOWN:
                self._known.clear()
            self._known[key] = self._distinct_laws(distinct)
        Phi, L = self._known[key]
        return Phi[index], L[index]

    def _distinct_laws(self, distinct: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return transitions and noise factors (K, n, n) of K distinct gaps, by doubling from at
        most one unit.
        """
        doublings = self._doublings(distinct)
        units = np.ldexp(distinct, -doublings)
        Phi, L = self._unit_transition(units), noise_factors(self._unit_noise(units))[0]
        with np.errstate(over="ignore", invalid="ignore"):  # unstable over a very long gap
            for level in range(int(doublings.max(initial=0))):
                k = np.flatnonzero(doublings > level)
                L[k] = noise_factors(np.concatenate([L[k], product(Phi[k], L[k])], axis=2))[0]
                Phi[k] = product(Phi[k], Phi[k])
        return Phi, L

    def transitions(self, gaps: FloatArray) -> FloatArray:
        """Return ``Phi = e^{A g}`` (K, n, n) alone."""
        distinct, index = np.unique(gaps, return_inverse=True)
        doublings = self._doublings(distinct)
        Phi = self._unit_transition(np.ldexp(distinct, -doublings))
        with np.errstate(over="ignore", invalid="ignore"):
            for level in range(int(doublings.max(initial=0))):
                k = np.flatnonzero(doublings > level)
                Phi[k] = product(Phi[k], Phi[k])
        return np.asarray(Phi[index])

    def bridges(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Return rows D (K, n, 2 n) with ``z = D [z1; z2]``: how the noise of a whole gap is made
        of that of its two parts of ``before`` and ``after`` seconds (K,). Rows are orthonormal or
        zero.
        """
        pairs, index = np.unique(np.stack([before, after]), axis=1, return_inverse=True)
        L1, (Phi2, L2) = self.laws(pairs[0])[1], self.laws(pairs[1])
        directions = noise_factors(np.concatenate([product(Phi2, L1), L2], axis=2))[1]
        return np.asarray(directions[index.reshape(-1)])

    def _doublings(self, gaps: FloatArray) -> np.ndarray:
        """Return how often (K,) each gap is halved before the power series is used."""
        sizes = np.maximum(gaps * (self._norm / UNIT_SIZE), 1.0)
        return np.ceil(np.log2(sizes)).astype(np.int64)

    def _unit_transition(self, gaps: FloatArray) -> FloatArray:
        """Return exp(A gap) (K, n, n) of gaps within one unit, by its power series."""
        n, terms = self.n, len(self._series)
        powers = _powers(gaps, terms)
        return product(powers, self._series.reshape(terms, n * n)).reshape(-1, n, n)

    def _unit_noise(self, gaps: FloatArray) -> FloatArray:
        """Return a factor (K, n, 10 m) of the noise, ``e^{A s} B sqrt(weight)`` at the nodes s."""
        terms, n, m = self._response.shape
        powers = _powers(gaps[:, None] * _NODES, terms)
        response = product(powers, self._response.reshape(terms, n * m))
        response = response.reshape(-1, len(_NODES), n, m)
        response *= np.sqrt(gaps[:, None] * _WEIGHTS)[:, :, None, None]
        return np.asarray(np.moveaxis(response, 1, 2).reshape(-1, n, len(_NODES) * m))


def noise_factors(noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lower triangular ``S`` (K, n, n) and rows ``D`` (K, n, c) with ``S D = noise``
    (K, n, c).

    The rows of D are orthonormal, or zero (as is the column of S) where a row of ``noise``
    depends on those before it. Modified Gram-Schmidt, twice (Kahan and Parlett): unlike
    reflections it gives a dependent row no direction that is made of rounding.
    """
    count, n, columns = noise.shape
    S, D = np.zeros((count, n, n)), np.zeros((count, n, columns))
    for k in range(n):
        row = noise[:, k]
        scale = np.abs(row).max(axis=1, initial=0.0)
        scale[scale == 0.0] = 1.0  # rows of any size, without underflow of their squares
        rest = row / scale[:, None]
        length = whole = norm(rest)
        for _ in range(2):
            along = apply(D[:, :k], rest)
            S[:, k, :k] += along * scale[:, None]
            rest = rest - apply(np.swapaxes(D[:, :k], 1, 2), along)
        length = norm(rest)
        free = length > DEPENDENT * whole
        S[free, k, k] = (length * scale)[free]
        D[free, k] = rest[free] / length[free, None]
    return S, D


def _powers(gaps: FloatArray, terms: int) -> FloatArray:
    """Return (K, c, terms): the powers 0 .. terms - 1 of gaps (K, c) or (K,), where c is 1."""
    # Products, since the last bit of a power depends on the CPU.
    gaps = gaps if gaps.ndim > 1 else gaps[:, None]
    factors = np.ones((*gaps.shape, terms))
    factors[:, :, 1:] = gaps[:, :, None]
    return np.asarray(np.multiply.accumulate(factors, axis=2))


GROWTH = 10.0 * math.log(2.0)
"""Logarithm of how much an unstable state may grow between two frames."""


def frame_period(A: FloatArray) -> float | None:
    """Return the longest time (seconds) between two frames of ``dx = A x dt``: growth e^{a g} of at
    most 2^10 for the spectral abscissa a of ``A`` (n, n); None for a plant that is not unstable.
    """
    abscissa = float(np.linalg.eigvals(A).real.max())
    return _round_seconds(GROWTH / abscissa) if abscissa > 0.0 else None


def _round_seconds(seconds: float) -> float:
    """Return a time rounded to 9 significant digits."""
    # Frames are to begin at the same times whatever the last bits of an eigenvalue.
    return float(f"{seconds:.9g}")


def frame_slots(F: FloatArray) -> int | None:
    """Return the slots between two frames of ``x[k+1] = F x[k]``: growth of at most 2^10 for the
    spectral radius of ``F`` (n, n); None for a plant that is not unstable.
    """
    radius = float(np.abs(np.linalg.eigvals(F)).max())
    return max(1, int(_round_seconds(GROWTH / math.log(radius)))) if radius > 1.0 else None
