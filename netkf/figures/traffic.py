"""The figures ``age``, ``links`` and ``delivery``: age of information, messages and their losses.

Here a direction is a directed link, from a sender to a receiver.
"""

from __future__ import annotations

import contextlib
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.panels import select_evenly, shade_downtimes
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
    label_text,
    new_figure,
)
from netkf.linalg.arrays import FloatArray
from netkf.runs.connectivity import newest_heard, sent_at
from netkf.trace.messages import DELIVERED, UNDER_WAY, by_link
from netkf.trace.schema import rows_of

AGE_BINS = 160  # of time, for means and maxima of the age
AGE_LEVELS = 400  # levels at which the distribution of ages is drawn
MIN_SHARE = 1e-4  # smallest share of time on the axis of that distribution
MAX_DIRECTIONS = 40  # rows that can still be told apart
MAX_LABELLED = 16  # directions whose names fit below the axis
MAX_MARKS = 3000  # messages that can still be told apart
CONFIDENCE = 0.95
TIME_BINS = 30  # of time: each has enough messages for an interval


class AgeSawtooth(NamedTuple):
    """The age of information of a node over time, a sawtooth of K segments, in seconds.

    Within a segment, between ``start`` (K,) and ``stop`` (K,), it grows from ``low`` (K,) to
    ``low + stop - start``.
    """

    start: FloatArray
    stop: FloatArray
    low: FloatArray

    def mean(self, edges: FloatArray) -> FloatArray:
        """Return the mean ages (B,) in bins between ``edges`` (B + 1,), in seconds."""
        length = self.stop - self.start
        # The integral of the age up to each segment, then up to each edge within its segment.
        at_start = np.concatenate([[0.0], np.cumsum(length * (self.low + 0.5 * length))])
        k = np.clip(np.searchsorted(self.start, edges, side="right") - 1, 0, None)
        elapsed = edges - self.start[k]
        integral = at_start[k] + elapsed * (self.low[k] + 0.5 * elapsed)
        return np.asarray(np.diff(integral) / np.diff(edges))

    def largest(self, edges: FloatArray) -> FloatArray:
        """Return the largest ages (B,) in bins between ``edges`` (B + 1,), in seconds."""
        # The age is largest at the end of the bin, or of a segment within it.
        last = np.searchsorted(self.start, edges[1:], side="left") - 1
        largest = self.low[last] + edges[1:] - self.start[last]
        bins = np.clip(np.searchsorted(edges, self.stop, side="left") - 1, 0, len(largest) - 1)
        np.maximum.at(largest, bins, self.low + self.stop - self.start)
        return np.asarray(largest)

    def time_above(self, levels: FloatArray) -> FloatArray:
        """Return the seconds (L,) for which the age is above each of the ``levels`` (L,)."""
        high = self.low + self.stop - self.start
        # The age grows by 1 s per second, so a segment from low to high is above a level for
        # max(0, high - level) - max(0, low - level) seconds.
        return _sum_excess(high, levels) - _sum_excess(self.low, levels)


def _sum_excess(values: FloatArray, levels: FloatArray) -> FloatArray:
    """Return sums of max(0, value - level) over ``values`` (K,), for each of ``levels`` (L,)."""
    # Values above a level: their sum, less the level for each of them.
    descending = np.sort(values)[::-1]
    sums = np.concatenate([[0.0], np.cumsum(descending)])
    above = len(descending) - np.searchsorted(descending[::-1], levels, side="right")
    return np.asarray(sums[above] - above * levels)


def age_of_information(arrived: np.ndarray, node: int, end: float) -> AgeSawtooth:
    """Return the time since the newest arrived message was sent, until ``end`` (s), from the EVENT
    rows of messages that have ``arrived`` (K,).
    """
    arrivals = np.take(arrived, np.flatnonzero((arrived["node"] == node) & (arrived["t"] < end)))
    start = np.concatenate([[0.0], arrivals["t"]])
    stop = np.concatenate([arrivals["t"], [end]])
    return AgeSawtooth(start, stop, start - newest_heard(start[1:], sent_at(arrivals), start))


def age_figure(data: FigureData) -> Picture:
    """Draw the age of information over time and its distribution; raises UnavailableError."""
    end = _last_time(data)
    # A node to which nothing is sent, such as one among nodes without readings, does not wait.
    addressed = set(rows_of(data.log, "send")["peer"].tolist())
    receivers = [node for node in data.nodes if node in addressed]
    if not receivers:
        raise UnavailableError("Nothing was sent to any node.")
    arrived = rows_of(data.log, "deliver")
    ages = [age_of_information(arrived, node, end) for node in receivers]
    means = np.array([float(age.mean(np.array([0.0, end]))[0]) for age in ages])
    figure = new_figure(8.4, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    _draw_ages(left, data, np.linspace(0.0, end, AGE_BINS + 1), ages)
    _draw_age_distribution(right, ages, means, end)
    worst = int(means.argmax())
    headline = f"On average the freshest message that a node has heard is {means.mean():.3g} s old"
    if len(means) > 1:
        headline += f"; node {receivers[worst]} waits longest, {means[worst]:.3g} s"
    note = (
        "Age of information: time since the freshest message that a node has heard was sent. "
        f"Left: means and maxima over {end / AGE_BINS:.3g} s."
    )
    return finish_figure(figure, data.title(headline), data.caption(note))


def _draw_ages(axes: Any, data: FigureData, edges: FloatArray, ages: list[AgeSawtooth]) -> None:
    """Draw median, 90% range and largest age of information in bins between ``edges`` (B + 1,)."""
    # Samples of a sawtooth at the times of a grid would alias with the clocks; means do not.
    centres = 0.5 * (edges[:-1] + edges[1:])
    means = np.array([age.mean(edges) for age in ages])
    largest = np.max([age.largest(edges) for age in ages], axis=0)
    if len(ages) > 1:
        low, median, high = np.quantile(means, (0.05, 0.5, 0.95), axis=0)
        axes.fill_between(centres, low, high, color=SKY, alpha=0.5, lw=0, label="90% of nodes")
    else:
        median = means[0]
    worst, typical = ("worst node", "median node") if len(ages) > 1 else ("the node", "the node")
    label = f"{worst}, at its worst moment"
    axes.plot(centres, largest, color=SENSING, ls="--", lw=1.0, label=label)
    axes.plot(centres, median, color=INK, lw=1.2, label=f"{typical}, on average")
    axes.set(xlabel=SECONDS, ylabel="age of information, seconds")
    axes.set_ylim(0.0, 1.05 * max(float(largest.max()), 1e-12))
    shade_downtimes(axes, data)
    draw_legend(axes)


def _draw_age_distribution(
    axes: Any, ages: list[AgeSawtooth], means: FloatArray, end: float
) -> None:
    """Draw the share of time in which the age exceeds a value: all nodes, best and worst."""
    largest = max(float((age.low + age.stop - age.start).max()) for age in ages)
    levels = np.linspace(0.0, largest, AGE_LEVELS)
    shares = np.array([age.time_above(levels) for age in ages]) / end
    rows: list[tuple[FloatArray, str, str, str]] = [(shares.mean(axis=0), INK, "-", "all nodes")]
    if len(ages) > 1:
        rows += [
            (shares[int(means.argmax())], SENSING, "--", "worst node"),
            (shares[int(means.argmin())], EXACT, "-.", "best node"),
        ]
    for share, colour, dashes, label in rows:
        # Shares of 0 have no place on a logarithmic axis.
        visible = share > 0.1 * MIN_SHARE
        axes.plot(levels[visible], share[visible], color=colour, ls=dashes, label=label)
    axes.set_yscale("log")
    axes.set_ylim(MIN_SHARE, 1.3)
    axes.set(xlabel="age, seconds", ylabel="share of time above")
    draw_legend(axes, 1)


def _last_time(data: FigureData) -> float:
    """Return the time of the last event or sample in seconds; the horizon if that is 0."""
    last = max([float(data.log["t"][-1]), *data.times[-1:].tolist()])
    return last if last > 0.0 else data.scenario.horizon


def links_figure(data: FigureData) -> Picture:
    """Draw delivered and lost messages of directions over time; raises UnavailableError."""
    directions = _require_messages(data)
    rows = select_evenly(np.arange(len(directions)), MAX_DIRECTIONS)
    selection = [directions[k] for k in rows.tolist()]
    # As many seconds as have about MAX_MARKS messages.
    times = np.sort(np.concatenate(selection)["ended"])
    end = float(times[MAX_MARKS]) if len(times) > MAX_MARKS else _last_time(data)
    figure = new_figure(8.4, min(9.0, 2.0 + 0.16 * len(selection)))
    axes = figure.add_subplot()
    for row, direction in enumerate(selection):
        for is_heard, marker, colour, size in ((True, "|", INK, 5.0), (False, "x", LOST, 4.0)):
            times = direction["ended"][heard(direction) == is_heard]
            drawn_times = times[times <= end]
            style: dict[str, Any] = {"ls": "", "marker": marker, "ms": size, "mew": 0.9}
            axes.plot(drawn_times, np.full(len(drawn_times), row), color=colour, **style)
    # Empty series for the legend, of what there is.
    outcomes = heard(np.concatenate(selection))
    if outcomes.any():
        axes.plot([], [], "|", color=INK, label="delivered")
    if not outcomes.all():
        axes.plot([], [], "x", color=LOST, label="lost")
    labels = [" to ".join(_end_names(data, one)) for one in selection]
    axes.set_yticks(range(len(selection)), labels, fontsize=6.5)
    axes.set_ylim(-0.8, len(selection) - 0.2)
    axes.invert_yaxis()
    axes.set_xlim(0.0, end)
    shade_downtimes(axes, data)
    axes.set(xlabel=SECONDS, ylabel="sender to receiver")
    draw_legend(axes)
    messages = np.concatenate(directions)
    lost, total = int((~heard(messages)).sum()), len(messages)
    headline = f"{lost:,} of {total:,} messages were lost ({lost / total:.1%})"
    omissions = []
    if len(selection) < len(directions):
        omissions.append(f"{len(selection)} of {len(directions)} directions")
    if end < _last_time(data):
        omissions.append(f"the first {end:,.4g} s")
    note = "All messages are shown."
    if omissions:
        note = f"Shown: {' of '.join(omissions)}; the title counts all."
    return finish_figure(figure, data.title(headline), data.caption(note))


def messages_by_direction(messages: np.ndarray) -> list[np.ndarray]:
    """Return those of the MESSAGE rows (M,) with an outcome, by direction."""
    return list(by_link(messages[messages["outcome"] != UNDER_WAY]))


def _require_messages(data: FigureData) -> list[np.ndarray]:
    """Return the messages by direction; raises UnavailableError without any."""
    directions = messages_by_direction(data.joined)
    if not directions:
        raise UnavailableError("No message was delivered or lost.")
    return directions


def heard(messages: np.ndarray) -> np.ndarray:
    """Return flags (M,): whether messages (M,) were delivered, neither lost nor late."""
    return np.asarray(messages["outcome"] == DELIVERED)


def _end_names(data: FigureData, direction: np.ndarray) -> tuple[str, str]:
    named, first = data.scenario.topology.named, direction[0]
    return label_text(named(int(first["sender"]))), label_text(named(int(first["receiver"])))


def wilson_interval(delivered: Any, total: Any) -> tuple[Any, Any]:
    """Return the ends of Wilson's interval of a delivery probability at the level CONFIDENCE."""
    z2, share = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2.0) ** 2, delivered / total
    half = np.sqrt(z2 * (share * (1.0 - share) + z2 / (4.0 * total)) / total)
    centre, scale = share + z2 / (2.0 * total), 1.0 + z2 / total
    # At the two ends rounding would leave the interval of probabilities.
    return np.clip((centre - half) / scale, 0.0, 1.0), np.clip((centre + half) / scale, 0.0, 1.0)


def delivery_figure(data: FigureData) -> Picture:
    """Draw the delivered shares of directions and losses over time; raises UnavailableError."""
    directions = _require_messages(data)
    delivered = np.array([heard(direction).sum() for direction in directions])
    totals = np.array([len(direction) for direction in directions])
    shares = delivered / totals
    figure = new_figure(8.4, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.3, 1.0])
    order = np.argsort(shares, kind="stable")
    interval = wilson_interval(delivered[order], totals[order])
    misses = _draw_shares(left, data, [directions[k] for k in order], shares[order], interval)
    _draw_losses(right, np.concatenate(directions), _last_time(data))
    headline = f"{delivered.sum() / totals.sum():.1%} of {totals.sum():,} messages arrived"
    if shares.min() < shares.max():
        headline += f"; by direction between {shares.min():.0%} and {shares.max():.0%}"
    note = "Intervals: Wilson, 95%."
    if misses is not None:
        note += f" {misses} of {len(directions)} intervals exclude the scenario's probability."
    return finish_figure(figure, data.title(headline), data.caption(note))


def _draw_shares(
    axes: Any,
    data: FigureData,
    directions: list[np.ndarray],
    shares: FloatArray,
    interval: tuple[FloatArray, FloatArray],
) -> int | None:
    """Draw ``shares`` (L,) with intervals; return how many exclude the stated probability."""
    positions, (low, high) = np.arange(len(shares)), interval
    width = max(0.4, min(3.0, 150.0 / len(shares)))
    axes.vlines(positions, low, high, color=SKY, lw=width, label="95% interval")
    axes.plot(positions, shares, ls="", marker=".", color=INK, ms=4, label="delivered")
    probabilities = np.full(len(directions), np.nan)
    for k, direction in enumerate(directions):
        link = int(direction["sender"][0]), int(direction["receiver"][0])
        # A user's class of losses may have no mean, or raise.
        with contextlib.suppress(ArithmeticError, LookupError, TypeError, ValueError):
            probabilities[k] = float(data.scenario.mean_delivery(link))
    misses = None
    if np.isfinite(probabilities).any():
        style = {"ls": "", "marker": "_", "ms": 5, "color": SENSING}
        axes.plot(positions, probabilities, **style, label="the channel of the scenario")
        misses = int(((probabilities < low) | (probabilities > high)).sum())
    axes.set_ylim(-0.02, 1.04)
    if len(directions) <= MAX_LABELLED:
        names = [">".join(_end_names(data, direction)) for direction in directions]
        rotation = 90 if len(names) * max(map(len, names)) > 24 else 0
        axes.set_xticks(positions, names, fontsize=6.5, rotation=rotation)
        axes.set_xlabel("direction, sender > receiver")
    else:
        axes.set_xlabel(f"{len(directions)} directions, in the order of their share")
        axes.locator_params(axis="x", integer=True)
    axes.set_ylabel("share of messages delivered")
    draw_legend(axes)
    return misses


def _draw_losses(axes: Any, messages: np.ndarray, end: float) -> None:
    """Draw the share of ``messages`` (M,) lost in TIME_BINS intervals until ``end`` s."""
    edges = np.linspace(0.0, end, TIME_BINS + 1)
    lost = np.histogram(messages["ended"][~heard(messages)], edges)[0]
    totals = np.histogram(messages["ended"], edges)[0]
    bins = np.flatnonzero(totals)
    low, high = wilson_interval(lost[bins], totals[bins])
    centres = 0.5 * (edges[1:] + edges[:-1])[bins]
    axes.fill_between(centres, low, high, color=FAINT, alpha=0.6, lw=0, label="95% interval")
    shares = lost[bins] / totals[bins]
    axes.plot(centres, shares, color=LOST, marker=".", label="lost in each part of the time")
    overall = lost.sum() / max(int(totals.sum()), 1)
    axes.axhline(overall, color=MUTED, ls="--", lw=1.0, label="lost in all")
    axes.set_ylim(0.0, min(1.02, 1.3 * max(float(high.max()), 0.02)))
    axes.set(xlabel=SECONDS, ylabel="share of messages lost")
    draw_legend(axes, 1)
