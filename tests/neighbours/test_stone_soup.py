"""Runs as objects of Stone Soup, with its own metrics, predictors and updaters."""

import datetime
from collections import Counter

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table
from tests.conftest import SCENARIOS

pytest.importorskip("stonesoup")
from stonesoup.measures import Euclidean
from stonesoup.metricgenerator.ospametric import OSPAMetric
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import (
    ExtendedKalmanUpdater,
    KalmanUpdater,
    UnscentedKalmanUpdater,
)


def test_ospa_of_a_track_is_the_error_of_its_node(run):
    found = run.to_stonesoup()
    (truth,) = found.truths
    metric = OSPAMetric(p=1, c=1e6, measure=Euclidean())
    for track in found.tracks:
        k = list(run.nodes).index(track.metadata["node"])
        both = (metric.extract_states([path], True) for path in (track, truth))
        computed = [one.value for one in metric.compute_over_time(*sum(both, ())).value]
        np.testing.assert_allclose(computed, np.sqrt(run.sq_error[:, k]), rtol=1e-12)
        np.testing.assert_array_equal(track.states[-1].covar, run.P[-1, k])
    assert {track.metadata["node"] for track in found.tracks} == set(run.nodes)


def test_detections_are_the_readings(run):
    start = datetime.datetime(2024, 2, 29, 12)
    found = run.to_stonesoup(start)
    senses = run.events[run.events.kind == "sense"]
    when = {
        (one.timestamp - start).total_seconds(): one
        for one in found.detections
        if one.metadata["node"] == run.nodes[0]
    }
    own = senses[senses.node == run.nodes[0]]
    np.testing.assert_allclose(sorted(when), own.t, atol=1e-6)
    # The readings less H x at their instants have the covariance R, by Stone Soup's own density.
    (truth,) = found.truths
    states = {state.timestamp: state for state in truth}
    hits = [one for one in found.detections if one.timestamp in states]
    nis = [
        float((z.T @ np.linalg.inv(one.measurement_model.covar()) @ z).item())
        for one in hits
        for z in [one.state_vector - one.measurement_model.function(states[one.timestamp])]
    ]
    assert len(nis) > 30
    assert abs(np.mean(nis) - 1.0) < 4.0 * np.sqrt(2.0 / len(nis))


@pytest.mark.parametrize("name", ["poisson_ring", "gossip_ring"])
def test_a_node_that_is_down_detects_nothing(name):
    lives = {"kind": "crashes", "nodes": [0, 1], "mean_up": 3.3, "mean_down": 1.7}
    changes = {"horizon": 20.0, "network.lives": [lives]}
    if name == "poisson_ring":
        changes["sensors.0.sampling"] = {"kind": "poisson", "rate": 2.0}
    run = netkf.simulate(netkf.load(SCENARIOS / f"{name}.toml").replace(changes), seed=2)
    senses = run.events[(run.events.kind == "sense") & (run.events.t > 0.0)]
    found = Counter(one.metadata["node"] for one in run.to_stonesoup().detections)
    assert found == Counter(senses.node.tolist())
    assert (run.events.kind == "crash").any()


def test_the_tracker_of_a_node_gives_what_local_gives(slot_run):
    """Stone Soup's Kalman filter, fed with the detections, has the track of the node."""
    scenario = slot_run.scenario.replace({"filter": {"kind": "local"}})
    run = netkf.simulate(scenario, engine="simpy")
    found, plant = run.to_stonesoup(), scenario.plant
    node = scenario.sensing_nodes[0]
    (track,) = [one for one in found.tracks if one.metadata["node"] == node]
    model = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=plant.F, covariance_matrix=plant.Q
    )
    predictor, updater = KalmanPredictor(model), KalmanUpdater()
    at = {d.timestamp: d for d in found.detections if d.metadata["node"] == node}
    state = GaussianState(plant.start_mean, plant.start_cov, timestamp=track[0].timestamp)
    for theirs in track[1:-1]:  # the last sample uses readings of the horizon, which is over
        prediction = predictor.predict(state, timestamp=theirs.timestamp)
        state = prediction
        if theirs.timestamp in at:
            state = updater.update(SingleHypothesis(prediction, at[theirs.timestamp]))
        np.testing.assert_allclose(theirs.mean, state.mean, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(theirs.covar, state.covar, rtol=1e-8, atol=1e-12)


def test_nonlinear_detections_have_the_jacobian_of_their_sensor():
    path = SCENARIOS / "nonlinear" / "range_tracking.toml"
    driven = {"kind": "constant", "G": [[1.0], [0.0], [0.0], [0.0]], "value": [3.0]}
    scenario = netkf.load(path, {"horizon": 4.0, "plant.input": driven})
    run = netkf.simulate(scenario, engine="simpy")
    found = run.to_stonesoup()
    (truth,) = found.truths
    states = {state.timestamp: state for state in truth}
    for d in found.detections:
        if d.timestamp in states:
            y = d.measurement_model.function(states[d.timestamp])
            assert abs(float((d.state_vector - y)[0])) < 5.0 * scenario.sensors[0].R[0, 0] ** 0.5
    one = next(d for d in found.detections if d.timestamp in states)
    state = states[one.timestamp]
    x, model = state.state_vector[:, 0].astype(float), one.measurement_model
    numeric = np.column_stack(
        [
            (
                model.function(GaussianState(x + 1e-6 * e, np.eye(len(x))))
                - model.function(GaussianState(x - 1e-6 * e, np.eye(len(x))))
            )[:, 0]
            / 2e-6
            for e in np.eye(len(x))
        ]
    ).astype(float)
    np.testing.assert_allclose(model.jacobian(state), numeric, atol=1e-6)
    prior = GaussianState(x, np.eye(len(x)), timestamp=one.timestamp)
    posterior = ExtendedKalmanUpdater().update(SingleHypothesis(prior, one))
    J, R = numeric, model.covar()
    expected = np.linalg.inv(np.eye(len(x)) + J.T @ np.linalg.inv(R) @ J)
    np.testing.assert_allclose(posterior.covar.astype(float), expected, atol=1e-6)


def test_directions_are_angles_of_stone_soup(tmp_path):
    """Its unscented filter, whose points lie on both sides of half a turn, has the node's track."""
    table = {
        "format": 1, "name": "behind", "horizon": 9.0, "probe": 1.0, "seed": 2,
        "plant": {
            "kind": "linear", "F": np.eye(2).tolist(), "Q": np.diag([0.02, 0.3]).tolist(),
            "period": 1.0, "mean": [-4.0, 0.0], "cov": [[0.2, 0.0], [0.0, 0.2]],
        },
        "sensors": [
            {
                "kind": "range-bearing", "nodes": [0], "positions": [[0.0, 0.0]],
                "R": [[0.04, 0.0], [0.0, 0.01]],
            }
        ],
        "network": {"graph": {"kind": "edges", "edges": [], "nodes": 1}},
        "filter": {"kind": "local", "linearise": "ukf"},
    }  # fmt: skip
    scenario = from_table(table, tmp_path)
    found, plant = netkf.simulate(scenario, engine="simpy").to_stonesoup(), scenario.plant
    model = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=plant.F, covariance_matrix=plant.Q
    )
    predictor, updater = KalmanPredictor(model), UnscentedKalmanUpdater(alpha=1, beta=2, kappa=0)
    (track,), at = found.tracks, {d.timestamp: d for d in found.detections}
    state = GaussianState(plant.start_mean, plant.start_cov, timestamp=track[0].timestamp)
    for theirs in track[1:-1]:
        prediction = predictor.predict(state, timestamp=theirs.timestamp)
        state = updater.update(SingleHypothesis(prediction, at[theirs.timestamp]))
        # Stone Soup averages angles on the circle, which is not quite their mean.
        mean, covar = state.mean.astype(float), state.covar.astype(float)
        np.testing.assert_allclose(theirs.mean.astype(float), mean, atol=2e-3)
        np.testing.assert_allclose(theirs.covar.astype(float), covar, atol=2e-3)


def test_blocks_are_paths_of_their_own():
    scenario = netkf.load(
        SCENARIOS / "blocks" / "cooperative_localisation.toml",
        {"horizon": 2.0, "filter": {"kind": "local", "estimates": "own+neighbours"}},
    )
    run = netkf.simulate(scenario)
    found = run.to_stonesoup()
    assert {truth.id for truth in found.truths} == {p.label for p in scenario.layout.places}
    track = next(iter(found.tracks))
    about = track.metadata
    block = run.block(about["block"], about["owner"], about["node"])
    np.testing.assert_array_equal([s.state_vector[:, 0].astype(float) for s in track], block.xhat)
    (truth,) = [t for t in found.truths if t.id == f"{about['block']}@{about['owner']}"]
    np.testing.assert_array_equal([s.state_vector[:, 0].astype(float) for s in truth], block.x)


def test_sample_times_nearer_than_a_microsecond_are_refused():
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 1e-6, "probe": 1e-7})
    run = netkf.simulate(scenario, engine="simpy")
    with pytest.raises(netkf.ScenarioError, match="must be a microsecond apart"):
        run.to_stonesoup()
    with pytest.raises(netkf.ScenarioError, match="start: must be a datetime"):
        run.to_stonesoup("noon")
