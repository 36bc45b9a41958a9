"""Nonlinear sensors: their derivatives, the extended Kalman filter, what theory leaves out."""

import dataclasses
import math
import tomllib
from dataclasses import dataclass

import numpy as np
import pytest

import netkf
from netkf import parts, theory
from netkf.rng.streams import Streams
from netkf.scenario.reading import from_table
from netkf.testing import check_sensor
from netkf.theory.promises import compute_promises, promises_text
from tests.algorithms.test_literature import ROTATION, scenario_of
from tests.conftest import ROOT

TRACKING = ROOT / "scenarios" / "nonlinear" / "range_tracking.toml"
PLACES = [[0.0, 0.0], [1.0, 2.0], [-1.0, 0.5]]
H = np.array([[1.0, 0.3]])


@dataclass(frozen=True, eq=False)
class Affine(parts.NonlinearSensor):
    """A linear h, which must give what a linear sensor gives."""

    def h(self, x, node):
        return H @ x

    def jacobian(self, x, node):
        return H


@dataclass(frozen=True, eq=False)
class Wrong(Affine):
    def jacobian(self, x, node):
        return 1.1 * H


@pytest.mark.parametrize(
    "sensor",
    [
        parts.RangeSensor(nodes=(0, 1, 2), R=[[0.1]], positions=PLACES),
        parts.RangeSensor(nodes=(0,), R=[[0.1]], positions=[[0.0, 1.0, 2.0]], states=(4, 0, 2)),
        parts.BearingSensor(nodes=(0, 1, 2), R=[[0.1]], positions=PLACES, states=(0, 2)),
        parts.RangeBearingSensor(nodes=(0, 1), R=[[0.1, 0.0], [0.0, 0.2]]),
        Affine(nodes=(0, 1), R=[[0.3]]),
    ],
)
def test_jacobians_are_derivatives(sensor):
    check_sensor(sensor)


def test_a_wrong_jacobian_is_named():
    with pytest.raises(AssertionError, match=r"Wrong.jacobian: must be the derivatives of h"):
        check_sensor(Wrong(nodes=(0,), R=[[0.3]]))


def test_readings_are_distances_and_directions():
    sensor = parts.RangeBearingSensor(nodes=(3, 5), R=np.eye(2), positions=PLACES[:2])
    np.testing.assert_allclose(sensor.h(np.array([4.0, 6.0]), 5), [5.0, math.atan2(4.0, 3.0)])
    # The shorter way round, and nothing where there is no derivative.
    gap = sensor.difference(np.array([1.0, 3.1]), np.array([0.5, -3.1]))
    np.testing.assert_allclose(gap, [0.5, 6.2 - 2.0 * math.pi])
    np.testing.assert_array_equal(sensor.jacobian(np.zeros(2), 3), np.zeros((2, 2)))


# The same run with a linear sensor and with an h(x) that is linear.


def both(algorithm, folder, **more):
    found = []
    for cls in (parts.LinearSensor, Affine):
        scenario = scenario_of(algorithm, folder, sensors=[], **more)
        own = {"H": H} if cls is parts.LinearSensor else {}
        clock = {} if scenario.slotted else {"sampling": parts.Poisson(rate=2.0)}
        sensors = (cls(nodes=(0, 2), R=[[0.3]], **own, **clock),)
        found.append(dataclasses.replace(scenario, sensors=sensors))
    return [netkf.simulate(scenario, engine="simpy") for scenario in found]


SLOT_FILTERS = ["hcmci", "icf", "kcf", "diffusion", "diffusion-kalman", "local", "central"]
SLOT_FILTERS += ["intermittent", "track-fusion", "one-bit"]


@pytest.mark.parametrize("kind", SLOT_FILTERS)
def test_with_a_linear_h_it_is_the_linear_filter(kind, tmp_path):
    rule = {"rule": "ci"} if kind == "track-fusion" else {}
    linear, extended = both({"kind": kind, **rule}, tmp_path)
    np.testing.assert_allclose(extended.xhat, linear.xhat, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(extended.P, linear.P, rtol=1e-12, atol=1e-13)
    assert netkf.first_difference(linear, extended) is None


@pytest.mark.parametrize("algorithm", [{"kind": "hybrid", "epsilon": 0.2}, {"kind": "central"}])
def test_with_a_linear_h_under_clocks(algorithm, tmp_path):
    network = {"graph": {"kind": "cycle", "nodes": 4}}
    network["activation"] = {"kind": "poisson", "rate": 2.0, "at": "links"}
    more = {"plant": ROTATION, "network": network, "horizon": 4.0, "probe": 0.5}
    linear, extended = both(algorithm, tmp_path, **more)
    np.testing.assert_allclose(extended.xhat, linear.xhat, rtol=1e-11, atol=1e-12)
    assert netkf.first_difference(linear, extended) is None


# The textbook of the extended Kalman filter.

RANGES = {"kind": "range-bearing", "nodes": [0, 1], "R": [[0.02, 0.0], [0.0, 0.01]]}
RANGES |= {"positions": PLACES[:2]}


def test_the_extended_kalman_filter(tmp_path):
    """Local filters, from the readings that the streams of the run give, by plain formulas."""
    places = [[0.4, -0.2], [1.0, 2.0]]
    more = {"sensors": [{**RANGES, "positions": places}], "horizon": 13.0, "probe": 1.0}
    scenario = scenario_of({"kind": "local"}, tmp_path, 0, **more)
    run = netkf.simulate(scenario)
    F, Q, R = scenario.plant.F, scenario.plant.Q, np.array(RANGES["R"])
    turned = 0
    for k in (0, 1):
        path = scenario.slot_path(Streams(run.seed, run.replica), k, scenario.placed_sensors[k][0])
        x, P, q = np.zeros(2), scenario.plant.cov, np.array(places[k])
        for slot in range(1, 13):
            x, P = F @ x, F @ P @ F.T + Q
            y, d = path.reading(slot, run.x[slot]), x - q
            r = np.linalg.norm(d)
            v = y - [r, math.atan2(d[1], d[0])]
            turned += abs(v[1]) > math.pi
            v[1] = math.remainder(v[1], 2.0 * math.pi)
            J = np.array([d / r, [-d[1] / r**2, d[0] / r**2]])
            K = P @ J.T @ np.linalg.inv(J @ P @ J.T + R)
            x, P = x + K @ v, (np.eye(2) - K @ J) @ P
            np.testing.assert_allclose(run.xhat[slot, k], x, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(run.P[slot, k], P, rtol=1e-9, atol=1e-10)
    assert turned > 0, "no bearing went the shorter way round"


@pytest.fixture(scope="module")
def tracking():
    return netkf.load(TRACKING)


def test_the_shipped_scenario_tracks(tracking):
    """Consensus brings a distance or a direction here and there to all nodes."""
    run = netkf.simulate(tracking)
    late = np.abs(run.error[20:, :, [0, 2]])
    assert run.status == "complete"
    assert late.mean() < 0.1
    alone = netkf.simulate(tracking.replace({"filter": {"kind": "local"}}))
    assert np.abs(alone.error[20:, :, [0, 2]]).mean() > 4.0 * late.mean()


def test_what_linear_theory_cannot_promise_is_said(tracking):
    table = theory.assumptions(tracking)
    assert table.iloc[0].tolist()[:3] == ["readings are linear in the state", "all papers", False]
    text = promises_text(tracking, compute_promises(tracking))
    assert "FAILS    readings are linear in the state" in text
    run = netkf.simulate(tracking)
    with pytest.raises(netkf.TheoryError, match="readings are not linear"):
        theory.error_covariance(tracking, run)
    found = netkf.consistency(tracking.replace({"horizon": 12.0}), 10, workers=1)
    assert all("the expected NEES is unknown" in row.verdict for row in found.rows)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"states": [0, 4]}, "sensors[0].states: must be different components of a state of 4"),
        ({"positions": [[0.0, 0.0]]}, "sensors[0].positions: must be 3 rows of 2"),
        ({"R": [[1.0, 0.0], [0.0, 1.0]]}, "sensors[0].R: must be 1 x 1"),
        ({"kind": "bearing", "states": [0, 1, 2]}, "sensors[0].states: must be 2"),
        ({"kind": "bearing", "heading": 2}, "sensors[0].heading: must be another component of"),
        ({"nodes": [0, 99]}, "sensors[0].nodes[1]: must be a node of the graph; got 99"),
    ],
)
def test_mistakes_get_one_line(change, words, tmp_path):
    whole = tomllib.loads(TRACKING.read_text(encoding="utf-8"))
    whole["sensors"][0] |= change
    with pytest.raises(netkf.ScenarioError) as caught:
        from_table(whole, tmp_path)
    assert words in str(caught.value)


def test_positions_are_those_of_the_graph_or_must_be_given(tmp_path):
    sensor = {"kind": "range", "nodes": [0], "R": [[0.1]]}
    with pytest.raises(netkf.ScenarioError, match="are missing, and this graph has none"):
        scenario_of({"kind": "local"}, tmp_path, sensors=[sensor])


def test_filters_with_a_fixed_h_and_sensors_without_a_clock_are_refused(tmp_path, tracking):
    with pytest.raises(netkf.ScenarioError, match="must have a fixed H"):
        tracking.replace({"filter": {"kind": "track-fusion", "rule": "cross-covariance"}})
    network = {"graph": {"kind": "cycle", "nodes": 4}}
    network["activation"] = {"kind": "poisson", "rate": 2.0}
    settings = {"plant": ROTATION, "network": network, "sensors": [RANGES], "probe": 0.5}
    with pytest.raises(netkf.ScenarioError, match=r"sensors\[0\].sampling: is missing"):
        scenario_of({"kind": "hybrid", "epsilon": 0.2}, tmp_path, **settings)
