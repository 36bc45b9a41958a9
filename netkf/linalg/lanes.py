"""Numbers of several runs side by side, which kernels handle as one value (SIMD).

Arrays hold the runs of a block along their last axis, L of them. ``load(lanes, array, i, j)`` takes
``array[i, j]`` (L,) as one value, with which kernels compute as with a number: ``+ - * /``,
comparisons, and the functions below. ``lanes`` is a tuple of L zeros, whose length is known when
the kernel is compiled; with one lane the value is a plain float, so that the same kernel serves a
single run. Operations are those of floats, lane by lane: a run has the same bits, whichever runs
are beside it.

A comparison gives flags: one truth value for each lane. An array without a last axis of lanes gives
L neighbours from ``array[place]`` on; with one lane that is the entry itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray, address_of

LANES = 8
"""Runs side by side: as many float64 as the widest registers of common processors hold."""

ALIGNMENT = 64
"""Bytes: a value that crosses no line of the cache is loaded twice as fast."""

Lanes = tuple[int, ...]
MANY: Lanes = (0,) * LANES
ONE: Lanes = (0,)


def aligned(shape: tuple[int, ...], dtype: Any = np.float64) -> Any:
    """Return an array of zeros of this ``shape`` in memory that begins at a line of the cache,
    C-contiguous.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    # numpy aligns to 16 bytes only: take more, and begin at the next line of the cache.
    memory = np.zeros(size + ALIGNMENT, dtype=np.uint8)
    start = -address_of(memory) % ALIGNMENT
    return memory[start : start + size].view(dtype).reshape(shape)


def unset(shape: tuple[int, ...]) -> Any:
    """Return a float64 array of this ``shape`` in memory that begins at a line of the cache, with
    anything in it: for large arrays that are filled at once.
    """
    memory = np.empty(math.prod(shape) + ALIGNMENT // 8)
    start = -address_of(memory) % ALIGNMENT // 8
    return memory[start : start + math.prod(shape)].reshape(shape)


def with_spare(shape: tuple[int, ...], make: Callable[[tuple[int, ...]], Any] = aligned) -> Any:
    """Return an array of this ``shape`` that ``make`` (``aligned`` or ``unset``) makes, with memory
    for a block of L by L numbers behind it, so that reading whole blocks never leaves it.
    """
    entries = math.prod(shape)
    return make((entries + LANES * LANES,))[:entries].reshape(shape)


def blocks_of(runs: int, lanes: int = LANES) -> int:
    """Return the number of blocks of so many ``lanes`` that hold the ``runs``; the last may have
    idle lanes.
    """
    return -(-runs // lanes)


def in_lanes(values: FloatArray, blocks: int, lanes: int = LANES) -> FloatArray:
    """Return an array (blocks, ..., lanes) with the same ``values`` (...) in each lane."""
    made: FloatArray = aligned((blocks, *values.shape, lanes))
    made[:] = values[..., None]
    return made


def by_run(values: Any, runs: int) -> Any:
    """Return ``values`` (B, ..., L) of B blocks of L lanes as an array (runs, ...), one run after
    the other; the idle lanes of the last block are left out.
    """
    blocks, *shape, lanes = values.shape
    # Lanes right behind blocks: then runs are in their order.
    every = np.moveaxis(values, -1, 1).reshape(blocks * lanes, *shape)
    return np.ascontiguousarray(every[:runs])


def load(lanes: Lanes, array: FloatArray, *place: int) -> Any:
    """Return, in kernels, ``array[place]`` (L,) as one value of L lanes; ``place`` are the
    indices of all axes but the last.
    """
    raise _only_in_kernels()


def turn(lanes: Lanes, rows: FloatArray, column: int, out: FloatArray) -> None:
    """Transpose a block in kernels: write ``rows[q, column + k]`` into ``out[column + k, q]``, for
    all lanes q and k < L; ``rows`` is (L, W), ``out`` (W, L). There are L lanes and W columns.
    """
    raise _only_in_kernels()


def gather(
    lanes: Lanes, array: FloatArray, places: np.ndarray, first: int, out: FloatArray
) -> None:
    """Transpose rows of different places into lanes, in kernels: write the L entries from ``first``
    on of ``array[places[q]]`` into lane q of the L rows of ``out`` from ``first`` on.

    ``array`` (K, W), with K places, and ``out`` (W, L) are taken as matrices, whatever their axes,
    and have memory behind their last entries (``with_spare``). Where a place (L,) is negative, lane
    q gets some other row.
    """
    raise _only_in_kernels()


def scatter(
    lanes: Lanes, rows: FloatArray, first: int, array: FloatArray, places: np.ndarray, count: int
) -> None:
    """Transpose lanes back into rows of different places, in kernels: write lane q of the
    ``count``, at most L, rows of ``rows`` (W, L) from ``first`` on into ``array[places[q]]`` of
    ``array`` (K, W), with K places, where the place (L,) is not negative. The array may be a part
    ``whole[:, k]`` of another.
    """
    raise _only_in_kernels()


def store(lanes: Lanes, array: FloatArray, *place_and_value: Any) -> None:
    """Write, in kernels, a value of L lanes, the last argument, into ``array[place]`` (L,); a float
    into all lanes.
    """
    raise _only_in_kernels()


def prefetch(array: np.ndarray, *place: int) -> None:
    """Ask the processor, in kernels, for the line of memory where ``array[place]`` begins, before
    it is needed; ``place`` are indices of the first axes. Nothing happens if there is none.
    """
    raise _only_in_kernels()


def spread(lanes: Lanes, number: float) -> Any:
    """Return, in kernels, one value with a number in all L lanes."""
    raise _only_in_kernels()


def load_flags(lanes: Lanes, array: np.ndarray, *place: int) -> Any:
    """Return, in kernels, flags of L lanes, set where ``array[place]`` (L,) of uint8 is not 0."""
    raise _only_in_kernels()


def store_flags(lanes: Lanes, array: np.ndarray, *place_and_flags: Any) -> None:
    """Write, in kernels, flags of L lanes, the last argument, into ``array[place]`` (L,) of uint8
    as 1 and 0.
    """
    raise _only_in_kernels()


def select(flags: Any, chosen: Any, other: Any) -> Any:
    """Return, in kernels, the value that is ``chosen`` in the lanes that are flagged, ``other`` in
    the rest.
    """
    raise _only_in_kernels()


def any_lane(flags: Any) -> bool:
    """Return True, in kernels, if at least one lane is flagged."""
    raise _only_in_kernels()


def root_of(value: Any) -> Any:
    """Return, in kernels, the square root of a value, lane by lane."""
    raise _only_in_kernels()


def magnitude(value: Any) -> Any:
    """Return, in kernels, the absolute value, lane by lane."""
    raise _only_in_kernels()


def with_sign(size: Any, sign: Any) -> Any:
    """Return, in kernels, ``size`` with the sign of ``sign``, lane by lane."""
    raise _only_in_kernels()


def _only_in_kernels() -> TypeError:
    """Return the error that Python gets from the functions that numba replaces in kernels."""
    return TypeError("values of lanes exist in kernels only")
