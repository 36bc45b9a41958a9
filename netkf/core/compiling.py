"""Loops compiled on request by numba (extra ``fast``), and only then imported."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any] | None:
    """The compiled form of a function that is made of loops, or None where numba is missing.

    Kept on disk beside the module, so that the next process starts at once. It runs without the
    interpreter's lock.
    """
    try:
        import numba
    except ImportError:
        return None
    made: Callable[..., Any] = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return made
