"""What is said about P's assumptions, and what ``netkf theory`` shows of push-sum."""

import json

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf import theory
from netkf.cli.main import main
from netkf.scenario.writing import resolve_defaults, to_toml
from netkf.theory.promises import compute_promises, promises_text
from tests.theory.push_sum_systems import RHO_T1, planar, scenario


def holds(made):
    table = theory.assumptions(made)
    assert all(table["evidence"])
    return dict(zip(table["assumption"], table["holds"], strict=True))


GOOD = {"gamma": 2, "delivery": 0.7, "delta": 1.01 * RHO_T1}


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("changes", "failing"),
    [
        ({}, {"gamma is certified for the mean", "gamma is certified for the mean square"}),
        ({"gamma": 1260}, {"gamma is certified for the mean square"}),
        ({"gamma": 1412}, set()),
        (
            {"gamma": 1412, "delta": 4.01},
            {
                "delta > rho(L)",
                "gamma is certified for the mean",
                "gamma is certified for the mean square",
            },
        ),
        ({"gamma": 1412, "stop": "paper"}, {"no gain is frozen before its time"}),
        ({"gamma": 1412, "stop": "paper", "delivery": 1.0}, set()),
        ({"gamma": 1412, "stop": "paper", "asymptotic": True}, set()),
        ({"gamma": 1412, "stop": "safe"}, set()),
        (
            {"links": "held"},
            {
                "links fail anew in each averaging step",
                "gamma is certified for the mean",
                "gamma is certified for the mean square",
            },
        ),
        (
            {"symmetric": False},
            {
                "both directions of a link fail together",
                "p_d < 1: the network is whole at times",
                "gamma is certified for the mean",
                "gamma is certified for the mean square",
            },
        ),
        (
            {"gamma": 1},
            {
                "the estimates become unbiased",
                "the errors stay bounded in the mean square",
                "gamma is certified for the mean",
                "gamma is certified for the mean square",
            },
        ),
    ],
    ids=lambda value: str(sorted(value)),
)
def test_what_fails_and_nothing_else(changes, failing):
    found = holds(planar(**(GOOD | changes)))
    assert {name for name, held in found.items() if not held} == failing
    assert len(found) == 14


def test_observability_and_controllability_are_of_the_whole():
    def made(H, Q):
        F = [[0.9, 0.0], [0.0, 0.8]]
        return scenario([[0, 1], [1, 2]], F, Q, {0: [H]}, {0: [[1.0]]}, 1, 4.0, 0.9)

    seen, driven = "(F, H) is observable, all sensors together", "(F, Q^1/2) is controllable"
    whole = holds(made([1.0, 1.0], [[1.0, 0.0], [0.0, 1.0]]))
    assert whole[seen]
    assert whole[driven]
    partly = holds(made([1.0, 0.0], [[0.0, 0.0], [0.0, 1.0]]))
    assert not partly[seen]
    assert not partly[driven]


def test_the_central_covariance_of_slots_is_that_after_the_reading():
    made = planar(2, 0.7)
    H = np.concatenate([made.observation_matrices(node)[0] for node in (4, 9)])
    F, Q, R = made.plant.F, made.plant.Q, 0.01 * np.eye(2)
    P = scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)
    after = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
    np.testing.assert_allclose(theory.central_covariance(made), after, rtol=1e-7, atol=1e-12)
    # a wrong belief moves the limit of the filters, not the central covariance
    wrong = made.replace({"filter.model": {"R": [[0.04]]}})
    np.testing.assert_array_equal(theory.central_covariance(wrong), theory.central_covariance(made))
    assert np.trace(theory.push_sum_limits(wrong).P) > 1.2 * np.trace(after)
    errors = [np.trace(P) for P in theory.push_sum_error_covariance(wrong)]
    assert min(errors) > np.trace(after)


@pytest.mark.slow
def test_netkf_theory_shows_both_kinds_of_gamma(tmp_path, capsys):
    path = tmp_path / "planar.toml"
    path.write_text(to_toml(resolve_defaults(planar(2, 0.7, delta=1.01 * RHO_T1))))
    assert main(["theory", str(path), "--json"]) == 0
    whole = json.loads(capsys.readouterr().out)
    found = whole["push_sum"]
    values = {name: found[name]["value"] for name in found}
    assert values["minimum_gamma_mean"] == 1260
    assert values["minimum_gamma_mean_square"] == 1412
    assert values["exact_minimum_gamma"] == 2
    assert values["limit_trace"] == pytest.approx(0.0124391671, abs=1e-10)
    assert values["central_trace"] == pytest.approx(values["limit_trace"], rel=1e-10)
    assert values["disconnection_probability"] == pytest.approx([0.248257] * 2, abs=1e-6)
    assert len(values["error_traces"]) == 10
    # What the command prints without --json, of the same values.
    text = promises_text(netkf.load(path), whole)
    assert "times the central one" in text
    assert "1412" in text


@pytest.mark.slow
def test_what_does_not_exist_has_a_reason():
    found = compute_promises(planar(1, 0.5))["push_sum"]
    assert found["error_traces"]["value"] is None
    assert "not below 1" in found["error_traces"]["reason"]
    assert "rho(L)" in found["minimum_gamma_mean"]["reason"]
