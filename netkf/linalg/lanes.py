"""Numbers of several runs side by side, which kernels handle as one value (SIMD).

Arrays hold the runs of a block along their last axis, L of them. ``load(lanes, array, i, j)`` takes
``array[i, j]`` (L,) as one value, with which kernels compute as with a number: ``+ - * /``,
comparisons, and the functions below. ``lanes`` is a tuple of L zeros, whose length is known when
the kernel is compiled; with one lane the value is a plain float, so that the same kernel serves a
single run. Operations are those of floats, lane by lane: a run has the same bits, whichever runs
are beside it. The functions below say what they mean, in Python, where a value is a :class:`Row`;
``lane_types`` is what numba makes of them.

A comparison gives flags: one truth value for each lane. An array without a last axis of lanes gives
L neighbours from ``array[place]`` on; with one lane that is the entry itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray, array_address

LANES = 8
"""Runs side by side: as many float64 as the widest registers of common processors hold."""

ALIGNMENT = 64
"""Bytes: a value that crosses no line of the cache is loaded twice as fast."""

Lanes = tuple[int, ...]
MANY: Lanes = (0,) * LANES
ONE: Lanes = (0,)


def aligned(shape: tuple[int, ...], dtype: Any = np.float64) -> Any:
    """Return C-contiguous zeros of this ``shape`` in memory that begins at a line of the cache."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    # numpy aligns to 16 bytes only: take more, and begin at the next line of the cache.
    memory = np.zeros(size + ALIGNMENT, dtype=np.uint8)
    start = -array_address(memory) % ALIGNMENT
    return memory[start : start + size].view(dtype).reshape(shape)


def unset(shape: tuple[int, ...]) -> Any:
    """Return a float64 array of this ``shape`` in memory that begins at a line of the cache, with
    anything in it: for large arrays that are filled at once.
    """
    memory = np.empty(math.prod(shape) + ALIGNMENT // 8)
    start = -array_address(memory) % ALIGNMENT // 8
    return memory[start : start + math.prod(shape)].reshape(shape)


def with_spare(shape: tuple[int, ...], make: Callable[[tuple[int, ...]], Any] = aligned) -> Any:
    """Return an array of this ``shape`` that ``make`` (``aligned`` or ``unset``) makes, with memory
    for a block of L by L numbers behind it, so that reading whole blocks never leaves it.
    """
    entries = math.prod(shape)
    return make((entries + LANES * LANES,))[:entries].reshape(shape)


def blocks_of(runs: int) -> int:
    """Return the number of blocks of lanes for the ``runs``; the last may have idle lanes."""
    return -(-runs // LANES)


def in_lanes(values: FloatArray, blocks: int) -> FloatArray:
    """Return an array (blocks, ..., L) with the same ``values`` (...) in each lane."""
    made: FloatArray = aligned((blocks, *values.shape, LANES))
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


class Row(np.ndarray):
    """A value of several lanes in plain Python. It never changes, as little as a number."""

    __iadd__, __isub__ = np.ndarray.__add__, np.ndarray.__sub__  # type: ignore[assignment]
    __imul__, __itruediv__ = np.ndarray.__mul__, np.ndarray.__truediv__  # type: ignore[assignment]


def _neighbours(lanes: Lanes, array: np.ndarray, place: tuple[int, ...]) -> Any:
    """Return a view (L,) of the L neighbours from ``array[place]`` on, further indices being 0."""
    if len(place) == array.ndim - 1 and array.shape[-1] == len(lanes):
        return array[place]
    place += (0,) * (array.ndim - len(place))
    first = int(np.ravel_multi_index(place, array.shape))
    return array.reshape(-1)[first : first + len(lanes)]


def load(lanes: Lanes, array: FloatArray, *place: int) -> Any:
    """Return ``array[place]`` (L,) as one value of L lanes; ``place`` are the indices of all axes
    but the last.
    """
    if len(lanes) == 1:
        return array[place + (0,) * (array.ndim - len(place))]
    return _neighbours(lanes, array, place).view(Row).copy()


def turn(lanes: Lanes, rows: FloatArray, column: int, out: FloatArray) -> None:
    """Transpose a block: write ``rows[q, column + k]`` into ``out[column + k, q]``, for all lanes q
    and k < L; ``rows`` is (L, W), ``out`` (W, L). There are L lanes and W columns.
    """
    block = slice(column, column + len(lanes))
    out[block] = rows[:, block].T


def gather(
    lanes: Lanes, array: FloatArray, places: np.ndarray, first: int, out: FloatArray
) -> None:
    """Transpose rows of different places into lanes: write the L entries from ``first`` on of
    ``array[places[q]]`` into lane q of the L rows of ``out`` from ``first`` on.

    ``array`` (K, W), with K places, and ``out`` (W, L) are taken as matrices, whatever their axes,
    and have memory behind them (``with_spare``). If a place (L,) is negative, lane q gets any row.
    """
    taken = array.reshape(len(array), -1)[np.maximum(places, 0), first : first + len(lanes)]
    out.reshape(-1, len(lanes))[first : first + taken.shape[1]] = taken.T


def scatter(
    lanes: Lanes, rows: FloatArray, first: int, array: FloatArray, places: np.ndarray, count: int
) -> None:
    """Transpose lanes back into rows of different places: write lane q of the ``count``, at most L,
    rows of ``rows`` (W, L) from ``first`` on into ``array[places[q]]`` of ``array`` (K, W), with K
    places, where the place (L,) is not negative. The array may be a part ``whole[:, k]``.
    """
    known, last = places >= 0, first + min(count, len(lanes))
    taken = rows.reshape(-1, len(lanes))[first:last, known]
    array.reshape(len(array), -1)[places[known], first:last] = taken.T


def store(lanes: Lanes, array: FloatArray, *place_and_value: Any) -> None:
    """Write a value of L lanes, the last argument, into ``array[place]`` (L,); a float into all
    lanes.
    """
    *place, value = place_and_value
    _neighbours(lanes, array, tuple(place))[:] = value


def prefetch(array: np.ndarray, *place: int) -> None:
    """Ask the processor for the line of memory where ``array[place]`` begins, before it is needed;
    ``place`` are indices of the first axes. Nothing happens if there is none.
    """


def spread(lanes: Lanes, number: float) -> Any:
    """Return one value with a number in all L lanes."""
    return np.float64(number) if len(lanes) == 1 else np.full(len(lanes), number, float).view(Row)


def load_flags(lanes: Lanes, array: np.ndarray, *place: int) -> Any:
    """Return flags of L lanes, set where ``array[place]`` (L,) of uint8 is not 0."""
    return load(lanes, array, *place) != 0


def store_flags(lanes: Lanes, array: np.ndarray, *place_and_flags: Any) -> None:
    """Write flags of L lanes, the last argument, into ``array[place]`` (L,) of uint8 as 1 and 0."""
    store(lanes, array, *place_and_flags)


def select(flags: Any, chosen: Any, other: Any) -> Any:
    """Return the value that is ``chosen`` in the lanes that are flagged, ``other`` in the rest."""
    if any(isinstance(part, Row) for part in (flags, chosen, other)):
        return np.where(flags, chosen, other).astype(float).view(Row)
    return np.float64(chosen if flags else other)


def any_lane(flags: Any) -> bool:
    """Return True if at least one lane is flagged."""
    return bool(np.any(flags))


def root_of(value: Any) -> Any:
    """Return the square root of a value, lane by lane."""
    return np.sqrt(value)


def magnitude(value: Any) -> Any:
    """Return the absolute value, lane by lane."""
    return np.fabs(value)


def with_sign(size: Any, sign: Any) -> Any:
    """Return ``size`` with the sign of ``sign``, lane by lane."""
    return np.copysign(size, sign)
