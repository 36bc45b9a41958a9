"""The figures ``age``, ``links`` and ``delivery``: age of information, messages and their losses;
``matrix``, ``fate`` and ``losses`` of outcomes of messages; and ``envelope`` of a fit.

Here a direction is a directed link, from a sender to a receiver.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np

from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.style import (
    EXACT,
    FAINT,
    INK,
    LOST,
    MUTED,
    SECONDS,
    SENSING,
    SEQUENTIAL,
    SKY,
    Picture,
    draw_legend,
    finish_figure,
    label_text,
    new_figure,
    select_evenly,
    shade_downtimes,
)
from netkf.linalg.arrays import FloatArray
from netkf.runs.connectivity import newest_heard, sent_at
from netkf.runs.outcomes import Outcomes, delivery_matrix, fate_matrix, loss_windows, outcomes_of
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


MAX_NUMBERS = 14
"""Nodes up to which numbers fit into the cells of a matrix."""
MAX_TICKS, MAX_LETTERS = 30, 75
"""Labels of a matrix, and the letters of them all that fit beside each other."""
WINDOWS, MAX_ROWS = 60, 60
"""Parts of the time, and directions whose rows can still be told apart."""


def _require_outcomes(data: FigureData) -> Outcomes:
    outcomes = outcomes_of(data.joined, data.nodes)
    if not len(outcomes.sent):
        raise UnavailableError("No message was delivered or lost.")
    return outcomes


def matrix_figure(data: FigureData) -> Picture:
    """Draw the share delivered of each sender to each receiver; raises UnavailableError."""
    outcomes = _require_outcomes(data)
    shares = delivery_matrix(outcomes, len(data.nodes))
    used = np.isfinite(shares)
    low = np.unravel_index(int(np.nanargmin(shares)), shares.shape)
    headline = f"{outcomes.heard.mean():.1%} of {len(outcomes.heard):,} messages arrived"
    if shares[used].min() < shares[used].max():
        ends = f"node {data.nodes[low[0]]} to node {data.nodes[low[1]]}"
        headline += f"; the worst link is that from {ends}, {shares[low]:.0%}"
    axes, figure = _draw_matrix(data.nodes, shares, (0.0, 1.0), SEQUENTIAL, "share delivered")
    axes.set(xlabel="receiver", ylabel="sender")
    note = "Rows are senders, columns receivers; white: nothing was sent."
    return finish_figure(figure, data.title(headline), data.caption(note))


def fate_figure(data: FigureData) -> Picture:
    """Draw correlations of outcomes of hearers of one broadcast; raises UnavailableError."""
    fates = fate_matrix(_require_outcomes(data), len(data.nodes))
    if not (data.scenario.has_broadcasts and np.isfinite(fates).any()):
        reason = "No two nodes could hear the same transmission, or they lost all or nothing."
        raise UnavailableError(reason)
    mean = float(np.nanmean(fates))
    headline = f"Outcomes of one broadcast at two hearers correlate by {mean:.2f} on average"
    axes, figure = _draw_matrix(data.nodes, fates, (-1.0, 1.0), "RdBu_r", "correlation of outcomes")
    axes.set(xlabel="hearer", ylabel="hearer")
    note = (
        "Outcomes of one transmission at two of its hearers, about the mean of each link, all "
        "senders together; white: no common broadcast, or no loss."
    )
    return finish_figure(figure, data.title(headline), data.caption(note))


def _ticks(count: int) -> np.ndarray:
    """Return which of so many rows have a label: at most MAX_TICKS, equally far apart."""
    return np.arange(0, count, -(-count // MAX_TICKS))


def _draw_matrix(
    nodes: Sequence[int], values: FloatArray, span: tuple[float, float], colours: str, label: str
) -> tuple[Any, Picture]:
    """Draw ``values`` (N, N) of pairs of nodes in colours from ``span[0]`` to ``span[1]``."""
    figure = new_figure(6.4, 5.8)
    axes = figure.add_subplot()
    cmap = mpl.colormaps[colours].with_extremes(bad="white")
    image = axes.imshow(values, vmin=span[0], vmax=span[1], cmap=cmap, interpolation="nearest")
    places = _ticks(len(nodes))
    names = [label_text(nodes[k]) for k in places.tolist()]
    is_tight = len(names) > MAX_NUMBERS or len(names) * max(map(len, names)) > MAX_LETTERS
    axes.set_xticks(places, names, fontsize=6.5, rotation=90 if is_tight else 0)
    axes.set_yticks(places, names, fontsize=6.5)
    axes.tick_params(length=0)
    if len(nodes) <= MAX_NUMBERS:
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                share = (value - span[0]) / (span[1] - span[0])
                red, green, blue, _ = cmap(float(share))
                dark = 0.3 * red + 0.59 * green + 0.11 * blue < 0.5
                style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 6.5}
                axes.text(j, i, f"{value:.2f}", color="white" if dark else INK, **style)
    figure.colorbar(image, ax=axes, shrink=0.85, label=label).outline.set_linewidth(0.5)
    return axes, figure


def losses_figure(data: FigureData) -> Picture:
    """Draw the share lost over time, in all and by direction; raises UnavailableError."""
    outcomes = _require_outcomes(data)
    edges = np.linspace(0.0, data.scenario.horizon, WINDOWS + 1)
    links, shares = loss_windows(outcomes, len(data.nodes), edges)
    bins = np.clip(np.searchsorted(edges, outcomes.sent, side="right") - 1, 0, WINDOWS - 1)
    sent, lost = (np.bincount(bins, w, WINDOWS) for w in (None, ~outcomes.heard))
    rows = select_evenly(np.arange(len(links)), MAX_ROWS)
    figure = new_figure(8.4, min(9.0, 4.2 + 0.1 * len(rows)))
    heights = [1.0, max(1.0, min(2.6, 0.06 * len(rows)))]
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=heights)
    used = np.flatnonzero(sent)
    centres = 0.5 * (edges[1:] + edges[:-1])
    style: dict[str, Any] = {"color": INK, "marker": ".", "label": "all messages"}
    upper.plot(centres[used], lost[used] / sent[used], **style)
    upper.set_ylim(-0.03, 1.03)
    upper.set_ylabel("share lost")
    shade_downtimes(upper, data)
    draw_legend(upper)
    cmap = mpl.colormaps[SEQUENTIAL].with_extremes(bad="white")
    image = lower.pcolormesh(
        edges, np.arange(len(rows) + 1), shares[rows], vmin=0.0, vmax=1.0, cmap=cmap
    )
    pairs = (map(label_text, (data.nodes[k] for k in links[row])) for row in rows.tolist())
    names = [f"{sender} to {receiver}" for sender, receiver in pairs]
    ticks = _ticks(len(rows))
    lower.set_yticks(ticks + 0.5, [names[k] for k in ticks.tolist()], fontsize=5.5)
    lower.invert_yaxis()
    lower.set(xlabel=SECONDS, ylabel="sender to receiver")
    lower.set_xlim(0.0, float(edges[-1]))
    bar = figure.colorbar(image, ax=[upper, lower], shrink=0.6, label="share lost")
    bar.outline.set_linewidth(0.5)
    worst = used[int(np.argmax(lost[used] / sent[used]))]
    headline = f"{(~outcomes.heard).mean():.1%} of the messages were lost"
    if lost[worst]:
        window = f"{edges[worst]:.6g} and {edges[worst + 1]:.6g} s"
        headline += f"; at worst {lost[worst] / sent[worst]:.0%}, between {window}"
    note = f"In parts of {edges[1]:.5g} s, by the time of sending; white: nothing was sent."
    return finish_figure(figure, data.title(headline), data.caption(note))


COLUMNS = 3
"""Panels beside each other."""


def envelope_figure(table: Any) -> Picture:
    """Draw each quantity's range by law, and the replay; raises UnavailableError without runs."""
    if not len(table):
        raise UnavailableError("The laws were not run: netkf fit without --no-runs does so.")
    quantities, laws = list(table["quantity"].unique()), list(table["law"].unique())
    rows = math.ceil(len(quantities) / COLUMNS)
    figure = new_figure(9.0, 1.4 + rows * (1.0 + 0.24 * len(laws)))
    panels = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).ravel()
    for axes, quantity in zip(panels, quantities, strict=False):
        own = table[table["quantity"] == quantity].set_index("law").reindex(laws)
        places = np.arange(len(laws))
        axes.hlines(places, own["low"], own["high"], color=SKY, lw=5.0, label="range of the law")
        axes.plot(own["median"], places, "|", color=INK, ms=8, label="its median run")
        replay = float(own["replay"].iloc[0])
        axes.axvline(replay, color=INK, ls="--", lw=1.2, label="replay")
        outside = places[~own["inside"].astype(bool)]
        # The legend, which is that of the first panel, has it where any panel has.
        label = "_" if table["inside"].all() else "replay outside"
        style: dict[str, Any] = {"color": LOST, "ls": "", "mew": 1.6, "label": label}
        axes.plot(np.full(len(outside), replay), outside, "x", **style)
        axes.set_yticks(places, laws)
        axes.margins(x=0.12)
        if own[["low", "high", "replay"]].stack().nunique() == 1:
            axes.set_xlim(replay - 0.1, replay + 0.1)  # an axis over nothing has no scale
        axes.locator_params(axis="x", nbins=4)
        axes.set_ylim(len(laws) - 0.4, -0.6)
        axes.set_xlabel(quantity)
    for axes in panels[len(quantities) :]:
        axes.axis("off")
    draw_legend(panels[0])
    fails = [law for law in laws if not table[table["law"] == law]["inside"].all()]
    headline = f"The replay lies in the envelope of all {len(laws)} laws"
    if fails:
        headline = f"The replay lies outside the envelope of {', '.join(fails)}"
    runs = int(table["runs"].iloc[0])
    note = (
        f"{runs:,} runs of each law, with parameters drawn from their posterior; all ranges of a "
    )
    note += "law hold together."
    return finish_figure(figure, headline, [note])
