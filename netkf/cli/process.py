"""How the process of a command begins and ends: standard streams, signals, the exit status."""

from __future__ import annotations

import _thread
import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

from netkf.core.printable import printable

TYPE_CHECKING = False  # as in netkf/__init__.py
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any, NoReturn, TextIO

INTERRUPTED = 130
END_SECONDS = 8.0
"""Seconds in which an interrupted command ends by itself; then it is ended."""
EXIT_SECONDS = 4.0
"""Seconds that functions registered with ``atexit`` have."""
AGAIN_SECONDS = 0.02  # long enough for the frame that swallowed the exception to return


class Interruption:
    """Ctrl-C and SIGTERM raise one KeyboardInterrupt between ``arm`` and ``disarm``; use it as a
    context manager.

    Batch systems stop jobs with SIGTERM: it means the same as Ctrl-C. Later signals are ignored:
    the command is ending. Where it ``ends_process``, the process ends after END_SECONDS anyway.
    A signal that comes before ``arm`` raises there; one that comes after ``disarm`` does nothing.
    """

    def __init__(self, ends_process: bool = False) -> None:
        self.received = self._armed = self._ended = False
        self._before: dict[signal.Signals, Any] = {}
        self._hook = sys.unraisablehook
        self._watched = not ends_process

    def __enter__(self) -> Interruption:
        if threading.current_thread() is not threading.main_thread():
            return self
        self._hook, sys.unraisablehook = sys.unraisablehook, self._raise_again
        for number in (signal.SIGINT, signal.SIGTERM):
            found = signal.getsignal(number)
            # What a shell or nohup made the process ignore stays ignored.
            if found not in (signal.SIG_IGN, None):
                self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        self._armed = False
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if sys.unraisablehook == self._raise_again:
            sys.unraisablehook = self._hook

    def arm(self) -> None:
        """Let signals raise from now on."""
        self._armed = True
        if self.received:
            raise KeyboardInterrupt

    def disarm(self) -> None:
        """Let signals do nothing from now on: the command has ended."""
        self._ended, self._armed = True, False

    def _receive(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: raise KeyboardInterrupt if armed, and remember it."""
        if self.received or self._ended:
            return
        self.received = True
        self._watch()
        if self._armed:
            raise KeyboardInterrupt

    def _watch(self) -> None:
        """End the process later, if it is still there."""
        if not self._watched:
            self._watched = True
            line = "netkf: interrupted; what was finished is kept"
            end_later(INTERRUPTED, END_SECONDS, line)

    def _raise_again(self, unraisable: Any) -> None:
        """Raise an interrupt again that Python has dropped, as it does in finalizers and callbacks
        of C code.
        """
        if unraisable.exc_type is None or not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)
        elif self._armed and self._before:
            _thread.start_new_thread(self._send_again, (next(iter(self._before)),))

    def _send_again(self, number: signal.Signals) -> None:
        """Send the signal once more after a while, in case its exception was swallowed."""
        time.sleep(AGAIN_SECONDS)
        self.received = False
        # To the main thread itself: that ends what it waits for.
        main = threading.main_thread().ident
        if main is not None and hasattr(signal, "pthread_kill"):
            signal.pthread_kill(main, number)
        else:
            _thread.interrupt_main(number)


def end_later(status: int, seconds: float, line: str = "") -> None:
    """End the process with ``status`` after some seconds, whatever its main thread waits for."""

    def end() -> None:
        """End the process after the delay."""
        time.sleep(seconds)
        if line:
            with contextlib.suppress(Exception):
                os.write(2, f"{line}\n".encode())
        os._exit(status)

    # A plain thread: threading.Thread takes locks that the main thread may hold.
    _thread.start_new_thread(end, ())


def end_process(status: int) -> NoReturn:
    """Call the functions registered with ``atexit``, and end the process without waiting for
    threads.

    A command has written everything by now. The interpreter's own way to end joins threads, and
    writes to closed streams once more.
    """
    end_later(status, EXIT_SECONDS)
    starting = sys.modules.get("netkf.ensembles.process_start")
    if starting is not None:
        starting.kill_server()
    with contextlib.suppress(BaseException):
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(status)


def open_missing_streams() -> None:
    """Open the null device for standard streams that are closed: files would get their numbers
    otherwise, and printed text would end in files.
    """
    for number, flags in enumerate((os.O_RDONLY, os.O_WRONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, flags)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


class OutputError(OSError):
    """Standard output cannot be written to."""


class SafeStream:
    """A text stream through which no control characters of files reach a terminal.

    write  : a text with its control characters escaped, as far as the stream can encode it
    direct : a text as it is
    A ``lossy`` stream drops what cannot be written; else OutputError is raised, but where nobody
    reads any more: that stops no command
    """

    def __init__(self, stream: TextIO, lossy: bool) -> None:
        self._stream, self._lossy = stream, lossy

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text and return its length."""
        return self.direct(printable(text))

    def direct(self, text: str) -> int:
        """Write a text of netkf's own that may move the cursor."""
        with self._failures():
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                encoding = getattr(self._stream, "encoding", None) or "ascii"
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        with self._failures():
            self._stream.flush()

    @contextlib.contextmanager
    def _failures(self) -> Iterator[None]:
        """Turn failures into OutputError, or ignore them where output may be lost."""
        try:
            yield
        except BrokenPipeError:
            if not self._lossy:
                discard_output(self._stream)
        except (OSError, ValueError) as error:  # ValueError: the stream is closed
            if not self._lossy:
                raise OutputError(getattr(error, "errno", None), str(error)) from error


@contextlib.contextmanager
def safe_streams() -> Iterator[None]:
    """Put SafeStreams in place of the standard streams: errors and notes that nobody can read do
    not stop a command, results that cannot be written do.
    """
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = SafeStream(before[0], False), SafeStream(before[1], True)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def discard_output(stream: Any = None) -> None:
    """Send the rest of standard output to the null device; it would fail again at the end."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), (stream or sys.stdout).fileno())


def run_as_process(command: Callable[[Interruption], int]) -> NoReturn:
    """Run the command of this process, and end the process with its status."""
    with Interruption(ends_process=True) as interruption:
        open_missing_streams()
        # Imported when signals are handled: an interrupt before that ends Python in its own way.
        import logging
        import warnings

        # Warnings and logs of libraries are for those who write code.
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        logging.disable()
        try:
            status = command(interruption)
        except SystemExit as stop:  # of the parser, which has printed its line
            status = stop.code if isinstance(stop.code, int) else 0
        end_process(status)
