"""Samples drawn in compiled code are those that sensors draw in Python, to the bit."""

import numpy as np
import pytest

from netkf.engines.compiled.sample_tables import KernelSamples, SampleTables, samples_of
from netkf.rng.streams import Streams

CLOCKS = [
    {"kind": "poisson", "rate": 2.0},
    {"kind": "periodic", "period": 0.2, "phase": "random", "jitter": 0.02},
    {"kind": "periodic", "period": 0.25},
    {"kind": "renewal", "distribution": "gamma", "shape": 2.0, "mean": 0.3},
]


@pytest.fixture
def case(ring):
    """Sensors of two rows and of one, two at one node, with all clocks."""
    H, R = [[1.0, 0.0], [0.3, 1.0]], [[0.5, 0.1], [0.1, 0.2]]
    sensors = [
        {"nodes": [0, 5], "H": H, "R": R, "sampling": CLOCKS[0]},
        *({"nodes": [0, 3], "H": [[0.0, 1.0]], "R": [[0.1]], "sampling": c} for c in CLOCKS[1:]),
    ]
    return ring.replace({"sensors": sensors, "horizon": 20.0})


def test_samples_of_several_windows(case):
    drawn, plain = (cls(case, Streams(3, 2)) for cls in (KernelSamples, SampleTables))
    assert type(samples_of(case, Streams(3, 2))) is KernelSamples
    for name in ("t", "index", "first", "node", "sensor", "matrix"):
        found, expected = (getattr(one.instants, name) for one in (drawn, plain))
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(drawn.sampled, plain.sampled)
    times = np.concatenate([[0.0], plain.sampled])
    states = np.random.default_rng(1).standard_normal((len(times), 2))
    for one in (drawn, plain):
        one.read(states, times, -np.inf, 3.0)
        one.read(states, times, 3.0, np.inf)
    np.testing.assert_array_equal(drawn.instants.y, plain.instants.y)
    assert len(np.unique(plain.instants.y[:, 0])) == len(plain.instants.y) > 300


def test_samples_of_several_runs_are_those_of_each(case):
    together = KernelSamples(case, Streams(3, 2, 3))
    states = np.random.default_rng(1).standard_normal((len(together.t), 2))
    together.read_from(0, states)
    all_of, place = together.instants, 0
    for run in range(3):
        own = slice(*together.edges[run : run + 2])
        alone = KernelSamples(case, Streams(3, 2 + run))
        alone.read_from(0, states[own])
        count = len(alone.instants.t)
        for name in ("node", "sensor", "matrix", "block", "y"):
            found, expected = getattr(all_of, name)[own], getattr(alone.instants, name)
            np.testing.assert_array_equal(found, expected)
        for name, shift in (("t", 0.0), ("index", 0), ("first", own.start)):
            found, expected = (getattr(one, name) for one in (all_of, alone.instants))
            np.testing.assert_array_equal(found[place : place + count], expected[:count] + shift)
        # An instant that never comes, without samples, ends the run.
        assert all_of.t[place + count] == np.inf
        assert all_of.first[place + count] == all_of.first[place + count + 1] == own.stop
        place += count + 1
