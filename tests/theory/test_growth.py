"""Growth of theory, checks and pictures with the network: by memory and work, never by seconds."""

import tracemalloc

import numpy as np
import pytest
import scipy.sparse

import netkf
from netkf import theory
from netkf.checks.samples import MAX_NODES, sampled_indices, sampling_note
from netkf.core.errors import TheoryError
from netkf.figures.layout import get_positions
from netkf.network import graphs
from netkf.runs.files import write_scenario
from netkf.theory import promises
from netkf.theory.common.observations import increment_observations
from netkf.theory.hybrid import coupled, linearised, steady
from netkf.theory.hybrid.packed import PackedRiccati
from netkf.theory.promises import compute_promises, promises_text

FLOW = """
format = 1
name = "ring"
horizon = 5.0
probe = 1.0
seed = 1
[plant]
kind = "diffusion"
A = [[0.0, 1.0], [-1.0, 0.1]]
B = [[0.0], [1.0]]
cov = [[1.0, 0.0], [0.0, 1.0]]
[[sensors]]
nodes = [0, {half}]
H = [[1.0, 0.0]]
R = [[0.25]]
[network]
graph = {{ kind = "cycle", nodes = {nodes} }}
activation = {{ kind = "poisson", rate = {rate} }}
[filter]
kind = "hybrid"
epsilon = 0.2
"""

SLOTS = """
format = 1
name = "averages"
horizon = 20.0
probe = 1.0
seed = 1
[plant]
kind = "linear"
period = 1.0
F = [[0.9]]
Q = [[0.1]]
cov = [[1.0]]
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[1.0]]
[network]
graph = {{ kind = "cycle", nodes = {nodes} }}
activation = {{ kind = "broadcast" }}
channel = {{ loss = {{ kind = "bernoulli", delivery = 0.9 }} }}
[filter]
kind = "push-sum"
gamma = 3
delta = 5.0
"""


def of_text(text, folder):
    path = folder / "scenario.toml"
    path.write_text(text)
    return netkf.load(path)


def ring(nodes, folder, rate=2.0):
    return of_text(FLOW.format(nodes=nodes, half=nodes // 2, rate=rate), folder)


def peak(function):
    """Bytes that a call takes at most."""
    tracemalloc.start()
    function()
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


def test_the_limit_of_a_large_network_makes_no_matrix_of_all_pairs(tmp_path):
    scenario = ring(4000, tmp_path)
    weights = coupled.left_weights(scenario)
    np.testing.assert_allclose(weights, 1.0 / 4000, rtol=1e-12)
    assert coupled.has_balanced_rates(scenario)
    assert peak(lambda: theory.limit_covariance(ring(4000, tmp_path))) < 4000**2  # an eighth of it


def test_pictures_place_the_nodes_of_a_large_network_without_all_distances(tmp_path):
    scenario = ring(4000, tmp_path)
    positions = {}
    assert peak(lambda: positions.update(get_positions(scenario))) < 4000**2
    radii = np.linalg.norm(np.array(list(positions.values())), axis=1)
    assert radii.min() > 0.8 * radii.max()  # a ring is drawn as one


def test_a_threshold_takes_few_linear_equations(tmp_path, monkeypatch):
    """Work is bounded for a rate that is thousands of times too low."""
    calls, newton = [], steady._newton
    monkeypatch.setattr(steady, "_newton", lambda *given: calls.append(1) or newton(*given))
    with pytest.raises(TheoryError, match="below the threshold"):
        theory.steady_covariance_bound(ring(300, tmp_path))
    assert len(calls) < 1500  # plain bisection took 3,213 at 100 nodes


def test_the_threshold_is_that_of_a_slow_search(tmp_path):
    with pytest.raises(TheoryError, match="below the threshold") as refused:
        theory.steady_covariance_bound(ring(30, tmp_path))
    rate = float(str(refused.value).split()[-1])
    assert np.isfinite(theory.steady_covariance_bound(ring(30, tmp_path, 1.001 * rate))).all()
    with pytest.raises(TheoryError, match="below the threshold"):
        theory.steady_covariance_bound(ring(30, tmp_path, 0.999 * rate))


def test_tables_of_large_networks_show_some_nodes_and_say_so(tmp_path):
    scenario = ring(60, tmp_path, 1000.0)
    lines = promises_text(scenario, compute_promises(scenario)).splitlines()
    assert len(lines) < 80
    assert any("the smallest, the middle and the largest bound of 60" in line for line in lines)


def test_mean_squares_of_large_networks_say_what_they_would_take(tmp_path):
    scenario = of_text(SLOTS.format(nodes=600), tmp_path)
    with pytest.raises(TheoryError, match=r"are 600\^2 numbers.* take a smaller network"):
        theory.push_sum_radius(scenario)


def test_checks_of_large_networks_watch_some_nodes_and_say_so(tmp_path):
    assert len(sampled_indices(ring(MAX_NODES, tmp_path))) == MAX_NODES
    assert not sampling_note(ring(MAX_NODES, tmp_path))
    large = ring(1000, tmp_path)
    assert len(sampled_indices(large)) <= MAX_NODES
    assert "looked at 50 of 1,000 nodes" in sampling_note(large)


def test_a_scenario_with_thousands_of_sensors_makes_no_matrix_of_all_readings(tmp_path):
    nodes = 6000
    scenario = ring(nodes, tmp_path)
    changes = {"sensors.0.nodes": list(range(nodes))}

    def build():
        return scenario.replace(changes).diffusion.sensing_period

    # R of all readings together would take 8 nodes^2 bytes.
    assert peak(build) < nodes**2
    # A larger network with the same sensor in every place asks for a period no longer.
    assert build() <= scenario.diffusion.sensing_period


def test_nodes_with_equal_sensors_share_their_observation_and_their_information(tmp_path):
    scenario = ring(60, tmp_path).replace({"sensors.0.nodes": list(range(0, 60, 3))})
    observations = increment_observations(scenario)
    assert len({id(one) for one in observations}) == 2
    informations = coupled.increment_informations(scenario)
    np.testing.assert_array_equal(informations[::3], [[[4.0, 0.0], [0.0, 0.0]]] * 20)
    assert not informations[1::3].any()
    assert not informations[2::3].any()


def test_the_tables_of_a_scenario_build_the_network_once(tmp_path, monkeypatch):
    built = []
    build = graphs.Cycle.build
    monkeypatch.setattr(
        graphs.Cycle, "build", lambda self, seed: built.append(1) or build(self, seed)
    )
    scenario = ring(50, tmp_path)
    write_scenario(tmp_path, scenario, 3)
    assert len(built) == 1
    assert netkf.load(tmp_path / "scenario.toml").seed == 3


def test_elimination_is_refused_where_its_fill_in_has_no_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(linearised, "_solve_by_gmres", lambda *_: None)
    graph = {"kind": "regular", "nodes": 3000, "degree": 4}
    packed = PackedRiccati(
        coupled.coupled_riccati(
            ring(6, tmp_path).replace({"network.graph": graph, "filter.epsilon": 0.1})
        )
    )
    with pytest.raises(TheoryError, match="GMRES did not converge for 9,000 unknowns"):
        linearised.solve_map(packed.linear(packed.equations.start), packed.start)


def test_a_steady_bound_with_many_unknowns_is_left_out_of_the_report(tmp_path, monkeypatch):
    monkeypatch.setattr(promises, "MAX_UNKNOWNS", 5)
    found = compute_promises(ring(6, tmp_path))
    assert found["steady_bound"]["trace"] is None
    assert "18 unknowns, more than 5" in found["steady_bound"]["reason"]
    assert found["bound_at_horizon"]["trace"] is not None


@pytest.mark.parametrize("unit", [1.0, 1e-10, 1e10])
def test_rates_are_balanced_in_all_units_of_time_or_in_none(unit):
    c = unit * scipy.sparse.csr_array([[0.0, 1.0], [3.0, 0.0]])
    assert not coupled._is_symmetric(c)
    assert coupled._is_symmetric(c + c.T * (1.0 + 1e-13))
    np.testing.assert_allclose(coupled._stationary(c), [0.75, 0.25])


@pytest.mark.parametrize("seed", range(1, 4))
def test_a_driven_mode_that_nobody_sees_has_no_steady_state(build, seed):
    """Its covariance grows as t, so slowly that gains of a late time looked stabilising."""
    random = np.random.default_rng(seed)
    H, B = (random.normal(size=shape).round(2).tolist() for shape in ((1, 3), (3, 2)))
    plant = {"kind": "diffusion", "A": [[0.0] * 3] * 3, "B": B, "cov": np.eye(3).tolist()}
    clock = {"kind": "poisson", "rate": 20.0}
    scenario = build(
        plant=plant,
        sensors=[{"nodes": [0], "H": H, "R": [[0.05]]}],
        network={"graph": {"kind": "complete", "nodes": 3}, "activation": clock},
    )
    with pytest.raises(netkf.TheoryError, match="faster links do not give it one"):
        netkf.theory.steady_covariance_bound(scenario)
