"""Moments of paper P step 5: gamma averaging steps z_i <- z_i + 1/delta sum_j b_ij (z_j - z_i).

One step is ``M = I - 1/delta sum of b_ij e_i (e_i - e_j)' + b_ji e_j (e_j - e_i)'`` over links,
with b_ij = 1 if i hears j, independent between links. With ``d = Y_ii - Y_ij - Y_ji + Y_jj`` of
each link, E[M Y M'] is E[M] Y E[M]' plus, in the four blocks of each link,

    var(b_ij) d / delta^2 at (i, i),    var(b_ji) d / delta^2 at (j, j),
    - cov(b_ij, b_ji) d / delta^2 at (i, j) and (j, i),

so that a step costs two sparse products. If each
step has its own draw, the moments of M^gamma are gamma such steps; if one draw is held over the
slot, M^gamma is a polynomial in the same b, and all outcomes are enumerated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray

# All outcomes of the losses are enumerated up to these sizes.
MAX_NODES, MAX_OUTCOMES = 60, 2**20
MAX_KRONECKER = 16  # nodes up to which the Kronecker square is cheap
MAX_WORK = 1e12  # multiplications of an enumeration
MAX_OUTCOMES_AT_ONCE = 8192  # bounds the memory of the products


@dataclass(frozen=True, eq=False)
class Averaging:
    """The law of gamma averaging steps z <- M z on N = ``nodes`` nodes with consensus gain
    ``delta``, where each node moves towards those that it hears, by 1/delta of the difference.

    links  : (E, 2) indices of the two ends of each of E links
    hears  : (E, 2) probabilities that the first end hears the second, and that the second the first
    both   : (E,) probability that both hear each other in one step
    held   : True if one draw of the links serves all steps of a slot, else each step has its own
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
        """E[M] (N, N), sparse, of one averaging step of the N nodes."""
        # Each link has E[b_ij] (z_j - z_i) in row i and E[b_ji] (z_i - z_j) in row j, over delta.
        i, j = self.links.T
        first, second = self.hears.T / self.delta
        rows = np.concatenate([np.arange(self.nodes), i, i, j, j])
        columns = np.concatenate([np.arange(self.nodes), j, i, i, j])
        values = np.concatenate([np.ones(self.nodes), first, -first, second, -second])
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(self.nodes, self.nodes))

    @cached_property
    def mean(self) -> FloatArray:
        """E[M^gamma] (N, N), paper P (28) for fresh links."""
        if self.enumerated:
            return self._moments[0]
        return np.linalg.matrix_power(self.mean_step.toarray(), self.gamma)

    @cached_property
    def kron(self) -> FloatArray:
        """E[M^gamma (x) M^gamma] (N^2, N^2), with M (N, N) one averaging step of the N nodes."""
        if self.enumerated:
            return self._moments[1]
        units = np.eye(self.nodes**2).reshape(-1, self.nodes, self.nodes)
        step = np.stack([self._step(unit).reshape(-1) for unit in units], axis=1)
        return np.linalg.matrix_power(step, self.gamma)

    def second_moment(self, Y: FloatArray) -> FloatArray:
        """Return E[(M^gamma (x) I) Y (M^gamma (x) I)'] (N n, N n) for second moments Y."""
        N, n = self.nodes, len(Y) // self.nodes
        if self.enumerated or N <= MAX_KRONECKER:
            pairs = Y.reshape(N, n, N, n).transpose(0, 2, 1, 3).reshape(N * N, n * n)
            result = (self.kron @ pairs).reshape(N, N, n, n).transpose(0, 2, 1, 3)
            return np.asarray(result.reshape(N * n, N * n))
        for _ in range(self.gamma):
            Y = self._step(Y)
        return Y

    def _step(self, Y: FloatArray) -> FloatArray:
        """Return E[(M (x) I) Y (M (x) I)'] (N n, N n) of one averaging step."""
        N, n, (i, j) = self.nodes, len(Y) // self.nodes, self.links.T
        first, second = self.hears.T[..., None, None] / self.delta
        covariance = self.both[:, None, None] / self.delta**2 - first * second
        Z, node_indices = Y.reshape(N, n, N, n), np.arange(N)
        # The second moment of the difference of the two ends of each link.
        d = Z[i, :, i] - Z[i, :, j] - Z[j, :, i] + Z[j, :, j]
        # E[M] Y E[M]', then what the randomness of each link adds in its four blocks.
        Y = self._multiply(self._multiply(Y).T).T.copy()
        Z = Y.reshape(N, n, N, n)
        at_node = np.zeros((N, n, n))
        np.add.at(at_node, i, (first / self.delta - first**2) * d)
        np.add.at(at_node, j, (second / self.delta - second**2) * d)
        Z[node_indices, :, node_indices] += at_node
        Z[i, :, j] -= covariance * d
        Z[j, :, i] -= covariance * d
        return Y

    def _multiply(self, Y: FloatArray) -> FloatArray:
        """Return (E[M] (x) I) Y (N n, columns) of one averaging step, for Y (N n, columns)."""
        product = self.mean_step @ np.ascontiguousarray(Y).reshape(self.nodes, -1)
        return np.asarray(product).reshape(Y.shape)

    @property
    def deterministic(self) -> bool:
        """True if every link is always up or always down."""
        return bool(np.isin(self.hears, (0.0, 1.0)).all())

    @property
    def enumerated(self) -> bool:
        """True if moments need all outcomes of the links, because one draw serves all steps."""
        return self.held and self.gamma > 1 and not self.deterministic

    @cached_property
    def _moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean and mean Kronecker square of M^gamma for one draw held; raises TheoryError."""
        N = self.nodes
        outcomes = self._link_outcomes
        count = math.prod(len(probability) for probability, _ in outcomes)
        if N > MAX_NODES or count > MAX_OUTCOMES or count * (N**4 + N**3) > MAX_WORK:
            raise TheoryError(
                "the outcomes of links held over gamma > 1 steps are enumerated, and there are too "
                f"many: 2^{math.log2(count):.0f} on {N} nodes; take a smaller graph or fresh links"
            )
        # The outcomes of each half of the links are tabulated, then combined block by block.
        half = len(outcomes) // 2
        first, second = (_tabulate(part, N * N) for part in (outcomes[:half], outcomes[half:]))
        mean, square = np.zeros(N * N), np.zeros((N * N, N * N))
        rows = max(1, MAX_OUTCOMES_AT_ONCE // len(second[0]))
        for start in range(0, len(first[0]), rows):
            probability, term = (table[start : start + rows, None] for table in first)
            M = np.eye(N).reshape(-1) - term - second[1]
            power = np.linalg.matrix_power(M.reshape(-1, N, N), self.gamma).reshape(-1, N * N)
            weighted = (probability * second[0]).reshape(-1, 1) * power
            mean += weighted.sum(axis=0)
            square += weighted.T @ power
        # Entry ((i, j), (k, l)) of the sum is M_ij M_kl, that of the Kronecker square M_ik M_jl.
        kron = square.reshape(N, N, N, N).transpose(0, 2, 1, 3).reshape(N * N, N * N)
        return mean.reshape(N, N), kron

    @cached_property
    def _link_outcomes(self) -> list[tuple[FloatArray, FloatArray]]:
        """Probabilities (K,) and terms (K, N^2) of the outcomes of each link in a step."""
        N, outcomes = self.nodes, []
        for (i, j), (first_hears, second_hears), both_hear in zip(
            self.links, self.hears, self.both, strict=True
        ):
            probabilities = np.array(
                [
                    both_hear,
                    first_hears - both_hear,
                    second_hears - both_hear,
                    1.0 - first_hears - second_hears + both_hear,
                ]
            )
            # The first end hears in outcomes 0 and 1, which gives row i entries 1 and -1 in columns
            # i and j; the second in outcomes 0 and 2.
            terms = np.zeros((4, N, N))
            terms[[[0], [1]], i, [i, j]] = terms[[[0], [2]], j, [j, i]] = [1.0, -1.0]
            possible = probabilities > 1e-15
            outcomes.append(
                (probabilities[possible], terms[possible].reshape(-1, N * N) / self.delta)
            )
        return outcomes


def _tabulate(
    outcomes: list[tuple[FloatArray, FloatArray]], size: int
) -> tuple[FloatArray, FloatArray]:
    """Return probabilities (K,) and sums (K, size) of joint outcomes of independent links."""
    probabilities, sums = np.ones(1), np.zeros((1, size))
    for probability, terms in outcomes:
        probabilities = np.outer(probabilities, probability).reshape(-1)
        sums = (sums[:, None] + terms).reshape(-1, size)
    return probabilities, sums
