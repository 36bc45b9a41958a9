"""The random Riccati equation against independent values in 60-digit arithmetic."""

import json
import warnings

import numpy as np
import pytest

import netkf
from netkf import theory
from tests.cases import FOLDER
from tests.conftest import SCENARIOS

CASES = json.loads((FOLDER / "intermittent.json").read_text())
SCALAR = ([[2.0**0.5]], [[1.0]], [[1.0]], [[1.0]])


@pytest.mark.parametrize("case", CASES["cases"], ids=lambda c: c["id"])
def test_recorded_arrivals(case):
    F, Q, H, R = (case[name] for name in "AQCR")
    P = np.array(case["P0"])
    for gamma, expected in zip(case["gammas"], case["P"][1:], strict=True):
        step = theory.riccati_step(P, F, Q, H, R) if gamma else theory.lyapunov_step(P, F, Q)
        np.testing.assert_allclose(step, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())
        P = step


@pytest.mark.parametrize("name", CASES["steady"])
def test_steady_covariance(name):
    case = CASES["steady"][name]
    P = theory.steady_covariance(*(case[k] for k in "AQCR"))
    np.testing.assert_allclose(P, case["Pstar"], rtol=0, atol=1e-11 * np.abs(case["Pstar"]).max())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(20))
def test_without_noise_a_stable_state_is_known_in_the_end(seed):
    random = np.random.default_rng(seed)
    n = 2 + seed % 2
    F, H = np.triu(random.normal(size=(n, n)), 1), random.normal(size=(2, n))
    assert not theory.steady_covariance(F + 0.6 * np.eye(n), 0.0 * F, H, np.eye(2)).any()
    # All of a nilpotent F is forgotten after n slots.
    assert theory.critical_probability(F, H) == (0.0, 0.0)


def test_a_rotation_without_noise_has_no_stabilising_fixed_point():
    turn = np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(netkf.TheoryError, match="does not stabilise the filter"):
            theory.steady_covariance(turn, np.zeros((2, 2)), [[1.0, 0.0]], [[0.1]])


@pytest.mark.parametrize("name", CASES["critical"])
def test_critical_probability_with_its_certificates(name):
    case, system = CASES["critical"][name], CASES["steady"][name]
    F, H = np.array(system["A"]), np.array(system["C"])
    found = theory.critical_certificate(F, H)
    assert theory.critical_probability(F, H) == (found.lower, found.upper)
    assert found.lower <= found.upper
    assert found.lower == pytest.approx(case["lower_31"], abs=1e-12)
    assert found.upper == pytest.approx(case["upper_closed_form"] or case["upper_32"], abs=1e-10)
    # the gain proves the bound from above
    g, closed = min(1.0, found.upper + 1e-6), F + found.gain @ H
    mean = (1 - g) * np.kron(F, F) + g * np.kron(closed, closed)
    assert np.abs(np.linalg.eigvals(mean)).max() < 1.0
    # the Perron matrix proves it from below: even the best gain for it does not shrink it
    g, X = found.upper - 1e-6, found.perron
    best = F @ X @ F.T - g * F @ X @ H.T @ np.linalg.pinv(H @ X @ H.T) @ H @ X @ F.T
    assert np.linalg.eigvalsh(X).min() >= -1e-9 * np.abs(X).max()
    assert np.linalg.eigvalsh(best - X).min() >= -1e-7 * np.abs(X).max()


def test_two_decoupled_plants_are_as_critical_as_the_worse():
    """A Perron matrix that lives on one block must not spoil the gain of the other."""
    one, other = [[1.25, 0.0], [1.0, 1.1]], [[2.0**0.5]]
    F = np.zeros((3, 3))
    F[:2, :2], F[2:, 2:] = one, other
    H = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    alone = [
        theory.critical_probability(one, [[1.0, 1.0]]),
        theory.critical_probability(other, [[1.0]]),
    ]
    both = theory.critical_probability(F, H)
    # the readings arrive together, so the bound is the larger of the two
    assert both[1] == pytest.approx(max(upper for _, upper in alone), abs=1e-9)


@pytest.mark.parametrize("mode", np.linspace(1.0, 3.0, 30).tolist())
def test_the_bounds_on_the_critical_probability_of_one_mode_are_in_order(mode):
    lower, upper = theory.critical_probability([[mode]], [[1.0]])
    assert lower <= upper == pytest.approx(1.0 - mode**-2, abs=1e-15)


def test_critical_probability_of_a_system_as_large_as_numbers_go():
    lower, upper = theory.critical_probability([[2.0**0.5 * 1e20]], [[1e20]])
    assert lower == upper == 1.0


def test_lower_bound_is_not_sufficient():
    lower, upper = theory.critical_probability(np.diag([2.0**0.5, -(2.0**0.5)]), [[1.0, 1.0]])
    assert lower == pytest.approx(0.5, abs=1e-12)
    assert upper == pytest.approx(0.75, abs=1e-9)


def test_readings_over_several_links_count_by_the_sets_that_arrive(tmp_path):
    """Two scalar sensors at 0.3 each: nothing comes with probability 0.49, and 0.49 F^2 < 1, though
    neither link alone reaches the critical 0.5. Two modes seen by one sensor each: the worse one.
    """
    from netkf.theory.intermittent.riccati import contraction_radius

    F, one, none = np.array([[2.0**0.5]]), np.ones((1, 1)), np.zeros((0, 1))
    sets = [(0.49, none), (0.21, one), (0.21, one), (0.09, np.ones((2, 1)))]
    assert contraction_radius(F, sets) == pytest.approx(0.98)
    modes, a, b = np.diag([1.2, 1.5]), np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])
    sets = [(0.08, a[:0]), (0.32, b), (0.12, a), (0.48, np.eye(2))]  # a at 0.6, b at 0.8
    assert contraction_radius(modes, sets) == pytest.approx(max(0.4 * 1.44, 0.2 * 2.25))
    scenario = netkf.load(SCENARIOS / "intermittent_scalar.toml").replace(
        {
            "network.graph": {"kind": "edges", "edges": [[0, 1], [1, 2]]},
            "sensors.0.nodes": [0, 2],
            "network.channel.loss.delivery": 0.3,
        }
    )
    row = theory.assumptions(scenario).set_index("source").loc["R (32)"]
    assert row.holds
    assert "0.98 a slot" in row.evidence


def test_a_step_survives_covariances_beyond_double_rounding():
    """f_1 of 1e14 and 1e20 times a full matrix, against the limit that forgets P."""
    F = np.array([[1.2, 0.4], [0.0, 1.1]])
    Q, H, R = np.eye(2), np.eye(2), np.eye(2)
    limit = F @ F.T + Q  # f_1(P) -> F (H^-1 R H^-T) F' + Q as P grows
    shape = np.array([[2.0, 1.0], [1.0, 1.0]])
    for size in (1e14, 1e20):
        np.testing.assert_allclose(theory.riccati_step(size * shape, F, Q, H, R), limit, rtol=1e-12)


def test_support_of_the_scalar_example():
    """R Proposition 24 with the holes: no point between what f_1 and f_0 can reach."""
    points = theory.support(*SCALAR, depth=12)[:, 0, 0]
    assert points.shape == (4096,)
    listed = {row["word"]: row["value"] for row in CASES["scalar_support_first_64"]}
    for word, value in listed.items():
        if len(word) <= 12:
            k = int((word + "1" * (12 - len(word))) or "0", 2)
            assert points[k] == pytest.approx(value, rel=1e-12)
    star = 1.0 + 2.0**0.5
    assert points.min() == pytest.approx(star, rel=1e-12)
    inside = (points > 3.0 + 1e-9) & (points < 2.0 * star + 1.0 - 1e-9)
    assert not inside.any()
    deeper = theory.support(*SCALAR, depth=13)[:, 0, 0]
    assert np.isclose(points[:, None], deeper[None, :], rtol=1e-12).any(axis=1).all()


@pytest.mark.parametrize("delivery", [0.6, 0.9])
def test_invariant_samples_have_the_exact_law_of_the_scalar_example(delivery):
    """Derived: P(P > 2^(n+2) - 1) = (1 - g)^(n+1); five binomial tests at level 1e-4 each."""
    scipy_stats = pytest.importorskip("scipy.stats")
    P = theory.invariant_samples(*SCALAR, delivery=delivery, samples=20000, seed=3)[:, 0, 0]
    for n in range(5):
        above, chance = int((2.0 ** (n + 2) - 1.0 < P).sum()), (1.0 - delivery) ** (n + 1)
        assert scipy_stats.binomtest(above, len(P), chance).pvalue > 1e-4
    wrong = (1.0 - delivery + 0.03) ** 2
    above = int((P > 7.0).sum())
    assert scipy_stats.binomtest(above, len(P), wrong).pvalue < 1e-4
    again = theory.invariant_samples(*SCALAR, delivery=delivery, samples=20000, seed=3)
    np.testing.assert_array_equal(P, again[:, 0, 0])


@pytest.mark.slow
def test_a_single_draw_has_the_invariant_law_too():
    """Stopping at the first meeting would prefer draws with recent arrivals; 2000 seeds."""
    scipy_stats = pytest.importorskip("scipy.stats")
    P = [theory.invariant_samples(*SCALAR, 0.75, samples=1, seed=s)[0, 0, 0] for s in range(2000)]
    for n in range(4):
        above = int((2.0 ** (n + 2) - 1.0 < np.array(P)).sum())
        assert scipy_stats.binomtest(above, len(P), 0.25 ** (n + 1)).pvalue > 1e-4


def test_what_does_not_exist_is_refused():
    with pytest.raises(netkf.TheoryError, match=r"not detectable: the mode with eigenvalue 2"):
        theory.steady_covariance([[2.0]], [[1.0]], [[0.0]], [[1.0]])
    with pytest.raises(netkf.TheoryError, match="is never seen"):
        theory.critical_probability([[2.0]], [[0.0]])
    with pytest.raises(netkf.TheoryError, match="depth must be"):
        theory.support(*SCALAR, depth=-1)
    with pytest.raises(netkf.TheoryError, match="delivery must lie"):
        theory.invariant_samples(*SCALAR, delivery=0.0, samples=1, seed=0)
    with pytest.raises(netkf.TheoryError, match="H must be a finite matrix of 1 columns"):
        theory.riccati_step([[1.0]], [[1.0]], [[1.0]], [[1.0, 0.0]], [[1.0]])


@pytest.mark.parametrize("delivery", [0.5, 0.6, 0.75, 0.9])
def test_exact_scalar_law(delivery):
    law = theory.scalar_law(*SCALAR, delivery)
    holes = 2.0 ** np.arange(2, 8) - 1.0
    above = (1.0 - delivery) ** np.arange(1, 7)
    np.testing.assert_allclose(1.0 - law.cdf(holes), above, rtol=0, atol=1e-15)
    # backwards in x: near P* a rounding error of x holds much of the mass, so not in u
    points = theory.support(*SCALAR, depth=6)[:, 0, 0]
    levels = law.cdf(points * (1.0 + 1e-12))
    kept = levels < 1.0 - 1e-6
    np.testing.assert_allclose(law.quantile(levels[kept]), points[kept], rtol=1e-4)
    assert law.cdf(law.least - 1e-9) == 0.0
    low, high = law.hole
    assert law.cdf((low + high) / 2) == pytest.approx(delivery)
    means = {0.5: np.inf, 0.6: 9.739843, 0.75: 4.266367, 0.9: 2.881815}
    assert law.mean() == pytest.approx(means[delivery], rel=1e-6)


def test_the_scalar_law_of_any_system_lies_between_all_paths():
    """From P* and from infinity, by sixteen slots with or without a reading; no number is 1."""
    F, Q, H, R, g = -1.5, 0.6, -2.0, 0.5, 0.9
    law = theory.scalar_law(F, Q, H, R, g)
    low, high, weight = np.array([law.least]), np.array([1e300]), np.ones(1)
    assert law.least == pytest.approx(F**2 / (1.0 / law.least + H**2 / R) + Q)
    for _ in range(16):
        low, high = (
            np.concatenate([F**2 * P + Q, F**2 / (1.0 / P + H**2 / R) + Q]) for P in (low, high)
        )
        weight = np.concatenate([(1.0 - g) * weight, g * weight])
    x = np.random.default_rng(5).choice(low, 400) * 1.001
    most, least = (np.array([weight[one >= P].sum() for one in x]) for P in (low, high))
    assert (least - 1e-12 <= law.cdf(x)).all()
    assert (law.cdf(x) <= most + 1e-12).all()
    assert (most - least).max() < 1e-2
    np.testing.assert_allclose(law.cdf_after(x, 16, law.least), most, rtol=0, atol=1e-12)
    assert law.mean() == pytest.approx(weight @ low, rel=1e-6)
    order, levels = np.argsort(low), np.array([0.05, 0.3, 0.91, 0.95, 0.992])
    places = order[np.searchsorted(np.cumsum(weight[order]), levels)]
    np.testing.assert_allclose(law.quantile(levels), low[places], rtol=1e-6)


@pytest.mark.parametrize("level", CASES["scalar_law"])
def test_quantiles_of_the_scalar_law(level):
    law = theory.scalar_law(*SCALAR, float(level))
    for row in CASES["scalar_law"][level]["quantiles"]:
        got = float(law.quantile(row["u"]))
        sides = row["exact_left"], row["exact_right"]
        assert min(sides) * (1 - 1e-9) <= got <= max(sides) * (1 + 1e-9), row


def test_samples_and_exact_law_agree(monkeypatch):
    """Kolmogorov-Smirnov at level 1e-4; a law of the wrong delivery is told apart."""
    monkeypatch.setattr("netkf.theory.intermittent.riccati.MAX_SAMPLES_AT_ONCE", 3000)
    scipy_stats = pytest.importorskip("scipy.stats")
    P = theory.invariant_samples(*SCALAR, delivery=0.75, samples=4000, seed=8)[:, 0, 0]
    P = np.round(P, 9)
    right, wrong = (theory.scalar_law(*SCALAR, g) for g in (0.75, 0.72))
    assert scipy_stats.kstest(P, lambda x: right.cdf(x + 1e-9)).pvalue > 1e-4
    assert scipy_stats.kstest(P, lambda x: wrong.cdf(x + 1e-9)).pvalue < 1e-4
    with pytest.raises(netkf.TheoryError, match="images of f_0 and f_1 meet"):
        theory.scalar_law(1.05, 1.0, 1.0, 100.0, 0.5)


@pytest.mark.parametrize("unit", [1e-8, 1e7])
def test_critical_probability_does_not_depend_on_units_of_outputs_or_states(unit):
    """With an invertible H both bounds are 1 - 1/alpha^2, small rows and columns included."""
    F = np.array([[1.5, 0.3], [0.0, 1.2]])
    moved = np.diag([1.0, unit]) @ F @ np.diag([1.0, 1.0 / unit])
    expected = [1.0 - 1.0 / 1.5**2] * 2
    for case in ((F, [[1, 0], [0, unit]]), (moved, [[1, 1 / unit], [1, -1 / unit]])):
        np.testing.assert_allclose(theory.critical_probability(*case), expected, rtol=1e-9)
    F3, H = np.diag([1.5, 1.2, 1.1]), np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    proof = theory.critical_certificate(F3, H * [[1.0], [unit]])
    closed, g = F3 + proof.gain @ (H * [[1.0], [unit]]), proof.upper + 1e-6
    mean_square = (1 - g) * np.kron(F3, F3) + g * np.kron(closed, closed)
    assert np.abs(np.linalg.eigvals(mean_square)).max() < 1.0


def test_arguments_of_a_wrong_kind_are_refused_with_one_line():
    """A number where a list is meant, text, lists of unequal length, complex, None, masked, dates,
    which numpy counts in days, and numbers as text.
    """
    hybrid = netkf.load(SCENARIOS / "poisson_ring.toml")
    push_sum = netkf.load(SCENARIOS / "push_sum_planar.toml")
    eye = np.eye(2)
    masked = np.ma.masked_array(eye, mask=[[1, 0], [0, 0]])
    takes_number = {
        "delivery": lambda x: theory.invariant_samples(*SCALAR, x, 2, 1),
        "scalar": lambda x: theory.scalar_law(*SCALAR, x),
        "gap": lambda x: theory.riccati_flow(eye, eye, eye, eye, x),
        "rate": lambda x: theory.link_rate_for(hybrid, x),
        "most": lambda x: theory.exact_minimum_gamma(push_sum, most=x),
        "seed": lambda x: theory.disconnection_probability([(0, 1)], 0.5, seed=x),
    }
    takes_list = {
        "times": lambda x: theory.covariance_bound(hybrid, x),
        "constant": lambda x: theory.constant_gain_bound(hybrid, x or "no"),
        "gains": lambda x: theory.constant_gain_bound(hybrid, [1.0], x or 1),
        "map": lambda x: theory.push_sum_stability(push_sum, x, [0.9]),
        "deliveries": lambda x: theory.push_sum_stability(push_sum, [1], x),
        "noise": lambda x: theory.push_sum_noise(push_sum, x),
        "covariances": lambda x: theory.push_sum_covariances(push_sum, x),
        "up": lambda x: theory.mass_totals(push_sum, x),
        "graph": lambda x: theory.disconnection_probability(x, 0.5),
        "topology": theory.consensus_gain_bound,
        "P": lambda x: theory.one_bit_update(x, [[1.0, 0.0]], 1.0),
        "trigger": lambda x: theory.trigger_rate(x, [[1.0, 0.0]], 1.0, 1.0),
        "scalar F": lambda x: theory.scalar_law(x, 1.0, 1.0, 1.0, 0.5),
    }
    calls = [(f, x) for f in takes_number.values() for x in ([0.5, 0.6], "text", None, 1j)]
    odd = ("2", np.datetime64(1, "D"), np.timedelta64(1, "D"), np.eye(2).astype(str))
    calls += [(f, x) for f in takes_number.values() for x in odd]
    calls += [(f, x) for f in takes_list.values() for x in ("text", None, 1j, [1, [2, 3]])]
    for value in (masked, eye.astype("m8[D]"), eye.astype(str), [["1", 0], [0, 1]]):
        calls.append((lambda x: theory.lyapunov_step(eye, x, eye), value))
    for value in (np.empty((0, 0)), 1e200 * eye):
        calls.append((lambda x: theory.lyapunov_step(x, x, x), value))
        calls.append((lambda x: theory.riccati_flow(x, x, x, x, 1.0), value))
        calls.append((lambda x: theory.critical_probability(x, x), value))
        calls.append((lambda x: theory.steady_covariance(x, x, x, x), value))
    for call, value in calls:
        with pytest.raises(netkf.TheoryError) as caught:
            call(value)
        assert "\n" not in str(caught.value)
