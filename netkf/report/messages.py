"""Messages of a run: each send event joined with what became of it, and thinned for a page."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.trace.schema import CODES

DELIVERED, LOST, LATE, UNDER_WAY = range(4)
MESSAGE = np.dtype(
    [
        ("sent", "f8"),
        ("ended", "f8"),
        ("age", "f8"),
        ("sender", "i8"),
        ("receiver", "i8"),
        ("number", "i8"),
        ("phase", "i4"),
        ("outcome", "u1"),
    ]
)
"""sent, ended: seconds, ended is nan under way; age: seconds of travel as recorded, nan if lost."""


class Kept(NamedTuple):
    """Messages that a page holds: all from ``start`` to ``end`` seconds, and outside of that every
    ``step``-th of each directed link, by its number.
    """

    messages: np.ndarray
    start: float
    end: float
    step: int


def join_messages(log: np.ndarray) -> np.ndarray:
    """Return MESSAGE rows, ordered by sender, receiver and number, from EVENT rows.

    Raises ValueError if an outcome belongs to no send event.
    """
    sends = log[log["kind"] == CODES["send"]]
    messages = np.zeros(len(sends), dtype=MESSAGE)
    for name, column in (("sender", "node"), ("receiver", "peer"), ("number", "message")):
        messages[name] = sends[column]
    messages["sent"], messages["phase"] = sends["t"], sends["phase"]
    messages["ended"] = messages["age"] = np.nan
    messages["outcome"] = UNDER_WAY
    messages = messages[np.argsort(_keys(messages, ("sender", "receiver")), kind="stable")]
    lost = log[log["kind"] == CODES["lost"]]
    _add_outcomes(messages, lost, LOST, ("node", "peer"))
    for kind, outcome in (("deliver", DELIVERED), ("late", LATE)):
        rows = log[log["kind"] == CODES[kind]]
        _add_outcomes(messages, rows, outcome, ("peer", "node"))
    return messages


def _keys(rows: np.ndarray, ends: tuple[str, str], number: str = "number") -> np.ndarray:
    """Return a number for each message that orders by sender, receiver and number: node ids are
    below 2^20 and a link has fewer than 2^24 messages in what fits in memory, else ValueError.
    """
    sender, receiver = (rows[name].astype(np.uint64) for name in ends)
    count = rows[number].astype(np.uint64)
    if len(rows) and (max(sender.max(), receiver.max()) >> 20 or count.max() >> 24):
        raise ValueError("node ids or message numbers are too large for a page")
    return np.asarray((sender << np.uint64(44)) | (receiver << np.uint64(24)) | count)


def _add_outcomes(
    messages: np.ndarray, rows: np.ndarray, outcome: int, ends: tuple[str, str]
) -> None:
    """Write the outcomes of EVENT rows; ``ends`` names their columns of sender and receiver."""
    if not len(rows):
        return
    known = _keys(messages, ("sender", "receiver"))
    wanted = _keys(rows, ends, "message")
    at = np.minimum(np.searchsorted(known, wanted), max(0, len(known) - 1))
    if not len(known) or (known[at] != wanted).any():
        raise ValueError("an outcome belongs to no message")
    messages["outcome"][at] = outcome
    messages["ended"][at] = rows["t"]
    messages["age"][at] = rows["age"]


def keep_messages(messages: np.ndarray, most: int, instant: float) -> Kept:
    """Return at most about ``most`` messages: half of them all those sent around ``instant``
    seconds, most of them before, the other half spread over the run.
    """
    if len(messages) <= most:
        return Kept(messages, -np.inf, np.inf, 1)
    sent = np.sort(messages["sent"])
    whole = most // 2
    # A fifth of them after the instant, so that a chart around it is whole.
    last = int(np.searchsorted(sent, instant, side="right")) + whole // 5
    last = min(max(last, whole), len(sent))
    start, end = float(sent[last - whole]), float(sent[last - 1])
    inside = (messages["sent"] >= start) & (messages["sent"] <= end)
    step = -(-len(messages) // max(1, whole))
    return Kept(messages[inside | (messages["number"] % step == 0)], start, end, step)


def information_age(
    messages: np.ndarray, nodes: tuple[int, ...], times: FloatArray, cuts: FloatArray
) -> FloatArray:
    """Return the age of information (T, N) in seconds at sample ``times`` (T,): the time since the
    newest delivered message of a link was sent, averaged over the links into a node.

    A sample knows what has arrived by its cut (T,). Before the first delivery the age is the time
    since the start; it is nan where no link leads to a node.
    """
    total = np.zeros((len(times), len(nodes)))
    links = np.zeros(len(nodes))
    ends = np.flatnonzero((np.diff(messages["sender"]) != 0) | (np.diff(messages["receiver"]) != 0))
    for link in np.split(messages, ends + 1) if len(messages) else []:
        column = int(np.searchsorted(nodes, link["receiver"][0]))
        arrived = link[link["outcome"] == DELIVERED]
        arrived = arrived[np.argsort(arrived["ended"], kind="stable")]
        newest = np.concatenate([[0.0], np.maximum.accumulate(arrived["sent"])])
        known = newest[np.searchsorted(arrived["ended"], cuts, side="right")]
        total[:, column] += np.maximum(0.0, times - known)
        links[column] += 1.0
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(links > 0.0, links, np.nan))


def traffic(messages: np.ndarray, horizon: float, bins: int) -> dict[str, list[int]]:
    """Return the messages sent in each of ``bins`` equal parts of the run, by what became of
    them.
    """
    edges = np.linspace(0.0, max(horizon, 1e-300), bins + 1)
    names = {"delivered": DELIVERED, "lost": LOST, "late": LATE, "under way": UNDER_WAY}
    return {
        name: np.histogram(messages["sent"][messages["outcome"] == code], edges)[0].tolist()
        for name, code in names.items()
    }
