"""Promises about clocks, channels and matchings, from the counts of many runs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.special

from netkf.checks.evidence import LOSSES, MATCHINGS, Assumption, Finding, Promise
from netkf.checks.laws import find_largest
from netkf.checks.parts.clock_rows import clock_promises, largest_correlation
from netkf.checks.parts.delays import delay_promises
from netkf.checks.parts.events import reversed_directions, shares_draws
from netkf.checks.parts.moments import (
    CORRELATION_TOLERANCE,
    MIN_COUNT,
    MIN_EVENTS,
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
from netkf.theory.common.random_links import has_constant_losses, has_recorded_broadcasts

PROBABILITY_TOLERANCE = 0.05
"""Tolerated error of a share of messages or slots."""


def _stated_loss(scenario: Scenario) -> Any:
    """Return the loss whose law the scenario states."""
    return stated_part(scenario.network.channel.loss, "loss")


@lru_cache(maxsize=8)
def loss_probabilities(scenario: Scenario) -> FloatArray:
    """Return the stated long-run probability (D,) that a message is lost on each of D directions
    (directed links); nan if unknown before a run.
    """
    loss, directions = _stated_loss(scenario), scenario.topology.directions
    delivery = [loss.mean_delivery(d, scenario.table_probability(d)) for d in directions]
    return 1.0 - np.array(delivery)


def _direction_label(scenario: Scenario, k: int) -> str:
    """Return the label of direction ``k``."""
    sender, receiver = scenario.topology.directions[k]
    return f"from {sender} to {receiver}"


def _check_losses(samples: PartSamples, level: float) -> Finding:
    """Test the null hypothesis that each direction (directed link) loses its stated share of
    messages.

    Three groups of comparisons get level / 3 each: all directions together, the same in each window
    of the run, and every direction.
    """
    scenario, counts = samples.scenario, samples.fates
    q = loss_probabilities(scenario)
    # Messages (R, D) of each run and direction, and the indices of directions with any.
    sent, lost = counts.sent.sum(axis=1), counts.lost.sum(axis=1)
    in_use = np.flatnonzero(sent.sum(axis=0) > 0)
    intervals = [(_loss_interval(scenario, sent, lost, q, in_use, level / 3.0), "all directions")]
    windows = np.flatnonzero(counts.sent.sum(axis=(0, 2)) > 0)
    # Windows show losses that change with time, as those of a user's class may do by design.
    steady = counts.sent.shape[1] > 1 and has_constant_losses(scenario)
    for w in windows.tolist() if steady else ():
        window_counts = counts.sent[:, w], counts.lost[:, w]
        interval = _loss_interval(scenario, *window_counts, q, in_use, level / (3.0 * len(windows)))
        label = f"all directions in part {w + 1} of {counts.sent.shape[1]} of the run"
        intervals.append((interval, label))
    single_level = level / (3.0 * max(len(in_use), 1))
    for k in in_use.tolist():
        direction = np.array([k])
        interval = _loss_interval(scenario, sent, lost, q, direction, single_level)
        intervals.append((interval, _direction_label(scenario, k)))
    message = f"{sent.sum():,.0f} messages, difference of the lost share"
    return with_best(intervals, PROBABILITY_TOLERANCE, message)


def _loss_interval(
    scenario: Scenario,
    sent: np.ndarray,
    lost: np.ndarray,
    q: FloatArray,
    directions: np.ndarray,
    level: float,
) -> Interval:
    """Return an interval for the distance between the lost and the stated share of messages.

    ``sent`` and ``lost`` (R, D) are counts of R runs, ``q`` (D,) stated probabilities of loss; only
    ``directions`` (indices) count. Independent losses of one direction have the exact limits of
    Clopper and Pearson. Otherwise the R runs are the independent values: losses of a run less their
    expected number have mean 0, and Student's interval applies. Where losses (or deliveries) occur
    in fewer than MIN_EVENTS runs, their sample variance is unreliable: limits are then those of
    independent messages if independence is stated, else those of :func:`_share_of_bounded_runs`.

    The interval misses the truth with at most the probability ``level``.
    """
    total, runs = float(sent[:, directions].sum()), len(sent)
    excess = (lost[:, directions] - sent[:, directions] * q[directions]).sum(axis=1)
    expected = float((sent[:, directions] * q[directions]).sum()) / total
    if len(directions) == 1 and _is_independent(scenario):
        limits = probability_interval(int(lost[:, directions].sum()), int(total), level)
        return deviation_interval(expected, limits)
    outcomes = (
        lost[:, directions].sum(axis=1),
        (sent[:, directions] - lost[:, directions]).sum(axis=1),
    )
    rare = min(np.count_nonzero(outcome) for outcome in outcomes) < MIN_EVENTS
    if rare and _is_independent(scenario):
        # The sum of independent losses of unequal probabilities has lighter tails than that of
        # equal ones (Hoeffding 1956). Both directions of a link may share one loss.
        messages_per_draw = 2 if scenario.network.channel.symmetric else 1
        limits = probability_interval(
            int(outcomes[0].sum()) // messages_per_draw, int(total) // messages_per_draw, level
        )
        return deviation_interval(expected, limits)
    if rare:
        limits = _share_of_bounded_runs(excess, sent[:, directions].sum(axis=1), expected, level)
        return deviation_interval(expected, limits)
    # Few runs may show too little spread by chance: at least that of one message, and as stated.
    stated = float((sent * (q * (1.0 - q)))[:, directions].sum()) * _variance_factor(scenario)
    spread = math.sqrt(max(float(excess.var(ddof=1)) * runs, stated, 1.0))
    estimate = expected + float(excess.sum()) / total
    return deviation_interval(expected, student_interval(estimate, spread / total, runs, level))


@lru_cache(maxsize=8)
def _variance_factor(scenario: Scenario) -> float:
    """Return the factor by which bursts and shared draws raise the variance of the number of losses
    over that of independent messages, in long runs; at least 1.
    """
    shared = 2.0 if len(scenario.topology.directions) and shares_draws(scenario).any() else 1.0
    loss = _stated_loss(scenario)
    if type(loss) is not GilbertElliott or not _one_step_a_message(scenario):
        return shared
    q = 1.0 - loss.mean_delivery((0, 1), 1.0)
    # Correlations of a two-state chain decay geometrically, by the second eigenvalue of its steps.
    memory = 1.0 - sum(loss.transitions)
    neighbours = loss_twice(loss) - q**2
    spread = q * (1.0 - q)
    if not spread > 0.0 or not memory < 1.0:
        return shared
    return shared * max(1.0, 1.0 + 2.0 * neighbours / spread / (1.0 - memory))


def _share_of_bounded_runs(
    excess: FloatArray, sent: np.ndarray, expected: float, level: float
) -> Interval:
    """Return an interval for the lost share of messages that holds whatever the law of the losses
    within a run, for losses too rare for a sample variance; only runs are independent.

    ``excess`` (R,) is the number of messages lost in each run less the expected number, ``sent``
    (R,) the number of messages, ``expected`` the stated share. By Hoeffding's bound
    (1963, Theorem 1) the average of R independent numbers in [0, 1] with mean m is f, or further
    from m, with a probability of at most exp(-R KL(f, m)), KL the Kullback-Leibler divergence of
    Bernoulli laws. The interval misses the truth with at most the probability ``level``.
    """
    runs, max_sent = len(sent), float(sent.max())
    # The numbers are lost messages over ``max_sent``; their mean is the share over ``scale``.
    scale = max_sent * runs / float(sent.sum())
    # Directions that lose unequal shares can take it slightly out of [0, 1].
    mean = min(max(expected + float(excess.mean()) / max_sent, 0.0), 1.0)

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another share and ``factor`` times the runs."""
        centre = min(max(expected + (value - expected) / scale, 0.0), 1.0)
        limit = math.log(2.0 / level) / (factor * runs)
        low, high = (_share_at(centre, end, limit) for end in (0.0, 1.0))
        return expected + scale * (low - expected), expected + scale * (high - expected)

    value = expected + scale * (mean - expected)
    low, high = limits(value, 1.0)
    return Interval(value, low, high, max(expected - low, high - expected), again=limits)


def _share_at(centre: float, end: float, limit: float) -> float:
    """Return a limit of Hoeffding's interval for a probability estimated as ``centre``: the m
    between ``centre`` and ``end`` (0 or 1) at which the Kullback-Leibler divergence KL(centre, m)
    of Bernoulli laws is ``limit``, by bisection; m is ``end`` if the divergence stays below it.
    """
    inner, outer = centre, end
    for _ in range(60):
        middle = 0.5 * (inner + outer)
        divergence = scipy.special.rel_entr([centre, 1.0 - centre], [middle, 1.0 - middle])
        if float(divergence.sum()) > limit:
            outer = middle
        else:
            inner = middle
    return inner


def _is_independent(scenario: Scenario) -> bool:
    """Return True if the scenario states that messages are lost independently of each other.

    The loss must state so, and every exchange must redraw the links: a filter may keep the outcome
    of a link for several exchanges of a slot.
    """
    filter_ = scenario.node_filter
    if scenario.slotted:
        # A slot has phases in which nodes exchange, and each of these one or more exchanges.
        phases = range((filter_.schedule or ()).count("exchange"))
        steps = [(phase, k) for phase in phases for k in range(filter_.exchange_steps(phase))]
        if not all(filter_.redraws_links(*step) for step in steps):
            return False
    return bool(_stated_loss(scenario).independent)


def _losses_apart(samples: PartSamples, level: float) -> Finding:
    """Test the null hypothesis that messages are lost independently of each other.

    Under it consecutive messages of a direction, messages of the same number in opposite directions
    (unless both share one draw), and different links have uncorrelated losses; each of the three
    tests gets a third of the level.
    """
    scenario, counts = samples.scenario, samples.fates
    q, sent = loss_probabilities(scenario), counts.sent.sum(axis=1)
    # Each job compares the number of pairs of messages that were both lost with its expected value:
    # (label, number of these pairs, number of all pairs, loss probability of the second message of
    # a pair, variance of the former number for each pair), over R runs and D directions.
    pairs = np.maximum(sent - 1, 0)
    # Where both directions of a link share one draw, each event is counted twice.
    repeated_variance = _neighbours_variance(q) * (
        2.0 if scenario.network.channel.symmetric else 1.0
    )
    jobs = [("a message and the one before", counts.repeated, pairs, q, repeated_variance)]
    if _directions_apart(scenario):
        # A pair is two messages of the same number in opposite directions of a link.
        opposite = reversed_directions(scenario)
        pairs = np.where(opposite >= 0, np.minimum(sent, sent[:, opposite]), 0)
        joint = q * q[opposite]
        # Each pair is counted in both directions.
        variance = 2.0 * joint * (1.0 - joint)
        jobs.append(("both directions of a link", counts.both, pairs, q[opposite], variance))
    intervals = []
    for label, observed, count, other_q, variance in jobs:
        scale = np.sqrt(q * (1.0 - q) * other_q * (1.0 - other_q))
        interval = _correlation_of_runs(
            observed - count * q * other_q, count, scale, variance, level / 3.0
        )
        if interval is not None:
            intervals.append((interval, f"correlation of {label}"))
    intervals += _links_apart(samples, level / 3.0)
    if not intervals:
        return nothing_to_see(CORRELATION_TOLERANCE)
    return find_largest(intervals, CORRELATION_TOLERANCE, "largest difference")


def _check_bursts(samples: PartSamples, level: float) -> Finding:
    """Test the null hypothesis that losses follow the stated two-state (Gilbert-Elliott) chain.

    Compared is the probability that the message after a lost one is lost too, by Student's interval
    over the runs. The interval of the finding misses the truth with at most the probability
    ``level``.
    """
    scenario, counts = samples.scenario, samples.fates
    loss, q = _stated_loss(scenario), loss_probabilities(scenario)
    runs, followed = len(counts.sent), counts.followed.sum(axis=1)
    total = float(followed.sum())
    if total < MIN_COUNT or np.count_nonzero(followed) < MIN_EVENTS:
        return nothing_to_see(PROBABILITY_TOLERANCE)
    probability = loss_twice(loss) / float(q.mean())
    excess = counts.repeated.sum(axis=1) - probability * followed
    # At least the variance of independent pairs: a few rare losses may show no variance.
    min_variance = max(total * probability * (1.0 - probability), 1.0)
    spread = math.sqrt(max(float(excess.var(ddof=1)) * runs, min_variance)) / total
    estimate = probability + float(excess.sum()) / total
    distance = deviation_interval(probability, student_interval(estimate, spread, runs, level))
    message = f"{total:,.0f} losses, after which the next message is lost with a probability off"
    return find_largest([(distance, "all directions")], PROBABILITY_TOLERANCE, message)


def loss_twice(chain: GilbertElliott) -> float:
    """Return the probability that two consecutive messages are lost, in the stationary chain."""
    to_bad, to_good = chain.transitions
    start = np.array([to_good, to_bad]) / (to_bad + to_good)
    step = np.array([[1.0 - to_bad, to_bad], [to_good, 1.0 - to_good]])
    delivery = [chain.delivery_probability((0, 1), 0, bad, 1.0) for bad in (False, True)]
    lost = 1.0 - np.array(delivery)
    return float((start * lost) @ step @ lost)


def _one_step_a_message(scenario: Scenario) -> bool:
    """Return True if the two-state chain of losses of a direction (directed link) makes one step
    for each of its messages, so that the loss after a loss can be compared with the chain's.
    """
    clock, channel = scenario.network.activation, scenario.network.channel
    if isinstance(clock, Matching):
        return True
    # Broadcasts of two nodes at different times would both step a chain that they share.
    at_once = isinstance(clock, LinkClock) and clock.at == "links"
    return at_once or (isinstance(clock, LinkClock) and not channel.symmetric)


def _neighbours_variance(p: Any) -> Any:
    """Return the variance, divided by the number of pairs, of the number of neighbouring pairs in
    which both events occur, in a long series of independent events of probability p.

    It is Var(x_k x_{k+1}) + 2 Cov(x_k x_{k+1}, x_{k+1} x_{k+2}): overlapping pairs share an event.
    """
    return p**2 * (1.0 - p**2) + 2.0 * p**3 * (1.0 - p)


def _directions_apart(scenario: Scenario) -> bool:
    """Return True if both directions of a link carry messages at once but draw their own losses, so
    that it can be tested whether the two are independent.
    """
    clock = scenario.network.activation
    at_once = getattr(clock, "at", "links") == "links"
    return at_once and not scenario.network.channel.symmetric


def _correlation_of_runs(
    excess: FloatArray, count: np.ndarray, scale: FloatArray, variance: FloatArray, level: float
) -> Interval | None:
    """Return an interval for the correlation of two events, such as the losses of two successive
    messages, from how often both happened in R independent runs with D directions (or links); None
    with fewer than MIN_RUNS runs.

    excess   : (R, D) number of pairs in which both events happened, less its expected value if
               they are independent
    count    : (R, D) number of pairs
    scale    : (D,) product of the standard deviations of both events
    variance : (D,) variance of ``excess`` for each pair if all events are independent, covariances
               with overlapping pairs included

    The interval misses the truth with at most the probability ``level``.
    """
    weight = float((count * scale).sum())
    if not weight > 0.0 or len(excess) < MIN_RUNS:
        return None
    values = excess.sum(axis=1)
    runs = len(values)
    # At least the variance under independence: rare events may vary less by chance.
    min_variance = float((count * variance).sum())
    spread = math.sqrt(max(float(values.var(ddof=1)) * runs, min_variance, 1.0))
    estimate = float(values.sum()) / weight
    return deviation_interval(0.0, student_interval(estimate, spread / weight, runs, level))


def _links_apart(samples: PartSamples, level: float) -> list[tuple[Interval, str]]:
    """Return labelled intervals for the largest and for the mean correlation of the numbers of
    losses of two links, from their counts in the windows (equal parts) of all runs.

    The probability that any of them misses the truth is at most ``level``.
    """
    scenario, counts = samples.scenario, samples.fates
    # One direction of a link stands for both, which may share their draws.
    direction_of_link: dict[tuple[int, int], int] = {}
    for k, (i, j) in enumerate(scenario.topology.directions):
        direction_of_link.setdefault((min(i, j), max(i, j)), k)
    columns = np.array(list(direction_of_link.values()))
    excess = (counts.lost - counts.sent * loss_probabilities(scenario)).reshape(
        -1, counts.sent.shape[2]
    )
    excess, variances = excess[:, columns], _loss_variances(samples)[:, columns]
    intervals, largest = [], largest_correlation(excess, variances, level / 2.0)
    if largest is not None:
        interval, (a, b) = largest
        first, second = (_direction_label(scenario, int(columns[k])) for k in (a, b))
        intervals.append((interval, f"correlation of losses {first} and {second}"))
    mean = _mean_correlation(excess, variances, level / 2.0)
    if mean is not None:
        # A common cause of losses correlates all pairs a little, which shows best in the mean.
        intervals.append((deviation_interval(0.0, mean), "mean correlation of losses of all links"))
    return intervals


def _loss_variances(samples: PartSamples) -> FloatArray:
    """Return the variance (K, D) of the number of losses of each direction in each of K windows of
    runs, given how many messages were sent in it.
    """
    sent, q = samples.fates.sent, loss_probabilities(samples.scenario)
    return np.asarray((sent * (q * (1.0 - q))).reshape(-1, sent.shape[2]))


def _mean_correlation(excess: FloatArray, variance: FloatArray, level: float) -> Interval | None:
    """Return an interval for the mean correlation of the losses of two links; None if too few
    windows have losses of two links.

    ``excess`` (K, L) are the losses of L links in K windows of runs less their expected numbers,
    and ``variance`` (K, L) their variances under independence. The estimate is the sum over windows
    and pairs of links of the products of two excesses, each of mean 0 under independence, over the
    sum of the products of their standard deviations. The interval misses the truth with at most the
    probability ``level``.
    """
    deviation = np.sqrt(variance)
    # The sum of x_i x_j over all pairs i < j is ((sum x)^2 - sum x^2) / 2.
    products = (excess.sum(axis=1) ** 2 - (excess**2).sum(axis=1)) / 2.0
    scale = float((deviation.sum(axis=1) ** 2 - variance.sum(axis=1)).sum()) / 2.0
    spreads = (variance.sum(axis=1) ** 2 - (variance**2).sum(axis=1)) / 2.0
    total = float(spreads.sum())
    # The effective number of windows, those with few messages counting less.
    effective_count = total**2 / float((spreads**2).sum()) if total > 0.0 else 0.0
    if not effective_count >= MIN_RUNS:
        return None
    # Correlated losses have products of larger variance than independent ones.
    spread = math.sqrt(max(total, float((products**2).sum())))
    return student_interval(
        float(products.sum()) / scale, spread / scale, int(effective_count), level
    )


@lru_cache(maxsize=8)
def pair_probabilities(scenario: Scenario) -> FloatArray | None:
    """Return the stated probability (L,) that each of L links is in the matching of a slot (the
    pairs of nodes that exchange); None if it is not known.
    """
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
    """Test the null hypothesis that matchings (the pairs of nodes that exchange in a slot) contain
    each link with its stated probability and are independent.

    Compared with the mean matching are the number of pairs in a slot (Student's interval over the
    runs) and the probability that each link is paired (Clopper and Pearson); and a link that is
    paired in one slot must not be correlated with itself in the next. The interval of the finding
    misses the truth with at most the probability ``level``.
    """
    scenario, pairs = samples.scenario, samples.pairs
    p = pair_probabilities(scenario)
    assert p is not None
    slots, runs = float(pairs.slots[0]), len(pairs.paired)
    single_level = level / (3.0 * len(p))
    # At least the deviation of one pair in all slots of all runs: rare pairs may show none.
    pairs_per_slot = pairs.paired.sum(axis=1) / slots
    spread = max(float(pairs_per_slot.std(ddof=1)) / math.sqrt(runs), 1.0 / (runs * slots))
    mean_pairs = student_interval(float(pairs_per_slot.mean()), spread, runs, level / 3.0)
    intervals = [(deviation_interval(float(p.sum()), mean_pairs), "pairs in a slot, of all links")]
    for k, link in enumerate(scenario.topology.links):
        label = f"link {link[0]}-{link[1]}"
        limits = probability_interval(
            int(pairs.paired[:, k].sum()), int(runs * slots), single_level
        )
        intervals.append((deviation_interval(float(p[k]), limits), label))
        repeated = pairs.repeated[:, k].astype(float)
        if slots < 2.0 or not 0.0 < p[k] < 1.0:
            continue
        # Neighbouring pairs of slots overlap, so that only runs are independent values.
        excess = (repeated - (slots - 1.0) * p[k] ** 2)[:, None]
        correlation = _correlation_of_runs(
            excess,
            np.full((runs, 1), slots - 1.0),
            np.array([p[k] * (1.0 - p[k])]),
            np.array([_neighbours_variance(float(p[k]))]),
            single_level,
        )
        if correlation is not None:
            intervals.append((correlation, f"{label} and the slot before, their correlation"))
    message = f"{runs * slots:,.0f} slots, largest difference of a share"
    return with_best(intervals, PROBABILITY_TOLERANCE, message)


DRAWN, STATED = "losses are drawn, not recorded", "losses state how often messages are lost"
SAME = "all messages of a link are lost with one probability"
LOSS_ROW = Promise(
    "messages are lost as often as the scenario says, in each direction",
    "the scenario",
    (DRAWN, STATED),
    _check_losses,
    group=LOSSES,
)
LOSSES_APART = Promise(
    "messages are lost independently of each other",
    "the scenario",
    (DRAWN, STATED, SAME),
    _losses_apart,
    group=LOSSES,
)
BURSTS = Promise(
    "losses follow each other as the scenario says",
    "the scenario",
    (DRAWN, STATED),
    _check_bursts,
    group=LOSSES,
)
MATCHING_ROW = Promise(
    "links are paired as often as the protocol says, whatever happened before",
    "the scenario",
    (),
    _check_matchings,
    group=MATCHINGS,
)


def loss_assumptions(scenario: Scenario) -> list[Assumption]:
    """Return the assumptions of tests of losses, each with whether it holds: there is a law, it is
    stated, and it is the same for all messages of a link.
    """
    channel = scenario.network.channel
    drawn, evidence = True, "links are up unless a message is lost"
    if isinstance(_stated_loss(scenario), RecordedLoss):
        drawn, evidence = False, "a table lists which messages arrive"
    elif delay_depends_on_message(channel.delay):
        # Such a delay may lose a message (nan), which the law of losses does not state.
        drawn, evidence = False, "delays depend on the message, and may lose it"
    elif has_recorded_broadcasts(scenario):
        drawn, evidence = False, "a table lists the links that are up; others lose their messages"
    source, name = "the scenario", type(channel.loss).__name__
    stated = bool(np.isfinite(loss_probabilities(scenario)).all())
    same = has_constant_losses(scenario)
    return [
        Assumption(DRAWN, source, drawn, evidence),
        Assumption(STATED, source, stated, "for each link" if stated else f"{name} does not"),
        Assumption(SAME, source, same, "" if same else f"{name} changes it with the message"),
    ]


def network_promises(samples: PartSamples) -> list[Promise]:
    """Return what the scenario states about its clocks, matchings, losses and delays, as promises
    that the runs can test; parts without a stated law have none.
    """
    promises = clock_promises(samples)
    scenario = samples.scenario
    drawn = samples.pairs is not None and scenario.node_filter.talks
    if drawn and pair_probabilities(scenario) is not None:
        promises.append(MATCHING_ROW)
    if samples.fates is not None and samples.fates.sent.any():
        q = loss_probabilities(scenario)
        promises.append(LOSS_ROW)
        if _is_independent(scenario) and ((q > 0.0) & (q < 1.0)).any():
            promises.append(LOSSES_APART)
        if type(_stated_loss(scenario)) is GilbertElliott and _one_step_a_message(scenario):
            promises.append(BURSTS)
    return promises + delay_promises(samples)
