"""What rows would have found at the default number of runs, and what it takes to know."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from netkf.checks.check import find_checks, judge_replicas, run_replica, with_check_times
from netkf.checks.exact import _compare_pooled, _pool_nees, check_expected_nees, max_replayed
from netkf.checks.samples import (
    ReplicaSummary,
    check_times,
    errors_at_once,
    probe_times,
    stack_summaries,
)
from netkf.laws.ticks import count_interval
from netkf.scenario.reading import load
from netkf.theory.errors import ErrorLaw
from tests.checks.power import STUDIES, measured_power

SCENARIOS = Path(__file__).parents[2] / "scenarios"
NAMES = ("poisson_ring", "gossip_ring", "push_sum_planar", "diffusion_regression", "threshold")
RUNS, FEW = 500, 25
FOUND = {
    # Part of the name of a row, and the error that it has to find at 500 runs.
    "noises of the sensors have their covariance": 0.05,
    "the plant's noise has its covariance": 0.05,
    "messages are lost as often": 0.02,
    "readings have no bias": 0.1,
    "the plant follows its equation without a bias": 0.1,
    "noises of the sensors are white": 0.2,
    "the plant's noise is white": 0.2,
    "clocks tick at the rates": 0.02,
}


def load_shipped(name):
    return load(SCENARIOS / f"{name}.toml")


@pytest.fixture(scope="module")
def ring():
    """Return a scenario and the results of some of its runs."""
    scenario = with_check_times(load_shipped("poisson_ring"))
    return scenario, [run_replica(scenario, 5, k) for k in range(FEW)]


@pytest.mark.slow
def test_rows_would_have_found_small_errors_at_the_default(ring):
    # What a row would find depends on how much it saw, and not on what: each run counts 20 times.
    scenario, results = ring
    rows = judge_replicas(scenario, [results[k % FEW] for k in range(RUNS)], 5, 0.99).rows
    for name, size in FOUND.items():
        (row,) = [row for row in rows if name in row.promise]
        assert 0.0 < row.detectable <= size, name
        # Of a single clock too, or the row would say what no test could find.
        assert "of one clock, no test" not in row.evidence


def test_one_clock_that_is_off_is_found_as_stated():
    """A rate that is 2 % off, among six clocks, in the ticks that are drawn for that."""
    random, mean, runs, level = np.random.default_rng(4), 40.0, 2000, 1.5e-4 / 6.0
    size = count_interval(random.poisson(mean, runs), mean, level, True, 0.0).detectable
    assert size <= 0.02
    for factor in (1.0 + size, 1.0 - size):
        off = [
            count_interval(random.poisson(factor * mean, runs), mean, level, True, 0.0).low
            for _ in range(300)
        ]
        assert np.mean(np.array(off) > 0.0) == pytest.approx(0.9, abs=0.06)


@pytest.mark.slow
def test_what_no_test_could_find_is_stated(ring):
    """In few runs: the bound is that of the most powerful test, by its power at that error."""
    scenario, results = ring
    rows = judge_replicas(scenario, results, 5, 0.99).rows
    (row,) = [row for row in rows if row.promise.startswith("clocks tick at the rates")]
    found = re.search(r"finds less than ([0-9.e-]+) in ([0-9,]+) ticks", row.evidence)
    least, ticks = float(found[1]), int(found[2].replace(",", ""))
    assert ticks == pytest.approx(5 * FEW * 40.0)
    limit = scipy.stats.poisson(ticks).isf(0.005 / 12.0)
    assert scipy.stats.poisson(ticks * (1.0 + 0.8 * least)).sf(limit) < 0.9


@pytest.mark.slow
def test_errors_have_the_freedom_to_find_five_per_cent(ring):
    scenario, results = ring
    joint = np.array([one.summary.joint for one in results])
    # The part of the level that the row has for all errors together, among ten rows.
    found = _compare_pooled(np.tile(joint, (20, 1))[: max_replayed(scenario)], 0.01 / 40.0)
    assert 0.0 < found.detectable <= 0.052


@pytest.mark.parametrize("name", NAMES)
def test_runs_are_sampled_where_rows_look_and_often_enough(name):
    scenario = load_shipped(name)
    times = probe_times(scenario)
    assert set(check_times(scenario)) <= set(times)
    assert len(times) <= max(24, len(check_times(scenario)))
    assert all(0.0 < time <= scenario.horizon for time in times)
    # A variance is known to 5 % with probability 0.9 from so many numbers, or from 500 runs.
    errors = len(times) * errors_at_once(scenario)
    assert max_replayed(scenario) >= min(RUNS, 23_000 / errors)


@pytest.mark.parametrize("horizon", [0.7, 3.1, 3.6, 3.9])
def test_equal_instants_are_sampled_once(horizon):
    """Shares of the horizon and even times meet: 0.125 of 3.6 s is three times 0.15 s."""
    scenario = load_shipped("poisson_ring").replace({"horizon": horizon, "probe": horizon})
    times = np.array(probe_times(scenario))
    np.testing.assert_array_equal(times, scenario.time_grid.snap(times))
    assert (np.diff(times) > 1e-9).all()


@pytest.fixture(scope="module")
def samples(ring):
    scenario, results = ring
    checks = find_checks(scenario)
    return checks.collect(scenario, stack_summaries([one.summary for one in results]), 5)


def test_the_expected_nees_of_all_errors_is_exact(samples):
    # Given the events the sum is a quadratic form with these weights: compare its moments.
    quadratic = samples.runs.quadratic
    weights = quadratic[:, 1:]
    z = (quadratic[:, 0] - weights.sum(axis=1)) / np.sqrt(2.0 * (weights**2).sum(axis=1))
    assert abs(z.mean()) < 4.0 / math.sqrt(FEW)
    assert 0.3 < z.std() < 2.0
    # Each NEES counts in units of its expected value over n, that of a right P.
    times, errors = len(probe_times(samples.scenario)), errors_at_once(samples.scenario)
    np.testing.assert_allclose(weights.sum(axis=1), times * errors, rtol=1e-9)


def test_sums_of_nees_are_those_of_a_plain_loop():
    random = np.random.default_rng(7)
    times, hosts, n = 3, 2, 2
    size = times * hosts * n
    root = random.standard_normal((size, size))
    C, e = root @ root.T, random.standard_normal((times, hosts, n))
    P = np.array([2.0 * np.eye(n) + 0.3 * k for k in range(times * hosts)]).reshape(3, 2, n, n)
    law = ErrorLaw(np.zeros(size), C, P)
    total, D = 0.0, np.zeros((size, size))
    for k, (x, one) in enumerate(zip(e.reshape(-1, n), P.reshape(-1, n, n), strict=True)):
        own = slice(k * n, (k + 1) * n)
        inverse = np.linalg.inv(one)
        unit = n / np.trace(inverse @ C[own, own])
        total += unit * x @ inverse @ x
        D[own, own] = unit * inverse
    found = _pool_nees(e, P, law)
    assert found[0] == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(found[1:], np.sort(np.linalg.eigvals(D @ C).real), rtol=1e-9)


@pytest.mark.parametrize(("factor", "broken"), [(1.0, False), (1.6, True), (0.6, True)])
def test_covariances_that_are_too_large_or_too_small_change_the_nees(ring, factor, broken):
    scenario, results = ring
    changed = []
    for one in results:
        summary = one.summary
        # P by the engine is off by a factor: so is the NEES, and not what is expected of it.
        quadratic = np.append(summary.quadratic[0] / factor, summary.quadratic[1:])
        fields = {"quadratic": quadratic, "nees": summary.nees / factor}
        found = ReplicaSummary(**vars(summary) | fields)
        changed.append(one._replace(summary=found))
    summaries = stack_summaries([one.summary for one in changed])
    samples = find_checks(scenario).collect(scenario, summaries, 5)
    finding = check_expected_nees(samples, 0.01)
    assert (finding.margin[2] < 0.0) == broken


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_whole_runs_find_what_their_rows_state(name):
    """The smallest error found with probability 0.9 is the stated one, within a factor of 1.5."""
    _, (less, _, more) = measured_power(name, 60, 30)
    # At 0.9 of 30 seeds fewer than 23 find it once in a hundred times.
    assert more >= 23 / 30
    assert less <= 29 / 30
