"""Scenario files: read, change, write, read again."""

import sys
import textwrap
import tomllib

import numpy as np
import pytest

import netkf
from netkf.engines.simpy.engine import SimpyEngine
from netkf.scenario.reading import from_table, load
from netkf.scenario.writing import as_table, resolve_defaults, to_toml
from tests.conftest import SCENARIOS, scenario_files


@pytest.mark.one_in(3)
@pytest.mark.parametrize("file", scenario_files(), ids=lambda f: f.stem)
def test_written_scenarios_read_back_the_same(file):
    scenario = netkf.load(file)
    for table in (as_table(scenario), resolve_defaults(scenario)):
        again = from_table(tomllib.loads(to_toml(table)), file.parent)
        assert resolve_defaults(again) == resolve_defaults(scenario)
    if not scenario.slotted and scenario.increment_sensors:
        assert resolve_defaults(scenario)["plant"]["sensing_period"] > 0.0


@pytest.mark.one_in(3)
@pytest.mark.parametrize("file", scenario_files(), ids=lambda f: f.stem)
def test_resolved_scenarios_give_the_same_run(file, tmp_path):
    scenario = netkf.load(file)
    changes = (
        {"horizon": 10.0, "probe": 1.0} if scenario.slotted else {"horizon": 1.0, "probe": 0.5}
    )
    scenario = scenario.replace(changes)
    again = from_table(tomllib.loads(to_toml(resolve_defaults(scenario))), file.parent)
    one, other = netkf.simulate(scenario), netkf.simulate(again)
    assert one.fingerprint == other.fingerprint
    np.testing.assert_array_equal(one.xhat, other.xhat)


def test_random_graphs_are_resolved_with_their_seed(build):
    network = {
        "graph": {"kind": "geometric", "nodes": 8, "radius": 0.6, "connected": True},
        "activation": {"kind": "poisson", "rate": 1.0},
    }
    scenario = build(network=network, seed=5, filter={"kind": "hybrid", "epsilon": 0.1})
    assert resolve_defaults(scenario)["network"]["graph"]["seed"] == 5
    assert scenario.replace({"seed": 6}).topology.links != scenario.topology.links


def test_defaults_come_from_the_plant(build):
    scenario = build(
        plant={"kind": "diffusion", "A": [[-1.0]], "B": [[1.0]], "mean": [3.0], "cov": [[2.0]]}
    )
    run = netkf.simulate(scenario)
    assert run.xhat[0].tolist() == [[3.0], [3.0]]
    np.testing.assert_allclose(run.P[0], [[[2.0]], [[2.0]]], rtol=1e-15)


def test_one_start_per_node(build):
    filters = {"kind": "hybrid", "epsilon": 0.5, "mean": [[1.0], [2.0]], "cov": [[[3.0]], [[4.0]]]}
    run = netkf.simulate(build(filter=filters))
    assert run.xhat[0].tolist() == [[1.0], [2.0]]
    np.testing.assert_allclose(run.P[0], [[[3.0]], [[4.0]]], rtol=1e-15)


def test_replace_takes_paths_as_in_a_file(ring):
    changed = ring.replace(
        {
            "network.activation.rate": 5.0,
            "sensors.0.R": [[1.0]],
            "sensors[0].nodes": [1],
            "filter.kind": "hybrid",
        }
    )
    assert changed.network.activation.rate == 5.0
    assert changed.sensors[0].nodes == (1,)
    assert ring.network.activation.rate == 2.0
    assert ring.replace({}) == ring != changed
    # derived defaults are derived again
    assert (
        ring.replace({"sensors.0.R": [[0.01]]}).diffusion.sensing_period
        < ring.diffusion.sensing_period
    )


def test_a_scenario_knows_its_folder_in_any_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(SCENARIOS)
    scenario = netkf.load("intel_lab.toml", {"horizon": 1.0})
    monkeypatch.chdir(tmp_path)
    again = scenario.replace({"seed": 5})
    assert netkf.save(netkf.simulate(again), again, "run").is_dir()


def test_arrays_of_a_scenario_are_read_only(ring):
    for array in (ring.times, ring.plant.Q, ring.plant.A):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 2.0


def test_a_class_of_the_user_needs_no_registration(tmp_path, monkeypatch, ring):
    (tmp_path / "fusion.py").write_text(
        textwrap.dedent(
            """
            from dataclasses import dataclass

            from netkf.algorithms.hybrid import Hybrid
            from netkf.algorithms.traits import Weights
            from netkf.core.fields import number, setting
            from netkf.network.clocks import LinkClock


            @dataclass(frozen=True, eq=False)
            class Timid(Hybrid):
                share: float = setting(number(above=0.0, high=1.0), default=0.5)

                @property
                def link_weights(self):
                    return Weights(lambda degree, peer_degree: self.share * self.epsilon)


            class Loud(Timid):
                def absorb(self, state, messages, exchange):
                    return state


            @dataclass(frozen=True, eq=False)
            class Doubling(LinkClock):
                first: float

                def ticks(self, link, origin, index, now, random, count):
                    return self.first * 2.0 ** __import__("numpy").arange(index, index + count)
            """
        )
    )
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    table = as_table(ring)
    table["filter"] = {"kind": "fusion:Timid", "epsilon": 0.4, "cov": [[1.0, 0.0], [0.0, 1.0]]}
    table["network"]["activation"] = {"kind": "fusion:Doubling", "first": 0.3}
    file = tmp_path / "mine.toml"
    file.write_text(to_toml(table))
    scenario = load(file)
    assert scenario.filter.algorithm.share == 0.5
    run = netkf.simulate(scenario)
    ticks = run.events[run.events.kind == "tick"]
    assert sorted(set(ticks.t)) == [0.3, 0.6, 1.2, 2.4, 4.8, 9.6, 19.2]
    assert resolve_defaults(scenario)["filter"]["kind"] == "fusion:Timid"
    plain = scenario.replace({"filter.kind": "hybrid", "filter.epsilon": 0.2})
    np.testing.assert_array_equal(netkf.simulate(plain).P, run.P)
    np.testing.assert_allclose(netkf.simulate(plain, engine=SimpyEngine()).P, run.P, rtol=1e-10)
    exact = netkf.theory.error_covariance(scenario, run)  # other weights are understood
    assert np.linalg.eigvalsh(run.P - exact).min() > -1e-9
    with pytest.raises(netkf.TheoryError, match="Loud defines absorb itself"):
        netkf.theory.error_covariance(scenario.replace({"filter.kind": "fusion:Loud"}), run)
    loud = scenario.replace({"filter.kind": "fusion:Loud", "network": as_table(ring)["network"]})
    with pytest.raises(netkf.TheoryError, match=r"not promised: .*Loud defines absorb itself"):
        netkf.theory.covariance_bound(loud, [1.0])
    with pytest.raises(netkf.TheoryError, match="another scenario"):
        netkf.theory.error_covariance(ring.replace({"network.graph.nodes": 5}), run)
    with pytest.raises(netkf.ScenarioError, match=r"filter\.share: must be a finite number"):
        scenario.replace({"filter.share": 2.0})


def test_what_a_run_never_uses_is_noted():
    ring = netkf.load(SCENARIOS / "poisson_ring.toml")
    zero = (0.0 * ring.plant.A).tolist()
    schedule = [{"from": 2.0, "A": zero}, {"from": ring.horizon, "A": zero}]
    changed = ring.replace({"plant.schedule": schedule, "filter.linearise": "ukf"})
    assert [note.split(":")[0] for note in changed.notes] == ["plant.schedule", "filter.linearise"]
    assert "1 entry is never used, from 20 s on" in changed.notes[0]
    assert ring.replace({"plant.schedule": schedule[:1]}).notes == ring.notes == ()
    curved = netkf.load(SCENARIOS / "blocks" / "cooperative_localisation.toml")
    assert curved.replace({"filter.linearise": "ukf"}).notes == curved.notes


def test_one_block_may_be_named_without_a_list():
    robots = netkf.load(SCENARIOS / "blocks" / "cooperative_localisation.toml")
    named = robots.replace({"filter.estimates": "pose"})
    listed = robots.replace({"filter.estimates": ["pose"]})
    assert named.estimated == listed.estimated == robots.estimated
    with pytest.raises(netkf.ScenarioError, match=r'did you mean "own"\? names are "pose"'):
        robots.replace({"filter.estimates": "owm"})


BIASES = """
format = 1
name = "biases"
horizon = 3.0
probe = 1.0
filter = { kind = "central", estimates = ["target", "bias"] }
[[plants]]
name = "target"
kind = "diffusion"
A = [[0.0]]
B = [[1.0]]
cov = [[2.0]]
[[plants]]
name = "bias"
nodes = [1]
kind = "diffusion"
A = [[0.0]]
B = [[0.5]]
cov = [[1.0]]
[[sensors]]
of = "bias"
nodes = [1]
H = [[1.0]]
R = [[0.25]]
sampling = { kind = "periodic", period = 1.0 }
[network]
graph = { kind = "path", nodes = 2 }
activation = { kind = "poisson", rate = 1.0 }
"""


def test_a_node_estimates_those_of_the_named_blocks_that_it_has(tmp_path):
    path = tmp_path / "biases.toml"
    path.write_text(BIASES)
    scenario = netkf.load(path)
    run = netkf.simulate(scenario, engine="simpy")
    assert run.block("bias", 1).P.ravel()[:2] == pytest.approx([1.0, 1.25 * 0.25 / 1.5])
    assert run.block("target", 0).P.ravel()[:2] == pytest.approx([2.0, 3.0])
    with pytest.raises(netkf.ScenarioError, match="must estimate block 'bias'"):
        run.block("bias", 1, by=0)
    for names, rule in [(["bias"], "node 0 has none"), (["biass"], "name of one of")]:
        with pytest.raises(netkf.ScenarioError, match=rule):
            scenario.replace({"filter.estimates": names})


@pytest.mark.parametrize("recorded", [False, True])
def test_noises_of_rows_in_any_units_are_positive_definite(tmp_path, recorded):
    """A range in metres beside a direction in radians, both of which are read well."""
    R = [[2.4e7, 0.0128], [0.0128, 1.5e-9]]
    scenario = netkf.load(SCENARIOS / "intermittent_scalar.toml")
    sensor = {"nodes": [0], "H": [[1.0], [1e-8]], "R": R}
    if recorded:
        values = ",".join(str(R[i][j]) for i, j in ((0, 0), (0, 1), (1, 1)))
        (tmp_path / "y.csv").write_text(f"t,node,y0,y1,R00,R01,R11\n1.0,0,2.0,3.0,{values}\n")
        sensor |= {"kind": "recorded", "path": "y.csv"}
    table = {**as_table(scenario), "sensors": [sensor]}
    assert np.array_equal(from_table(table, tmp_path).sensors[0].R, R)
    with pytest.raises(netkf.ScenarioError, match="must be positive definite"):
        from_table({**table, "sensors": [{**sensor, "R": [[2.4e7, 0.2], [0.2, 1.5e-9]]}]}, tmp_path)
