"""The true state of one run in continuous time, and the frames in which it is given.

Errors ``x - xhat`` of affine filters do not change when the truth, the readings and all estimates
are shifted along a solution of ``dc = A c dt``. On an unstable plant the state therefore starts
again from zero at every *frame time*: ``local`` states are counted from the origin of the present
frame, which moves with the plant, and keep the digits that ``absolute`` ones lose to growth.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply
from netkf.plants.transitions import Transitions

TOLERANCE = 1e-9  # seconds by which a recorded time may be off
BLOCK = 1024  # laws worked out at once


class ContinuousTruth(Protocol):
    """The state of one run, at sample times, probe times and frame times.

    At a frame time the state is that after the rebase, so ``local`` is zero.
    """

    @property
    def frame_times(self) -> FloatArray:
        """(F,) increasing, inside the run; empty unless frames are used."""

    def local(self, time: float) -> FloatArray:
        """Return x (n,) in the present frame."""

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,)."""

    def rebase(self, k: int) -> FloatArray:
        """Return the shift (n,) to subtract from estimates at ``frame_times[k]``: the local state
        just before.
        """


def multiples(period: float | None, horizon: float) -> FloatArray:
    """Return the multiples of ``period`` in (0, horizon)."""
    if period is None or period >= horizon:
        return np.empty(0)
    times = period * np.arange(1, int(horizon / period) + 2)
    return np.asarray(times[times < horizon])


def origins(Phi: FloatArray, offsets: FloatArray) -> FloatArray:
    """Return the absolute state (F + 1, n) at the origin of each frame when the frame begins, 0 for
    the first.

    ``Phi`` (F, n, n) are the transitions over the frames that end by a rebase, ``offsets`` (F, n)
    the local states that become the new origins.
    """
    found = np.zeros((len(offsets) + 1, offsets.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for k, offset in enumerate(offsets):
            # An origin at 0 stays there; the product would be nan if Phi has overflowed.
            found[k + 1] = apply(Phi[k], found[k]) + offset if found[k].any() else offset
    return found


def absolute_states(
    moves: Transitions, frame_times: FloatArray, offsets: FloatArray, t: FloatArray, x: FloatArray
) -> FloatArray:
    """Return absolute states (K, n) at times ``t`` (K,) from local states ``x`` (K, n).

    A frame begins at 0 and at each of ``frame_times`` (F,), in seconds; ``offsets`` (F, n) are the
    local states by which its origin was moved. At a frame time ``x`` is local to the new frame.
    """
    starts = np.concatenate([[0.0], frame_times])
    at_start = origins(moves.transitions(np.diff(starts)), offsets)
    frame = np.searchsorted(frame_times, t, side="right")
    with np.errstate(over="ignore", invalid="ignore"):
        shift = apply(moves.transitions(t - starts[frame]), at_start[frame])
        # An origin at 0 stays there; the product is nan where a transition has overflowed.
        shift[~at_start[frame].any(axis=1)] = 0.0
        return np.asarray(x + shift)


class TruthTimes(NamedTuple):
    """Times in seconds of samples, of probes and of the marks at which frames may begin."""

    samples: FloatArray
    probes: FloatArray
    marks: FloatArray


class SampledTruth:
    """A path drawn exactly at ``samples`` and ``marks`` from ``random``, and at ``probes`` from
    ``probing`` by the exact conditional law, so that neither probes nor the network move it.

    ``start`` (n,) is x(0). ``marks`` are the frame times of the plant; they are used as such only
    with ``frames``, and the path is the same without. All times in seconds, at least 0.
    """

    def __init__(
        self,
        moves: Transitions,
        start: FloatArray,
        random: np.random.Generator,
        probing: np.random.Generator,
        at: TruthTimes,
        frames: bool,
    ) -> None:
        self._moves = moves
        samples, probes, marks = at
        self.frame_times = marks if frames else np.empty(0)
        times = np.unique(np.concatenate([[0.0], samples, marks]))
        inside = np.unique(probes[~np.isin(probes, times)])
        rebased = np.isin(times, self.frame_times)
        before, normals = _draw_states(moves, start, random, times, rebased)
        self.offsets = before[rebased]
        after = np.where(rebased[:, None], 0.0, before)
        between = _bridge_gap(moves, times, after, normals, probing, inside)
        order = np.argsort(np.concatenate([times, inside]), kind="stable")
        self._times = np.concatenate([times, inside])[order]
        self._local = np.concatenate([after, between])[order]
        self._absolute = self._local
        if frames:
            self._absolute = absolute_states(
                moves, self.frame_times, self.offsets, self._times, self._local
            )

    def _index_of(self, time: float) -> int:
        """Return the index of a time among those of the truth."""
        k = int(np.searchsorted(self._times, time))
        assert k < len(self._times), f"{time} is no sample, probe or frame time"
        assert self._times[k] == time, f"{time} is no sample, probe or frame time"
        return k

    def local(self, time: float) -> FloatArray:
        """Return x (n,) in the present frame."""
        return np.asarray(self._local[self._index_of(time)])

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,)."""
        return np.asarray(self._absolute[self._index_of(time)])

    def rebase(self, k: int) -> FloatArray:
        """Return the local state (n,) just before ``frame_times[k]``."""
        return np.asarray(self.offsets[k])

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (K, n) at times in any order."""
        indices = np.searchsorted(self._times, times)
        return self._local[indices], self._absolute[indices]


def _draw_states(
    moves: Transitions,
    start: FloatArray,
    random: np.random.Generator,
    times: FloatArray,
    rebased: np.ndarray,
) -> tuple[FloatArray, FloatArray]:
    """Return states (K, n) at ``times`` (K,) just before any rebase, which makes them 0, and the
    normals (K - 1, n) of the gaps.
    """
    gaps = np.diff(times)
    states = np.empty((len(times), moves.n))
    states[0] = x = start
    drawn = [np.empty((0, moves.n))]
    for first in range(0, len(gaps), BLOCK):
        Phi, L = moves.laws(gaps[first : first + BLOCK])
        normals = random.standard_normal((len(Phi), moves.n))
        drawn.append(normals)
        noise = apply(L, normals)
        for k in range(len(Phi)):
            x = states[first + k + 1] = apply(Phi[k], x) + noise[k]
            if rebased[first + k + 1]:
                x = np.zeros(moves.n)
    return states, np.concatenate(drawn)


def _bridge_gap(
    moves: Transitions,
    times: FloatArray,
    states: FloatArray,
    normals: FloatArray,
    probing: np.random.Generator,
    probes: FloatArray,
) -> FloatArray:
    """Return states (P, n) at ``probes`` (P,), in the frame of the time before, given those at
    ``times``; beyond the last of them the path goes on freely.
    """
    n = moves.n
    found, rest = np.empty((len(probes), n)), np.empty(0)
    gap = np.searchsorted(times, probes) - 1  # the number of the gap that each probe lies in
    starts = times[gap]
    again = np.flatnonzero(np.diff(gap) == 0) + 1
    starts[again] = probes[again - 1]
    ends = np.append(times, math.inf)[gap + 1]
    for first in range(0, len(probes), BLOCK):
        some = slice(first, first + BLOCK)
        before, after = probes[some] - starts[some], ends[some] - probes[some]
        Phi, L = moves.laws(before)
        free = np.isinf(after)
        D = moves.bridges(before, np.where(free, 0.0, after))
        drawn = probing.standard_normal((len(before), 2 * n))
        for k in range(len(before)):
            number = first + k
            if number and gap[number] == gap[number - 1]:
                x = found[number - 1]
            else:
                x = states[gap[number]]
                rest = rest if free[k] else normals[gap[number]]
            z = drawn[k]
            if not free[k]:
                # What is left free by the noise of the whole gap, which is known.
                z = apply(D[k].T, rest) + (z - apply(D[k].T, apply(D[k], z)))
                rest = z[n:]
            found[number] = apply(Phi[k], x) + apply(L[k], z[:n])
    return found


class RecordedTruth:
    """States (K, n) at recorded times (K,), which are asked for to 1e-9 s; nan elsewhere."""

    frame_times = np.empty(0)

    def __init__(self, times: FloatArray, states: FloatArray, n: int) -> None:
        self._times, self._states = times, states
        self._missing = np.full(n, math.nan)

    def local(self, time: float) -> FloatArray:
        """Return x (n,), or nan."""
        k = nearest_row(self._times, time)
        return self._missing if k is None else np.asarray(self._states[k])

    absolute = local

    def rebase(self, k: int) -> FloatArray:
        """Raise IndexError: there are no frames."""
        raise IndexError(k)

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return states (K, n) at times in any order, twice."""
        x = np.array([self.local(time) for time in times.tolist()]).reshape(-1, len(self._missing))
        return x, x


def nearest_row(times: FloatArray, time: float) -> int | None:
    """Return the row whose time (increasing) is ``time`` to 1e-9 s."""
    k = int(np.searchsorted(times, time - TOLERANCE))
    return k if k < len(times) and times[k] <= time + TOLERANCE else None


def demand_rows(source: SourceFile, times: FloatArray, wanted: FloatArray, what: str) -> None:
    """Raise ScenarioError for the first of the ``wanted`` times that has no row."""
    for time in wanted.tolist():
        if nearest_row(times, time) is None:
            rule = f"{source.name} has no state for {what}, t = {time:.9g}"
            raise ScenarioError("path", rule, None, "add the row, or ask for no state then")
