"""Second moments of errors with constant gains under Poisson clocks, where messages take d seconds.

A message sent at t - d arrives at t, predicted over d; its error ``m_j(t)`` is that of the
prediction, ``e^{A d} e_j(t - d)`` and the plant's noise of d seconds. Messages arrive as a Poisson
process, and the errors before an arrival do not depend on it: those of the sender are older than
its tick, and nothing else of that tick has arrived. So jumps are a mean drift and white noise,

    dE = (B E + G m) dt + dxi,    E[dxi dxi'] = Phi dt,    Phi = inflow(E[(E, m) (E, m)'])

With ``K(s) = E[E(t) E(t - s)']`` for s in [0, d], H = G e^{A d} and the plant's noise in messages,
``F(s) = E[m(t) E(t - s)'] - e^{A d} K(d - s)'``, steady moments obey (derived; Kharitonov 2013,
Time-Delay Systems, chapter 2, for systems of this form with white noise)

    dK/ds = B K(s) + H K(d - s)' + G F(s),    K(0) = K(0)',
    0 = B K(0) + K(0) B' + H K(d)' + K(d) H' + G F(0) + F(0)' G' + noise + Phi,

a linear boundary value problem, solved by collocation at Chebyshev points (Trefethen 2000, Spectral
Methods in MATLAB, chapters 6 and 12). Mean squares are bounded if the mean of the errors is stable
and the map T from Phi to inflow has a spectral radius below 1 (a renewal equation, derived). That
is so if some positive definite Phi is T(Phi) and a positive definite rest, a problem of the same
form in which Phi belongs to the unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.spectra import contracts, growth_factor
from netkf.theory.common.jumps import ClockJumps, LyapunovInverse
from netkf.theory.common.random_links import Directions
from netkf.theory.numerics.matrices import arnoldi_start

MIN_POINTS, MAX_POINTS, POINTS_PER_CHANGE = 12, 80, 1.2
"""Limits of the number of intervals between the collocation points of a delay, and how many more
than the least are taken for each change of the errors by a factor e.
"""
MAX_DENSE, MAX_DENSE_MEAN = 1200, 600
"""Unknowns up to which the boundary value problem, and the map of means over d, are matrices."""
KRYLOV_VECTORS, MAX_ROUNDS = 40, 10
"""Vectors between restarts of GMRES, and rounds of iterative refinement."""
FIRST_TOLERANCE, TOLERANCE, CORRECTION = 1e-7, 1e-12, 1e-3
"""Relative tolerances of the first solution of the boundary value problem, of the refined one, and
of each correction that refines it."""
PROOF_TOLERANCE = 1e-9
"""Relative size of a negative eigenvalue that rounding of a semidefinite matrix explains."""


@dataclass(frozen=True, eq=False)
class DelayedJumps:
    """A filter whose clocks are Poisson processes and whose messages take ``delay`` seconds.

    instant : the system with the same clocks and messages without delay, of one mode
    A, Q    : (n, n) drift of the plant, and covariance of its noise per second
    delay   : seconds, positive

    Raises TheoryError if the errors change too much during a delay for MAX_POINTS.
    """

    instant: ClockJumps
    A: FloatArray
    Q: FloatArray
    delay: float

    def __post_init__(self) -> None:
        _ = self.points

    @property
    def nodes(self) -> int:
        """N, the number of nodes."""
        return self.instant.nodes

    @property
    def shape(self) -> tuple[int, int, int]:
        """(1, M, M), the shape of Phi and of the second moments of the M = N n errors."""
        return self.instant.shape

    @cached_property
    def _message_directions(self) -> Directions:
        """The K links, with messages under way as senders: that of node i has the index N + i."""
        directions = self.instant.directions
        assert directions is not None
        return directions._replace(sender=directions.sender + self.nodes)

    @cached_property
    def _mean(self) -> tuple[FloatArray, FloatArray]:
        """B and G (M, M), the mean effects per second of the errors and of arriving messages."""
        N, M = self.nodes, len(self.instant.drift)
        mean_drift = np.zeros((M, 2 * M))
        mean_drift[:, :M] = self.instant.drift
        for node, rate, lost in self.instant.samples:
            rows = slice(node * len(self.A), (node + 1) * len(self.A))
            mean_drift[rows, rows] -= rate * lost
        for rate, tick_directions in self.instant.ticks:
            mean_drift += rate * self._message_directions.mean(2 * N, tick_directions)[0, :M]
        return mean_drift[:, :M], mean_drift[:, M:]

    @cached_property
    def points(self) -> int:
        """The number k of intervals between the k + 1 collocation points of the delay."""
        B, G = (float(np.linalg.norm(matrix, 2)) for matrix in self._mean)
        growth = float(np.linalg.norm(self.A, 2))
        changes = self.delay * (B + growth + G * np.exp(growth * self.delay))
        # The Chebyshev series of e^{c x} over [0, 1] falls like (c / 4)^k / k!.
        points = MIN_POINTS + int(min(np.ceil(POINTS_PER_CHANGE * changes), 10.0 * MAX_POINTS))
        if points > MAX_POINTS:
            most = (MAX_POINTS - MIN_POINTS) / POINTS_PER_CHANGE
            raise TheoryError(
                f"errors change {changes:.3g} times during a delay of {self.delay:g} s; exact mean "
                f"squares are computed for at most {most:.0f}: give a shorter delay or lower rates"
            )
        return points

    @cached_property
    def _integral(self) -> FloatArray:
        """Integrals (k + 1, k + 1) in seconds: row a integrates collocation values from 0 to a."""
        x = 2.0 * chebyshev_points(self.points) - 1.0
        coefficients = np.linalg.inv(np.polynomial.chebyshev.chebvander(x, self.points))
        integrals = np.polynomial.chebyshev.chebint(coefficients, lbnd=-1.0, axis=0)
        return self.delay * np.asarray(0.5 * np.polynomial.chebyshev.chebval(x, integrals).T)

    @cached_property
    def _drift_blocks(self) -> FloatArray:
        """The diagonal blocks (N, n, n) of B, which is block diagonal."""
        N, n = self.nodes, len(self.A)
        return self._mean[0].reshape(N, n, N, n)[np.arange(N), :, np.arange(N)]

    @cached_property
    def _coupling(self) -> scipy.sparse.csr_array:
        """H = G e^{A d} (M, M), sparse: the mean effect of errors one delay ago."""
        return scipy.sparse.csr_array(self._mean[1] @ self._delay_transition)

    @cached_property
    def _delay_transition(self) -> FloatArray:
        """Transition (M, M) of all messages over the delay: e^{A d} for each node."""
        return np.asarray(np.kron(np.eye(self.nodes), scipy.linalg.expm(self.delay * self.A)))

    @cached_property
    def _propagators(self) -> FloatArray:
        """Inverses (N, (k + 1) n, (k + 1) n) of ``y -> y - integral B_i y``, for dy/ds = B_i y."""
        size = (self.points + 1) * len(self.A)
        coupled = np.einsum("kl,aij->akilj", self._integral, self._drift_blocks).reshape(
            -1, size, size
        )
        return np.linalg.inv(np.eye(size) - coupled)

    def _apply_inverse(self, y: FloatArray) -> FloatArray:
        """Return Y (k + 1, M, columns) with ``Y - integral B Y = y``, node by node."""
        N, (K, M, columns) = self.nodes, y.shape
        by_node = y.reshape(K, N, -1, columns).swapaxes(0, 1).reshape(N, -1, columns)
        solution = (self._propagators @ by_node).reshape(N, K, -1, columns)
        return np.asarray(solution.swapaxes(0, 1).reshape(K, M, columns))

    @cached_property
    def _message_noise(self) -> tuple[FloatArray, FloatArray]:
        """Return F(s) (k + 1, n, M) and a covariance (n, n): noise during the delay in messages."""
        # An impulse of noise moves errors by h, dh/ds = B h + G e^{U s}, and messages under way by
        # e^{A s}: F(s) = e^{A s} int_0^{d - s} e^{A u} Q h(u)' du.
        N, n, G = self.nodes, len(self.A), self._mean[1]
        times = self.delay * chebyshev_points(self.points)
        E = np.stack([scipy.linalg.expm(s * self.A) for s in times])
        repeated = np.tile(E, (1, N, 1))
        start = np.tile(np.eye(n), (N, 1))
        h = self._apply_inverse(start + np.tensordot(self._integral, G @ repeated, 1))
        covariance = np.tensordot(self._integral, E @ self.Q @ np.swapaxes(h, 1, 2), 1)
        noise = np.tensordot(self._integral, E @ self.Q @ np.swapaxes(E, 1, 2), 1)
        return E @ covariance[::-1], symmetric(noise[-1])

    def _driven_by(self, Phi: FloatArray) -> FloatArray:
        """Return the right-hand side (k + 1, M, M) for white noise of covariance Phi per second."""
        right = np.zeros((self.points + 1, *Phi.shape))
        right[0] = Phi
        return right

    def _residual(self, K: FloatArray, right: FloatArray, jumps: bool) -> FloatArray:
        """Return the residuals (k + 1, M, M) of K(s) = E[E(t) E(t - s)'] and ``right``."""
        # Entry 0 is that of the second equation, the others those of the first, integrated from 0.
        # With ``jumps`` Phi is the inflow computed from K.
        k, M, _ = K.shape
        driven = (self._drift_blocks @ K.reshape(k, self.nodes, -1, M)).reshape(K.shape)
        # H K(d - s)' (k + 1, M, M): points are symmetric, so K(d - s) is K reversed.
        columns = np.ascontiguousarray(K[::-1].transpose(2, 0, 1)).reshape(M, k * M)
        heard = np.asarray((self._coupling @ columns).reshape(M, k, M).swapaxes(0, 1))
        residual = right + K[0] - K + np.tensordot(self._integral, driven + heard, 1)
        # The antisymmetric part of this entry is the condition K(0) = K(0)'.
        residual[0] = right[0] + 2.0 * symmetric(driven[0] + heard[0]) + 0.5 * (K[0].T - K[0])
        if jumps:
            residual[0] += self._inflow(self._moments(K, noise=False))
        return np.asarray(residual)

    @cached_property
    def _lyapunov(self) -> LyapunovInverse:
        return LyapunovInverse(self._mean[0][None])

    def _solve_without_messages(self, right: FloatArray) -> FloatArray:
        """Return K (k + 1, M, M) for H = 0 (Lyapunov), the preconditioner of GMRES."""
        equation = symmetric(right[:1])
        first = (right[:1] - equation) + self._lyapunov(equation)
        return self._apply_inverse(np.concatenate([first, right[1:] + first]))

    @cached_property
    def _factors(self) -> dict[bool, Any]:
        return {}

    def _by_elimination(self, right: FloatArray, jumps: bool) -> FloatArray:
        """Return K (k + 1, M, M) by dense LU factors, which are cached."""
        if jumps not in self._factors:
            units = np.eye(right.size).reshape(right.size, *right.shape)
            columns = [-self._residual(unit, np.zeros_like(unit), jumps).ravel() for unit in units]
            self._factors[jumps] = scipy.linalg.lu_factor(np.stack(columns, axis=1))
        return np.asarray(
            scipy.linalg.lu_solve(self._factors[jumps], right.ravel()).reshape(right.shape)
        )

    def _solve(self, right: FloatArray, jumps: bool, tolerance: float) -> FloatArray:
        """Return K (k + 1, M, M) to a relative ``tolerance``, by elimination or GMRES."""
        if right.size <= MAX_DENSE:
            return self._by_elimination(right, jumps)
        zeros = np.zeros_like(right)

        def apply(x: FloatArray) -> FloatArray:
            """Return the residual of the unknowns ``x`` ((k + 1) M M,), preconditioned."""
            return -self._solve_without_messages(
                self._residual(x.reshape(right.shape), zeros, jumps)
            ).ravel()

        operator = scipy.sparse.linalg.LinearOperator((right.size, right.size), matvec=apply)
        start = self._solve_without_messages(right).ravel()
        solution, _ = scipy.sparse.linalg.gmres(
            operator, start, rtol=tolerance, atol=0.0, restart=KRYLOV_VECTORS, maxiter=5
        )
        return np.asarray(solution).reshape(right.shape)

    def _autocovariances(self, right: FloatArray, jumps: bool) -> FloatArray:
        """Return K (k + 1, M, M) by iterative refinement of _solve; raises TheoryError."""
        K = self._solve(right, jumps, FIRST_TOLERANCE)
        for _ in range(MAX_ROUNDS):
            change = self._solve(self._residual(K, right, jumps), jumps, CORRECTION)
            K, size = K + change, float(np.abs(change).max())
            if size <= TOLERANCE * np.abs(K).max():
                return K
        raise TheoryError(f"delayed mean squares were solved to {size:.1e} only")

    def _moments(self, K: FloatArray, noise: bool) -> FloatArray:
        """Return E[(E, m) (E, m)'] (2 M, 2 M) of errors and arriving messages, from K."""
        late, X = self._delay_transition, symmetric(K[0])
        across = K[-1] @ late.T
        sent = late @ X @ late.T
        if noise:
            F, Q = self._message_noise
            across = across + np.tile(F[0].T, (1, self.nodes))
            sent = sent + np.tile(Q, (self.nodes, self.nodes))
        return np.block([[X, across], [across.T, symmetric(sent)]])

    def _inflow(self, moments: FloatArray) -> FloatArray:
        """Return Phi (M, M), the covariance per second that messages and samples add."""
        M, Z = len(moments) // 2, moments[None]
        heard = self._message_directions.products(*self.instant.all_pairs, Z)[:, :M, :M]
        return np.asarray(symmetric(self.instant.sampled(Z[:, :M, :M]) + heard)[0])

    def apply_jumps(self, Phi: FloatArray) -> FloatArray:
        """Return T(Phi) (1, M, M), what jumps cause in errors driven by noise Phi; positive."""
        K = self._autocovariances(self._driven_by(Phi[0]), jumps=False)
        return self._inflow(self._moments(K, noise=False))[None]

    @cached_property
    def is_bounded(self) -> bool:
        """True if a definite Phi (M, M) solves ``Phi = T(Phi) + I``: mean squares stay bounded."""
        unit = self._driven_by(np.eye(len(self.instant.drift)))
        try:
            moments = self._moments(self._autocovariances(unit, jumps=True), noise=False)
        except TheoryError:  # near 1, or above it
            return False
        eigenvalues = np.linalg.eigvalsh(self._inflow(moments))
        return bool(eigenvalues[0] >= -PROOF_TOLERANCE * max(1.0, eigenvalues[-1]))

    @cached_property
    def covariance(self) -> FloatArray:
        """E[E E'] (1, M, M) under all noises and jumps."""
        heard = self._mean[1] @ np.tile(self._message_noise[0], (1, self.nodes, 1))
        right = np.tensordot(self._integral, heard, 1)
        jump_noise = self._inflow(self._moments(np.zeros_like(right), noise=True))
        right[0] = self.instant.noise + 2.0 * symmetric(heard[0]) + jump_noise
        return symmetric(self._autocovariances(np.asarray(right), jumps=True)[:1])

    @cached_property
    def mean_is_stable(self) -> bool:
        """True if mean errors die out, by their map over d s (Breda, Maset, Vermiglio 2015)."""
        K, M = self.points + 1, len(self.instant.drift)

        def next_means(y: FloatArray) -> FloatArray:
            """Return the means (K M,) at the points of the next delay from those of the last."""
            past = y.reshape(K, M)
            heard = self._integral @ (self._coupling @ past.T).T
            return self._apply_inverse((past[-1] + heard)[:, :, None]).ravel()

        size = K * M
        if size <= MAX_DENSE_MEAN:
            dense = np.stack([next_means(unit) for unit in np.eye(size)], axis=1)
            return contracts(growth_factor(dense))
        operator = scipy.sparse.linalg.LinearOperator((size, size), matvec=next_means)
        start = arnoldi_start(size)
        values = scipy.sparse.linalg.eigs(operator, k=4, v0=start, return_eigenvectors=False)
        return contracts(float(np.abs(values).max()))


def chebyshev_points(K: int) -> FloatArray:
    """Return the extreme points (K + 1,) of the Chebyshev polynomial of degree K on [0, 1]."""
    return np.asarray(0.5 * (1.0 - np.cos(np.pi * np.arange(K + 1) / K)))
