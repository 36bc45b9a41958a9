"""The diffusion plant dx = A x dt + B dw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from netkf.core.fields import field, matrix, positive, square
from netkf.linalg.arrays import FloatArray
from netkf.plants.laws import GridLaws
from netkf.plants.paths import Cuts, DiffusionPath, DiffusionPaths
from netkf.plants.plant import Plant
from netkf.plants.transitions import Transitions, frame_period
from netkf.plants.truth import SampledTruth, TruthTimes, multiples
from netkf.rng.normals import GeneratorNormals, Normals

MAX_STEP = 8.0  # norm of A times a step, beyond which the series of e^{A g} loses digits
NO_TIMES = np.empty(0)


@dataclass(frozen=True, eq=False)
class Diffusion(Plant):
    """``dx = A x dt + B dw``, H (1), with x(0) Gaussian of ``mean`` and ``cov``.

    ``A`` (n, n), ``B`` (n, m); ``sensing_period`` is the step h of the sensors in seconds.
    """

    A: FloatArray = field(square)
    B: FloatArray = field(matrix)
    sensing_period: float | None = field(positive, default=None)

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.A)

    @cached_property
    def Q(self) -> FloatArray:
        """``B B'`` (n, n)."""
        return np.asarray(self.B @ self.B.T)

    @cached_property
    def laws(self) -> GridLaws:
        """The laws on the sensing grid that all paths of this plant share."""
        assert self.sensing_period is not None
        return GridLaws(self.A, self.B, self.sensing_period)

    @property
    def longest_period(self) -> float:
        """Seconds; the longest sensing period for which the path is exact."""
        norm = float(np.abs(self.A).sum(axis=0).max())
        return MAX_STEP / norm if norm > 0.0 else math.inf

    @cached_property
    def moves(self) -> Transitions:
        """Exact discretisation over any gap."""
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
    ) -> DiffusionPath:
        """Return a path of its own that can be asked for its state on the sensing grid and at the
        times ``sampled`` and ``probe_times`` (increasing). ``sampling`` is used only for times
        sampled off the grid, ``probing`` only for those probed off both. With ``frames``, states
        are local, see ``truth``, in frames that begin before the ``horizon``.
        """
        own, probes = GeneratorNormals([random]), GeneratorNormals([probing])
        samples = GeneratorNormals([] if sampling is None else [sampling])
        paths = self.paths(own, probes, probe_times, samples, sampled, frames)
        return DiffusionPath(paths, horizon)

    def paths(
        self,
        normals: Normals,
        probing: Normals,
        probe_times: FloatArray,
        sampling: Normals | None = None,
        sampled: FloatArray = NO_TIMES,
        frames: bool = False,
    ) -> DiffusionPaths:
        """Return the paths of several runs together, which are sampled and probed at the
        same times.
        """
        start = self.starts(normals)
        cuts = [] if sampling is None or not len(sampled) else [Cuts(sampled, sampling)]
        steps = self.frame_steps if frames else None
        return DiffusionPaths(self.laws, start, normals, [*cuts, Cuts(probe_times, probing)], steps)

    def start(self, random: np.random.Generator) -> FloatArray:
        """Draw x(0) (n,)."""
        return np.asarray(self.starts(GeneratorNormals([random]))[0])

    @property
    def frame_steps(self) -> int | None:
        """Steps of the sensing grid between two frames; None for a plant that is not unstable."""
        period = frame_period(self.A)
        assert self.sensing_period is not None
        return None if period is None else max(1, int(period / self.sensing_period))

    def sampled_truth(
        self,
        random: np.random.Generator,
        probing: np.random.Generator,
        samples: FloatArray,
        probes: FloatArray,
        horizon: float,
        frames: bool = False,
    ) -> SampledTruth:
        """Return a path that needs no sensing grid: it can be asked for its state at ``samples``,
        ``probes`` and frame times, up to the ``horizon``.
        """
        marks = multiples(frame_period(self.A), horizon)
        start = self.start(random)
        times = TruthTimes(samples, probes, marks)
        return SampledTruth(self.moves, start, random, probing, times, frames)


def default_sensing_period(
    plant: Diffusion, informations: list[FloatArray], longest: float
) -> float:
    """Return the sensing period for which the errors' covariance is within 1e-3 of the exact one.

    ``informations`` are the matrices H' R^-1 H of the nodes that sense, ``longest`` what their
    filters can use at once (algorithms/kernels/gains). The period is a fraction
    of the fastest time constant of the plant and of a node's own filter (a large
    covariance asks for nothing shorter, see FlowFilter.stretch), rounded down to 1, 2 or 5 times a
    power of ten. It depends on nothing else, so that filters and networks meet the same truth.
    """
    fastest = float(np.abs(np.linalg.eigvals(plant.A)).max())
    for G in informations:
        M = np.block([[-plant.A.T, G], [plant.Q, plant.A]])
        fastest = max(fastest, float(np.abs(np.linalg.eigvals(M)).max()))
    wanted = min(0.5 / fastest if fastest > 0.0 else 1.0, longest, plant.longest_period)
    power = 10.0 ** math.floor(math.log10(wanted))
    digit = next(d for d in (5.0, 2.0, 1.0) if d * power <= wanted * (1.0 + 1e-9))
    return float(f"{digit * power:.12g}")
