"""Scratch arrays that the compiler can keep in registers, for an n known at compile time.

Loops over a :func:`netkf.linalg.structs.sized` n are unrolled, so that each entry of an array on
the stack becomes a register: no other pointer can refer to it. An array in memory might overlap any
other, so that each entry is stored and loaded again. For larger n the given array is used.
"""

from __future__ import annotations

from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import Lanes
from netkf.linalg.structs import Size


def local_matrix(size: Size, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised array (n, n), valid until the calling kernel returns.

    It is on the stack if ``size`` is a tuple, and ``scratch`` (n, n) if ``size`` is an array.
    Called from Python it raises TypeError.
    """
    raise TypeError("local_matrix is for kernels")


def local_vector(size: Size, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised array (n,), valid until the calling kernel returns: on
    the stack if ``size`` is a tuple, else ``scratch`` (n,). Called from Python it raises TypeError.
    """
    raise TypeError("local_vector is for kernels")


def local_lanes_matrix(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised array (n, n, L) for L lanes, valid until the calling
    kernel returns: on the stack if ``size`` is a tuple, else ``scratch`` (n, n, L). Called from
    Python it raises TypeError. ``lanes`` is a tuple of length L.
    """
    raise TypeError("local_lanes_matrix is for kernels")


def local_lanes_vector(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised array (n, L) for L lanes, valid until the calling kernel
    returns: on the stack if ``size`` is a tuple, else ``scratch`` (n, L). Called from Python it
    raises TypeError. ``lanes`` is a tuple of length L.
    """
    raise TypeError("local_lanes_vector is for kernels")
