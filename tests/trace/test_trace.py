"""Tables, fingerprints, differences."""

import hashlib
import os
import signal
import threading

import numpy as np
import pytest

import netkf
from netkf.trace import recorder
from netkf.trace.nees import blurred_from, errors, traces
from netkf.trace.recorder import MemorySink
from netkf.trace.schema import EVENT, EVENT_COLUMNS, state_columns


def test_tables_have_their_columns(ring):
    run = netkf.simulate(ring)
    events, states = run.events, run.states
    assert tuple(events.columns) == EVENT_COLUMNS
    assert events.seq.tolist() == list(range(len(events)))
    assert (events.run == 0).all()
    assert events.t.is_monotonic_increasing
    assert list(states.columns) == [
        "run",
        "t",
        "node",
        "x0",
        "x1",
        "xhat0",
        "xhat1",
        "P00",
        "P01",
        "P11",
        "sq_error",
        "nees",
    ]
    assert len(states) == len(run.times) * len(run.nodes)
    row = states[(states.t == 3.5) & (states.node == 4)].iloc[0]
    e = run.x[7] - run.xhat[7, 4]
    np.testing.assert_allclose(row.sq_error, e @ e, rtol=1e-14)
    np.testing.assert_allclose(row.nees, e @ np.linalg.inv(run.P[7, 4]) @ e)
    assert run.P[7, 4, 0, 1] == row.P01
    assert "P0_11" in state_columns(12)


def test_states_that_a_node_does_not_estimate_do_not_count_and_others_that_are_nan_do():
    nan, P = np.nan, np.array([[2.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, np.nan]])
    P[2, :2] = P[:2, 2] = nan
    e = np.array([[2.0, 1.0, nan], [2.0, nan, nan], [nan, nan, nan]])
    square, nees = errors(e, np.stack([P, P, np.full((3, 3), nan)]))
    np.testing.assert_array_equal(square, [5.0, nan, nan])
    np.testing.assert_allclose(nees, [4.0, nan, nan], rtol=1e-15)
    np.testing.assert_array_equal(traces(np.stack([P, np.full((3, 3), nan)])), [2.5, nan])


def test_errors_are_blurred_from_where_rounding_shows():
    """A standard deviation below a hundred times the rounding of the state; one of 0 never is."""
    times, eps = np.arange(4.0), 4.0 * np.finfo(float).eps
    x = np.array([1.0, 1e3, 1e6, 1e9])[None, :, None]
    P = np.full((1, 4, 2, 1, 1), 4.0)
    P[:, :, 0] = (200.0 * eps * 1e6) ** 2
    e, lengths = np.ones((1, 4, 2, 1)), np.array([4])
    assert blurred_from(times, x, P, e, lengths).tolist() == [3.0]
    P[:, :, 0] = (99.0 * eps * 1e6) ** 2
    assert blurred_from(times, x, P, e, lengths).tolist() == [2.0]
    assert blurred_from(times, x, 0.0 * P, e, lengths).tolist() == [np.inf]


def test_columns_that_mean_nothing_say_so(ring):
    events = netkf.simulate(ring).events
    sense = events[events.kind == "sense"]
    assert set(sense.node) == {0, 3}
    assert (sense[["peer", "message", "phase"]] == -1).all(axis=None)
    assert sense.age.isna().all()
    assert (events[events.kind == "absorb"].age == 0.0).all()


def test_nees_of_a_certain_state_is_nan(build):
    run = netkf.simulate(build(plant={"kind": "diffusion", "A": [[-1.0]], "B": [[1.0]]}))
    states = run.states
    assert states[states.t == 0.0].nees.isna().all()
    assert states[states.t > 0.0].nees.notna().all()


def test_fingerprint_does_not_depend_on_blocks(ring, monkeypatch):
    whole = netkf.simulate(ring)
    monkeypatch.setattr(recorder, "BLOCK", 10)
    pieces = netkf.simulate(ring)
    assert pieces.fingerprint == whole.fingerprint
    assert whole.fingerprint == hashlib.sha256(whole.log.tobytes()).hexdigest()
    assert netkf.first_difference(whole, pieces) is None


class Watched(MemorySink):
    """Notes which thread calls, and in which order; fails at its ``fails``-th block."""

    def __init__(self, fails=0):
        super().__init__()
        self.calls, self.fails = [], fails

    def events(self, rows):
        self.calls.append((threading.current_thread(), "events", int(rows["node"][0])))
        super().events(rows)
        if len(self.blocks) == self.fails:
            raise OSError("the disk is full")

    def states(self, t, x, xhat, P, error):
        self.calls.append((threading.current_thread(), "states", int(t[0])))


def block(number, length):
    rows = np.zeros(length, dtype=EVENT)
    rows["node"] = number
    return rows


def test_long_blocks_are_kept_by_one_other_thread_in_their_order():
    sink, plain, fingerprint = Watched(), hashlib.sha256(), recorder.Fingerprint()
    record = recorder.Recorder([sink, fingerprint])
    here = threading.current_thread()
    for number in range(6):
        rows = block(number, recorder.LONG if number in (2, 4) else 5)
        plain.update(rows.tobytes())
        record.extend(rows)
        record.sample(
            float(number), *(np.zeros(shape) for shape in ((1,), (2, 1), (2, 1, 1), (2, 1)))
        )
    record.flush()
    assert str(fingerprint) == plain.hexdigest()
    assert record.total == 2 * recorder.LONG + 20
    expected = [(kind, number) for number in range(6) for kind in ("events", "states")]
    assert [call[1:] for call in sink.calls] == expected
    threads = [call[0] for call in sink.calls]
    assert set(threads[:4]) == {here}
    assert len(set(threads[4:])) == 1
    assert here not in threads[4:]
    assert not threads[-1].is_alive()
    record.extend(block(6, 5))  # and on it goes
    assert sink.calls[-1] == (here, "events", 6)


def test_sinks_that_may_not_be_called_from_anywhere_are_called_from_here(monkeypatch):
    monkeypatch.setattr(Watched, "thread_safe", False)
    sink = Watched()
    record = recorder.Recorder([sink, MemorySink()])
    for number in range(3):
        record.extend(block(number, recorder.LONG))
    record.flush()
    assert {call[0] for call in sink.calls} == {threading.current_thread()}


def test_what_fails_in_the_other_thread_fails_the_run():
    record = recorder.Recorder([Watched(fails=1)])
    record.extend(block(0, recorder.LONG))
    with pytest.raises(OSError, match="the disk is full"):
        record.extend(block(1, recorder.LONG))
    with pytest.raises(OSError, match="the disk is full"):
        record.flush()


class Interrupted(MemorySink):
    """Ctrl-C comes while it takes a block."""

    def events(self, rows):
        os.kill(os.getpid(), signal.SIGINT)
        super().events(rows)

    def states(self, t, x, xhat, P, error):
        os.kill(os.getpid(), signal.SIGINT)
        super().states(t, x, xhat, P, error)


def test_an_interrupt_leaves_every_sink_with_the_same():
    sinks = [MemorySink(), Interrupted(), MemorySink()]
    log = recorder.Recorder(sinks)
    with pytest.raises(KeyboardInterrupt):
        log.extend(block(0, 3))
    with pytest.raises(KeyboardInterrupt):
        log.samples(
            np.zeros(2),
            np.zeros((2, 1)),
            np.zeros((2, 3, 1)),
            np.zeros((2, 3, 1, 1)),
            np.zeros((2, 3, 1)),
        )
    assert [len(sink.blocks) for sink in sinks] == [1, 1, 1]
    assert [len(sink.samples) for sink in sinks] == [1, 1, 1]
    assert log.total == 3


def test_first_difference_names_the_event(ring):
    one = netkf.simulate(ring)
    other = netkf.simulate(ring.replace({"network.channel.loss.delivery": 0.3}))
    words = netkf.first_difference(one, other)
    row = int(words.split()[1].rstrip(":"))
    assert (
        one.events.drop(columns="run")
        .iloc[:row]
        .equals(other.events.drop(columns="run").iloc[:row])
    )
    assert "kind=deliver" in words
    assert "kind=lost" in words
    short = netkf.simulate(ring.replace({"horizon": 15.0}))
    words = netkf.first_difference(one, short)
    assert "no event" in words
    assert not {"nan", "=-1"} & {word[-3:] for word in words.split()}  # of what an event lacks
