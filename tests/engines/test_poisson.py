"""Poisson schedules made in compiled code are those that are drawn link by link."""

import math

import numpy as np
import pytest

from netkf.engines.compiled import poisson
from netkf.engines.compiled.poisson import PoissonSchedules, is_poisson, schedule
from netkf.engines.compiled.schedule import Schedule, all_windows
from netkf.rng.streams import ReplicaStreams, Streams

CHANNELS = {
    "shared": {"symmetric": True, "loss": {"kind": "bernoulli", "delivery": 0.7}},
    "each way": {"symmetric": False, "loss": {"kind": "bernoulli", "delivery": 0.7}},
    "late": {"symmetric": False, "delay": {"kind": "constant", "seconds": 0.25}},
    "never": {"loss": {"kind": "bernoulli", "delivery": 0.0}},
}


def all_of(windows):
    """Every tick of a run."""
    parts = []
    while not parts or parts[-1].end < math.inf:
        parts.append(windows.following())
    told = [ticks_of(part) for part in parts]
    return parts, [np.concatenate(column) for column in zip(*told, strict=True)]


def ticks_of(window):
    """Times, entities and the outcomes forth and back of each tick."""
    assert window.first_outcome.max(initial=0) + 2 <= max(len(window.delay), 2)
    return window.t, window.entity, window.delay[window.first_outcome[:, None] + [0, 1]]


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


@pytest.mark.parametrize("name", CHANNELS)
def test_ticks_and_fates_are_those_drawn_link_by_link(busy, monkeypatch, name):
    case = busy(CHANNELS[name])
    assert is_poisson(case)
    monkeypatch.setattr(poisson, "TICKS", 40)
    parts, made = all_of(schedule(case, Streams(3)))
    _, plain = all_of(Schedule(case, Streams(3)))
    assert len(parts) > 5
    assert len(made[0]) > 500
    for one, other in zip(made, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_room_grows_where_there_are_more_ticks_than_expected(busy):
    case = busy(CHANNELS["each way"])
    windows = PoissonSchedules(case, Streams(3))
    windows._rate *= 1e-3
    _, made = all_of(windows)
    _, plain = all_of(Schedule(case, Streams(3)))
    for one, other in zip(made, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_several_runs_are_what_each_is_alone(busy):
    case = busy(CHANNELS["shared"])
    few = PoissonSchedules(case, ReplicaStreams(3, 5, 3))
    few._rate *= 1e-3  # many more ticks than expected: the arrays grow
    for schedules in (few, PoissonSchedules(case, ReplicaStreams(3, 5, 3))):
        ticks = schedules.all()
        for run, plain in enumerate(all_windows(case, ReplicaStreams(3, 5, 3))):
            found = ticks_of(poisson.window_of(ticks, run))
            for one, other in zip(found, ticks_of(plain), strict=True):
                np.testing.assert_array_equal(one, other)


def test_ticks_that_crowd_are_put_in_order():
    """Even where the clocks are not as even in time as they should be, and at one instant."""
    random = np.random.default_rng(1)
    t = np.concatenate([random.random(200) ** 8, np.full(20, 0.5)])
    link = random.permutation(len(t))
    found = poisson.TickBuffer(t, link, 2 * link, np.empty(0))
    ordered = poisson._empty_buffer(len(t), 0)
    poisson.put_in_time_order(0.0, 1.0, len(t), found, ordered, poisson._sorting(len(t)))
    order = np.lexsort((link, t))
    for one, other in zip(ordered[:3], found[:3], strict=True):
        np.testing.assert_array_equal(one, other[order])


@pytest.mark.parametrize(
    "changes",
    [
        {
            "network.activation": {
                "kind": "renewal",
                "distribution": "gamma",
                "rate": 3.0,
                "shape": 2.0,
            }
        },
        {"network.channel.delay": {"kind": "exponential", "mean": 1.0}},
        {"filter": {"kind": "local"}},
    ],
)
def test_others_are_drawn_as_before(ring, changes):
    assert not is_poisson(ring.replace(changes))
