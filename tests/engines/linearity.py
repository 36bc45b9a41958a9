"""The exact error covariance of the engine itself, without Monte Carlo.

Given the clocks, every error is linear in the Gaussian draws. Running the engine once for each
draw, with that draw 1 and all others 0, gives the columns of the linear map, hence Cov(x - xhat).
"""

from unittest import mock

import numpy as np

from netkf import simulate
from netkf.engines.simpy.engine import SimpyEngine
from netkf.plants import linear, paths, sensors
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


def run(scenario, streams):
    memory = MemorySink()
    SimpyEngine().run(scenario, streams, Recorder([memory]), lambda time: None)
    return np.concatenate([error for *_, error in memory.samples])


def engine_covariance(scenario, engine="auto"):
    """(T, N, n, n): Cov(x - xhat_i) of what SimPy computes, for plants starting at mean 0; and the
    run of an engine.
    """
    total = 0.0
    # What is drawn ahead in blocks would be as many runs more, all of them without errors.
    with (
        mock.patch.object(linear, "BLOCK", 1),
        mock.patch.object(paths, "BLOCK", 1),
        mock.patch.object(sensors, "BLOCK", 1),
    ):
        silent = OneDraw(scenario.seed)
        assert not run(scenario, silent).any()
        for name, unit in silent.made.items():
            for place in range(unit.count):
                e = run(scenario, OneDraw(scenario.seed, name, place))
                total = total + np.einsum("tia,tib->tiab", e, e)
    return total, simulate(scenario, engine=engine)
