"""H(12) on upper triangles, its solution, and its linear equations, against plain formulas."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.sparse

from netkf import TheoryError, theory
from netkf.network.spectra import connected_parts
from netkf.theory.hybrid import bounds, coupled, dense, linearised, steady
from netkf.theory.hybrid.coupled import CoupledRiccati
from netkf.theory.hybrid.packed import PackedRiccati
from netkf.theory.hybrid.samples import PoissonSamples
from netkf.theory.numerics import matrices

N, n = 5, 3


def equations(delay=0.0, seed=1, n=n):
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(n, n)), random.normal(size=(n, n))
    coupling = random.uniform(size=(N, N)) * (random.uniform(size=(N, N)) < 0.6)
    np.fill_diagonal(coupling, 0.0)
    G = np.zeros((N, n, n))
    for i, rows in ((0, 1), (2, 2), (3, 3)):
        H = random.normal(size=(rows, n))
        H[:, :3] *= [1.0, 1e-3, 10.0]  # states in units of their own
        G[i] = H.T @ H
    T, q = scipy.linalg.expm(A * delay), delay * np.eye(n)
    start = random.normal(size=(N, n, n))
    start = start @ np.swapaxes(start, 1, 2)
    return CoupledRiccati(A, B @ B.T, G, scipy.sparse.csr_array(coupling), T, q, delay, start)


def plain(e, P, sent):
    c = e.coupling.toarray()
    return np.stack(
        [
            e.A @ P[i]
            + P[i] @ e.A.T
            + e.Q
            - P[i] @ e.G[i] @ P[i]
            + sum(c[i, j] * (e.T @ sent[j] @ e.T.T + e.q - P[i]) for j in range(N))
            for i in range(N)
        ]
    )


def near(got, expected, tolerance=1e-12):
    assert np.abs(got - expected).max() <= tolerance * np.abs(expected).max()


@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_the_slope_is_the_right_hand_side(delay):
    e, other = equations(delay), equations(seed=2).start
    packed = PackedRiccati(e)
    near(packed.unpack(packed.slope(packed.start, packed.pack(other))), plain(e, e.start, other))
    if delay == 0.0:
        near(packed.unpack(packed.slope(packed.start)), plain(e, e.start, e.start))


def test_samples_are_linearised_as_the_slope_changes():
    random = np.random.default_rng(4)
    H, R = random.normal(size=(2, 2, n)), np.tile(np.diag([0.5, 0.2]), (2, 1, 1))
    heard = scipy.sparse.csr_array(random.uniform(size=(N, 2)))
    group = PoissonSamples(np.array([0, 3]), H, R, np.array([2.0, 0.7]), heard)
    packed = PackedRiccati(equations()._replace(samples=(group,)))
    P, X, step = packed.pack(equations(seed=5).start), packed.pack(equations(seed=2).start), 1e-4
    expected = (packed.slope(P + step * X) - packed.slope(P - step * X)) / (2.0 * step)
    found = packed.linear(packed.unpack(P)).matrix(True) @ X.reshape(-1)
    near(found, expected.reshape(-1), 1e-6)


@pytest.mark.parametrize("arriving", [True, False])
def test_the_linear_part_is_the_derivative_of_the_slope(arriving):
    e = equations(0.3)
    packed, X = PackedRiccati(e), equations(seed=2).start
    # The right-hand side is quadratic: central differences are exact.
    sent = X if arriving else 0.0 * X
    expected = 0.5 * (plain(e, e.start + X, sent) - plain(e, e.start - X, -sent))
    linear, rows = packed.linear(e.start), packed.pack(X)
    applied = np.einsum("ik,ikl->il", rows, linear.blocks) + arriving * linear.arriving(rows)
    near(packed.unpack(applied), expected, 1e-11)
    flat = linear.matrix(arriving) @ rows.reshape(-1)
    near(packed.unpack(flat.reshape(rows.shape)), expected, 1e-11)


@pytest.mark.slow
def test_the_solution_is_followed_to_all_digits(monkeypatch):
    """And to fewer by the implicit method, where explicit steps would be too many."""
    e = equations()
    packed, times = PackedRiccati(e), np.array([0.0, 0.0, 0.1, 0.5, 2.0, 2.0])
    got = packed.unpack(bounds._solve_coupled(packed, times))
    solved = scipy.integrate.solve_ivp(
        lambda _, y: plain(e, y.reshape(N, n, n), y.reshape(N, n, n)).reshape(-1),
        (0.0, 2.0), e.start.reshape(-1), "DOP853", times[2:5], rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_array_equal(got[:2], [e.start, e.start])
    np.testing.assert_array_equal(got[5], got[4])
    for P, expected in zip(got[2:5], solved.y.T.reshape(-1, N, n, n), strict=True):
        near(P, expected, 1e-9)
    monkeypatch.setattr(bounds, "MAX_EXPLICIT_EVALUATIONS", 28)
    near(packed.unpack(bounds._solve_coupled(packed, times)), got, 1e-7)


@pytest.fixture
def random_graph(build):
    """Random graphs of degree 8, four states, every third node senses two of them."""

    def made(nodes):
        A = np.kron(np.eye(2), [[0.0, 1.0], [-1.0, 0.1]])
        eye, H = np.eye(4).tolist(), [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
        graph = {"kind": "regular", "nodes": nodes, "degree": 8, "seed": 1, "connected": True}
        return build(
            plant={"kind": "diffusion", "A": A.tolist(), "B": eye, "cov": eye},
            sensors=[{"nodes": list(range(0, nodes, 3)), "H": H, "R": [[0.25, 0.0], [0.0, 0.25]]}],
            network={"graph": graph, "activation": {"kind": "poisson", "rate": 3.0}},
            filter={"kind": "hybrid", "epsilon": 0.1},
        )

    return made


def test_a_large_network_comes_to_its_steady_state(random_graph, monkeypatch):
    def refused(*_):
        raise AssertionError("1000 nodes would take minutes")

    monkeypatch.setattr(scipy.sparse.linalg, "spsolve", refused)
    scenario = random_graph(250)
    steady = theory.steady_covariance_bound(scenario)
    near(theory.covariance_bound(scenario, [0.0, 150.0])[1], steady, 1e-9)


def test_iterations_and_elimination_agree(random_graph, monkeypatch):
    scenario = random_graph(40)
    eliminated = theory.steady_covariance_bound(scenario)
    monkeypatch.setattr(linearised, "FEW_UNKNOWNS", 0)
    near(theory.steady_covariance_bound(scenario), eliminated, 1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.1])
@pytest.mark.parametrize("sampled", [False, True])
def test_linear_equations_of_many_states_take_no_matrix_of_all_entries(monkeypatch, delay, sampled):
    """Of 20 states 210 entries of P: GMRES, and its preconditioner, multiply matrices (20, 20)."""
    e, X = equations(delay, n=20), equations(seed=2, n=20).start
    e = e._replace(A=e.A / 5.0 - np.eye(20), start=e.start / 20.0)
    if sampled:
        H, nodes = np.random.default_rng(3).normal(size=(2, 1, 20)), np.array([1, 4])
        heard = scipy.sparse.csr_array((N, 2))
        group = PoissonSamples(nodes, H, np.ones((2, 1, 1)), np.array([1.0, 3.0]), heard)
        e = e._replace(samples=(group,))
    packed = PackedRiccati(e)
    half = (packed.slope(packed.pack(e.start + h * X), h * packed.pack(X)) for h in (1e-5, -1e-5))
    right = -(next(half) - next(half)) / 2e-5

    def refused(*_):
        raise AssertionError("of order m^3")

    for module, name in ((np.linalg, "inv"), (scipy.sparse.linalg, "spsolve")):
        monkeypatch.setattr(module, name, refused)
    monkeypatch.setattr(linearised, "FEW_UNKNOWNS", 0)
    monkeypatch.setattr(PackedRiccati, "eliminates_cheaply", False)
    near(packed.unpack(linearised.solve_map(packed.linear(e.start), right)), X, 1e-6)


def test_a_bound_without_stiffness_takes_few_steps(random_graph, monkeypatch):
    """Series of 28 terms: explicit methods of order 8 take thousands of evaluations."""
    monkeypatch.setattr(bounds, "MAX_EXPLICIT_EVALUATIONS", 600)
    monkeypatch.setattr(bounds, "_PiecewiseSolution", None)
    scenario = random_graph(60)
    found = theory.covariance_bound(scenario, np.linspace(0.0, 10.0, 41))
    assert np.linalg.eigvalsh(found).min() > 0.0
    blind = scenario.replace({"sensors": []})
    grown, A = theory.covariance_bound(blind, [2.0])[0], scenario.plant.A
    # Without sensors all nodes have the covariance of the prediction alone.
    exponential = scipy.linalg.expm(np.block([[-A, np.eye(4)], [np.zeros((4, 4)), A.T]]) * 2.0)
    F = exponential[4:, 4:].T
    near(grown, np.broadcast_to(F @ F.T + F @ exponential[:4, 4:], grown.shape), 1e-10)


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_few_nodes_in_full_matrices_have_the_results_of_sparse_ones(delay):
    """The sparse ones are solved by scipy's SuperLU."""
    e, random = equations(delay), np.random.default_rng(4)
    H, nodes = random.normal(size=(3, 1, n)), np.array([1, 4, 4])
    heard = scipy.sparse.csr_array(random.uniform(size=(N, 3)))
    group = PoissonSamples(nodes, H, np.ones((3, 1, 1)), np.array([1.0, 3.0, 2.0]), heard)
    full = dense.full_matrix(N, N)
    full[:] = e.coupling.toarray()
    linears = []
    for one, rates in ((e, heard), (e._replace(coupling=full), heard.toarray())):
        samples = (group._replace(heard=np.asarray(rates).view(dense.FullMatrix)),)
        packed = PackedRiccati(one._replace(samples=samples if one is not e else (group,)))
        linears.append((packed, packed.linear(e.start)))
    (sparse, linear), (packed, full_linear) = linears
    assert packed.is_full
    assert not sparse.is_full
    near(full_linear.full_matrix(), linear.matrix().toarray())
    near(packed.slope(packed.start, packed.start), sparse.slope(sparse.start, sparse.start))
    right = packed.pack(equations(seed=2).start)
    near(linearised.solve_map(full_linear, right), linearised.solve_map(linear, right), 1e-11)


@pytest.fixture
def both_ways(monkeypatch):
    def compute(function):
        results = []
        for unknowns in (0, dense.MAX_UNKNOWNS):
            monkeypatch.setattr(dense, "MAX_UNKNOWNS", unknowns)
            coupled.coupling.cache_clear()
            steady._steady_state_of.cache_clear()
            results.append(function())
        return results

    return compute


@pytest.mark.parametrize("delay", [0.0, 0.1])
def test_bounds_and_limits_of_few_nodes_are_those_of_sparse_matrices(build, both_ways, delay):
    delays = {"delay": {"kind": "constant", "seconds": delay}} if delay else {}
    scenario = build(
        plant={"kind": "diffusion", "A": [[0.1, 1.0], [-1.0, 0.1]], "B": [[1.0], [0.5]]},
        sensors=[{"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.25]]}],
        network={
            "graph": {"kind": "edges", "nodes": 5, "edges": [[0, 1], [1, 2], [2, 3], [3, 4]]},
            "activation": {"kind": "poisson", "at": "nodes", "rate": 8.0},
            "channel": {"loss": {"kind": "bernoulli", "delivery": 0.5}, **delays},
        },
        filter={"kind": "hybrid", "epsilon": 0.2},
    )
    sparse, full = both_ways(
        lambda: (
            theory.covariance_bound(scenario, [0.0, 1.0, 3.0]),
            theory.steady_covariance_bound(scenario),
            theory.limit_covariance(scenario),
        )
    )
    for got, expected in zip(full, sparse, strict=True):
        near(got, expected)


def test_riccati_equations_of_few_states_have_the_solutions_of_scipy():
    for seed in range(24):
        random = np.random.default_rng(seed)
        size = 1 + seed % matrices.MAX_STATES
        A, B, C = (random.normal(size=(size, size)) for _ in range(3))
        A[0] *= 10.0 ** (seed % 3)  # states in units of their own
        Q, G = B @ B.T, C[:1].T @ C[:1]
        expected = scipy.linalg.solve_continuous_are(A.T, C[:1].T, Q, np.eye(1))
        got = matrices.algebraic_riccati(A, Q, G)
        terms = np.abs(A @ got).max() + np.abs(got @ G @ got).max()
        assert np.abs(A @ got + got @ A.T + Q - got @ G @ got).max() <= 1e-11 * terms
        near(got, expected, 1e-7)


@pytest.mark.parametrize("A", [[[0.0]], [[0.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [-1.0, 0.0]]])
def test_what_neither_fades_nor_is_driven_has_no_stabilising_solution(A):
    """P falls to 0 as 1 / t, and so does the gain."""
    A = np.array(A)
    with pytest.raises(TheoryError):
        matrices.algebraic_riccati(A, np.zeros(A.shape), 2.0 * np.eye(len(A)))


@pytest.mark.parametrize("connection", ["strong", "weak"])
def test_the_parts_of_full_graphs_are_those_that_scipy_finds(connection):
    random = np.random.default_rng(0)
    for size in (1, 2, 7, 40):
        graph = (random.uniform(size=(size, size)) < 1.2 / size) * 0.5
        count, part = connected_parts(graph, connection)
        expected, other = connected_parts(scipy.sparse.csr_array(graph), connection)
        assert count == expected
        assert len({*zip(part.tolist(), other.tolist(), strict=True)}) == count
