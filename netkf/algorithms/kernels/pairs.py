"""Readings of pairs: what a node reads of its own states and of a block that it does not estimate.

A message brings the reading that its sender had (``run.heard``), and with it these. What a receiver
makes of one is a linear reading ``z = J_own x_own + J_other x_other + v`` at the estimates of both.
A filter that keeps readings (``Kernels.keeps_pairs``) keeps the ``sensor`` and ``number`` of each,
and linearises it again later.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from netkf.algorithms.kernels.nonlinear_rows import (
    LINEAR,
    NonlinearRows,
    differentiate_rows,
    no_nonlinear,
    read_rows,
    subtract_rows,
)
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.linalg.structs import Struct

IN_PYTHON = 5
"""The kind of a pair whose function returns z and J (p, 1 + n) together, beside those of rows."""


class Pairs(Struct):
    """K readings of pairs, of at most p rows, of n numbers: the node's own states, ``own`` at most,
    and then those of the other block.

    first : (R + 1,), those of reading number r are ``first[r]`` to ``first[r + 1]`` - 1
    row, length : (K,), the first row of each in ``run.y`` of its reading, and how many it has; of
                  those that are linear ``run.H`` (p, n) has n columns, and rows are white
    block : (S or 1, K), number of the other block in each slot of a plan, -1: nothing is read
    rows, places : NonlinearRows of K filters, and from where they read, (K, p, n, 1)
    sensor, number : (K,), what takes each in ``known``, and what tells it from others that do
    known, sources : NonlinearRows of all that take such readings, and from where, (S, p, n, 1)
    slot : number of the slot in the plan
    origin : scratch (n,), from where the states of a pair are counted
    """

    first: IntArray
    row: IntArray
    length: IntArray
    block: IntArray
    rows: NonlinearRows
    places: FloatArray
    sensor: IntArray
    number: IntArray
    known: NonlinearRows
    sources: FloatArray
    origin: FloatArray
    own: int
    slot: int


def empty_pairs(
    rows: NonlinearRows,
    own: int,
    first: IntArray,
    known: NonlinearRows | None = None,
    sources: FloatArray | None = None,
) -> Pairs:
    """Return pairs of nobody yet, for readings with these ``first`` ones; by default each is taken
    by a sensor of its own, which ``rows`` describe.
    """
    K, p = rows.kind.shape
    places = np.zeros((K, p, len(rows.x), 1))
    return Pairs(
        first=first,
        row=np.zeros(K, dtype=np.int64),
        length=np.zeros(K, dtype=np.int64),
        block=np.full((1, K), -1),
        rows=rows,
        places=places,
        sensor=np.arange(K),
        number=np.zeros(K, dtype=np.int64),
        known=rows if known is None else known,
        sources=places if sources is None else sources,
        origin=np.zeros(len(rows.x)),
        own=own,
        slot=0,
    )


@cache
def no_pairs() -> Pairs:
    """Return no pairs, for filters that know no blocks."""
    return empty_pairs(no_nonlinear(), 0, np.zeros(1, dtype=int))


@kernel
def block_of_pair(pairs: Pairs, k: int) -> int:
    """Return the number of the other block of pair ``k``, -1 if nothing is read."""
    return int(pairs.block[min(pairs.slot, len(pairs.block) - 1), k])


@kernel
def write_origin(pairs: Pairs, k: int) -> None:
    """Write from where the states of pair ``k`` are counted now into ``pairs.origin`` (n,)."""
    rows, slot = pairs.rows, min(pairs.slot, len(pairs.rows.origin) - 1)
    of = min(k, len(rows.entries) - 1)
    for j in range(len(pairs.origin)):
        entry = rows.entries[of, j]
        pairs.origin[j] = rows.origin[slot, entry] if entry >= 0 else 0.0


@kernel
def linearise_pair(pairs: Pairs, run: Any, r: int, k: int, q: int) -> None:
    """Write z, J and the covariance of the noise of pair ``k`` of reading number ``r`` in lane
    ``q`` into ``rows.value`` (p,), ``rows.J`` (p, n), ``rows.C`` (p, p), at ``rows.x`` (n,).
    """
    rows, first, matrix = pairs.rows, run.first_y + r, run.first_H + run.matrix[r]
    count, noise = pairs.length[k], min(pairs.slot, len(rows.R) - 1)
    for i in range(count):
        row = pairs.row[k] + i
        rows.y[i] = rows.value[i] = run.y[first, row, q]
        for j in range(count):
            rows.C[i, j] = rows.R[noise, k, i, j]
        for j in range(len(rows.x) if rows.kind[k, 0] == LINEAR else 0):
            rows.J[i, j] = run.H[matrix, row, j, q]
    if rows.kind[k, 0] != LINEAR:
        write_origin(pairs, k)
        linearise_at(pairs, rows, pairs.places, k, k, count)
    leave_out_missing(rows, count)


@kernel
def linearise_at(
    pairs: Pairs, rows: NonlinearRows, sources: FloatArray, k: int, number: int, count: int
) -> None:
    """Write z and J of the reading ``rows.y`` (p,) with a ``number``, of number ``k`` in ``rows``,
    at the estimates ``rows.x`` (n,), which are counted from ``pairs.origin`` (n,).
    """
    n = len(rows.x)
    if rows.kind[k, 0] == IN_PYTHON:
        call_function(rows.functions[k, 0, 0], rows.x, rows.y, float(number), 0.0, rows.matrix)
        for i in range(count):
            rows.value[i] = rows.matrix[i, 0]
            for j in range(n):
                rows.J[i, j] = rows.matrix[i, 1 + j]
        return
    for j in range(n):
        rows.x[j] += pairs.origin[j]
    read_rows(rows, k, sources, k, 0, rows.mean)
    differentiate_rows(rows, k, sources, k, 0)
    subtract_rows(rows, k, rows.y, rows.mean, rows.value)
    for j in range(n):
        rows.x[j] -= pairs.origin[j]
        for i in range(count):
            rows.value[i] += rows.J[i, j] * rows.x[j]


@kernel
def leave_out_missing(rows: NonlinearRows, count: int) -> None:
    """Let values that are missing say nothing."""
    for i in range(count):
        if math.isnan(rows.value[i]):
            rows.value[i] = 0.0
            rows.J[i, :] = 0.0
            rows.C[i, :] = rows.C[:, i] = 0.0
            rows.C[i, i] = 1.0
