"""Nodes that estimate different parts of the state: the compiled engine makes what SimPy makes."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.engines.compiled import slot_pairs
from netkf.engines.compiled.slot_setup import slot_setup
from tests.algorithms.test_block_intersection import CLOCKED, ROBOTS, load
from tests.algorithms.test_partition import AREAS, FLOWS
from tests.algorithms.test_partition import clocked as clocked_areas
from tests.engines.agreement import assert_agree

POSES = """
format = 1
name = "blocks of different size"
horizon = 9.0
probe = 1.0
seed = 5
[[plants]]
name = "pose"
nodes = [1, 2]
F = [[0.9, 0.1], [0.0, 0.8]]
Q = [[0.2, 0.0], [0.0, 0.1]]
period = 1.0
cov = [[1.0, 0.2], [0.2, 0.5]]
input = { kind = "sine", G = [[1.0], [0.5]], amplitude = 1.0, frequency = 0.1 }
schedule = [{ from = 4.0, F = [[0.7, 0.0], [0.2, 0.9]] }]
[[plants]]
name = "pose"
nodes = [3]
F = [[0.95, 0.0, 0.1], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]]
Q = [[0.3, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.1]]
period = 1.0
cov = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
mean = [4.0, 1.0, 0.0]
[[sensors]]
of = "pose"
nodes = [1, 2]
H = [[1.0, 0.0], [0.0, 1.0]]
R = [[0.1, 0.02], [0.02, 0.3]]
[[sensors]]
of = "pose"
nodes = [3]
H = [[1.0, 0.0, 1.0]]
R = [[0.1]]
[network]
graph = { kind = "edges", edges = [[1, 2], [2, 3]] }
activation = { kind = "broadcast" }
channel = { loss = { kind = "bernoulli", delivery = 0.7 } }
[filter]
kind = "local"
estimates = "own"
"""
RANGES = """
[[sensors]]
kind = "range"
of = "pose"
nodes = [2]
positions = [[3.0, 1.0]]
R = [[0.1]]
"""
SIGHTS = """
[[sensors]]
kind = "relative-range-bearing"
of = "pose"
R = [[0.1, 0.0], [0.0, 0.05]]
[[sensors]]
kind = "relative"
path = "seen.csv"
R = [[0.2, 0.0], [0.0, 0.1]]
nodes = [1, 2]
"""
SEEN = "t,node,to,y0,y1\n1,1,2,0.3,0.2\n2,1,2,0.1,\n2,1,2,,0.4\n3,2,1,-0.3,0.1\n5,1,2,0.5,0.5\n"


def poses(folder: Path, more: str, **changes: object) -> netkf.Scenario:
    (folder / "seen.csv").write_text(SEEN)
    return load(POSES.replace("[network]", more + "[network]"), folder, **changes)


def clocked(text: str) -> str:
    """The same blocks in continuous time: one node reads increments, the others samples."""
    text = text.replace("F = [[0.9, 0.1], [0.0, 0.8]]\nQ =", "A = [[-0.1, 0.1], [0.0, -0.2]]\nB =")
    text = text.replace("F = [[0.95, 0.0, 0.1], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]]\nQ =", FLOW)
    text = text.replace("F = [[0.7, 0.0], [0.2, 0.9]]", "A = [[-0.3, 0.0], [0.2, -0.1]]")
    text = text.replace("\nperiod = 1.0", "").replace(
        '"broadcast"', '"poisson", at = "nodes", rate = 2.0'
    )
    return text.replace("0.3]]\n[[sen", "0.3]]\nsampling = { kind = 'poisson', rate = 2.0 }\n[[sen")


FLOW = "A = [[0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, -0.1]]\nB ="


@pytest.mark.one_in(3)
@pytest.mark.parametrize("estimates", ["own", "own+neighbours", ["pose"]])
@pytest.mark.parametrize("more", ["", RANGES, "clocks"])
def test_local_filters_of_own_states(tmp_path: Path, estimates: object, more: str) -> None:
    scenario = poses(tmp_path, "", filter__estimates=estimates)
    if more == "clocks":
        scenario = load(clocked(POSES), tmp_path, filter__estimates=estimates)
    elif more:
        scenario = poses(tmp_path, more, filter__estimates=estimates)
    run = assert_agree(scenario)
    assert np.isnan(run.xhat).any()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("estimates", ["own", "own+neighbours", "all"])
@pytest.mark.parametrize("rule", ["split", "ci", "naive"])
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED])
def test_block_intersection(tmp_path: Path, text: str, rule: str, estimates: object) -> None:
    assert_agree(load(text, tmp_path, filter__rule=rule, filter__estimates=estimates))


@pytest.mark.parametrize("estimates", ["own", "all"])
def test_recorded_pairs_under_clocks(tmp_path: Path, estimates: str) -> None:
    (tmp_path / "seen.csv").write_text(
        "t,node,to,y0\n0.5,1,2,0.3\n1.25,1,3,0.1\n1.25,1,2,0.2\n2.0,2,1,-0.3\n2.0,3,2,\n"
    )
    text = CLOCKED.replace('kind = "relative"', 'kind = "relative"\npath = "seen.csv"')
    text = text.replace("sampling = { kind = 'periodic', period = 0.5 }\n", "")
    assert_agree(load(text, tmp_path, filter__estimates=estimates))


RADIO = {"network__radio": {"bits_per_second": 600.0, "queue": "wait"}}


@pytest.mark.parametrize("text", [POSES, CLOCKED])
def test_radios_and_lives(tmp_path: Path, text: str) -> None:
    """A message takes as long as the states of its sender, and who was down begins with its own."""
    lives = {"kind": "duty", "nodes": [2, 3], "period": 4.0, "up": 2.5, "memory": "lost"}
    filtering = {"kind": "block-intersection", "estimates": "own"}
    scenario = load(text, tmp_path, filter=filtering, network__lives=[lives], **RADIO)
    run = assert_agree(scenario)
    assert "restart" in set(run.events["kind"])


KEPT, PATHS = "block-cross-covariances", "block-belief-propagation"


@pytest.mark.one_in(3)
@pytest.mark.parametrize("linearise", ["ekf", "ukf"])
@pytest.mark.parametrize(
    ("kind", "estimates"),
    [
        ("block-intersection", "own"),
        ("block-intersection", "own+neighbours"),
        (KEPT, "own"),
        (PATHS, "own"),
    ],
)
def test_readings_of_pairs(tmp_path: Path, kind: str, estimates: str, linearise: str) -> None:
    changes = {"filter__kind": kind, "filter__linearise": linearise}
    assert_agree(poses(tmp_path, RANGES + SIGHTS, filter__estimates=estimates, **changes))


@pytest.mark.slow
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED])
def test_kept_cross_covariances(tmp_path: Path, text: str) -> None:
    assert_agree(load(text, tmp_path, filter={"kind": KEPT, "estimates": "own"}))


@pytest.mark.parametrize("text", [ROBOTS, CLOCKED])
def test_paths_of_a_few_instants(tmp_path: Path, text: str) -> None:
    """Nodes forget, and remember nothing after a crash."""
    channel = {"loss": {"kind": "bernoulli", "delivery": 0.7}, "symmetric": False}
    lives = {"kind": "duty", "nodes": [2], "period": 5.0, "up": 4.0, "memory": "lost"}
    filtering = {"kind": PATHS, "estimates": "own", "window": 3}
    changes = {"network__lives": [lives], "network__channel": channel}
    assert_agree(load(text, tmp_path, filter=filtering, **changes))


PERIODIC = '\nsampling = { kind = "periodic", period = 0.7 }'
CRASHES = {"kind": "duty", "nodes": [2, 3], "period": 5.0, "up": 3.0, "memory": "lost"}
COUPLED = {
    "as they are": {},
    "delays": {"network.channel.delay": {"kind": "uniform", "low": 0.1, "high": 0.6}},
    "crashes": {"network.lives": [CRASHES]},
    "drift": {
        "network.clocks": [{"nodes": [2], "drift": 0.02}],
        "filter.model": {"input": False, "schedule": False},
    },
    "gate": {"filter.gate": {"probability": 0.8}},
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("estimates", ["own", "own+neighbours", "all"])
@pytest.mark.parametrize("case", COUPLED)
@pytest.mark.parametrize("slotted", [True, False])
def test_coupled_areas(tmp_path: Path, slotted: bool, case: str, estimates: str) -> None:
    """With a reading across a border, an input, and a plant that changes."""
    # In slots no clock is wrong.
    changes = {} if slotted and case == "drift" else COUPLED[case]
    text = AREAS if slotted else clocked_areas(AREAS)
    key, noise = ("F", "") if slotted else ("A", PERIODIC)
    text = text.replace("[network]", FLOWS.replace("R = [[0.05]]", "R = [[0.05]]" + noise), 1)
    coupling = "coupling = [{ from = [2], A = [[0.3]] }]"
    schedule = f"schedule = [{{ from = 6.0, {key} = [[-0.2]] }}]"
    sine = 'input = { kind = "sine", G = [[2.0]], amplitude = 1.0, frequency = 0.1 }'
    text = text.replace(coupling, "\n".join([coupling, schedule, sine]))
    assert_agree(load(text, tmp_path, **{"filter.estimates": estimates}, **changes))


@pytest.mark.slow
def test_unicycles() -> None:
    changes = {"horizon": 6.0, "network.channel.loss": {"kind": "bernoulli", "delivery": 0.8}}
    assert_agree(netkf.load("scenarios/blocks/cooperative_localisation.toml", changes))


@pytest.mark.parametrize("kind", ["local", "central"])
def test_many_runs_together(tmp_path: Path, kind: str) -> None:
    scenario = poses(tmp_path, "", filter={"kind": kind, "estimates": "own"})
    fast, slow = (
        netkf.monte_carlo(scenario, 3, workers=1, engine=name) for name in ("compiled", "simpy")
    )
    for name in ("mean_P", "mean_nees"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), rtol=1e-10)


def test_a_block_named_like_a_choice_of_estimates(tmp_path: Path) -> None:
    own = load(POSES.replace('"pose"', '"shared"'), tmp_path)
    with pytest.raises(netkf.ScenarioError, match=r"filter.estimates: is a word for other blocks"):
        own.replace({"filter.estimates": "shared"})
    assert own.replace({"filter.estimates": ["shared"]}).estimated == own.estimated


def test_tables_of_sensors_have_the_rows_of_one_of_them_not_of_all_that_a_node_has(tmp_path):
    """100 robots that read each other filled 6 GiB with zeros."""
    nodes = list(range(12))
    text = ROBOTS.replace("nodes = [1, 2, 3]", f"nodes = {nodes}")
    text = text.replace("edges = [[1, 2], [2, 3]]", "nodes = 12").replace('"edges"', '"complete"')
    setup = slot_setup(load(text, tmp_path))
    assert setup.p == 12
    assert setup.sensors.H.shape == (1 + 12 * 11, 1, 12)
    assert setup.sensors.noise.shape == (1 + 12 * 11, 1, 1)


def test_many_robots_are_few_states_each(tmp_path):
    """600 were refused for covariances of all 600 states at each, and filled 2 GiB with them."""
    text = ROBOTS.replace("nodes = [1, 2, 3]", f"nodes = {list(range(600))}")
    text = text.replace("edges = [[1, 2], [2, 3]]", "nodes = 600").replace('"edges"', '"path"')
    tracemalloc.start()
    scenario = load(text, tmp_path)
    infos, peak = scenario.node_infos, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (scenario.width, len(infos)) == (1, 600)
    # Some matrices of all states, whatever the number of nodes.
    assert peak < 200e6


def test_what_the_compiled_engine_runs_is_asked_once_for_all_runs_of_a_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``why`` replays a run hundreds of times: of 150 robots two thirds of it went there."""
    asked = []
    ask = slot_pairs._reads_in_its_own_way
    monkeypatch.setattr(
        slot_pairs, "_reads_in_its_own_way", lambda *args: asked.append(args) or ask(*args)
    )
    scenario = load(POSES, tmp_path)
    first = netkf.simulate(scenario)
    count = len(asked)
    assert count > 0
    assert netkf.simulate(scenario).fingerprint == first.fingerprint
    assert len(asked) == count
