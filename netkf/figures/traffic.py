"""The figures ``age``, ``links`` and ``delivery``: what happened to the messages."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from netkf.figures.panels import select_evenly
from netkf.figures.style import (
    EXACT,
    FAINT,
    INK,
    LOST,
    MUTED,
    SECONDS,
    SENSING,
    SKY,
    Picture,
    draw_legend,
    finish_figure,
    new_figure,
)
from netkf.figures.subject import Subject, UnavailableError
from netkf.linalg.arrays import FloatArray
from netkf.trace.schema import CODES

AGE_BINS = 160  # of time, for means and maxima of the age
AGE_LEVELS = 400  # levels at which the distribution of ages is drawn
MAX_DIRECTIONS = 40  # rows that can still be told apart
MAX_MARKS = 3000  # messages that can still be told apart
CONFIDENCE = 0.95
TIME_BINS = 30  # of time: each has enough messages for an interval


def freshest(log: np.ndarray, node: int) -> tuple[FloatArray, FloatArray]:
    """Return the times at which a node heard a message, and for each the time at which the freshest
    message so far was sent, both (K,) in seconds.
    """
    heard = log[(log["kind"] == CODES["deliver"]) & (log["node"] == node)]
    sent = np.maximum.accumulate(heard["t"] - np.nan_to_num(heard["age"]))
    return heard["t"], sent


class Ages(NamedTuple):
    """Age of information of a node as a sawtooth: segments between ``start`` and ``stop`` (K,),
    seconds, in which it grows from ``low`` to ``low + stop - start``.
    """

    start: FloatArray
    stop: FloatArray
    low: FloatArray

    def mean(self, edges: FloatArray) -> FloatArray:
        """Return the time averages (B,) between ``edges`` (B + 1,), which begin at time 0."""
        length = self.stop - self.start
        before = np.concatenate([[0.0], np.cumsum(length * (self.low + 0.5 * length))])
        k = np.clip(np.searchsorted(self.start, edges, side="right") - 1, 0, None)
        gone = edges - self.start[k]
        return np.asarray(np.diff(before[k] + gone * (self.low[k] + 0.5 * gone)) / np.diff(edges))

    def largest(self, edges: FloatArray) -> FloatArray:
        """Return the largest age (B,) between ``edges`` (B + 1,)."""
        # An age is largest where a segment ends, or the bin.
        last = np.searchsorted(self.start, edges[1:], side="left") - 1
        found = self.low[last] + edges[1:] - self.start[last]
        bins = np.clip(np.searchsorted(edges, self.stop, side="left") - 1, 0, len(found) - 1)
        np.maximum.at(found, bins, self.low + self.stop - self.start)
        return np.asarray(found)

    def time_above(self, levels: FloatArray) -> FloatArray:
        """Return for how many seconds the age is above each of the ``levels`` (L,)."""
        top = self.low + self.stop - self.start
        # Seconds above a level: sums of (top - level) where that is positive, less the same of low.
        return _excess_time(top, levels) - _excess_time(self.low, levels)


def _excess_time(values: FloatArray, levels: FloatArray) -> FloatArray:
    """Return the sum of ``max(0, value - level)`` over the values (K,) for each level (L,)."""
    ordered = np.sort(values)[::-1]
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    above = len(ordered) - np.searchsorted(ordered[::-1], levels, side="right")
    return np.asarray(sums[above] - above * levels)


def ages_of(log: np.ndarray, node: int, end: float) -> Ages:
    """Return the age of information of a node up to ``end``: the time since the freshest message
    that it has heard was sent; since time 0 before the first one.
    """
    heard, sent = freshest(log, node)
    before = heard < end
    start = np.concatenate([[0.0], heard[before]])
    stop = np.concatenate([heard[before], [end]])
    return Ages(start, stop, start - np.concatenate([[0.0], sent[before]]))


def age_figure(subject: Subject) -> Picture:
    """Draw the age of information over time, means and maxima over the nodes, and its law."""
    end = _last_time(subject)
    degrees = subject.scenario.topology.degrees
    receivers = [node for node in subject.nodes if degrees.get(node, 0)]
    if not receivers:
        raise UnavailableError("No node can hear another one.")
    ages = [ages_of(subject.log, node, end) for node in receivers]
    means = np.array([float(each.mean(np.array([0.0, end]))[0]) for each in ages])
    figure = new_figure(8.4, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    _draw_ages(left, np.linspace(0.0, end, AGE_BINS + 1), ages)
    _draw_age_law(right, ages, means, end)
    worst = int(means.argmax())
    claim = f"On average the freshest message that a node has heard is {means.mean():.3g} s old"
    if len(means) > 1:
        claim += f"; node {receivers[worst]} waits longest, {means[worst]:.3g} s"
    note = (
        "Age of information: time since the freshest message that a node has heard was sent. "
        f"Left: means and maxima over {end / AGE_BINS:.3g} s."
    )
    finish_figure(figure, subject.claim(claim), subject.caption(note))
    return figure


def _draw_ages(axes: Any, edges: FloatArray, ages: list[Ages]) -> None:
    """Draw mean and largest age of information within bins of time."""
    # Ages are sawtooths: instants of a grid would beat with the clocks, means over bins do not.
    centres = 0.5 * (edges[:-1] + edges[1:])
    means = np.array([each.mean(edges) for each in ages])
    largest = np.max([each.largest(edges) for each in ages], axis=0)
    if len(ages) > 1:
        low, median, high = np.quantile(means, (0.05, 0.5, 0.95), axis=0)
        axes.fill_between(centres, low, high, color=SKY, alpha=0.5, lw=0, label="90% of nodes")
    else:
        median = means[0]
    text = ("worst node", "median node") if len(ages) > 1 else ("the node", "the node")
    label = f"{text[0]}, at its worst moment"
    axes.plot(centres, largest, color=SENSING, ls="--", lw=1.0, label=label)
    axes.plot(centres, median, color=INK, lw=1.2, label=f"{text[1]}, on average")
    axes.set(xlabel=SECONDS, ylabel="age of information, seconds")
    axes.set_ylim(0.0, 1.05 * max(float(largest.max()), 1e-12))
    draw_legend(axes)


def _draw_age_law(axes: Any, ages: list[Ages], means: FloatArray, end: float) -> None:
    """Draw the share of time for which the age exceeds a value: of all nodes, best and worst."""
    levels = np.linspace(
        0.0, max(float((a.low + a.stop - a.start).max()) for a in ages), AGE_LEVELS
    )
    shares = np.array([each.time_above(levels) for each in ages]) / end
    rows: list[tuple[FloatArray, str, str, str]] = [(shares.mean(axis=0), INK, "-", "all nodes")]
    if len(ages) > 1:
        rows += [
            (shares[int(means.argmax())], SENSING, "--", "worst node"),
            (shares[int(means.argmin())], EXACT, "-.", "best node"),
        ]
    least = 1e-4
    for share, colour, dashes, label in rows:
        # The axis is logarithmic: smaller shares only stretch it.
        visible = share > 0.1 * least
        axes.plot(levels[visible], share[visible], color=colour, ls=dashes, label=label)
    axes.set_yscale("log")
    axes.set_ylim(least, 1.3)
    axes.set(xlabel="age, seconds", ylabel="share of time above")
    draw_legend(axes, 1)


def _last_time(subject: Subject) -> float:
    """Return the last recorded time in seconds."""
    last = float(subject.log["t"][-1])
    if len(subject.times):
        last = max(last, float(subject.times[-1]))
    return last if last > 0.0 else subject.scenario.horizon


class DirectedMessages(NamedTuple):
    """Messages from ``sender`` to ``receiver``: when they were sent or lost, and delivered."""

    sender: int
    receiver: int
    delivered: FloatArray
    lost: FloatArray


def messages_by_direction(log: np.ndarray) -> list[DirectedMessages]:
    """Return the messages of each direction over which some were sent, by delivery and loss."""
    arrived = log[log["kind"] == CODES["deliver"]]
    missed = log[np.isin(log["kind"], (CODES["lost"], CODES["late"]))]
    # A message that arrived stands with its receiver first, one that was lost with its sender.
    late = missed["kind"] == CODES["late"]
    sender = np.where(late, missed["peer"], missed["node"])
    receiver = np.where(late, missed["node"], missed["peer"])
    pairs = {(int(i), int(j)) for i, j in zip(arrived["peer"], arrived["node"], strict=True)}
    pairs |= {(int(i), int(j)) for i, j in zip(sender, receiver, strict=True)}
    heard, gone = (
        _by_pair(arrived["peer"], arrived["node"], arrived["t"]),
        _by_pair(sender, receiver, missed["t"]),
    )
    none = np.empty(0)
    return [
        DirectedMessages(*pair, heard.get(pair, none), gone.get(pair, none))
        for pair in sorted(pairs)
    ]


def _by_pair(
    senders: np.ndarray, receivers: np.ndarray, times: FloatArray
) -> dict[tuple[int, int], FloatArray]:
    """Return the times of each pair of nodes."""
    if not len(times):
        return {}
    order = np.lexsort((times, receivers, senders))
    i, j, t = senders[order], receivers[order], times[order]
    begins = np.flatnonzero((i[1:] != i[:-1]) | (j[1:] != j[:-1])) + 1
    starts = [0, *begins.tolist()]
    parts = np.split(t, begins)
    return {(int(i[s]), int(j[s])): part for s, part in zip(starts, parts, strict=True)}


def links_figure(subject: Subject) -> Picture:
    """Draw every message of each direction at its time: ticks for delivered, crosses for lost."""
    found = _with_messages(subject)
    chosen = [found[k] for k in select_evenly(np.arange(len(found)), MAX_DIRECTIONS).tolist()]
    begin, end = _readable_window(chosen, _last_time(subject))
    figure = new_figure(8.4, min(9.0, 2.0 + 0.16 * len(chosen)))
    axes = figure.add_subplot()
    for row, one in enumerate(chosen):
        for times, marker, colour, size in (
            (one.delivered, "|", INK, 5.0),
            (one.lost, "x", LOST, 4.0),
        ):
            inside = times[(times >= begin) & (times <= end)]
            style: dict[str, Any] = {
                "ls": "",
                "marker": marker,
                "ms": size,
                "color": colour,
                "mew": 0.9,
            }
            axes.plot(inside, np.full(len(inside), row), **style)
    axes.plot([], [], "|", color=INK, label="delivered")
    axes.plot([], [], "x", color=LOST, label="lost")
    axes.set_yticks(
        range(len(chosen)), [f"{d.sender} to {d.receiver}" for d in chosen], fontsize=6.5
    )
    axes.set_ylim(-0.8, len(chosen) - 0.2)
    axes.invert_yaxis()
    axes.set_xlim(begin, end)
    axes.set(xlabel=SECONDS, ylabel="sender to receiver")
    draw_legend(axes)
    lost, total = (
        sum(len(d.lost) for d in found),
        sum(len(d.lost) + len(d.delivered) for d in found),
    )
    claim = f"{lost:,} of {total:,} messages were lost ({lost / total:.1%})"
    directions = f"{len(chosen)} of {len(found)} directions" if len(chosen) < len(found) else ""
    part = f"the first {end:,.4g} s" if end < _last_time(subject) else ""
    cut = " of ".join(filter(None, (directions, part)))
    sentence = f"Shown: {cut}; the claim counts all." if cut else "All messages are shown."
    finish_figure(figure, subject.claim(claim), subject.caption(sentence))
    return figure


def _with_messages(subject: Subject) -> list[DirectedMessages]:
    """Return the messages by direction; raises UnavailableError without any."""
    found = messages_by_direction(subject.log)
    if not found:
        raise UnavailableError("No message was delivered or lost.")
    return found


def _readable_window(chosen: list[DirectedMessages], end: float) -> tuple[float, float]:
    """Return the longest time from 0 on with at most MAX_MARKS messages, seconds."""
    times = np.sort(np.concatenate([np.concatenate([d.delivered, d.lost]) for d in chosen]))
    return 0.0, float(times[MAX_MARKS]) if len(times) > MAX_MARKS else end


def wilson(delivered: int, total: int) -> tuple[float, float]:
    """Return Wilson's interval of a probability with CONFIDENCE."""
    found = binomtest(delivered, total).proportion_ci(CONFIDENCE, "wilson")
    return float(found.low), float(found.high)


def delivery_figure(subject: Subject) -> Picture:
    """Draw the delivered fraction of each direction with its interval, and the loss over time."""
    found = _with_messages(subject)
    shares = np.array([len(d.delivered) / (len(d.delivered) + len(d.lost)) for d in found])
    ends = np.array([wilson(len(d.delivered), len(d.delivered) + len(d.lost)) for d in found])
    figure = new_figure(8.4, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.3, 1.0])
    outside = _draw_shares(left, subject, found, shares, ends)
    _draw_loss(right, found, _last_time(subject))
    total = sum(len(d.delivered) + len(d.lost) for d in found)
    arrived = sum(len(d.delivered) for d in found)
    claim = f"{arrived / total:.1%} of {total:,} messages arrived"
    if shares.min() < shares.max():
        claim += f"; by direction between {shares.min():.0%} and {shares.max():.0%}"
    note = "Intervals: Wilson, 95%."
    if outside is not None:
        note += f" {outside} of {len(found)} intervals miss what the channel of the scenario says."
    finish_figure(figure, subject.claim(claim), subject.caption(note))
    return figure


def _draw_shares(
    axes: Any, subject: Subject, found: list[DirectedMessages], shares: FloatArray, ends: FloatArray
) -> int | None:
    """Draw the directions in the order of their shares; return how many intervals miss the stated
    probability, None if none is stated.
    """
    order = np.argsort(shares, kind="stable")
    positions = np.arange(len(order))
    axes.vlines(
        positions,
        *ends[order].T,
        color=SKY,
        lw=max(0.4, min(3.0, 150.0 / len(order))),
        label="95% interval",
    )
    axes.plot(positions, shares[order], ls="", marker=".", color=INK, ms=4, label="delivered")
    said = np.array([_stated_delivery(subject, found[k]) for k in order.tolist()])
    outside = None
    if np.isfinite(said).any():
        style = {"ls": "", "marker": "_", "ms": 5, "color": SENSING}
        axes.plot(positions, said, **style, label="the channel of the scenario")
        outside = int(((said < ends[order, 0]) | (said > ends[order, 1])).sum())
    axes.set_ylim(-0.02, 1.04)
    if len(found) <= 16:
        names = [f"{found[k].sender}>{found[k].receiver}" for k in order.tolist()]
        axes.set_xticks(positions, names, fontsize=6.5, rotation=90 if len(found) > 8 else 0)
        axes.set_xlabel("direction, sender > receiver")
    else:
        axes.set_xlabel(f"{len(found)} directions, in the order of their share")
    axes.set_ylabel("share of messages delivered")
    draw_legend(axes)
    return outside


def _stated_delivery(subject: Subject, one: DirectedMessages) -> float:
    """Return the delivery probability that the scenario gives a direction; nan if it varies."""
    link = one.sender, one.receiver
    loss = subject.scenario.network.channel.loss
    try:
        return float(loss.mean_delivery(link, subject.scenario.table_probability(link)))
    except (ArithmeticError, LookupError, TypeError, ValueError):  # a loss of the user's
        return float("nan")


def _draw_loss(axes: Any, found: list[DirectedMessages], end: float) -> None:
    """Draw the share of messages that were lost in each of TIME_BINS bins, with intervals."""
    edges = np.linspace(0.0, end, TIME_BINS + 1)
    lost, arrived = (
        np.histogram(np.concatenate([getattr(d, name) for d in found]), edges)[0]
        for name in ("lost", "delivered")
    )
    full = np.flatnonzero(lost + arrived)
    ends = np.array([wilson(int(lost[k]), int(lost[k] + arrived[k])) for k in full.tolist()])
    centres = 0.5 * (edges[1:] + edges[:-1])[full]
    axes.fill_between(centres, *ends.T, color=FAINT, alpha=0.6, lw=0, label="95% interval")
    share = (lost / np.maximum(lost + arrived, 1))[full]
    axes.plot(centres, share, color=LOST, marker=".", label="lost in each part of the time")
    whole = lost.sum() / max(int((lost + arrived).sum()), 1)
    axes.axhline(whole, color=MUTED, ls="--", lw=1.0, label="lost in all")
    axes.set_ylim(0.0, min(1.02, 1.3 * max(float(ends.max()), 0.02)))
    axes.set(xlabel=SECONDS, ylabel="share of messages lost")
    draw_legend(axes, 1)
