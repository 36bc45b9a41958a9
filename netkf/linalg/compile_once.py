"""Compiled code on disk that several processes use: one compiles it, the others wait for it.

Without this, processes that start side by side would all compile the same kernels, and numba would
lose entries of its index, which it reads, changes and writes without a lock.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

MAX_WAIT, POLL = 60.0, 0.02
"""Seconds that a process waits for another one that compiles, several times what that takes; and
after which it looks again.
"""


class SharedCache:
    """The cache of a numba dispatcher, with locks between processes; the other attributes are
    those of numba's own cache.
    """

    def __init__(self, cache: Any, name: str) -> None:
        self._cache, self._name = cache, name
        self._waiting = ExitStack()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kept code for a signature. None: the caller compiles it, saves it, and calls
        :meth:`release`; other processes wait for that.
        """
        found = self._cache.load_overload(sig, target_context)
        if found is not None:
            return found
        # A lock for each signature: those who need another one need not wait.
        signature = hashlib.sha256(str(sig).encode()).hexdigest()[:16]
        self._waiting.enter_context(self._locked(f"{self._name}-{signature}.lock"))
        # Another process may have compiled it while this one was waiting.
        return self._cache.load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code."""
        # The index file holds all signatures of a function.
        with self._locked(f"{self._name}.lock"):
            self._cache.save_overload(sig, data)

    def release(self) -> None:
        """Let other processes go on, whether or not anything was compiled."""
        self._waiting.close()

    @contextmanager
    def _locked(self, name: str) -> Iterator[None]:
        try:
            folder = Path(self._cache.cache_path)
            folder.mkdir(parents=True, exist_ok=True)
            opened = os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:
            # A full disk, say: compiling twice is better than not at all.
            yield
            return
        try:
            _wait_for(opened)
            yield
        finally:
            # The lock would end with the file, were that not open in a process forked meanwhile.
            _unlock(opened)
            os.close(opened)


if sys.platform == "win32":

    def _wait_for(opened: int) -> None:
        """Windows has no lock that waits: each process compiles for itself."""

    def _unlock(opened: int) -> None:
        """Nothing was locked."""

else:
    import fcntl

    def _wait_for(opened: int) -> None:
        """Lock the file, once no other process has it locked; some file systems have no locks. A
        process that was stopped while it compiled is not waited for: MAX_WAIT seconds at most.
        """
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
        """Let other processes have the file."""
        with suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_UN)
