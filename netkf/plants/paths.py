"""The path of a diffusion in one run, drawn block by block of steps of the sensing grid.

The path is drawn exactly on the sensing grid ``t_k = k h``: each step gives ``x(t_{k+1})`` and the
two moments of x over the step (core/legendre), all from one stream and whatever the network does.
Between grid points, filters that are woken by the network need part of a step. There the path is
the response to the state at the grid point plus the cubic that agrees with the step's end and with
its two moments; what that leaves out of a reading is of third order in h and less than 1e-4 h^3 of
the noise intensity. Where a state is to be *shown* off the grid, the step is cut there beforehand:
state and moments are drawn from their exact law given the step, from a second stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.compiling import in_place
from netkf.core.series import fill_polynomial, polynomial
from netkf.core.small import added, applied
from netkf.plants.laws import Laws, grid_time

BLOCK = 64  # steps drawn at once, or a multiple of it
_THREE, _THREE_WEIGHTS = np.polynomial.legendre.leggauss(3)
_THREE_MOMENTS = np.stack([_THREE_WEIGHTS, _THREE_WEIGHTS * _THREE])


class Step(NamedTuple):
    """One stretch of the path: times, states at its ends, (2, n) moments and the cubic's (4, n)
    Legendre coefficients of what noise added.
    """

    start: float
    end: float
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray


class Block(NamedTuple):
    """Some steps S as K pieces, since a step is cut where a state is shown: ``start, end`` (K,), x
    at both (K, n), ``moments`` (K, 2, n), ``cubic`` (K, 4, n) and whose ``step`` (K,) each is;
    ``ends`` (S,) of the steps. What is random comes for B paths at once, (B, K, ...).
    """

    start: FloatArray
    end: FloatArray
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray
    step: np.ndarray
    ends: FloatArray

    def of(self, k: int) -> Block:
        """That of path ``k``."""
        return self._replace(
            x_start=self.x_start[k],
            x_end=self.x_end[k],
            moments=self.moments[k],
            cubic=self.cubic[k],
        )


class DiffusionPaths:
    """The paths of B runs, which are cut at the same times: ``start`` (B, n), the sources of each,
    and the times ``shown`` (increasing) at which states are shown.

    Each path is to the last bit what it is alone, and however many steps are drawn at once.
    """

    def __init__(
        self,
        laws: Laws,
        start: FloatArray,
        randoms: Sequence[np.random.Generator],
        probings: Sequence[np.random.Generator],
        shown: FloatArray,
    ) -> None:
        self.laws, self._randoms, self._probings, self._shown = laws, randoms, probings, shown
        self._x, self._drawn = start, 0

    def following(self, blocks: int = 1) -> Block:
        """The next steps of the sensing grid, ``blocks`` times BLOCK."""
        laws, (count, n), total = self.laws, self._x.shape, blocks * BLOCK
        # Block by block, so that no path is rounded as its neighbours happen to be.
        size = blocks, BLOCK, 3 * n
        normals = np.stack([random.standard_normal(size) for random in self._randoms])
        noise = (normals @ laws.spread.T).reshape(count * blocks, BLOCK, 3, n)
        cubic = _cubics(laws.period, noise[:, :, 0], noise[:, :, 1:])
        onwards = noise[:, :, 0].reshape(count, blocks, BLOCK, n)
        x = laws.steps.states(self._x, onwards)
        self._x = x[:, -1]
        before = x[:, :-1].reshape(count * blocks, BLOCK, n)
        moments = _moved(laws.response[1:], before) + noise[:, :, 1:]
        times = laws.grid(self._drawn, total + 1)
        self._drawn += total
        whole = Block(
            start=times[:-1],
            end=times[1:],
            x_start=x[:, :-1],
            x_end=x[:, 1:],
            moments=moments.reshape(count, total, 2, n),
            cubic=cubic.reshape(count, total, 4, n),
            step=np.arange(total),
            ends=times[1:],
        )
        first, last = np.searchsorted(self._shown, times[[0, -1]], side="right")
        shown = self._shown[first:last]
        inside = shown[~np.isin(shown, whole.ends)]
        return self._cut(whole, inside) if len(inside) else whole

    def _cut(self, block: Block, shown: FloatArray) -> Block:
        """The block with pieces that end at the times ``shown``, which are inside its steps."""
        steps = np.searchsorted(block.ends, shown)
        size = len(shown), 3 * self.laws.n
        normals = np.stack([probing.standard_normal(size) for probing in self._probings])
        counts = 1 + np.bincount(steps, minlength=len(block.ends))
        # A step that is cut twice is cut at the first time, and what is left of it at the second.
        turn = np.arange(len(shown)) - np.searchsorted(steps, steps)
        which = np.repeat(block.step, counts)
        pieces = Block(
            start=block.start[which],
            end=block.end[which],
            x_start=block.x_start[:, which],
            x_end=block.x_end[:, which],
            moments=block.moments[:, which],
            cubic=block.cubic[:, which],
            step=which,
            ends=block.ends,
        )
        rows = (np.cumsum(counts) - counts)[steps] + turn
        for k in range(int(turn.max()) + 1):
            chosen = turn == k
            lengths = np.round(pieces.end[rows[chosen]] - pieces.start[rows[chosen]], 12)
            lefts = np.round(shown[chosen] - pieces.start[rows[chosen]], 12)
            laws = np.unique(np.stack([lengths, lefts]), axis=1, return_inverse=True)[1].ravel()
            for law in range(int(laws.max()) + 1):
                same = np.flatnonzero(chosen)[laws == law]
                self._split(pieces, rows[same], shown[same], normals[:, same])
        return pieces

    def _split(
        self,
        pieces: Block,
        rows: np.ndarray,
        times: FloatArray,
        normals: FloatArray,
    ) -> None:
        """Draw the paths at ``times`` given the pieces in ``rows``, all of one length and cut at
        the same place, and divide each with all rows of its step that come after it.
        """
        n, laws = self.laws.n, self.laws
        length = float(pieces.end[rows[0]] - pieces.start[rows[0]])
        left = float(times[0] - pieces.start[rows[0]])
        gain, spread = laws.split(length, left)
        x, end = pieces.x_start[:, rows], pieces.x_end[:, rows]
        known = np.concatenate([end[:, :, None], pieces.moments[:, rows]], axis=2)
        residual = (known - _moved(laws.responses(length), x)).reshape(*x.shape[:2], 3 * n)
        noise = (residual @ gain.T + normals @ spread.T).reshape(known.shape)
        values = _moved(laws.responses(left), x) + noise
        middle, first = values[:, :, 0], values[:, :, 1:]
        share = left / length
        # Moments of the rest: the whole's P_1 is (share - 1) + share P_1 on the left part and
        # share + (1 - share) P_1 on the right one.
        plain = known[:, :, 1] - first[:, :, 0]
        tilted = known[:, :, 2] - (share - 1.0) * first[:, :, 0] - share * first[:, :, 1]
        second = np.stack([plain, (tilted - share * plain) / (1.0 - share)], axis=2)
        later = np.concatenate([end[:, :, None], second], axis=2)
        later -= _moved(laws.responses(length - left), middle)
        cubics = _cubics(left, noise[:, :, 0], noise[:, :, 1:])
        rest = _cubics(length - left, later[:, :, 0], later[:, :, 1:])
        pieces.end[rows], pieces.x_end[:, rows] = times, middle
        pieces.moments[:, rows], pieces.cubic[:, rows] = first, cubics
        stops = np.searchsorted(pieces.step, pieces.step[rows], side="right")
        for k, (row, stop) in enumerate(zip(rows.tolist(), stops.tolist(), strict=True)):
            after = slice(row + 1, stop)
            pieces.start[after], pieces.x_start[:, after] = times[k], middle[:, k, None]
            pieces.moments[:, after], pieces.cubic[:, after] = second[:, k, None], rest[:, k, None]


class DiffusionPath:
    """The path of one run, asked for step by step."""

    def __init__(self, paths: DiffusionPaths) -> None:
        self.laws, self.period, self._paths = paths.laws, paths.laws.period, paths
        self._block: Block | None = None
        self._first = self._piece = 0  # of the present step, and the one last asked for
        self._step, self._step_end = Step(0.0, 0.0, *[np.empty(0)] * 4), 0.0

    def grid(self, k: int) -> float:
        """Time of the k-th point of the sensing grid."""
        return grid_time(self.period, k)

    def _at(self, time: float) -> Step:
        """The piece that ``time`` is in; it may lie before the last one asked for, in its step."""
        while self._block is None or time > self._block.ends[-1]:
            self._block, self._first, self._piece = self._paths.following().of(0), 0, -1
        block, k = self._block, self._first
        while block.end[k] < time:
            k += 1
        if k != self._piece:
            self._piece = k
            self._step = Step(*(part[k] for part in block[:6]))
            self._step_end = float(block.ends[block.step[k]])
            self._first = int(np.searchsorted(block.step, block.step[k]))
        return self._step

    def step_end(self) -> float:
        """Where the sensing step that was last asked for ends."""
        return self._step_end

    def moments(self, start: float, end: float) -> FloatArray:
        """(2, n) moments of x over ``[start, end]``, which lies inside one sensing step and not in
        one before the last one asked for.
        """
        step = self._at(end)
        return seen(self.laws, step, start, end)

    def state(self, time: float) -> FloatArray:
        """x(time) on the sensing grid or at a time shown, not before the last one asked for."""
        step = self._at(time)
        assert time in (step.start, step.end), f"{time} is neither on the grid nor shown"
        return step.x_end if time == step.end else step.x_start


def _moved(responses: FloatArray, x: FloatArray) -> FloatArray:
    """(B, K, m, n) of responses (m, n, n) to states (B, K, n)."""
    return np.swapaxes(x[:, None] @ np.swapaxes(responses, 1, 2), 1, 2)


def _cubics(length: float, end: FloatArray, moments: FloatArray) -> FloatArray:
    """(B, K, 4, n) Legendre coefficients of the cubics on [0, 1] that start at 0, end at ``end``
    (B, K, n) and have these moments (B, K, 2, n).
    """
    mean, slope = moments[:, :, 0] / length, 3.0 * moments[:, :, 1] / length
    return np.stack([mean, slope, 0.5 * end - mean, 0.5 * end - slope], axis=2)


@in_place
def _fill_legendre(out: FloatArray, since: float, gap: float, length: float) -> None:
    """Write (2, 4) the two moments over ``gap`` seconds from ``since`` on of the Legendre
    polynomials of a step of ``length`` seconds, by Gauss's rule with three nodes, which is exact.
    """
    for m in range(2):
        for c in range(4):
            out[m, c] = 0.0
    for k in range(3):
        z = 2.0 * (since + 0.5 * gap * (1.0 + _THREE[k])) / length - 1.0
        square = z * z
        for m in range(2):
            weight = 0.5 * gap * _THREE_MOMENTS[m, k]
            out[m, 0] += weight
            out[m, 1] += weight * z
            out[m, 2] += weight * (1.5 * square - 0.5)
            out[m, 3] += weight * (2.5 * square - 1.5) * z


def seen(laws: Laws, step: Step, start: float, end: float) -> FloatArray:
    """(2, n) moments of x over ``[start, end]`` inside a step."""
    n = len(step.x_start)
    if start == step.start and end == step.end:
        return step.moments
    since, gap = start - step.start, end - start
    x = step.x_start
    if since > 0.0:
        x = applied(polynomial(laws.to_end, since).reshape(n, n), x)
    plain = applied(polynomial(laws.to_moments, gap).reshape(2 * n, n), x).reshape(2, n)
    from_noise = np.empty((2, 4))
    _fill_legendre(from_noise, since, gap, step.end - step.start)
    return added(plain, from_noise, step.cubic)


@in_place
def fill_seen(
    out: FloatArray,
    to_end: FloatArray,
    to_moments: FloatArray,
    since: float,
    gap: float,
    length: float,
    x_start: FloatArray,
    cubic: FloatArray,
    k: int,
    responses: FloatArray,
    x: FloatArray,
    from_noise: FloatArray,
) -> None:
    """``seen`` in loops, ``gap`` seconds from ``since`` on in piece ``k`` of ``length`` seconds,
    into ``out`` (2, n); ``responses`` (2 n n,), ``x`` (n,) and ``from_noise`` (2, 4) are room to
    work in.
    """
    n = len(x)
    for i in range(n):
        x[i] = x_start[k, i]
    if since > 0.0:
        fill_polynomial(responses[: n * n], to_end, since)
        for i in range(n):
            x[i] = 0.0
            for j in range(n):
                x[i] += responses[i * n + j] * x_start[k, j]
    fill_polynomial(responses, to_moments, gap)
    _fill_legendre(from_noise, since, gap, length)
    for m in range(2):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += responses[(m * n + i) * n + j] * x[j]
            for c in range(4):
                total += from_noise[m, c] * cubic[k, c, i]
            out[m, i] = total
