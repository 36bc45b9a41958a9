"""Keeping freed memory for the next arrays, instead of giving it back to the system."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np

KEPT_BYTES = 31 << 20
"""Size up to which freed arrays are kept: just below 32 MiB, the largest that glibc adapts to."""


@cache
def keep_freed_memory() -> None:
    """Make this process keep the memory of large arrays that it frees, from now on.

    The C library of Linux (glibc) gives large blocks back to the system when they are freed, and
    the next batch of runs gets them again page by page: up to a tenth of the time of short runs.
    But it keeps blocks up to the size of the largest one freed so far (mallopt(3),
    M_MMAP_THRESHOLD), and twice as much in all.
    """
    # This array is freed at once. Nothing is written to it, so it takes no physical memory.
    np.empty(KEPT_BYTES, dtype=np.uint8)


class ReusableMemory(threading.local):
    """Memory for one array per thread, which is used again once that array has been freed.

    The system clears pages that it gives for the first time, which is a twelfth of the time of
    short runs. Unlike ``keep_freed_memory`` this works for arrays of any size.
    """

    def __init__(self, max_bytes: int) -> None:
        """``max_bytes`` is the size of the largest array whose memory is kept."""
        self._max_bytes, self._memory = max_bytes, np.empty(0)
        self._get_array: Callable[[], np.ndarray | None] = lambda: None  # None once it is freed

    def array(self, size: int) -> np.ndarray:
        """Return an uninitialised array (size,) of float64.

        It is in the kept memory, unless that is in use or the array is too large.
        """
        too_large = size * self._memory.itemsize > self._max_bytes
        if size == 0 or too_large or self._get_array() is not None:
            return np.empty(size)
        if len(self._memory) < size:
            self._memory = np.empty(size)
        # The weak reference must live as long as any view of the result. numpy makes the base of a
        # view the array that owns the memory: for a slice of self._memory that would be
        # self._memory; for an array on a foreign buffer it is the result itself.
        array = np.frombuffer(memoryview(cast(Any, self._memory)), count=size)
        self._get_array = weakref.ref(array)
        return array
