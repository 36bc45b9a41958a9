"""What a run leaves behind, gathered with as little work in the loop as Python allows.

Events are appended to a list as tuples and leave it in blocks, or come in blocks; states come as
one block a sample time or several. Both go to sinks, which keep them in memory or write them to
files. From the first long block on, a thread of its own does that and the fingerprint, one thing
after the other, while the engine goes on.
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
from netkf.trace.schema import CODES, EVENT, KINDS

BLOCK = 1 << 17  # rows; large enough that the system gives memory for them in large pages
LONG = 1 << 14  # rows that are worth another thread
NAN = math.nan


class Sink(ABC):
    """Where a recorder's blocks go; from another thread too, one call at a time, where that is
    ``thread_safe``.
    """

    thread_safe: ClassVar[bool] = False
    exact_errors: bool = False
    """Whether errors keep their digits however large the state is; the recorder sets it."""

    @abstractmethod
    def events(self, rows: np.ndarray) -> None:
        """A block of EVENT rows that follows the one before."""

    @abstractmethod
    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Samples at times (T,): x (T, n), xhat (T, N, n), P (T, N, n, n), nan where the filter
        gives none, and error (T, N, n), x - xhat without the rounding of large x and xhat.
        """


class MemorySink(Sink):
    """Keeps everything."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.blocks: list[np.ndarray] = []
        self.samples: list[tuple[FloatArray, ...]] = []

    def events(self, rows: np.ndarray) -> None:
        """Appended."""
        self.blocks.append(rows)

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Appended."""
        self.samples.append((t, x, xhat, P, error))


def _ignore(row: tuple[float, int, int, int, int, int, float]) -> None:
    """No event."""


class Recorder:
    """Takes events and samples from an engine, counts them, fingerprints the events. Where
    ``counted`` events are only counted, and the sinks see samples alone.
    """

    def __init__(self, sinks: Sequence[Sink], counts_only: bool = False) -> None:
        self._sinks, self.counts_only = tuple(sinks), counts_only
        self._rows: list[tuple[float, int, int, int, int, int, float]] = []
        self._hash = hashlib.sha256()
        self._counts = np.zeros(len(KINDS), dtype=np.int64)
        self._thread: ThreadPoolExecutor | None = None
        self._handed: list[Future[None]] = []
        self.append: Callable[[tuple[float, int, int, int, int, int, float]], None]
        self.append = self._rows.append
        """``append((t, kind code, node, peer, message, phase, age))`` records one event."""
        self.sums: dict[str, tuple[float, float]] = {}
        """Sums over all nodes that exchanges should conserve: at the start, at the last sample."""
        self.stats: dict[str, int] = {}
        """What the engine counted of its own work, such as SimPy processes and events."""
        self._exact_errors = False

    @property
    def exact_errors(self) -> bool:
        """Whether errors keep their digits however large the state is: False where the engine
        subtracts xhat from x, and True where it simulates the state in a frame that moves along.
        An engine sets it before the first sample.
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
        """Pass the gathered events on once there are enough of them."""
        if len(self._rows) >= BLOCK:
            self.flush()

    def flush(self) -> None:
        """Pass the gathered events on; all that came is counted and kept then, and nothing goes on
        in another thread.
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
        self._do(self._pass_on, rows)

    def extend(self, rows: np.ndarray) -> None:
        """Record a block of EVENT rows, which nobody writes to from now on."""
        with defer_signals():  # what is counted is also kept
            self._flush_gathered()
            if not len(rows):
                return
            if self.counts_only:
                self._count(rows["kind"])
                return
            if len(rows) >= LONG and all(sink.thread_safe for sink in self._sinks):
                self._wait()  # one block at most waits for its turn
                if self._thread is None:
                    self._thread = ThreadPoolExecutor(1, "netkf-recorder")
            self._do(self._pass_on, rows)

    def add_counts(self, counts: np.ndarray) -> None:
        """Count events by kind (len(KINDS),), where they are only counted."""
        assert self.counts_only, "events are recorded"
        self._flush_gathered()
        self._counts += counts

    def _do(self, something: Callable[..., None], *arguments: Any) -> None:
        """At once, or in its turn where there is a thread for it."""
        if self._thread is None:
            something(*arguments)
        else:
            self._handed.append(self._thread.submit(something, *arguments))

    def _wait(self) -> None:
        """Until all that was handed over is done; raises what failed first."""
        while self._handed:
            self._handed[0].result()
            del self._handed[0]

    def _count(self, kinds: np.ndarray) -> None:
        self._counts += np.bincount(kinds, minlength=len(KINDS))

    def _pass_on(self, rows: np.ndarray) -> None:
        self._count(rows["kind"])
        self._hash.update(rows.data)
        for sink in self._sinks:
            sink.events(rows)

    def sample(
        self, t: float, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Record one sample of the truth (n,) and of all nodes: xhat and error (N, n), P (N, n, n),
        nan where the filter gives no covariance.
        """
        self.samples(np.array([t]), x[None], xhat[None], P[None], error[None])

    def samples(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Record some samples, which nobody writes to from now on."""
        with defer_signals():  # what one sink has seen all have
            self._do(self._show, t, x, xhat, P, error)

    def _show(self, *sample: FloatArray) -> None:
        for sink in self._sinks:
            sink.states(*sample)

    def count(self, kind: str) -> int:
        """Events of a kind that were flushed."""
        return int(self._counts[CODES[kind]])

    @property
    def counts(self) -> np.ndarray:
        """(len(KINDS),) flushed events by kind."""
        return self._counts.copy()

    @property
    def total(self) -> int:
        """Events that were flushed."""
        return int(self._counts.sum())

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the flushed events, independent of blocks and machines; empty where they were
        only counted.
        """
        return "" if self.counts_only else self._hash.hexdigest()
