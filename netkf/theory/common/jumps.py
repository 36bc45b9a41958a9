"""Second moments of errors with constant gains, over random losses and clocks.

The stacked error e (M,), M = N n, of such a filter is a linear system with jumps at events, which
are independent of e. So its second moment obeys a linear recursion (slots) or a linear differential
equation (Poisson clocks), a generalised Lyapunov equation. With bursty links there is one second
moment for each joint state (mode) of the links.
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
    def shape(self) -> tuple[int, int, int]:
        """(S, M, M), the shape of second moments by mode; S = 1 without bursty links."""
        M = self.nodes * len(self.F)
        return (self.directions.modes if self.directions else 1, M, M)

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray]:
        """Pairs (P,) of directions that share a draw; each is also paired with itself."""
        assert self.directions is not None
        first, second = np.nonzero(self.directions.source[:, None] == self.directions.source)
        return first, second

    @cached_property
    def _mean(self) -> FloatArray:
        """E[D] (S, M, M), the mean change of errors in one exchange, by mode of bursty links."""
        assert self.directions is not None
        return self.directions.mean(self.nodes, np.arange(len(self.directions.sender)))

    def step(self, X: FloatArray, noise: bool = False) -> FloatArray:
        """Return second moments (S, M, M) of M stacked errors one slot after X, weighted by mode of
        the links; with the ``noise`` of plant and readings, or linear.
        """
        N = self.nodes
        weight = self.directions.stationary if self.directions else np.ones(1)
        share = (weight if noise else 0.0 * weight)[:, None, None]
        predicted = _multiply_blocks(self.F[None], X, N) + share * np.tile(self.Q, (N, N))
        if self.directions is not None:
            predicted = self.directions.advance(predicted, np.unique(self.directions.source))
        updated = _multiply_blocks(self.closed, predicted, N) + share * self.noise
        return updated if self.directions is None else self._exchange(predicted, updated)

    def maps(self) -> tuple[PositiveMap, FloatArray | None]:
        """Return the map of second moments (S, M, M) over a slot, and the noise that it adds."""
        return self.step, self.step(np.zeros(self.shape), noise=True)

    def _exchange(self, predicted: FloatArray, updated: FloatArray) -> FloatArray:
        """Return the second moments (S, M, M) after the exchange, by mode."""
        directions, mean = self.directions, self._mean
        assert directions is not None
        # With u the errors after readings and s those that are exchanged: E[s s'] and E[u s'].
        source, cross = updated, updated
        if self.on_predictions:
            source = predicted
            cross = block_diagonal(list(self.closed)) @ predicted
        first, second = self._pairs
        spread = (
            directions.joint(first, second)
            - directions.delivery[:, first] * directions.delivery[:, second]
        )
        # E[(u + D s)(u + D s)'], u the updated and s the source errors, from E[D] and the
        # covariances of the deliveries.
        cross_terms = cross @ np.swapaxes(mean, 1, 2)
        fluctuation = directions.products(first, second, spread, source)
        mean_terms = mean @ source @ np.swapaxes(mean, 1, 2)
        return symmetric(updated + 2.0 * symmetric(cross_terms) + mean_terms + fluctuation)


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
    def shape(self) -> tuple[int, int, int]:
        """(S, M, M) of second moments by mode."""
        return (self.directions.modes if self.directions else 1, *self.drift.shape)

    @cached_property
    def _chains(self) -> list[IntArray]:
        assert self.directions is not None
        return [np.unique(self.directions.source[own]) for _, own in self.ticks]

    @cached_property
    def flows(self) -> FloatArray:
        """Mean drift B (S, M, M) of the errors, per second, while the mode of the links stays."""
        drifts, eye = np.tile(self.drift, (self.shape[0], 1, 1)), np.eye(len(self.drift))
        for node, rate, lost in self.samples:
            _block_slice(drifts, self.nodes, node)[...] -= rate * lost
        for k, (rate, tick_directions) in enumerate(self.ticks):
            assert self.directions is not None
            # A tick moves the errors by their mean if the mode stays; otherwise moments leave the
            # mode, at half the rate since B acts from both sides.
            stay = self.directions.stay(self._chains[k])[:, None, None]
            drifts += (
                rate * stay * self.directions.mean(self.nodes, tick_directions)
                - 0.5 * rate * (1.0 - stay) * eye
            )
        return drifts

    @cached_property
    def _pairs(self) -> list[tuple[IntArray, IntArray, FloatArray]]:
        """Ordered pairs (P,) of each clock's directions, and rates (S, P) at which both arrive."""
        assert self.directions is not None
        pairs = []
        for rate, tick_directions in self.ticks:
            first, second = (part.ravel() for part in np.meshgrid(tick_directions, tick_directions))
            pairs.append((first, second, rate * self.directions.joint(first, second)))
        return pairs

    @cached_property
    def all_pairs(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Pairs (P,) of directions of all clocks, and the rates (S, P) at which both arrive."""
        first, second = (np.concatenate([pair[k] for pair in self._pairs]) for k in (0, 1))
        return first, second, np.concatenate([rates for *_, rates in self._pairs], axis=1)

    @cached_property
    def _means(self) -> list[FloatArray]:
        """The mean change E[D] (S, M, M) of the errors at a tick of each clock."""
        assert self.directions is not None
        return [self.directions.mean(self.nodes, own) for _, own in self.ticks]

    def sampled(self, X: FloatArray) -> FloatArray:
        """Return the part (S, M, M) of ``inflow`` that samples add, for moments X (S, M, M)."""
        inflow = np.zeros_like(X)
        for node, rate, lost in self.samples:
            block = _block_slice(X, self.nodes, node)
            _block_slice(inflow, self.nodes, node)[...] += rate * lost @ block @ lost.T
        return inflow

    def inflow(self, X: FloatArray) -> FloatArray:
        """Return what jumps add to dX/dt beyond B X + X B' and the noise: a positive map."""
        total = self.sampled(X)
        if self.directions is None or not self.ticks:
            return total
        if self.directions.steps is None:
            return np.asarray(total + self.directions.products(*self.all_pairs, X))
        for k, (rate, _) in enumerate(self.ticks):
            chains, (first, second, rates) = self._chains[k], self._pairs[k]
            stepped = self.directions.advance(X, chains)
            # The part in which the mode stays and errors move by their mean is in ``flows``.
            change = rate * (stepped - self.directions.stay(chains)[:, None, None] * X)
            total += change + 2.0 * symmetric(self._means[k] @ change)
            total += self.directions.products(first, second, rates, stepped)
        return total

    def maps(self) -> tuple[PositiveMap, FloatArray | None]:
        """Return X -> L^-1(inflow(X)) and L^-1(noise), L X = -(B X + X B'); None if unstable."""
        if max(map(growth_rate, self.flows)) >= 0.0:
            return self.inflow, None
        inverse = LyapunovInverse(self.flows)
        stationary = self.directions.stationary if self.directions else np.ones(1)
        noise = inverse(stationary[:, None, None] * self.noise)
        return lambda X: inverse(self.inflow(X)), noise


def _block_slice(X: FloatArray, nodes: int, i: int) -> FloatArray:
    n = X.shape[1] // nodes
    return X[:, i * n : (i + 1) * n, i * n : (i + 1) * n]


def _multiply_blocks(maps: FloatArray, X: FloatArray, nodes: int) -> FloatArray:
    """Return ``C X C'`` (S, M, M) for block diagonal C of N blocks ``maps``, or one for all."""
    S, M, _ = X.shape
    n = M // nodes
    CX = (maps @ X.reshape(S, nodes, n, M)).reshape(S, M, M)
    transposed = np.ascontiguousarray(np.swapaxes(CX, 1, 2)).reshape(S, nodes, n, M)
    return np.asarray((maps @ transposed).reshape(S, M, M))


class LyapunovInverse:
    """The inverse of ``X -> -(B X + X B')`` for stable matrices B (S, M, M), by Schur forms."""

    def __init__(self, B: FloatArray) -> None:
        """Compute the Schur forms of S stable matrices ``B`` (S, M, M)."""
        self._forms = [scipy.linalg.schur(matrix)[:2] for matrix in B]

    def __call__(self, Y: FloatArray) -> FloatArray:
        """Return X (S, M, M) with ``B X + X B' + Y = 0`` for Y (S, M, M), matrix by matrix."""
        return np.stack([self._solve(T, U, M) for (T, U), M in zip(self._forms, Y, strict=True)])

    @staticmethod
    def _solve(T: FloatArray, U: FloatArray, Y: FloatArray) -> FloatArray:
        """Return X (M, M), A X + X A' = -Y, by a real Schur form (Bartels and Stewart 1972)."""
        X, scale, _ = scipy.linalg.lapack.dtrsyl(T, T, -(U.T @ Y @ U), trana="N", tranb="T")
        return symmetric(np.asarray(U @ (X / scale) @ U.T))
