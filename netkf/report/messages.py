"""Messages of a run for a page: thinned, and counted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.runs.connectivity import newest_heard
from netkf.trace.messages import DELIVERED, LATE, LOST, UNDER_WAY, by_link


class ThinnedMessages(NamedTuple):
    """MESSAGE rows that a page holds: all sent from ``start`` to ``end`` seconds, and of the others
    those whose number on their directed link is a multiple of ``step``.
    """

    messages: np.ndarray
    start: float
    end: float
    step: int


def thin_messages(messages: np.ndarray, max_messages: int, instant: float) -> ThinnedMessages:
    """Return about ``max_messages`` MESSAGE rows: half around ``instant`` (s), half of the run."""
    if len(messages) <= max_messages:
        return ThinnedMessages(messages, -np.inf, np.inf, 1)
    sent = np.sort(messages["sent"])
    half = max_messages // 2
    # A fifth of the interval's messages are after the instant, so that a chart around it is whole.
    last = int(np.searchsorted(sent, instant, side="right")) + half // 5
    last = min(max(last, half), len(sent))
    start, end = float(sent[last - half]), float(sent[last - 1])
    inside = (messages["sent"] >= start) & (messages["sent"] <= end)
    step = -(-len(messages) // max(1, half))
    return ThinnedMessages(messages[inside | (messages["number"] % step == 0)], start, end, step)


def information_age(
    messages: np.ndarray, nodes: tuple[int, ...], times: FloatArray, cutoffs: FloatArray
) -> FloatArray:
    """Return the age (T, N) in seconds of the newest delivered message, averaged over links into a
    node, of samples with ``cutoffs`` (T,); before the first the time since 0, nan without links.
    """
    total = np.zeros((len(times), len(nodes)))
    links = np.zeros(len(nodes))
    for link in by_link(messages):
        column = int(np.searchsorted(nodes, link["receiver"][0]))
        arrived = link[link["outcome"] == DELIVERED]
        arrived = arrived[np.argsort(arrived["ended"], kind="stable")]
        newest = newest_heard(arrived["ended"], arrived["sent"], cutoffs)
        total[:, column] += np.maximum(0.0, times - newest)
        links[column] += 1.0
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(links > 0.0, links, np.nan))


def bin_messages(messages: np.ndarray, horizon: float, bins: int) -> dict[str, list[int]]:
    """Return by outcome the numbers (bins,) of messages sent in equal parts of ``horizon`` s."""
    edges = np.linspace(0.0, max(horizon, 1e-300), bins + 1)
    names = {"delivered": DELIVERED, "lost": LOST, "late": LATE, "under way": UNDER_WAY}
    return {
        name: np.histogram(messages["sent"][messages["outcome"] == code], edges)[0].tolist()
        for name, code in names.items()
    }
