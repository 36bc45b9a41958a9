"""Functions of vectors that kernels call by their address, such as a user's dynamics.

A kernel becomes part of the kernels that call it, which are compiled for it. A function with an
address (``vector_functions``) is called instead, so that one compiled loop serves all of them,
kernels and plain Python alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

from netkf.linalg.arrays import FloatArray

plain_functions: dict[int, Callable[..., None]] = {}
"""Functions by address where kernels are plain Python; addresses are mere numbers then."""
_numbers = itertools.count(1)


def plain_address(function: Callable[..., None]) -> int:
    """Return an address of a function where kernels are plain Python."""
    number = next(_numbers)
    plain_functions[number] = function
    return number


def call_function(
    address: int, x: FloatArray, u: FloatArray, t: float, period: float, out: FloatArray
) -> None:
    """Write a function's value at ``x``, ``u``, ``t`` and ``period`` into ``out``, C-contiguous."""
    plain_functions[int(address)](x, u, t, period, out)
