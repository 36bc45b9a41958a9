"""Messages of a run for a page: each send event joined with its outcome, thinned, and counted."""

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
"""A message. sent, ended: seconds, ``ended`` is nan for a message under way; age: seconds of travel
as recorded, nan for a lost one; sender, receiver: ids; number: counts the messages of a directed
link; phase: that of its slot, -1 under clocks; outcome: DELIVERED, LOST, LATE or UNDER_WAY.
"""


class ThinnedMessages(NamedTuple):
    """MESSAGE rows that a page holds: all sent from ``start`` to ``end`` seconds, and of the others
    those whose number on their directed link is a multiple of ``step``.
    """

    messages: np.ndarray
    start: float
    end: float
    step: int


def join_messages(log: np.ndarray) -> np.ndarray:
    """Return one MESSAGE row for each of the M messages sent in a run, (M,), ordered by sender,
    receiver and number: its send event joined with that of its delivery or loss.

    ``log`` (E,) are the EVENT rows of the run. Raises ValueError if an outcome belongs to no send
    event, or if ids or numbers are too large.
    """
    sends = log[log["kind"] == CODES["send"]]
    messages = np.zeros(len(sends), dtype=MESSAGE)
    for name, column in (("sender", "node"), ("receiver", "peer"), ("number", "message")):
        messages[name] = sends[column]
    messages["sent"], messages["phase"] = sends["t"], sends["phase"]
    messages["ended"] = messages["age"] = np.nan
    messages["outcome"] = UNDER_WAY
    order = np.argsort(_message_keys(messages, ("sender", "receiver")), kind="stable")
    messages = messages[order]
    # A loss is an event of the sender, an arrival one of the receiver.
    lost = log[log["kind"] == CODES["lost"]]
    _set_outcomes(messages, lost, LOST, ("node", "peer"))
    for kind, outcome in (("deliver", DELIVERED), ("late", LATE)):
        rows = log[log["kind"] == CODES[kind]]
        _set_outcomes(messages, rows, outcome, ("peer", "node"))
    return messages


def _message_keys(
    rows: np.ndarray, node_columns: tuple[str, str], number_column: str = "number"
) -> np.ndarray:
    """Return integers (M,) that order messages by sender, receiver, number; raises ValueError."""
    sender, receiver = (rows[name].astype(np.uint64) for name in node_columns)
    number = rows[number_column].astype(np.uint64)
    if len(rows) and (max(sender.max(), receiver.max()) >> 20 or number.max() >> 24):
        raise ValueError("node ids or message numbers are too large for a page")
    return np.asarray((sender << np.uint64(44)) | (receiver << np.uint64(24)) | number)


def _set_outcomes(
    messages: np.ndarray, rows: np.ndarray, outcome: int, node_columns: tuple[str, str]
) -> None:
    """Set ``outcome``, ``ended`` and ``age`` of the ``messages`` that EVENT ``rows`` are about."""
    if not len(rows):
        return
    keys = _message_keys(messages, ("sender", "receiver"))
    row_keys = _message_keys(rows, node_columns, "message")
    indices = np.minimum(np.searchsorted(keys, row_keys), max(0, len(keys) - 1))
    if not len(keys) or (keys[indices] != row_keys).any():
        raise ValueError("an outcome belongs to no message")
    messages["outcome"][indices] = outcome
    messages["ended"][indices] = rows["t"]
    messages["age"][indices] = rows["age"]


def thin_messages(messages: np.ndarray, max_messages: int, instant: float) -> ThinnedMessages:
    """Return at most about ``max_messages`` of the MESSAGE rows ``messages`` (M,), one for each
    message of a run, so that the page does not become too large.

    If there are more, half of those returned are all messages of an interval around ``instant``
    (seconds), and the other half is spread over the run.
    """
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
    """Return the age of information (T, N) in seconds of N ``nodes`` at sample ``times`` (T,): the
    time since the newest delivered message of a link was sent, averaged over the links into a node.

    A sample includes the messages that arrived until its cutoff, ``cutoffs`` (T,) in seconds.
    Before the first delivery the age is the time since the start; it is nan for a node without
    incoming links. ``messages`` (M,) are MESSAGE rows, one for each message sent, ordered as by
    ``join_messages``.
    """
    total = np.zeros((len(times), len(nodes)))
    links = np.zeros(len(nodes))
    # The messages of each directed link are neighbours.
    ends = np.flatnonzero((np.diff(messages["sender"]) != 0) | (np.diff(messages["receiver"]) != 0))
    for link in np.split(messages, ends + 1) if len(messages) else []:
        column = int(np.searchsorted(nodes, link["receiver"][0]))
        arrived = link[link["outcome"] == DELIVERED]
        arrived = arrived[np.argsort(arrived["ended"], kind="stable")]
        # A message that overtakes another one is newer: the age does not grow when the late one
        # arrives. The first entry is for times before the first arrival.
        newest_sent = np.concatenate([[0.0], np.maximum.accumulate(arrived["sent"])])
        last_sent = newest_sent[np.searchsorted(arrived["ended"], cutoffs, side="right")]
        total[:, column] += np.maximum(0.0, times - last_sent)
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
