"""Sensors that users write run in both engines alike, wherever Python can read them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import netkf
from netkf.network.clocks import Periodic, Poisson, Renewal
from netkf.parts import Cycle, covariance, matrix, setting
from netkf.plants.sampling import DrawnSamples
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.testing import check_sensor
from tests.engines.agreement import assert_agree
from tests.testing.sound_parts import Bearing, LaplaceSensor


class Skewed:
    """Readings with noise that has no kernel, of an H that turns; the least that is asked for."""

    def __init__(self, random, R):
        self.random, self.R = random, R

    def matrix(self, k):
        return np.array([[np.cos(0.1 * k), np.sin(0.1 * k), 0.0, 0.0]])

    def draw(self, k, x):
        noise = np.sqrt(self.R[0]) * (self.random.exponential() - 1.0)
        return self.matrix(k) @ x + noise


class SkewedInSlots(Skewed):
    def reading(self, slot, x):
        return self.draw(slot, x)

    def covariance(self, slot, R):
        return R * (1.0 + slot % 2)


class SkewedSamples:
    def __init__(self, random, R):
        self.readings = Skewed(random, R)

    def reading(self, k, x):
        return self.readings.draw(k, x), self.readings.matrix(k)


@dataclass(frozen=True, eq=False)
class Turning(LinearSensor):
    def slot_path(self, node, period, generator):
        return SkewedInSlots(generator("noise"), self.R)

    def samples(self, node, generator, horizon):
        return SkewedSamples(generator("noise"), self.R)


@dataclass(frozen=True, eq=False)
class Biased(LinearSensor):
    def samples(self, node, generator, horizon):
        return DrawnSamples(1.01 * self.H, self.R, generator("noise"))


@dataclass(frozen=True, eq=False)
class Empty(LinearSensor):
    pass


@dataclass(frozen=True, eq=False)
class Increments(LinearSensor):
    def path(self, random, cutting):
        return super().path(random, cutting)


ONE = {"H": [[1.0, 0.0, 0.0, 0.0]], "R": [[0.5]]}
TWO = {"H": np.eye(2, 4), "R": [[0.5, 0.2], [0.2, 0.3]]}
INPUT = {"kind": "constant", "G": np.eye(4, 1).tolist(), "value": [0.7]}
IN_SLOTS = {
    "laplace": LaplaceSensor(nodes=(0, 2), **TWO),
    "from the contract": Bearing(nodes=(1, 3), direction=[3.0, 4.0, 0.0, 0.0], sigma=0.5),
    "turning": Turning(nodes=(0, 4), **ONE),
    "empty": Empty(nodes=(0, 4), **ONE),
}


@pytest.fixture(scope="module")
def slots():
    return netkf.load("scenarios/gossip_ring.toml").replace({"horizon": 20.0})


@pytest.fixture(scope="module")
def clocks():
    return netkf.load("scenarios/intel_lab_radio.toml").replace({"horizon": 6.0})


def in_clocks(scenario, cls):
    old = scenario.sensors[0]
    own = cls(nodes=old.nodes, H=old.H, R=old.R, sampling=Periodic(period=0.5, jitter=0.1))
    return scenario.replace({"sensors": [own]})


@pytest.mark.parametrize("kind", IN_SLOTS)
def test_in_slots(slots, kind):
    built_in = LinearSensor(nodes=(1,), H=[[0.0, 1.0, 0.0, 0.0]], R=[[2.0]])
    # Beside an input states are counted from the response to it.
    driven = {"plant.input": INPUT} if kind == "turning" else {}
    scenario = slots.replace({"sensors": [IN_SLOTS[kind], built_in], **driven})
    run = assert_agree(scenario)
    assert netkf.simulate(scenario).engine == "compiled"
    # Runs side by side are what they are alone.
    ensemble = netkf.monte_carlo(scenario, 11, workers=1)
    errors = [netkf.simulate(scenario, replica=r).error for r in range(11)]
    mean = np.mean([e[:, :, :, None] * e[:, :, None, :] for e in errors], axis=0)
    np.testing.assert_allclose(ensemble.mean_error, mean, rtol=1e-9, atol=1e-9)
    assert run.status == "complete"


@pytest.mark.one_in(3)
@pytest.mark.parametrize("cls", [Turning, Biased, Empty])
def test_samples(clocks, cls):
    scenario = in_clocks(clocks, cls)
    run = assert_agree(scenario)
    assert (run.events["kind"] == "sense").any()


class OneByOne:
    """Samples of a fixed H; the least that is asked for."""

    def __init__(self, sensor, random):
        self.sensor, self.random, self.noise = sensor, random, []

    def reading(self, k, x):
        while len(self.noise) <= k:
            self.noise.append(self.random.standard_normal(1))
        return self.sensor.H @ x + np.sqrt(self.sensor.R[0]) * self.noise[k], self.sensor.H


@dataclass(frozen=True, eq=False)
class FromTheContract(Sensor):
    H: np.ndarray = setting(matrix)
    R: np.ndarray = setting(covariance)
    sampling: Any = None

    def slot_path(self, node, period, generator):
        raise NotImplementedError

    def samples(self, node, generator, horizon):
        return OneByOne(self, generator("noise"))


class AtItsTimes(FromTheContract):
    def sample_times(self, node, ordinal, generator, horizon):
        return np.arange(0.25, horizon, 0.5)


def test_samples_of_a_sensor_that_derives_from_the_contract_alone(clocks):
    ticking = FromTheContract(nodes=(3,), sampling=Poisson(rate=2.0), **ONE)
    for sensor in (ticking, AtItsTimes(nodes=(3,), **ONE)):
        scenario = clocks.replace({"sensors": [sensor]})
        assert (assert_agree(scenario).events["kind"] == "sense").any()
        assert netkf.check(scenario, runs=10)
    with pytest.raises(netkf.ScenarioError, match="is missing, and a custom sensor takes samples"):
        clocks.replace({"sensors": [FromTheContract(nodes=(3,), **ONE)]})
    check_sensor(ticking)


def test_theory_asks_when_a_sensor_from_the_contract_samples(clocks):
    gamma = Renewal(distribution="gamma", shape=2.0, mean=0.5)
    for sensor in (
        FromTheContract(nodes=(3,), sampling=gamma, **ONE),
        AtItsTimes(nodes=(3,), **ONE),
    ):
        hybrid = {"sensors": [sensor], "filter": {"kind": "hybrid", "epsilon": 0.02}}
        hybrid["network"] = netkf.Network(graph=Cycle(4), activation=Poisson(rate=1.0))
        with pytest.raises(netkf.TheoryError, match="samples is random and no Poisson process"):
            netkf.theory.covariance_bound(clocks.replace(hybrid), [1.0])


def test_increments_of_a_sensor_that_overrides_nothing_are_compiled():
    ring = netkf.load("scenarios/poisson_ring.toml").replace({"horizon": 3.0})
    old = ring.sensors[0]
    same, own = (
        ring.replace({"sensors": [cls(nodes=old.nodes, H=old.H, R=old.R)]})
        for cls in (Empty, Increments)
    )
    assert netkf.simulate(same).engine == "compiled"
    assert_agree(same)
    assert netkf.simulate(own).engine == "simpy"
    with pytest.raises(netkf.NetkfError, match=r"cannot run the sensor .*Increments"):
        netkf.simulate(own, engine="compiled")


def test_what_nobody_reads_in_bulk_is_refused(slots):
    @dataclass(frozen=True, eq=False)
    class Curved(Sensor):
        linear = False
        H = np.eye(2)
        R = np.eye(2)

        def slot_path(self, node, period, generator):
            raise AssertionError

    with pytest.raises(netkf.NetkfError):
        netkf.simulate(slots.replace({"sensors": [Curved(nodes=(0,))]}), engine="compiled")


class OddInSlots(SkewedInSlots):
    give = staticmethod(lambda y: y)

    def reading(self, slot, x):
        return OddInSlots.give(self.draw(slot, x))


class OddSamples(SkewedSamples):
    def reading(self, k, x):
        y, H = super().reading(k, x)
        return OddInSlots.give(y), H


@dataclass(frozen=True, eq=False)
class Odd(LinearSensor):
    def slot_path(self, node, period, generator):
        return OddInSlots(generator("noise"), self.R)

    def samples(self, node, generator, horizon):
        return OddSamples(generator("noise"), self.R)


NO_READINGS = {
    "a number": lambda y: float(y[0]),
    "a column": lambda y: y[:, None],
    "nothing": lambda y: None,
    "nan": lambda y: np.nan * y,
    "too much": lambda y: np.append(y, 1.0),
    "complex": lambda y: y + 1j,
}


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("name", NO_READINGS)
def test_what_is_no_reading_is_refused_alike(slots, clocks, name, engine, monkeypatch):
    changes = {"sensors": [Odd(nodes=(0, 4), **ONE)]}
    monkeypatch.setattr(OddInSlots, "give", staticmethod(NO_READINGS[name]))
    driven = slots.replace({**changes, "plant.input": INPUT})
    for scenario in (slots.replace(changes), driven, in_clocks(clocks, Odd)):
        with pytest.raises(netkf.ScenarioError, match=r"Odd.*\.reading must give finite numbers"):
            netkf.simulate(scenario, engine=engine)


@pytest.mark.parametrize("time", ["slots", "driven", "clocks"])
def test_a_reading_without_values_tells_as_little_as_a_row_of_zeros(
    slots, clocks, time, monkeypatch
):
    changes = {"sensors": [Odd(nodes=(0, 4), **ONE)]}
    changes |= {"plant.input": INPUT} if time == "driven" else {}
    scenario = in_clocks(clocks, Odd) if time == "clocks" else slots.replace(changes)
    with monkeypatch.context() as patch:
        patch.setattr(OddInSlots, "give", staticmethod(lambda y: y[:0]))
        run = netkf.simulate(scenario, engine="simpy")
        with pytest.raises(netkf.ScenarioError, match="no values at times, which only SimPy"):
            netkf.simulate(scenario, engine="compiled")
    monkeypatch.setattr(Skewed, "matrix", lambda self, k: np.zeros((1, 4)))
    zeros = netkf.simulate(scenario, engine="simpy")
    np.testing.assert_allclose(run.xhat, zeros.xhat, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.P, zeros.P, rtol=1e-12)
    assert run.fingerprint == zeros.fingerprint
