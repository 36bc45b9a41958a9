"""Moments of the averaging of P step 5, z_i <- z_i + 1/delta sum_j b_ij (z_j - z_i), gamma times.

One step is ``M = I - 1/delta sum of b_ij e_i (e_i - e_j)' + b_ji e_j (e_j - e_i)'`` over links,
which are independent. So with ``d = Y_ii - Y_ij - Y_ji + Y_jj`` of each link

    E[M Y M'] = E[M] Y E[M]' + 1/delta^2 sum over links of +-cov(b, b) d,

which touches only the link's own four blocks: a step costs two sparse products, and gamma of them
with a draw each are gamma such steps. One draw held over the slot makes M^gamma a polynomial in the
same b; its outcomes are then enumerated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray

MAX_NODES, MAX_OUTCOMES = 60, 2**20
FEW_NODES = 16  # up to which the Kronecker square is cheap
MAX_WORK = 1e12  # multiplications to enumerate
CHUNK = 8192  # outcomes at a time


@dataclass(frozen=True, eq=False)
class Averaging:
    """The law of gamma averaging steps on ``nodes`` nodes with consensus gain ``delta``.

    links  : (E, 2) places of the two ends
    hears  : (E, 2) probabilities that the first end hears the second, and that the second the first
    both   : (E,) probability that both hear each other in one step
    held   : whether one draw of the links serves all steps of a slot, else each step has its own
    """

    nodes: int
    links: IntArray
    hears: FloatArray
    both: FloatArray
    delta: float
    gamma: int
    held: bool = False

    @cached_property
    def mean_step(self) -> scipy.sparse.csr_array:
        """(N, N) E[M] of one step."""
        i, j = self.links.T
        first, second = self.hears.T / self.delta
        rows = np.concatenate([np.arange(self.nodes), i, i, j, j])
        columns = np.concatenate([np.arange(self.nodes), j, i, i, j])
        values = np.concatenate([np.ones(self.nodes), first, -first, second, -second])
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(self.nodes, self.nodes))

    @cached_property
    def mean(self) -> FloatArray:
        """(N, N) E[M^gamma], P (28) for fresh links."""
        if self.enumerated:
            return self._moments[0]
        return np.linalg.matrix_power(self.mean_step.toarray(), self.gamma)

    @cached_property
    def kron(self) -> FloatArray:
        """(N^2, N^2) E[M^gamma (x) M^gamma]."""
        if self.enumerated:
            return self._moments[1]
        N, (i, j) = self.nodes, self.links.T
        step = self.mean_step.toarray()
        one = np.kron(step, step)
        four = (i * N + i, i * N + j, j * N + i, j * N + j)
        spread = np.zeros((N * N, len(i)))
        differ = np.zeros((len(i), N * N))
        each = np.arange(len(i))
        parts = zip(four, self._covariances, (1.0, -1.0, -1.0, 1.0), strict=True)
        for place, covariance, sign in parts:
            spread[place, each] = sign * covariance
            differ[each, place] = sign
        return np.linalg.matrix_power(one + spread @ differ, self.gamma)

    def second_moment(self, Y: FloatArray) -> FloatArray:
        """(N n, N n) E[(M^gamma (x) I) Y (M^gamma (x) I)'] for one Y of that shape."""
        N, n = self.nodes, len(Y) // self.nodes
        if self.enumerated or N <= FEW_NODES:
            pairs = Y.reshape(N, n, N, n).transpose(0, 2, 1, 3).reshape(N * N, n * n)
            four = (self.kron @ pairs).reshape(N, N, n, n).transpose(0, 2, 1, 3)
            return np.asarray(four.reshape(N * n, N * n))
        i, j = self.links.T
        own, cross, _, other = (c[:, None, None] for c in self._covariances)
        each = np.arange(N)
        for _ in range(self.gamma):
            Z = Y.reshape(N, n, N, n)
            d = Z[i, :, i] - Z[i, :, j] - Z[j, :, i] + Z[j, :, j]
            Y = self._left(self._left(Y).T).T.copy()
            Z = Y.reshape(N, n, N, n)
            at_node = np.zeros((N, n, n))
            np.add.at(at_node, i, own * d)
            np.add.at(at_node, j, other * d)
            Z[each, :, each] += at_node
            Z[i, :, j] -= cross * d
            Z[j, :, i] -= cross * d
        return Y

    def _left(self, Y: FloatArray) -> FloatArray:
        product = self.mean_step @ np.ascontiguousarray(Y).reshape(self.nodes, -1)
        return np.asarray(product).reshape(Y.shape)

    @property
    def certain(self) -> bool:
        """Whether every link is always up or always down."""
        return bool(np.isin(self.hears, (0.0, 1.0)).all())

    @property
    def enumerated(self) -> bool:
        """Whether moments need all outcomes of the links, because one draw serves all steps."""
        return self.held and self.gamma > 1 and not self.certain  # else one draw either way

    @cached_property
    def _covariances(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(E,) covariances of the pairs from (b_ij, b_ji), row by row, over delta^2."""
        first, second = self.hears.T
        cross = (self.both - first * second) / self.delta**2
        own, other = (p * (1.0 - p) / self.delta**2 for p in (first, second))
        return own, cross, cross, other

    @cached_property
    def _moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean and mean Kronecker square of M^gamma over all outcomes of one draw."""
        N = self.nodes
        fates = self._fates
        count = math.prod(len(chance) for chance, _ in fates)
        if N > MAX_NODES or count > MAX_OUTCOMES or count * (N**4 + N**3) > MAX_WORK:
            raise TheoryError(
                "the outcomes of links held over gamma > 1 steps are enumerated, and there are too "
                f"many: 2^{math.log2(count):.0f} on {N} nodes; take a smaller graph or fresh links"
            )
        half = len(fates) // 2
        one, other = (_together(part, N * N) for part in (fates[:half], fates[half:]))
        mean, square = np.zeros(N * N), np.zeros((N * N, N * N))
        rows = max(1, CHUNK // len(other[0]))
        for start in range(0, len(one[0]), rows):
            chance, piece = (table[start : start + rows, None] for table in one)
            M = np.eye(N).reshape(-1) - piece - other[1]
            power = np.linalg.matrix_power(M.reshape(-1, N, N), self.gamma).reshape(-1, N * N)
            weighted = (chance * other[0]).reshape(-1, 1) * power
            mean += weighted.sum(axis=0)
            square += weighted.T @ power
        # entry ((i, j), (k, l)) of the sum is M_ij M_kl, of the Kronecker square M_ik M_jl
        kron = square.reshape(N, N, N, N).transpose(0, 2, 1, 3).reshape(N * N, N * N)
        return mean.reshape(N, N), kron

    @cached_property
    def _fates(self) -> list[tuple[FloatArray, FloatArray]]:
        """For each link the probabilities of its outcomes and (outcomes, N^2) what each subtracts
        from M; impossible outcomes are left out.
        """
        N, found = self.nodes, []
        for (i, j), (first, second), both in zip(self.links, self.hears, self.both, strict=True):
            chances = np.array([both, first - both, second - both, 1.0 - first - second + both])
            pieces = np.zeros((4, N, N))
            pieces[[[0], [1]], i, [i, j]] = pieces[[[0], [2]], j, [j, i]] = [1.0, -1.0]
            possible = chances > 1e-15
            found.append((chances[possible], pieces[possible].reshape(-1, N * N) / self.delta))
        return found


def _together(
    fates: list[tuple[FloatArray, FloatArray]], size: int
) -> tuple[FloatArray, FloatArray]:
    """Probabilities and sums of pieces of all outcomes of several links."""
    chances, sums = np.ones(1), np.zeros((1, size))
    for chance, pieces in fates:
        chances = np.outer(chances, chance).reshape(-1)
        sums = (sums[:, None] + pieces).reshape(-1, size)
    return chances, sums
