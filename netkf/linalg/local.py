"""Scratch arrays of kernels that live in registers where n is known when a kernel is compiled.

Loops over a :func:`netkf.linalg.structs.sized` n are unrolled, and then the compiler keeps each
entry of such an array in a register: nothing else can point to it. An array in memory may overlap
any other, so that each entry is stored and loaded again. For a larger n the array in memory is
used.
"""

from __future__ import annotations

from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import Lanes
from netkf.linalg.structs import Size


def local_matrix(size: Size, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised (n, n) for the kernel that calls: ``scratch`` where
    ``size`` is an array. Python raises TypeError.
    """
    raise TypeError("local_matrix is for kernels")


def local_vector(size: Size, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised (n,), as ``local_matrix``."""
    raise TypeError("local_vector is for kernels")


def local_lanes_matrix(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised (n, n, L), as ``local_matrix``."""
    raise TypeError("local_lanes_matrix is for kernels")


def local_lanes_vector(size: Size, lanes: Lanes, scratch: FloatArray) -> FloatArray:  # noqa: ARG001
    """Return, in kernels, an uninitialised (n, L), as ``local_matrix``."""
    raise TypeError("local_lanes_vector is for kernels")
