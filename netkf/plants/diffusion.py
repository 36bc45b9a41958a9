"""The diffusion plant dx = A x dt + B dw.

Its state is drawn at three kinds of times: on the *sensing grid* k h, if sensors read increments
over steps of h seconds; at *sample times*, when a sensor reads the state at an instant; and at
*probe times*, when the run records the state. Each kind has a random stream of its own, so that
the path on the grid is the same whatever is sampled or recorded. On an unstable plant states may be
relative to an origin that is moved to the state at regular times; the interval between two moves is
a *frame* (``truth`` says why).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from netkf.core.fields import field, matrix, of_time, positive, square
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.linalg.spectra import balanced_norm, eigenvalues
from netkf.plants.changes import DiffusionChange, matrices_of_pieces, schedule_of
from netkf.plants.laws import GridLaws
from netkf.plants.paths import DiffusionPath, DiffusionPaths
from netkf.plants.plant import Plant
from netkf.plants.transitions import Transitions, decimal_below, frame_period
from netkf.plants.tree import Tree
from netkf.plants.truth import ChangingTruth, SampledTruth, multiples
from netkf.rng.normals import GeneratorNormals, Normals, StreamNormals
from netkf.rng.streams import Streams, state_of

MAX_STEP = 8.0  # norm of A times a step, beyond which the series of e^{A g} loses digits
NO_TIMES = np.empty(0)


@dataclass(frozen=True, eq=False)
class Diffusion(Plant):
    """``dx = A x dt + B dw``, Tanwani, H (1), with x(0) Gaussian of ``mean`` and ``cov``.

    ``A`` (n, n), ``B`` (n, m); ``sensing_period`` is the step h of the sensors in seconds, and
    ``schedule`` has other matrices from some times on (``plants.changes``).
    """

    A: FloatArray = field(square)
    B: FloatArray = field(matrix)
    sensing_period: float | None = field(of_time(positive), default=None)
    schedule: tuple[DiffusionChange, ...] = field(schedule_of(DiffusionChange), default=())

    grid_values: ClassVar[tuple[str, ...]] = ("laws", "pieces")

    @cached_property
    def pieces(self) -> tuple[Diffusion, ...]:
        """The plants before the first change and after each, without changes of their own."""
        all_matrices = matrices_of_pieces({"A": self.A, "B": self.B}, self.schedule)
        return tuple(
            Diffusion(A=m["A"], B=m["B"], sensing_period=self.sensing_period).on_grid(
                self.time_grid
            )
            for m in all_matrices
        )

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.A)

    @cached_property
    def Q(self) -> FloatArray:
        """``B B'`` (n, n)."""
        return readonly_array(self.B @ self.B.T)

    @cached_property
    def laws(self) -> GridLaws:
        """The laws of the steps of the sensing grid, shared by all paths of this plant."""
        assert self.sensing_period is not None
        return GridLaws(self.A, self.B, self.sensing_period, self.time_grid)

    @property
    def longest_period(self) -> float:
        """The longest sensing period (seconds) for which the path is exact to rounding."""
        norm = max(balanced_norm(piece.A) for piece in self.pieces)
        return MAX_STEP / norm if norm > 0.0 else math.inf

    @cached_property
    def moves(self) -> Transitions:
        """The exact discretisation over an interval of any length."""
        return Transitions(self.A, self.B)

    def path(
        self,
        random: np.random.Generator,
        probing: np.random.Generator,
        probe_times: FloatArray,
        sampling: np.random.Generator | None = None,
        sampled: FloatArray = NO_TIMES,
        horizon: float = 0.0,
        frames: bool = False,
        forcing: Any = None,
    ) -> DiffusionPath:
        """Return the path of one run, see ``paths``: ``random``, ``probing`` and ``sampling`` draw
        what ``normals`` and the others draw there; frames begin before the ``horizon`` (seconds).
        """
        steps, probes = GeneratorNormals([random]), GeneratorNormals([probing])
        samples = GeneratorNormals([] if sampling is None else [sampling])
        paths = self.paths(steps, probes, probe_times, samples, sampled, frames, forcing)
        return DiffusionPath(paths, horizon)

    def paths(
        self,
        normals: Normals,
        probing: Normals,
        probe_times: FloatArray,
        sampling: Normals | None = None,
        sampled: FloatArray = NO_TIMES,
        frames: bool = False,
        forcing: Any = None,
    ) -> DiffusionPaths:
        """Return the paths of R runs, one for each of the R streams of ``normals``, which draw x(0)
        and the steps; all have states on the sensing grid and at the times ``sampled`` and
        ``probe_times`` (increasing, seconds), one-dimensional arrays.

        ``sampling`` draws only the states at times ``sampled`` off the grid, ``probing`` those at
        probe times off both. With ``frames`` states are relative to the origin of their frame.
        ``forcing``, a response to an input, is added to the paths.
        """
        start = self.starts(normals)
        cuts = [] if sampling is None or not len(sampled) else [(sampled, sampling)]
        steps = self.frame_steps if frames else None
        laws = {self.step_of(t): p.laws for t, p in zip(self.changes, self.pieces[1:], strict=True)}
        cuts = [*cuts, (probe_times, probing)]
        return DiffusionPaths(self.laws, start, normals, cuts, steps, laws, forcing)

    def step_of(self, time: float) -> int:
        """Return the number of steps of the sensing grid up to ``time``, one of its points."""
        assert self.sensing_period is not None
        return round(time / self.sensing_period)

    def start(self, random: np.random.Generator) -> FloatArray:
        """Return x(0) (n,), drawn from ``random``."""
        return np.asarray(self.starts(GeneratorNormals([random]))[0])

    @cached_property
    def frame_steps(self) -> int | None:
        """Steps of the sensing grid from one frame to the next; None for a stable plant."""
        period = frame_period(self.A)
        assert self.sensing_period is not None
        return None if period is None else max(1, int(period / self.sensing_period))

    def sampled_truth(
        self, random: np.random.Generator, times: FloatArray, horizon: float, frames: bool = False
    ) -> SampledTruth:
        """Return a path without a sensing grid, which has states at ``times`` (K,) in seconds, all
        below the ``horizon``, and at frame times. A state depends on its time only: ``random``
        draws x(0), and names the streams of all else. With ``frames`` states are relative to the
        origin of their frame.
        """
        stream = state_of(random)
        start = self.start(random)
        if len(self.changes):
            trees = [piece._tree(horizon, k) for k, piece in enumerate(self.pieces)]
            return ChangingTruth(trees, self.changes, start, stream, times, self.time_grid)
        tree = self._tree(horizon)
        frame_times = multiples(tree.frame, horizon, self.time_grid)
        return SampledTruth(self.moves, tree, start, stream, times, frame_times, frames)

    def sampled_states(
        self, streams: Streams, times: Sequence[FloatArray], horizon: float
    ) -> list[FloatArray]:
        """Return the states (K, n) of each run at its ``times`` (K,), in any order, as
        ``sampled_truth`` of the stream "plant" of each run has them, without frames.
        """
        normals, tree = StreamNormals(streams.states("plant", [()])), self._tree(horizon)
        started, starts, found = normals.states.copy(), self.starts(normals), []
        for k, own in enumerate(times):
            order, x = np.argsort(own), np.empty((len(own), self.n))
            x[order] = tree.states(own[order], starts[k], started[k : k + 1], 0)[0]
            found.append(x)
        return found

    def _tree(self, horizon: float, piece: int = 0) -> Tree:
        """Return the cells of paths up to a horizon (seconds), made once for all runs."""
        if horizon not in self._trees:
            self._trees[horizon] = Tree(self.moves, horizon, frame_period(self.A), piece)
        return self._trees[horizon]

    @cached_property
    def _trees(self) -> dict[float, Tree]:
        return {}


def default_sensing_period(
    plant: Diffusion, informations: list[FloatArray], longest: float
) -> float:
    """Return the sensing period (seconds) of a scenario that gives none: one for which error
    covariances are within 1e-3 of those in the limit of period 0.

    ``informations`` are the matrices H' R^-1 H (n, n) of the nodes that sense, ``longest`` is the
    longest interval (seconds) that one update of their filters can use (algorithms/kernels/gains).
    The period is half the shortest time constant of the plant and of the stationary Kalman-Bucy
    filter of each node (1 s if they have none), or less where ``longest`` or the plant's
    ``longest_period`` demands it, rounded down to 1, 2 or 5 times a power of ten. It depends on
    nothing else, so that all algorithms and networks see the same truth.
    """
    fastest = float(np.abs(eigenvalues(plant.A)).max())
    for G in informations:
        # The eigenvalues of the Hamiltonian matrix of the Riccati equation are those of the
        # node's filter, with both signs.
        M = np.block([[-plant.A.T, G], [plant.Q, plant.A]])
        fastest = max(fastest, float(np.abs(eigenvalues(M)).max()))
    bound = min(0.5 / fastest if fastest > 0.0 else 1.0, longest, plant.longest_period)
    return decimal_below(bound)
