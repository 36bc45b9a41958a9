"""The response of a linear plant to its input: the state m(t) that the input alone would give.

``m' = A m + G u``, in slots ``m[k+1] = F m[k] + G u[k]``, from m(0) = 0 on. The state of a driven
plant is that of the same plant without input plus m. It is computed exactly: input and response
together are a linear system that nothing drives, and its state moves by one exponential of
``[[A, G C], [0, S]]`` over any gap, see ``inputs``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from netkf.core.instants import TimeGrid
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.portable import apply
from netkf.plants.inputs import Exogenous, Input
from netkf.plants.linear import LinearPlant
from netkf.plants.transitions import Transitions

CHUNK = 4096  # transitions computed at once
SLOTS = 256  # slots computed at once, at least


class Response(Protocol):
    """The response m to an input."""

    def states(self, times: np.ndarray) -> FloatArray:
        """Return m (K, n) at K ``times`` (K,) in seconds; of a plant in slots, at K slots."""


@kernel(allocates=True)
def _recur(start: FloatArray, moves: FloatArray, drive: FloatArray, out: FloatArray) -> None:
    """Write ``m[k+1] = moves[k] m[k] + drive[k]`` from m[0] = ``start`` into ``out`` (K, n)."""
    m = start.copy()
    for k in range(len(drive)):
        move = moves[min(k, len(moves) - 1)]
        for i in range(len(m)):
            total = drive[k, i]
            for j in range(len(m)):
                total += move[i, j] * m[j]
            out[k, i] = total
        m[:] = out[k]


def _follow(start: FloatArray, moves: FloatArray, drive: FloatArray) -> FloatArray:
    """Return m[1], m[2], ... (K, n), see ``_recur``."""
    out = np.empty(drive.shape)
    _recur(np.array(start), moves, np.array(drive), out)
    return out


class FlowResponse:
    """The response to the input ``u`` of a diffusion with A (n, n) and G (n, m) of ``pieces``, the
    first up to ``changes[0]`` seconds, the second from there on, and so on.
    """

    def __init__(
        self, pieces: Sequence[tuple[FloatArray, FloatArray]], changes: FloatArray, u: Input
    ) -> None:
        times, S, C, z = u.exogenous
        self.n, self._changes, self._u, q = len(pieces[0][0]), changes, u, len(S)
        self._A, self._G = (np.array(parts) for parts in zip(*pieces, strict=True))
        # The input begins anew, as it is, where the plant changes.
        added = np.setdiff1d(changes, times)
        if len(added):
            z = np.concatenate([z, u.exogenous.states(added)])
            times = np.concatenate([times, added])
            z, times = z[np.argsort(times)], np.sort(times)
        self._exogenous, self.jumps = Exogenous(times, S, C, z), times
        self.joint = [np.block([[A, G @ C], [np.zeros((q, self.n)), S]]) for A, G in pieces]
        self._moves = [Transitions(joint, np.zeros((len(joint), 1))) for joint in self.joint]
        # m where the input jumps, as far as it has been asked for.
        self._at_jumps = np.zeros((min(len(z), 1), self.n))

    def _transitions(self, starts: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return the transitions (K, n + q, n + q) over ``gaps`` from ``starts`` on, both (K,)."""
        if len(self._moves) == 1:
            return self._moves[0].transitions(gaps)
        pieces = np.searchsorted(self._changes, starts, side="right")
        out = np.empty((len(gaps), *self.joint[0].shape))
        for piece in np.unique(pieces).tolist():
            inside = pieces == piece
            out[inside] = self._moves[piece].transitions(gaps[inside])
        return out

    def joint_states(self, times: FloatArray) -> FloatArray:
        """Return m and the state of the input, (K, n + q), at K ``times`` (K,) in seconds."""
        last = self._exogenous.last(times)
        starts = self._starts(int(last.max(initial=-1)))
        out = np.zeros((len(times), len(self.joint[0])))
        begun = np.flatnonzero(last >= 0)
        for k in range(0, len(begun), CHUNK):
            chunk = begun[k : k + CHUNK]
            begin = self._exogenous.times[last[chunk]]
            moves = self._transitions(begin, times[chunk] - begin)
            out[chunk] = apply(moves, starts[last[chunk]])
        return out

    def states(self, times: np.ndarray) -> FloatArray:
        """Return m (K, n) at K ``times`` (K,) in seconds."""
        return self.joint_states(times)[:, : self.n]

    def A_at(self, times: FloatArray) -> FloatArray:
        """Return A (K, n, n) at K ``times`` (K,) in seconds."""
        return np.asarray(self._A[np.searchsorted(self._changes, times, side="right")])

    def drive(self, times: FloatArray) -> FloatArray:
        """Return what drives m, ``m' - A m`` (K, n), at K ``times`` (K,) in seconds."""
        piece = np.searchsorted(self._changes, times, side="right")
        return apply(self._G[piece], self._u.values(times))

    def _starts(self, last: int) -> FloatArray:
        """Return m and the state of the input (last + 1, n + q) at its jumps up to ``last``."""
        times, z, n = self._exogenous.times, self._exogenous.z, self.n
        for first in range(len(self._at_jumps) - 1, last, CHUNK):
            stop = min(first + CHUNK, last)
            moves = self._transitions(times[first:stop], np.diff(times[first : stop + 1]))
            drive = apply(moves[:, :n, n:], z[first:stop])
            driven = _follow(self._at_jumps[-1], np.array(moves[:, :n, :n]), drive)
            self._at_jumps = np.concatenate([self._at_jumps, driven])
        return np.hstack([self._at_jumps[: last + 1], z[: last + 1]])

    def over_pieces(
        self, start: FloatArray, end: FloatArray, grid: TimeGrid
    ) -> tuple[FloatArray, FloatArray]:
        """Return m (K, n) at the ``start`` of K pieces of time, which follow each other without a
        change of the plant, and end state and both moments (K, 3, n) of each, see ``paths``.
        """
        joint = self.joint[int(np.searchsorted(self._changes, start[0], side="right"))]
        n, N, jumps = self.n, len(joint), self._exogenous.times
        inside = jumps[(jumps > start[0]) & (jumps < end[-1])]
        first = np.unique(np.concatenate([start, inside]))
        last = np.append(first[1:], end[-1])
        gaps, w = grid.snap(last - first), self.joint_states(first)
        # exp([[M, I, 0], [0, 0, I], [0, 0, 0]] g) has the integrals of e^{M s} and of (g - s) e^{M
        # s} over the gap g in its first row of blocks.
        nested = np.zeros((3 * N, 3 * N))
        nested[:N, :N] = joint
        nested[:N, N : 2 * N] = np.eye(N)
        nested[N : 2 * N, 2 * N :] = np.eye(N)
        moves = Transitions(nested, np.zeros((3 * N, 1))).transitions(gaps)[:, :n]
        ends, plain, tail = (apply(moves[..., k * N : (k + 1) * N], w) for k in range(3))
        # P_1 = 2 s / g - 1, and s = g - (g - s).
        tilted = plain - 2.0 * tail / gaps[:, None]
        # Parts of a piece that the input cuts: P_1 of the piece is middle + share P_1 of the part.
        piece = np.searchsorted(start, first, side="right") - 1
        length = (end - start)[piece]
        middle = ((first - start[piece]) - (end[piece] - last)) / length
        tilted = middle[:, None] * plain + (gaps / length)[:, None] * tilted
        begins = np.searchsorted(piece, np.arange(len(start)))
        sums = [np.add.reduceat(values, begins) for values in (plain, tilted)]
        stops = ends[np.append(begins[1:], len(first)) - 1]
        return w[begins, :n], np.stack([stops, *sums], axis=1)


def moments_over(response: Any, start: float, end: float, grid: TimeGrid) -> FloatArray:
    """Return the two moments (2, n) of a ``response`` over [start, end] seconds, in which the plant
    does not change, see ``paths``.
    """
    return np.asarray(response.over_pieces(np.array([start]), np.array([end]), grid)[1][0, 1:])


class SlotResponse:
    """The response to the input of a ``plant`` in slots, moved by F (n, n) and G (n, m) of
    ``pieces``, the first before slot ``changes[0]``, the second from there on, and so on.
    """

    def __init__(
        self,
        pieces: Sequence[tuple[FloatArray, FloatArray]],
        changes: Sequence[int],
        plant: LinearPlant,
    ) -> None:
        assert plant.input is not None
        self._F, self._G = (np.array(parts) for parts in zip(*pieces, strict=True))
        self._changes, self._u, self._plant = changes, plant.input, plant
        self._states = np.zeros((1, len(self._F[0])))

    def states(self, slots: np.ndarray) -> FloatArray:
        """Return m (K, n) in K ``slots`` (K,) by number."""
        needed, known = int(np.max(slots, initial=0)) + 1, len(self._states)
        if needed > known:
            driving = np.arange(known - 1, max(needed, known + SLOTS) - 1)
            starts = self._plant.time_grid.snap(driving * self._plant.period)
            piece = np.searchsorted(self._changes, driving, side="right")
            drive = apply(self._G[piece], self._u.values(starts))
            moves = self._F if len(self._F) == 1 else self._F[piece]
            driven = _follow(self._states[-1], np.array(moves), drive)
            self._states = np.concatenate([self._states, driven])
        return np.asarray(self._states[slots])


class Difference:
    """The response ``true`` minus the one that filters believe."""

    def __init__(self, true: Any, believed: Any) -> None:
        self._true, self._believed = true, believed

    def states(self, times: np.ndarray) -> FloatArray:
        """Return the difference (K, n) at K ``times`` (K,) in seconds, or in K slots."""
        return np.asarray(self._true.states(times) - self._believed.states(times))

    @property
    def jumps(self) -> FloatArray:
        """Times (J,) in seconds at which the input jumps."""
        return np.asarray(self._true.jumps)

    def drive(self, times: FloatArray) -> FloatArray:
        """Return what drives the difference in the plant, (K, n), at K ``times`` (K,)."""
        true, believed = self._true, self._believed
        moved = apply(true.A_at(times) - believed.A_at(times), believed.states(times))
        return np.asarray(moved + true.drive(times) - believed.drive(times))

    def over_pieces(
        self, start: FloatArray, end: FloatArray, grid: TimeGrid
    ) -> tuple[FloatArray, FloatArray]:
        """Return the difference of what ``FlowResponse.over_pieces`` returns."""
        true, believed = (r.over_pieces(start, end, grid) for r in (self._true, self._believed))
        return true[0] - believed[0], true[1] - believed[1]
