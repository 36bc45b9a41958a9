"""Promises about clocks, channels and matchings, from the counts of many runs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.special

from netkf.checks.evidence import Finding, Promise
from netkf.checks.laws import find_largest
from netkf.checks.parts.clock_rows import clock_promises, largest_correlation
from netkf.checks.parts.delays import delay_promises
from netkf.checks.parts.events import reversed_directions
from netkf.checks.parts.moments import (
    CORRELATION_TOLERANCE,
    MIN_COUNT,
    MIN_RUNS,
    nothing_to_see,
    with_best,
)
from netkf.checks.parts.samples import PartSamples
from netkf.checks.parts.sources import stated_part
from netkf.checks.statistics import (
    Interval,
    deviation_interval,
    probability_interval,
    student_interval,
)
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import GilbertElliott, delay_depends_on_message
from netkf.network.clocks import LinkClock
from netkf.network.matchings import Matching
from netkf.network.recorded import RecordedLoss
from netkf.scenario.scenario import Scenario

PROBABILITY_TOLERANCE = 0.05
MIN_EVENTS = 20
"""Runs in which something has to happen before their spread is used."""


def _stated_loss(scenario: Scenario) -> Any:
    """Return the loss whose law the scenario states."""
    return stated_part(scenario.network.channel.loss, "loss")


@lru_cache(maxsize=8)
def loss_probabilities(scenario: Scenario) -> FloatArray:
    """Return the stated long-run loss (D,) of each direction; nan if unknown before a run."""
    loss, directions = _stated_loss(scenario), scenario.topology.directions
    kept = [loss.mean_delivery(d, scenario.table_probability(d)) for d in directions]
    return 1.0 - np.array(kept)


def _direction_label(scenario: Scenario, k: int) -> str:
    """Return the label of direction ``k``."""
    sender, receiver = scenario.topology.directions[k]
    return f"from {sender} to {receiver}"


def _check_losses(samples: PartSamples, level: float) -> Finding:
    """Compare lost shares with the stated ones, all directions together and one by one."""
    scenario, counts = samples.scenario, samples.fates
    q = loss_probabilities(scenario)
    sent, lost = counts.sent.sum(axis=1), counts.lost.sum(axis=1)
    used = np.flatnonzero(sent.sum(axis=0) > 0)
    intervals = [(_loss_interval(scenario, sent, lost, q, used, level / 3.0), "all directions")]
    windows = np.flatnonzero(counts.sent.sum(axis=(0, 2)) > 0)
    for w in windows.tolist() if counts.sent.shape[1] > 1 else ():
        part = counts.sent[:, w], counts.lost[:, w]
        found = _loss_interval(scenario, *part, q, used, level / (3.0 * len(windows)))
        label = f"all directions in part {w + 1} of {counts.sent.shape[1]} of the run"
        intervals.append((found, label))
    share = level / (3.0 * max(len(used), 1))
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
    messages of a run beyond their expected loss has the mean 0. Where few runs lost any, or few
    delivered any, their spread says little: limits are those of independent messages if that is
    what is stated, else they hold for every law of a run.
    """
    total, runs = float(sent[:, which].sum()), len(sent)
    excess = (lost[:, which] - sent[:, which] * q[which]).sum(axis=1)
    expected = float((sent[:, which] * q[which]).sum()) / total
    if len(which) == 1 and _is_independent(scenario):
        found = probability_interval(int(lost[:, which].sum()), int(total), level)
        return deviation_interval(expected, found)
    some = lost[:, which].sum(axis=1), (sent[:, which] - lost[:, which]).sum(axis=1)
    few = min(np.count_nonzero(part) for part in some) < MIN_EVENTS
    if few and _is_independent(scenario):
        # The sum of independent losses of unequal probabilities has lighter tails than that of
        # equal ones (Hoeffding 1956). Both directions of a link may share one loss.
        each = 2 if scenario.network.channel.symmetric else 1
        found = probability_interval(int(some[0].sum()) // each, int(total) // each, level)
        return deviation_interval(expected, found)
    if few:
        found = _share_of_bounded_runs(excess, sent[:, which].sum(axis=1), expected, level)
        return deviation_interval(expected, found)
    # A spread of at least one message of all: a few rare losses may show none.
    spread = math.sqrt(max(float(excess.var(ddof=1)) * runs, 1.0))
    estimate = expected + float(excess.sum()) / total
    return deviation_interval(expected, student_interval(estimate, spread / total, runs, level))


def _share_of_bounded_runs(
    excess: FloatArray, sent: np.ndarray, expected: float, level: float
) -> Interval:
    """Return an interval for the lost share of messages, which holds for every law of a run.

    ``excess`` (R,) is the number of messages lost in each run less the expected one, of ``sent``
    (R,), and ``expected`` the stated share. By Hoeffding's bound, R independent numbers in [0, 1]
    with mean m have an average of f or beyond with a probability of at most exp(-R KL(f, m)).
    """
    runs, most = len(sent), float(sent.max())
    # The numbers are lost messages over ``most``; their mean is the share over ``scale``.
    scale = most * runs / float(sent.sum())
    # Directions that lose unequal shares can take it slightly out of [0, 1].
    found = min(max(expected + float(excess.mean()) / most, 0.0), 1.0)

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another share and ``factor`` times the runs."""
        near = min(max(expected + (value - expected) / scale, 0.0), 1.0)
        limit = math.log(2.0 / level) / (factor * runs)
        low, high = (_share_at(near, end, limit) for end in (0.0, 1.0))
        return expected + scale * (low - expected), expected + scale * (high - expected)

    value = expected + scale * (found - expected)
    low, high = limits(value, 1.0)
    return Interval(value, low, high, max(expected - low, high - expected), again=limits)


def _share_at(found: float, end: float, limit: float) -> float:
    """Return the mean from ``found`` towards ``end``, 0 or 1, whose divergence is ``limit``."""
    near, far = found, end
    for _ in range(60):
        middle = 0.5 * (near + far)
        parts = scipy.special.rel_entr([found, 1.0 - found], [middle, 1.0 - middle])
        if float(parts.sum()) > limit:
            far = middle
        else:
            near = middle
    return near


def _is_independent(scenario: Scenario) -> bool:
    """Return True if messages are lost independently of each other: by what is stated, and because
    each has an outcome of its own; a filter may hold those of a link for several exchanges.
    """
    filter_ = scenario.hosted
    if scenario.slotted:
        phases = range((filter_.schedule or ()).count("exchange"))
        steps = [(phase, k) for phase in phases for k in range(filter_.exchange_steps(phase))]
        if not all(filter_.redraws_links(*step) for step in steps):
            return False
    return bool(_stated_loss(scenario).independent)


def _losses_apart(samples: PartSamples, level: float) -> Finding:
    """Test that losses are independent from message to message, between both directions where they
    do not share one fate, and between links.
    """
    scenario, counts = samples.scenario, samples.fates
    q, sent = loss_probabilities(scenario), counts.sent.sum(axis=1)
    pairs = np.maximum(sent - 1, 0)
    # Where both directions of a link share one fate, each is counted twice.
    repeated = _neighbours_variance(q) * (2.0 if scenario.network.channel.symmetric else 1.0)
    jobs = [("a message and the one before", counts.repeated, pairs, q, repeated)]
    if _directions_apart(scenario):
        # In each of two directions of a link the same pairs are counted: messages of one number.
        back = reversed_directions(scenario)
        pairs = np.where(back >= 0, np.minimum(sent, sent[:, back]), 0)
        joint = q * q[back]
        # Each pair is counted in both directions.
        variance = 2.0 * joint * (1.0 - joint)
        jobs.append(("both directions of a link", counts.both, pairs, q[back], variance))
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


def _check_bursts(samples: PartSamples, level: float) -> Finding:
    """Compare how often a message is lost after another loss with the chain that is stated."""
    scenario, counts = samples.scenario, samples.fates
    loss, q = _stated_loss(scenario), loss_probabilities(scenario)
    runs, followed = len(counts.sent), counts.followed.sum(axis=1)
    total = float(followed.sum())
    if total < MIN_COUNT or np.count_nonzero(followed) < MIN_EVENTS:
        return nothing_to_see(PROBABILITY_TOLERANCE)
    again = loss_twice(loss) / float(q.mean())
    excess = counts.repeated.sum(axis=1) - again * followed
    # At least the spread of independent pairs: a few rare ones may show none.
    least = max(total * again * (1.0 - again), 1.0)
    spread = math.sqrt(max(float(excess.var(ddof=1)) * runs, least)) / total
    estimate = again + float(excess.sum()) / total
    apart = deviation_interval(again, student_interval(estimate, spread, runs, level))
    message = f"{total:,.0f} losses, after which the next message is lost with a probability off"
    return find_largest([(apart, "all directions")], PROBABILITY_TOLERANCE, message)


def loss_twice(chain: GilbertElliott) -> float:
    """Return the probability that two messages in a row are lost, by the chain of the losses."""
    to_bad, to_good = chain.transitions
    start = np.array([to_good, to_bad]) / (to_bad + to_good)
    step = np.array([[1.0 - to_bad, to_bad], [to_good, 1.0 - to_good]])
    kept = [chain.delivery_probability((0, 1), 0, bad, 1.0) for bad in (False, True)]
    lost = 1.0 - np.array(kept)
    return float((start * lost) @ step @ lost)


def _one_step_a_message(scenario: Scenario) -> bool:
    """Return True if the chain of a direction makes one step for each of its messages."""
    clock, channel = scenario.network.activation, scenario.network.channel
    if isinstance(clock, Matching):
        return True
    at_once = isinstance(clock, LinkClock) and clock.at == "links"
    return at_once or (isinstance(clock, LinkClock) and not channel.symmetric)


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
    """Return an interval for the correlation of the two events of a pair, from R independent runs;
    None with too few.

    excess   : (R, D) number of pairs in which both events happened, less its expected value if
               they are independent
    count    : (R, D) number of pairs
    scale    : (D,) product of the standard deviations of both events
    variance : (D,) variance of ``excess`` for each pair if all events are independent, covariances
               with overlapping pairs included
    """
    weight = float((count * scale).sum())
    if not weight > 0.0 or len(excess) < MIN_RUNS:
        return None
    values = excess.sum(axis=1)
    runs = len(values)
    # Rare events may by chance vary less between runs than their law says.
    least = float((count * variance).sum())
    spread = math.sqrt(max(float(values.var(ddof=1)) * runs, least, 1.0))
    estimate = float(values.sum()) / weight
    return deviation_interval(0.0, student_interval(estimate, spread / weight, runs, level))


def _links_apart(samples: PartSamples, level: float) -> list[tuple[Interval, str]]:
    """Return the correlations of losses between links: those that are largest, from the counts of
    runs.
    """
    scenario, counts = samples.scenario, samples.fates
    # One direction of a link stands for both, which may share their fates.
    estimate: dict[tuple[int, int], int] = {}
    for k, (i, j) in enumerate(scenario.topology.directions):
        estimate.setdefault((min(i, j), max(i, j)), k)
    columns = np.array(list(estimate.values()))
    excess = (counts.lost - counts.sent * loss_probabilities(scenario)).reshape(
        -1, counts.sent.shape[2]
    )
    excess = excess[:, columns]
    found = largest_correlation(excess, level / 2.0)
    if found is None:
        return []
    interval, (a, b) = found
    first, second = (_direction_label(scenario, int(columns[k])) for k in (a, b))
    intervals = [(interval, f"correlation of losses {first} and {second}")]
    mean = _mean_correlation(excess, _loss_variances(samples)[:, columns], level / 2.0)
    if mean is not None:
        # Correlations of some pairs cancel others only by design; a common cause adds up.
        intervals.append((deviation_interval(0.0, mean), "mean correlation of losses of all links"))
    return intervals


def _loss_variances(samples: PartSamples) -> FloatArray:
    """Return the variance (K, D) of the losses of each direction in a part of a run, given how many
    messages were sent in it.
    """
    sent, q = samples.fates.sent, loss_probabilities(samples.scenario)
    return np.asarray((sent * (q * (1.0 - q))).reshape(-1, sent.shape[2]))


def _mean_correlation(excess: FloatArray, variance: FloatArray, level: float) -> Interval | None:
    """Return an interval for the correlation of losses of two links, the same for all of them, from
    ``excess`` (K, L) over the means in K parts of runs; None if no part has losses of two links.

    Given what was sent products of two independent links have mean 0 and the variance that those of
    the links have as product: a part in which little was sent says little.
    """
    deviation = np.sqrt(variance)
    products = (excess.sum(axis=1) ** 2 - (excess**2).sum(axis=1)) / 2.0
    scale = float((deviation.sum(axis=1) ** 2 - variance.sum(axis=1)).sum()) / 2.0
    spreads = (variance.sum(axis=1) ** 2 - (variance**2).sum(axis=1)) / 2.0
    total = float(spreads.sum())
    # As many parts as there would be if all said the same.
    parts = total**2 / float((spreads**2).sum()) if total > 0.0 else 0.0
    if not parts >= MIN_RUNS:
        return None
    # Losses of links that are related spread more than the stated ones.
    spread = math.sqrt(max(total, float((products**2).sum())))
    return student_interval(float(products.sum()) / scale, spread / scale, int(parts), level)


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


def _check_matchings(samples: PartSamples, level: float) -> Finding:
    """Compare how often links are paired with the mean matching, in all slots and in two
    neighbouring ones.
    """
    scenario, pairs = samples.scenario, samples.pairs
    p = pair_probabilities(scenario)
    assert p is not None
    slots, runs = float(pairs.slots[0]), len(pairs.paired)
    share = level / (3.0 * len(p))
    # A few rare pairs may show no spread: there is at least that of one pair in all runs.
    number = pairs.paired.sum(axis=1) / slots
    spread = max(float(number.std(ddof=1)) / math.sqrt(runs), 1.0 / (runs * slots))
    together = student_interval(float(number.mean()), spread, runs, level / 3.0)
    intervals = [(deviation_interval(float(p.sum()), together), "pairs in a slot, of all links")]
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
    return with_best(intervals, PROBABILITY_TOLERANCE, message)


LOSSES = Promise(
    "messages are lost as often as the scenario says, in each direction",
    "the scenario",
    (),
    _check_losses,
)
LOSSES_APART = Promise(
    "messages are lost independently of each other", "the scenario", (), _losses_apart
)
BURSTS = Promise("losses follow each other as the scenario says", "the scenario", (), _check_bursts)
MATCHINGS = Promise(
    "links are paired as often as the protocol says, whatever happened before",
    "the scenario",
    (),
    _check_matchings,
)


def network_promises(samples: PartSamples) -> list[Promise]:
    """Return the promises about the network that have a stated law and were seen in the runs."""
    found = clock_promises(samples)
    scenario = samples.scenario
    drawn = samples.pairs is not None and scenario.hosted.talks
    if drawn and pair_probabilities(scenario) is not None:
        found.append(MATCHINGS)
    # A delay that depends on the message may lose it (nan), which the law of losses does not state.
    losses_are_stated = not delay_depends_on_message(scenario.network.channel.delay)
    recorded = isinstance(_stated_loss(scenario), RecordedLoss)
    sent = samples.fates is not None and samples.fates.sent.any()
    if sent and losses_are_stated and not recorded:
        q = loss_probabilities(scenario)
        if np.isfinite(q).all():
            found.append(LOSSES)
            if _is_independent(scenario) and ((q > 0.0) & (q < 1.0)).any():
                found.append(LOSSES_APART)
            if type(_stated_loss(scenario)) is GilbertElliott and _one_step_a_message(scenario):
                found.append(BURSTS)
    return found + delay_promises(samples)
