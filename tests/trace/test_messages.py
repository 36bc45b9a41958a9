"""Messages of a run: sends joined with their outcomes, beside a plain loop."""

import math

import numpy as np
import pytest

from netkf.trace.messages import DELIVERED, LATE, LOST, UNDER_WAY, join_messages
from netkf.trace.schema import CODES, EVENT

OUTCOMES = {"deliver": DELIVERED, "lost": LOST, "late": LATE}


def drawn_log(ids, seed=0):
    """Events in which messages overtake each other, some are lost and some under way."""
    random, events, number = np.random.default_rng(seed), [], {}
    for k in range(200):
        i, j = random.choice(ids, 2, replace=False).tolist()
        count = number[i, j] = number.get((i, j), -1) + 1
        events.append((float(k), "send", i, j, count, math.nan))
        kind = random.choice(["deliver", "lost", "late", "under way"])
        delay = 0.0 if kind == "lost" else float(random.integers(1, 60))
        end = (i, j) if kind == "lost" else (j, i)
        if kind != "under way":
            events.append((k + delay, kind, *end, count, math.nan if kind == "lost" else delay))
    return log_of(sorted(events, key=lambda event: event[0]))


def log_of(events):
    log = np.zeros(len(events), dtype=EVENT)
    for row, (t, kind, node, peer, message, age) in zip(log, events, strict=True):
        row["t"], row["kind"], row["node"], row["peer"] = t, CODES[kind], node, peer
        row["message"], row["age"], row["phase"] = message, age, -1
    return log


@pytest.mark.parametrize("ids", [(0, 1, 2), (5, 10**9, 2**31 - 1)])
def test_messages_are_sends_with_their_outcomes(ids):
    log = drawn_log(np.array(ids))
    found, names = {}, {code: name for name, code in CODES.items()}
    for row in log:
        kind = names[row["kind"]]
        sender, receiver = row["node"], row["peer"]
        if kind not in ("send", "lost"):
            sender, receiver = receiver, sender
        key = tuple(int(value) for value in (sender, receiver, row["message"]))
        if kind == "send":
            found[key] = [row["t"], math.nan, math.nan, UNDER_WAY]
        else:
            found[key][1:] = [row["t"], row["age"], OUTCOMES[kind]]
    messages = join_messages(log)
    assert [m[["sender", "receiver", "number"]].item() for m in messages] == sorted(found)
    columns = messages[["sent", "ended", "age", "outcome"]].tolist()
    np.testing.assert_array_equal(columns, [found[key] for key in sorted(found)])
    ended = messages["outcome"] != UNDER_WAY
    assert (log["kind"][messages["sent_row"]] == CODES["send"]).all()
    np.testing.assert_array_equal(log["t"][messages["end_row"][ended]], messages["ended"][ended])
    assert (messages["end_row"][~ended] == -1).all()


@pytest.mark.parametrize(
    "more",
    [
        [(1.0, "deliver", 2, 1, 1, 0.5)],
        [(1.0, "deliver", 2, 1, 0, 0.5), (2.0, "lost", 1, 2, 0, math.nan)],
        [(1.0, "deliver", 1, 2, 0, 0.5)],
    ],
    ids=["never sent", "twice", "of another link"],
)
def test_an_outcome_of_no_message_is_refused(more):
    with pytest.raises(ValueError, match="belongs to no message"):
        join_messages(log_of([(0.5, "send", 1, 2, 0, math.nan), *more]))


def test_a_log_without_messages():
    assert len(join_messages(log_of([]))) == 0
