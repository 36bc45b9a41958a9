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
from netkf.linalg.local import local_vector
from netkf.linalg.portable import apply, norm, product
from netkf.linalg.structs import MAX_UNROLLED, Size, sized
from netkf.plants.transitions import Transitions, noise_factors
from netkf.rng.draws import Ziggurat
from netkf.rng.numbers import first_normals, normal_ziggurat
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
PIECE_LEVELS = 256
"""What is added to second ids, also to that of knots, -1, in the next piece of a plant."""
_ZERO, _ONE, _FULL = np.uint64(0), np.uint64(1), np.uint64(BLOCK_WORDS)


class Cells(NamedTuple):
    """The laws of C kinds of cells, smallest first, of n states.

    length, before, unit : (C,), ticks of a cell and of its first part, and the unit of its decade
    parts : (C, 2), kinds of its parts; -1: a tick, which is not divided
    level : (C,), second id of the streams of points that divide it
    knot_level : second id of the streams of knots
    Phi : (C, n, n), transposed, of the first part
    middle : (C, 2 n, n), transposed, the effect of [z; w] on the state at the end of the first part
    inner : (C, 2, 2 n, n), transposed, the effect of [z; w] on the normals of each part
    of_v, of_x : (C, 2 n, 2), (C, n, 2), first state and end of those that an entry of [z; w], or of
        the state, has an effect on: of many blocks most have none on each other
    knot_Phi, knot_L : (n, n), transposed, of the largest cell, between two knots
    """

    length: IntArray
    before: IntArray
    unit: FloatArray
    parts: IntArray
    level: IntArray
    knot_level: int
    Phi: FloatArray
    middle: FloatArray
    inner: FloatArray
    of_v: IntArray
    of_x: IntArray
    knot_Phi: FloatArray
    knot_L: FloatArray


class Walk(NamedTuple):
    """The cells around the present instant, from one between knots inwards, at most S.

    kind, part : (S,), kind of each cell, and which part of the one before it it is (0, 1)
    start, point, end : (S,), ticks at its ends and where it is divided
    x : (S, n), the state at its start
    v : (S, 2 n), [z; w]: the normals that move it to its end, and those of the point that divides
        it
    """

    kind: IntArray
    part: IntArray
    start: IntArray
    point: IntArray
    end: IntArray
    x: FloatArray
    v: FloatArray


class Tree:
    """The cells of a plant up to a ``horizon`` in seconds. Frames are ``frame`` seconds long, 1, 2
    or 5 times a power of ten; None without frames. Trees of another ``piece`` of a plant have other
    normals.
    """

    def __init__(
        self, moves: Transitions, horizon: float, frame: float | None, piece: int = 0
    ) -> None:
        self.frame = frame
        digits = math.floor(math.log10(MAX_TICKS / horizon))
        top = max(KNOTS, math.ceil(math.log10(horizon)) - 6)
        # Numbers of ticks in a cell between knots are 64-bit integers.
        top = min(top, MAX_DECADES - digits)
        if frame is not None:
            top = min(top, math.floor(math.log10(frame) + 1e-9))
        self._per_second = float(f"1e{digits}")
        self._cells = _cells(moves, digits, max(top + digits, 1), piece * PIECE_LEVELS)
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
        kind, part, begin, point, end = (np.zeros(depth, dtype=np.int64) for _ in range(5))
        x, v = np.zeros((depth, n)), np.zeros((depth, 2 * n))
        walk = Walk(kind, part, begin, point, end, x, v)
        states, offsets = np.empty((len(times), n)), np.zeros((frames, n))
        walk.x[0] = start
        ticks = np.rint(times * self._per_second).astype(np.int64)
        drawn = stream.copy(), self._every, normal_ziggurat()
        fill_states(sized(n), self._cells, ticks, *drawn, walk, states, offsets)
        return states, offsets


@kernel
def draw_normals_of_point(
    size: Size,
    stream: np.ndarray,
    first: int,
    second: int,
    ziggurat: Ziggurat,
    out: FloatArray,
    begin: int,
) -> None:
    """Write the first n standard normals of the stream (``first``, ``second``) into ``out`` from
    ``begin`` on; the second id is -1 if there is none. ``stream`` (1, WIDTH) has the key and the
    purpose, and ``size`` the length n.
    """
    stream[0, 0], stream[0, USED] = _ZERO, _FULL
    stream[0, 1], stream[0, 2] = np.uint64(first) + _ONE, np.uint64(second + 1)
    first_normals(size, stream, 0, ziggurat, out, begin)


@kernel
def fill_states(
    size: Size,
    cells: Cells,
    ticks: IntArray,
    stream: np.ndarray,
    every: int,
    ziggurat: Ziggurat,
    walk: Walk,
    states: FloatArray,
    offsets: FloatArray,
) -> None:
    """Write the states at increasing ``ticks`` (K,) into ``states`` (K, n), and those just before
    each frame, of ``every`` cells (0: none), into ``offsets`` (F, n). ``walk.x[0]`` is x(0).
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
        # Each in a loop of its own: cells and their normals depend on the tick only, so that a
        # processor works on several at once.
        outer, depth = depth, enter_cells(cells, walk, depth, tick)
        for d in range(outer, depth):
            kind = walk.kind[d]
            first = int(walk.point[d] / cells.unit[kind])  # exact: both are below 2^53
            draw_normals_of_point(size, stream, first, cells.level[kind], ziggurat, walk.v[d], n)
        for d in range(outer, depth):
            divide_cell(size, cells, walk, d)
        for i in range(n):
            states[k, i] = walk.x[depth, i]


@kernel
def enter_knot(
    size: Size, cells: Cells, stream: np.ndarray, knot: int, ziggurat: Ziggurat, walk: Walk
) -> None:
    """Make the cell after number ``knot`` of the knots the first of the ``walk``."""
    kind = len(cells.length) - 1
    walk.kind[0], walk.start[0] = kind, knot * cells.length[kind]
    walk.end[0] = walk.start[0] + cells.length[kind]
    draw_normals_of_point(size, stream, knot, cells.knot_level, ziggurat, walk.v[0], 0)


@kernel
def move_to_knot(size: Size, cells: Cells, walk: Walk) -> None:
    """Move the state ``walk.x[0]`` of the first cell to its end."""
    n, x = len(size), walk.x
    # The second row is free until the cell is divided.
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += cells.knot_Phi[j, i] * x[0, j]
        for j in range(n):
            total += cells.knot_L[j, i] * walk.v[0, j]
        x[1, i] = total
    for i in range(n):
        x[0, i] = x[1, i]


@kernel
def enter_cells(cells: Cells, walk: Walk, depth: int, tick: int) -> int:
    """Put the parts of cell number ``depth`` of the ``walk`` after it in which ``tick`` lies, down
    to one that begins there; return the number of that.
    """
    while walk.start[depth] != tick:
        kind, start, end = walk.kind[depth], walk.start[depth], walk.end[depth]
        point = walk.point[depth] = start + cells.before[kind]
        part = 1 if tick >= point else 0
        depth += 1
        walk.kind[depth], walk.part[depth] = cells.parts[kind, part], part
        walk.start[depth] = point if part == 1 else start
        walk.end[depth] = end if part == 1 else point
    return depth


@kernel
def divide_cell(size: Size, cells: Cells, walk: Walk, depth: int) -> None:
    """Write state and normals of the next part of cell number ``depth`` of the ``walk``."""
    n, kind, inner, part = len(size), walk.kind[depth], depth + 1, walk.part[depth + 1]
    x, z = local_vector(size, walk.x[inner]), local_vector(size, walk.v[inner])
    for i in range(n):
        x[i] = z[i] = 0.0
    for j in range(2 * n):
        v = walk.v[depth, j]
        for i in range(*_span(size, cells.of_v, kind, j)):
            z[i] += cells.inner[kind, part, j, i] * v
    if part == 1:
        for j in range(n):
            v = walk.x[depth, j]
            for i in range(*_span(size, cells.of_x, kind, j)):
                x[i] += cells.Phi[kind, j, i] * v
        for j in range(2 * n):
            v = walk.v[depth, j]
            for i in range(*_span(size, cells.of_v, kind, j)):
                x[i] += cells.middle[kind, j, i] * v
    for i in range(n):
        walk.x[inner, i] = x[i] if part == 1 else walk.x[depth, i]
        walk.v[inner, i] = z[i]


@kernel(inlined=True)
def _span(size: Size, spans: IntArray, kind: int, j: int) -> tuple[int, int]:
    """Return ``spans[kind, j]``; of few states all, as loops over them are unrolled."""
    if len(size) <= MAX_UNROLLED:
        return 0, len(size)
    return spans[kind, j, 0], spans[kind, j, 1]


def _cells(moves: Transitions, digits: int, decades: int, first_level: int) -> Cells:
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
    Phi = _transposed(Phi_1)
    middle = np.ascontiguousarray(product(turn[:, :, :n], _transposed(L_1)))
    inner = np.ascontiguousarray(np.stack([turn[:, :, :n], turn[:, :, n:]], axis=1))
    return Cells(
        length=np.array(SHARES)[share] * unit,
        before=before,
        unit=unit.astype(np.float64),
        parts=np.stack([np.maximum(4 * exponent + part, -1) for part in (left, right)], axis=1),
        level=exponent - digits + LEVELS + first_level,
        knot_level=first_level - 1,
        Phi=Phi,
        middle=middle,
        inner=inner,
        of_v=_spans((inner != 0.0).any(axis=1) | (middle != 0.0)),
        of_x=_spans(Phi != 0.0),
        knot_Phi=_transposed(knot_Phi)[0],
        knot_L=_transposed(knot_L)[0],
    )


def _spans(used: np.ndarray) -> IntArray:
    """Return the first place and the end (C, r, 2) of the rows of flags ``used`` (C, r, n)."""
    n, some = used.shape[-1], used.any(axis=2)
    ends = np.where(some, n - used[:, :, ::-1].argmax(axis=2), 0)
    return np.stack([np.where(some, used.argmax(axis=2), 0), ends], axis=2)


def _transposed(matrices: FloatArray) -> FloatArray:
    """Return the transposes (C, c, r) of matrices (C, r, c)."""
    return np.ascontiguousarray(np.swapaxes(matrices, 1, 2))


def _completed(D: FloatArray) -> FloatArray:
    """Return orthogonal matrices (C, 2 n, 2 n) whose first rows are ``D`` (C, n, 2 n)."""
    count, n, columns = D.shape
    rows = np.concatenate([D, np.zeros((count, columns - n, columns))], axis=1)
    taken = (rows * rows).sum(axis=1)
    for k in range(columns):
        missing = np.flatnonzero(~rows[:, k].any(axis=1))
        others = rows if len(missing) == count else rows[missing]
        # The unit vector that is farthest from the rows so far, the first of those as far.
        row = np.eye(columns)[np.argmax(np.round(1.0 - taken[missing], 6), axis=1)]
        for _ in range(2):
            row = row - apply(np.swapaxes(others, 1, 2), apply(others, row))
        row /= norm(row)[:, None]
        rows[missing, k] = row
        taken[missing] += row * row
    return rows
