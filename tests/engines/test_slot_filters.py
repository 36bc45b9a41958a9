"""Filters of the literature in slots: both engines make one run, and batches hold the single runs.

What the formulas are is tested in tests/algorithms; here it is networks, sensors and frames.
"""

import numpy as np
import pytest

import netkf
from netkf.engines.compiled.engine import CompiledEngine
from tests.algorithms.test_literature import GRAPH, scenario_of
from tests.engines.agreement import assert_agree, assert_blocks_do_not_matter
from tests.engines.test_batches import assert_alone

BROADCAST = {"kind": "broadcast"}
LOSS = {"loss": {"kind": "bernoulli", "delivery": 0.6}}
BURSTS = {"kind": "gilbert-elliott", "mean_loss": 0.4, "mean_burst": 3.0}
ARROWS = [[0, 1], [1, 2], [2, 0], [3, 2], [2, 4], [4, 3], [1, 3]]
NETWORKS = {
    "lossless": {"graph": GRAPH},
    "loss": {"graph": GRAPH, "channel": LOSS},
    "each way": {"graph": GRAPH, "channel": {**LOSS, "symmetric": False}},
    "one way": {"graph": {"kind": "edges", "edges": ARROWS, "directed": True}, "channel": LOSS},
    "bursts": {"graph": GRAPH, "channel": {"loss": BURSTS, "symmetric": False}},
    "tree": {"graph": {"kind": "star", "nodes": 6}, "channel": {**LOSS, "symmetric": False}},
    "complete": {"graph": {"kind": "complete", "nodes": 5}},
    "dense": {"graph": {"kind": "complete", "nodes": 9}, "channel": {**LOSS, "symmetric": False}},
    "late": {"graph": GRAPH, "channel": {"delay": {"kind": "uniform", "low": 0.0, "high": 0.6}}},
    "alone": {"graph": {"kind": "edges", "edges": [], "nodes": 5}},
}
LATE = {**BROADCAST, "phase": 0.3}
TRIGGERED = {"kind": "event-triggered", "trigger": "stochastic", "Y": 1.0}
FILTERS = {
    "consensus-innovations": {"kind": "consensus-innovations"},
    "cross-covariance": {"kind": "track-fusion", "rule": "cross-covariance"},
    "belief-propagation": {"kind": "belief-propagation", "steps": 3},
    "beliefs that are kept": {"kind": "belief-propagation", "steps": 2, "memory": "all"},
    "one-bit": {"kind": "one-bit"},
}


def network_of(name):
    return {"activation": LATE if name == "late" else BROADCAST, **NETWORKS[name]}


def made(name, folder, seed=0, n=2, **more):
    """The scenario of a filter; messages are kept where the plant has no noise. States that decay
    fast would then be known to more digits than others have.
    """
    if FILTERS[name].get("memory") == "all":
        plant = scenario_of({"kind": "local"}, folder, seed, n, **more).plant
        F = plant.F if "plant" in more else 0.9 * np.eye(n) + 0.1 * plant.F
        tables = {"F": F.tolist(), "Q": np.zeros((n, n)).tolist(), "cov": plant.cov.tolist()}
        more["plant"] = {"kind": "linear", "period": 1.0, **tables}
    return scenario_of(FILTERS[name], folder, seed, n, **more)


@pytest.mark.one_in(9)
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("name", FILTERS)
def test_both_engines_make_the_same_run(name, network, tmp_path):
    if (name, network) == ("one-bit", "alone"):
        with pytest.raises(netkf.ScenarioError, match="must be nodes that others hear"):
            made(name, tmp_path, network=network_of(network))
        return
    missing = 0
    for seed, n in enumerate((1, 2, 4)):
        scenario = made(name, tmp_path, seed, n, network=network_of(network))
        run = assert_agree(scenario, replica=seed)
        missing += run.count("lost") + run.count("late")
    assert (missing > 5) == (network not in ("lossless", "complete", "alone"))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("network", ["loss", "one way", "dense"])
@pytest.mark.parametrize("name", FILTERS)
def test_batches_hold_the_single_runs(name, network, tmp_path):
    """Nine runs are more than a block of lanes holds."""
    scenario = made(name, tmp_path, 3, network=network_of(network))
    assert_alone(scenario, CompiledEngine(), 5, range(2, 11), fingerprint=True)


@pytest.mark.parametrize("name", FILTERS)
def test_blocks_of_slots_do_not_matter(name, tmp_path, monkeypatch):
    """A kernel is called for some slots at a time."""
    scenario = made(name, tmp_path, 1, network=network_of("loss"), horizon=30.0)
    assert_blocks_do_not_matter(scenario, monkeypatch)


UNSTABLE = {"kind": "linear", "F": [[1.3, 0.2], [0.0, 1.2]], "Q": [[0.1, 0.0], [0.0, 0.2]]}
UNSTABLE |= {"cov": [[1.0, 0.2], [0.2, 2.0]], "period": 1.0}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", FILTERS)
def test_errors_of_unstable_plants_are_exact(name, tmp_path):
    """Where states have no digits left: both engines count from the same origins."""
    more = {"plant": UNSTABLE, "horizon": 161.0, "probe": [0.0, 40.0, 90.0, 160.0]}
    sensors = [{"nodes": [0, 1, 2, 3, 4], "H": [[1.0, 0.3], [0.2, 1.0]], "R": np.eye(2).tolist()}]
    more |= {"sensors": sensors, "network": network_of("lossless")}
    run = assert_agree(made(name, tmp_path, 2, **more))
    assert run.exact_errors
    assert np.abs(run.x).max() > 1e15
    # One bit a slot does not hold a state that grows by 30 %.
    assert (np.abs(run.error).max() < 50.0) == (name != "one-bit")


READINGS = {
    "intermittent": {"kind": "intermittent"},
    "diffusion-kalman": {"kind": "diffusion-kalman"},
    "kcf": {"kind": "kcf"},
    "hcmci": {"kind": "hcmci"},
    "track-fusion": {"kind": "track-fusion", "rule": "ci"},
    "scheduled": {**TRIGGERED, "inner": {"kind": "intermittent"}},
    "triggered": {**TRIGGERED, "inner": {"kind": "diffusion-kalman"}},
}
COUNTING = {"consensus-innovations", "cross-covariance", "scheduled"}
"""Those whose P counts every reading, so that none may be missing (tests/scenario)."""


@pytest.mark.one_in(4)
@pytest.mark.parametrize("network", ["loss", "one way", "late"])
@pytest.mark.parametrize("name", sorted({*FILTERS, *READINGS} - COUNTING))
def test_recorded_sensors_may_miss_slots(name, network, tmp_path):
    """Node 0 has two of them, of which one or both may have no row; node 3 always reads one."""
    files = {"a": (1, 2, 5), "b": (2, 3, 5), "c": (1, 3, 4, 6), "d": (2, 3)}
    for (file, slots), node in zip(files.items(), (0, 0, 2, 3), strict=True):
        rows = "".join(f"{slot},{node},{0.3 * slot - node}\n" for slot in slots)
        (tmp_path / f"{file}.csv").write_text("t,node,y0\n" + rows)
    table = {"kind": "recorded", "R": [[0.4]]}
    sensors = [
        {**table, "path": "a.csv", "H": [[1.0, 0.2]], "nodes": [0]},
        {**table, "path": "b.csv", "H": [[0.1, 0.8]], "nodes": [0]},
        {**table, "path": "c.csv", "H": [[0.5, 1.0]], "nodes": [2]},
        {**table, "path": "d.csv", "H": [[0.5, 0.3]], "nodes": [3]},
        {"nodes": [3], "H": [[1.0, 0.0]], "R": [[0.2]]},
    ]
    more = {"sensors": sensors, "network": network_of(network)}
    if name in FILTERS:
        scenario = made(name, tmp_path, 1, **more)
    else:
        scenario = scenario_of(READINGS[name], tmp_path, 1, **more)
    assert_agree(scenario)
    if network != "late":
        assert_alone(scenario, CompiledEngine(), 5, range(2, 12), fingerprint=True)


def test_more_neighbours_than_a_number_has_bits(tmp_path):
    """Combinations of tracks are found again by whom a node has heard."""
    graph = {"kind": "star", "nodes": 70}
    network = {"graph": graph, "activation": BROADCAST, "channel": {**LOSS, "symmetric": False}}
    scenario = made("cross-covariance", tmp_path, n=1, network=network)
    assert_agree(scenario.replace({"horizon": 4.0, "probe": [0.0, 1.0, 2.0, 3.0]}))
