"""Compiled code on disk that several processes use: one compiles it, the others wait for it.

Without this, processes that start side by side would all compile the same kernels, and numba would
lose entries of its index, which it reads, changes and writes without a lock.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any


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
            # The lock ends with the file, and with the process.
            os.close(opened)


if sys.platform == "win32":

    def _wait_for(opened: int) -> None:
        """Windows has no lock that waits: each process compiles for itself."""

else:
    import fcntl

    def _wait_for(opened: int) -> None:
        """Wait until no other process has the file locked; some file systems have no locks."""
        try:
            fcntl.flock(opened, fcntl.LOCK_EX)
        except OSError:
            return
