"""The two moments by which a continuous reading is represented over one interval.

Over ``[a, b]`` of length g a signal z is represented by ``(int P_0 dz, int P_1 dz)`` with the
Legendre polynomials ``P_0 = 1`` and ``P_1(s) = 2 (s - a) / g - 1``. A filter that uses one moment
is second-order accurate in g, one that uses two is fourth-order.
"""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray

MOMENTS = 2


def forward_coefficients(terms: int) -> FloatArray:
    """Return (2, terms) the integrals ``int_0^1 u^k P_j(2 u - 1) du`` of Legendre polynomials, for
    ``exp(M (s - a))`` integrated from a.

    With u = (s - a) / g: ``int exp(M (s - a)) P_j ds`` is the sum over k of row j, entry k, times
    ``M^k g^(k + 1) / k!``.
    """
    k = np.arange(terms)
    # P_0 = 1 and P_1 = 2 u - 1, so the second row is 2 / (k + 2) - 1 / (k + 1).
    return np.stack([1.0 / (k + 1), k / ((k + 1.0) * (k + 2.0))])


def backward_coefficients(terms: int) -> FloatArray:
    """Return (2, terms) the integrals ``int_0^1 u^k P_j(1 - 2 u) du`` of Legendre polynomials, for
    ``exp(-M (b - s))`` integrated from b.

    As ``forward_coefficients``, with u = (b - s) / g and -M.
    """
    # P_1 is odd about the middle: looking back from b changes its sign.
    return np.asarray(forward_coefficients(terms) * np.array([[1.0], [-1.0]]))
