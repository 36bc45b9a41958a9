"""Second moments of errors with constant gains, over random losses and clocks.

The stacked error e (M,), M = N n, of such a filter is a linear system with jumps at events, which
are independent of e. So its second moment obeys a linear recursion (slots) or a linear differential
equation (Poisson clocks), a generalised Lyapunov equation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray, IntArray, block_diagonal, symmetric
from netkf.linalg.spectra import growth_rate
from netkf.theory.common.random_links import Directions
from netkf.theory.numerics.positive_maps import PositiveMap


@dataclass(frozen=True, eq=False)
class SlotJumps:
    """A filter in slots: all nodes predict, use readings, and exchange once.

    F, Q     : (n, n) of the plant, which the filters know
    closed   : (N, n, n) I - K_i H_i, by which readings multiply the errors of predictions
    noise    : (M, M) covariance that readings add
    directions     : the links, None if nothing is sent
    on_predictions : the exchange uses differences of predictions, else those of the estimates after
                     readings
    """

    F: FloatArray
    Q: FloatArray
    closed: FloatArray
    noise: FloatArray
    directions: Directions | None
    on_predictions: bool = False

    @property
    def nodes(self) -> int:
        """N, the number of nodes."""
        return len(self.closed)

    @property
    def size(self) -> int:
        """M, the number of errors of all nodes."""
        return self.nodes * len(self.F)

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray]:
        """Pairs (P,) of directions that share a draw; each is also paired with itself."""
        assert self.directions is not None
        first, second = np.nonzero(self.directions.source[:, None] == self.directions.source)
        return first, second

    @cached_property
    def _mean(self) -> FloatArray:
        """E[D] (M, M), the mean change of errors in one exchange."""
        assert self.directions is not None
        return self.directions.mean(self.nodes, np.arange(len(self.directions.sender)))

    def step(self, X: FloatArray, noise: bool = False) -> FloatArray:
        """Return second moments (M, M) of M stacked errors one slot after X; with the ``noise`` of
        plant and readings, or linear.
        """
        N, share = self.nodes, float(noise)
        predicted = _multiply_blocks(self.F[None], X, N) + share * np.tile(self.Q, (N, N))
        updated = _multiply_blocks(self.closed, predicted, N) + share * self.noise
        return updated if self.directions is None else self._exchange(predicted, updated)

    def maps(self) -> tuple[PositiveMap, FloatArray | None]:
        """Return the map of second moments (M, M) over a slot, and the noise that it adds."""
        return self.step, self.step(np.zeros((self.size, self.size)), noise=True)

    def _exchange(self, predicted: FloatArray, updated: FloatArray) -> FloatArray:
        """Return the second moments (M, M) after the exchange."""
        directions, mean = self.directions, self._mean
        assert directions is not None
        # With u the errors after readings and s those that are exchanged: E[s s'] and E[u s'].
        source, cross = updated, updated
        if self.on_predictions:
            source = predicted
            cross = block_diagonal(list(self.closed)) @ predicted
        first, second = self._pairs
        independent = directions.delivery[first] * directions.delivery[second]
        spread = directions.joint(first, second) - independent
        # E[(u + D s)(u + D s)'], u the updated and s the source errors, from E[D] and the
        # covariances of the deliveries.
        fluctuation = directions.products(first, second, spread, source)
        mean_terms = 2.0 * symmetric(cross @ mean.T) + mean @ source @ mean.T
        return symmetric(updated + mean_terms + fluctuation)


@dataclass(frozen=True, eq=False)
class ClockJumps:
    """A filter in continuous time whose clocks are all Poisson processes.

    nodes      : N
    drift      : (M, M) of the errors between events
    noise      : (M, M) covariance per second, that of readings included
    samples    : (node, rate per second, L H (n, n)) of nodes that take samples, which multiply the
                 node's error by I - L H
    directions : the links, None if nothing is sent
    ticks      : (rate per second, indices of directions) of each clock at which nodes transmit
    """

    nodes: int
    drift: FloatArray
    noise: FloatArray
    samples: tuple[tuple[int, float, FloatArray], ...]
    directions: Directions | None
    ticks: tuple[tuple[float, IntArray], ...] = field(default=())

    @property
    def size(self) -> int:
        """M, the number of errors of all nodes."""
        return len(self.drift)

    @cached_property
    def flow(self) -> FloatArray:
        """Mean drift B (M, M) of the errors, per second."""
        flow, n = self.drift.copy(), self.size // self.nodes
        for node, rate, lost in self.samples:
            flow[node * n : (node + 1) * n, node * n : (node + 1) * n] -= rate * lost
        for rate, tick_directions in self.ticks:
            assert self.directions is not None
            flow += rate * self.directions.mean(self.nodes, tick_directions)
        return flow

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Ordered pairs (P,) of each clock's directions, and rates (P,) at which both arrive."""
        assert self.directions is not None
        pairs = []
        for rate, tick_directions in self.ticks:
            first, second = (part.ravel() for part in np.meshgrid(tick_directions, tick_directions))
            pairs.append((first, second, rate * self.directions.joint(first, second)))
        first, second, rates = (np.concatenate(part) for part in zip(*pairs, strict=True))
        return first, second, rates

    def inflow(self, X: FloatArray) -> FloatArray:
        """Return what jumps add to dX/dt beyond B X + X B' and the noise: a positive map."""
        total, n = np.zeros_like(X), self.size // self.nodes
        for node, rate, lost in self.samples:
            rows = slice(node * n, (node + 1) * n)
            total[rows, rows] += rate * lost @ X[rows, rows] @ lost.T
        if self.directions is not None and self.ticks:
            total += self.directions.products(*self._pairs, X)
        return total

    def maps(self) -> tuple[PositiveMap, FloatArray | None]:
        """Return X -> L^-1(inflow(X)) and L^-1(noise), L X = -(B X + X B'); None if unstable."""
        if growth_rate(self.flow) >= 0.0:
            return self.inflow, None
        T, U = scipy.linalg.schur(self.flow)

        def inverse(Y: FloatArray) -> FloatArray:
            """Solve B X + X B' = -Y by the real Schur form (Bartels and Stewart 1972)."""
            X, scale, _ = scipy.linalg.lapack.dtrsyl(T, T, -(U.T @ Y @ U), trana="N", tranb="T")
            return symmetric(np.asarray(U @ (X / scale) @ U.T))

        return lambda X: inverse(self.inflow(X)), inverse(self.noise)


def _multiply_blocks(maps: FloatArray, X: FloatArray, nodes: int) -> FloatArray:
    """Return ``C X C'`` (M, M) for block diagonal C of N blocks ``maps``, or one for all."""
    M = len(X)
    CX = (maps @ X.reshape(nodes, -1, M)).reshape(M, M)
    return np.asarray((maps @ CX.T.reshape(nodes, -1, M)).reshape(M, M))
