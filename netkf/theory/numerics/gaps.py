"""How the state, errors and covariances move over a gap between events.

Without increments every error moves alike, ``e+ = F e + D x + w`` with the F of the filters and D
from where the plant's differs; :class:`Drift` makes such a :class:`Gap` of a diffusion. With
increments each error has a transition of its own, which :class:`Flow` gives: with ``[X; Y](s) =
E(s) [I; P]`` and ``E(s) = exp(M s)``, M the Hamiltonian, ``Phi(g, s) = X(g)^-T X(s)^T`` and
``Phi(g, s) L(s) = X(g)^-T Y(s)^T H' R^-1`` are entire functions of s, which eight Gauss-Legendre
nodes integrate to machine precision over steps of |M| g <= 1/2. Covariances enter and leave as
roots ``P = S S'``, since ``(I + P G)^-1`` has no digits left where P is wide: with ``G_g = Gamma'
Gamma`` from the same nodes and ``[I; Gamma S] = Z U``, it is ``I - (S Z_1)(Z_2' Gamma)``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS
REACH, TERMS = 0.5, 22  # of |M| s, and of the series of exp(M s): 0.5^22 / 22! is nothing
KEPT = 256  # gaps that are remembered; periodic clocks have few


class Gap(NamedTuple):
    """One move of everything that is only predicted.

    state (n, n) F of the plant; error (n, n) F of the filters; follow (n, n): x enters errors;
    state_noise, error_noise (n, k) of the same k inputs; root (n, r), root root' = Q believed.
    """

    state: FloatArray
    error: FloatArray
    follow: FloatArray
    state_noise: FloatArray
    error_noise: FloatArray
    root: FloatArray


class Exponential:
    """``exp(M s)`` by its series, for |M| s up to REACH."""

    def __init__(self, M: FloatArray) -> None:
        self.unit = REACH / max(float(np.abs(M).sum(axis=0).max(initial=0.0)), 1e-300)
        terms = [np.eye(len(M))]
        for k in range(1, TERMS):
            terms.append(terms[-1] @ (M * self.unit) / k)
        self._terms = np.array(terms)

    def __call__(self, times: FloatArray) -> FloatArray:
        """(K, d, d) at K times."""
        powers = (np.asarray(times)[:, None] / self.unit) ** np.arange(TERMS)
        return np.asarray(np.tensordot(powers, self._terms, 1))


def lower_root(parts: FloatArray) -> FloatArray:
    """(..., n, n) lower triangular S with ``S S' = parts parts'``, parts (..., n, k)."""
    n, k = parts.shape[-2:]
    if k == 0:
        return np.zeros((*parts.shape[:-1], n))
    if k < n:
        widths = [(0, 0)] * (parts.ndim - 1) + [(0, n - k)]
        parts = np.pad(parts, widths)
    return np.swapaxes(np.linalg.qr(np.swapaxes(parts, -1, -2), mode="r"), -1, -2)


class Drift:
    """Gaps without increments: a diffusion (A, B) and filters that believe (A, B) of their own."""

    def __init__(self, A: FloatArray, B: FloatArray, A_f: FloatArray, B_f: FloatArray) -> None:
        n = len(A)
        nothing = np.zeros((n, n))
        self._n = n
        self._truth = _Linear(
            np.block([[A, nothing], [A - A_f, A_f]]), np.concatenate([B, B], axis=0)
        )
        same = np.array_equal(A, A_f) and np.array_equal(B, B_f)
        self._belief = None if same else _Linear(A_f, B_f)
        self._known: dict[float, Gap] = {}

    def __call__(self, gap: float) -> Gap:
        """The move over ``gap`` seconds."""
        found = self._known.get(gap)
        if found is None:
            n = self._n
            F, noise = self._truth.over(gap)
            root = noise[n:] if self._belief is None else self._belief.over(gap)[1]
            found = Gap(F[:n, :n], F[n:, n:], F[n:, :n], noise[:n], noise[n:], lower_root(root))
            if len(self._known) >= KEPT:
                self._known.clear()
            self._known[gap] = found
        return found


class _Linear:
    """dz = A z dt + B dw over any gap, by doubling."""

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        self._exp, self._B = Exponential(A), B

    def over(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """``exp(A gap)`` and a root of the covariance of what the noise adds."""
        doublings = max(0, math.ceil(math.log2(max(gap / self._exp.unit, 1e-300))))
        short = gap / 2.0**doublings
        E = self._exp(np.append(short * (1.0 - NODES), short))
        parts = np.sqrt(WEIGHTS * short)[:, None, None] * (E[:-1] @ self._B)
        F, root = E[-1], parts.transpose(1, 0, 2).reshape(len(self._B), -1)
        for _ in range(doublings):
            root = np.concatenate([F @ root, root], axis=1)
            if root.shape[1] > 2 * len(root):
                root = lower_root(root)
            F = F @ F
        return F, lower_root(root)


class Moved(NamedTuple):
    """What becomes of K errors over a gap: transition (K, n, n), follow (K, n, n) of x, response
    (K, n, k) to the plant's k inputs, own (K, n, q) to q noises of their readings, at most n, root
    (K, n, n) of P.
    """

    transition: FloatArray
    follow: FloatArray
    response: FloatArray
    own: FloatArray
    root: FloatArray


class Flow:
    """Errors of a filter with continuous readings, or without any: H (p, n), p may be 0.

    ``R`` (p, p) is what it believes, ``noise`` (p, p) a root of the true one; ``A``, ``B`` as it
    believes them, ``plant`` the true pair.
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
        n = len(A)
        self._n, self._B, self._plant = n, B, plant
        self._root_R = np.linalg.cholesky(R)
        self._seen = np.linalg.solve(self._root_R, H)
        self._weight = np.linalg.solve(R, H).T
        self._noise = self._weight @ noise
        G, Q = self._seen.T @ self._seen, B @ B.T
        self._scale = _scale(A, Q, G)
        M = np.block([[-A.T, G * self._scale], [Q / self._scale, A]])
        self._exp = Exponential(M)
        self._difference = plant[0] - A
        self._state = Exponential(plant[0]) if self._difference.any() else None
        self.unit = self._exp.unit
        if self._state is not None:
            self.unit = min(self.unit, self._state.unit)

    def _blocks(self, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(K, n, n) each: transposes of the four blocks of exp(M s)."""
        n, c = self._n, self._scale
        E = np.swapaxes(self._exp(times), 1, 2)
        return E[:, :n, :n], E[:, n:, :n] / c, E[:, :n, n:] * c, E[:, n:, n:]

    def move(self, roots: FloatArray, gap: float) -> Moved:
        """K filters with ``roots`` (K, n, n) over ``gap``, at most ``unit`` seconds."""
        times, w = NODES * gap, WEIGHTS * gap
        T11, T12, T21, T22 = self._blocks(np.append(times, gap))
        F = np.linalg.inv(T11[-1])
        at = np.sqrt(w)[:, None, None]
        J, C, SZ = self._gained(roots, at * (self._seen @ np.linalg.inv(T11[:-1])))
        FJ, FC = F @ J, F @ C
        phi = FJ[:, None] @ T11[:-1] + FC[:, None] @ T12[:-1]
        response = phi @ self._plant[1]
        follow = np.zeros_like(FJ)
        if self._state is not None:
            states = self._state(times)
            weighted = w[:, None, None] * phi @ self._difference @ states
            follow = weighted.sum(axis=1)
            response = response + self._through_state(FJ, FC, gap)
        gains = (FJ[:, None] @ T21[:-1] + FC[:, None] @ T22[:-1]) @ self._noise
        own = _side_by_side(at * gains)
        if own.shape[2] > self._n:
            own = lower_root(own)
        root = self._root(F, F @ SZ, T11[:-1], T21[:-1], at)
        return Moved(FJ, follow, _side_by_side(at * response), own, root)

    def _gained(
        self, roots: FloatArray, pieces: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``(I + P G)^-1``, that times P, and S Z_1 a root of the latter; pieces make Gamma."""
        n, Gamma = self._n, pieces.reshape(-1, self._n)
        eye = np.broadcast_to(np.eye(n), roots.shape)
        if not len(Gamma):
            return eye, roots @ np.swapaxes(roots, 1, 2), roots
        Z, _ = np.linalg.qr(np.concatenate([eye, Gamma @ roots], axis=1))
        SZ = roots @ Z[:, :n]  # Z_1 = U^-1 whatever the signs of U
        J = eye - SZ @ (np.swapaxes(Z[:, n:], 1, 2) @ Gamma)
        return J, SZ @ np.swapaxes(SZ, 1, 2), SZ

    def _root(
        self, F: FloatArray, moved: FloatArray, T11: FloatArray, T21: FloatArray, at: FloatArray
    ) -> FloatArray:
        """The root of P at the end: F S Z_1 beside a root of what comes from P = 0."""
        fresh = [_side_by_side((at * (F @ T11 @ self._B))[None])[0]]
        fresh.append(_side_by_side((at * (F @ T21 @ self._weight @ self._root_R))[None])[0])
        zero = lower_root(np.concatenate(fresh, axis=1))
        both = np.concatenate([moved, np.broadcast_to(zero, moved.shape)], axis=2)
        return lower_root(both)

    def _through_state(self, FJ: FloatArray, FC: FloatArray, gap: float) -> FloatArray:
        """(K, 8, n, m): what noise at each node adds to errors through the state they follow."""
        assert self._state is not None
        parts = []
        for s in NODES * gap:
            places, w = s + NODES * (gap - s), WEIGHTS * (gap - s)
            T11, T12, _, _ = self._blocks(places)
            phi = FJ[:, None] @ T11 + FC[:, None] @ T12
            states = self._state(places - s) @ self._plant[1]
            parts.append((w[:, None, None] * phi @ self._difference @ states).sum(axis=1))
        return np.stack(parts, axis=1)


def state_over(plant: tuple[FloatArray, FloatArray], gap: float) -> tuple[FloatArray, FloatArray]:
    """The state's own transition (n, n) and response (n, 8 m) to the inputs of a :class:`Flow`."""
    A, B = plant
    E = Exponential(A)(np.append((1.0 - NODES) * gap, gap))
    at = np.sqrt(WEIGHTS * gap)[:, None, None]
    return E[-1], _side_by_side((at * (E[:-1] @ B))[None])[0]


def _side_by_side(parts: FloatArray) -> FloatArray:
    """(K, s, n, m) to (K, n, s m)."""
    K, s, n, m = parts.shape
    return np.ascontiguousarray(parts.transpose(0, 2, 1, 3)).reshape(K, n, s * m)


def _scale(A: FloatArray, Q: FloatArray, G: FloatArray) -> float:
    """The unit of covariances that makes the Hamiltonian about as small as it can be."""
    q, g = float(np.abs(Q).max(initial=0.0)), float(np.abs(G).max(initial=0.0))
    if g == 0.0:
        return q or 1.0
    rate = max(float(np.abs(A).max(initial=0.0)), 1e-12)
    return math.sqrt(q / g) if q > 0.0 else rate / g
