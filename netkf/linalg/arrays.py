"""Array types and small helpers for symmetric matrices."""

from __future__ import annotations

import ctypes
import numbers
import sys
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
P = ParamSpec("P")
T = TypeVar("T")

__all__ = [
    "ArrayLike",
    "FloatArray",
    "IntArray",
    "array_address",
    "block_diagonal",
    "cached_by_entries",
    "enlarged",
    "in_own_units",
    "in_units",
    "readonly_array",
    "real_numbers",
    "is_definite",
    "is_semidefinite",
    "as_kernel_array",
    "row_units",
    "spectral_root",
    "square_root",
    "symmetric",
]


def array_address(array: Any) -> int:
    """Return the address of the first byte of a C-contiguous numpy ``array``."""
    try:
        # A quarter of the time of ``array.ctypes.data``, of which a run needs some hundred.
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    except (TypeError, ValueError):  # read-only, or empty
        return int(array.ctypes.data)


class _Entries(NamedTuple):
    shape: tuple[int, ...]
    entries: bytes


def cached_by_entries(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator that keeps the last ``maxsize`` results of a function of arrays and of
    values with a hash: arrays with the same entries, which it must not write to, share one.
    """

    def decorate(function: Any) -> Any:
        @lru_cache(maxsize)
        def compute(*keys: Any) -> Any:
            return function(
                *(
                    np.frombuffer(key.entries).reshape(key.shape) if type(key) is _Entries else key
                    for key in keys
                )
            )

        def as_key(value: Any) -> Any:
            if not isinstance(value, np.ndarray):
                return value
            return _Entries(value.shape, np.asarray(value, dtype=np.float64).tobytes())

        return lambda *values: compute(*map(as_key, values))

    return decorate


def readonly_array(value: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of an array or nested lists of any shape; raises TypeError or
    ValueError for what is none of real numbers.
    """
    # A copy: the caller may go on writing into its own array.
    array = np.array(real_numbers(value))
    array.flags.writeable = False
    return array


def real_numbers(value: ArrayLike) -> FloatArray:
    """Return ``value`` as a float64 array; raises as ``readonly_array``."""
    array = np.asarray(value)
    # numpy would drop imaginary parts and masks, count dates in days, and read texts.
    is_real = array.dtype.kind in "biuf"
    if array.dtype.kind == "O":
        is_real = all(isinstance(number, numbers.Number) for number in array.flat)
    # There is no masked array before numpy.ma is imported, which takes 10 ms.
    if not is_real or ("numpy.ma" in sys.modules and np.ma.is_masked(value)):
        raise TypeError(f"no real numbers: {array.dtype}")
    return np.asarray(array, dtype=np.float64)


def symmetric(matrices: FloatArray) -> FloatArray:
    """Return the symmetric parts (..., n, n) of ``matrices``, one or a stack."""
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, -1, -2)))


def row_units(variances: FloatArray) -> FloatArray:
    """Return units (..., n) in which ``variances`` (..., n) are 1. Those that are rounding of zero
    beside the largest have no units, and get its; all 1 if all are 0.
    """
    largest = np.maximum(np.asarray(variances).max(axis=-1, keepdims=True), 0.0)
    units = np.sqrt(np.where(variances > 1e-13 * largest, variances, largest))
    return np.asarray(np.where(largest > 0.0, units, 1.0))


def in_units(matrices: FloatArray, units: FloatArray) -> FloatArray:
    """Return covariances ``matrices`` (..., n, n) in ``units`` (..., n) of their rows."""
    return np.asarray(matrices / units[..., :, None] / units[..., None, :])


def in_own_units(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return covariances P (..., n, n) in the units (..., n) of their own rows, and these."""
    units = row_units(np.diagonal(P, axis1=-2, axis2=-1))
    return in_units(P, units), units


def is_semidefinite(matrix: FloatArray) -> bool:
    """Return True if no eigenvalue of a symmetric ``matrix`` (n, n) is below -1e-10 times its
    largest, and none below -1e-5 in units of the rows in which the diagonal is 1.
    """
    sizes = np.diagonal(matrix)
    largest = max(float(np.abs(matrix).max()), np.finfo(float).tiny)  # tiny: of the zero matrix
    # Rows that are rounding of zero beside it have no units; others may be written in six digits.
    rounding = 1e-13 * largest
    units = np.sqrt(np.where(sizes > rounding, sizes, largest))
    least = np.linalg.eigvalsh(matrix / units[:, None] / units)[0]
    if sizes.min() < -rounding or not least >= -1e-5:
        return False
    if least >= -1e-10:
        return True  # in units of the largest row too
    values = np.linalg.eigvalsh(matrix)
    return bool(values[0] >= -1e-10 * abs(values[-1]))


def is_definite(matrices: FloatArray) -> NDArray[np.bool_]:
    """Return a mask (...) of those finite symmetric ``matrices`` (..., n, n) that are positive
    definite beyond rounding, whatever the units of their rows.
    """
    n = matrices.shape[-1]
    sizes = np.diagonal(matrices, axis1=-2, axis2=-1)
    positive = np.asarray((sizes > 0.0).all(axis=-1))
    roots = np.sqrt(np.where(positive[..., None], sizes, 1.0))
    # With a diagonal of 1 the largest eigenvalue is at most n.
    scaled = np.where(positive[..., None, None], matrices, np.eye(n))
    least = np.linalg.eigvalsh(scaled / roots[..., :, None] / roots[..., None, :])[..., 0]
    return np.asarray(positive & (least > 8.0 * n * np.finfo(float).eps))


def square_root(matrix: FloatArray) -> FloatArray:
    """Return a factor ``S`` (n, n) with ``S S' = matrix``, positive semidefinite (n, n), whatever
    the units of its rows; it may be singular.
    """
    sizes = np.diagonal(matrix)
    units = np.ldexp(1.0, np.frexp(np.where(sizes > 0.0, sizes, 1.0))[1] // 2)
    scaled = matrix / units[:, None] / units
    # Rows that are rounding of zero have no units: together they may be far from semidefinite.
    if np.linalg.eigvalsh(scaled)[0] < -1e-12:
        return spectral_root(matrix)
    return np.asarray(units[:, None] * spectral_root(scaled))


def spectral_root(matrix: FloatArray) -> FloatArray:
    """Return :func:`square_root` with columns along the eigenvectors, by increasing eigenvalues:
    the rounding of all rows is that of the largest.
    """
    # Eigenvalues instead of Cholesky, which fails for singular matrices.
    values, vectors = np.linalg.eigh(matrix)
    # Negative eigenvalues are rounding of zero.
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def block_diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """Return a matrix (r, c) with ``blocks`` (r_k, c_k), possibly rectangular or empty, along its
    diagonal, r and c being the sums of their rows and columns.
    """
    rows = sum(b.shape[0] for b in blocks)
    columns = sum(b.shape[1] for b in blocks)
    # Empty slices assign blocks without rows or columns correctly.
    matrix = np.zeros((rows, columns))
    row = column = 0
    for block in blocks:
        matrix[row : row + block.shape[0], column : column + block.shape[1]] = block
        row += block.shape[0]
        column += block.shape[1]
    return matrix


def enlarged(array: FloatArray, *shape: int) -> FloatArray:
    """Return an array of this ``shape`` that begins with ``array`` and has zeros beyond it."""
    whole = np.zeros(shape)
    whole[tuple(slice(length) for length in array.shape)] = array
    return whole


def as_kernel_array(matrix: FloatArray) -> FloatArray:
    """Return the matrix (r, c) as a writable C-contiguous array, as kernels need; maybe a copy."""
    if matrix.flags.c_contiguous and matrix.flags.writeable:
        return matrix
    return np.array(matrix, order="C")


@cache
def upper_indices(n: int) -> tuple[IntArray, IntArray]:
    """Return the rows and columns (n (n + 1) / 2,) of an upper triangle, row by row."""
    return np.triu_indices(n)


def from_upper(values: FloatArray, n: int) -> FloatArray:
    """Return symmetric matrices (..., n, n) from upper triangles ``values`` (..., u) by row."""
    i, j = upper_indices(n)
    matrices = np.empty((*values.shape[:-1], n, n))
    matrices[..., i, j] = matrices[..., j, i] = values
    return matrices
