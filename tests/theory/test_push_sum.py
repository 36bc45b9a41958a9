"""Exact mean squares of the push-sum filter: reference cases, enumeration, simulation."""

import itertools
import json

import networkx
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import netkf
from netkf import theory
from netkf.scenario.reading import from_table
from netkf.theory.numerics import positive_maps
from netkf.theory.push_sum import averaging
from tests.cases import FOLDER
from tests.theory.push_sum_systems import RHO_T1, T1, of_case, planar, scenario

CASES = json.loads((FOLDER / "push_sum.json").read_text())
TABLES = [(case, row) for case in CASES["mean_square_tables"] for row in case["rows"]]


@pytest.mark.parametrize(
    ("case", "row"), TABLES, ids=lambda x: x.get("name") or f"gamma{x['gamma']}-p{x['p']}"
)
def test_reference_tables(case, row):
    made = of_case(case, row["gamma"], row["p"])
    assert theory.push_sum_radius(made) == pytest.approx(row["rho_ms"], rel=1e-10)
    P = theory.push_sum_error_covariance(made)
    np.testing.assert_allclose(np.trace(P, axis1=1, axis2=2), row["node_mse"], rtol=1e-9)
    np.testing.assert_allclose(P[0], row["cov_node0"], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(theory.push_sum_limits(made).P, case["P_inf"], rtol=1e-9)


def test_the_limits_are_those_of_theorem_1():
    made = planar(2, 0.7)
    limits = theory.push_sum_limits(made)
    degrees = np.bincount(np.array(T1).ravel()) + 1.0
    H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    G = H.T @ H / 0.01
    np.testing.assert_allclose(limits.weight, degrees / degrees.sum(), rtol=1e-14)
    np.testing.assert_allclose(limits.number / limits.weight, np.full(10, 10.0), rtol=1e-14)
    np.testing.assert_allclose(limits.mass / limits.weight[:, None, None], [G] * 10, rtol=1e-13)
    F, Q = made.slot_belief
    predicted = scipy.linalg.solve_discrete_are(F.T, H.T, Q, 0.01 * np.eye(2))
    filtered = np.linalg.inv(np.linalg.inv(predicted) + G)
    np.testing.assert_allclose(limits.P, filtered, rtol=1e-8, atol=1e-12)
    assert np.trace(limits.P) == pytest.approx(0.0124391671, abs=1e-10)
    assert limits.gains[0].shape == (4, 0)
    np.testing.assert_allclose(limits.gains[4], 10.0 * filtered @ H[:1].T / 0.01, rtol=1e-8)


@pytest.mark.parametrize(
    ("gamma", "delivery", "links", "expected"),
    [
        (1, 0.7, "fresh", 0.896),
        (1, 0.6, "fresh", 1.149),
        (1, 0.5, "fresh", 1.647),
        (2, 0.6, "fresh", 0.841),
        (2, 0.5, "fresh", 0.872),
        (2, 0.5, "held", 1.205),
    ],
)
def test_radii_of_section_5(gamma, delivery, links, expected):
    assert theory.push_sum_radius(planar(gamma, delivery, links=links)) == pytest.approx(
        expected, abs=5.1e-4
    )


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("gamma", "delivery", "expected"),
    [
        (1, 0.7, 7.45),
        (1, 1.0, 1.76),
        (2, 0.7, 1.462),
        (2, 0.8, 1.287),
        (2, 0.9, 1.277),
        (2, 1.0, 1.463),
        (3, 0.7, 1.113),
        (3, 0.8, 1.056),
        (3, 0.9, 1.039),
        (3, 1.0, 1.073),
    ],
)
def test_mean_squares_of_section_5(gamma, delivery, expected):
    made = planar(gamma, delivery)
    traces = np.trace(theory.push_sum_error_covariance(made), axis1=1, axis2=2)
    central = np.trace(theory.push_sum_limits(made).P)
    assert traces.mean() / central == pytest.approx(expected, abs=5.1e-3 if gamma == 1 else 5.1e-4)


def enumerated(made):
    """E[(M (x) M) (x) ...] of the errors and of their noise, written plainly over all outcomes."""
    filter_, links = made.filter.algorithm, made.topology.links
    limits, N, n = theory.push_sum_limits(made), len(made.nodes), made.plant.n
    p = made.network.channel.loss.delivery
    A, S, own = [], [], []
    for node, K in zip(made.nodes, limits.gains, strict=True):
        H, R = made.observation_matrices(node)
        S.append(np.eye(n) - K @ H)
        A.append(S[-1] @ made.plant.F)
        own.append(K @ R @ K.T)
    A, stacked = scipy.linalg.block_diag(*A), np.concatenate(S)
    noise = stacked @ made.plant.Q @ stacked.T + scipy.linalg.block_diag(*own)
    coins = 1 if made.network.channel.symmetric else 2
    steps = []
    for ups in itertools.product((0, 1), repeat=coins * len(links)):
        M, chance = np.eye(N), 1.0
        for k, (i, j) in enumerate(links):
            mine = ups[coins * k : coins * (k + 1)]
            for up in mine:
                chance *= p if up else 1.0 - p
            for (a, b), up in (((i, j), mine[0]), ((j, i), mine[-1])):
                M[a, a] -= up / filter_.delta
                M[a, b] += up / filter_.delta
        steps.append((chance, np.kron(M, np.eye(n))))
    gamma = filter_.gamma
    if filter_.links == "held":
        powers = [(c, np.linalg.matrix_power(M, gamma)) for c, M in steps]
        mean = sum(c * np.kron(M, M) for c, M in powers)
    else:
        mean = np.linalg.matrix_power(sum(c * np.kron(M, M) for c, M in steps), gamma)
    T = mean @ np.kron(A, A)
    radius = np.abs(np.linalg.eigvals(T)).max()
    X = np.linalg.solve(np.eye(len(T)) - T, mean @ noise.ravel()).reshape(N * n, N, n)
    return radius, np.array([X[k * n : (k + 1) * n, k] for k in range(N)])


@pytest.mark.parametrize("links", ["fresh", "held"])
@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("gamma", [1, 2, 3])
def test_against_plain_enumeration(gamma, symmetric, links):
    """A small system of coupled states: all outcomes of all links, dense Kronecker products."""
    F, Q = [[1.02, 0.2], [-0.1, 0.95]], [[0.2, 0.05], [0.05, 0.1]]
    made = scenario(
        [[0, 1], [1, 2], [0, 2], [2, 3]],
        F,
        Q,
        {0: [[1.0, 0.0]], 3: [[0.3, 1.0]]},
        {0: [[0.5]], 3: [[1.5]]},
        gamma,
        4.3,
        0.8,
        symmetric=symmetric,
        links=links,
    )
    radius, P = enumerated(made)
    assert theory.push_sum_radius(made) == pytest.approx(radius, rel=1e-9)
    if radius < 1.0:
        np.testing.assert_allclose(theory.push_sum_error_covariance(made), P, rtol=1e-8)
    else:
        with pytest.raises(netkf.TheoryError, match="not below 1"):
            theory.push_sum_error_covariance(made)


RING = [[k, (k + 1) % 10] for k in range(10)]


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "settings",
    [
        {"gamma": 1, "delivery": 0.7},
        {"gamma": 3, "delivery": 0.8},
        {"gamma": 3, "delivery": 0.8, "symmetric": False},
        {"gamma": 6, "delivery": 0.9, "delta": 3.0, "edges": RING, "links": "held"},
    ],
    ids=str,
)
def test_the_methods_for_large_networks_agree_with_dense_ones(settings, monkeypatch):
    made = planar(**settings)
    radius, P = theory.push_sum_radius(made), theory.push_sum_error_covariance(made)
    monkeypatch.setattr(averaging, "MAX_KRONECKER", 1)
    assert theory.push_sum_radius(made) == pytest.approx(radius, rel=1e-11)
    monkeypatch.setattr(positive_maps, "MAX_DENSE_FALLBACK", 1)
    assert theory.push_sum_radius(made) == pytest.approx(radius, rel=1e-11)
    np.testing.assert_allclose(theory.push_sum_error_covariance(made), P, rtol=1e-7, atol=1e-12)
    monkeypatch.undo()
    monkeypatch.setattr(positive_maps, "MAX_DENSE", 10**6)
    assert theory.push_sum_radius(made) == pytest.approx(radius, rel=1e-11)
    np.testing.assert_allclose(theory.push_sum_error_covariance(made), P, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("nodes", [40, pytest.param(200, marks=pytest.mark.slow)])
def test_large_networks_and_ten_steps(nodes):
    """Nothing of (N n)^2 columns is built; a path of the errors, over nodes and time, agrees."""
    graph = networkx.random_regular_graph(4, nodes, seed=1)
    edges = [list(edge) for edge in graph.edges]
    base = planar(10, 0.7)
    H = {k: [[1.0, 0.0, 0.0, 0.0]] if k % 2 else [[0.0, 1.0, 0.0, 0.0]] for k in range(nodes)}
    made = scenario(
        edges,
        base.plant.F.tolist(),
        base.plant.Q.tolist(),
        H,
        {k: [[0.01]] for k in H},
        10,
        8.0,
        0.7,
    )
    assert 0.2 < theory.push_sum_radius(made) < 1.0
    P = theory.push_sum_error_covariance(made)
    least = np.linalg.eigvalsh(P - theory.push_sum_limits(made).P)[:, 0].min()
    assert least > -1e-12  # nobody does better than the filter with all readings
    assert np.trace(P, axis1=1, axis2=2).mean() == pytest.approx(
        simulated(made, slots=600, seed=3), rel=0.15
    )


def simulated(made, slots, seed):
    """Mean square of steps 4-5 at the asymptotic gains, over one path from slot 50 on."""
    random, n, N = np.random.default_rng(seed), made.plant.n, len(made.nodes)
    limits, filter_ = theory.push_sum_limits(made), made.filter.algorithm
    links = np.array(made.topology.links)
    root_Q = np.linalg.cholesky(made.plant.Q)
    error, total = np.zeros((N, n)), []
    for _ in range(slots):
        drive = root_Q @ random.standard_normal(n)
        ahead = error @ made.plant.F.T + drive
        for k, K in enumerate(limits.gains):
            H, R = made.observation_matrices(made.nodes[k])
            noise = np.linalg.cholesky(R) @ random.standard_normal(len(H))
            ahead[k] -= K @ (H @ ahead[k] + noise)
        for _ in range(filter_.gamma):
            up = links[random.random(len(links)) < made.network.channel.loss.delivery]
            step = np.zeros((N, n))
            np.add.at(step, up[:, 0], ahead[up[:, 1]] - ahead[up[:, 0]])
            np.add.at(step, up[:, 1], ahead[up[:, 0]] - ahead[up[:, 1]])
            ahead = ahead + step / filter_.delta
        error = ahead
        total.append((error**2).sum(axis=1).mean())
    return np.mean(total[50:])


def test_a_simulation_stays_within_its_interval():
    made = of_case(CASES["mean_square_tables"][0], 2, 0.7, asymptotic=True)
    made = made.replace({"horizon": 61.0, "probe": [60.0]})
    assert theory.push_sum_radius(made) < 0.8
    P = theory.push_sum_error_covariance(made)[:, 0, 0]
    runs = [netkf.simulate(made, seed=5, replica=k) for k in range(200)]
    squares = np.array([(run.x[-1] - run.xhat[-1])[:, 0] ** 2 for run in runs])
    z = (squares.mean(axis=0) - P) / (squares.std(axis=0, ddof=1) / np.sqrt(len(squares)))
    assert np.abs(z).max() < 4.0


@pytest.mark.slow
def test_each_direction_has_its_own_probability(tmp_path):
    """Node 1 mostly hears node 0, node 0 hardly hears node 1; the engine sees it the same way."""
    rows = "sender,receiver,delivery_probability\n0,1,0.9\n1,0,0.2\n1,2,0.8\n2,1,0.6\n"
    (tmp_path / "links.csv").write_text(rows)
    table = {
        "format": 1,
        "name": "directions",
        "horizon": 31.0,
        "probe": [30.0],
        "plant": {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0},
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
        "network": {
            "graph": {"kind": "csv", "path": "links.csv"},
            "activation": {"kind": "broadcast"},
            "channel": {"loss": {"kind": "per-link"}, "symmetric": False},
        },
        "filter": {"kind": "push-sum", "gamma": 2, "delta": 3.5, "asymptotic": True},
    }
    made = from_table(table, tmp_path)
    assert theory.push_sum_radius(made) < 0.8
    P = theory.push_sum_error_covariance(made)[:, 0, 0]
    runs = [netkf.simulate(made, seed=2, replica=k) for k in range(400)]
    squares = np.array([(run.x[-1] - run.xhat[-1])[:, 0] ** 2 for run in runs])
    z = (squares.mean(axis=0) - P) / (squares.std(axis=0, ddof=1) / np.sqrt(len(squares)))
    assert np.abs(z).max() < 4.0
    (tmp_path / "links.csv").write_text(
        rows.replace("0.9", "x").replace("0.2", "0.9").replace("x", "0.2")
    )
    turned = theory.push_sum_error_covariance(from_table(table, tmp_path))[:, 0, 0]
    off = (squares.mean(axis=0) - turned) / (squares.std(axis=0, ddof=1) / np.sqrt(len(squares)))
    assert np.abs(off).max() > 6.0  # the test would see the directions exchanged


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.4, 0.7, 0.9]))
def test_certain_links_are_fresh_and_held_alike(seed, delivery):
    random = np.random.default_rng(seed)
    F = (0.9 * random.standard_normal((2, 2))).tolist()
    given_ = ([[0, 1], [1, 2]], F, np.eye(2).tolist(), {0: np.eye(2).tolist()})
    R = {0: np.eye(2).tolist()}
    fresh, held = (scenario(*given_, R, 3, 3.5, 1.0, links=k) for k in ("fresh", "held"))
    assert theory.push_sum_radius(fresh) == pytest.approx(theory.push_sum_radius(held), rel=1e-9)
    one, same = (scenario(*given_, R, 1, 3.5, delivery, links=k) for k in ("fresh", "held"))
    assert theory.push_sum_radius(one) == theory.push_sum_radius(same)


def test_close_to_the_threshold_the_errors_are_still_exact(monkeypatch):
    made = planar(1, 0.6387)
    radius = theory.push_sum_radius(made)
    assert 0.9999 < radius < 1.0
    P = theory.push_sum_error_covariance(made)
    monkeypatch.setattr(positive_maps, "MAX_DENSE", 10**6)
    np.testing.assert_allclose(theory.push_sum_error_covariance(made), P, rtol=1e-7)


def test_units_do_not_matter():
    """Several units in one state: the same radius, and errors in those units."""
    made, units = planar(2, 0.7), np.diag([1e-2, 1.0, 1e2, 1.0])
    back = np.linalg.inv(units)
    other = scenario(
        T1,
        (units @ made.plant.F @ back).tolist(),
        (units @ made.plant.Q @ units).tolist(),
        {k: (made.observation_matrices(k)[0] @ back).tolist() for k in (4, 9)},
        {4: [[0.01]], 9: [[0.01]]},
        2,
        4.01,
        0.7,
    )
    assert theory.push_sum_radius(other) == pytest.approx(theory.push_sum_radius(made), rel=1e-6)
    P = back @ theory.push_sum_error_covariance(other) @ back
    np.testing.assert_allclose(P, theory.push_sum_error_covariance(made), rtol=1e-5, atol=1e-9)


def test_certain_links_need_no_enumeration():
    chain = [[k, k + 1] for k in range(99)]
    H = R = {k: [[1.0]] for k in range(100)}
    fresh, held = (
        scenario(chain, [[0.5]], [[1.0]], H, R, 3, 4.5, 1.0, links=links)
        for links in ("fresh", "held")
    )
    assert theory.push_sum_radius(held) == theory.push_sum_radius(fresh)
    np.testing.assert_array_equal(
        theory.push_sum_error_covariance(held), theory.push_sum_error_covariance(fresh)
    )


def test_systems_at_the_edge():
    """One node is the central filter; no sensors: the plant's own covariance; F = 0: no memory."""
    one = scenario([], [[0.9]], [[1.0]], {0: [[1.0]]}, {0: [[1.0]]}, 3, 4.0, 0.5, nodes=1)
    alone = theory.push_sum_error_covariance(one)[0]
    np.testing.assert_allclose(alone, theory.central_covariance(one), rtol=1e-12)
    blind = scenario([[0, 1]], [[0.9]], [[1.0]], {}, {}, 2, 4.0, 0.5)
    np.testing.assert_allclose(theory.push_sum_error_covariance(blind), [[[1 / 0.19]]] * 2)
    chain = [[k, k + 1] for k in range(19)]
    forgetful = scenario(chain, [[0.0]], [[1.0]], {0: [[1.0]]}, {0: [[1.0]]}, 2, 4.0, 0.5)
    assert theory.push_sum_radius(forgetful) == 0.0


def test_the_stability_map_is_made_of_radii():
    made = planar(1, 0.9)
    found = theory.push_sum_stability(made, [1, 2], [0.5, 1.0])
    expected = [[theory.push_sum_radius(planar(g, p)) for p in (0.5, 1.0)] for g in (1, 2)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    with pytest.raises(netkf.TheoryError, match="gamma"):
        theory.push_sum_stability(made, [0], [0.5])
    with pytest.raises(netkf.TheoryError, match="delivery"):
        theory.push_sum_stability(made, [1], [1.5])


@pytest.mark.parametrize("graph", CASES["graphs"], ids=lambda g: g["name"])
def test_bounds_on_the_consensus_gain(graph):
    made = scenario(
        graph["edges"], [[0.9]], [[1.0]], {0: [[1.0]]}, {0: [[1.0]]}, 1, 2.0 * graph["N"], 0.7
    )
    bound = theory.consensus_gain_bound(made)
    assert bound.radius == pytest.approx(graph["rho_L"], rel=1e-12)
    assert bound.local == graph["max_degree_sum"]
    assert bound.nodes == graph["N"]
    assert graph["max_degree"] + 1.0 <= bound.radius + 1e-12
    assert bound.radius <= min(bound.local, bound.nodes) + 1e-12


def test_rho_of_the_planar_network():
    assert theory.consensus_gain_bound(planar(1, 0.7)).radius == pytest.approx(RHO_T1, rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {
                "network.channel.loss": {
                    "kind": "gilbert-elliott",
                    "mean_loss": 0.2,
                    "mean_burst": 4.0,
                }
            },
            "gilbert-elliott",
        ),
        ({"network.channel.delay": {"kind": "exponential", "mean": 0.1}}, "shorter delay"),
        ({"filter": {"kind": "central"}}, "push-sum filter"),
        ({"filter.model": {"F": [[1.0]]}}, "F differs"),
    ],
)
def test_refusals(changes, words):
    made = of_case(CASES["mean_square_tables"][0], 2, 0.7).replace(changes)
    with pytest.raises(netkf.TheoryError, match=words):
        theory.push_sum_radius(made)


def test_held_links_that_are_too_many_are_refused():
    edges = [list(edge) for edge in networkx.complete_graph(8).edges]
    H, R = {0: [[1.0]]}, {0: [[1.0]]}
    made = scenario(edges, [[0.9]], [[1.0]], H, R, 2, 9.0, 0.7, links="held")
    with pytest.raises(netkf.TheoryError, match="enumerated"):
        theory.push_sum_radius(made)
