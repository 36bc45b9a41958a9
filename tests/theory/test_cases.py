"""The reference cases: covariances, exact error covariances, bounds and limits."""

import numpy as np
import pytest

import netkf
from netkf import theory
from tests.cases import hybrid_cases, hybrid_scenario

CASES = hybrid_cases()


def close(got, expected, tolerance):
    expected = np.asarray(expected)
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    assert got.shape == expected.shape
    assert (np.abs(got - expected) <= tolerance * size).all()


@pytest.mark.parametrize("case", CASES, ids=lambda c: c["name"])
def test_replay(case, tmp_path):
    scenario = hybrid_scenario(case, tmp_path, recorded=True)
    run = netkf.simulate(scenario)
    expected = case["expected"]
    close(run.P, expected["P"], 1e-11)
    exact = theory.error_covariance(scenario, run)
    close(exact, expected["Sigma_ii"], 1e-10)
    if "Sigma" in expected:
        close(theory.error_covariance(scenario, run, stacked=True), expected["Sigma"], 1e-10)
    # H (10), given the events
    gap = run.P - exact
    least = np.linalg.eigvalsh(gap)[..., 0] / np.abs(run.P).max(axis=(-1, -2))
    assert least.min() >= -1e-12


@pytest.mark.parametrize("case", CASES, ids=lambda c: c["name"])
def test_bounds_and_limits(case, tmp_path):
    scenario = hybrid_scenario(case, tmp_path, recorded=False)
    expected = case["expected"]
    close(theory.covariance_bound(scenario, case["input"]["times"]), expected["bound"], 1e-8)
    close(theory.steady_covariance_bound(scenario), expected["bound_steady"], 1e-11)
    close(theory.limit_covariance(scenario), expected["S"], 1e-11)
    close(theory.true_limit_covariance(scenario), expected["true_limit"], 1e-11)
    close(theory.central_covariance(scenario), expected["centralized"], 1e-11)


def test_a_reset_of_one_after_the_other_is_another_filter(tmp_path):
    """The case with ties is sharp: sequential resets miss it by far."""
    case = next(c for c in CASES if "ties" in c["name"])
    scenario = hybrid_scenario(case, tmp_path, recorded=True)
    (tmp_path / "apart.csv").write_text(
        "t,node,peer\n"
        + "\n".join(
            f"{t + 1e-7 * k!r},{int(i)},{int(j)}"
            for k, (t, i, j) in enumerate(case["input"]["events"])
        )
    )
    apart = scenario.replace({"network.activation.path": "apart.csv"})
    difference = np.abs(netkf.simulate(apart).P - netkf.simulate(scenario).P).max()
    assert difference > 0.01
