"""The numbers behind figures, against plain loops over events and replays of textbook filters."""

import math

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf.algorithms.models import FlowModel
from netkf.checks.innovations import ExpectedIncrements, autocorrelation, compute_innovations
from netkf.figures.style import MAX_FREEDOM, nees_interval
from netkf.figures.traffic import age_of_information, heard, messages_by_direction, wilson_interval
from netkf.studies.consistency import replica_consistency
from netkf.trace.messages import join_messages
from netkf.trace.schema import rows_of
from tests.conftest import SCENARIOS
from tests.figures.conftest import one_node


@pytest.mark.parametrize("kind", ["no truth", "slots"])
def test_the_age_of_information_is_that_of_a_plain_loop(results, kind):
    """Means, maxima and shares of time of a sawtooth, against its values at many instants."""
    run = results(kind)
    events, end = run.events, run.scenario.horizon
    fine = np.linspace(0.0, end, 40_000, endpoint=False)
    for node in run.scenario.nodes[:3]:
        heard = events[(events["kind"] == "deliver") & (events["node"] == node)]
        # The largest time of sending up to each instant, by going through all messages.
        newest = np.zeros(len(fine))
        for e in heard.itertuples():
            newest[fine >= e.t] = np.maximum(newest[fine >= e.t], e.t - np.nan_to_num(e.age))
        expected = fine - newest
        found = age_of_information(rows_of(run.log, "deliver"), node, end)
        edges = np.linspace(0.0, end, 9)
        parts = np.split(expected, 8)
        step = 2.0 * end / len(fine)
        np.testing.assert_allclose(found.mean(edges), [np.mean(p) for p in parts], atol=step)
        np.testing.assert_allclose(found.largest(edges), [np.max(p) for p in parts], atol=step)
        for level in (0.0, 0.1 * expected.max(), 0.7 * expected.max(), 2.0 * expected.max()):
            share = np.mean(expected > level)
            above = found.time_above(np.array([level]))[0] / end
            # At each of so many jumps an instant may lie on the other side.
            assert abs(above - share) <= (1 + len(heard)) * 2.0 / len(fine)


@pytest.mark.parametrize("kind", ["ring", "no truth", "slots"])
def test_directions_have_the_messages_of_the_log(results, kind):
    run = results(kind)
    events = run.events
    for one in messages_by_direction(join_messages(run.log)):
        sent = events[(events["kind"] == "send") & (events["node"] == one["sender"][0])]
        sent = sent[sent["peer"] == one["receiver"][0]]
        # What is on its way at the end has neither arrived nor been lost.
        assert 0 <= len(sent) - len(one) <= 1
    found = np.concatenate(messages_by_direction(join_messages(run.log)))
    assert heard(found).sum() == run.count("deliver")
    assert (~heard(found)).sum() == run.count("lost") + run.count("late")


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("k", "n"), [(0, 5), (5, 5), (3, 10), (500, 1000)])
def test_wilson_is_that_of_scipy(k, n):
    expected = scipy.stats.binomtest(k, n).proportion_ci(0.95, "wilson")
    np.testing.assert_allclose(wilson_interval(k, n), expected, atol=1e-12)
    low, high = wilson_interval(np.array([k, k]), np.array([n, n + 1]))
    assert (low[0], high[0]) == wilson_interval(k, n)


def test_innovations_are_those_of_a_plain_kalman_filter(results):
    """One node, a scalar plant: xhat and P from the readings by the textbook recursion."""
    run = results("one node")
    found = compute_innovations(run)
    assert len(found.nis) == run.count("sense")
    np.testing.assert_array_equal(found.nodes, 0)
    a, R, q = -0.5, 0.5, 1.0
    now, xhat, P, nis = 0.0, 0.0, 1.0, []
    again = compute_innovations(netkf.simulate(one_node()))
    for t, z in zip(found.times, found.whitened, strict=True):
        f = np.exp(a * (t - now))
        P = f * f * P + q * (f * f - 1.0) / (2.0 * a)
        S = P + R
        v = float(z[0]) * np.sqrt(S)  # the reading is xhat + v
        nis.append(v * v / S)
        xhat, P, now = f * xhat + P / S * v, P - P * P / S, t
        k = np.searchsorted(run.times, t, side="right")
        if k < len(run.times) and not ((found.times > t) & (found.times <= run.times[k])).any():
            gap = np.exp(a * (run.times[k] - t))
            np.testing.assert_allclose(run.xhat[k, 0, 0], gap * xhat, atol=1e-9)
    np.testing.assert_allclose(found.nis, nis, rtol=1e-9)
    np.testing.assert_array_equal(again.nis, found.nis)


def test_increments_have_the_innovations_of_an_integrated_ornstein_uhlenbeck_process():
    """dx = a x ds + b dw and dy = h x ds + dv in closed form, over an interval of g seconds."""
    a, b, h, R, g, P, xhat, y = -0.7, 1.3, 0.8, 0.4, 0.6, 0.5, 2.0, 1.1
    model = FlowModel(*(np.array([[v]]) for v in (a, b * b, h, R)), 10.0, 1.0)
    found, root = ExpectedIncrements(model).innovation(
        np.array([xhat]), np.array([[P]]), np.array([y]), g
    )
    J = (math.exp(a * g) - 1.0) / a
    # int_0^g ((e^{a (g - s)} - 1) / a)^2 ds
    noise = ((math.exp(2.0 * a * g) - 1.0) / (2.0 * a) - 2.0 * J + g) / a**2
    S = h * h * (J * J * P + b * b * noise) + R * g
    np.testing.assert_allclose([found[0], root[0, 0]], [y - h * J * xhat, math.sqrt(S)], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("believed", "expected"), [(0.5, 2.0), pytest.param(1.0, 1.0, marks=pytest.mark.slow)]
)
def test_increments_are_as_far_from_expectations_as_exact_covariances_say(believed, expected):
    """With half of the true R the noise, which is most of a short interval's, looks doubled."""
    sensors = [{"nodes": [0], "H": [[1.0, 0.2]], "R": [[2.0]]}]
    changes = {"sensors": sensors, "filter": {"kind": "local", "model": {"R": [[2.0 * believed]]}}}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 300.0, "probe": 0.5})
    found = compute_innovations(netkf.simulate(scenario.replace(changes)))
    assert found.increments == len(found.nis) > 500
    assert found.times[-1] == pytest.approx(300.0)  # the increments up to the horizon
    deviation = math.sqrt(2.0 / len(found.nis))
    assert abs(found.nis.mean() / expected - 1.0) < 4.0 * deviation + (expected - 1.0) * 0.15
    if believed == 1.0:
        first = np.concatenate(found.whitened)
        assert np.abs(autocorrelation(first, 5)).max() < 4.0 / math.sqrt(len(first))


def test_innovations_of_slots_have_the_nis_of_netkf_consistency():
    scenario = netkf.load(SCENARIOS / "diffusion_regression.toml", {"horizon": 40.0, "probe": 1.0})
    found = compute_innovations(netkf.simulate(scenario))
    expected = replica_consistency(scenario, scenario.seed, 0).nis
    for node, nis in zip(scenario.nodes, expected, strict=True):
        mine = found.nis[(found.nodes == node) & (found.times > 0.0)]
        np.testing.assert_allclose(mine.mean(), nis, rtol=0.05)  # the last slot is one's alone


def test_white_noise_is_found_white_and_coloured_noise_is_not():
    random = np.random.default_rng(1)
    white = random.normal(size=4000)
    found = autocorrelation(white, 10)
    expected = [np.sum(white[k:] * white[:-k]) / np.sum(white**2) for k in range(1, 11)]
    np.testing.assert_allclose(found, expected)
    assert np.abs(found).max() < 4.0 / np.sqrt(4000)
    moving = white[1:] + 0.8 * white[:-1]
    assert autocorrelation(moving, 3)[0] == pytest.approx(0.8 / 1.64, abs=0.05)


@pytest.mark.parametrize("runs", [1, 5, MAX_FREEDOM])
def test_the_interval_of_nees_is_that_of_chi_square(runs):
    for n in (1, 2, 3, 8, 20):
        expected = scipy.stats.chi2.ppf([0.025, 0.975], runs * n) / runs
        np.testing.assert_allclose(nees_interval(n, runs), expected, rtol=1e-12)
