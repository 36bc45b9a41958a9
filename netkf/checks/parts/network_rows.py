"""Promises about clocks, channels and matchings, from the counts of many runs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.special

from netkf.checks.evidence import Finding, Promise
from netkf.checks.laws import find_largest
from netkf.checks.parts.events import CELLS, clock_entities, reversed_directions
from netkf.checks.parts.moments import (
    CORRELATION_TOLERANCE,
    correlation_interval,
    nothing_to_see,
    with_best,
)
from netkf.checks.parts.samples import PartSamples
from netkf.checks.parts.sources import stated_part
from netkf.checks.statistics import (
    Interval,
    detectable_shift,
    deviation_interval,
    probability_interval,
    scale_interval,
    student_interval,
)
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.network.matchings import Matching
from netkf.network.recorded import RecordedLoss
from netkf.scenario.scenario import Scenario

RATE_TOLERANCE, PROBABILITY_TOLERANCE, DISPERSION_TOLERANCE = 0.05, 0.05, 0.25
FIRST_TICK = 1.0
"""Ticks by which a clock that is not memoryless may be off its rate in a run: it has begun."""


def _stated_clock(scenario: Scenario) -> Any:
    return stated_part(scenario.network.activation, "activation")


@lru_cache(maxsize=8)
def clock_rates(scenario: Scenario) -> FloatArray:
    """Return the stated rates (E,) of all clocks in ticks per second; nan if unknown."""
    stated = _stated_clock(scenario)
    return np.array([stated.mean_rate(entity) for entity in clock_entities(scenario)])


def _clock_labels(scenario: Scenario) -> list[str]:
    return [f"clock {'-'.join(map(str, entity))}" for entity in clock_entities(scenario)]


def _rates(samples: PartSamples, level: float) -> Finding:
    """Compare the ticks of all runs with the rates, all clocks together and one by one."""
    scenario, counts = samples.scenario, samples.ticks.ticks.sum(axis=1)
    expected = clock_rates(scenario) * scenario.horizon
    poisson, found = bool(_stated_clock(scenario).memoryless), counts.sum(axis=0).astype(float)
    intervals = []
    share = level / (2.0 * len(expected))
    jobs = [(counts.sum(axis=1), float(expected.sum()), level / 2.0, "all clocks together")]
    jobs += [
        (counts[:, k], float(expected[k]), share, label)
        for k, label in enumerate(_clock_labels(scenario))
    ]
    for values, mean, part, label in jobs:
        clocks = len(expected) if part > share or len(expected) == 1 else 1
        slack = 0.0 if poisson else FIRST_TICK * clocks / mean
        intervals.append((_count_interval(values, mean, part, poisson, slack), label))
    message = f"{found.sum():,.0f} ticks, relative difference from the rates,"
    return with_best(intervals, RATE_TOLERANCE, message)


def _count_interval(
    values: np.ndarray, mean: float, level: float, poisson: bool, slack: float
) -> Interval:
    """Return an interval for how far counts (R,) are from ``mean`` in a run, relative to it.

    ``slack`` is a difference that says nothing. Sums of Poisson counts are Poisson, with exact
    limits; other clocks are judged by the spread of their counts.
    """
    total, runs = float(values.sum()), len(values)
    if poisson:
        low = float(scipy.special.gammaincinv(total, level / 2.0)) if total else 0.0
        high = float(scipy.special.gammaincinv(total + 1.0, 1.0 - level / 2.0))
        spread = math.sqrt(runs * mean)
    else:
        spread = math.sqrt(max(float(values.var(ddof=1)), 0.25) * runs)
        _, low, high = student_interval(total, spread, runs, level)[:3]
    whole = runs * mean
    ratio = Interval(
        total / whole, low / whole, high / whole, detectable_shift(spread, level) / whole
    )
    apart = deviation_interval(1.0, ratio)
    value, low, high = (max(0.0, end - slack) for end in apart[:3])
    return apart._replace(value=value, low=low, high=high, detectable=apart.detectable + slack)


def _gaps(samples: PartSamples, level: float) -> Finding:
    """Compare the gaps of Poisson clocks with the exponential law, cell by cell, and with the gap
    before.
    """
    cells, products = samples.ticks.cells.sum(axis=0), samples.ticks.products.sum(axis=0)
    total = int(cells.sum())
    if total < 10 * CELLS:
        return nothing_to_see(PROBABILITY_TOLERANCE)
    share, intervals = level / (CELLS + 1.0), []
    for k, count in enumerate(cells.tolist()):
        found = probability_interval(count, total, share)
        label = f"gaps of rank {k / CELLS:.2f} to {(k + 1) / CELLS:.2f}"
        intervals.append((deviation_interval(1.0 / CELLS, found), label))
    related = correlation_interval(float(products[0] / products[1]), float(products[2]), share)
    intervals.append((deviation_interval(0.0, related), "neighbouring gaps, their correlation"))
    message = f"{total:,} gaps, largest difference of a share"
    return find_largest(intervals, PROBABILITY_TOLERANCE, message)


def _clocks_apart(samples: PartSamples, level: float) -> Finding:
    """Compare the spread of all ticks of a run with that of independent Poisson clocks."""
    scenario, ticks = samples.scenario, samples.ticks.ticks
    counts = ticks.reshape(-1, ticks.shape[2])
    mean = float((clock_rates(scenario) * scenario.horizon).sum()) / ticks.shape[1]
    values = counts.sum(axis=1) - mean
    # A squared Poisson count has a little more spread than a squared normal one.
    freedom = len(values) / (1.0 + 0.5 / mean)
    ratio = scale_interval(freedom * float((values**2).mean()) / mean, freedom, level / 2.0)
    apart = deviation_interval(1.0, ratio)
    intervals = [(apart, "variance of all ticks at once over that of independent clocks")]
    pairs = _largest_correlation(counts - counts.mean(axis=0), level / 2.0)
    if pairs is not None:
        value, clocks = pairs
        labels = _clock_labels(scenario)
        intervals.append((value, f"correlation of {labels[clocks[0]]} and {labels[clocks[1]]}"))
    return find_largest(intervals, DISPERSION_TOLERANCE, "largest difference")


MAX_CLOCKS = 60
"""Clocks of which all pairs are compared."""


def _stated_loss(scenario: Scenario) -> Any:
    return stated_part(scenario.network.channel.loss, "loss")


@lru_cache(maxsize=8)
def loss_probabilities(scenario: Scenario) -> FloatArray:
    """Return the stated long-run loss (D,) of each direction; nan if unknown before a run."""
    loss, directions = _stated_loss(scenario), scenario.topology.directions
    kept = [loss.mean_delivery(d, scenario.table_probability(d)) for d in directions]
    return 1.0 - np.array(kept)


def _direction_label(scenario: Scenario, k: int) -> str:
    sender, receiver = scenario.topology.directions[k]
    return f"from {sender} to {receiver}"


def _losses(samples: PartSamples, level: float) -> Finding:
    """Compare lost shares with the stated ones, all directions together and one by one."""
    scenario, fates = samples.scenario, samples.fates
    q = loss_probabilities(scenario)
    sent, lost = fates.sent.sum(axis=1), fates.lost.sum(axis=1)
    used = np.flatnonzero(sent.sum(axis=0) > 0)
    intervals = [(_loss_interval(scenario, sent, lost, q, used, level / 2.0), "all directions")]
    share = level / (2.0 * max(len(used), 1))
    for k in used.tolist():
        one = np.array([k])
        found = _loss_interval(scenario, sent, lost, q, one, share)
        intervals.append((found, _direction_label(scenario, k)))
    message = f"{sent.sum():,.0f} messages, difference of the lost share"
    return with_best(intervals, PROBABILITY_TOLERANCE, message)


def _loss_interval(
    scenario: Scenario,
    sent: np.ndarray,
    lost: np.ndarray,
    q: FloatArray,
    which: np.ndarray,
    level: float,
) -> Interval:
    """Return an interval for the distance of the lost share from the stated one.

    Independent losses of one direction have exact limits. Otherwise runs are: what is lost of the
    messages of a run beyond their expected loss has the mean 0.
    """
    total, runs = float(sent[:, which].sum()), len(sent)
    excess = (lost[:, which] - sent[:, which] * q[which]).sum(axis=1)
    expected = float((sent[:, which] * q[which]).sum()) / total
    if len(which) == 1 and _stated_loss(scenario).independent:
        found = probability_interval(int(lost[:, which].sum()), int(total), level)
        return deviation_interval(expected, found)
    # A spread of at least one message of all: a few rare losses may show none.
    spread = math.sqrt(max(float(excess.var(ddof=1)) * runs, 1.0))
    seen = expected + float(excess.sum()) / total
    return deviation_interval(expected, student_interval(seen, spread / total, runs, level))


def _losses_apart(samples: PartSamples, level: float) -> Finding:
    """Test that losses are independent from message to message, between both directions where they
    do not share one fate, and between links.
    """
    scenario, fates = samples.scenario, samples.fates
    q, sent = loss_probabilities(scenario), fates.sent.sum(axis=1)
    pairs = np.maximum(sent - 1, 0)
    # Where both directions of a link share one fate, each is counted twice.
    repeated = _neighbours_variance(q) * (2.0 if scenario.network.channel.symmetric else 1.0)
    jobs = [("a message and the one before", fates.repeated, pairs, q, repeated)]
    if _directions_apart(scenario):
        # In each of two directions of a link the same pairs are counted: messages of one number.
        back = reversed_directions(scenario)
        pairs = np.where(back >= 0, np.minimum(sent, sent[:, back]), 0)
        joint = q * q[back]
        # Each pair is counted in both directions.
        variance = 2.0 * joint * (1.0 - joint)
        jobs.append(("both directions of a link", fates.both, pairs, q[back], variance))
    intervals = []
    for label, both, count, other, variance in jobs:
        scale = np.sqrt(q * (1.0 - q) * other * (1.0 - other))
        found = _correlation_of_runs(both - count * q * other, count, scale, variance, level / 3.0)
        if found is not None:
            intervals.append((found, f"correlation of {label}"))
    intervals += _links_apart(samples, level / 3.0)
    if not intervals:
        return nothing_to_see(CORRELATION_TOLERANCE)
    return find_largest(intervals, CORRELATION_TOLERANCE, "largest difference")


def _neighbours_variance(p: Any) -> Any:
    """Return the variance for each pair of the number of pairs of neighbours in a long row of
    independent events of probability p that both happened; neighbouring pairs share an event.
    """
    return p**2 * (1.0 - p**2) + 2.0 * p**3 * (1.0 - p)


def _directions_apart(scenario: Scenario) -> bool:
    """Return True if both directions of a link have messages at once and fates of their own."""
    clock = scenario.network.activation
    at_once = getattr(clock, "at", "links") == "links"
    return at_once and not scenario.network.channel.symmetric


def _correlation_of_runs(
    excess: FloatArray, count: np.ndarray, scale: FloatArray, variance: FloatArray, level: float
) -> Interval | None:
    """Return an interval for a correlation: how often both events of a pair happened beyond the
    mean, (R, D), in ``count`` pairs (R, D) whose deviations have the product ``scale`` (D,).

    Runs are independent. ``variance`` (D,) is that of each pair's count where nothing is
    correlated, covariances with its neighbours included: few rare events spread less by chance.
    """
    weight = float((count * scale).sum())
    if not weight > 0.0 or len(excess) < 10:
        return None
    values = excess.sum(axis=1)
    runs, least = len(values), float((count * variance).sum())
    spread = math.sqrt(max(float(values.var(ddof=1)) * runs, least, 1.0))
    seen = float(values.sum()) / weight
    return deviation_interval(0.0, student_interval(seen, spread / weight, runs, level))


def _links_apart(samples: PartSamples, level: float) -> list[tuple[Interval, str]]:
    """Return the correlations of losses between links: those that are largest, from the counts of
    runs.
    """
    scenario, fates = samples.scenario, samples.fates
    # One direction of a link stands for both, which may share their fates.
    seen: dict[tuple[int, int], int] = {}
    for k, (i, j) in enumerate(scenario.topology.directions):
        seen.setdefault((min(i, j), max(i, j)), k)
    columns = np.array(list(seen.values()))
    excess = (fates.lost - fates.sent * loss_probabilities(scenario)).reshape(
        -1, fates.sent.shape[2]
    )
    excess = excess[:, columns]
    found = _largest_correlation(excess, level / 2.0)
    if found is None:
        return []
    interval, (a, b) = found
    first, second = (_direction_label(scenario, int(columns[k])) for k in (a, b))
    intervals = [(interval, f"correlation of losses {first} and {second}")]
    own = float(excess.var(axis=0, ddof=1).sum())
    if own > 0.0:
        freedom = float(len(excess) - 1)
        ratio = scale_interval(
            freedom * float(excess.sum(axis=1).var(ddof=1)) / own, freedom, level / 2.0
        )
        # Correlations of some pairs cancel others only by design; a common cause adds up.
        mean = _mean_correlation(ratio, len(columns))
        intervals.append((deviation_interval(0.0, mean), "mean correlation of losses of all links"))
    return intervals


def _mean_correlation(ratio: Interval, links: int) -> Interval:
    """Return the mean correlation of so many equal numbers from the variance of their sum over the
    sum of their variances, widened by what is not known of these.
    """
    scale = 1.0 / max(links - 1, 1)
    value, low, high = ((end - 1.0) * scale for end in ratio[:3])
    return Interval(value, low - 0.02 * scale, high + 0.02 * scale, ratio.detectable * scale)


def _largest_correlation(
    values: FloatArray, level: float
) -> tuple[Interval, tuple[int, int]] | None:
    """Return an interval for the largest correlation of two columns of values (K, L) of mean 0, by
    the spread of their products over the K independent rows.
    """
    some = values[:, :MAX_CLOCKS]
    kept = np.flatnonzero(some.var(axis=0) > 0.0)
    runs = len(some)
    if len(kept) < 2 or runs < 100:
        return None
    z = some[:, kept] / some[:, kept].std(axis=0)
    related = z.T @ z / runs
    upper = np.triu_indices(len(kept), 1)
    worst = int(np.argmax(np.abs(related[upper])))
    a, b = int(upper[0][worst]), int(upper[1][worst])
    products = z[:, a] * z[:, b]
    spread = max(float(products.std(ddof=1)), 1.0) / math.sqrt(runs)
    found = student_interval(float(related[upper][worst]), spread, runs, level / len(upper[0]))
    return deviation_interval(0.0, found), (int(kept[a]), int(kept[b]))


@lru_cache(maxsize=8)
def pair_probabilities(scenario: Scenario) -> FloatArray | None:
    """Return the stated probability (L,) of each link in a matching; None if it is not known."""
    stated = stated_part(scenario.network.activation, "slot activation")
    if not isinstance(stated, Matching):
        return None
    try:
        mean = stated.mean(scenario.topology)
    except ScenarioError:
        return None
    index = scenario.topology.index
    return np.array([mean[index[i], index[j]] for i, j in scenario.topology.links])


def _matchings(samples: PartSamples, level: float) -> Finding:
    """Compare how often links are paired with the mean matching, in all slots and in two
    neighbouring ones.
    """
    scenario, pairs = samples.scenario, samples.pairs
    p = pair_probabilities(scenario)
    assert p is not None
    slots, runs = float(pairs.slots[0]), len(pairs.paired)
    share, intervals = level / (2.0 * len(p)), []
    for k, link in enumerate(scenario.topology.links):
        label = f"link {link[0]}-{link[1]}"
        found = probability_interval(int(pairs.paired[:, k].sum()), int(runs * slots), share)
        intervals.append((deviation_interval(float(p[k]), found), label))
        again = pairs.repeated[:, k].astype(float)
        if slots < 2.0 or not 0.0 < p[k] < 1.0:
            continue
        # The pairs of neighbouring slots overlap, and the runs do not.
        excess = (again - (slots - 1.0) * p[k] ** 2)[:, None]
        related = _correlation_of_runs(
            excess,
            np.full((runs, 1), slots - 1.0),
            np.array([p[k] * (1.0 - p[k])]),
            np.array([_neighbours_variance(float(p[k]))]),
            share,
        )
        if related is not None:
            intervals.append((related, f"{label} and the slot before, their correlation"))
    message = f"{runs * slots:,.0f} slots, largest difference of a share"
    return find_largest(intervals, PROBABILITY_TOLERANCE, message)


CLOCK_RATES = Promise("clocks tick at the rates of the scenario", "the scenario", (), _rates)
CLOCK_GAPS = Promise(
    "gaps between ticks are exponential, and independent of those before", "the scenario", (), _gaps
)
CLOCKS_APART = Promise("clocks tick independently of each other", "the scenario", (), _clocks_apart)
LOSSES = Promise(
    "messages are lost as often as the scenario says, in each direction",
    "the scenario",
    (),
    _losses,
)
LOSSES_APART = Promise(
    "messages are lost independently of each other", "the scenario", (), _losses_apart
)
MATCHINGS = Promise(
    "links are paired as often as the protocol says, whatever happened before",
    "the scenario",
    (),
    _matchings,
)


def network_promises(samples: PartSamples) -> list[Promise]:
    """Return the promises about the network that have a stated law and were seen in the runs."""
    found: list[Promise] = []
    scenario = samples.scenario
    if samples.ticks is not None and np.isfinite(clock_rates(scenario)).all():
        found.append(CLOCK_RATES)
        if _stated_clock(scenario).memoryless:
            found += [CLOCK_GAPS, CLOCKS_APART]
    drawn = samples.pairs is not None and scenario.hosted.talks
    if drawn and pair_probabilities(scenario) is not None:
        found.append(MATCHINGS)
    if samples.fates is not None and not isinstance(_stated_loss(scenario), RecordedLoss):
        q = loss_probabilities(scenario)
        if np.isfinite(q).all():
            found.append(LOSSES)
            if _stated_loss(scenario).independent and ((q > 0.0) & (q < 1.0)).any():
                found.append(LOSSES_APART)
    return found
