"""The laws of the steps of a diffusion, which all its paths on one sensing grid share."""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES
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
from netkf.linalg.small import matmul

MAX_LAWS = 256  # laws of states inside a step that are kept
MAX_GRIDS = 256  # parts of the sensing grid that are kept
DEPENDENT = 1e-9  # share of a row that is not rounding
_NODES, _WEIGHTS = gauss_legendre(20)


def grid_time(period: float, k: int) -> float:
    """Return a time of the grid, rounded so that lattices of other periods meet it."""
    return float(round(k * period, 12))


class GridLaws:
    """The laws of all paths of ``dx = A x dt + B dw`` on the sensing grid of one ``period``.

    Laws of states inside a step are computed on demand and kept.
    """

    def __init__(self, A: FloatArray, B: FloatArray, period: float) -> None:
        self.n, self.period = len(A), period
        self.A, self.B = A, B
        self.to_end, self.to_moments = _response_series(A, period)
        self.course_table = course_table(self.to_end, self.n, period)
        self.response = self.responses(period)
        self.noise_factor = _nonnegative_factor(self._impulse_responses(period))
        self._conditional_laws: dict[tuple[float, float], tuple[FloatArray, FloatArray]] = {}
        self._grids: dict[tuple[int, int], FloatArray] = {}

    def grid(self, first: int, count: int) -> FloatArray:
        """Return points (count,) of the sensing grid from number ``first`` on."""
        known = self._grids.get((first, count))
        if known is None:
            known = np.array([grid_time(self.period, first + k) for k in range(count)])
            if len(self._grids) < MAX_GRIDS:
                self._grids[first, count] = known
        return known

    def responses(self, gap: float) -> FloatArray:
        """Return the matrices (3, n, n) that map a state to the state ``gap`` seconds later and to
        the two moments.
        """
        values = [polynomial(series, gap) for series in (self.to_end, self.to_moments)]
        return np.concatenate(values).reshape(3, self.n, self.n)

    def _impulse_responses(self, gap: float) -> FloatArray:
        """Return the responses (3 n, 20 m) of the end and the moments to noise at the quadrature
        nodes.
        """
        out = np.empty((3 * self.n, len(_NODES) * self.B.shape[1]))
        self._fill_impulses(out, 0, gap, _NODES * gap, _WEIGHTS * gap)
        return out

    def _fill_impulses(
        self, out: FloatArray, row: int, end: float, instants: FloatArray, weights: FloatArray
    ) -> None:
        """Write the responses to impulses of noise at ``instants`` into ``out`` from ``row`` on, as
        ``fill_impulses``.
        """
        tables = self.to_end, self.to_moments, self.B
        fill_impulses(out, row, *tables, end, instants, weights)

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
        """Return gain and root (3 n, 3 n) of the law at a cut, ``left`` seconds after the start of
        a piece of ``length`` seconds, given the end and moments of the piece.
        """
        size = 3 * self.n
        instants = np.concatenate([_NODES * left, left + _NODES * (length - left)])
        weights = np.concatenate([_WEIGHTS * left, _WEIGHTS * (length - left)])
        factor = np.empty((2 * size, len(instants) * self.B.shape[1]))
        self._fill_impulses(factor, 0, length, instants, weights)
        self._fill_impulses(factor, size, left, instants, weights)
        C = matmul(factor, np.ascontiguousarray(factor.T))
        known, asked, cross = C[:size, :size], C[size:, size:], C[size:, :size]
        gain = product(cross, pseudo_inverse(known, 1e-13))
        return gain, symmetric_root(symmetric(asked - product(gain, cross.T)))


@kernel(allocates=True, compact=True)
def fill_impulses(
    out: FloatArray,
    row: int,
    to_end: FloatArray,
    to_moments: FloatArray,
    B: FloatArray,
    end: float,
    instants: FloatArray,
    weights: FloatArray,
) -> None:
    """Write what noise of unit density at each of K ``instants``, times the root of its weight,
    adds to x(end) and to the moments over [0, end] into 3 n rows of ``out`` (., K m) from ``row``
    on. Noise after ``end`` adds nothing. ``B`` is (n, m), the series are those of GridLaws.
    """
    n, m = B.shape
    for k in range(len(instants)):
        # In an interval that begins with the noise it is a state, B dw.
        rest = max(end - instants[k], 0.0)
        moved, means = polynomial(to_end, rest), polynomial(to_moments, rest)
        # P_1 of the whole interval, which may be a point, is (1 - share) + share P_1 of the rest.
        share = rest / end if rest > 0.0 else 0.0
        scale = math.sqrt(weights[k]) if rest > 0.0 else 0.0
        for i in range(n):
            for j in range(m):
                last = plain = tilted = 0.0
                for c in range(n):
                    mean, slope = means[i * n + c], means[(n + i) * n + c]
                    last += moved[i * n + c] * B[c, j]
                    plain += mean * B[c, j]
                    tilted += ((1.0 - share) * mean + share * slope) * B[c, j]
                out[row + i, k * m + j] = last * scale
                out[row + n + i, k * m + j] = plain * scale
                out[row + 2 * n + i, k * m + j] = tilted * scale


def _response_series(A: FloatArray, longest: float) -> tuple[FloatArray, FloatArray]:
    """Return power series in the gap of ``exp(A g)`` (terms, n n + 1) and of its two moments
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


def course_width(n: int) -> int:
    """Return the number of columns of ``course_table``: whole lanes for two integrals of
    n states.
    """
    return -(-2 * n // LANES) * LANES


def course_table(to_end: FloatArray, n: int, longest: float) -> FloatArray:
    """Return the table (D, 2 n, W) of what ``paths.fill_course`` multiplies with the state at the
    start of a piece of at most ``longest`` seconds, by powers of its length (the first n rows),
    and with the coefficients of its cubic. Columns are those of the course.
    """
    # Terms beyond are below rounding, see linalg/series.
    needed = int(np.searchsorted(to_end[:-1, -1], longest)) + 1
    terms = max(needed, 4)  # those of a cubic
    table = np.zeros((terms, 2 * n, course_width(n)))
    # Integrals of u^d and of u u^d over the share u of a piece.
    plain, tilted = 1.0 / np.arange(1, terms + 1), 1.0 / np.arange(2, terms + 2)
    response = np.zeros((terms, n, n))
    response[:needed] = to_end[:needed, :-1].reshape(needed, n, n)
    table[:, :n, :n] = np.swapaxes(response, 1, 2) * plain[:, None, None]
    table[:, :n, n : 2 * n] = np.swapaxes(response, 1, 2) * tilted[:, None, None]
    # The cubic has no term of degree 0.
    for d in range(1, 4):
        table[d, n:, :n], table[d, n:, n : 2 * n] = plain[d] * np.eye(n), tilted[d] * np.eye(n)
    return table


def _nonnegative_factor(noise: FloatArray) -> FloatArray:
    """Return the lower triangular S with ``S S' = noise noise'`` and no entry below zero on its
    diagonal, whose column is zero where a row of ``noise`` depends on those before it.
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
