"""A cache of compiled code on disk for several processes: one compiles, the others wait.

Without it, processes that start side by side would all compile the same kernels, and entries of
an index file, which is read, changed and written, would be lost.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

MAX_WAIT, POLL = 60.0, 0.02
"""Longest wait in seconds for another process that compiles (several times the usual compile time),
and interval at which the lock is tried.
"""


LOCK_FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
"""A lock file is made where it is, not where a link points to."""


class SharedCache:
    """A numba dispatcher's cache with locks between processes, otherwise as it is."""

    def __init__(
        self, cache: Any, name: str, on_missing: Callable[[], None] = lambda: None
    ) -> None:
        """Wrap a ``cache`` of the function ``name``, which names its lock files; ``on_missing`` is
        called before code that it lacks is compiled.
        """
        self._cache, self._name, self._on_missing = cache, name, on_missing
        self._waiting = ExitStack()

    def __getattr__(self, name: str) -> Any:
        """Return the attribute ``name`` of the wrapped cache: all that is not defined here."""
        return getattr(self._cache, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached code for a signature, or None.

        After None this process holds the lock of the signature: it compiles and saves the code, and
        must call :meth:`release`, for which other processes wait.
        """
        code = self._cache.load_overload(sig, target_context)
        if code is not None:
            return code
        self._on_missing()
        # A lock for each signature: processes that need another signature do not wait.
        signature = hashlib.sha256(str(sig).encode()).hexdigest()[:16]
        self._waiting.enter_context(self._locked(f"{self._name}-{signature}.lock"))
        # Another process may have compiled it while this one was waiting.
        return self._cache.load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code for a signature."""
        # All signatures of a function share one index file, which needs its own lock.
        with self._locked(f"{self._name}.lock"):
            self._cache.save_overload(sig, data)

    def release(self) -> None:
        """Release the lock of :meth:`load_overload`, whether or not anything was compiled."""
        self._waiting.close()

    @contextmanager
    def _locked(self, name: str) -> Iterator[None]:
        """Hold the lock file ``name`` of the cache folder; without a lock if that is impossible."""
        try:
            folder = Path(self._cache.cache_path)
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder / name, LOCK_FLAGS, 0o600)
        except OSError:
            # A full or read-only disk, for instance: compiling twice is better than failing.
            yield
            return
        try:
            _wait_for(descriptor)
            yield
        finally:
            # Closing alone is not enough: a process forked meanwhile has the file open too.
            _unlock(descriptor)
            os.close(descriptor)


if sys.platform == "win32":

    def _wait_for(opened: int) -> None:
        """Lock a file, or give up after MAX_WAIT seconds, or where the file system has no locks."""

    def _unlock(opened: int) -> None:
        """Nothing was locked."""

else:
    import fcntl

    def _wait_for(opened: int) -> None:
        """Lock a file, or give up after MAX_WAIT seconds, or where the file system has no locks."""
        end = time.monotonic() + MAX_WAIT
        while time.monotonic() < end:
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(POLL)
            except OSError:
                return
            else:
                return

    def _unlock(opened: int) -> None:
        """Unlock the file with the descriptor ``opened``."""
        with suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_UN)
