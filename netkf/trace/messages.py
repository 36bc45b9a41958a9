"""The messages of a run: each send event joined with its outcome."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from netkf.linalg.arrays import IntArray
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
        ("sent_row", "i8"),
        ("end_row", "i8"),
    ]
)
"""A message. sent, ended: seconds, ``ended`` is nan for a message under way; age: seconds of travel
as recorded, nan for a lost one; sender, receiver: ids; number: counts the messages of a directed
link; phase: that of its slot, -1 under clocks; outcome: DELIVERED, LOST, LATE or UNDER_WAY;
sent_row, end_row: rows of both events in the log, -1 for a message under way.
"""
OUTCOMES = {CODES["deliver"]: DELIVERED, CODES["lost"]: LOST, CODES["late"]: LATE}
"""Outcomes by the codes of their events."""


def join_messages(log: np.ndarray) -> np.ndarray:
    """Return one MESSAGE row for each of the M messages sent in a run, (M,), ordered by sender,
    receiver and number: its send event joined with that of its delivery or loss.

    ``log`` (E,) are the EVENT rows of the run. Raises ValueError if an outcome belongs to no send
    event.
    """
    rows = np.flatnonzero(np.isin(log["kind"], [CODES["send"], *OUTCOMES]))
    events = np.take(log, rows)
    ended = events["kind"] != CODES["send"]
    # A loss is an event of the sender, an arrival one of the receiver.
    of_sender = ~ended | (events["kind"] == CODES["lost"])
    sender = np.where(of_sender, events["node"], events["peer"])
    receiver = np.where(of_sender, events["peer"], events["node"])
    order = _order_by(sender, receiver, events["message"], ended)
    events, rows, ended = np.take(events, order), rows[order], ended[order]
    sends = np.flatnonzero(~ended)
    messages = np.zeros(len(sends), dtype=MESSAGE)
    columns = {"sender": sender[order], "receiver": receiver[order], "number": events["message"]}
    for name, column in columns.items():
        messages[name] = column[sends]
    messages["sent"], messages["phase"] = events["t"][sends], events["phase"][sends]
    messages["sent_row"] = rows[sends]
    messages["ended"] = messages["age"] = np.nan
    messages["outcome"], messages["end_row"] = UNDER_WAY, -1
    # The event of an outcome directly follows that of its message.
    ends = np.flatnonzero(ended)
    follows = ~ended[ends - 1] if len(sends) else np.zeros(len(ends), dtype=bool)
    for column in columns.values():
        follows &= column[ends] == column[ends - 1]
    if not follows.all() or (len(ends) and not ends[0]):
        raise ValueError("an outcome belongs to no message")
    k = np.cumsum(~ended)[ends] - 1
    messages["ended"][k], messages["age"][k] = events["t"][ends], events["age"][ends]
    for code, outcome in OUTCOMES.items():
        messages["outcome"][k[events["kind"][ends] == code]] = outcome
    messages["end_row"][k] = rows[ends]
    return messages


def _order_by(*keys: np.ndarray) -> IntArray:
    """Return the order (K,) of rows by integer ``keys`` (K,), the first one first."""
    sizes = [int(key.max(initial=0)) + 1 for key in keys]
    if math.prod(sizes) >= 1 << 62 or min(int(key.min(initial=0)) for key in keys) < 0:
        return np.lexsort(keys[::-1])
    # As one number they are sorted once, not key by key.
    number = np.zeros(len(keys[0]), dtype=np.int64)
    for key, size in zip(keys, sizes, strict=True):
        number = number * size + key
    return np.argsort(number, kind="stable")


def by_link(messages: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the MESSAGE rows of each directed link; ``messages`` (M,) are in the order of
    ``join_messages``.
    """
    ends = np.flatnonzero((np.diff(messages["sender"]) != 0) | (np.diff(messages["receiver"]) != 0))
    yield from np.split(messages, ends + 1) if len(messages) else ()
