"""The progress line of a command."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from netkf.cli import process
from netkf.core.printable import one_line

CLEAR_LINE = "\r\033[K"
QUIET_SECONDS = 2.0
"""Seconds without an update after which the line shows the time that the command has taken."""


class ProgressLine:
    """Context manager with a line on standard error that each update overwrites; it is cleared at
    the end. Nothing is printed if standard error is not a terminal.
    """

    def __init__(self) -> None:
        self._is_terminal, self._printed = sys.stderr.isatty(), False
        self._began = self._updated = time.monotonic()
        self._text, self._ended = "", threading.Event()

    def __enter__(self) -> ProgressLine:
        if self._is_terminal:
            # What is printed meanwhile, such as a note, gets a line of its own.
            process.before_writing.append(self.clear)
            threading.Thread(target=self._show_time, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._is_terminal:
            process.before_writing.remove(self.clear)
        self.clear()

    def clear(self) -> None:
        """Remove the line until the next update."""
        if self._printed:
            self._printed, self._updated = False, time.monotonic()
            _print_direct("")

    def replace(self, text: str) -> None:
        """Replace the line by a text; do nothing without a terminal."""
        if self._is_terminal:
            self._text, self._updated = text, time.monotonic()
            self._printed = True
            _print_direct(one_line(text))

    def _show_time(self) -> None:
        """Show the time taken where nothing else does; runs in a thread of its own."""
        while not self._ended.wait(0.5):
            if time.monotonic() - self._updated >= QUIET_SECONDS:
                self._printed = True
                seconds = f"{time.monotonic() - self._began:.0f} s so far"
                _print_direct(one_line(f"{self._text}; {seconds}" if self._text else seconds))

    def make_time_update(self, horizon: float) -> Callable[[float], None]:
        """Return a function of the simulated time (s) that shows its share of ``horizon``."""
        last_percent, began = -1, time.monotonic()

        def update(seconds: float) -> None:
            # Engines call this far more often than the percentage changes.
            nonlocal last_percent
            percent = int(100.0 * seconds / horizon)
            if percent != last_percent:
                last_percent = percent
                text = f"{percent:3d} % of {horizon:g} simulated seconds"
                took = time.monotonic() - began
                if took >= 1.0 and 0.0 < seconds <= horizon:
                    left = took * (horizon - seconds) / seconds
                    text += f", {seconds / took:,.3g} per second, about {left:.0f} s left"
                self.replace(text)

        return update

    def make_count_update(self, unit: str) -> Callable[[int, int], None]:
        """Return a function of (done, wanted) that shows both in ``unit``, and the time left."""
        first_update: tuple[float, int] | None = None

        def update(done: int, wanted: int) -> None:
            nonlocal first_update
            now = time.monotonic()
            # The rate counts from the first update: a resumed ensemble does not begin at 0.
            if first_update is None:
                first_update = now, done
            seconds, finished = now - first_update[0], done - first_update[1]
            left = ""
            if finished and seconds:
                left = f", {finished / seconds:,.3g} per second"
                left += f", about {seconds * (wanted - done) / finished:.0f} s left"
            self.replace(f"{done:,} of {wanted:,} {unit}{left}")

        return update


def _print_direct(text: str) -> None:
    # SafeStream.write would escape the control characters that clear the line.
    write = getattr(sys.stderr, "direct", sys.stderr.write)
    write(f"{CLEAR_LINE}{text}")
    sys.stderr.flush()
