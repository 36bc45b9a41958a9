"""Errors of parts are found with probability 0.9 at the size that their rows state, within 1.5.

Counts are drawn as events would give them, without runs.
"""

import math

import numpy as np
import pytest

from netkf.checks.parts.events import PartSamples, loss_law
from netkf.checks.parts.network_rows import (
    BURSTS,
    LOSSES_APART,
    MATCHING_ROW,
    pair_probabilities,
)
from netkf.laws.intervals import correlation_interval, deviation_interval, probability_interval
from netkf.laws.losses import (
    LossLaw,
    PairCounts,
    compare_independence,
    count_outcomes,
    mean_correlation,
)
from netkf.laws.noise import _between, _in_size, _in_time
from netkf.laws.ticks import CELLS, Ranks, correlate_neighbours, largest_correlation
from netkf.scenario.reading import from_table
from tests.checks.parts.test_parts import SLOTS

LEVEL, RUNS, TRIALS, SLACK = 2e-3, 200, 40, 1.5
WINDOWS, MESSAGES = 4, 8  # of a run, and of a direction in each of them


def _scenario(folder, loss, activation=None):
    channel = {"loss": loss, "symmetric": False}
    network = {**SLOTS["network"], "channel": channel}
    if activation:
        network["activation"] = activation
    return from_table({**SLOTS, "network": network}, folder)


def _samples(scenario, fates=None, pairs=None):
    return PartSamples(scenario, 1, fates=fates, pairs=pairs)


def _count(scenario, lost):
    return count_outcomes(lost, loss_law(scenario).opposite)


def _of(finding):
    """Return if a row is broken, and the error that it states."""
    return finding.margin[2] < 0.0, finding.detectable


def _interval(interval):
    return interval.low > 0.0, interval.detectable


def _losses_between_links(folder):
    scenario = _scenario(folder, {"kind": "bernoulli", "delivery": 0.7})
    directions = scenario.topology.directions
    first = directions[0]
    other = next(k for k, d in enumerate(directions) if d[0] < d[1] and set(d) != set(first))

    def draw(size, random):
        lost = random.random((RUNS, WINDOWS * MESSAGES, len(directions))) < 0.3
        same = random.random(lost.shape[:2]) < size
        lost[..., other] = np.where(same, lost[..., 0], lost[..., other])
        return _of(LOSSES_APART.test(_samples(scenario, _count(scenario, lost)), LEVEL))

    return draw


def _bursts_of_losses(folder):
    to_good, share = 0.3, 0.25
    loss = {"kind": "gilbert-elliott", "to_good": to_good, "to_bad": to_good * share / (1 - share)}
    scenario = _scenario(folder, loss)
    size_of = (RUNS, len(scenario.topology.directions))

    def draw(size, random):
        leaves = to_good - size  # a loss is followed by another one more often
        arrives, steps = leaves * share / (1.0 - share), [random.random(size_of) < share]
        for u in random.random((WINDOWS * MESSAGES - 1, *size_of)):
            steps.append(np.where(steps[-1], u >= leaves, u < arrives))
        lost = np.swapaxes(np.array(steps), 0, 1)
        return _of(BURSTS.test(_samples(scenario, _count(scenario, lost)), LEVEL))

    return draw


def _matchings_of_slots(folder):
    activation = {"kind": "matching", "protocol": "independent", "p": 0.3}
    scenario = _scenario(folder, {"kind": "bernoulli", "delivery": 1.0}, activation)
    p, slots = pair_probabilities(scenario), 20

    def draw(size, random):
        paired = random.random((RUNS, slots, len(p))) < p + size / len(p)
        again = (paired[:, 1:] & paired[:, :-1]).sum(axis=1)
        pairs = PairCounts(paired.sum(axis=1), again, np.full(RUNS, float(slots)))
        return _of(MATCHING_ROW.test(_samples(scenario, pairs=pairs), LEVEL))

    return draw


def _clocks_together(folder):
    def draw(size, random):
        common = math.sqrt(size) * random.standard_normal((500, 1))
        values = random.standard_normal((500, 6))
        values[:, :2] = common + math.sqrt(1.0 - size) * values[:, :2]
        return _interval(largest_correlation(values, np.ones(values.shape), LEVEL)[0])

    return draw


def _gaps_in_time(folder):
    def draw(size, random):
        u = random.random(2000)
        # Each number is the one before with this probability.
        for k in np.flatnonzero(random.random(len(u)) < size)[1:].tolist():
            u[k] = u[k - 1]
        sums = correlate_neighbours(Ranks(u, np.full(len(u), CELLS)), np.zeros(len(u), bool))
        found = correlation_interval(float(sums[0] / sums[1]), float(sums[2]), LEVEL)
        return _interval(deviation_interval(0.0, found))

    return draw


STUDIES = {
    "losses of two links": _losses_between_links,
    "losses in bursts": _bursts_of_losses,
    "pairs in a slot": _matchings_of_slots,
    "two clocks": _clocks_together,
    "gaps and delays in time": _gaps_in_time,
}


@pytest.mark.parametrize("name", STUDIES)
def test_rows_about_parts_find_what_they_state(name, tmp_path):
    draw, random = STUDIES[name](tmp_path), np.random.default_rng(3)
    stated = float(np.median([draw(0.0, random)[1] for _ in range(5)]))
    above, below = (
        sum(bool(draw(stated * factor, random)[0]) for _ in range(TRIALS))
        for factor in (SLACK, 1.0 / SLACK)
    )
    assert probability_interval(above, TRIALS, 1e-3).high >= 0.9, (name, stated, above)
    assert above >= 0.8 * TRIALS, (name, stated, above)
    assert probability_interval(below, TRIALS, 1e-3).low <= 0.9, (name, stated, below)


@pytest.mark.parametrize("mean", [0.2, 1.0])
def test_parts_of_runs_with_few_messages_accuse_nobody(mean):
    """Most parts have no message of either link, and what is lost there does not vary."""
    random, level, q, accused = np.random.default_rng(7), 0.02, 0.7, 0
    for _ in range(400):
        # Broadcasts: both links have a message at once.
        sent = np.repeat(random.poisson(mean, (240, 1)), 2, axis=1)
        excess = random.binomial(sent, q) - q * sent
        found = mean_correlation(excess, sent * q * (1.0 - q), level)
        accused += not found.low <= 0.0 <= found.high
    # 8 are expected at most; 18 and more have probability 0.002.
    assert accused < 18
    same = np.repeat(excess[:, :1], 2, axis=1)
    assert mean_correlation(same, sent * q * (1.0 - q), level).low > 0.0


@pytest.mark.parametrize("hub", [0, 2])
def test_links_that_lose_together_are_found_whichever_end_has_the_lower_id(hub):
    """Two leaves send to a hub that sends nothing, and their messages share their fate."""
    links = sorted({(a, b) for leaf in {0, 1, 2} - {hub} for a, b in ((leaf, hub), (hub, leaf))})
    opposite = np.array([links.index(link[::-1]) for link in links])
    speaks = np.array([link[1] == hub for link in links])
    lost = (np.random.default_rng(5).random((100, 40, 1)) < 0.3) & speaks
    counts = count_outcomes(lost, opposite)
    counts = counts._replace(sent=counts.sent * speaks)
    law = LossLaw(np.full(4, 0.3), True, None, opposite, links)
    worst = compare_independence(law, counts, 0.01).worst
    assert worst is not None
    assert "correlation of losses" in worst[1]


def test_correlations_of_noises_are_those_of_the_pairs_that_are_there():
    random = np.random.default_rng(11)
    z = random.standard_normal((30, 2)) * np.linspace(0.2, 5.0, 30)[:, None]
    z[random.random(30) < 0.3, 0] = z[random.random(30) < 0.3, 1] = np.nan

    def expected(a, b):
        a, b = (one[np.isfinite(a) & np.isfinite(b)] for one in (a, b))
        return (a @ b) / math.sqrt((a @ a) * (b @ b)), len(a)

    found = z[None]
    labels = ["a", "b"]
    seen = [one[:2] for one in (*_between(found, labels), *_in_time(found, labels))]
    pairs = [(z[:, 1], z[:, 0]), *((z[1:, i], z[:-1, j]) for i in (0, 1) for j in (0, 1))]
    np.testing.assert_allclose(seen, [expected(a, b) for a, b in pairs], rtol=1e-12)
    lags = [(i, k) for k in (2, 3, 7) for i in (0, 1)]
    seen = [one[:2] for one in _in_size(found, labels, (2, 3, 7))][: len(lags)]
    assert len(seen) == len(lags)
    np.testing.assert_allclose(seen, [expected(z[k:, i], z[:-k, i]) for i, k in lags], rtol=1e-12)
