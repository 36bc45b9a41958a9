"""Draws from mu^Abar of G against laws that are known exactly."""

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf import theory
from netkf.core.errors import TheoryError
from netkf.scenario.reading import from_table
from tests.conftest import SCENARIOS

ROOT2 = 2.0**0.5
ONE_EDGE = {"kind": "matching", "protocol": "one-edge"}


def gossip(tmp_path, activation, edges, sensing, F=((ROOT2,),)):
    n = len(F)
    return from_table(
        {
            "format": 1,
            "name": "gossip",
            "horizon": 20.0,
            "probe": 1.0,
            "plant": {
                "kind": "linear",
                "F": [list(row) for row in F],
                "Q": np.eye(n).tolist(),
                "period": 1.0,
            },
            "sensors": [{"nodes": sensing, "H": np.eye(n).tolist(), "R": np.eye(n).tolist()}],
            "network": {"graph": {"kind": "edges", "edges": edges}, "activation": activation},
            "filter": {"kind": "gossip"},
        },
        tmp_path,
    )


def test_two_sensors_of_which_one_is_blind(tmp_path):
    """They are paired with probability 1/2, so that the token sees a reading with probability 1/2,
    independently: the scalar law of R with g = 1/2. Below the hole lie the draws at the sensor,
    above it those at the blind node, so that G (27) is attained: P(P_n in F) = N mu(F) = 1.
    """
    activation = {"kind": "matching", "protocol": "one-edge", "lazy": 0.5}
    made = gossip(tmp_path, activation, [[0, 1]], [0])
    np.testing.assert_allclose(theory.mean_matching(made), np.full((2, 2), 0.5))
    found = theory.switched_samples(made, 4000, 7)
    law = theory.scalar_law([[ROOT2]], [[1.0]], [[1.0]], [[1.0]], 0.5)
    P = found.P[:, 0, 0]
    for u in (0.2, 0.45, 0.6, 0.8, 0.95):
        edge = float(law.quantile(u)) * (1.0 + 1e-9)
        exact = float(law.cdf(edge))
        assert abs(np.mean(edge >= P) - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / len(P))
    low, high = law.hole
    assert (P[found.node == 0] <= low).all()
    assert (P[found.node == 1] >= high * (1.0 - 1e-9)).all()
    assert abs((P >= 5.83).mean() - 0.5) < 0.03


def test_only_the_mean_matching_matters(tmp_path):
    """G Remark 9: one random edge of the ring of four with probability 16/27, and each edge with
    probability 1/3 where none meets it, which swaps two pairs at once now and then. Every edge is
    swapped with probability 4/27 in both.
    """
    edges = [[0, 1], [1, 2], [2, 3], [0, 3]]
    single = {"kind": "matching", "protocol": "one-edge", "lazy": 11.0 / 27.0}
    several = {"kind": "matching", "protocol": "independent", "p": 1.0 / 3.0}
    one, other = (gossip(tmp_path, kind, edges, [0]) for kind in (single, several))
    np.testing.assert_allclose(theory.mean_matching(one), theory.mean_matching(other))
    drawn = [theory.switched_samples(made, 200, 3) for made in (one, other)]
    np.testing.assert_allclose(drawn[0].P, drawn[1].P, rtol=1e-9)


def test_all_sensors_equal_gives_the_riccati_fixed_point(tmp_path):
    F = ((1.1, 0.2), (0.0, 0.9))
    made = gossip(tmp_path, ONE_EDGE, [[0, 1], [1, 2]], [0, 1, 2], F)
    found = theory.switched_samples(made, 20, 1)
    expected = theory.steady_covariance(F, np.eye(2), np.eye(2), np.eye(2))
    np.testing.assert_allclose(found.P, np.broadcast_to(expected, found.P.shape), rtol=1e-8)


def test_draws_are_the_law_that_random_sensors_come_to():
    """G Theorem 10 [i]: simulated runs at their horizon, one random sensor each."""
    made = netkf.load(SCENARIOS / "gossip_ring.toml")
    drawn = theory.switched_samples(made, 2000, 11)
    assert scipy.stats.chisquare(np.bincount(drawn.node, minlength=5)).pvalue > 1e-4
    random = np.random.default_rng(5)
    ends = []
    for replica in range(300):
        run = netkf.simulate(made, made.seed, replica)
        ends.append(np.trace(run.P[-1, random.integers(5)]))
    traces = np.trace(drawn.P, axis1=1, axis2=2)
    assert scipy.stats.ks_2samp(np.round(ends, 9), np.round(traces, 9)).pvalue > 1e-3


def test_a_law_needs_a_connected_network_and_readings(tmp_path):
    kind = {"kind": "matching", "protocol": "one-edge", "lazy": 0.5}
    never = {"loss": {"kind": "bernoulli", "delivery": 0.0}, "symmetric": True}
    cut = gossip(tmp_path, kind, [[0, 1], [1, 2]], [0]).replace({"network.channel": never})
    with pytest.raises(TheoryError, match=r"C\.1"):
        theory.switched_samples(cut, 5, 1)
