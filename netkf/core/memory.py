"""How freed memory is kept for the next arrays."""

from __future__ import annotations

from functools import cache

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
