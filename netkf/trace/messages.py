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
_OUTCOME_OF_KIND = np.array([OUTCOMES.get(code, UNDER_WAY) for code in range(max(OUTCOMES) + 1)])


def join_messages(log: np.ndarray) -> np.ndarray:
    """Return one MESSAGE row for each of the M messages sent in a run, (M,), ordered by sender,
    receiver and number: its send event joined with that of its delivery or loss.

    ``log`` (E,): the EVENT rows of the run. Raises ValueError for an outcome without a send.
    """
    kind, send = log["kind"], CODES["send"]
    sends, ends = np.flatnonzero(kind == send), np.flatnonzero(np.isin(kind, [*OUTCOMES]))
    # A loss is an event of the sender, an arrival one of the receiver.
    node, peer, is_lost = log["node"][ends], log["peer"][ends], kind[ends] == CODES["lost"]
    sender, receiver = np.where(is_lost, node, peer), np.where(is_lost, peer, node)
    columns = {name: log[name][sends] for name in ("node", "peer", "message")}
    key, end_key = _keys(
        (columns["node"], sender),
        (columns["peer"], receiver),
        (columns["message"], log["message"][ends]),
    )
    order, end_order = np.argsort(key, kind="stable"), np.argsort(end_key, kind="stable")
    key, end_key, sends, ends = key[order], end_key[end_order], sends[order], ends[end_order]
    messages = np.zeros(len(sends), dtype=MESSAGE)
    for name, column in zip(("sender", "receiver", "number"), columns.values(), strict=True):
        messages[name] = column[order]
    messages["sent"], messages["phase"] = log["t"][sends], log["phase"][sends]
    messages["ended"] = messages["age"] = np.nan
    messages["outcome"], messages["sent_row"], messages["end_row"] = UNDER_WAY, sends, -1
    k = np.searchsorted(key, end_key, side="right") - 1
    if (k < 0).any() or (key[k] != end_key).any() or (np.diff(end_key) == 0).any():
        raise ValueError("an outcome belongs to no message")
    messages["ended"][k], messages["age"][k] = log["t"][ends], log["age"][ends]
    messages["outcome"][k], messages["end_row"][k] = _OUTCOME_OF_KIND[kind[ends]], ends
    return messages


def _keys(*pairs: tuple[np.ndarray, np.ndarray]) -> tuple[IntArray, IntArray]:
    """Return the rows of two tables as integers in their order, from both of each column."""
    columns = [np.concatenate(pair).astype(np.int64) for pair in pairs]
    sizes = [int(column.max(initial=0)) + 1 for column in columns]
    if math.prod(sizes) >= 1 << 62 or min(int(column.min(initial=0)) for column in columns) < 0:
        columns = [np.unique(column, return_inverse=True)[1] for column in columns]
        sizes = [int(column.max(initial=0)) + 1 for column in columns]
    total = np.zeros(len(columns[0]), dtype=np.int64)
    for column, size in zip(columns, sizes, strict=True):
        total = total * size + column
    first, second = np.split(total, [len(pairs[0][0])])
    return first, second


def by_link(messages: np.ndarray) -> Iterator[np.ndarray]:
    """Yield MESSAGE rows (M,), in the order of ``join_messages``, of each directed link."""
    ends = np.flatnonzero((np.diff(messages["sender"]) != 0) | (np.diff(messages["receiver"]) != 0))
    yield from np.split(messages, ends + 1) if len(messages) else ()
