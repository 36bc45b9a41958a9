"""Rows state the error that they find with probability 0.9: Student's, exact and censored laws too.

Statistics are drawn as runs would give them. An error of the stated size is found with about that
probability, and what is right is accused no more often than the level.
"""

from functools import partial

import numpy as np
import pytest
import scipy.stats

from netkf.checks.exact import _length_interval, detectable_length, gaussian_radius
from netkf.checks.laws import find
from netkf.checks.statistics import (
    distance_to_law,
    eigenvalue_interval,
    law_distance,
    quadratic_interval,
)
from netkf.core.laws import EXPONENTIAL
from netkf.laws.intervals import (
    POWER,
    correlation_interval,
    detectable_shift_of_student,
    deviation_interval,
    poisson_interval,
    probability_interval,
    scale_interval,
    student_interval,
)
from netkf.laws.ticks import (
    CELLS,
    ClockGroup,
    censored_ranks,
    compare_shares,
    correlation_of_columns,
    count_interval,
    count_ranks,
    count_ticks,
    largest_correlation,
)
from netkf.network.clocks import Poisson, Renewal

LEVEL, TRIALS = 0.01, 300


def from_zero(interval, expected=0.0):
    """Return if an interval excludes the expected value, and the error that it states."""
    distance = deviation_interval(expected, interval)
    return distance.low > 0.0, distance.detectable


def student(count, size, random):
    values = random.normal(size, 1.0, count)
    found = student_interval(values.mean(), values.std(ddof=1) / count**0.5, count, LEVEL)
    # The stated error is in units of the deviation that was estimated: take the true one.
    return from_zero(found)[0], detectable_shift_of_student(count, LEVEL) / count**0.5


def probability(p, trials, size, random):
    found = from_zero(probability_interval(random.binomial(trials, p + size), trials, LEVEL), p)
    # Of the null hypothesis, and not of what was seen.
    stated = probability_interval(round(p * trials), trials, LEVEL).detectable
    return found[0], stated


def poisson(mean, size, random):
    return from_zero(poisson_interval(random.poisson(mean * (1.0 + size)), mean, LEVEL), 1.0)


def renewal(runs, size, random):
    counts = random.normal(40.0 * (1.0 + size), 3.0, runs)
    found = count_interval(counts, 40.0, LEVEL, False, 0.0)
    return found.low > 0.0, 3.0 / 40.0 / runs**0.5 * detectable_shift_of_student(runs, LEVEL)


def scale(freedom, size, random):
    return from_zero(scale_interval((1.0 + size) * random.chisquare(freedom), freedom, LEVEL), 1.0)


def quadratic(size, random):
    weights = np.repeat([3.0, 1.0, 0.3], 40)
    total = (1.0 + size) * (weights * random.standard_normal(120) ** 2).sum()
    return from_zero(quadratic_interval(total, weights, LEVEL), 1.0)


def correlation(size, random):
    u, v = random.standard_normal((2, 400))
    v = size * u + (1.0 - size**2) ** 0.5 * v
    value = (u @ v) / ((u @ u) * (v @ v)) ** 0.5
    return from_zero(correlation_interval(value, 400, LEVEL))


def coincidences(q, size, random):
    """Losses of two links, one of whose losses is with probability ``size`` that of the other."""
    lost = random.random((1600, 2)) < q
    lost[:, 1] = np.where(random.random(1600) < size, lost[:, 0], lost[:, 1])
    x = lost - q
    variances = np.full(1600, (q * (1.0 - q)) ** 2)
    return from_zero(correlation_of_columns(x[:, 0] * x[:, 1], variances, LEVEL))


def law(size, random):
    first, second = random.random(400), random.random(4000)
    first[random.random(400) < size] += 2.0  # so much of the mass is elsewhere
    return from_zero(law_distance(first, second, LEVEL))


def exact_law(size, random):
    values = random.random(400)
    values[random.random(400) < size] = 2.0
    return from_zero(distance_to_law(lambda x: np.clip(x, 0.0, 1.0), values, LEVEL))


def length(n, size, random):
    spread = 0.1 * np.eye(n)
    z = random.standard_normal(n) + size / 0.1 * np.eye(n)[0]
    return from_zero(_length_interval(spread, z, LEVEL))


def eigenvalue(count, size, random):
    x = random.standard_normal((count, 400, 2)) * np.sqrt([1.0 + size, 0.5])
    samples = np.einsum("rka,rkb->rab", x, x) / 400
    found = eigenvalue_interval(samples, LEVEL)
    return found.low > 1.0, found.detectable


EXACT = {
    **{f"student {n}": partial(student, n) for n in (10, 20, 60, 300)},
    "share": partial(probability, 0.3, 500),
    "rare share": partial(probability, 2e-3, 2000),
    "frequent ticks": partial(poisson, 4000.0),
    "rare ticks": partial(poisson, 6.0),
    "renewal ticks of 10": partial(renewal, 10),
    "variance": partial(scale, 80.0),
    "quadratic form": quadratic,
    "correlation": correlation,
    "bias": partial(length, 1),
    "bias in 4 directions": partial(length, 4),
}
CAREFUL = {
    # With limits that hold whatever the law is: found more often than stated.
    "coincidences": partial(coincidences, 0.3),
    "rare coincidences": partial(coincidences, 0.02),
    "law": law,
    "exact law": exact_law,
    "largest eigenvalue of 20": partial(eigenvalue, 20),
}


def shares_found(draw, trials=TRIALS):
    """Return the shares of draws in which an error of the stated size is found, and none at all."""
    random = np.random.default_rng(4)
    stated = float(np.median([draw(0.0, random)[1] for _ in range(9)]))
    return [np.mean([draw(size, random)[0] for _ in range(trials)]) for size in (stated, 0.0)]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", {**EXACT, **CAREFUL})
def test_the_stated_error_is_found_with_the_stated_probability(name):
    found, accused = shares_found({**EXACT, **CAREFUL}[name])
    # 0.9 of 300 has the standard deviation 0.017, 0.01 of 300 one of 0.006.
    assert found >= POWER - 0.06
    assert accused <= LEVEL + 0.02
    if name in EXACT:
        assert found <= POWER + 0.05


def test_students_shift_is_that_of_the_noncentral_law():
    for count in (4, 10, 60, 1000):
        shift = detectable_shift_of_student(count, 0.05)
        critical = scipy.stats.t(count - 1).isf(0.025)
        assert scipy.stats.nct(count - 1, shift).sf(critical) == pytest.approx(POWER, abs=2e-3)


def shifted_ranks(size, cell, count, random):
    """Return ranks with so much more probability in one of CELLS cells, from all others."""
    moved = random.random(count) < size / (1.0 - 1.0 / CELLS)
    return np.where(moved, (cell + random.random(count)) / CELLS, random.random(count))


GAPS = {
    # Clock, quantiles of its gaps, horizon: from 4 to 40 ticks in a run.
    "poisson": (Poisson(rate=2.0), scipy.stats.expon(scale=0.5), 20.0),
    "poisson in short runs": (Poisson(rate=2.0), scipy.stats.expon(scale=0.5), 2.0),
    "gamma": (Renewal(distribution="gamma", shape=2.5, mean=0.4),
              scipy.stats.gamma(2.5, scale=0.16), 4.0),
    "weibull": (Renewal(distribution="weibull", shape=0.7, scale=0.5),
                scipy.stats.weibull_min(0.7, scale=0.5), 4.0),
}  # fmt: skip


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("name", "cell"),
    [("poisson", 1), ("poisson in short runs", 7), ("gamma", 7), ("weibull", 1)],
)
def test_laws_of_gaps_state_the_error_of_the_law_itself(name, cell):
    """Not of what the end of a run leaves of it, which is far smaller."""
    (clock, law, horizon), size = GAPS[name], 60
    entities = tuple((k, k + 1) for k in range(size))
    rates = np.full(size, clock.mean_rate((0, 1)))
    group = ClockGroup(entities, rates, (clock.gaps,) * size, ("",) * size)
    batches = 1 if horizon > 10.0 else 5

    def draw(error, random):
        cells = np.zeros((CELLS, 2))
        for _ in range(batches):
            gaps = law.ppf(shifted_ranks(error, cell, size * 80, random)).reshape(size, 80)
            times = np.cumsum(gaps, axis=1)
            reached = times < horizon
            clocks = np.broadcast_to(np.arange(size)[:, None], times.shape)[reached]
            cells += count_ticks(group, times[reached], clocks, horizon).cells
        finding = find(compare_shares(cells, LEVEL, "gaps"), 0.02)
        return finding.margin[2] < 0.0, finding.detectable

    found, accused = shares_found(draw, trials=40)
    assert found >= 0.78
    assert accused <= 0.05


def test_laws_of_delays_state_the_error_of_the_law_itself():
    """Of messages of which many are under way when the run ends."""
    law, horizon = EXPONENTIAL, 4.0

    def draw(error, random):
        sent = random.uniform(0.0, horizon, 4000)
        delays = -np.log1p(-shifted_ranks(error, 5, 4000, random))
        arrived = sent + delays < horizon
        ranks = censored_ranks(law, sent, np.where(arrived, delays, np.inf), horizon)
        finding = find(compare_shares(count_ranks(ranks), LEVEL, "delays"), 0.02)
        return finding.margin[2] < 0.0, finding.detectable

    found, accused = shares_found(draw, trials=150)
    assert 0.8 <= found <= 0.98
    assert accused <= 0.05


def test_links_with_few_losses_state_no_error_that_they_could_not_find():
    random = np.random.default_rng(2)
    excess = (random.random((4000, 3)) < 0.006) - 0.006
    variances = np.full(excess.shape, 0.006 * 0.994)
    # 24 losses of a link are expected: at this level not even equal losses would be found.
    assert np.isnan(largest_correlation(excess, variances, 1e-6)[0].detectable)
    assert largest_correlation(excess, variances, LEVEL)[0].detectable < 1.0
    assert largest_correlation(excess[:, :2], variances[:, :2] / 4.0, LEVEL) is None
    # Links of which one is up at a time, as in a matching.
    alternate = np.eye(2)[np.arange(len(excess)) % 2]
    assert largest_correlation(excess[:, :2] * alternate, 9.0 * alternate, LEVEL) is None


@pytest.mark.parametrize("n", [1, 2, 7])
def test_lengths_of_gaussian_vectors_have_the_law_of_chi_square(n):
    """A wider radius would state the error that it finds as well, and find less."""
    radius = gaussian_radius(LEVEL, n)
    assert scipy.stats.chi2.sf(radius**2, n) == pytest.approx(LEVEL)
    found = scipy.stats.ncx2.sf(radius**2, n, detectable_length(radius, n) ** 2)
    assert found == pytest.approx(POWER)
