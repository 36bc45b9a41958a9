"""How often nodes transmit: counted from the rows, whatever the blocks."""

from collections import Counter

import numpy as np
import pytest

import netkf
from netkf.runs.outcomes import PairCounter, Transmissions, count_pairs
from netkf.runs.tables import summary_table
from netkf.trace.schema import CODES, EVENT
from tests.conftest import scenario_files


def counted(rows, size):
    found = Transmissions()
    for first in range(0, len(rows), size):
        found.add(rows[first : first + size])
    return found


@pytest.mark.one_in(3)
@pytest.mark.parametrize("file", scenario_files(), ids=lambda f: f.stem)
def test_blocks_do_not_matter(file):
    """By hand: in slots the distinct (node, t, phase) of sends, under clocks every send, or where
    nodes broadcast every transmission.
    """
    log = netkf.simulate(netkf.load(file, {"seed": 3})).log[:1000]
    sends = log[log["kind"] == CODES["send"]]
    keys = [(row["node"], row["t"], row["phase"]) for row in sends]
    slotted = len(sends) and sends["phase"].min() >= 0
    expected = Counter(int(key[0]) for key in (set(keys) if slotted else keys))
    transmitted = log[log["kind"] == CODES["transmit"]]
    if len(transmitted):
        expected = Counter(transmitted["node"].tolist())
    for size in (1, 7, 1000):
        found = counted(log, size)
        nodes = range(int(log["node"].max()) + 1)
        assert found.sent(nodes) == np.bincount(sends["node"], minlength=len(nodes)).tolist()
        assert found.transmissions(nodes) == [expected[node] for node in nodes]


def broadcasts():
    rows = np.zeros(6, dtype=EVENT)
    rows["kind"] = [CODES[k] for k in ("transmit", "send", "send", "transmit", "transmit", "send")]
    rows["node"], rows["peer"] = [4, 4, 4, 5, 4, 4], [-1, 5, 6, -1, -1, 5]
    rows["t"], rows["phase"] = [1.0, 1.0, 1.0, 2.0, 3.0, 3.0], -1
    return rows


@pytest.mark.parametrize("size", [1, 2, 6])
def test_a_broadcast_by_a_clock_is_one_transmission(size):
    found = counted(broadcasts(), size)
    assert found.sent([4, 5]) == [3, 0]
    assert found.transmissions([4, 5, 6]) == [2, 1, 0]  # node 5 had no hearer


@pytest.mark.parametrize("size", [1, 2, 3, 9])
def test_messages_of_a_step_are_one_transmission_whatever_lies_between(size):
    # Two exchanges at one instant, and a third one later.
    rows = np.zeros(9, dtype=EVENT)
    rows["kind"], rows["node"] = CODES["send"], [0, 0, 1, 0, 0, 1, 0, 1, 1]
    rows["phase"], rows["t"] = [0, 0, 0, 0, 1, 1, 1, 0, 0], [1] * 7 + [2] * 2
    found = counted(rows, size)
    assert found.transmissions([0, 1]) == [2, 3]
    assert list(found.by_phase([0, 1])) == [(0, [1, 2]), (1, [1, 1])]


def test_the_table_shows_transmissions_that_differ_from_messages():
    messages = {"sent": 3, "delivered": 3, "lost": 0, "in_flight": 0, "transmissions": 2}
    row = dict.fromkeys(("rms_error", "mean_trace", "bound", "ratio", "mean_nees"), 1.0)
    summary = {"nodes": [{"node": 0, **row}], "overall": row, "messages": messages}
    summary |= {"bound": "", "notes": ["something"], "limit": None, "central": None}
    shown = summary_table(summary)
    assert "messages: 3 sent in 2 transmissions, 3 delivered, 0 lost" in shown
    assert "note: something" in shown
    for equal in (3, None, float("nan")):  # in slots they are not counted
        messages["transmissions"] = equal
        assert "messages: 3 sent, 3 delivered" in summary_table(summary)


@pytest.mark.parametrize("size", [1, 7, 500])
@pytest.mark.parametrize("largest", [9, 2**53])
def test_pairs_are_counted_whatever_their_ids_and_blocks(largest, size):
    random = np.random.default_rng(5)
    ids = np.array([0, 3, largest - 1, largest])
    first, second = random.choice(ids, 500), random.choice(ids, 500)
    found = PairCounter()
    for k in range(0, 500, size):
        found.add(first[k : k + size], second[k : k + size])
    assert found.total == 500
    assert found.counts() == Counter(zip(first.tolist(), second.tolist(), strict=True))
    assert list(found.counts()) == sorted(found.counts())


def test_no_pairs_are_counted():
    assert PairCounter().counts() == {}
    assert [len(column) for column in count_pairs(*np.zeros((2, 0), dtype=np.int64))] == [0] * 3
