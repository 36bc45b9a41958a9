"""The true state of one run in continuous time, and its frames.

Errors ``x - xhat`` of affine filters do not change when the truth, the readings and all estimates
are shifted along a solution of ``dc = A c dt``. On an unstable plant the state is therefore reset
to zero at every *frame time* (a *rebase*), which starts a new *frame*. ``local`` states are
relative to the origin of the present frame, which moves with the plant; they keep the digits that
``absolute`` states lose as they grow.

*Samples* are the times at which a sensor reads the state at an instant, *probes* those at which the
run records it. They have separate random streams, so that recording does not change the path.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.core.instants import TimeGrid
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply
from netkf.plants.transitions import Transitions

TOLERANCE = 1e-9  # seconds by which a recorded time may be off
BLOCK = 1024  # gaps whose laws are computed at once


class ContinuousTruth(Protocol):
    """The state of one run, at sample times, probe times and frame times.

    At a frame time the state is that after the rebase, so ``local`` is zero.
    """

    @property
    def frame_times(self) -> FloatArray:
        """(F,) increasing times in seconds, inside the run, at which the origin of states is moved
        and a new frame begins; empty unless frames are used.
        """

    def local(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds), relative to the origin of the present frame."""

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds), in the plant's coordinates."""

    def rebase(self, k: int) -> FloatArray:
        """Return the shift (n,) to subtract from estimates at ``frame_times[k]``: the local state
        just before, to which the origin moves. The engine calls this once for each k, in order.
        """


def multiples(period: float | None, horizon: float, grid: TimeGrid) -> FloatArray:
    """Return the multiples (K,) of ``period`` in (0, horizon), seconds, on the ``grid``; empty
    without a period.
    """
    if period is None or period >= horizon:
        return np.empty(0)
    times = grid.snap(period * np.arange(1, int(horizon / period) + 2))
    return np.asarray(times[times < horizon])


def origins(Phi: FloatArray, offsets: FloatArray) -> FloatArray:
    """Return the position (F + 1, n), in the plant's coordinates, of the origin of each of F + 1
    frames at the start of the frame.

    The first is 0, then ``c[k+1] = Phi[k] c[k] + offsets[k]``: ``Phi`` (F, n, n) are the
    transitions over the F frames that end by a rebase, ``offsets`` (F, n) the local states before
    it.
    """
    positions = np.zeros((len(offsets) + 1, offsets.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for k, offset in enumerate(offsets):
            # An origin at 0 stays there; the product would be nan if Phi has overflowed.
            if positions[k].any():
                positions[k + 1] = apply(Phi[k], positions[k]) + offset
            else:
                positions[k + 1] = offset
    return positions


def absolute_states(
    moves: Transitions, frame_times: FloatArray, offsets: FloatArray, t: FloatArray, x: FloatArray
) -> FloatArray:
    """Return the states (K, n) in the plant's coordinates at K times ``t`` (K,) in seconds, from
    local states ``x`` (K, n).

    A frame begins at 0 and at each of ``frame_times`` (F,), in seconds; ``offsets`` (F, n) are the
    local states just before these rebases. At a frame time ``x`` is local to the new frame.
    ``moves`` gives the transitions of the plant.
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
    """Times in seconds of samples (K,), of probes (P,) and of the ``marks`` (F,) at which frames
    begin if they are used.
    """

    samples: FloatArray
    probes: FloatArray
    marks: FloatArray


class SampledTruth:
    """A path from x(0) = ``start`` (n,) on, drawn exactly at the times ``at`` and nowhere else.

    ``random`` draws the states at samples and marks; ``probing`` draws those at probes from their
    exact law given the others, so that the path does not depend on the probes. The marks are the
    frame times if ``frames``; without frames the path is the same. All times are in seconds and at
    least 0.
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
        """Draw the whole path from ``start`` (n,) on, at the times ``at``; ``moves`` are the
        transitions of the plant, and marks are frame times if ``frames``.
        """
        self._moves = moves
        # Samples and marks are drawn first, one after the other, then probes between them.
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
        """Return the index of ``time`` (seconds) among those of the path."""
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
        """Return local and absolute states (K, n) each at ``times`` (K,) of the path in seconds, in
        any order.
        """
        indices = np.searchsorted(self._times, times)
        return self._local[indices], self._absolute[indices]


def _draw_states(
    moves: Transitions,
    start: FloatArray,
    random: np.random.Generator,
    times: FloatArray,
    rebased: np.ndarray,
) -> tuple[FloatArray, FloatArray]:
    """Return states (K, n) at ``times`` (K,) in seconds, each before a rebase, and the standard
    normals (K - 1, n) of the gaps.

    ``x <- Phi x + L z`` from ``start`` (n,) on, with Phi and L of each gap from ``moves`` and z
    drawn from ``random``; at times marked in ``rebased`` (K,) it restarts from 0.
    """
    gaps = np.diff(times)
    states = np.empty((len(times), moves.n))
    states[0] = x = start
    blocks = [np.empty((0, moves.n))]
    for first in range(0, len(gaps), BLOCK):
        Phi, L = moves.laws(gaps[first : first + BLOCK])
        normals = random.standard_normal((len(Phi), moves.n))
        blocks.append(normals)
        noise = apply(L, normals)
        for k in range(len(Phi)):
            x = states[first + k + 1] = apply(Phi[k], x) + noise[k]
            if rebased[first + k + 1]:
                x = np.zeros(moves.n)
    return states, np.concatenate(blocks)


def _bridge_gap(
    moves: Transitions,
    times: FloatArray,
    states: FloatArray,
    normals: FloatArray,
    probing: np.random.Generator,
    probes: FloatArray,
) -> FloatArray:
    """Return states (P, n) at P increasing ``probes`` (P,) given the ``states`` (K, n) at ``times``
    (K,), both in seconds.

    ``normals`` (K - 1, n) are those z from which the state at the end of each gap between the times
    was drawn, ``x <- Phi x + L z``. A state is in the frame of the last time before it. After the
    last of ``times`` the path is drawn without a condition.

    A probe divides a gap, or what follows the previous probe in it, in two parts with normals z1
    and z2. Given the normals z = D [z1; z2] of the whole, [z1; z2] = D' z + (I - D' D) w with
    standard normal w, drawn from ``probing`` (see ``moves.bridges``); z2 is the z of the part that
    the next probe in the gap divides.
    """
    n = moves.n
    # z_gap: the normals of the present gap, or of its part after the probes so far.
    x_probes, z_gap = np.empty((len(probes), n)), np.empty(0)
    gap = np.searchsorted(times, probes) - 1  # index of the gap that contains each probe
    # Each part begins at the last time before the probe, or at the probe before it in the same gap.
    starts = times[gap]
    shared = np.flatnonzero(np.diff(gap) == 0) + 1
    starts[shared] = probes[shared - 1]
    ends = np.append(times, math.inf)[gap + 1]
    for first in range(0, len(probes), BLOCK):
        block = slice(first, first + BLOCK)
        before, after = probes[block] - starts[block], ends[block] - probes[block]
        Phi, L = moves.laws(before)
        unconditional = np.isinf(after)
        # D is not used after the last time; 0 stands for the infinite gap there.
        D = moves.bridges(before, np.where(unconditional, 0.0, after))
        w = probing.standard_normal((len(before), 2 * n))
        for k in range(len(before)):
            index = first + k
            if index and gap[index] == gap[index - 1]:
                x = x_probes[index - 1]
            else:
                x = states[gap[index]]
                z_gap = z_gap if unconditional[k] else normals[gap[index]]
            z_parts = w[k]
            if not unconditional[k]:
                z_parts = apply(D[k].T, z_gap) + (z_parts - apply(D[k].T, apply(D[k], z_parts)))
                z_gap = z_parts[n:]
            x_probes[index] = apply(Phi[k], x) + apply(L[k], z_parts[:n])
    return x_probes


class RecordedTruth:
    """Known states (K, n) at recorded ``times`` (K,) in seconds, which increase. Between these, up
    to 1e-9 s, states are nan unless ``interpolate`` is "linear", or "hold": the last one counts.
    """

    frame_times = np.empty(0)

    def __init__(
        self, times: FloatArray, states: FloatArray, n: int, interpolate: str | None = None
    ) -> None:
        self.times, self._states, self._interpolate = times, states, interpolate
        self._missing = np.full(n, math.nan)

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

    def rebase(self, k: int) -> FloatArray:
        """Raise IndexError: a recorded truth has no frame number ``k``."""
        raise IndexError(k)

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (K, n) each, which are equal, at ``times`` (K,) in
        seconds, in any order.
        """
        x = np.array([self.local(time) for time in times.tolist()]).reshape(-1, len(self._missing))
        return x, x


def nearest_row(times: FloatArray, time: float) -> int | None:
    """Return the index in increasing ``times`` (K,) of the one within 1e-9 s of ``time``, else
    None; both in seconds.
    """
    k = int(np.searchsorted(times, time - TOLERANCE))
    return k if k < len(times) and times[k] <= time + TOLERANCE else None


def demand_states(source: SourceFile, truth: RecordedTruth, needed: FloatArray, use: str) -> None:
    """Raise ScenarioError for the first of the ``needed`` times (M,), in seconds, at which the
    ``truth`` of the table in the file ``source`` is unknown; ``use`` says in the message what the
    state is for.
    """
    for time in needed.tolist():
        if truth.rows_at(time):
            continue
        times = truth.times
        remedy = "add the row, or ask for no state then"
        if len(times) and times[0] < time < times[-1]:
            remedy = 'add the row, or write interpolate = "linear" or "hold"'
        elif len(times):
            remedy += f"; the rows are from t = {times[0]:.9g} to {times[-1]:.9g}"
        rule = f"{source.name} has no state for {use}, t = {time:.9g}"
        raise ScenarioError("path", rule, None, remedy)
