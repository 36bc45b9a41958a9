"""The Gaussian laws of the steps of a diffusion, shared by all its paths on one sensing grid.

The sensing grid is the times k h at which increments of sensors are drawn. A step of it is
described by 3 n numbers: the state at its end and the two moments ``int x dt`` (*plain*) and
``int x P_1 dt`` (*tilted*) over it, with the Legendre polynomial P_1, -1 .. 1 over the step. A
*piece* is a step, or a part of one that was cut at a time at which the state is needed.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.core.instants import STANDARD, TimeGrid
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES
from netkf.linalg.legendre import forward_coefficients
from netkf.linalg.portable import gauss_legendre, product, pseudo_inverse, symmetric_root
from netkf.linalg.series import exponential_terms, polynomial, with_reach
from netkf.linalg.small import matmul
from netkf.linalg.spectra import balanced_norm
from netkf.plants.transitions import noise_factors

MAX_LAWS = 256  # cached laws of states inside a step
MAX_GRIDS = 256  # cached parts of the sensing grid
_NODES, _WEIGHTS = gauss_legendre(20)  # on [0, 1]


class GridLaws:
    """The laws of all paths of ``dx = A x dt + B dw`` on the sensing grid of one ``period`` (s);
    ``A`` (n, n), ``B`` (n, m). Its points are instants of ``time_grid``.

    to_end, to_moments  power series in the gap of the response to the state at the start of a
                        step, of its end (terms, n n + 1) and moments (terms, 2 n n + 1); the last
                        column has the longest gap (s) for which the terms so far suffice
    response            (3, n, n) that response over one period
    noise_factor        (3 n, 3 n) lower triangular root of the covariance of end and moments, given
                        the state at the start
    course_table        (D, 2 n, W) coefficients of the integrals of x inside a piece, for
                        ``paths.fill_course``

    Laws of states inside a step are computed on demand and cached.
    """

    def __init__(
        self, A: FloatArray, B: FloatArray, period: float, time_grid: TimeGrid = STANDARD
    ) -> None:
        self.n, self.period, self.time_grid = len(A), period, time_grid
        self.A, self.B = A, B
        self.to_end, self.to_moments = _response_series(A, period)
        self.course_table = course_table(self.to_end, self.n, period)
        self.response = self.responses(period)
        noise = np.empty((3 * self.n, len(_NODES) * B.shape[1]))
        self._fill_impulses(noise, 0, period, _NODES * period, _WEIGHTS * period)
        self.noise_factor = noise_factors(noise[None])[0][0]
        self._conditional_laws: dict[tuple[float, float], tuple[FloatArray, FloatArray]] = {}
        self._cut_laws: dict[tuple[float, float], tuple[FloatArray, FloatArray, FloatArray]] = {}
        self._grids: dict[tuple[int, int], FloatArray] = {}

    def grid(self, first: int, count: int) -> FloatArray:
        """Return the points ``first`` .. ``first + count - 1`` of the grid in seconds, (count,)."""
        times = self._grids.get((first, count))
        if times is None:
            times = self.time_grid.snap(self.period * np.arange(first, first + count))
            if len(self._grids) < MAX_GRIDS:
                self._grids[first, count] = times
        return times

    def responses(self, gap: float) -> FloatArray:
        """Return the maps (3, n, n) from a state to that ``gap`` seconds later and both moments."""
        values = [polynomial(series, gap) for series in (self.to_end, self.to_moments)]
        return np.concatenate(values).reshape(3, self.n, self.n)

    def _fill_impulses(
        self, out: FloatArray, row: int, end: float, instants: FloatArray, weights: FloatArray
    ) -> None:
        tables = self.to_end, self.to_moments, self.B
        fill_impulses(out, row, *tables, end, instants, weights)

    def conditional_law(self, length: float, before: float) -> tuple[FloatArray, FloatArray]:
        """Return the gain of the conditional mean and a root of the conditional covariance, both (3
        n, 3 n), of state and moments ``before`` seconds after the start of a piece, given its end
        and moments over ``length`` seconds.
        """
        key = self.time_grid.instant(length), self.time_grid.instant(before)
        law = self._conditional_laws.get(key)
        if law is None:
            if len(self._conditional_laws) >= MAX_LAWS:
                self._conditional_laws.clear()
            law = self._conditional_laws[key] = self._conditional(*key)
        return law

    def cut_law(self, length: float, before: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the ``conditional_law`` of a cut, and ``responses`` (3, 3, n, n) over the whole
        piece and the parts before and after it.
        """
        # The responses are those of the very gaps, not of their instants.
        law = self._cut_laws.get((length, before))
        if law is None:
            responses = [self.responses(gap) for gap in (length, before, length - before)]
            law = *self.conditional_law(length, before), np.stack(responses)
            if len(self._cut_laws) < MAX_LAWS:
                self._cut_laws[length, before] = law
        return law

    def _conditional(self, length: float, before: float) -> tuple[FloatArray, FloatArray]:
        size, after = 3 * self.n, length - before
        instants = np.concatenate([_NODES * before, before + _NODES * after])
        weights = np.concatenate([_WEIGHTS * before, _WEIGHTS * after])
        factor = np.empty((2 * size, len(instants) * self.B.shape[1]))
        self._fill_impulses(factor, 0, length, instants, weights)
        self._fill_impulses(factor, size, before, instants, weights)
        # Joint covariance C of the whole piece (first) and of the part before the cut (second).
        # The second given the first: K = C_21 C_11^+, covariance C_22 - K C_12.
        C = matmul(factor, np.ascontiguousarray(factor.T))
        C_11, C_22, C_21 = C[:size, :size], C[size:, size:], C[size:, :size]
        gain = product(C_21, pseudo_inverse(C_11, 1e-13))
        return gain, symmetric_root(symmetric(C_22 - product(gain, C_21.T)))


@kernel(allocates=True)
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
    """Write the response of x(end) and of the moments over [0, end] to an impulse of the noise at
    each of K ``instants`` (K,), in seconds, times the root of its ``weights`` (K,), into 3 n rows
    of ``out`` (., K m) from ``row`` on. By Gauss quadrature ``out out'`` is the covariance.
    """
    n, m = B.shape
    for k in range(len(instants)):
        # An impulse is a state B dw at its instant: its response over the remaining time is that
        # to a state at the start of an interval of ``remaining`` seconds.
        remaining = max(end - instants[k], 0.0)
        Phi, responses = polynomial(to_end, remaining), polynomial(to_moments, remaining)
        # P_1 of [0, end] is (1 - share) + share P_1 of the remaining interval.
        share = remaining / end if remaining > 0.0 else 0.0
        scale = math.sqrt(weights[k]) if remaining > 0.0 else 0.0
        for i in range(n):
            for j in range(m):
                last = plain = tilted = 0.0
                for c in range(n):
                    # Plain and tilted moment over the remaining interval.
                    mean, slope = responses[i * n + c], responses[(n + i) * n + c]
                    last += Phi[i * n + c] * B[c, j]
                    plain += mean * B[c, j]
                    tilted += ((1.0 - share) * mean + share * slope) * B[c, j]
                out[row + i, k * m + j] = last * scale
                out[row + n + i, k * m + j] = plain * scale
                out[row + 2 * n + i, k * m + j] = tilted * scale


def _response_series(A: FloatArray, longest: float) -> tuple[FloatArray, FloatArray]:
    """Return power series in the gap of ``exp(A g)`` and of its two moments over the gap."""
    n, terms = len(A), exponential_terms(balanced_norm(A) * longest) + len(A)
    exponential = [np.eye(n)]
    for k in range(1, terms):
        exponential.append(product(exponential[-1], A) / k)
    # int_0^g (A s)^k / k! P_j ds = f_jk A^k g^(k + 1) / k!, with f = forward_coefficients(terms): a
    # moment, an integral over the gap, has one power of g more than the exponential.
    end, moments = np.stack(exponential), np.zeros((terms + 1, 2, n, n))
    moments[1:] = forward_coefficients(terms).T[:, :, None, None] * end[:, None]
    to_end, to_moments = (
        with_reach(series.reshape(len(series), -1), longest) for series in (end, moments)
    )
    return to_end, to_moments


def course_width(n: int) -> int:
    """Return the number of columns W of ``course_table``: 2 n, rounded up to whole lanes."""
    return -(-2 * n // LANES) * LANES


def course_table(to_end: FloatArray, n: int, longest: float) -> FloatArray:
    """Return the table (D, 2 n, W) from which ``paths.fill_course`` computes the coefficients
    (D, W) of the course of x over a piece of at most ``longest`` seconds: the integrals of x and of
    x u from its start up to u, the share of the piece that has passed, as polynomials in u.

    Rows 0 .. n - 1 are the factors of the state at the start, to be scaled by powers of the length
    of the piece; the other n those of the coefficients of the cubic. ``to_end`` (terms, n n + 1) is
    the power series of exp(A g) of GridLaws.
    """
    # Later terms are below rounding, see linalg/series.
    needed = int(np.searchsorted(to_end[:-1, -1], longest)) + 1
    terms = max(needed, 4)  # a cubic has 4
    table = np.zeros((terms, 2 * n, course_width(n)))
    # int_0^u v^d dv = u^(d+1) / (d + 1) and int_0^u v v^d dv = u^(d+2) / (d + 2).
    of_x, of_xu = 1.0 / np.arange(1, terms + 1), 1.0 / np.arange(2, terms + 2)
    response = np.zeros((terms, n, n))
    response[:needed] = to_end[:needed, :-1].reshape(needed, n, n)
    table[:, :n, :n] = np.swapaxes(response, 1, 2) * of_x[:, None, None]
    table[:, :n, n : 2 * n] = np.swapaxes(response, 1, 2) * of_xu[:, None, None]
    # The cubic has no term of degree 0.
    for d in range(1, 4):
        table[d, n:, :n], table[d, n:, n : 2 * n] = of_x[d] * np.eye(n), of_xu[d] * np.eye(n)
    return table
