"""Blocks of code that SIGINT (Ctrl-C) and SIGTERM do not interrupt."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TYPE_CHECKING = False  # as in netkf/__init__.py
if TYPE_CHECKING:
    from typing import Any

DEFERRED = (signal.SIGINT, signal.SIGTERM)
LAST_WRITES: list[Callable[[], None]] = []
"""Functions that write results that wait in memory, called by a thread that ends the process while
compiled code keeps the main thread.
"""
_is_deferring = False  # the main thread is in a block of defer_signals


@contextmanager
def writing_at_last(write: Callable[[], None]) -> Iterator[None]:
    """Have ``write`` called if the process is ended within the block by another thread."""
    LAST_WRITES.append(write)
    try:
        yield
    finally:
        LAST_WRITES.remove(write)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Hold back SIGINT and SIGTERM in a block; their handlers are called when it is left.

    Of blocks inside one another the outermost counts. In other threads than the main one this does
    nothing, because Python calls handlers in the main thread only.
    """
    global _is_deferring  # noqa: PLW0603 - only the main thread uses it
    if _is_deferring or threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[tuple[int, Any]] = []
    handlers: dict[signal.Signals, Any] = {}
    for number in DEFERRED:
        handler = signal.getsignal(number)
        if handler is not None:  # None: set by other code than Python, which could not restore it
            handlers[number] = handler
    for number in handlers:
        signal.signal(number, lambda number, frame: received.append((number, frame)))
    _is_deferring = True
    try:
        yield
    finally:
        _is_deferring = False
        # SIGINT comes last: once its handler is restored, a Ctrl-C raises inside this loop.
        for number in reversed(handlers):
            signal.signal(number, handlers[number])
        for received_number, frame in received:
            handler = handlers[signal.Signals(received_number)]
            if callable(handler):
                handler(received_number, frame)
            elif handler == signal.SIG_DFL:
                os.kill(os.getpid(), received_number)
