"""Losses and delays of messages, and pairs of matchings, against what parts state of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.core.laws import Chain, WaitingLaw
from netkf.laws.intervals import (
    NO_COMPARISON,
    Interval,
    LawComparison,
    deviation_interval,
    excess_interval,
    normal_interval,
    probability_interval,
    student_interval,
)
from netkf.laws.ticks import (
    CELLS,
    MIN_EVENTS,
    WINDOWS,
    censored_ranks,
    compare_shares,
    correlate_neighbours,
    count_ranks,
    fill_in,
    largest_correlation,
    neighbour_correlation,
)
from netkf.linalg.arrays import FloatArray, IntArray

MIN_COUNT, MIN_RUNS = 20, 10
"""Losses after which the next message is looked at, and runs from whose spread an interval is
computed.
"""


class LossLaw(NamedTuple):
    """What is stated of the losses on D directions (directed links).

    lost        : (D,) long-run probability that a message is lost, nan if unknown
    independent : messages are lost independently of each other
    chain       : the two-state chain that makes one step with each message, None without one
    opposite    : (D,) index of the opposite direction, -1 without one
    links       : the directions, (sender, receiver)
    steady      : all messages of a link are lost with one probability
    shared      : both messages of an exchange share one draw, which is counted twice
    at_once     : both directions carry messages at once and draw their own losses
    share       : probability that all hearers of a broadcast have one fate
    hops        : (D, H) probability that message k is lost, on hop k mod H; None without hops
    """

    lost: FloatArray
    independent: bool
    chain: Chain | None
    opposite: np.ndarray
    links: Sequence[tuple[int, int]]
    steady: bool = False
    shared: bool = False
    at_once: bool = False
    share: float = 0.0
    hops: FloatArray | None = None

    def expected(self, sent: np.ndarray, directions: np.ndarray) -> FloatArray:
        """Return how many of the first messages ``sent`` (R, K) of K ``directions`` (indices) are
        lost on average; a run need not end with the last hop.
        """
        if self.hops is None:
            return np.asarray(sent * self.lost[directions])
        sums = np.cumsum(np.pad(self.hops[directions], ((0, 0), (1, 0))), axis=1)
        cycles, rest = np.divmod(sent, self.hops.shape[1])
        return np.asarray(cycles * sums[:, -1] + sums[np.arange(len(sums)), rest])

    @property
    def variance_factor(self) -> float:
        """Factor by which bursts and shared draws raise the variance of the number of losses."""
        factor, chain = (2.0 if self.shared else 1.0), self.chain
        q = float(self.lost[0]) if len(self.lost) else 0.0
        spread = q * (1.0 - q)
        if chain is None or not spread > 0.0 or not chain.memory < 1.0:
            return factor
        # Correlations of a two-state chain decay geometrically.
        tail = 2.0 * (chain.lost_twice - q**2) / spread / (1.0 - chain.memory)
        return factor * max(1.0, 1.0 + tail)


class LossCounts(NamedTuple):
    """Counts of the messages of one run over D directions; of R runs with a first axis.

    sent, lost : (W, D) messages in each of W equal windows of the run
    followed   : (D,) losses after which another message was sent
    repeated   : (D,) pairs of consecutive messages that were both lost
    both       : (D,) messages lost together with the message of the same number in the opposite
                 direction
    hearers    : () pairs of messages of one broadcast
    alike      : () pairs of them that were both lost
    """

    sent: np.ndarray
    lost: np.ndarray
    followed: np.ndarray
    repeated: np.ndarray
    both: np.ndarray
    hearers: np.ndarray
    alike: np.ndarray


class PairCounts(NamedTuple):
    """Counts of the matchings of one run over L links; of R runs with a first axis of that length.

    paired   : (L,) slots in which the link was in the matching
    repeated : (L,) slots in which it was in the matchings of this slot and of the one before
    slots    : () number of slots with a matching
    """

    paired: np.ndarray
    repeated: np.ndarray
    slots: np.ndarray


def count_outcomes(lost: np.ndarray, opposite: np.ndarray) -> LossCounts:
    """Return the counts of R runs of K messages in D directions from ``lost`` (R, K, D)."""
    parts = np.array_split(lost, WINDOWS, axis=1)
    sent = [np.full((len(lost), lost.shape[2]), part.shape[1]) for part in parts]
    return LossCounts(
        np.stack(sent, axis=1),
        np.stack([part.sum(axis=1) for part in parts], axis=1),
        lost[:, :-1].sum(axis=1),
        (lost[:, 1:] & lost[:, :-1]).sum(axis=1),
        (lost & lost[..., opposite] & (opposite >= 0)).sum(axis=1),
        *np.zeros((2, len(lost))),
    )


def compare_losses(law: LossLaw, counts: LossCounts, level: float) -> LawComparison:
    """Compare the lost shares of R runs with the stated ones: of all directions together, of the
    same in each window of the run, and of every direction, with a third of ``level`` each.
    """
    # Messages (R, D) of each run and direction, and the indices of directions with any.
    sent, lost = counts.sent.sum(axis=1), counts.lost.sum(axis=1)
    in_use, count = np.flatnonzero(sent.sum(axis=0) > 0), counts.sent.shape[1]
    distances = [(_loss_interval(law, sent, lost, in_use, level / 3.0), "all directions")]
    windows = np.flatnonzero(counts.sent.sum(axis=(0, 2)) > 0)
    # Windows show losses that change with time, as those of a user's class may do by design.
    for w in windows.tolist() if law.steady and count > 1 else ():
        interval = _loss_interval(
            law, counts.sent[:, w], counts.lost[:, w], in_use, level / (3.0 * len(windows))
        )
        distances.append((interval, f"all directions in part {w + 1} of {count} of the run"))
    single = level / (3.0 * max(len(in_use), 1))
    for k in in_use.tolist():
        interval = _loss_interval(law, sent, lost, np.array([k]), single)
        distances.append((interval, direction_label(law.links[k])))
    text = f"{sent.sum():,.0f} messages, difference of the lost share"
    return LawComparison(distances, text, overall=1)


def direction_label(link: tuple[int, int]) -> str:
    """Return the label of a direction (sender, receiver)."""
    return f"from {link[0]} to {link[1]}"


def _loss_interval(
    law: LossLaw, sent: np.ndarray, lost: np.ndarray, directions: np.ndarray, level: float
) -> Interval:
    q, sent, lost = law.lost[directions], sent[:, directions], lost[:, directions]
    stated = law.expected(sent, directions)
    total, losses = float(sent.sum()), lost.sum(axis=1)
    excess, expected = (lost - stated).sum(axis=1), float(stated.sum()) / total
    if len(directions) == 1 and law.independent:
        limits = probability_interval(int(losses.sum()), int(total), level)
        return deviation_interval(expected, limits)
    arrived = sent.sum(axis=1) - losses
    rare = min(np.count_nonzero(losses), np.count_nonzero(arrived)) < MIN_EVENTS
    if rare and law.independent:
        # The sum of independent losses of unequal probabilities has lighter tails than that of
        # equal ones (Hoeffding 1956). Both directions of a link may share one loss.
        per_draw = 2 if law.shared else 1
        limits = probability_interval(int(losses.sum()) // per_draw, int(total) // per_draw, level)
        return deviation_interval(expected, limits)
    if rare:
        limits = share_of_bounded_runs(excess, sent.sum(axis=1), expected, level)
        return deviation_interval(expected, limits)
    variance = float((sent * (q * (1.0 - q))).sum()) * law.variance_factor
    return excess_interval(expected, excess, total, variance, level)


def share_of_bounded_runs(
    excess: FloatArray, sent: np.ndarray, expected: float, level: float
) -> Interval:
    """Return an interval for the lost share of messages whatever the law of losses within a run,
    for losses too rare for a sample variance.

    ``excess`` (R,) are messages lost less those expected, ``sent`` (R,) messages, ``expected`` the
    stated share. By Hoeffding (1963, Theorem 1) the average of R independent numbers in [0, 1] with
    mean m is f, or further from m, with a probability of at most exp(-R KL(f, m)).
    """
    runs, max_sent = len(sent), float(sent.max())
    # The numbers are lost messages over ``max_sent``; their mean is the share over ``scale``.
    scale = max_sent * runs / float(sent.sum())
    # Directions that lose unequal shares can take it slightly out of [0, 1].
    mean = min(max(expected + float(excess.mean()) / max_sent, 0.0), 1.0)

    def limits(value: float, factor: float) -> tuple[float, float]:
        centre = min(max(expected + (value - expected) / scale, 0.0), 1.0)
        limit = math.log(2.0 / level) / (factor * runs)
        low, high = (_share_at(centre, end, limit) for end in (0.0, 1.0))
        return expected + scale * (low - expected), expected + scale * (high - expected)

    value = expected + scale * (mean - expected)
    low, high = limits(value, 1.0)
    return Interval(value, low, high, max(expected - low, high - expected), again=limits)


def _share_at(centre: float, end: float, limit: float) -> float:
    """Return the m from ``centre`` to ``end`` (0 or 1) at which KL(centre, m) is ``limit``."""
    inner, outer = centre, end
    for _ in range(60):
        middle = 0.5 * (inner + outer)
        divergence = scipy.special.rel_entr([centre, 1.0 - centre], [middle, 1.0 - middle])
        if float(divergence.sum()) > limit:
            outer = middle
        else:
            inner = middle
    return inner


def compare_bursts(law: LossLaw, counts: LossCounts, level: float) -> LawComparison:
    """Compare the probability of a loss after a loss with that of the stated chain."""
    assert law.chain is not None
    followed = counts.followed.sum(axis=1)
    total = float(followed.sum())
    if total < MIN_COUNT or np.count_nonzero(followed) < MIN_EVENTS:
        return NO_COMPARISON
    probability = law.chain.lost_twice / float(law.lost.mean())
    excess = counts.repeated.sum(axis=1) - probability * followed
    # At least the variance of independent pairs.
    independent = total * probability * (1.0 - probability)
    distance = excess_interval(probability, excess, total, independent, level)
    text = f"{total:,.0f} losses, after which the next message is lost with a probability off"
    return LawComparison([(distance, "all directions")], text)


def compare_joint_losses(law: LossLaw, counts: LossCounts, level: float) -> LawComparison:
    """Compare how often two hearers of a broadcast lose it both, in R runs, with c q + (1 - c) q^2
    for the share c of broadcasts that have one fate and the probability q of a loss.
    """
    q, pairs = float(law.lost[0]), counts.hearers
    expected, total = law.share * q + (1.0 - law.share) * q**2, float(pairs.sum())
    if total < MIN_COUNT or len(pairs) < MIN_RUNS:
        return NO_COMPARISON
    excess = counts.alike - expected * pairs
    distance = excess_interval(expected, excess, total, total * expected, level)
    text = f"{total:,.0f} pairs of hearers, which lose a broadcast both with a probability off"
    return LawComparison([(distance, "all senders")], text)


def compare_independence(law: LossLaw, counts: LossCounts, level: float) -> LawComparison:
    """Compare losses of R runs with independent ones: of consecutive messages of a direction, of
    messages of the same number in opposite directions (unless both share one draw), and of
    different links; each of the three gets a third of ``level``.
    """
    q, sent = law.lost, counts.sent.sum(axis=1)
    distances = []
    # Where both directions of a link share one draw, each event is counted twice.
    variance = neighbours_variance(q) * (2.0 if law.shared else 1.0)
    pairs = np.maximum(sent - 1, 0)
    found = correlation_of_runs(
        counts.repeated - pairs * q**2, pairs, q * (1.0 - q), variance, level / 3.0
    )
    if found is not None:
        distances.append((found, "correlation of a message and the one before"))
    if law.at_once:
        other = q[law.opposite]
        pairs = np.where(law.opposite >= 0, np.minimum(sent, sent[:, law.opposite]), 0)
        scale = np.sqrt(q * (1.0 - q) * other * (1.0 - other))
        # Each pair is counted in both directions.
        variance = 2.0 * q * other * (1.0 - q * other)
        excess = counts.both - pairs * q * other
        found = correlation_of_runs(excess, pairs, scale, variance, level / 3.0)
        if found is not None:
            distances.append((found, "correlation of both directions of a link"))
    distances += _links_apart(law, counts, level / 3.0)
    return LawComparison(distances, "largest difference") if distances else NO_COMPARISON


def neighbours_variance(p: Any) -> Any:
    """Return the variance, by pair, of the number of neighbouring pairs of independent events of
    probability p in which both occur: Var(x_k x_{k+1}) + 2 Cov(x_k x_{k+1}, x_{k+1} x_{k+2}).
    """
    return p**2 * (1.0 - p**2) + 2.0 * p**3 * (1.0 - p)


def correlation_of_runs(
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
    """
    weight = float((count * scale).sum())
    if not weight > 0.0 or len(excess) < MIN_RUNS:
        return None
    # At least the variance under independence.
    return excess_interval(0.0, excess.sum(axis=1), weight, float((count * variance).sum()), level)


def _links_apart(law: LossLaw, counts: LossCounts, level: float) -> list[tuple[Interval, str]]:
    # Of directions that share their draws the one that has carried more messages stands for both.
    total = counts.sent.sum(axis=(0, 1)).tolist()
    ends = [(min(link), max(link)) if law.shared else link for link in law.links]
    most = {ends[k]: k for k in sorted(range(len(ends)), key=total.__getitem__)}
    columns = np.array(sorted(most.values()))
    sent, lost = (part.reshape(-1, part.shape[2])[:, columns] for part in counts[:2])
    q = law.lost[columns]
    excess, variances = lost - sent * q, sent * (q * (1.0 - q))
    distances, largest = [], largest_correlation(excess, variances, level / 2.0)
    if largest is not None:
        interval, pair = largest
        first, second = (direction_label(law.links[columns[k]]) for k in pair)
        distances.append((interval, f"correlation of losses {first} and {second}"))
    mean = mean_correlation(excess, variances, level / 2.0)
    if mean is not None:
        # A common cause of losses correlates all pairs a little, which shows best in the mean.
        distances.append((deviation_interval(0.0, mean), "mean correlation of losses of all links"))
    return distances


def mean_correlation(excess: FloatArray, variance: FloatArray, level: float) -> Interval | None:
    """Return an interval for the mean correlation of the losses of two links; None if too few
    windows have losses of two links.

    ``excess`` (K, L) are the losses of L links in K windows of runs less their expected numbers,
    and ``variance`` (K, L) their variances under independence. The estimate is the sum over windows
    and pairs of links of the products of two excesses, each of mean 0 under independence, over the
    sum of the products of their standard deviations.
    """
    deviation = np.sqrt(variance)
    # The sum of x_i x_j over all pairs i < j is ((sum x)^2 - sum x^2) / 2.
    products = (excess.sum(axis=1) ** 2 - (excess**2).sum(axis=1)) / 2.0
    scale = float((deviation.sum(axis=1) ** 2 - variance.sum(axis=1)).sum()) / 2.0
    spreads = (variance.sum(axis=1) ** 2 - (variance**2).sum(axis=1)) / 2.0
    total = float(spreads.sum())
    # The effective number of windows, those with few messages counting less.
    effective = total**2 / float((spreads**2).sum()) if total > 0.0 else 0.0
    if not effective >= MIN_RUNS:
        return None
    # Correlated losses have products of larger variance than independent ones.
    spread = math.sqrt(max(total, float((products**2).sum())))
    return student_interval(float(products.sum()) / scale, spread / scale, int(effective), level)


def compare_matchings(
    p: FloatArray, counts: PairCounts, links: Sequence[tuple[int, int]], level: float
) -> LawComparison:
    """Compare matchings of R runs with ``p`` (L,) of each link in a slot, independent of other
    slots: the number of pairs in a slot by Student's interval, for each link its probability by
    Clopper and Pearson, and its correlation with the next slot.
    """
    slots, runs = float(counts.slots[0]), len(counts.paired)
    single_level = level / (3.0 * len(p))
    # At least the deviation of one pair in all slots of all runs: rare pairs may show none.
    per_slot = counts.paired.sum(axis=1) / slots
    spread = max(float(per_slot.std(ddof=1)) / math.sqrt(runs), 1.0 / (runs * slots))
    mean_pairs = student_interval(float(per_slot.mean()), spread, runs, level / 3.0)
    distances = [(deviation_interval(float(p.sum()), mean_pairs), "pairs in a slot, of all links")]
    for k, (i, j) in enumerate(links):
        label = f"link {i}-{j}"
        paired = int(counts.paired[:, k].sum())
        limits = probability_interval(paired, int(runs * slots), single_level)
        distances.append((deviation_interval(float(p[k]), limits), label))
        if slots < 2.0 or not 0.0 < p[k] < 1.0:
            continue
        # Neighbouring pairs of slots overlap, so that only runs are independent values.
        correlation = correlation_of_runs(
            (counts.repeated[:, k] - (slots - 1.0) * p[k] ** 2)[:, None],
            np.full((runs, 1), slots - 1.0),
            np.array([p[k] * (1.0 - p[k])]),
            np.array([neighbours_variance(float(p[k]))]),
            single_level,
        )
        if correlation is not None:
            distances.append((correlation, f"{label} and the slot before, their correlation"))
    text = f"{runs * slots:,.0f} slots, largest difference of a share"
    return LawComparison(distances, text, overall=1)


def compare_coincidences(
    events: np.ndarray, lags: Sequence[int], labels: Sequence[str], level: float
) -> LawComparison:
    """Compare how often two of L events are ``lags`` steps apart, by ``events`` (R, K, L), 0 or 1,
    with independent ones of their frequencies: by Clopper and Pearson, shared among all pairs; each
    lag gives the pair that is least likely.
    """
    p, size = events.mean(axis=(0, 1)), events.shape[2]
    expected, distances = np.minimum(np.outer(p, p), 1.0), []
    single = level / (len(lags) * size**2)
    events = events.astype(np.float64)
    for lag in lags:
        early, late = events[:, : events.shape[1] - lag], events[:, lag:]
        count = early[..., 0].size
        # Entry [l, m]: how often event l happens and, lag steps later, event m.
        both = np.tensordot(early, late, axes=([0, 1], [0, 1]))
        f, entropy = both / count, scipy.special.rel_entr
        # The Kullback-Leibler divergence, which orders pairs as Chernoff's bound on their chance.
        scores = entropy(f, expected) + entropy(1.0 - f, 1.0 - expected)
        if lag == 0:
            np.fill_diagonal(scores, 0.0)
        i, j = divmod(int(np.argmax(scores)), size)
        limits = probability_interval(int(both[i, j]), count, single)
        label = f"{labels[i]} and, {lag} later, {labels[j]}"
        distances.append((deviation_interval(float(expected[i, j]), limits), label))
    return LawComparison(distances, "largest difference of a share")


class DelayCounts(NamedTuple):
    """Delays of the messages of one run over D directions (directed links), by their ranks u,
    uniform in [0, 1] under the stated law; of R runs with a first axis of that length.

    cells    : (CELLS, 2) numbers of u in equal parts of [0, 1], and of those looked at
    products : (3,) sums over neighbouring delays of a direction (:func:`correlate_neighbours`)
    sums     : (2, D) of each direction the number of delays and the sum of u - 1/2; (2, 0) if all
               should be constant
    off      : () largest distance in seconds of a delay from a stated constant
    """

    cells: FloatArray
    products: FloatArray
    sums: FloatArray
    off: FloatArray


def count_fixed(ages: FloatArray, fixed: float) -> DelayCounts:
    """Return the distance of ``ages`` (K,) in seconds from a ``fixed`` delay, as counts."""
    largest_error = np.abs(ages - fixed).max(initial=0.0)
    return DelayCounts(np.zeros((CELLS, 2)), np.zeros(3), np.zeros((2, 0)), np.array(largest_error))


def count_delays(
    law: WaitingLaw, sent: FloatArray, ages: FloatArray, links: IntArray, size: int, horizon: float
) -> DelayCounts:
    """Return the counts of K messages, in order of direction and number, ``sent`` (K,) and taking
    ``ages`` (K,) seconds, inf where under way at the ``horizon``.
    """
    ranks = censored_ranks(law, sent, ages, horizon)
    # The first message of each direction has no neighbour before it.
    first = np.ones(len(sent), dtype=bool)
    first[1:] = links[1:] != links[:-1]
    seen, centred = np.isfinite(ranks.rank), fill_in(ranks) - 0.5
    sums = [np.bincount(links[seen], w[seen], size) for w in (np.ones(len(sent)), centred)]
    products = correlate_neighbours(ranks, first)
    return DelayCounts(count_ranks(ranks), products, np.array(sums), np.array(0.0))


def compare_delays(
    counts: DelayCounts, links: Sequence[tuple[int, int]], level: float
) -> tuple[LawComparison, LawComparison]:
    """Compare delays of R runs with their law: of all (the first comparison), the mean rank of each
    direction, with their ``links``, and neighbours; each of the three gets a third of ``level``.
    """
    law = compare_shares(counts.cells.sum(axis=0), level / 3.0, "delays")
    number, excess = counts.sums.sum(axis=0)
    frequent = np.flatnonzero(number >= MIN_COUNT)
    distances: list[tuple[Interval, str]] = []
    for k in frequent.tolist():
        single = level / (3.0 * len(frequent))
        # The mean of numbers that are uniform has the variance 1 / (12 N), and is nearly normal.
        mean, deviation = 0.5 + excess[k] / number[k], 1.0 / np.sqrt(12.0 * number[k])
        interval = normal_interval(mean, deviation, single)
        distances.append((deviation_interval(0.5, interval), direction_label(links[k])))
    correlation = neighbour_correlation(counts.products, level / 3.0)
    if correlation is not None:
        label = "neighbouring ones, their correlation"
        distances.append((deviation_interval(0.0, correlation), label))
    return law, LawComparison(distances, "largest difference of a mean rank from 1/2")
