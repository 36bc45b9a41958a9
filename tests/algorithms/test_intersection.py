"""Covariance intersection: its formula, order and robustness, and the filter over link clocks."""

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.algorithms.kernels.square_root import lower_root
from tests.algorithms.test_estimates import intersect
from tests.engines.linearity import engine_covariance

PLANAR = {
    "kind": "diffusion",
    "A": [[0.0, 1.0], [-1.0, 0.1]],
    "B": [[0.0], [1.0]],
    "cov": [[1.0, 0.0], [0.0, 1.0]],
}
SENSORS = [
    {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.25]]},
    {"nodes": [2], "H": [[0.0, 1.0]], "R": [[0.5]]},
]
NETWORK = {
    "graph": {"kind": "cycle", "nodes": 4},
    "activation": {"kind": "poisson", "rate": 3.0},
    "channel": {"loss": {"kind": "bernoulli", "delivery": 0.7}},
}


def planar(build, kind, **more):
    tables = {"plant": PLANAR, "sensors": SENSORS, "network": NETWORK, "probe": 0.25}
    return build(**tables | {"filter": {"kind": kind, "epsilon": 0.4}} | more)


@pytest.mark.parametrize("n", [1, 3, 6])
@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_textbook_formula(n, seed):
    """P^-1 = sum w P_j^-1, P^-1 x = sum w P_j^-1 x_j, and P <= sum w P_j."""
    rng = np.random.default_rng(seed)
    roots, means = rng.standard_normal((4, n, n)), 100.0 * rng.standard_normal((4, n))
    roots = np.stack([lower_root(root) for root in roots])
    weights = rng.dirichlet(np.ones(4))
    weights[seed % 4] = 0.0
    weights /= weights.sum()
    xhat, root = intersect(weights, means, roots)
    P = roots @ roots.swapaxes(1, 2)
    inverses = np.linalg.inv(P)
    expected = np.linalg.inv(np.tensordot(weights, inverses, 1))
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-7)
    estimate = expected @ np.einsum("j,jab,jb->a", weights, inverses, means)
    np.testing.assert_allclose(xhat, estimate, rtol=1e-7)
    mean = np.tensordot(weights, P, 1)
    assert np.linalg.eigvalsh(mean - expected)[0] > -1e-9 * np.abs(mean).max()


def test_ill_conditioned_covariances_keep_their_digits():
    """Variances of 1e12 beside 1e-12: what is sure stays sure, to rounding."""
    one, other = np.diag([1e6, 1e-6]), np.diag([1e-6, 1e6])
    means = np.array([[3.0, 1.0], [2.0, 7.0]])
    xhat, root = intersect(np.array([0.5, 0.5]), means, np.stack([one, other]))
    np.testing.assert_allclose(np.diag(root @ root.T), [2e-12, 2e-12], rtol=1e-12)
    np.testing.assert_allclose(xhat, [2.0, 1.0], rtol=1e-12)


def test_equal_covariances_make_it_the_hybrid_filter(build):
    same = {"sensors": [{"nodes": [0, 1, 2, 3], "H": [[1.0, 0.0]], "R": [[0.25]]}]}
    ours, hybrid = (
        netkf.simulate(planar(build, kind, **same))
        for kind in ("covariance-intersection", "hybrid")
    )
    np.testing.assert_allclose(ours.xhat, hybrid.xhat, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(ours.P, hybrid.P, rtol=1e-9, atol=1e-12)
    assert ours.count("absorb") == hybrid.count("absorb") > 10


def test_on_every_path_it_claims_less_than_the_hybrid_filter_so_the_bound_holds(build):
    """The same ticks; P is below the convex reset's, whose mean is below H (12)."""
    ours = planar(build, "covariance-intersection")
    for replica in range(10):
        P = netkf.simulate(ours, replica=replica).P
        hybrid = netkf.simulate(planar(build, "hybrid"), replica=replica).P
        gap = np.linalg.eigvalsh(hybrid - P)[..., 0]
        assert gap.min() >= -1e-10
        assert np.trace(hybrid - P, axis1=2, axis2=3).max() > 1e-3
    bound = theory.covariance_bound(ours, [1.0, 3.0])
    np.testing.assert_array_equal(
        bound, theory.covariance_bound(planar(build, "hybrid"), [1.0, 3.0])
    )


def test_its_covariance_is_never_below_the_error_s(build):
    """H (10) without Monte Carlo, against a map found by running the engine draw by draw."""
    scenario = planar(build, "covariance-intersection", horizon=1.0)
    by_draws, run = engine_covariance(scenario)
    exact = theory.error_covariance(scenario, run)
    assert run.count("absorb") > 2
    assert np.linalg.eigvalsh(run.P - exact)[..., 0].min() > -1e-9
    size = np.linalg.norm(exact, axis=(2, 3))
    assert (np.linalg.norm(by_draws - exact, axis=(2, 3)) <= 1e-3 * size).all()


def test_singular_starts_are_refused_where_noise_does_not_reach_every_state(build):
    plant = PLANAR | {"B": [[0.0], [0.0]], "cov": [[0.0, 0.0], [0.0, 0.0]]}
    with pytest.raises(netkf.ScenarioError, match=r"filter\.cov: must be positive definite"):
        planar(build, "covariance-intersection", plant=plant)
    start = PLANAR | {"cov": [[0.0, 0.0], [0.0, 0.0]]}
    run = netkf.simulate(planar(build, "covariance-intersection", plant=start))
    assert np.linalg.eigvalsh(run.P[1:]).min() > 0.0
