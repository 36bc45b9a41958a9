"""The exact error covariance of the engine itself, without Monte Carlo.

Given the clocks, every error is linear in the Gaussian draws. Running the engine once for each
draw, with that draw 1 and all others 0, gives the columns of the linear map, hence Cov(x - xhat).
"""

from unittest import mock

import numpy as np
import scipy.linalg

from netkf import simulate
from netkf.engines.simpy.engine import SimpyEngine
from netkf.plants import linear, paths
from netkf.plants.diffusion import Diffusion
from netkf.plants.transitions import frame_period
from netkf.plants.truth import SampledTruth, multiples
from netkf.rng.streams import Streams
from netkf.trace.recorder import MemorySink, Recorder

GAUSSIAN = {"plant", "noise", "cut", "probe"}


class Unit:
    """A generator whose normal draws are all 0 but one."""

    def __init__(self, place=None):
        self.place, self.count = place, 0

    def standard_normal(self, size):
        values = np.zeros(size)
        place = None if self.place is None else self.place - self.count
        if place is not None and 0 <= place < values.size:
            values.reshape(-1)[place] = 1.0
        self.count += values.size
        return values


class OneDraw(Streams):
    """Streams that are silent but for draw number ``place`` of ``name``."""

    def __init__(self, seed, name=None, place=None):
        super().__init__(seed)
        object.__setattr__(self, "chosen", (name, place))
        object.__setattr__(self, "made", {})

    def generator(self, purpose, *entity):
        if purpose not in GAUSSIAN:
            return super().generator(purpose, *entity)
        name = (purpose, *entity)
        self.made[name] = Unit(self.chosen[1] if name == self.chosen[0] else None)
        return self.made[name]


class Chain:
    """The states of a plant at some times, each from the one before and the next n normals: the
    law of ``netkf.plants.tree``, which draws inside kernels (``tests/plants/test_truth.py``).
    """

    def __init__(self, plant, frame_times):
        self.plant, self.frame_times = plant, frame_times

    def states(self, times, start, random, frames):
        A, Q, n = self.plant.A, self.plant.B @ self.plant.B.T, len(start)
        states, offsets = np.empty((len(times), n)), np.zeros((frames, n))
        states[0] = start
        for k, gap in enumerate(np.diff(times).tolist()):
            E = scipy.linalg.expm(np.block([[-A, Q], [np.zeros((n, n)), A.T]]) * gap)
            values, axes = np.linalg.eigh(E[n:, n:].T @ E[:n, n:])
            root = axes * np.sqrt(np.maximum(values, 0.0))
            states[k + 1] = E[n:, n:].T @ states[k] + root @ random.standard_normal(n)
            for frame in np.flatnonzero(self.frame_times[:frames] == times[k + 1]):
                offsets[frame], states[k + 1] = states[k + 1], 0.0
        return states, offsets


def chained_truth(plant, random, times, horizon, frames=False):
    """What ``Diffusion.sampled_truth`` returns, from the numbers of a ``Unit``."""
    frame_times = multiples(frame_period(plant.A), horizon, plant.time_grid)
    chain, start = Chain(plant, frame_times), plant.start(random)
    return SampledTruth(plant.moves, chain, start, random, times, frame_times, frames)


def run(scenario, streams):
    memory = MemorySink()
    SimpyEngine().run(scenario, streams, Recorder([memory]), lambda time: None)
    return np.concatenate([error for *_, error in memory.samples])


def error_forms(scenario):
    """For each draw the errors (T, N, n) of what SimPy computes where it is 1 and all others 0."""
    # What is drawn ahead in blocks would be as many runs more, all of them without errors.
    with (
        mock.patch.object(linear, "BLOCK", 1),
        mock.patch.object(paths, "BLOCK", 1),
        mock.patch.object(Diffusion, "sampled_truth", chained_truth),
    ):
        silent = OneDraw(scenario.seed)
        assert not run(scenario, silent).any()
        for name, unit in silent.made.items():
            for place in range(unit.count):
                yield run(scenario, OneDraw(scenario.seed, name, place))


def engine_covariance(scenario, engine="auto"):
    """(T, N, n, n): Cov(x - xhat_i) of what SimPy computes, for plants starting at mean 0; and the
    run of an engine.
    """
    total = sum(np.einsum("tia,tib->tiab", e, e) for e in error_forms(scenario))
    return total, simulate(scenario, engine=engine)


def engine_joint(scenario):
    """The joint covariance (T, N, n, T, N, n) of all these errors."""
    return sum(np.multiply.outer(e, e) for e in error_forms(scenario))
