"""The true state of one run at its samples, absolute and relative to a moving origin."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from netkf.engines.compiled.state import PathBlock
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply
from netkf.plants.transitions import Transitions
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario


class States(Protocol):
    """True states of a run; local ones are relative to the origin of the present frame."""

    frame_times: FloatArray

    def offset(self, k: int, path: PathBlock, piece: int) -> FloatArray:
        """Return the local state (n,) just before frame ``k`` begins at ``frame_times[k]``, where
        the ``piece`` (index) of the ``path`` ends.
        """

    def states_at(
        self, times: FloatArray, path: PathBlock, pieces: np.ndarray
    ) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (T, n) each at T ``times`` (T,) in seconds, of which
        time k lies in the piece ``pieces[k]`` of the ``path``.
        """


class CompleteStates:
    """States of a truth that is drawn up to the horizon, or recorded, before the run."""

    def __init__(self, scenario: Scenario, streams: Streams, sampled: FloatArray) -> None:
        """Draw the states; ``sampled`` (K,) are the sample times of all sensors, in seconds."""
        self.truth = scenario.continuous_truth(streams, sampled=sampled)
        self.frame_times = np.array(self.truth.frame_times, dtype=np.float64)

    def offset(self, k: int, path: PathBlock, piece: int) -> FloatArray:
        """Return the local state (n,) just before frame ``k`` begins at ``frame_times[k]``;
        ``path`` and ``piece`` are not used.
        """
        # The truth has frames of its own.
        return np.asarray(self.truth.rebase(k))

    def states_at(
        self, times: FloatArray, path: PathBlock, pieces: np.ndarray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states (T, n) at ``times`` (T,) in seconds, relative to the origin of the
        frame of that time, and absolute.

        ``path`` and ``pieces`` are not used: this truth was drawn, or recorded, before the run.
        """
        local, absolute = self.truth.states(times)
        return local, absolute


class PathStates:
    """The states of a path that is drawn block by block; its origin moves to the state at each of
    ``frame_times`` (F,), in seconds.
    """

    def __init__(self, scenario: Scenario, frame_times: FloatArray) -> None:
        """Begin at time 0 with the origin 0; ``frame_times`` (F,) in seconds are those at which it
        moves.
        """
        self.frame_times = frame_times
        # Without frames the origin never moves, and no transition is needed.
        self._moves = (
            Transitions(scenario.diffusion.A, scenario.diffusion.B) if len(frame_times) else None
        )
        self._frame, self._frame_start, self._origin = 0, 0.0, np.zeros(scenario.plant.n)

    def local(self, times: FloatArray, path: PathBlock, pieces: np.ndarray) -> FloatArray:
        """Return the states (T, n) relative to the moving origin at T ``times`` (T,) in seconds, of
        which time k is an end of the piece ``pieces[k]`` of the ``path``; 0 at times at which a
        frame begins, as the origin moves to the state there.
        """
        # A time is the end of its piece, or the start of the first one.
        ends = (times == path.stop[pieces])[:, None]
        x = np.where(ends, path.x_stop[0, pieces], path.x_start[0, pieces])
        # A frame begins there: its local state is 0 after the origin has moved.
        if len(self.frame_times):
            x[np.isin(times, self.frame_times)] = 0.0
        return np.asarray(x)

    def offset(self, k: int, path: PathBlock, piece: int) -> FloatArray:
        """Return the local state (n,), that relative to the present origin, just before frame ``k``
        begins at ``frame_times[k]``, where the ``piece`` (index) of the ``path`` ends, and make it
        the new origin.
        """
        x, time = path.x_stop[0, piece], float(self.frame_times[k])
        with np.errstate(over="ignore", invalid="ignore"):
            # The new origin: the old one moved to now, plus the local state.
            self._origin = self._origin_at(np.array([time]))[0] + x
        # The present frame begins here.
        self._frame, self._frame_start = k + 1, time
        return np.asarray(x)

    def states_at(
        self, times: FloatArray, path: PathBlock, pieces: np.ndarray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states (T, n) relative to the moving origin and absolute, at T ``times`` (T,)
        in seconds in the present frame (the time since the origin moved last), of which time k lies
        in the piece ``pieces[k]`` of the ``path``.
        """
        local = self.local(times, path, pieces)
        # No frame has begun: local states are absolute.
        if not self._frame:
            return local, local
        with np.errstate(over="ignore", invalid="ignore"):
            return local, local + self._origin_at(times)

    def _origin_at(self, times: FloatArray) -> FloatArray:
        """Return the origin (T, n) of the present frame at T ``times`` in seconds."""
        # An origin of 0 stays 0, and its transition may overflow.
        if self._moves is None or not self._origin.any():
            return np.broadcast_to(self._origin, (len(times), len(self._origin)))
        moves = self._moves.transitions(times - self._frame_start)
        return apply(moves, self._origin)
