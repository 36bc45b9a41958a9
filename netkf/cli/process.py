"""The process of a command: signals, standard streams, and its end with an exit status."""

from __future__ import annotations

import _thread
import atexit
import contextlib
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

from netkf.core.interrupts import LAST_WRITES
from netkf.core.printable import printable

TYPE_CHECKING = False  # as in netkf/__init__.py
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any, NoReturn, TextIO

INTERRUPTED = 130
"""Exit status of an interrupted command."""
END_SECONDS = 8.0
"""Seconds after which the process of an interrupted command is ended if it has not ended itself."""
INTERRUPTED_LATE = "netkf: interrupted; what was finished is kept"
EXIT_SECONDS = 4.0
"""Seconds after which functions registered with ``atexit`` are not waited for."""
RESEND_SECONDS = 0.02  # long enough for the frame that swallowed the exception to return
KEEPING_SECONDS = 4.0
"""Seconds in which no garbage is collected: a command imports 1,000 modules, whose objects stay."""
POSTPONED = ("numpy.f2py", "numpy.testing")
"""Modules that libraries import and hardly ever use, which are executed at their first use: scipy
copies all names of numpy, and so would import its Fortran compiler.
"""


class Interruption:
    """Context manager in which Ctrl-C and SIGTERM raise one KeyboardInterrupt.

    They raise it between ``arm`` and ``disarm``: a signal before ``arm`` raises there, and one
    after ``disarm`` does nothing, nor do signals after the first. SIGTERM, with which batch systems
    stop jobs, means the same as Ctrl-C. With ``ends_process`` the process ends END_SECONDS after
    the signal at the latest. ``received`` is True after a signal.
    """

    def __init__(self, ends_process: bool = False) -> None:
        self.received = self._armed = self._disarmed = False
        self._previous_handlers: dict[signal.Signals, Any] = {}
        self._previous_hook = sys.unraisablehook
        self._needs_deadline = ends_process

    def __enter__(self) -> Interruption:
        if threading.current_thread() is not threading.main_thread():
            return self  # Python lets only the main thread handle signals
        self._previous_hook, sys.unraisablehook = sys.unraisablehook, self._handle_unraisable
        for number in (signal.SIGINT, signal.SIGTERM):
            # A signal that a shell or nohup made the process ignore stays ignored.
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                self._previous_handlers[number] = signal.signal(number, self._receive)
        if self._needs_deadline and sys.platform != "win32":  # where only sockets can wake up
            descriptor, signalled = os.pipe()
            os.set_blocking(signalled, False)
            signal.set_wakeup_fd(signalled, warn_on_full_buffer=False)
            _thread.start_new_thread(self._watch, (descriptor,))
            self._needs_deadline = False
        return self

    def _watch(self, descriptor: int) -> None:
        """End the process END_SECONDS after a signal, also while compiled code runs."""
        # In a thread of its own: handlers in Python wait until that code returns.
        while True:
            numbers = os.read(descriptor, 9)
            if not self._disarmed and any(n in self._previous_handlers for n in numbers):
                break
        end_later(INTERRUPTED, END_SECONDS, INTERRUPTED_LATE)

    def __exit__(self, *_: object) -> None:
        self._armed = False
        for number, handler in self._previous_handlers.items():
            signal.signal(number, handler)
        if sys.unraisablehook == self._handle_unraisable:
            sys.unraisablehook = self._previous_hook

    def arm(self) -> None:
        """Make signals raise KeyboardInterrupt from now on, and at once if one was received."""
        self._armed = True
        if self.received:
            raise KeyboardInterrupt

    def disarm(self) -> None:
        """Ignore signals from now on, because the command has ended."""
        self._disarmed, self._armed = True, False

    def _receive(self, number: int, frame: FrameType | None) -> None:
        """Remember the first signal, and raise KeyboardInterrupt if the command is armed."""
        if self.received or self._disarmed:
            return
        self.received = True
        if self._needs_deadline:
            self._needs_deadline = False
            end_later(INTERRUPTED, END_SECONDS, INTERRUPTED_LATE)
        if self._armed:
            raise KeyboardInterrupt

    def _handle_unraisable(self, unraisable: Any) -> None:
        if unraisable.exc_type is None or not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._previous_hook(unraisable)
        elif self._armed and self._previous_handlers:
            number = next(iter(self._previous_handlers))
            _thread.start_new_thread(self._send_again, (number,))

    def _send_again(self, number: signal.Signals) -> None:
        """Send a signal again after RESEND_SECONDS; runs in a thread of its own."""
        time.sleep(RESEND_SECONDS)
        self.received = False
        # A signal to that very thread also ends its blocking system calls.
        main = threading.main_thread().ident
        if main is not None and hasattr(signal, "pthread_kill"):
            signal.pthread_kill(main, number)
        else:
            _thread.interrupt_main(number)


class QuickImports:
    """A finder of modules that saves a third of the time in which a command imports libraries: it
    postpones POSTPONED, and lets matplotlib write no documentation of its classes.
    """

    _is_patched = False

    def find_spec(self, name: str, path: Any, _: object = None) -> Any:
        """Return the specification of a postponed module; None for all others."""
        artist = sys.modules.get("matplotlib.artist")
        if not self._is_patched and hasattr(artist, "kwdoc"):
            self._is_patched = True
            module: Any = artist
            module.kwdoc = lambda _: ""
            # It describes the method ``set`` of each class of artists by all its properties.
            module.Artist._update_set_signature_and_docstring = classmethod(lambda _: None)
        if name not in POSTPONED:
            return None
        from importlib.machinery import PathFinder
        from importlib.util import LazyLoader

        spec = PathFinder.find_spec(name, path)
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


def collect_garbage_later() -> None:
    """Collect no cyclic garbage for KEEPING_SECONDS."""

    def collect() -> None:
        time.sleep(KEEPING_SECONDS)
        # What was imported until now stays: it need not be looked through again and again.
        gc.freeze()
        gc.enable()

    gc.disable()
    _thread.start_new_thread(collect, ())


def end_later(status: int, seconds: float, message: str = "") -> None:
    """Start a thread that later flushes results (LAST_WRITES), prints ``message``, and ends."""

    def end() -> None:
        time.sleep(seconds)
        for write in tuple(LAST_WRITES):
            with contextlib.suppress(Exception):
                write()
        if message:
            with contextlib.suppress(Exception):
                os.write(2, f"{message}\n".encode())
        os._exit(status)

    # Not threading.Thread: it takes locks that the main thread may hold.
    _thread.start_new_thread(end, ())


def end_process(status: int) -> NoReturn:
    """Run the functions of ``atexit``, flush the streams and end without waiting for threads."""
    end_later(status, EXIT_SECONDS)
    # Nothing is imported here: if the module is missing, no server was started.
    process_start = sys.modules.get("netkf.ensembles.process_start")
    if process_start is not None:
        process_start.kill_server()
    with contextlib.suppress(BaseException):
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(status)


def open_missing_streams() -> None:
    """Open the null device as each closed standard stream, whose descriptor files would get."""
    for number, flags in enumerate((os.O_RDONLY, os.O_WRONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, flags)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


before_writing: list[Callable[[], None]] = []
"""Called before text is written to a standard stream: a progress line leaves its place."""


class OutputError(OSError):
    """Standard output cannot be written to."""


class SafeStream:
    """A text stream that escapes control characters: files cannot control the terminal.

    A ``lossy`` stream ignores errors of writing. Others raise OutputError, except for a broken
    pipe: the reader, such as ``head``, needs no more output, so that the rest is discarded.
    """

    def __init__(self, stream: TextIO, lossy: bool) -> None:
        self._stream, self._lossy = stream, lossy

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text with its control characters escaped; return the length written."""
        for function in before_writing:
            function()
        return self.direct(printable(text))

    def direct(self, text: str) -> int:
        """Write a text as it is, such as one that moves the cursor; return its length."""
        with self._handle_failures():
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                encoding = getattr(self._stream, "encoding", None) or "ascii"
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        with self._handle_failures():
            self._stream.flush()

    @contextlib.contextmanager
    def _handle_failures(self) -> Iterator[None]:
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
    """Use SafeStreams within the block; only standard error may lose what it cannot write."""
    stdout, stderr = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = SafeStream(stdout, lossy=False), SafeStream(stderr, lossy=True)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = stdout, stderr


def discard_output(stream: Any = None) -> None:
    """Send what is left in a stream's buffer to the null device, where it cannot fail."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), (stream or sys.stdout).fileno())


def run_as_process(command: Callable[[Interruption], int]) -> NoReturn:
    """Run a command as the only one of this process, and end the process with its exit status."""
    with Interruption(ends_process=True) as interruption:
        open_missing_streams()
        collect_garbage_later()
        sys.meta_path.insert(0, QuickImports())
        # Imported only now, when signals are handled: an interrupt during imports would end in a
        # traceback.
        import logging
        import warnings

        # Warnings and logs of libraries are for programmers, not for users of the command line.
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        logging.disable()
        try:
            status = command(interruption)
        except SystemExit as stop:  # raised by the parser, which has printed its message
            status = stop.code if isinstance(stop.code, int) else 0
        end_process(status)
