"""The true states of runs whose path is drawn block by block."""

from __future__ import annotations

import numpy as np

from netkf.engines.compiled.state import PathBlock
from netkf.linalg.arrays import FloatArray
from netkf.plants.truth import absolute_states
from netkf.scenario.scenario import Scenario


class PathStates:
    """The states of R runs on the present block of their paths, ``path``, at times that are ends of
    its pieces; the origin moves to the state at each of ``frame_times`` (F,), in seconds.
    """

    def __init__(self, scenario: Scenario, frame_times: FloatArray, path: PathBlock) -> None:
        self._moves, self._offsets = scenario.diffusion.moves, list[FloatArray]()
        self.frame_times, self.path = frame_times, path
        self._believed = scenario.origin_response

    def local(self, times: FloatArray) -> FloatArray:
        """Return the states (R, T, n) at ``times`` (T,), relative to the origin of their frame."""
        path, pieces = self.path, np.searchsorted(self.path.stop, times)
        # A time is the end of its piece, or the start of the first one.
        ends = (times == path.stop[pieces])[:, None]
        x = np.where(ends, path.x_stop.take(pieces, axis=1), path.x_start.take(pieces, axis=1))
        # A frame begins there: the origin has moved to the state.
        x[:, np.isin(times, self.frame_times)] = 0.0
        return x

    def rebase(self, k: int) -> FloatArray:
        """Return the first run's state (n,) before ``frame_times[k]``; states become origins."""
        x = self.path.x_stop[:, np.searchsorted(self.path.stop, self.frame_times[k])]
        self._offsets.append(x)
        return np.asarray(x[0])

    def of_runs(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (R, T, n) each at ``times`` (T,) in seconds."""
        absolute = local = self.local(times)
        # Until a frame begins the origin is at 0, and where it does not move with an input.
        if self._offsets:
            begun = self.frame_times[: len(self._offsets)]
            offsets = np.stack(self._offsets, axis=1)
            absolute = absolute_states(self._moves, begun, offsets, times, local)
        if self._believed is not None:
            absolute = absolute + self._believed.states(times)
        return local, absolute

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (T, n) each of the first run."""
        local, absolute = self.of_runs(times)
        return (local[0], local[0]) if absolute is local else (local[0], absolute[0])
