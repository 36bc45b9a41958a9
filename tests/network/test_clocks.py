"""Link clocks against the laws they are named after (Kolmogorov-Smirnov at level 1e-4 each)."""

import numpy as np
import pytest
import scipy.stats

from netkf.core.streams import Streams
from netkf.network.clocks import Periodic, Poisson, Renewal

LINK = (0, 1)


def ticks(clock, count, seed=0, block=None):
    random = Streams(seed).generator("clock", *LINK)
    origin = clock.origin(LINK, lambda: Streams(seed).generator("phase", *LINK))
    times, now = [], 0.0
    while len(times) < count:
        new = clock.ticks(LINK, origin, len(times), now, random, block or count)
        times.extend(new.tolist())
        now = times[-1]
    return np.array(times[:count])


LAWS = {
    "poisson": (Poisson(rate=3.0), scipy.stats.expon(scale=1 / 3)),
    "gamma": (
        Renewal(distribution="gamma", shape=4.0, mean=0.5),
        scipy.stats.gamma(4.0, scale=0.125),
    ),
    "weibull": (
        Renewal(distribution="weibull", shape=2.0, rate=2.0),
        scipy.stats.weibull_min(2.0, scale=0.5 / scipy.special.gamma(1.5)),
    ),
    "uniform": (Renewal(distribution="uniform", low=0.2, high=1.0), scipy.stats.uniform(0.2, 0.8)),
}


@pytest.mark.parametrize("name", LAWS)
def test_gaps_have_their_law(name):
    clock, law = LAWS[name]
    gaps = np.diff(ticks(clock, 4000), prepend=0.0)
    assert scipy.stats.kstest(gaps, law.cdf).pvalue > 1e-4
    # and the test can tell: the same gaps stretched by a fifth fail
    assert scipy.stats.kstest(1.2 * gaps, law.cdf).pvalue < 1e-4
    assert clock.mean_rate(LINK) == pytest.approx(1.0 / law.mean())
    assert clock.memoryless == (name == "poisson")


@pytest.mark.parametrize(
    "clock",
    [
        LAWS["poisson"][0],
        LAWS["weibull"][0],
        Periodic(period=0.1, phase="random", jitter=0.05),
        Renewal(distribution="constant", mean=0.1),
    ],
)
def test_blocks_do_not_show(clock):
    np.testing.assert_array_equal(ticks(clock, 500), ticks(clock, 500, block=7))


def test_lattices_meet():
    tenth, third = Periodic(period=0.1), Periodic(period=0.3)
    assert set(ticks(third, 50)) < set(ticks(tenth, 150))
    constant = Renewal(distribution="constant", rate=10.0)
    np.testing.assert_array_equal(ticks(constant, 100), ticks(tenth, 100))


def test_phase_and_jitter():
    assert ticks(Periodic(period=1.0), 2).tolist() == [1.0, 2.0]
    assert ticks(Periodic(period=1.0, phase=0.25), 2).tolist() == [0.25, 1.25]
    starts = [ticks(Periodic(period=2.0, phase="random"), 1, seed)[0] for seed in range(300)]
    assert scipy.stats.kstest(starts, scipy.stats.uniform(0, 2).cdf).pvalue > 1e-4
    late = ticks(Periodic(period=1.0, jitter=0.5), 1000) - np.arange(1, 1001)
    assert scipy.stats.kstest(late, scipy.stats.uniform(0, 0.5).cdf).pvalue > 1e-4
