"""The recording of events and samples of a run, with little work in the event loop.

Engines append events to a list as tuples, which is passed on in blocks, or hand over blocks of
events; samples arrive one or several at a time. Both go to sinks, which keep them in memory or
write them to files. From the first long block on, a thread calls the sinks, in order, while the
engine continues.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from operator import itemgetter
from typing import Any, ClassVar

import numpy as np

from netkf.core.interrupts import defer_signals
from netkf.linalg.arrays import FloatArray
from netkf.trace.schema import CODES, DIVERGED, EVENT, KINDS

BLOCK = 1 << 17  # rows; large enough that the system gives memory for them in large pages
LONG = 1 << 14  # rows that are worth another thread
NAN = math.nan


class Sink(ABC):
    """The contract of a destination of recorded blocks.

    If ``thread_safe``, the recorder may call it from a thread of its own, one call at a time.
    """

    thread_safe: ClassVar[bool] = False
    exact_errors: bool = False
    """True if errors keep their digits however large the state is; the recorder sets it."""

    @abstractmethod
    def events(self, rows: np.ndarray) -> None:
        """Take the next block of EVENT ``rows`` (K,), in the order of time."""

    @abstractmethod
    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Take T samples at times t (T,) in seconds: x (T, n), xhat (T, N, n), P (T, N, n, n),
        error (T, N, n) of N nodes.

        P is nan if the filter gives none; error is x - xhat without the rounding of large x.
        """


class MemorySink(Sink):
    """A sink that keeps all blocks in memory."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.blocks: list[np.ndarray] = []
        self.samples: list[tuple[FloatArray, ...]] = []

    def events(self, rows: np.ndarray) -> None:
        """Append the EVENT ``rows`` (K,) to ``blocks``."""
        self.blocks.append(rows)

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Append T samples to ``samples``: t (T,), x (T, n), xhat, P and error of N nodes."""
        self.samples.append((t, x, xhat, P, error))


class Fingerprint(Sink):
    """A sink that only hashes the events: SHA-256, which does not depend on the blocks."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def events(self, rows: np.ndarray) -> None:
        """Add the EVENT ``rows`` (K,) to the hash."""
        self._hash.update(rows.data)

    def states(self, *samples: FloatArray) -> None:
        """Ignore samples."""

    def __str__(self) -> str:
        return self._hash.hexdigest()


def _ignore(row: tuple[float, int, int, int, int, int, float]) -> None:
    """Discard an event, the tuple ``row`` that ``Recorder.append`` takes."""


class Recorder:
    """Takes events and samples from an engine, counts the events, and passes both to sinks, with
    ``counts_only`` only the samples.
    """

    def __init__(self, sinks: Sequence[Sink], counts_only: bool = False) -> None:
        self._sinks, self.counts_only = tuple(sinks), counts_only
        self._rows: list[tuple[float, int, int, int, int, int, float]] = []
        self._counts = np.zeros(len(KINDS), dtype=np.int64)
        self._thread: ThreadPoolExecutor | None = None
        self._pending: list[Future[None]] = []
        self.append: Callable[[tuple[float, int, int, int, int, int, float]], None]
        self.append = self._rows.append
        """``append((t, kind code, node, peer, message, phase, age))`` records one event."""
        self.sums: dict[str, tuple[float, float]] = {}
        """Sums over all nodes that exchanges should conserve: at the start, at the last sample."""
        self.stats: dict[str, int] = {}
        """Counts that the engine keeps of its own work, such as SimPy processes and events."""
        self._exact_errors, self._last_time = False, 0.0
        self.unknown: tuple[np.ndarray, np.ndarray] | None = None
        """Masks (n,) and (N, n) of states and of errors that are unknown; an engine sets it."""

    @property
    def exact_errors(self) -> bool:
        """True if errors keep their digits however large the state is.

        It is False if the engine subtracts xhat from x, and True if it simulates the state in a
        moving frame. An engine sets it before the first sample.
        """
        return self._exact_errors

    @exact_errors.setter
    def exact_errors(self, value: bool) -> None:
        self._exact_errors = value
        for sink in self._sinks:
            sink.exact_errors = value

    def pause(self) -> None:
        """Record no events until ``resume``."""
        self.append = _ignore

    def resume(self) -> None:
        """Record events again."""
        self.append = self._rows.append

    def flush_if_full(self) -> None:
        """Pass the appended events on if there are enough of them for a block."""
        if len(self._rows) >= BLOCK:
            self.flush()

    def flush(self) -> None:
        """Pass the appended events on and wait until every sink has taken all of them; engines call
        it at the end of a run, and also after an error.
        """
        with defer_signals():
            try:
                self._flush_gathered()
                self._wait()
            finally:
                thread, self._thread = self._thread, None
                if thread is not None:
                    thread.shutdown()

    def _flush_gathered(self) -> None:
        if not self._rows:
            return
        if self.counts_only:
            kinds = np.fromiter(map(itemgetter(1), self._rows), dtype=np.uint8)
            self._rows.clear()
            self._count(kinds)
            return
        rows = np.array(self._rows, dtype=EVENT)
        self._rows.clear()
        self._last_time = float(rows["t"][-1])
        self._run_or_submit(self._pass_on, rows)

    def extend(self, rows: np.ndarray) -> None:
        """Record a block of EVENT ``rows`` (K,), after the events appended one by one; the caller
        must not write to it afterwards, since sinks keep it or take it in another thread.
        """
        with defer_signals():  # a signal must not separate the count from the rows
            self._flush_gathered()
            if not len(rows):
                return
            self._last_time = float(rows["t"][-1])
            if self.counts_only:
                self._count(rows["kind"])
                return
            if len(rows) >= LONG and all(sink.thread_safe for sink in self._sinks):
                self._wait()  # one block at most waits for its turn
                if self._thread is None:
                    self._thread = ThreadPoolExecutor(1, "netkf-recorder")
            self._run_or_submit(self._pass_on, rows)

    def add_counts(self, counts: np.ndarray) -> None:
        """Add ``counts`` (len(KINDS),) of events by kind; only with ``counts_only``."""
        assert self.counts_only, "events are recorded"
        self._flush_gathered()
        self._counts += counts

    def _run_or_submit(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call ``function`` now, or in order in the recorder's thread if it has one."""
        if self._thread is None:
            function(*arguments)
        else:
            self._pending.append(self._thread.submit(function, *arguments))

    def _wait(self) -> None:
        """Wait for the recorder's thread; raises the exception of the first call that failed."""
        while self._pending:
            self._pending[0].result()
            del self._pending[0]

    def _count(self, kinds: np.ndarray) -> None:
        """Count events by their kind codes ``kinds`` (K,)."""
        self._counts += np.bincount(kinds, minlength=len(KINDS))

    def _pass_on(self, rows: np.ndarray) -> None:
        """Count a block of EVENT ``rows`` (K,), and pass it to all sinks."""
        self._count(rows["kind"])
        for sink in self._sinks:
            sink.events(rows)

    def sample(
        self, t: float, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Record one sample at ``t`` (seconds) of the truth x (n,) and of all nodes: xhat and error
        (N, n), P (N, n, n), nan where the filter gives no covariance.
        """
        self.samples(np.array([t]), x[None], xhat[None], P[None], error[None])

    def samples(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Record T samples at times t (T,) in seconds: x (T, n), xhat and error (T, N, n), P
        (T, N, n, n); the caller must not write to the arrays afterwards.
        """
        if self.unknown is not None:
            # Engines count them as 0.
            states, errors = self.unknown
            x, error = np.where(states, NAN, x), np.where(errors, NAN, error)
        with defer_signals():  # a signal must not leave the sinks with different samples
            self._run_or_submit(self._pass_sample_on, t, x, xhat, P, error)

    def _pass_sample_on(self, *sample: FloatArray) -> None:
        for sink in self._sinks:
            sink.states(*sample)

    def end_as_diverged(self, t: float, nodes: Sequence[int]) -> None:
        """Record that the estimates of ``nodes`` (ids) are broken in the sample at ``t`` (seconds).

        A sample of a slot may be taken when it ends: the time is that of the last event then.
        """
        t = max(t, self._rows[-1][0] if self._rows else self._last_time)
        for node in nodes:
            self.append((t, DIVERGED, node, -1, -1, -1, NAN))

    def count(self, kind: str) -> int:
        """Return the number of flushed events of a kind."""
        return int(self._counts[CODES[kind]])

    @property
    def counts(self) -> np.ndarray:
        """The numbers (len(KINDS),) of flushed events of each kind."""
        return self._counts.copy()

    @property
    def total(self) -> int:
        """The number of flushed events."""
        return int(self._counts.sum())
