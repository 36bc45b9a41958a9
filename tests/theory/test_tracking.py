"""The level of noise in D Theorem 4.2 against quadrature."""

import math

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import netkf
from netkf import theory
from netkf.core.errors import TheoryError
from tests.conftest import SCENARIOS


@pytest.fixture(scope="module")
def regression():
    return netkf.load(SCENARIOS / "diffusion_regression.toml")


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("p", "beta"), [(1.0, 2.1), (2.0, 3.0)])
def test_the_level_against_quadrature(regression, p, beta):
    """|V| and |Delta| are independent multiples of chi variables: scalar noises of one variance at
    N nodes, and N copies of one increment with covariance q I.
    """
    nodes, Q = len(regression.nodes), regression.slot_plant.Q
    scale = math.sqrt(nodes * Q[0, 0])
    assert np.array_equal(Q, Q[0, 0] * np.eye(len(Q)))
    sensors = [
        regression.noise_covariance(place.entry, believed=False)[0, 0]
        for node in regression.sensing_nodes
        for place in regression.placed_sensors[node]
    ]
    assert np.ptp(sensors) == 0.0
    r = math.sqrt(sensors[0])

    def integrand(v, d):
        xi = r * v + scale * d
        density = scipy.stats.chi.pdf(v, len(sensors)) * scipy.stats.chi.pdf(d, len(Q))
        return (xi * math.log(math.e + xi) ** beta) ** p * density

    total, _ = scipy.integrate.dblquad(integrand, 0.0, 9.0, 0.0, 12.0, epsabs=1e-4)
    found = theory.tracking_level(regression, p, beta, samples=40_000, seed=2)
    assert found.low < total ** (1.0 / p) < found.high < 1.03 * found.low
    assert found.shape == pytest.approx(
        found.sigma * math.log(math.e + 1.0 / found.sigma) ** (1.0 + beta / 2.0)
    )


def test_the_bound_goes_to_0_with_the_noises(regression):
    """D Remark 4.1."""
    quiet = regression.replace({"plant.Q": (1e-8 * regression.slot_plant.Q).tolist()})
    found = theory.tracking_level(quiet)
    assert found.shape < theory.tracking_level(regression).shape


def test_a_high_moment_does_not_overflow(regression):
    """The norm of order p tends to the largest of the draws."""
    high, higher = (theory.tracking_level(regression, p, samples=1000) for p in (400.0, 1e300))
    assert high.sigma < higher.sigma < 1.02 * high.sigma
    assert high.low < high.sigma < high.high


def test_wrong_arguments(regression):
    with pytest.raises(TheoryError, match="beta > 2"):
        theory.tracking_level(regression, beta=2.0)
    with pytest.raises(TheoryError, match="beyond floating point"):
        theory.tracking_level(regression, beta=1e6)
    with pytest.raises(TheoryError, match="law"):
        theory.tracking_level(netkf.load(SCENARIOS / "poisson_ring.toml"))
