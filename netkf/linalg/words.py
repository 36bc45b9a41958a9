"""The 128-bit product of 64-bit words, which Python and NumPy lack, for kernels."""

from __future__ import annotations

from typing import Any


def high_word(a: Any, b: Any) -> Any:  # noqa: ARG001
    """Return, in kernels, the upper 64 bits of the product of two unsigned 64-bit words. Python
    raises TypeError.
    """
    raise TypeError("high_word is for kernels")
