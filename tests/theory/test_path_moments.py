"""Mean squares by quadrature against the exact covariances of the errors of the same run."""

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.core.errors import TheoryError
from netkf.theory.hybrid.path_moments import expected_squares
from tests.conftest import SCENARIOS

BURSTS = {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.3}
CHANGES = {
    "bursts": {"network.channel.loss": BURSTS},
    "one way": {"network.activation.at": "directions"},
    "nodes": {"network.activation.at": "nodes"},
    "at once": {"network.activation": {"kind": "periodic", "period": 0.4}},
    "another start": {"filter.cov": [[3.0, 0.0], [0.0, 2.0]], "filter.mean": [1.0, -0.5]},
    "another model": {"filter.model": {"R": [[0.5]], "B": [[0.0], [1.4]]}},
}


@pytest.mark.parametrize("change", CHANGES)
def test_they_are_the_traces_of_the_exact_covariances(ring, change):
    made = ring.replace({"horizon": 4.0, **CHANGES[change]})
    run = netkf.simulate(made, 3, 1)
    exact = np.trace(theory.error_covariance(made, run), axis1=2, axis2=3)
    found = expected_squares(made, run)
    if change == "another start":
        # the exact covariance leaves out the mean that another start gives the error
        assert (found > exact - 1e-6).all()
        assert found[0] == pytest.approx(2.0 + 1.25)
        return
    np.testing.assert_allclose(found, exact, rtol=2e-5)


def test_they_are_the_mean_of_squared_errors(ring):
    """The average over runs with the same messages is what the quadrature says."""
    made = ring.replace({"horizon": 2.0, "network.channel.loss": BURSTS})
    squares, expected = [], []
    for replica in range(400):
        run = netkf.simulate(made, 3, replica)
        squares.append((run.error[-1] ** 2).sum(axis=1))
        expected.append(expected_squares(made, run)[-1] if replica < 40 else None)
    mean, error = np.mean(squares, axis=0), np.std(squares, axis=0) / 20.0
    assert (np.abs(mean - np.mean(expected[:40], axis=0)) < 4.5 * error).all()


def test_where_they_are_not_known(ring):
    for name in ("delayed_links", "gossip_ring", "intel_lab"):
        made = netkf.load(SCENARIOS / f"{name}.toml")
        run = netkf.simulate(made.replace({"horizon": made.probe}))
        with pytest.raises(TheoryError, match="by quadrature"):
            expected_squares(made, run)
    unstable = ring.replace({"filter.model": {"A": [[0.0, 1.0], [-1.0, 0.2]]}, "horizon": 1.0})
    with pytest.raises(TheoryError, match="follows the state"):
        expected_squares(unstable, netkf.simulate(unstable))
