"""The path of a diffusion at any instants, whatever other instants are asked for.

Time is divided into *cells*, ever smaller: knots of a fixed spacing, halves of a cell, then fifths
of that in steps (10 = 5 + 5, 5 = 2 + 3, 3 = 1 + 2, 2 = 1 + 1), and so on by powers of ten down to
ticks. A cell has the state x at its start and the standard normals z that move it to its end,
``Phi x + L z``. Its parts have normals z1 and z2, with ``L z = Phi2 L1 z1 + L2 z2``, that is
``z = D [z1; z2]`` with orthonormal rows. Given z, ``[z1; z2] = O' [z; w]`` where O is D completed
to an orthogonal matrix, and w are fresh normals of a stream that belongs to the instant at which
the cell is divided. This is the law of the path exactly (P. Lévy's construction of Brownian motion
for a linear SDE), and the state at an instant is reached from its knot by the cells around it: it
depends on the streams and on that instant only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.portable import apply, norm, product
from netkf.linalg.structs import Size, sized
from netkf.plants.transitions import Transitions, noise_factors
from netkf.rng.numbers import NormalZiggurat, next_normal, normal_ziggurat
from netkf.rng.streams import BLOCK_WORDS, USED

MAX_TICKS = 1e15  # ticks of the finest cells up to the horizon
MAX_DECADES = 18  # from the finest cells to knots
KNOTS = 3  # knots are 10^KNOTS s apart, unless the plant is unstable or the horizon very long
SHARES = (2, 3, 5, 10)
LEFT, RIGHT = (1, 1, 2, 5), (1, 2, 3, 5)
"""Units of the four kinds of cells of a decade, and of their two parts."""
LEVELS = 64
"""The second id of the stream of a point that divides a cell is this plus the power of ten of its
unit in seconds; the first is the number of units from time 0.
"""
_ZERO, _ONE, _FULL = np.uint64(0), np.uint64(1), np.uint64(BLOCK_WORDS)


class Cells(NamedTuple):
    """The laws of C kinds of cells, smallest first, of n states.

    length, before, unit : (C,), ticks of a cell and of its first part, and the unit of its decade
    left, right : (C,), kinds of its parts; -1: a tick, which is not divided
    level : (C,), second id of the streams of points that divide it
    Phi : (C, n, n), transposed, of the first part
    middle, first, second : (C, 2 n, n), transposed: the effect of [z; w] on the state at the end of
                            the first part, on its normals, and on those of the second
    knot_Phi, knot_L : (n, n), transposed, of the largest cell, between two knots
    """

    length: IntArray
    before: IntArray
    unit: FloatArray
    left: IntArray
    right: IntArray
    level: IntArray
    Phi: FloatArray
    middle: FloatArray
    first: FloatArray
    second: FloatArray
    knot_Phi: FloatArray
    knot_L: FloatArray


class Walk(NamedTuple):
    """The cells around the present instant, from one between knots inwards, at most S.

    kind, start, end : (S,), kind of each cell and the ticks at its ends
    x, z : (S, n), the state at its start and the normals that move it to its end
    v : (2 n,) scratch
    """

    kind: IntArray
    start: IntArray
    end: IntArray
    x: FloatArray
    z: FloatArray
    v: FloatArray


class Tree:
    """The cells of a plant up to a ``horizon`` in seconds. Frames are ``frame`` seconds long, 1, 2
    or 5 times a power of ten; None without frames.
    """

    def __init__(self, moves: Transitions, horizon: float, frame: float | None) -> None:
        self.frame = frame
        digits = math.floor(math.log10(MAX_TICKS / horizon))
        top = max(KNOTS, math.ceil(math.log10(horizon)) - 6)
        # Numbers of ticks in a cell between knots are 64-bit integers.
        top = min(top, MAX_DECADES - digits)
        if frame is not None:
            top = min(top, math.floor(math.log10(frame) + 1e-9))
        self._per_second = float(f"1e{digits}")
        self._cells = _cells(moves, digits, max(top + digits, 1))
        # Cells between knots in a frame.
        self._every = 0 if frame is None else round(frame / float(f"1e{top}"))

    def states(
        self, times: FloatArray, start: FloatArray, stream: np.ndarray, frames: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states (K, n) at increasing ``times`` (K,) in seconds, from ``start`` (n,) at
        time 0 on, and those (F, n) just before each of the first F = ``frames`` frame times, at
        which the state is taken to 0. ``stream`` (1, WIDTH) is the state of the plant's stream.
        """
        n, depth = len(start), len(self._cells.length) + 1
        kind, begin, end = (np.zeros(depth, dtype=np.int64) for _ in range(3))
        x, z = np.zeros((depth, n)), np.zeros((depth, n))
        walk = Walk(kind, begin, end, x, z, np.zeros(2 * n))
        states, offsets = np.empty((len(times), n)), np.zeros((frames, n))
        walk.x[0] = start
        ticks = np.rint(times * self._per_second).astype(np.int64)
        fill_states(
            sized(n),
            self._cells,
            ticks,
            stream.copy(),
            self._every,
            normal_ziggurat(),
            walk,
            states,
            offsets,
        )
        return states, offsets


@kernel
def draw_normals_of_point(
    size: Size,
    stream: np.ndarray,
    first: int,
    second: int,
    ziggurat: NormalZiggurat,
    out: FloatArray,
    begin: int,
) -> None:
    """Write the first n standard normals of the stream (``first``, ``second``) into ``out`` from
    ``begin`` on; the second id is -1 if there is none. ``stream`` (1, WIDTH) has the key and the
    purpose, and ``size`` the length n.
    """
    stream[0, 0], stream[0, USED] = _ZERO, _FULL
    stream[0, 1], stream[0, 2] = np.uint64(first) + _ONE, np.uint64(second + 1)
    for i in range(len(size)):
        out[begin + i] = next_normal(stream, 0, ziggurat)


@kernel
def fill_states(
    size: Size,
    cells: Cells,
    ticks: IntArray,
    stream: np.ndarray,
    every: int,
    ziggurat: NormalZiggurat,
    walk: Walk,
    states: FloatArray,
    offsets: FloatArray,
) -> None:
    """Write the states at increasing ``ticks`` (K,) into ``states`` (K, n), and those just before
    each frame, of ``every`` cells between knots (0: none), into ``offsets`` (F, n). ``walk.x[0]``
    is the state at time 0.
    """
    knot, depth, frame, n = 0, 0, 0, len(size)
    enter_knot(size, cells, stream, knot, ziggurat, walk)
    for k in range(len(ticks)):
        tick = ticks[k]
        while tick >= walk.end[0]:
            knot, depth = knot + 1, 0
            move_to_knot(size, cells, walk)
            enter_knot(size, cells, stream, knot, ziggurat, walk)
            if every > 0 and knot % every == 0 and frame < len(offsets):
                for i in range(n):
                    offsets[frame, i], walk.x[0, i] = walk.x[0, i], 0.0
                frame += 1
        while tick >= walk.end[depth]:
            depth -= 1
        while walk.start[depth] != tick:
            divide_cell(size, cells, stream, ziggurat, walk, depth, tick)
            depth += 1
        for i in range(n):
            states[k, i] = walk.x[depth, i]


@kernel
def enter_knot(
    size: Size, cells: Cells, stream: np.ndarray, knot: int, ziggurat: NormalZiggurat, walk: Walk
) -> None:
    """Make the cell after number ``knot`` of the knots the first of the ``walk``."""
    kind = len(cells.length) - 1
    walk.kind[0], walk.start[0] = kind, knot * cells.length[kind]
    walk.end[0] = walk.start[0] + cells.length[kind]
    draw_normals_of_point(size, stream, knot, -1, ziggurat, walk.z[0], 0)


@kernel
def move_to_knot(size: Size, cells: Cells, walk: Walk) -> None:
    """Move the state ``walk.x[0]`` of the first cell to its end."""
    n = len(size)
    for i in range(n):
        walk.v[i], walk.v[n + i] = walk.x[0, i], walk.z[0, i]
        walk.x[0, i] = 0.0
    for j in range(n):
        for i in range(n):
            walk.x[0, i] += cells.knot_Phi[j, i] * walk.v[j]
    for j in range(n):
        for i in range(n):
            walk.x[0, i] += cells.knot_L[j, i] * walk.v[n + j]


@kernel
def divide_cell(
    size: Size,
    cells: Cells,
    stream: np.ndarray,
    ziggurat: NormalZiggurat,
    walk: Walk,
    depth: int,
    tick: int,
) -> None:
    """Divide cell number ``depth`` of the ``walk`` and put that of its two parts after it in which
    ``tick`` lies.
    """
    n, kind, v, inner = len(size), walk.kind[depth], walk.v, depth + 1
    point = walk.start[depth] + cells.before[kind]
    # v = [z; w]
    first = int(point / cells.unit[kind])  # exact: both are below 2^53
    draw_normals_of_point(size, stream, first, cells.level[kind], ziggurat, v, n)
    for i in range(n):
        v[i] = walk.z[depth, i]
    if tick < point:
        walk.kind[inner], walk.start[inner], walk.end[inner] = (
            cells.left[kind],
            walk.start[depth],
            point,
        )
        for i in range(n):
            walk.x[inner, i], total = walk.x[depth, i], 0.0
            for j in range(2 * n):
                total += cells.first[kind, j, i] * v[j]
            walk.z[inner, i] = total
        return
    walk.kind[inner], walk.start[inner], walk.end[inner] = (
        cells.right[kind],
        point,
        walk.end[depth],
    )
    for i in range(n):
        x = z = 0.0
        for j in range(n):
            x += cells.Phi[kind, j, i] * walk.x[depth, j]
        for j in range(2 * n):
            x += cells.middle[kind, j, i] * v[j]
            z += cells.second[kind, j, i] * v[j]
        walk.x[inner, i], walk.z[inner, i] = x, z


def _cells(moves: Transitions, digits: int, decades: int) -> Cells:
    """Return the cells of ``decades`` powers of ten of a tick of 10^-``digits`` s."""
    share, exponent = np.tile(np.arange(4), decades), np.repeat(np.arange(decades), 4)
    unit = np.array([10**e for e in exponent.tolist()], dtype=np.int64)
    before, after = (np.array(parts)[share] * unit for parts in (LEFT, RIGHT))
    tick = float(f"1e{digits}")
    (Phi_1, L_1), (Phi_2, L_2) = (moves.laws(part / tick) for part in (before, after))
    _, D = noise_factors(np.concatenate([product(Phi_2, L_1), L_2], axis=2))
    turn, n = _completed(D), moves.n
    knot_Phi, knot_L = moves.laws(np.array([10.0**decades / tick]))
    kinds = {1: -1, 2: 0, 3: 1, 5: 2}  # of the parts of the four kinds, after those of a decade
    left, right = (np.array([kinds[m] for m in parts])[share] for parts in (LEFT, RIGHT))
    return Cells(
        length=np.array(SHARES)[share] * unit,
        before=before,
        unit=unit.astype(np.float64),
        left=np.maximum(4 * exponent + left, -1),
        right=np.maximum(4 * exponent + right, -1),
        level=exponent - digits + LEVELS,
        Phi=_transposed(Phi_1),
        middle=np.ascontiguousarray(product(turn[:, :, :n], _transposed(L_1))),
        first=np.ascontiguousarray(turn[:, :, :n]),
        second=np.ascontiguousarray(turn[:, :, n:]),
        knot_Phi=_transposed(knot_Phi)[0],
        knot_L=_transposed(knot_L)[0],
    )


def _transposed(matrices: FloatArray) -> FloatArray:
    """Return the transposes (C, c, r) of matrices (C, r, c)."""
    return np.ascontiguousarray(np.swapaxes(matrices, 1, 2))


def _completed(D: FloatArray) -> FloatArray:
    """Return orthogonal matrices (C, 2 n, 2 n) whose first rows are ``D`` (C, n, 2 n)."""
    count, n, columns = D.shape
    rows = np.concatenate([D, np.zeros((count, columns - n, columns))], axis=1)
    for k in range(columns):
        missing = np.flatnonzero(~rows[:, k].any(axis=1))
        others = rows[missing]
        # The unit vector that is farthest from the rows so far, the first of those as far.
        left = np.round(1.0 - (others * others).sum(axis=1), 6)
        row = np.eye(columns)[np.argmax(left, axis=1)]
        for _ in range(2):
            row = row - apply(_transposed(others), apply(others, row))
        rows[missing, k] = row / norm(row)[:, None]
    return rows
