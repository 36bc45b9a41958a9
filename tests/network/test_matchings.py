"""Matchings: draws against exact means, exact means against independent fractions."""

import json
from itertools import pairwise

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.network.graphs import Cycle, Edges
from netkf.network.matchings import Matching, maximal_matchings
from netkf.theory.gossip.matchings import period_of
from tests.cases import FOLDER
from tests.conftest import SCENARIOS

MEANS = json.loads((FOLDER / "gossip.json").read_text())["mean_matchings"]


def matching(words):
    name = words.split(",")[0]
    more = {"lazy": 1 / 3} if "lazy" in words else {"p": 0.5} if "p =" in words else {}
    return Matching(protocol=name, **more)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("case", MEANS, ids=lambda c: f"{c['graph']} {c['protocol']}")
def test_exact_means_and_draws(case):
    topology = Edges(edges=case["edges"], nodes=case["N"]).build(0)
    protocol = matching(case["protocol"])
    mean = protocol.mean(topology)
    np.testing.assert_allclose(mean, case["Abar"], rtol=0, atol=1e-15)
    assert (period_of(mean) == 1) == case["primitive"]
    random, draws, seen = np.random.default_rng(1), 4000, np.zeros_like(mean)
    for _ in range(draws):
        pairs = protocol.draw(topology, random)
        ends = [node for pair in pairs for node in pair]
        assert len(set(ends)) == len(ends)
        for i, j in pairs:
            seen[i, j] += 1.0 / draws
            seen[j, i] += 1.0 / draws
    off = ~np.eye(len(mean), dtype=bool)
    error = np.sqrt(mean * (1.0 - mean) / draws)
    assert (np.abs(seen - mean)[off] <= 4.5 * error[off] + 1e-12).all()


def test_greedy_in_random_order_is_not_uniform_over_maximal_matchings():
    """On a path of five links the two differ."""
    topology = Edges(edges=[[k, k + 1] for k in range(5)]).build(0)
    greedy, uniform = (
        Matching(protocol=name).mean(topology) for name in ("maximal", "uniform-maximal")
    )
    assert np.abs(greedy - uniform).max() > 0.01


def test_maximal_matchings_are_all_of_them():
    links = Cycle(6).build(0).links
    found = maximal_matchings(links)
    assert len(set(found)) == len(found) == 5  # two perfect ones and three with opposite gaps
    for chosen in found:
        busy = {node for link in chosen for node in link}
        assert all(busy & set(link) for link in links)


def test_periodicity_is_said_before_anything_runs():
    periodic = netkf.load(SCENARIOS / "gossip_periodic.toml")
    table = theory.assumptions(periodic).set_index("source")
    assert not table.holds["G C.1"]
    assert "period 2" in table.evidence["G C.1"]
    run = netkf.simulate(periodic)
    assert np.trace(run.P[-1], axis1=1, axis2=2).min() > 1e9
    lazy = periodic.replace({"network.activation": {"kind": "matching", "protocol": "one-edge"}})
    assert theory.assumptions(lazy).set_index("source").holds["G C.1"]
    assert np.trace(netkf.simulate(lazy).P[-1], axis1=1, axis2=2).max() < 1e3


def test_detecting_walk_has_an_invertible_gramian():
    scenario = netkf.load(SCENARIOS / "gossip_ring.toml")
    walk = theory.detecting_walk(scenario)
    mean, F = theory.mean_matching(scenario), scenario.slot_plant.F
    for i, j in pairwise(walk):
        assert mean[i, j] > 0.0
    gramian = sum(
        np.linalg.matrix_power(F, k).T @ H.T @ H @ np.linalg.matrix_power(F, k)
        for k, H in enumerate(scenario.observation_matrices(node)[0] for node in walk)
    )
    assert np.linalg.eigvalsh(gramian)[0] > 1e-3
    # nobody alone detects: no node's own stays suffice
    for node in scenario.nodes:
        H = scenario.observation_matrices(node)[0]
        own = np.concatenate([H @ np.linalg.matrix_power(F, k) for k in range(4)])
        # numpy 2.0 knows no rank of nothing
        assert not len(H) or np.linalg.matrix_rank(own) < 4


def test_detecting_walk_of_two_that_always_swap():
    """mathematics of G: rotation by a quarter turn; alternating places see one axis for ever."""
    rows = {"plant.F": [[0.0, -1.1], [1.1, 0.0]]}
    scenario = netkf.load(SCENARIOS / "gossip_periodic.toml").replace(rows)
    assert theory.detecting_walk(scenario) is None
    # A swap that is lost leaves both alone, and the turn shows a sensor the other axis.
    for delivery, expected in ((0.5, (True, True)), (0.0, (False, True))):
        loss = {"kind": "bernoulli", "delivery": delivery}
        lossy = scenario.replace({"network.channel.loss": loss})
        holds = theory.assumptions(lossy).set_index("source").holds
        assert (holds["G C.1"], holds["G D.1"]) == expected
        assert len(set(theory.detecting_walk(lossy))) == 1
