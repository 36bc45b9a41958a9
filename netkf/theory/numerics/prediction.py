"""Propagation of the state, of errors and of covariances between events of nodes that read
increments.

With increments each error has a transition of its own, computed by :class:`ErrorFlow`. Let M be the
Hamiltonian of the Riccati equation, ``E(s) = exp(M s)`` and ``[X; Y](s) = E(s) [I; P]``. Over a gap
g the error's transition from s is ``Phi(g, s) = X(g)^-T X(s)^T``, and that of the filter's gain L
``Phi(g, s) L(s) = X(g)^-T Y(s)^T H' R^-1``. Both are entire functions of s, which eight
Gauss-Legendre nodes integrate to machine precision over steps of |M| g <= 1/2.

Covariances are passed as roots ``P = S S'``, since ``(I + P G)^-1`` loses all digits if the
eigenvalues of P differ by orders of magnitude. With ``G_g = Gamma' Gamma`` from the same nodes and
the QR factorisation ``[I; Gamma S] = Z U`` it is ``I - (S Z_1)(Z_2' Gamma)``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.theory.numerics.roots import discretise, flow_estimates, triangular

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


def triangular_root(factor: FloatArray) -> FloatArray:
    """Return the lower triangular S (..., n, n) with ``S S' = factor factor'``, for a ``factor``
    (..., n, k) with any number k of columns.
    """
    n, k = factor.shape[-2:]
    if k == 0:
        return np.zeros((*factor.shape[:-1], n))
    if k < n:
        widths = [(0, 0)] * (factor.ndim - 1) + [(0, n - k)]
        factor = np.pad(factor, widths)
    if factor.ndim == 2:
        return triangular(factor)
    # factor' = Z U, so factor factor' = U' U: U' is the root, with arbitrary signs of its columns.
    return np.swapaxes(np.linalg.qr(np.swapaxes(factor, -1, -2), mode="r"), -1, -2)


class LinearSDE:
    """The equation dz = A z dt + B dw for z (d,), discretised over any gap by doubling; A is
    (d, d), B (d, m).
    """

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        """Take A (d, d), per second, and B (d, m) of m noises of variance 1 per second."""
        self._exp, self._B = ShortExponential(A), as_kernel_array(B)

    def discretise(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """Return ``exp(A gap)`` (d, d) and a root (d, d) of the covariance that the noise adds."""
        result: tuple[FloatArray, FloatArray] = discretise(
            self._exp.terms, self._exp.unit, self._B, gap, (NODES, WEIGHTS)
        )
        return result


class FlowTransition(NamedTuple):
    """Transition of K errors over a gap with continuous readings.

    transition : (K, n, n) of each error
    follow     : (K, n, n) factor of the state
    response   : (K, n, k) factor of the plant's k inputs
    reading_noise : (K, n, q) factor of q noises of the filter's readings, q at most n
    root       : (K, n, n) root of P at the end
    """

    transition: FloatArray
    follow: FloatArray
    response: FloatArray
    reading_noise: FloatArray
    root: FloatArray


class ErrorFlow:
    """Errors of filters with the same continuous readings H (p, n); p = 0 for filters without any.

    ``R`` (p, p) is the noise covariance that the filters assume, ``noise`` (p, p) a root of the
    true one; ``A`` (n, n), ``B`` (n, m) as they assume them, ``plant`` the true pair. Transitions
    are over at most ``unit`` seconds.
    """

    def __init__(
        self,
        A: FloatArray,
        B: FloatArray,
        H: FloatArray,
        R: FloatArray,
        noise: FloatArray,
        plant: tuple[FloatArray, FloatArray],
    ) -> None:
        """Take A (n, n), B (n, m), H (p, n) and R (p, p) as the filters assume them, a root
        ``noise`` (p, p) of the true R, and the true pair A, B of the ``plant``.
        """
        n = len(A)
        self._n, self._B, self._plant = n, B, plant
        self._root_R = np.linalg.cholesky(R)
        self._whitened = np.linalg.solve(self._root_R, H)
        self._weight = np.linalg.solve(R, H).T
        self._noise = self._weight @ noise
        self.observes = len(H) > 0
        # The Hamiltonian of dP = A P + P A' + Q - P G P, scaled to balance its off-diagonal blocks.
        G, Q = self._whitened.T @ self._whitened, B @ B.T
        self._scale = _balancing_scale(A, Q, G)
        M = np.block([[-A.T, G * self._scale], [Q / self._scale, A]])
        self._exp = ShortExponential(M)
        gain = self._weight @ self._root_R
        self._tables = (
            as_kernel_array(self._whitened),
            as_kernel_array(gain),
            as_kernel_array(self._noise),
            as_kernel_array(B),
            as_kernel_array(plant[1]),
        )
        self._difference = plant[0] - A
        self._state = ShortExponential(plant[0]) if self._difference.any() else None
        self.unit = self._exp.unit
        if self._state is not None:
            self.unit = min(self.unit, self._state.unit)

    def _exponential_blocks(
        self, times: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the transposes (K, n, n) of the blocks of exp(M s) at K ``times`` (s)."""
        # M = [-A' G; Q A] is the Hamiltonian of dP/dt = A P + P A' + Q - P G P, G = H' R^-1 H.
        n, c = self._n, self._scale
        E = np.swapaxes(self._exp(times), 1, 2)
        return E[:, :n, :n], E[:, n:, :n] / c, E[:, :n, n:] * c, E[:, n:, n:]

    def transition(self, roots: FloatArray, gap: float) -> FlowTransition:
        """Return how the errors and roots of P of K filters, which have the ``roots`` (K, n, n) at
        its start, change over a ``gap`` in seconds, at most ``unit``.

        Let M be the Hamiltonian of the Riccati equation and [X; Y](s) = exp(M s) [I; P]: the
        error's transition from s to the end g is ``Phi(g, s) = X(g)^-T X(s)^T``.
        """
        # The transposed blocks T11 .. T22 of exp(M s), at the quadrature nodes and at the end.
        times, weights = NODES * gap, WEIGHTS * gap
        T11, T12, T21, T22 = self._exponential_blocks(np.append(times, gap))
        F = np.linalg.inv(T11[-1])
        root_weights = np.sqrt(weights)[:, None, None]
        # X(g)^T = (I + P G_g) T11(g), so X(g)^-T = T11^-1 J = F J with J = (I + P G_g)^-1.
        J, C, SZ = self._update_gramian(
            roots, root_weights * (self._whitened @ np.linalg.inv(T11[:-1]))
        )
        FJ, FC = F @ J, F @ C
        phi = FJ[:, None] @ T11[:-1] + FC[:, None] @ T12[:-1]  # Phi(g, s) = X(g)^-T X(s)^T
        response = phi @ self._plant[1]
        follow = np.zeros_like(FJ)
        if self._state is not None:
            states = self._state(times)
            weighted = weights[:, None, None] * phi @ self._difference @ states
            follow = weighted.sum(axis=1)
            response = response + self._response_through_state(FJ, FC, gap)
        # Phi(g, s) L(s) at each node, L the gain of the filter at that time.
        gains = (FJ[:, None] @ T21[:-1] + FC[:, None] @ T22[:-1]) @ self._noise
        reading_noise = _side_by_side(root_weights * gains)
        if reading_noise.shape[2] > self._n:
            reading_noise = triangular_root(reading_noise)
        # P at the end: the start through the closed loop, and the noise on the way.
        root = self._final_root(F, F @ SZ, T11[:-1], T21[:-1], root_weights)
        return FlowTransition(
            FJ, follow, _side_by_side(root_weights * response), reading_noise, root
        )

    def move(
        self, errors: FloatArray, roots: FloatArray, gap: float, columns: tuple[int, int]
    ) -> None:
        """Propagate the forms of K ``errors`` (K, n, C), which do not depend on the state, and the
        ``roots`` (K, n, n) of their P over ``gap`` seconds, at most ``unit``: as
        :meth:`transition`, in compiled code.

        Changes both. ``columns``: the first of the plant's 8 m inputs, and the first of n inputs of
        each error.
        """
        flow_estimates(
            errors,
            roots,
            columns,
            self._tables,
            (self._exp.terms, self._exp.unit, self._scale),
            gap,
            (NODES, WEIGHTS),
        )

    def follow(
        self,
        errors: FloatArray,
        roots: FloatArray,
        state: FloatArray,
        gap: float,
        columns: tuple[int, int],
    ) -> None:
        """Do the same for ``errors`` that depend on the ``state``, whose form (n, C) is that at the
        start of the gap.
        """
        step, (first, own) = self.transition(roots, gap), columns
        width, noises = step.response.shape[2], step.reading_noise.shape[2]
        errors[:] = step.transition @ errors + step.follow @ state
        errors[:, :, first : first + width] += step.response
        for k in range(len(errors)):
            begin = own + k * self._n
            errors[k, :, begin : begin + noises] += step.reading_noise[k]
        roots[:] = step.root

    def _update_gramian(
        self, roots: FloatArray, gamma_rows: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return J = (I + P G)^-1, J P and its root S Z_1, (K, n, n) each."""
        # G = Gamma' Gamma is the information of the gap's readings, P = S S', [I; Gamma S] = Z U.
        n, Gamma = self._n, gamma_rows.reshape(-1, self._n)
        eye = np.broadcast_to(np.eye(n), roots.shape)
        if not len(Gamma):
            return eye, roots @ np.swapaxes(roots, 1, 2), roots
        # [I; Gamma S] = Z U gives U'U = I + S' G S, so that J = (I + P G)^-1 = I - S (U'U)^-1 S' G
        # = I - (S Z_1)(Z_2' Gamma).
        Z, _ = np.linalg.qr(np.concatenate([eye, Gamma @ roots], axis=1))
        SZ = roots @ Z[:, :n]  # Z_1 = U^-1 whatever the signs of U
        J = eye - SZ @ (np.swapaxes(Z[:, n:], 1, 2) @ Gamma)
        return J, SZ @ np.swapaxes(SZ, 1, 2), SZ

    def _final_root(
        self,
        F: FloatArray,
        start_factor: FloatArray,
        T11: FloatArray,
        T21: FloatArray,
        root_weights: FloatArray,
    ) -> FloatArray:
        """Return the roots (K, n, n) of P at the end of the gap."""
        # P(g) = (F S Z_1)(F S Z_1)' plus the solution from P(0) = 0, by quadrature at 8 nodes.
        noise_factors = [_side_by_side((root_weights * (F @ T11 @ self._B))[None])[0]]
        noise_factors.append(
            _side_by_side((root_weights * (F @ T21 @ self._weight @ self._root_R))[None])[0]
        )
        noise_root = triangular_root(np.concatenate(noise_factors, axis=1))
        factor = np.concatenate(
            [start_factor, np.broadcast_to(noise_root, start_factor.shape)], axis=2
        )
        return triangular_root(factor)

    def _response_through_state(self, FJ: FloatArray, FC: FloatArray, gap: float) -> FloatArray:
        """Return the response (K, 8, n, m) of errors to plant noise by way of the state."""
        # The filters' A is not the plant's. Phi(g, s) = FJ T11(s) + FC T12(s) is the transition.
        assert self._state is not None
        responses = []
        for s in NODES * gap:  # noise at s moves the state from s on, and that the errors
            later_times, weights = s + NODES * (gap - s), WEIGHTS * (gap - s)
            T11, T12, _, _ = self._exponential_blocks(later_times)
            phi = FJ[:, None] @ T11 + FC[:, None] @ T12
            states = self._state(later_times - s) @ self._plant[1]
            responses.append((weights[:, None, None] * phi @ self._difference @ states).sum(axis=1))
        return np.stack(responses, axis=1)


class StateFlow:
    """The true state dx = A x dt + B dw over gaps; A is (n, n), B (n, m).

    inputs : 8 m, the m of the noise at each of 8 quadrature nodes (instants of the gap)
    """

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        """Take A (n, n), per second, and B (n, m) of m noises of variance 1 per second."""
        self._exp, self._B = ShortExponential(A), B
        self.inputs = len(NODES) * B.shape[1]

    def __call__(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """Return the state's transition (n, n) and its response (n, 8 m) to the plant's inputs,
        over a ``gap`` in seconds, at most MAX_NORM / |A|.

        The inputs are independent with variance 1, those of one instant side by side, so that
        response times its transpose is the covariance of the noise over the gap.
        """
        E = self._exp(np.append((1.0 - NODES) * gap, gap))
        root_weights = np.sqrt(WEIGHTS * gap)[:, None, None]
        return E[-1], _side_by_side((root_weights * (E[:-1] @ self._B))[None])[0]


def _side_by_side(matrices: FloatArray) -> FloatArray:
    """Return (K, n, s m): for each of K, the s ``matrices`` (K, s, n, m) side by side."""
    K, s, n, m = matrices.shape
    return np.ascontiguousarray(matrices.transpose(0, 2, 1, 3)).reshape(K, n, s * m)


def _balancing_scale(A: FloatArray, Q: FloatArray, G: FloatArray) -> float:
    """Return the scale for which the Hamiltonian's blocks Q and G have equal norms."""
    q, g = float(np.abs(Q).max(initial=0.0)), float(np.abs(G).max(initial=0.0))
    # Equal blocks Q / c and G c need c = sqrt(q / g). Without G, c = q makes Q / c of size 1;
    # without Q, c makes G c as large as A.
    if g == 0.0:
        return q or 1.0
    rate = max(float(np.abs(A).max(initial=0.0)), 1e-12)
    return math.sqrt(q / g) if q > 0.0 else rate / g
