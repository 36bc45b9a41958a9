"""Propagation of errors and of the true state between events of nodes that read increments.

Let M be the Hamiltonian of the Riccati equation, ``E(s) = exp(M s)`` and ``[X; Y](s) = E(s) [I;
P]``. Over a gap g the error's transition from s is ``Phi(g, s) = X(g)^-T X(s)^T``, and that of the
filter's gain L ``Phi(g, s) L(s) = X(g)^-T Y(s)^T H' R^-1``. Both are entire functions of s, which
eight Gauss-Legendre nodes integrate to machine precision over steps of |M| g <= 1/2.

Covariances are passed as roots ``P = S S'``, since ``(I + P G)^-1`` loses all digits if the
eigenvalues of P differ by orders of magnitude.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.theory.numerics.roots import flow_estimates

# Eight nodes integrate e^{A s} to rounding within one unit; mapped from [-1, 1] to [0, 1].
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS
MAX_NORM, TERMS = 0.5, 22  # largest |M| s, and terms, of exp(M s); the remainder is 0.5^22 / 22!


class ShortExponential:
    """``exp(M s)`` (d, d) by its Taylor series for 0 <= s <= ``unit`` seconds, at which |M| s =
    MAX_NORM in the 1-norm, for M (d, d) per second.

    terms : (TERMS, d, d) coefficients of the powers of s / unit
    """

    def __init__(self, M: FloatArray) -> None:
        """Compute the terms (TERMS, d, d) of the series of exp(M s) for M (d, d), per second."""
        self.unit = MAX_NORM / max(float(np.abs(M).sum(axis=0).max(initial=0.0)), 1e-300)
        terms = [np.eye(len(M))]
        for k in range(1, TERMS):
            terms.append(terms[-1] @ (M * self.unit) / k)
        self.terms = np.array(terms)

    def __call__(self, times: FloatArray) -> FloatArray:
        """Return exp(M s) (K, d, d) at K ``times`` s in seconds, each at most ``unit``."""
        powers = (np.asarray(times)[:, None] / self.unit) ** np.arange(TERMS)
        return np.asarray(np.tensordot(powers, self.terms, 1))


class ErrorFlow:
    """Errors of filters with the same continuous readings H (p, n); p = 0 for filters without any.

    Transitions are over at most ``unit`` seconds.
    """

    def __init__(
        self,
        A: FloatArray,
        B: FloatArray,
        H: FloatArray,
        R: FloatArray,
        noise: FloatArray,
        plant: FloatArray,
    ) -> None:
        """Take A (n, n), B (n, m), H (p, n) and R (p, p) as the filters assume them, a root
        ``noise`` (p, p) of the true R, and the true B of the ``plant``; A is the true one.
        """
        root_R = np.linalg.cholesky(R)
        whitened, weight = np.linalg.solve(root_R, H), np.linalg.solve(R, H).T
        # The Hamiltonian of dP = A P + P A' + Q - P G P, scaled to balance its off-diagonal blocks.
        G, Q = whitened.T @ whitened, B @ B.T
        scale = _balancing_scale(A, Q, G)
        exponential = ShortExponential(np.block([[-A.T, G * scale], [Q / scale, A]]))
        self.unit = exponential.unit
        tables = (whitened, weight @ root_R, weight @ noise, B, plant)
        self._tables = tuple(as_kernel_array(table) for table in tables)
        self._exponential = (exponential.terms, exponential.unit, scale)

    def move(
        self, errors: FloatArray, roots: FloatArray, gap: float, columns: tuple[int, int]
    ) -> None:
        """Propagate the forms of K ``errors`` (K, n, C) and the ``roots`` (K, n, n) of their P in
        place over ``gap`` seconds, at most ``unit``; ``columns``: the first of the plant's 8 m
        inputs, and the first of n inputs of each error.
        """
        quadrature = (NODES, WEIGHTS)
        flow_estimates(errors, roots, columns, self._tables, self._exponential, gap, quadrature)


class StateFlow:
    """The true state dx = A x dt + B dw over gaps; A is (n, n), B (n, m).

    inputs : 8 m, the m of the noise at each of 8 quadrature nodes (instants of the gap)
    """

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        """Take A (n, n), per second, and B (n, m) of m noises of variance 1 per second."""
        self._exp, self._B = ShortExponential(A), B
        self.inputs = len(NODES) * B.shape[1]

    def __call__(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """Return transition (n, n) and response (n, 8 m) to inputs over a short ``gap`` (s)."""
        E = self._exp(np.append((1.0 - NODES) * gap, gap))
        root_weights = np.sqrt(WEIGHTS * gap)[:, None, None]
        responses = root_weights * (E[:-1] @ self._B)
        return E[-1], responses.transpose(1, 0, 2).reshape(len(self._B), -1)


def _balancing_scale(A: FloatArray, Q: FloatArray, G: FloatArray) -> float:
    """Return the scale for which the Hamiltonian's blocks Q and G have equal norms."""
    q, g = float(np.abs(Q).max(initial=0.0)), float(np.abs(G).max(initial=0.0))
    # Equal blocks Q / c and G c need c = sqrt(q / g). Without G, c = q makes Q / c of size 1;
    # without Q, c makes G c as large as A.
    if g == 0.0:
        return q or 1.0
    rate = max(float(np.abs(A).max(initial=0.0)), 1e-12)
    return math.sqrt(q / g) if q > 0.0 else rate / g
