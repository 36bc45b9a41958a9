"""The gains of a Kalman-Bucy filter for the two moments of a reading of an interval [a, b].

A sensor ``dy = H x dt + dv`` with noise of covariance R per second gives a filter of an interval
only its moments ``int P_j dy`` with the Legendre polynomials P_0 and P_1 (``linalg.legendre``). The
filter predicts estimate and P to b (``riccati`` or ``root_flow``), then corrects the estimate.

Exactly, ``xhat(b) = exp(A g) xhat(a) + int k(s) (dy - H xhat_open(s) ds)`` with the weight ``k(s) =
Phi(b, s) P(s) H' R^-1`` and the open-loop prediction ``xhat_open``. Since the Hamiltonian flow is
symplectic, ``k(s) = Y(s)' H' R^-1`` with ``[X; Y](s) = exp(-M (b - s)) [I; P(b)]``: the weight is
*affine in the covariance at the end*. Projecting it on the Legendre polynomials ``P_0, P_1`` of the
interval gives gains ``K_j = U_j(g) + P(b) W_j(g)`` for the two moments of dy, with U and W power
series in g = b - a; the error of the projection has fourth order in g. The estimate enters through
the innovation only, so the error never depends on the state itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.riccati import (
    change_units,
    exponential_series,
    hamiltonian,
    state_units,
)
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.lanes import LANES, aligned
from netkf.linalg.legendre import MOMENTS, backward_coefficients
from netkf.linalg.series import exponential_terms, with_reach
from netkf.linalg.structs import Struct

MAX_INTERVAL = 8.0  # |M| g beyond which two moments do not describe a reading well enough


class GainTable(NamedTuple):
    """Power series in the interval g (seconds) of the gains U + P(b) W, U and W (n, 2p), and of the
    predictor C (2p, n) of the moments, for readings of p rows.

    moments : 2p
    series : (terms, 6 n p + 1), the coefficients of U, W and C by rows, and their reach in the
             last column: the longest interval for which the terms so far suffice, see linalg/series
    """

    moments: int
    series: FloatArray


class Gains(Struct):
    """The gain tables of M models, padded to one size; p rows of readings.

    series : (M, terms, width), coefficients of the power series in the interval of the gains U
             (n, 2 p), W (n, 2 p) and C (2 p, n)
    reach : (M, terms, 1), up to which interval in seconds the terms so far are enough
    moments : (M,), 2 p, the numbers of moments that are read
    """

    series: FloatArray
    reach: FloatArray
    moments: IntArray


def stack_gains(gains: Sequence[GainTable]) -> Gains:
    """Return the tables of M models as one struct."""
    terms, width = np.max([gain.series.shape for gain in gains], axis=0)
    # The padding is never read: the last reach of a table is infinite.
    # A multiple of the lanes, see series.fill_series.
    width = -(-(width - 1) // LANES) * LANES
    series, reach = aligned((len(gains), terms, width)), np.zeros((len(gains), terms, 1))
    for k, gain in enumerate(gains):
        count, entries = len(gain.series), gain.series.shape[1] - 1
        series[k, :count, :entries], reach[k, :count] = gain.series[:, :-1], gain.series[:, -1:]
    moments = np.array([gain.moments for gain in gains], dtype=np.int64)
    return Gains(series=series, reach=reach, moments=moments)


def gain_table(
    A: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray, longest: float
) -> GainTable:
    """Return the table of the gains of a plant with A and Q (n, n) and a sensor with H (p, n) and R
    (p, p) for intervals up to ``longest`` seconds; p may be 0.

    Raises ValueError if that is above :func:`longest_interval`.
    """
    n, p = len(A), len(H)
    if p == 0:
        return GainTable(0, np.zeros((0, 1)))
    # In units in which entries are of about the same size, powers of 2, see root_flow.
    units = state_units(A, Q, H.T @ np.linalg.solve(R, H))
    A, Q, H = change_units(units, A, Q, H)
    # H' R^-1 (n, p).
    HR = np.linalg.solve(R, H).T
    M, scale = hamiltonian(A, Q, HR @ H)
    # The 1-norm of M times g bounds every term of the power series.
    size = float(np.abs(M).sum(axis=0).max()) * longest
    # The tolerance admits an interval that was computed from MAX_INTERVAL itself.
    if size > MAX_INTERVAL * (1.0 + 1e-9):
        raise ValueError(f"an interval of {longest:g} s is too long for the gains of this sensor")
    terms = exponential_terms(size)
    # k(s) looks back from the end b, hence exp(-M (b - s)).
    E = exponential_series(-M, terms)
    c = backward_coefficients(terms)
    # ``(2 j + 1)`` normalises P_j, whose square has the mean 1 / (2 j + 1) over the interval.
    weight = np.array([1.0, 3.0])  # 2 j + 1
    # [X; Y] = E [I; P] and k = Y' H' R^-1: the block of Y that multiplies I gives U, the one that
    # multiplies P gives W. M belongs to P / scale, so only the first of them is scaled back.
    # Indices: moment j, power k of g, states a and b, row p of the reading.
    from_Y = np.einsum("j,jk,kba,bp->kajp", weight, c, E[:, n:, :n] * scale, HR)
    from_P = np.einsum("j,jk,kba,bp->kajp", weight, c, E[:, n:, n:], HR)
    # C = moments of H exp(-A (b - s)): the reading that x(b), taken back without noise, predicts.
    predictor = np.einsum("jk,pa,kab->kjpb", c, H, exponential_series(-A, terms))
    series = np.zeros((terms + 1, 3 * n * MOMENTS * p))
    size_U = n * MOMENTS * p
    series[:-1, :size_U] = from_Y.reshape(terms, -1)
    series[:-1, size_U : 2 * size_U] = from_P.reshape(terms, -1)
    # One power of g more than the gains have: a moment of dy is an integral over the interval,
    # while a gain is a mean.
    series[1:, 2 * size_U :] = predictor.reshape(terms, -1)
    table = with_reach(series, longest)
    of_U = np.repeat(units, MOMENTS * p)
    table[:, :-1] *= np.concatenate([of_U, 1.0 / of_U, np.tile(1.0 / units, MOMENTS * p)])
    return GainTable(MOMENTS * p, table)


def longest_interval(A: FloatArray, Q: FloatArray, G: FloatArray) -> float:
    """Return the longest interval (seconds) whose reading the gains can use, for a plant with A and
    Q (n, n) and a sensor with the information rate ``G = H' R^-1 H`` (n, n).
    """
    units = state_units(A, Q, G)
    A, Q, G = change_units(units, A, Q, G)
    M, _ = hamiltonian(A, Q, G * units[:, None])
    norm = float(np.abs(M).sum(axis=0).max())
    # No dynamics and no information: every interval is short enough.
    return MAX_INTERVAL / norm if norm > 0.0 else math.inf
