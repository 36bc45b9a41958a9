"""The laws of the steps of a diffusion, which all its paths on one sensing grid share."""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.legendre import forward_coefficients
from netkf.linalg.portable import (
    apply,
    gauss_legendre,
    norm,
    product,
    pseudo_inverse,
    symmetric_root,
)
from netkf.linalg.series import polynomial, with_reach

MAX_LAWS = 256  # laws of states inside a step that are kept
MAX_GRIDS = 256  # parts of the sensing grid that are kept
DEPENDENT = 1e-9  # share of a row that is not rounding
_NODES, _WEIGHTS = gauss_legendre(20)


def grid_time(period: float, k: int) -> float:
    """Rounded so that lattices of other periods meet it."""
    return float(round(k * period, 12))


class GridLaws:
    """The laws of all paths of ``dx = A x dt + B dw`` on the sensing grid of one ``period``.

    Laws of states inside a step are computed on demand and kept.
    """

    def __init__(self, A: FloatArray, B: FloatArray, period: float) -> None:
        self.n, self.period = len(A), period
        self.A, self.B = A, B
        self.to_end, self.to_moments = _response_series(A, period)
        self.response = self.responses(period)
        self.noise_factor = _factor(self._noise(period))
        self._conditional_laws: dict[tuple[float, float], tuple[FloatArray, FloatArray]] = {}
        self._grids: dict[tuple[int, int], FloatArray] = {}

    def grid(self, first: int, count: int) -> FloatArray:
        """(count,) points of the sensing grid from number ``first`` on."""
        known = self._grids.get((first, count))
        if known is None:
            known = np.array([grid_time(self.period, first + k) for k in range(count)])
            if len(self._grids) < MAX_GRIDS:
                self._grids[first, count] = known
        return known

    def responses(self, gap: float) -> FloatArray:
        """(3, n, n): what a state adds to the state ``gap`` later and to the two moments."""
        values = [polynomial(series, gap) for series in (self.to_end, self.to_moments)]
        return np.concatenate(values).reshape(3, self.n, self.n)

    def _noise(self, gap: float) -> FloatArray:
        """(3 n, 20 m): responses of the end and the moments to noise at the quadrature nodes."""
        columns = [
            self._impulse(gap, 0.0, gap, s) * np.sqrt(w * gap)
            for s, w in zip(_NODES * gap, _WEIGHTS, strict=True)
        ]
        return np.concatenate(columns, axis=1)

    def _impulse(self, gap: float, start: float, end: float, s: float) -> FloatArray:
        """(3 n, m): what dw at time s adds to x(end) and to the moments over [start, end] of
        length ``gap``.
        """
        if s >= end:
            return np.zeros((3 * self.n, self.B.shape[1]))
        since = max(s, start)
        entry = product(self.responses(since - s)[0], self.B)
        rest = end - since
        to_end, plain, tilted = self.responses(rest)
        share = rest / gap  # P_1 of the whole interval is (1 - share) + share P_1 of the rest
        response = np.concatenate([to_end, plain, (1.0 - share) * plain + share * tilted])
        return product(response, entry)

    def conditional_law(self, length: float, left: float) -> tuple[FloatArray, FloatArray]:
        """Return the conditional law of state and moments at ``left`` seconds of a step.

        It is given by those of the whole step of ``length`` seconds; the result is the gain and a
        square root of the covariance, both (3 n, 3 n).
        """
        key = round(length, 12), round(left, 12)
        law = self._conditional_laws.get(key)
        if law is None:
            if len(self._conditional_laws) >= MAX_LAWS:
                self._conditional_laws.clear()
            law = self._conditional_laws[key] = self._conditional(*key)
        return law

    def _conditional(self, length: float, left: float) -> tuple[FloatArray, FloatArray]:
        n = self.n
        places = np.concatenate([_NODES * left, left + _NODES * (length - left)])
        weights = np.concatenate([_WEIGHTS * left, _WEIGHTS * (length - left)])
        columns = [
            np.concatenate([self._impulse(length, 0, length, s), self._impulse(left, 0, left, s)])
            * np.sqrt(w)
            for s, w in zip(places, weights, strict=True)
        ]
        factor = np.concatenate(columns, axis=1)
        C = product(factor, factor.T)
        known, asked, cross = C[: 3 * n, : 3 * n], C[3 * n :, 3 * n :], C[3 * n :, : 3 * n]
        gain = product(cross, pseudo_inverse(known, 1e-13))
        return gain, symmetric_root(symmetric(asked - product(gain, cross.T)))


def _response_series(A: FloatArray, longest: float) -> tuple[FloatArray, FloatArray]:
    """Power series in the gap of ``exp(A g)`` (terms, n n + 1) and of its two moments
    (terms, 2 n n + 1), with their reach, see linalg/series.
    """
    n, size = len(A), float(np.abs(A).sum(axis=0).max()) * longest
    terms, last = 1, 1.0
    while last > 1e-18 or terms < 8:
        last *= size / terms
        terms += 1
    exponential = [np.eye(n)]
    for k in range(1, terms):
        exponential.append(product(exponential[-1], A) / k)
    end, moments = np.stack(exponential), np.zeros((terms + 1, 2, n, n))
    moments[1:] = forward_coefficients(terms).T[:, :, None, None] * end[:, None]
    to_end, to_moments = (
        with_reach(series.reshape(len(series), -1), longest) for series in (end, moments)
    )
    return to_end, to_moments


def _factor(noise: FloatArray) -> FloatArray:
    """The lower triangular S with ``S S' = noise noise'`` and no entry below zero on its diagonal,
    whose column is zero where a row of ``noise`` depends on those before it.
    """
    # Gram and Schmidt, twice, which is enough (Kahan and Parlett). Householder's reflections would
    # give a dependent row a direction of its own, made of rounding, and later rows a share in it.
    size = len(noise)
    S, directions = np.zeros((size, size)), np.zeros_like(noise)
    for k, row in enumerate(noise):
        rest = row.copy()
        for _ in range(2):
            along = apply(directions[:k], rest)
            S[k, :k] += along
            rest -= apply(directions[:k].T, along)
        length = float(norm(rest))
        if length > DEPENDENT * float(norm(row)):
            S[k, k] = length
            directions[k] = rest / length
    return S
