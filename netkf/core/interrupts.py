"""Stretches of code that are done whole or not at all."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

WAITING = (signal.SIGINT, signal.SIGTERM)
_inside = False


@contextmanager
def defer_signals() -> Iterator[None]:
    """Ctrl-C and the request to end wait until the block is left, and all blocks around it.

    In other threads than the main one nothing is changed: Python delivers signals to that one.
    """
    global _inside  # noqa: PLW0603 - of the main thread alone
    if _inside or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []
    found = {number: signal.getsignal(number) for number in WAITING}
    before = {number: handler for number, handler in found.items() if handler is not None}
    for number in before:  # one that is None is not Python's, and Python could not put it back
        signal.signal(number, lambda number, frame: came.append((number, frame)))
    _inside = True
    try:
        yield
    finally:
        _inside = False
        for number in reversed(before):  # a Ctrl-C from now on ends this loop: it comes last
            signal.signal(number, before[number])
        for received, frame in came:
            handler: Any = before[signal.Signals(received)]
            if callable(handler):
                handler(received, frame)
            elif handler == signal.SIG_DFL:
                os.kill(os.getpid(), received)
