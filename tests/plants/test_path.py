"""The plant's path and the sensors' noise against the laws that they are drawn from."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg

from netkf.plants import linear, paths
from netkf.plants.diffusion import Diffusion, default_sensing_period
from netkf.plants.laws import GridLaws
from netkf.plants.sensors import LinearSensor
from tests.engines.linearity import Unit

A = np.array([[0.0, 1.0], [-2.0, 0.3]])
B = np.array([[0.0], [1.5]])
COV = np.array([[2.0, 0.5], [0.5, 1.0]])


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    monkeypatch.setattr(paths, "BLOCK", 1)
    monkeypatch.setattr(linear, "BLOCK", 1)


def plant(**changes):
    given = {"A": A, "B": B, "mean": [0.0, 0.0], "cov": COV, "sensing_period": 0.2}
    return Diffusion(**{**given, **changes})


def covariance_of(compute, streams):
    """Exact covariance of a linear map of normal draws, column by column."""
    units = [Unit() for _ in range(streams)]
    compute(*units)
    columns = []
    for k, unit in enumerate(units):
        for place in range(unit.count):
            chosen = [Unit(place if j == k else None) for j in range(streams)]
            columns.append(compute(*chosen))
    L = np.array(columns).T
    return L @ L.T


def exact_joint(times):
    """Covariance of x at several times: e^At COV e^A't and the integral of the noise (Van Loan)."""
    expm = scipy.linalg.expm

    def at(t):
        E = expm(np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]) * t)
        return expm(A * t) @ COV @ expm(A * t).T + E[2:, 2:].T @ E[:2, 2:]

    return np.block(
        [
            [expm(A * max(t - s, 0.0)) @ at(min(s, t)) @ expm(A * max(s - t, 0.0)).T for s in times]
            for t in times
        ]
    )


@pytest.mark.parametrize("times", [[0.0, 0.2, 0.4, 1.0], [0.13, 0.17, 0.2, 0.55, 0.81]])
def test_states_have_their_exact_joint_law_on_and_off_the_grid(times):
    def compute(random, probing):
        path = plant().path(random, probing, np.array(times))
        return np.concatenate([path.state(t) for t in times])

    np.testing.assert_allclose(covariance_of(compute, 2), exact_joint(times), rtol=0, atol=2e-9)


@pytest.mark.parametrize("n", [2, 3])
def test_no_draw_hangs_on_rounding(n):
    """Covariances of states and moments are singular, as the integral of a speed is a distance:
    roots of such may turn round at a touch, what is drawn by them must not.
    """
    A, B = np.eye(n, k=1) - 0.1 * np.eye(n, k=-1), np.eye(n)[:, n - 1 :]
    plain = GridLaws(A, B, 0.2)
    gain, spread = plain.conditional_law(0.2, 0.1)
    random = np.random.default_rng(1)
    for _ in range(20):
        laws = GridLaws(A * (1.0 + 1e-14 * random.standard_normal(A.shape)), B, 0.2)
        others = laws.conditional_law(0.6000000000000001 - 0.4, 0.1)
        np.testing.assert_allclose(others[0], gain, rtol=1e-6, atol=1e-6 * np.abs(gain).max())
        np.testing.assert_allclose(others[1], spread, rtol=0.0, atol=1e-7)
        np.testing.assert_allclose(laws.noise_factor, plain.noise_factor, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("left", [0.0, 1e-13, 0.2 - 1e-13, 0.2])
def test_a_state_at_an_end_of_a_step_is_that_of_the_end(left):
    """Times of clocks fall on the sensing grid up to rounding."""
    A, B = np.array([[-0.3, 0.5], [-0.6, 0.1]]), np.array([[0.8, 0.0], [0.1, 0.5]])
    gain, spread = GridLaws(A, B, 0.2).conditional_law(0.2, left)
    ends = np.eye(6) if left > 0.1 else np.zeros((6, 6))
    np.testing.assert_allclose(gain, ends, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(spread, 0.0, rtol=0.0, atol=1e-6)


def test_the_grid_does_not_depend_on_what_is_shown():
    seeds = lambda: (np.random.default_rng(1), np.random.default_rng(2))  # noqa: E731
    one = plant().path(*seeds(), np.array([0.4, 0.8]))
    other = plant().path(*seeds(), np.array([0.05, 0.31, 0.4, 0.47, 0.8]))
    for t in (0.4, 0.8):
        np.testing.assert_array_equal(one.state(t), other.state(t))


@pytest.mark.parametrize(
    ("cut", "start", "end"), [([], 0.2, 0.4), ([0.3], 0.2, 0.3), ([0.3], 0.3, 0.4)]
)
def test_moments_of_the_parts_of_a_piece_add_up(cut, start, end):
    path = plant().path(np.random.default_rng(0), np.random.default_rng(1), np.array(cut))
    path.state(start)
    whole, length = path.moments(start, end), end - start
    cuts = [start, start + 0.15 * length, start + 0.55 * length, end]
    parts = [path.moments(a, b) for a, b in pairwise(cuts)]
    np.testing.assert_allclose(sum(p[0] for p in parts), whole[0], rtol=1e-11)
    # P_1 of the whole on a part [a, b] is middle + share P_1 of the part
    tilted = sum(
        (a + b - start - end) / length * p[0] + (b - a) / length * p[1]
        for a, b, p in zip(cuts[:-1], cuts[1:], parts, strict=True)
    )
    np.testing.assert_allclose(tilted, whole[1], rtol=0, atol=1e-14)


def test_a_plant_without_noise_follows_its_equation():
    quiet = plant(B=[[0.0], [0.0]], cov=np.zeros((2, 2)), mean=[1.0, -1.0])
    path = quiet.path(np.random.default_rng(0), np.random.default_rng(1), np.array([0.77, 3.0]))
    for t in (0.77, 3.0):
        np.testing.assert_allclose(path.state(t), scipy.linalg.expm(A * t) @ [1.0, -1.0], rtol=1e-9)


@pytest.mark.parametrize("cuts", [[0.2], [0.05, 0.2], [0.01, 0.06, 0.19, 0.2]])
def test_cuts_of_a_reading_are_independent_white_noise(cuts):
    """Moments of the parts of a step: independent, variances g R and g R / 3 (derived)."""
    R = np.array([[0.5, 0.2], [0.2, 0.4]])
    sensor = LinearSensor((0,), np.zeros((2, 2)), R)

    def compute(random, cutting):
        truth = plant().path(np.random.default_rng(0), np.random.default_rng(1), np.array([]))
        path, start, parts = sensor.path(random, cutting), 0.0, []
        for end in cuts:
            seen = truth.moments(start, end)
            parts.append(path.moments(truth, seen, start, end).reshape(-1))
            start = end
        return np.concatenate(parts)

    gaps = np.diff([0.0, *cuts])
    blocks = [scipy.linalg.block_diag(g * R, g / 3.0 * R) for g in gaps]
    expected = scipy.linalg.block_diag(*blocks)
    np.testing.assert_allclose(covariance_of(compute, 2), expected, rtol=0, atol=1e-12)


def test_default_period_follows_the_fastest_time_constant():
    G = [np.diag([4.0, 0.0])]
    slow, fast = (
        default_sensing_period(plant(A=A * s, B=B * np.sqrt(s)), [g * s for g in G], np.inf)
        for s in (1.0, 10.0)
    )
    assert slow == pytest.approx(10.0 * fast)
    # 1, 2 or 5 times a power of ten
    assert f"{slow:e}"[0] in "125"


@pytest.mark.one_in(3)
@pytest.mark.parametrize("n", [1, 4, 16])
@pytest.mark.parametrize(("since", "gap"), [(0.0, 0.13), (0.05, 0.15), (0.07, 0.02), (0.1, 1e-5)])
def test_moments_of_a_part_are_those_of_response_and_cubic(n, since, gap):
    random = np.random.default_rng(n)
    A = random.standard_normal((n, n)) / np.sqrt(n)
    x, cubic = random.standard_normal(n), random.standard_normal((3, n))
    step = paths.PathStep(0.0, 0.2, x, np.zeros(n), np.zeros((2, n)), cubic)
    got = paths.state_moments(GridLaws(A, np.eye(n), 0.2), step, since, since + gap)
    # Gauss' rule is exact for polynomials of this degree, and the rest of exp(A s) is rounding.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    times = since + 0.5 * gap * (1.0 + nodes)
    course = np.array([scipy.linalg.expm(A * s) @ x for s in times])
    u = times[:, None] / 0.2
    course += (u * cubic[0] + u**2 * cubic[1] + u**3 * cubic[2]) / 0.2
    wanted = 0.5 * gap * np.array([weights @ course, (weights * nodes) @ course])
    np.testing.assert_allclose(got[0], wanted[0], rtol=1e-10, atol=1e-16)
    # Beside noise of sqrt(gap): P_1 is a difference of integrals, known to 1e-17 over the gap.
    np.testing.assert_allclose(got[1], wanted[1], rtol=1e-10, atol=1e-16 / gap)
