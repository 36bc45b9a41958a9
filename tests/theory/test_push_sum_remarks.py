"""P Lemma 4, Theorem 4, Corollary 2 and Remarks 1 and 3 against enumerations and closed forms."""

import itertools
import json

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from netkf import theory
from netkf.core.errors import TheoryError
from netkf.network.graphs import Topology
from netkf.theory.promises import compute_promises, promises_text
from tests.cases import FOLDER
from tests.theory.push_sum_systems import of_case, planar, scenario

CASES = json.loads((FOLDER / "push_sum.json").read_text())
BOUNDS = [(case, row) for case in CASES["bounds"] for row in case["rows"]]
TABLES = CASES["mean_square_tables"]


def path(delivery=0.6, gamma=1, **more):
    H, R = {0: [[1.0]], 2: [[0.5]]}, {0: [[0.5]], 2: [[0.2]]}
    return scenario([[0, 1], [1, 2]], [[0.95]], [[0.1]], H, R, gamma, 3.1, delivery, **more)


@pytest.mark.parametrize("case", TABLES, ids=lambda case: case["name"])
def test_reference_covariances_for_each_gamma(case):
    for row in case["rows"]:
        made = of_case(case, 1, row["p"])
        found = theory.push_sum_covariances(made, [row["gamma"]])[0]
        np.testing.assert_allclose(np.trace(found, axis1=1, axis2=2), row["node_mse"], rtol=1e-7)


@pytest.mark.parametrize("delivery", [1.0, 0.7, 0.5])
def test_every_node_comes_to_the_central_filter(delivery):
    """P Theorem 4: P_inf of the reference, trace .0124391671, by scipy's Riccati solver."""
    made = planar(1, delivery, lower_right=0.25)
    F, Q = made.slot_plant.F, made.slot_plant.Q
    H = np.eye(4)[:2]
    prior = scipy.linalg.solve_discrete_are(F.T, H.T, Q, 0.01 * np.eye(2))
    posterior = np.linalg.inv(np.linalg.inv(prior) + H.T @ H / 0.01)
    limit = theory.large_gamma_limits(made).covariance
    np.testing.assert_allclose(limit, posterior, rtol=1e-8, atol=1e-12)
    assert np.trace(limit) == pytest.approx(0.0124391671, rel=1e-8)
    ratios = np.trace(theory.push_sum_covariances(made, [2, 3, 30]), axis1=2, axis2=3).mean(axis=1)
    expected = {1.0: (1.463, 1.073), 0.7: (1.462, 1.113), 0.5: (None, None)}[delivery]
    for ratio, stated in zip(ratios / np.trace(posterior), expected, strict=False):
        assert stated is None or ratio == pytest.approx(stated, abs=6e-4)
    assert ratios[2] == pytest.approx(np.trace(posterior), rel=2e-2)


def test_filters_that_assume_another_noise_come_to_another_covariance():
    made = path().replace({"filter.model": {"R": [[0.1]]}})
    limit = theory.large_gamma_limits(made).covariance[0, 0]
    late = theory.push_sum_covariances(made, [120])[0, :, 0, 0]
    np.testing.assert_allclose(late, limit, rtol=1e-6)
    assert limit > theory.large_gamma_limits(path()).covariance[0, 0]


def test_no_steady_covariance_is_nan():
    found = theory.push_sum_covariances(planar(1, 0.5), [1, 2])
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


@pytest.mark.parametrize("gamma", [1, 3])
def test_the_transformed_noise_against_all_outcomes_of_the_links(gamma):
    """P Lemma 4: the average over all outcomes of two links in gamma steps."""
    made, p = path(delivery=0.6), 0.6
    limits = theory.push_sum_limits(made)
    h = np.zeros((3, 3))
    for i, j in itertools.product(range(3), repeat=2):
        (K, (H, R)), (L, (G, _)) = (
            (limits.gains[k], made.observation_matrices(made.nodes[k])) for k in (i, j)
        )
        h[i, j] = ((1.0 - K @ H) * 0.1 * (1.0 - L @ G)).sum()
        h[i, j] += (K @ R @ K.T).sum() if i == j else 0.0
    links = [
        np.array([[1, -1, 0], [-1, 1, 0], [0, 0, 0]]),
        np.array([[0, 0, 0], [0, 1, -1], [0, -1, 1]]),
    ]
    expected = np.zeros((3, 3))
    for word in itertools.product(itertools.product((0, 1), repeat=2), repeat=gamma):
        share, M = 1.0, np.eye(3)
        for up in word:
            share *= np.prod([p if one else 1.0 - p for one in up])
            M = (np.eye(3) - sum(one * L for one, L in zip(up, links, strict=True)) / 3.1) @ M
        expected += share * M @ h @ M.T
    found = theory.push_sum_noise(made, [gamma])[0]
    v = np.ones(3) / np.sqrt(3.0)
    assert found[0, 0] == pytest.approx(v @ expected @ v, rel=1e-12)
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvalsh(found)), np.sort(np.linalg.eigvalsh(expected))
    )
    # the printed limit: N (I - K C) Q (I - K C)' + N P C' R^-1 C P
    P, G = limits.P[0, 0], limits.G[0, 0]
    printed = 3 * (1 - P * G) ** 2 * 0.1 + 3 * P * G * P
    limit = theory.large_gamma_limits(made).noise
    assert limit[0, 0] == pytest.approx(printed, rel=1e-12)
    late = theory.push_sum_noise(made, [150])[0]
    np.testing.assert_allclose(late, limit, atol=1e-10)


@pytest.mark.parametrize(
    ("more", "why"),
    [({"links": "held"}, "fresh"), ({"symmetric": False}, "together"), ({"delivery": 0.0}, "up")],
)
def test_where_theorem_4_does_not_hold(more, why):
    for function in (theory.large_gamma_limits, lambda made: theory.push_sum_noise(made, [2])):
        with pytest.raises(TheoryError, match=why):
            function(path(**more))


@pytest.mark.parametrize(("case", "row"), BOUNDS, ids=lambda x: x.get("name") or str(x["p"]))
def test_reference_corollary_2(case, row):
    made = of_case(case, 1, row["p"])
    for key, sharp in (("printed", False), ("exact", True)):
        found = theory.corollary_2(made, sharp=sharp)
        assert (found.gamma, found.needed) == (row[key]["corollary2"], row[key]["theorem5"])


def test_corollary_2_does_not_follow_from_theorem_5():
    """(44) gives 11 where rho(A_R(11)) is 1.38 and Theorem 5 needs 18."""
    H, R = {0: [[1.0]], 1: [[1.0]]}, {0: [[0.01]], 1: [[0.01]]}
    made = scenario([[0, 1]], [[0.5]], [[1.0]], H, R, 1, 2.8, 0.2)
    found = theory.corollary_2(made)
    assert (found.gamma, found.needed) == (11, 18)
    # by hand: lambda, c_B and theta of a scalar plant
    constants = theory.gamma_constants(made)
    c, t = max(constants.printed, constants.sharp), 1.0 - 0.2 / 2.8
    a = constants.contraction**0.5
    assert t**11 < ((1.0 - a) / c) ** 2 < t**10
    radius = max(abs(np.linalg.eigvals([[a, t**11 * c], [c, t**11 * c]])))
    assert found.radius == pytest.approx(radius, rel=1e-12)
    assert radius > 1.3


def test_nominal_degrees_conserve_mass_and_actual_ones_do_not():
    """P Remark 1, against a plain loop."""
    topology = Topology((0, 1, 2, 3), ((0, 1), (0, 3), (1, 2), (1, 3), (2, 3)))
    up = np.random.default_rng(4).random((40, 5)) < 0.6
    np.testing.assert_allclose(theory.mass_totals(topology, up), 1.0, rtol=1e-13)
    z, seen, expected = [0.25] * 4, [3.0, 4.0, 3.0, 4.0], [1.0]
    for row in up:
        share = [z[i] / seen[i] for i in range(4)]
        z, seen = list(share), [1.0] * 4
        for (i, j), works in zip(topology.links, row, strict=True):
            if works:
                z[i], z[j] = z[i] + share[j], z[j] + share[i]
                seen[i], seen[j] = seen[i] + 1.0, seen[j] + 1.0
        expected.append(sum(z))
    np.testing.assert_allclose(theory.mass_totals(topology, up, "last"), expected, rtol=1e-13)
    assert np.ptp(expected) > 0.1
    # links that never change do no harm
    np.testing.assert_allclose(theory.mass_totals(topology, np.ones((9, 5)), "last"), 1.0)
    with pytest.raises(TheoryError, match="one column"):
        theory.mass_totals(topology, up[:, :2])


@pytest.mark.parametrize("delivery", [0.3, 0.8])
def test_a_leader_on_a_path_is_known_after_a_negative_binomial_time(delivery):
    """The largest id is at the end of the path, and every hop takes a geometric time."""
    found = theory.leader_agreement(path(delivery), 30)
    expected = scipy.stats.nbinom.cdf(np.arange(31) - 2, 2, delivery)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_leader_in_the_middle_of_a_star_and_in_a_triangle():
    star = path(0.7)
    t = np.arange(20)
    expected = (1.0 - 0.3**t) ** 2
    np.testing.assert_allclose(theory.leader_agreement(star, 19, leader=1), expected, atol=1e-12)
    H, R = {0: [[1.0]]}, {0: [[1.0]]}
    triangle = scenario([[0, 1], [1, 2], [0, 2]], [[0.9]], [[1.0]], H, R, 1, 4.0, 0.5)
    # all sequences of one link from the leader and one between the others, for two slots
    known = theory.leader_agreement(triangle, 2)
    assert known[1] == pytest.approx(0.25)
    # after one slot: both 1/4, none 1/4, one of them 1/2, which then needs one of two links
    assert known[2] == pytest.approx(0.25 + 0.25 * 0.25 + 0.5 * 0.75)
    with pytest.raises(TheoryError, match="not a node"):
        theory.leader_agreement(triangle, 2, leader=9)


def test_netkf_theory_prints_corollary_2_and_the_leader():
    H, R = {0: [[1.0]], 1: [[1.0]]}, {0: [[0.01]], 1: [[0.01]]}
    made = scenario([[0, 1]], [[0.5]], [[1.0]], H, R, 1, 2.8, 0.2)
    found = compute_promises(made)
    assert found["push_sum"]["corollary_2"]["value"]["needed"] == 18
    # 1 - 0.8^t reaches 0.99 at t = 21
    assert found["push_sum"]["leader_slots"]["value"] == 21
    assert "Corollary 2: 11, where rho(A_R) is 1.38: too few" in promises_text(made, found)
