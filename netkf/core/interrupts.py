"""Blocks of code that signals must not interrupt."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

DEFERRED = (signal.SIGINT, signal.SIGTERM)
_inside = False


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defer SIGINT and SIGTERM until the outermost such block is left.

    In other threads than the main one this does nothing: Python delivers signals to that one.
    """
    global _inside  # noqa: PLW0603 - of the main thread alone
    if _inside or threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[tuple[int, Any]] = []
    found = {number: signal.getsignal(number) for number in DEFERRED}
    before = {number: handler for number, handler in found.items() if handler is not None}
    for number in before:  # one that is None is not Python's, and Python could not put it back
        signal.signal(number, lambda number, frame: received.append((number, frame)))
    _inside = True
    try:
        yield
    finally:
        _inside = False
        for number in reversed(before):  # a Ctrl-C from now on ends this loop: it comes last
            signal.signal(number, before[number])
        for code, frame in received:
            handler: Any = before[signal.Signals(code)]
            if callable(handler):
                handler(code, frame)
            elif handler == signal.SIG_DFL:
                os.kill(os.getpid(), code)
