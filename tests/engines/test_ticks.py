"""Ticks and outcomes drawn in compiled code are those that clocks and channels draw in Python."""

import math

import numpy as np
import pytest

from netkf.engines.compiled import ticks as ticks_module
from netkf.engines.compiled.ticks import LISTED, Schedule
from netkf.rng.streams import Streams

CHANNELS = {
    "shared": {"symmetric": True, "loss": {"kind": "bernoulli", "delivery": 0.7}},
    "each way": {"symmetric": False, "loss": {"kind": "bernoulli", "delivery": 0.7}},
    "late": {"symmetric": False, "delay": {"kind": "constant", "seconds": 0.25}},
    "never": {"loss": {"kind": "bernoulli", "delivery": 0.0}},
    "bursts": {
        "symmetric": False,
        "loss": {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.4, "deliver_good": 0.9},
        "delay": {"kind": "exponential", "mean": 0.1},
    },
    "shared bursts": {
        "loss": {"kind": "gilbert-elliott", "mean_loss": 0.4, "mean_burst": 3.0},
        "delay": {"kind": "uniform", "low": 0.1, "high": 0.3},
    },
    "lognormal": {"symmetric": False, "delay": {"kind": "lognormal", "mean": 0.1, "sigma": 0.7}},
}
CLOCKS = {
    "poisson": {"kind": "poisson", "rate": 3.0},
    "directions": {"kind": "poisson", "rate": 3.0, "at": "directions"},
    "nodes": {"kind": "periodic", "period": 0.3, "phase": "random", "at": "nodes"},
    "together": {"kind": "periodic", "period": 0.25},
    "late": {"kind": "periodic", "period": 0.25, "phase": 0.1, "jitter": 0.01, "at": "nodes"},
    "uniform": {"kind": "renewal", "distribution": "uniform", "low": 0.1, "high": 0.4},
    "constant": {"kind": "renewal", "distribution": "constant", "rate": 3.0, "at": "directions"},
    "erlang": {"kind": "renewal", "distribution": "gamma", "shape": 3.0, "mean": 0.3},
    "bursty": {"kind": "renewal", "distribution": "gamma", "shape": 0.3, "rate": 3.0},
    "regular": {"kind": "renewal", "distribution": "gamma", "shape": 1e4, "scale": 3e-5},
    "weibull": {"kind": "renewal", "distribution": "weibull", "shape": 0.5, "mean": 0.3},
    "shape 1": {"kind": "renewal", "distribution": "weibull", "shape": 1.0, "rate": 3.0},
}


@pytest.fixture
def in_python(monkeypatch):
    """Make a schedule whose ticks and outcomes are drawn by the clocks and channels themselves."""

    def make(case, streams, names=("is_kernel_clock", "draws_in_kernels")):
        with monkeypatch.context() as patch:
            for name in names:
                patch.setattr(ticks_module, name, lambda part: False)
            return Schedule(case, streams)

    return make


def all_of(windows):
    """Every tick of a run."""
    parts = []
    while not parts or parts[-1].end < math.inf:
        parts.append(windows.following())
    told = [ticks_of(part) for part in parts]
    return parts, [np.concatenate(column) for column in zip(*told, strict=True)]


def ticks_of(window):
    """Times, entities and the outcomes forth and back of each tick."""
    # Outcomes in the order of their ticks: windows may keep them in another.
    ends = np.append(window.first_outcome, len(window.delay))
    sizes = np.array([np.min(ends[ends > first], initial=first) - first for first in ends[:-1]])
    outcomes = [window.delay[f : f + n] for f, n in zip(ends, sizes, strict=False)]
    return window.t, window.entity, np.concatenate([np.empty(0), *outcomes])


@pytest.fixture
def busy(ring):
    rates = [[0, 1, 7.0], [2, 3, 0.1]]
    return lambda channel: ring.replace(
        {
            "horizon": 50.0,
            "network.activation": {"kind": "poisson", "rate": 3.0, "rates": rates},
            "network.channel": channel,
        }
    )


def of_run(ticks, run):
    """What ``ticks_of`` returns, of one run of several."""
    own, delays = (slice(*first[run : run + 2]) for first in (ticks.first, ticks.first_delay))
    window = ticks._replace(delay=ticks.delay[delays], first_outcome=ticks.first_outcome[own])
    return ticks_of(window._replace(t=ticks.t[own], entity=ticks.entity[own]))


def assert_same(made, plain):
    for one, other in zip(made, plain, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", CHANNELS)
def test_ticks_and_fates_are_those_drawn_link_by_link(busy, monkeypatch, in_python, name):
    case = busy(CHANNELS[name])
    monkeypatch.setattr(ticks_module, "TICKS", 40)
    parts, made = all_of(Schedule(case, Streams(3)))
    _, plain = all_of(in_python(case, Streams(3)))
    assert len(parts) > 5
    assert len(made[0]) > 500
    assert_same(made, plain)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("channel", ["shared", "bursts", "shared bursts", "lognormal"])
@pytest.mark.parametrize("clock", CLOCKS)
def test_all_clocks_and_channels(ring, monkeypatch, in_python, clock, channel):
    case = ring.replace(
        {
            "horizon": 20.0,
            "network.activation": CLOCKS[clock],
            "network.channel": CHANNELS[channel],
        }
    )
    monkeypatch.setattr(ticks_module, "TICKS", 40)
    schedule = Schedule(case, Streams(3))
    assert schedule._clocks.kind != LISTED
    (_, made), (_, plain) = all_of(schedule), all_of(in_python(case, Streams(3)))
    assert len(made[0]) > 300
    assert_same(made, plain)
    batch = Schedule(case, Streams(2, 1, 2)).all()
    listed = in_python(case, Streams(2, 1, 2)).all()
    for run in range(2):
        plain = all_of(in_python(case, Streams(2, 1 + run)))[1]
        assert_same(of_run(batch, run), plain)
        assert_same(of_run(listed, run), plain)


@pytest.mark.parametrize("at", ["links", "nodes"])
@pytest.mark.parametrize("channel", ["shared", "bursts", "shared bursts", "lognormal"])
def test_outcomes_after_ticks_of_other_clocks(ring, in_python, channel, at):
    gamma = {"kind": "renewal", "distribution": "gamma", "mean": 0.3, "shape": 2.0, "at": at}
    changes = {"network.activation": gamma, "network.channel": CHANNELS[channel]}
    case = ring.replace({"horizon": 20.0, **changes})
    schedule = in_python(case, Streams(3), ("is_kernel_clock",))
    assert schedule._clocks.kind == LISTED
    assert_same(all_of(schedule)[1], all_of(in_python(case, Streams(3)))[1])


def test_room_grows_where_there_are_more_ticks_than_expected(busy, in_python):
    case = busy(CHANNELS["each way"])
    windows = Schedule(case, Streams(3))
    windows._rate *= 1e-3
    assert_same(all_of(windows)[1], all_of(in_python(case, Streams(3)))[1])


@pytest.mark.parametrize("user", [(), ("draws_in_kernels",)])
def test_several_runs_are_what_each_is_alone(busy, in_python, user):
    case = busy(CHANNELS["shared"])
    few = in_python(case, Streams(3, 5, 3), user)
    few._rate *= 1e-3  # many more ticks than expected: the arrays grow
    for schedules in (few, in_python(case, Streams(3, 5, 3), user)):
        ticks = schedules.all()
        for run in range(3):
            plain = all_of(in_python(case, Streams(3, 5 + run)))[1]
            assert_same(of_run(ticks, run), plain)


def test_ticks_that_crowd_are_put_in_order():
    """Even where the clocks are not as even in time as they should be, and at one instant."""
    random = np.random.default_rng(1)
    t = np.concatenate([random.random(200) ** 8, np.full(20, 0.5)])
    link = random.permutation(len(t))
    found = ticks_module.TickBuffer(t, link, 2 * link, np.empty(0))
    ordered = ticks_module._empty_buffer(len(t), 0)
    ticks_module.put_in_time_order(0.0, 1.0, len(t), found, ordered, ticks_module._sorting(len(t)))
    order = np.lexsort((link, t))
    for one, other in zip(ordered[:3], found[:3], strict=True):
        np.testing.assert_array_equal(one, other[order])


def test_a_filter_that_sends_nothing_has_no_ticks(ring):
    windows = Schedule(ring.replace({"filter": {"kind": "local"}}), Streams(3))
    assert [len(column) for column in all_of(windows)[1]] == [0, 0, 0]
