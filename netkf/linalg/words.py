"""The 128-bit product of 64-bit words, which NumPy lacks, for kernels."""

from __future__ import annotations

from typing import Any

import numpy as np


def high_word(a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two unsigned 64-bit words."""
    return np.uint64(int(a) * int(b) >> 64)
