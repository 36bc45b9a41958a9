"""Scratch arrays that the compiler can keep in registers, for an n known at compile time.

Loops over a :func:`netkf.linalg.structs.sized` n are unrolled, so that each entry of an array on
the stack becomes a register: no other pointer can refer to it. An array in memory might overlap any
other, so that each entry is stored and loaded again. For larger n the given array is used.
"""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import Lanes
from netkf.linalg.structs import Size


def local_matrix(size: Size, scratch: FloatArray) -> FloatArray:
    """Return an uninitialised array (n, n), valid until the calling kernel returns.

    It is on the stack if ``size`` is a tuple, and ``scratch`` (n, n) if ``size`` is an array.
    """
    return _local(size, scratch, len(size), len(size))


def local_vector(size: Size, scratch: FloatArray) -> FloatArray:
    """Return an uninitialised array (n,), valid until the calling kernel returns: on the stack if
    ``size`` is a tuple, else ``scratch`` (n,).
    """
    return _local(size, scratch, len(size))


def local_lanes_matrix(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:
    """Return an uninitialised array (n, n, L) for L lanes, valid until the calling kernel returns:
    on the stack if ``size`` is a tuple, else ``scratch`` (n, n, L). ``lanes`` has length L.
    """
    return _local(size, scratch, len(size), len(size), len(lanes))


def local_lanes_vector(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:
    """Return an uninitialised array (n, L) for L lanes, valid until the calling kernel returns: on
    the stack if ``size`` is a tuple, else ``scratch`` (n, L). ``lanes`` is a tuple of length L.
    """
    return _local(size, scratch, len(size), len(lanes))


def local_lanes_pair(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:
    """Return an uninitialised array (n, n + 1, L) for L lanes, as ``local_lanes_matrix``."""
    return _local(size, scratch, len(size), len(size) + 1, len(lanes))


def _local(size: Size, scratch: FloatArray, *shape: int) -> FloatArray:
    """Return a new array of this ``shape`` if the size is a tuple, else ``scratch``."""
    return np.full(shape, np.nan) if isinstance(size, tuple) else scratch
