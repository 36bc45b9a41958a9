"""What P Theorems 5 and 6 certify against independent values, and against the exact radius."""

import json

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf import theory
from netkf.theory.push_sum import certified_gamma
from tests.cases import FOLDER
from tests.theory.push_sum_systems import RHO_T1, of_case, planar, scenario

CASES = json.loads((FOLDER / "push_sum.json").read_text())["bounds"]
ROWS = [(case, row) for case in CASES for row in case["rows"]]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_reference_constants(case):
    found = theory.gamma_constants(of_case(case, 1, case["rows"][0]["p"]))
    expected = case["constants"]
    assert found.contraction == pytest.approx(expected["lam"], rel=1e-9)
    assert found.printed == pytest.approx(expected["cB"], rel=1e-9)
    assert found.sharp == pytest.approx(expected["cB_exact"], rel=1e-9)


@pytest.mark.parametrize(("case", "row"), ROWS, ids=lambda x: x.get("name") or str(x["p"]))
def test_reference_bounds(case, row):
    made = of_case(case, 1, row["p"])
    constants = theory.gamma_constants(made)
    assert constants.mean == pytest.approx(row["theta_p"], rel=1e-12)
    assert constants.mean_square == pytest.approx(row["theta_pd"], rel=1e-12)
    for key, sharp in (("printed", False), ("exact", True)):
        expected = row[key]
        five = theory.minimum_gamma(made, "mean", sharp=sharp)
        six = theory.minimum_gamma(made, "mean-square", sharp=sharp)
        assert (five, six) == (expected["theorem5"], expected["theorem6"])
        bound = constants.sharp if sharp else constants.printed
        assert certified_gamma.theorem_5(constants, bound, five) == pytest.approx(
            expected["rho_AR_at"], rel=1e-8
        )
        assert certified_gamma.theorem_6(constants, bound, six) == pytest.approx(
            expected["rho_AS_at"], rel=1e-8
        )
    assert theory.exact_minimum_gamma(made, "mean") == row["exact_first_gamma_mean"]
    assert theory.exact_minimum_gamma(made) == row["exact_first_gamma_ms"]


@pytest.mark.parametrize(
    ("delivery", "five", "six", "exact"),
    [(1.0, 881, 881, 1), (0.9, 980, 982, 2), (0.7, 1260, 1412, 2), (0.5, 1765, 5643, 3)],
)
def test_the_theorems_are_orders_too_large(delivery, five, six, exact):
    made = planar(1, delivery, delta=1.01 * RHO_T1)
    assert theory.minimum_gamma(made) == five
    assert theory.minimum_gamma(made, "mean-square") == six
    assert theory.exact_minimum_gamma(made) == exact


def test_a_printed_constant_that_is_too_small_is_not_used():
    """Where (37) lies below max |A_i'|_P, the gamma it would give is not certified."""
    made = scenario(
        [[0, 1], [1, 2]],
        [[-0.3, 0.2], [-0.5, -0.4]],
        [[0.01, 0.0], [0.0, 0.001]],
        {0: [[0.7, -0.3]]},
        {0: [[10.0]]},
        1,
        3.5,
        0.7,
    )
    constants = theory.gamma_constants(made)
    P = theory.push_sum_limits(made).P
    root = np.linalg.cholesky(P)
    F = made.plant.F
    K = theory.push_sum_limits(made).gains[0]
    norms = [
        np.linalg.norm(np.linalg.solve(root, A @ root), 2)  # |A'|_P with P = root root'
        for A in (F, F - K @ np.array([[0.7, -0.3]]) @ F)
    ]
    assert constants.sharp == pytest.approx(max(norms), rel=1e-10)
    assert constants.printed < constants.sharp
    assert theory.minimum_gamma(made) == theory.minimum_gamma(made, sharp=True)


def test_norms_of_p_35():
    random = np.random.default_rng(1)
    A, S = random.standard_normal((2, 3, 3))
    P = S @ S.T + np.eye(3)
    root = scipy.linalg.sqrtm(P).real
    plain = np.linalg.norm(root @ A @ np.linalg.inv(root), 2)
    assert certified_gamma._weighted_norm(A, P) == pytest.approx(plain, rel=1e-10)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: planar(1, 0.7), r"rho\(L\) = 6.68"),
        (lambda: planar(1, 0.7, delta=7.0, links="held"), "fresh"),
        (lambda: planar(2, 0.7, delta=7.0, symmetric=False), "both directions"),
        (lambda: planar(2, 0.0, delta=7.0), "no gamma up to"),
    ],
)
def test_where_the_theorems_say_nothing(made, words):
    with pytest.raises(netkf.TheoryError, match=words):
        theory.minimum_gamma(made())


def test_no_gamma_helps_without_links_and_moments_have_names():
    made = planar(1, 0.0, delta=7.0)
    with pytest.raises(netkf.TheoryError, match="no gamma up to 3"):
        theory.exact_minimum_gamma(made, most=3)
    with pytest.raises(netkf.TheoryError, match="moment"):
        theory.minimum_gamma(planar(1, 0.7, delta=7.0), "median")
