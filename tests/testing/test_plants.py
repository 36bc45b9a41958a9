"""check_sensor, check_plant and check_matching: our own parts pass, and each breach is named."""

import numpy as np
import pytest

import netkf
from netkf import parts
from netkf.testing import (
    assert_dominated,
    check_channel,
    check_clock,
    check_filter,
    check_matching,
    check_plant,
    check_sensor,
    noise,
    scenario_files,
)
from netkf.testing import plants as of_plants
from netkf.testing import sensors as of_sensors
from netkf.testing.clocks import _check_matching
from netkf.testing.plants import _check_plant
from netkf.testing.sensors import _check_sensor
from tests.conftest import with_slow
from tests.testing.broken_plants import FLOW, LINEAR, MATCHINGS, PLANTS, REGRESSOR, SENSORS
from tests.testing.sound_parts import HEALTHY_MATCHINGS, HEALTHY_PLANTS, HEALTHY_SENSORS
from tests.testing.test_channels import refused

METRES_AND_RADIANS = [[0.5, 2e-8], [2e-8, 3e-15]]
SMALL = {"Drifts", "FixedF"}
"""Breaches that a quarter of the draws does not show."""


@pytest.fixture
def fewer_draws(name, monkeypatch):
    """A quarter of the draws, which finds errors of twice the size: most breaches are larger."""
    counts = {of_sensors: ("READINGS", "RUNS", "REGRESSOR_RUNS")}
    counts[of_plants] = ("STARTS", "STEPS", "GRID_STEPS", "MAX_RUNS")
    for module, names in counts.items() if name not in SMALL else ():
        for count in names:
            monkeypatch.setattr(module, count, max(2, getattr(module, count) // 4))


@pytest.mark.one_in(7)
@pytest.mark.usefixtures("fewer_draws")
@pytest.mark.parametrize("name", with_slow(SENSORS, {"Drifts"}))
def test_every_breach_of_a_sensor_is_named(name):
    refused(check_sensor, *SENSORS[name])


@pytest.mark.one_in(7)
@pytest.mark.usefixtures("fewer_draws")
@pytest.mark.parametrize("name", PLANTS)
def test_every_breach_of_a_plant_is_named(name):
    refused(check_plant, *PLANTS[name])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", MATCHINGS)
def test_every_breach_of_a_matching_is_named(name):
    refused(check_matching, *MATCHINGS[name])


def sensors():
    return [
        parts.LinearSensor(nodes=(0,), H=[[1.0, 0.5]], R=[[0.5]]),
        parts.LinearSensor(nodes=(0, 2, 5, 7), H=np.diag([1.0, 1e-7]), R=METRES_AND_RADIANS),
        parts.LinearSensor(nodes=(0, 2), H=[[1.0]], R=[[1e-8]], sampling=parts.Poisson(rate=2.0)),
        parts.LinearSensor(nodes=(4,), H=[[1.0]], R=[[1e6]], sampling=jittered()),
        parts.RegressorSensor(**REGRESSOR),
        *(cls(**settings) for cls, settings in HEALTHY_SENSORS),
    ]


def jittered():
    return parts.Periodic(period=0.3, phase="random", jitter=0.2)


def plants():
    return [
        parts.LinearPlant(**LINEAR),
        parts.LinearPlant(F=[[1.3, 0.1], [0.0, 0.5]], Q=[[1.0, 0.0], [0.0, 0.0]], period=0.5),
        parts.LinearPlant(F=[[1.0]], Q=[[0.0]], mean=[5.0], period=0.5),
        parts.Diffusion(**FLOW),
        parts.Diffusion(A=[[0.0, 1.0], [0.0, 0.0]], B=[[0.0], [0.3]], cov=np.eye(2)),
        parts.Diffusion(A=[[0.5]], B=[[0.3]], mean=[3.0], sensing_period=0.02),
        parts.Diffusion(A=[[0.0]], B=[[0.0]], mean=[3.0]),
        *(cls(**settings) for cls, settings in HEALTHY_PLANTS),
    ]


def matchings():
    return [
        parts.Matching("one-edge"),
        parts.Matching("one-edge", lazy=0.9),
        parts.Matching("node-wakeup"),
        parts.Matching("maximal"),
        parts.Matching("uniform-maximal"),
        parts.Matching("independent", p=0.02),
        parts.Matching("independent", p=1.0),
        parts.Broadcast(),
        *(cls(**settings) for cls, settings in HEALTHY_MATCHINGS),
    ]


@pytest.mark.one_in(6)
@pytest.mark.parametrize("k", with_slow(range(len(sensors())), {4}))
def test_sound_sensors_pass(k):
    assert check_sensor(sensors()[k]) is None


@pytest.mark.one_in(10)
@pytest.mark.parametrize("k", range(len(plants())))
def test_sound_plants_pass(k):
    assert check_plant(plants()[k]) is None


@pytest.mark.one_in(12)
@pytest.mark.parametrize("k", range(len(matchings())))
def test_sound_matchings_pass(k):
    assert check_matching(matchings()[k]) is None


def test_a_matching_is_looked_at_on_the_network_that_is_given():
    path = parts.PathGraph(nodes=3).build(seed=0)
    assert check_matching(parts.Matching("maximal"), topology=path) is None
    cls, settings, _ = MATCHINGS["Prefers"]
    with pytest.raises(AssertionError, match=r"on 3 nodes and 2 links, .*, link 0-1"):
        check_matching(cls, topology=path, **settings)


def test_recorded_parts_are_not_drawn(tmp_path):
    from netkf.core.fields import SourceFile

    (tmp_path / "x.csv").write_text("t,x0\n0,1.0\n1,2.0\n")
    (tmp_path / "y.csv").write_text("t,node,y0\n0,3,1.0\n1,3,2.0\n")
    (tmp_path / "pairs.csv").write_text("slot,node,peer\n1,0,1\n1,2,3\n2,0,3\n")
    x, y, pairs = (SourceFile(f"{name}.csv", tmp_path) for name in ("x", "y", "pairs"))
    matrices = {"F": [[1.0]], "Q": [[1.0]], "period": 1.0}
    assert check_plant(parts.RecordedPlant(path=x, **matrices)) is None
    assert check_plant(parts.UnknownPlant(**matrices)) is None
    assert check_sensor(parts.RecordedSensor(path=y, H=[[1.0]], R=[[1.0]])) is None
    assert check_matching(parts.RecordedSlots(path=pairs)) is None


def test_what_is_of_another_family_is_told():
    with pytest.raises(AssertionError, match="must be derived from Sensor"):
        check_sensor(parts.Matching("maximal"))
    with pytest.raises(AssertionError, match="must be derived from Plant"):
        check_plant(parts.Matching("maximal"))
    with pytest.raises(AssertionError, match="must be derived from SlotActivation"):
        check_matching(parts.Poisson(rate=1.0))
    with pytest.raises(AssertionError, match=r"could not be made with the settings .*missing"):
        check_plant(parts.LinearPlant, Q=[[1.0]])


@pytest.mark.parametrize("odd", [3, "x", np.nan, {}, object, np.eye(2)[0]])
def test_arguments_of_a_wrong_kind_are_told(odd):
    calls = {
        "topology": lambda: check_channel(parts.Bernoulli(delivery=0.5), topology=odd),
        "topology: must": lambda: check_matching(parts.Matching("maximal"), topology=odd),
        "link": lambda: check_clock(parts.Poisson(rate=1.0), link=odd),
        "link: must": lambda: check_clock(parts.Poisson(rate=1.0), link=(odd, "a")),
        "same_as_parent": lambda: check_filter(parts.Hybrid(epsilon=0.1), same_as_parent=odd),
        "P": lambda: assert_dominated({"P": odd}, np.eye(2)),
        "bound": lambda: assert_dominated(np.eye(2), {"bound": odd}),
        "tolerance": lambda: assert_dominated(np.eye(2), np.eye(2), {"tolerance": odd}),
        "folder": lambda: scenario_files([odd]),
    }
    for words, call in calls.items():
        with pytest.raises((AssertionError, netkf.NetkfError), match=words) as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_stated(monkeypatch):
    """At a level of 5 % for a whole check."""
    monkeypatch.setattr(noise, "LEVEL", 0.05)
    alarms = 0
    for part in (sensors()[2], plants()[0], plants()[6], *matchings()[:4]):
        family = (parts.LinearSensor, parts.Plant, parts.Matching)
        checker = next(c for f, c in zip(family, CHECKERS, strict=True) if isinstance(part, f))
        try:
            checker(part, 0)
        except AssertionError:
            alarms += 1
    assert alarms <= 2  # of 7: for one seed of 250 there are more


CHECKERS = (
    _check_sensor,
    _check_plant,
    lambda part, seed: _check_matching(part, None, seed),
)
