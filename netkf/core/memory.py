"""How freed memory is kept for the next arrays."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np

KEPT_BYTES = 31 << 20
"""Size of the arrays that are worth keeping: just below the largest that glibc takes note of."""


@cache
def keep_freed_memory() -> None:
    """Let this process keep the memory of large arrays that it frees, once and for all.

    The C library of Linux gives large blocks back to the system when they are freed, and the next
    batch of runs gets them again page by page: up to a tenth of the time of short runs. It keeps
    blocks of any size up to that of the largest one that was freed (mallopt(3), M_MMAP_THRESHOLD),
    and twice as much in all. Nothing is written to that block, so it takes no memory.
    """
    np.empty(KEPT_BYTES, dtype=np.uint8)


class LentMemory(threading.local):
    """Memory for one array of each thread, lent again when nobody uses that array any more.

    The system clears pages that it gives for the first time, which is a twelfth of the time of
    short runs. Unlike ``keep_freed_memory`` this works for arrays of any size.
    """

    def __init__(self, most: int) -> None:
        """``most``: bytes of the largest array that is worth keeping."""
        self._most, self._memory = most, np.empty(0)
        self._lent: Callable[[], np.ndarray | None] = lambda: None

    def array(self, size: int) -> np.ndarray:
        """Return an array of ``size`` floats with anything in it."""
        too_large = size * self._memory.itemsize > self._most
        if size == 0 or too_large or self._lent() is not None:
            return np.empty(size)
        if len(self._memory) < size:
            self._memory = np.empty(size)
        # Neither a slice nor of the array itself: parts of it would refer to that, and not to this.
        lent = np.frombuffer(memoryview(cast(Any, self._memory)), count=size)
        self._lent = weakref.ref(lent)
        return lent
