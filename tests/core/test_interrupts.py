"""Signals wait for what must be done whole."""

import os
import signal
import threading

import pytest

from netkf.core.interrupts import defer_signals


def test_a_signal_waits_until_the_block_is_left():
    done = []

    def work():
        with defer_signals():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("whole")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["whole"]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_signal_waits_for_the_outermost_block():
    done = []

    def work():
        with defer_signals():
            with defer_signals():
                os.kill(os.getpid(), signal.SIGINT)
                done.append("inner")
            done.append("outer")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["inner", "outer"]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_handler_that_is_not_pythons_is_left_alone(monkeypatch):
    plain = signal.getsignal
    monkeypatch.setattr(signal, "getsignal", lambda n: None if n == signal.SIGTERM else plain(n))
    before = plain(signal.SIGTERM)
    with defer_signals():
        assert plain(signal.SIGTERM) is before
    assert plain(signal.SIGTERM) is before


def test_other_threads_go_on_as_they_are():
    seen = []

    def work():
        with defer_signals():
            seen.append("done")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == ["done"]
