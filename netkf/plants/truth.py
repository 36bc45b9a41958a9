"""The true state of one run in continuous time, and its frames.

Errors ``x - xhat`` of affine filters do not change when the truth, the readings and all estimates
are shifted along a solution of ``dc = A c dt``. On an unstable plant the state is therefore reset
to zero at every *frame time* (a *rebase*), which starts a new *frame*. ``local`` states are
relative to the origin of the present frame, which moves with the plant; they keep the digits that
``absolute`` states lose as they grow.

*Samples* are the times at which a sensor reads the state, *probes* those at which it is recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.core.instants import TimeGrid
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply
from netkf.plants.transitions import Transitions
from netkf.plants.tree import Tree

TOLERANCE = 1e-9  # seconds by which a recorded time may be off


def multiples(period: float | None, horizon: float, grid: TimeGrid) -> FloatArray:
    """Return the multiples (K,) of ``period`` or None in (0, horizon) s, on the ``grid``."""
    if period is None or period >= horizon:
        return np.empty(0)
    times = grid.snap(period * np.arange(1, int(horizon / period) + 2))
    return np.asarray(times[times < horizon])


def absolute_states(
    moves: Transitions, frame_times: FloatArray, offsets: FloatArray, t: FloatArray, x: FloatArray
) -> FloatArray:
    """Return the states (..., K, n) in the plant's coordinates at K times ``t`` (K,) in seconds,
    from local states ``x`` (..., K, n).

    A frame begins at 0 and at each of ``frame_times`` (F,), in seconds; ``offsets`` (..., F, n) are
    the local states just before these rebases. At a frame time ``x`` is local to the new frame.
    ``moves`` gives the transitions of the plant.
    """
    starts = np.concatenate([[0.0], frame_times])
    frame, Phi = np.searchsorted(frame_times, t, side="right"), moves.transitions(np.diff(starts))
    # The position of the origin of each frame at its start: 0, then c[k+1] = Phi[k] c[k] + offset.
    origin = np.zeros((*x.shape[:-2], len(starts), x.shape[-1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(frame_times)):
            origin[..., k + 1, :] = _moved(Phi[k], origin[..., k, :]) + offsets[..., k, :]
        shift = _moved(moves.transitions(t - starts[frame]), origin[..., frame, :])
        return np.asarray(x + shift)


def _moved(Phi: FloatArray, x: FloatArray) -> FloatArray:
    # An origin at 0 stays there; the product is nan where a transition has overflowed.
    return np.where(x.any(axis=-1, keepdims=True), apply(Phi, x), 0.0)


class SampledTruth:
    """A path of a plant that is drawn at some instants only, from the ``tree`` of its cells, so
    that a state depends on its instant and not on the others.
    """

    def __init__(
        self,
        moves: Transitions,
        tree: Tree,
        start: FloatArray,
        stream: np.ndarray,
        times: FloatArray,
        frame_times: FloatArray,
        frames: bool,
    ) -> None:
        """Draw the path from ``start`` (n,) on at ``times`` (K,) in seconds. ``stream`` (1, WIDTH)
        is the state of its random stream, ``frame_times`` (F,) are those of the tree up to the last
        time. Without ``frames`` the path is the same, and its origin does not move.
        """
        self._times = np.unique(np.concatenate([[0.0], times, frame_times]))
        self._local, self.offsets = tree.states(self._times, start, stream, len(frame_times))
        self.frame_times, self._absolute = frame_times, self._local
        if len(frame_times):
            self._absolute = absolute_states(
                moves, frame_times, self.offsets, self._times, self._local
            )
        if not frames:
            self.frame_times, self._local = np.empty(0), self._absolute

    def _index_of(self, time: float) -> int:
        k = int(np.searchsorted(self._times, time))
        assert k < len(self._times), f"{time} is no sample, probe or frame time"
        assert self._times[k] == time, f"{time} is no sample, probe or frame time"
        return k

    def local(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds), relative to the origin of the present frame."""
        return np.asarray(self._local[self._index_of(time)])

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds), in the plant's coordinates."""
        return np.asarray(self._absolute[self._index_of(time)])

    def rebase(self, k: int) -> FloatArray:
        """Return the local state (n,) just before ``frame_times[k]``."""
        return np.asarray(self.offsets[k])

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (K, n) at ``times`` (K,) of the path, in any order."""
        indices = np.searchsorted(self._times, times)
        return self._local[indices], self._absolute[indices]


class ChangingTruth(SampledTruth):
    """A path of a plant that changes, drawn from the tree of each of its pieces, which begins at
    its change with the state in which the piece before it ends; its origin does not move.
    """

    def __init__(
        self,
        trees: Sequence[Tree],
        changes: FloatArray,
        start: FloatArray,
        stream: np.ndarray,
        times: FloatArray,
        grid: TimeGrid,
    ) -> None:
        """Draw the path from ``start`` (n,) on at ``times`` (K,) in seconds, with the state
        ``stream`` (1, WIDTH) of its random stream; ``changes`` (C,) are where its pieces end.
        """
        self._times = np.unique(np.concatenate([[0.0], times]))
        self._local, x = np.empty((len(self._times), len(start))), start
        edges = [0.0, *changes.tolist(), math.inf]
        for tree, begin, end in zip(trees, edges[:-1], edges[1:], strict=True):
            inside = (self._times >= begin) & (self._times < end)
            last = [end] if end <= self._times[-1] else []
            moments = grid.snap(np.concatenate([self._times[inside], last]) - begin)
            if not len(moments):
                break
            states, _ = tree.states(moments, x, stream, 0)
            self._local[inside], x = states[: inside.sum()], states[-1]
        self._absolute, self.offsets = self._local, np.empty((0, len(start)))
        self.frame_times = np.empty(0)


class WithoutFrames:
    """A truth, in slots or not, whose origin does not move."""

    frame_slots: int | None = None
    frame_times = np.empty(0)

    def rebase(self, k: int) -> FloatArray:
        """Raise IndexError: no frame begins, neither number ``k`` nor in a slot ``k``."""
        raise IndexError(k)


class RecordedTruth(WithoutFrames):
    """Known states (K, n) at recorded ``times`` (K,) in seconds, which increase. Between these, up
    to 1e-9 s, states are nan unless ``interpolate`` is "linear", or "hold": the last one counts.
    """

    def __init__(
        self, times: FloatArray, states: FloatArray, n: int, interpolate: str | None = None
    ) -> None:
        self.times, self._states, self._interpolate = times, states, interpolate
        self.n, self._missing = n, np.full(n, math.nan)

    def rows_at(self, time: float) -> tuple[int, ...]:
        """Return the indices of the rows that say the state at ``time`` (seconds): one, or the two
        on either side of it; none if the state is unknown.
        """
        k = nearest_row(self.times, time)
        if k is not None:
            return (k,)
        after = int(np.searchsorted(self.times, time))
        if self._interpolate is None or not 0 < after < len(self.times):
            return ()
        return (after - 1,) if self._interpolate == "hold" else (after - 1, after)

    def local(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds); nan where it is unknown."""
        rows = self.rows_at(time)
        if len(rows) < 2:
            return np.asarray(self._states[rows[0]]) if rows else self._missing
        first, last = rows
        share = (time - self.times[first]) / (self.times[last] - self.times[first])
        return np.asarray((1.0 - share) * self._states[first] + share * self._states[last])

    absolute = local

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (K, n) each at ``times`` (K,), in any order."""
        x = [(self.local(time), self.absolute(time)) for time in times.tolist()]
        local, absolute = np.array(x).reshape(-1, 2, self.n).swapaxes(0, 1)
        return local, absolute


def nearest_row(times: FloatArray, time: float) -> int | None:
    """Return the index in ``times`` (K,), increasing, of the one within 1e-9 s of ``time``."""
    k = int(np.searchsorted(times, time - TOLERANCE))
    return k if k < len(times) and times[k] <= time + TOLERANCE else None


def demand_states(source: SourceFile, truth: RecordedTruth, needed: FloatArray, use: str) -> None:
    """Raise ScenarioError for the first of the ``needed`` times (M,), in seconds, at which the
    ``truth`` of the table in the file ``source`` is unknown; ``use`` says what it is for.
    """
    for time in needed.tolist():
        if truth.rows_at(time):
            continue
        times = truth.times
        remedy = "add the row, or set [time] origin and horizon"
        if len(times) and times[0] < time < times[-1]:
            remedy = 'add the row, or write interpolate = "linear" or "hold"'
        elif len(times):
            remedy += f"; the rows are from t = {times[0]:.9g} to {times[-1]:.9g}"
        rule = f"{source.name} has no state for {use}, t = {time:.9g}"
        raise ScenarioError("path", rule, None, remedy)
