"""Kernels of Gaussian belief propagation over the paths of blocks.

The *path* of a node is its states at the K instants of its window and now, K + 1 blocks of n
numbers, ``record.path`` with the lower triangular root ``record.path_root`` of what the node knows
by itself. What the sender of a link told is *evidence*: readings with unit noise of the window, of
which column r of ``record.evidence`` is a row and ``record.evidence_z[r]`` the value. Readings of
pairs are kept with what linearises them, which is done at both beliefs whenever a message comes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.algorithms.kernels.block_fusion import semidefinite_root
from netkf.algorithms.kernels.estimates import transform_root, update_by_row
from netkf.algorithms.kernels.nonlinear_rows import LINEAR
from netkf.algorithms.kernels.pairs import Pairs, block_of_pair, linearise_at, write_origin
from netkf.algorithms.kernels.run import (
    ALL,
    predict_estimate,
    shift_vector,
    transition,
    use_reading,
)
from netkf.algorithms.kernels.square_root import reflect
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, load, store
from netkf.linalg.structs import Struct

ROUNDING = 1e-9
"""Relative deviation of traces that rounding explains."""
NEGLIGIBLE = 1e-28
"""Share of the squared length of a row that is rounding."""
IS_LINEAR = -1
"""The ``sensor`` of a reading whose matrices are kept."""


class PathScratch(Struct):
    """Scratch for a path of d numbers and readings of m rows, of a node with n states whose senders
    have at most v.

    x, S, row, gains : (1, d, 1), (1, d, d, 1) and (d, 1) twice, a belief and its updates
    y, H : (1, 1, 1) and (1, 1, d, 1), one row of a reading
    size : (d,), for lengths
    known : (d,), the mean of the belief of all evidence
    square : (d, d)
    evidence, former : (d + 1, max(d, m)) and (d + 1, d), new evidence with its values in the row
        behind those of the window, and the one that it replaces
    G, G_other, z, wide : (m, d), (m, d'), (m,) and (m, d' + m), readings of two paths
    value, J, J_other, C : (p,), (p, v) twice and (p, p), one of them
    F, root_Q, small, first, second : (n, n) twice and (1, n, n, 1), (n, n, 1) twice
    """

    x: FloatArray
    S: FloatArray
    row: FloatArray
    gains: FloatArray
    y: FloatArray
    H: FloatArray
    size: FloatArray
    known: FloatArray
    square: FloatArray
    evidence: FloatArray
    former: FloatArray
    G: FloatArray
    G_other: FloatArray
    z: FloatArray
    wide: FloatArray
    value: FloatArray
    J: FloatArray
    J_other: FloatArray
    C: FloatArray
    F: FloatArray
    root_Q: FloatArray
    small: FloatArray
    first: FloatArray
    second: FloatArray


def path_scratch(window: int, n: int, v: int, readings: int, p: int) -> PathScratch:
    """Return scratch for ``window`` instants of a node with n states whose senders have at most v,
    and so many ``readings`` of at most p rows.
    """
    d, e, m = (window + 1) * n, window * v, readings * p
    shapes: dict[str, tuple[int, ...]] = {
        **{"x": (1, d, 1), "S": (1, d, d, 1), "row": (d, 1), "gains": (d, 1)},
        **{"y": (1, 1, 1), "H": (1, 1, d, 1), "size": (d,), "known": (d,), "square": (d, d)},
        **{"evidence": (d + 1, max(d, m)), "former": (d + 1, d), "G": (m, d), "z": (m,)},
        **{"G_other": (m, e), "wide": (m, e + m), "value": (p,), "C": (p, p)},
        **dict.fromkeys(("J", "J_other"), (p, v)),
        **dict.fromkeys(("F", "root_Q"), (n, n)),
        **{"small": (1, n, n, 1), "first": (n, n, 1), "second": (n, n, 1)},
    }
    return PathScratch(**{name: np.zeros(shape) for name, shape in shapes.items()})


@kernel
def time_of(run: Any) -> float:
    """Return the time of this instant, in slots the number of the slot."""
    return float(run.slot) if run.slot >= 0 else float(run.now)


@kernel
def use_row(f: PathScratch, d: int) -> None:
    """Update the belief of the first ``d`` numbers of a path by the row in ``y`` and ``H``."""
    update_by_row(ONE, f.size[:d], f.x, f.S, 0, f.y, f.H, (0, 0, 0), True, (f.row, f.gains))


@kernel
def believe(record: Any, h: int, n: int, links: tuple[int, int], but: int, q: int) -> float:
    """Write what node ``h`` (n states) believes of its path into the scratch, from the evidence of
    its ``links``, the first one and the one after the last, but not that of link ``but``; return
    the trace of the covariance of the present state.
    """
    f, K = record.work, record.count[h, q]
    d, total = (K + 1) * n, 0.0
    load_path(record, h, d, q)
    for w in range(links[0], links[1]):
        for r in range(record.rows[w, q] if w != but else 0):
            f.y[0, 0, 0] = record.evidence_z[w, r, q]
            for j in range(d):
                f.H[0, 0, j, 0] = record.evidence[w, j, r, q] if j < K * n else 0.0
            use_row(f, d)
    for i in range(K * n, d):
        for j in range(i + 1):
            total += f.S[0, i, j, 0] * f.S[0, i, j, 0]
    return total


@kernel
def load_path(record: Any, h: int, d: int, q: int) -> None:
    """Write what node ``h`` knows by itself of its path (d,) into the scratch."""
    f = record.work
    for i in range(d):
        f.x[0, i, 0] = record.path[h, i, q]
        for j in range(i + 1):
            f.S[0, i, j, 0] = record.path_root[h, i, j, q]


@kernel
def keep_mean(f: PathScratch) -> None:
    """Keep the mean of the belief of all evidence."""
    for i in range(len(f.known)):
        f.known[i] = f.x[0, i, 0]


@kernel
def write_present(record: Any, h: int, n: int, q: int) -> None:
    """Make the present state of the belief the estimate of node ``h``."""
    f, first = record.work, record.count[h, q] * n
    for i in range(n):
        record.xhat[h, i, q] = f.x[0, first + i, 0]
        for j in range(first + n):
            f.square[i, j] = f.S[0, first + i, j, 0] if j <= first + i else 0.0
    for i in range(n):
        reflect(f.square, i, i, n, first + n)
        for j in range(i + 1):
            record.root[h, i, j, q] = f.square[i, j]


@kernel
def leave_out_oldest(f: PathScratch, n: int, count: int) -> None:
    """Write the root ``S`` without its ``n`` oldest of ``n + count`` states into ``square``."""
    for i in range(count):
        for j in range(n + count):
            f.square[i, j] = f.S[0, n + i, j, 0] if j <= n + i else 0.0
    for i in range(count):
        reflect(f.square, i, i, count, min(i + n + 1, n + count))


@kernel
def eliminate(E: FloatArray, count: int, rows: int, columns: int) -> int:
    """Turn the ``columns`` of E so that its first ``count`` of ``rows`` rows are lower trapezoidal;
    return how many columns they need.
    """
    c = 0
    for i in range(count):
        square = whole = 0.0
        for j in range(columns):
            whole += E[i, j] * E[i, j]
            if j >= c:
                square += E[i, j] * E[i, j]
        if square > NEGLIGIBLE * whole:
            reflect(E, i, c, rows, columns)
            c += 1
        for j in range(c, columns):
            E[i, j] = 0.0
    return c


@kernel
def mark(record: Any, h: int, n: int, links: tuple[int, int], now: float, q: int) -> None:
    """Add the present to the window of node ``h``; a full window loses its oldest instant."""
    K = record.count[h, q]
    if K > 0 and record.times[h, K - 1, q] == now:
        return
    is_full = record.times.shape[1] == K
    if is_full:
        forget_oldest(record, h, n, links, q)
        K -= 1
    # The present stands there twice.
    first = K * n
    for i in range(n):
        record.path[h, first + n + i, q] = record.path[h, first + i, q]
        for j in range(first + n + i + 1):
            value = record.path_root[h, first + i, j, q] if j <= first + i else 0.0
            record.path_root[h, first + n + i, j, q] = value
    record.times[h, K, q] = now
    record.count[h, q] = K + 1
    kept = 0
    for e in range(record.total[h, q]):
        if record.since[h, e, q] >= record.times[h, 0, q]:
            copy_stored(record, h, kept, record, h, e, q)
            kept += 1
    record.total[h, q] = kept
    if is_full:
        # What was told of the oldest says less now.
        believe(record, h, n, links, -1, q)
        write_present(record, h, n, q)


@kernel
def forget_oldest(record: Any, h: int, n: int, links: tuple[int, int], q: int) -> None:
    """Leave the oldest instant out of the window of node ``h``, and of what senders told of it."""
    f, K = record.work, record.count[h, q]
    load_path(record, h, (K + 1) * n, q)
    leave_out_oldest(f, n, K * n)
    for i in range(K * n):
        record.path[h, i, q] = record.path[h, n + i, q]
        for j in range(i + 1):
            record.path_root[h, i, j, q] = f.square[i, j]
    for k in range(K - 1):
        record.times[h, k, q] = record.times[h, k + 1, q]
    record.count[h, q] = K - 1
    for w in range(links[0], links[1]):
        rows = load_evidence(record, w, f.evidence, q)
        # What the evidence says whatever the oldest state is.
        spent = eliminate(f.evidence, n, len(f.former), rows)
        for r in range(spent, rows):
            for j in range(len(f.former) - n):
                f.evidence[j, r - spent] = f.evidence[n + j, r]
            f.evidence[len(f.former) - 1, r - spent] = f.evidence[len(f.former) - 1, r]
        store_evidence(record, w, f.evidence, rows - spent, (K - 1) * n, q)


@kernel
def load_evidence(record: Any, w: int, out: FloatArray, q: int) -> int:
    """Write the evidence of link ``w`` into ``out``, values last; return the number of readings."""
    last = len(record.work.former) - 1
    for r in range(record.rows[w, q]):
        for j in range(record.evidence.shape[1]):
            out[j, r] = record.evidence[w, j, r, q]
        for j in range(record.evidence.shape[1], last):
            out[j, r] = 0.0
        out[last, r] = record.evidence_z[w, r, q]
    return int(record.rows[w, q])


@kernel
def store_evidence(record: Any, w: int, E: FloatArray, rows: int, known: int, q: int) -> None:
    """Make ``rows`` readings of the first ``known`` numbers of the path, the columns of E with
    their values in the last of d + 1 rows, the evidence of link ``w``.
    """
    last = len(record.work.former) - 1
    for r in range(rows):
        for j in range(record.evidence.shape[1]):
            record.evidence[w, j, r, q] = E[j, r] if j < known else 0.0
        record.evidence_z[w, r, q] = E[last, r]
    record.rows[w, q] = rows


@kernel
def copy_stored(to: Any, i: int, e: int, source: Any, j: int, s: int, q: int) -> None:
    """Copy reading number ``s`` of entry ``j`` of ``source`` to number ``e`` of entry ``i``."""
    to.since[i, e, q], to.length[i, e, q] = source.since[j, s, q], source.length[j, s, q]
    to.block[i, e, q], to.sensor[i, e, q] = source.block[j, s, q], source.sensor[j, s, q]
    to.number[i, e, q] = source.number[j, s, q]
    for a in range(to.y.shape[2]):
        to.y[i, e, a, q] = source.y[j, s, a, q]
        for b in range(to.R.shape[3]):
            to.R[i, e, a, b, q] = source.R[j, s, a, b, q]
        for b in range(to.J.shape[3]):
            to.J[i, e, a, b, q] = source.J[j, s, a, b, q]
            to.J_other[i, e, a, b, q] = source.J_other[j, s, a, b, q]
    for b in range(to.J.shape[3]):
        for side in range(2):
            to.origin[i, e, side, b, q] = source.origin[j, s, side, b, q]


@kernel
def keep_pairs(record: Any, h: int, run: Any, q: int) -> bool:
    """Keep the readings of pairs of ``run.reading``; False if there are none that say anything."""
    pairs, r, found = run.pairs, run.reading, False
    for c in range(pairs.first[r], pairs.first[r + 1]):
        b = block_of_pair(pairs, c)
        if b >= 0 and record.total[h, q] < record.y.shape[1] and says_anything(run, c, q):
            keep_pair(record, h, run, c, q)
            e = record.total[h, q]
            record.since[h, e, q], record.block[h, e, q] = time_of(run), b
            record.total[h, q] = e + 1
            found = True
    return found


@kernel
def says_anything(run: Any, c: int, q: int) -> bool:
    """Return False if pair ``c`` of ``run.reading`` has no value."""
    pairs, place = run.pairs, run.first_y + run.reading
    matrix, found = run.first_H + run.matrix[run.reading], False
    for a in range(pairs.row[c], pairs.row[c] + pairs.length[c]):
        if pairs.rows.kind[c, 0] != LINEAR:
            found = found or not math.isnan(run.y[place, a, q])
        else:
            for j in range(len(pairs.origin)):
                found = found or run.H[matrix, a, j, q] != 0.0
    return found


@kernel
def keep_pair(record: Any, h: int, run: Any, c: int, q: int) -> None:
    """Write pair ``c`` of ``run.reading`` behind the readings that node ``h`` keeps."""
    pairs, e, v = run.pairs, record.total[h, q], record.J.shape[3]
    rows, own, is_linear = pairs.rows, pairs.own, pairs.rows.kind[c, 0] == LINEAR
    place, matrix = run.first_y + run.reading, run.first_H + run.matrix[run.reading]
    noise = min(pairs.slot, len(rows.R) - 1)
    record.length[h, e, q], record.number[h, e, q] = pairs.length[c], pairs.number[c]
    record.sensor[h, e, q] = IS_LINEAR if is_linear else pairs.sensor[c]
    write_origin(pairs, c)
    for side in range(2):
        for j in range(v):
            column = j + side * own
            known = column < (len(pairs.origin) if side == 1 else own)
            record.origin[h, e, side, j, q] = pairs.origin[column] if known else 0.0
    for a in range(pairs.length[c]):
        row = pairs.row[c] + a
        record.y[h, e, a, q] = run.y[place, row, q]
        for b in range(pairs.length[c]):
            record.R[h, e, a, b, q] = rows.R[noise, c, a, b]
        for j in range(v if is_linear else 0):
            record.J[h, e, a, j, q] = run.H[matrix, row, j, q] if j < own else 0.0
            column = own + j
            other = run.H[matrix, row, column, q] if column < len(pairs.origin) else 0.0
            record.J_other[h, e, a, j, q] = other


@kernel
def linearise_stored(f: PathScratch, pairs: Pairs, source: Any, i: int, e: int, q: int) -> int:
    """Write reading number ``e`` that entry ``i`` of ``source`` keeps, whitened, into ``value``,
    ``J`` and ``J_other``, at the estimates of its node and of the other block that stand in
    ``J[0]`` and ``J_other[0]``; return how many rows it has.
    """
    count, v, known = source.length[i, e, q], f.J.shape[1], pairs.known
    for a in range(count):
        f.value[a] = source.y[i, e, a, q]
        for b in range(count):
            f.C[a, b] = source.R[i, e, a, b, q]
    if source.sensor[i, e, q] == IS_LINEAR:
        for a in range(count):
            for j in range(v):
                f.J[a, j] = source.J[i, e, a, j, q]
                f.J_other[a, j] = source.J_other[i, e, a, j, q]
    else:
        own, width = pairs.own, len(pairs.origin)
        for j in range(width):
            k, side = (j, 0) if j < own else (j - own, 1)
            known.x[j] = pairs.origin[j] = 0.0
            if k < v:
                known.x[j] = f.J[0, k] if side == 0 else f.J_other[0, k]
                pairs.origin[j] = source.origin[i, e, side, k, q]
        for a in range(count):
            known.y[a] = f.value[a]
        sensor, number = source.sensor[i, e, q], source.number[i, e, q]
        linearise_at(pairs, known, pairs.sources, sensor, number, count)
        for a in range(count):
            f.value[a] = known.value[a]
            for j in range(v):
                f.J[a, j] = known.J[a, j] if j < own else 0.0
                f.J_other[a, j] = known.J[a, own + j] if own + j < width else 0.0
    whiten_stored(f, count)
    return int(count)


@kernel
def whiten_stored(f: PathScratch, count: int) -> None:
    """Divide a reading by the Cholesky factor of ``C``; values that are missing say nothing."""
    C, v = f.C, f.J.shape[1]
    for a in range(count):
        if math.isnan(f.value[a]):
            f.value[a] = 0.0
            f.J[a, :] = f.J_other[a, :] = 0.0
            for b in range(count):
                C[a, b] = C[b, a] = 1.0 if a == b else 0.0
    semidefinite_root(C, count)
    for a in range(count):
        for b in range(a):
            f.value[a] -= C[a, b] * f.value[b]
            for j in range(v):
                f.J[a, j] -= C[a, b] * f.J[b, j]
                f.J_other[a, j] -= C[a, b] * f.J_other[b, j]
        f.value[a] /= C[a, a]
        for j in range(v):
            f.J[a, j] /= C[a, a]
            f.J_other[a, j] /= C[a, a]


@kernel
def index_of_time(times: FloatArray, i: int, count: int, time: float, q: int) -> int:
    """Return the place of a ``time`` among the first ``count`` ones of entry ``i``, or -1."""
    for k in range(count):
        if times[i, k, q] == time:
            return k
    return -1


@kernel
def gather_pairs(
    record: Any, h: int, n: int, pairs: Pairs, of: tuple[int, int], mine: bool, M: int, q: int
) -> int:
    """Write the readings of a pair that node ``h`` has kept (``mine``), or the sender tells, behind
    the first ``M`` rows of the scratch; return their number. ``of``: numbers of link and message.
    """
    (w, m), f, p, tables = of, record.work, record.payload, record.tables
    for e in range(record.total[h, q] if mine else p.total[m, q]):
        b = record.block[h, e, q] if mine else p.block[m, e, q]
        since = record.since[h, e, q] if mine else p.since[m, e, q]
        first = tables.theirs[w, b] if mine else tables.first[h, b]
        k = index_of_time(record.times, h, record.count[h, q], since, q)
        j = index_of_time(p.times, m, p.count[m, q], since, q)
        if min(first, k, j) < 0:
            continue
        at = n * k, record.J.shape[3] * j, first, tables.size[b]
        write_believed(f, p, m, mine, at, q)
        if mine:
            count = linearise_stored(f, pairs, record, h, e, q)
        else:
            count = linearise_stored(f, pairs, p, m, e, q)
        for a in range(count):
            write_row(f, a, mine, n, at, M)
            M += 1
    return M


@kernel
def write_believed(
    f: PathScratch, p: Any, m: int, mine: bool, at: tuple[int, int, int, int], q: int
) -> None:
    """Write the estimates at which a reading of a pair is linearised into the first rows of ``J``
    and ``J_other``; ``at`` says where the states of the node and of the sender of message ``m`` are
    in their paths, and where those of the block that is read, of how many, are from there.
    """
    k, j, first, size = at
    v = f.J.shape[1]
    f.J[0, :] = f.J_other[0, :] = 0.0
    for i in range(v):
        if not mine:
            f.J[0, i] = p.mean[m, j // v, i, q]
        elif k + i < len(f.known):
            # Beyond its own states there is nothing that a reading of its own depends on.
            f.J[0, i] = f.known[k + i]
    for i in range(size):
        other = p.mean[m, j // v, first + i, q] if mine else f.known[k + first + i]
        f.J_other[0, i] = other


@kernel
def write_row(
    f: PathScratch, a: int, mine: bool, n: int, at: tuple[int, int, int, int], M: int
) -> None:
    """Write row ``a`` of the reading in the scratch, at these places, as row ``M`` of all."""
    k, j, first, size = at
    f.z[M] = f.value[a]
    f.G[M, :] = f.G_other[M, :] = 0.0
    for i in range(n if mine else f.J.shape[1]):
        if mine:
            f.G[M, k + i] = f.J[a, i]
        else:
            f.G_other[M, j + i] = f.J[a, i]
    for i in range(size):
        if mine:
            f.G_other[M, j + first + i] = f.J_other[a, i]
        else:
            f.G[M, k + first + i] = f.J_other[a, i]


@kernel
def find_evidence(record: Any, h: int, n: int, pairs: Pairs, of: tuple[int, int], q: int) -> int:
    """Write what a message says of the window of node ``h`` into the scratch, as readings with unit
    noise: all readings of the pair at instants that both remember. Return their number. ``of`` are
    the numbers of link and message.
    """
    m, f, p, v = of[1], record.work, record.payload, record.J.shape[3]
    M = gather_pairs(record, h, n, pairs, of, True, 0, q)
    M = gather_pairs(record, h, n, pairs, of, False, M, q)
    d, e = record.count[h, q] * n, p.count[m, q] * v
    # The root of the covariance of G_other x_other + noise, without the squares: near each other
    # nodes have large derivatives.
    for r in range(M):
        for c in range(e + M):
            f.wide[r, c] = 1.0 if c == e + r else 0.0
        for c in range(e):
            for k in range(c, e):
                f.wide[r, c] += f.G_other[r, k] * p.root[m, k // v, k % v, c // v, c % v, q]
            f.z[r] -= f.G_other[r, c] * p.x[m, c // v, c % v, q]
    for r in range(M):
        reflect(f.wide, r, r, M, e + M)
    last = len(f.former) - 1
    E = f.evidence
    for r in range(M):
        for j in range(d + 1):
            value = f.G[r, j] if j < d else f.z[r]
            for c in range(r):
                value -= f.wide[r, c] * E[j, c]
            E[j, r] = value / f.wide[r, r]
    # As many readings as states say the same.
    rows = eliminate(E, d, d + 1, M) if d < M else M
    for r in range(rows):
        E[last, r] = E[d, r]
    return rows


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``: the present moves, the window does not. Dynamics that are not linear are
    linearised at the belief, the best estimate.
    """
    n, lanes = len(run.size), run.lanes
    transition(run.model, run, record.xhat, h, record.F)
    for i in range(n):
        store(lanes, record.moved, 0, i, load(lanes, record.xhat, h, i))
        for j in range(n):
            store(lanes, record.moved_root, 0, i, j, 0.0)
    predict_estimate(run.model, run, record.moved, record.moved_root, 0, h)
    for q in range(len(lanes)):
        for i in range(n):
            for j in range(n):
                record.work.F[i, j] = record.F[i, j, q]
                record.work.root_Q[i, j] = record.moved_root[0, i, j, q] if j <= i else 0.0
        move_path(record, h, n, q)


@kernel
def move_path(record: Any, h: int, n: int, q: int) -> None:
    """Move the present of node ``h`` (n states) by ``F`` and a noise with ``root_Q``."""
    f, first = record.work, record.count[h, q] * n
    for i in range(n):
        f.row[i, 0] = record.path[h, first + i, q] - record.xhat[h, i, q]
    for i in range(n):
        moved = record.xhat[h, i, q] = record.moved[0, i, q]
        record.path[h, first + i, q] = moved + product_with_row(f, i, n)
    for c in range(first):
        for i in range(n):
            f.row[i, 0] = record.path_root[h, first + i, c, q]
        for i in range(n):
            record.path_root[h, first + i, c, q] = product_with_row(f, i, n)
    move_root(f, record.path_root[h, first:, first:], n, q)
    move_root(f, record.root[h], n, q)


@kernel
def product_with_row(f: PathScratch, i: int, n: int) -> float:
    """Return entry ``i`` of F times the first ``n`` numbers of ``row``."""
    total = 0.0
    for j in range(n):
        total += f.F[i, j] * f.row[j, 0]
    return total


@kernel
def move_root(f: PathScratch, root: FloatArray, n: int, q: int) -> None:
    """Predict the first ``n`` rows of a ``root`` (>= n, >= n, L) in lane ``q``."""
    for i in range(n):
        for j in range(i + 1):
            f.small[0, i, j, 0] = root[i, j, q]
    transform_root(ONE, f.size[:n], f.small, 0, f.F, f.root_Q, (f.first, f.second))
    for i in range(n):
        for j in range(i + 1):
            root[i, j, q] = f.small[0, i, j, 0]


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Use the readings of the node's own block; those of pairs are kept."""
    f, n, r = record.work, len(run.size), run.reading
    y, matrix = run.first_y + r, run.first_H + run.matrix[r]
    use_reading(run, record.xhat, record.root, h, r, True)
    for q in range(len(run.lanes)):
        first = record.count[h, q] * n
        if run.rows[r] > 0:
            load_path(record, h, first + n, q)
            for a in range(run.rows[r]):
                f.y[0, 0, 0] = run.y[y, a, q]
                for j in range(first + n):
                    f.H[0, 0, j, 0] = run.H[matrix, a, j - first, q] if j >= first else 0.0
                use_row(f, first + n)
            for i in range(first + n):
                record.path[h, i, q] = f.x[0, i, 0]
                for j in range(i + 1):
                    record.path_root[h, i, j, q] = f.S[0, i, j, 0]
        if len(run.pairs.row) > 0 and keep_pairs(record, h, run, q):
            mark(record, h, n, (run.first[h], run.first[h + 1]), time_of(run), q)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send what node ``h`` believes of its path, to each neighbour without what it knows from that
    one. In slots the present becomes part of it: others may have read the block.
    """
    n, links, now = len(run.size), (run.first[h], run.first[h + 1]), time_of(run)
    for q in range(len(run.lanes)):
        if run.sends[q] == 0:
            continue
        believe(record, h, n, links, -1, q)
        keep_mean(record.work)
        if run.receiver != ALL:
            if run.receiver >= 0:
                believe(record, h, n, links, run.receiver, q)
            write_message(record, h, m, n, now, q)
        else:
            # Nodes that it does not hear are told everything.
            write_message(record, h, m + links[1] - links[0], n, now, q)
            for w in range(links[0], links[1]):
                believe(record, h, n, links, w, q)
                write_message(record, h, m + w - links[0], n, now, q)
        if run.slot >= 0:
            mark(record, h, n, links, now, q)


@kernel
def write_message(record: Any, h: int, m: int, n: int, now: float, q: int) -> None:
    """Write the belief at the instants of the window and ``now`` into payload ``m``."""
    f, p, K = record.work, record.payload, record.count[h, q]
    # The present is the last instant; the oldest is left out if there are too many.
    count = K if K > 0 and record.times[h, K - 1, q] == now else K + 1
    skipped = 1 if count > record.times.shape[1] else 0
    count -= skipped
    if skipped == 1:
        leave_out_oldest(f, n, count * n)
    for k in range(count):
        p.times[m, k, q] = record.times[h, k + skipped, q] if k + skipped < K else now
        for i in range(n):
            row = k * n + i
            p.mean[m, k, i, q] = f.known[skipped * n + row]
            p.x[m, k, i, q] = f.x[0, skipped * n + row, 0]
            for c in range(row + 1):
                value = f.square[row, c] if skipped == 1 else f.S[0, row, c, 0]
                p.root[m, k, i, c // n, c % n, q] = value
    p.sent[m, q], p.count[m, q], p.total[m, q] = now, count, record.total[h, q]
    for e in range(record.total[h, q]):
        copy_stored(p, m, e, record, h, e, q)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Replace the evidence of each sender by that of its message, unless the one that node ``h``
    has was sent later.
    """
    f, p, n, links = record.work, record.payload, len(run.size), (run.first[h], run.first[h + 1])
    for q in range(len(run.lanes)):
        if not mark_heard(record, h, run, q):
            continue
        trace, is_current = believe(record, h, n, links, -1, q), True
        keep_mean(f)
        for k in range(run.count):
            m, w = run.message[k], run.link[k]
            if run.arrived[k, q] == 0 or p.sent[m, q] < record.sent[w, q]:
                continue
            rows, d = find_evidence(record, h, n, run.pairs, (w, m), q), record.count[h, q] * n
            former = load_evidence(record, w, f.former, q)
            store_evidence(record, w, f.evidence, rows, d, q)
            after = believe(record, h, n, links, -1, q)
            # What was kept of an older message may say more, if windows are short.
            is_current = after <= (1.0 + ROUNDING) * trace
            if is_current:
                trace, record.sent[w, q] = after, p.sent[m, q]
                keep_mean(f)
            else:
                store_evidence(record, w, f.former, former, d, q)
        if not is_current:
            believe(record, h, n, links, -1, q)
        write_present(record, h, n, q)


@kernel
def mark_heard(record: Any, h: int, run: Any, q: int) -> bool:
    """Make now an instant of the window if a message reads ``h`` now; return if any arrived."""
    found, p, now, links = False, record.payload, time_of(run), (run.first[h], run.first[h + 1])
    for k in range(run.count):
        m = run.message[k]
        if run.arrived[k, q] == 1:
            found = True
            for e in range(p.total[m, q]):
                if p.since[m, e, q] == now and record.tables.first[h, p.block[m, e, q]] >= 0:
                    mark(record, h, len(run.size), links, now, q)
    return found


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the present with the origin; states of the window, of which messages are made, keep the
    coordinates of their time.
    """
    shift_vector(run, record.xhat, h)
    for q in range(len(run.lanes)):
        first = record.count[h, q] * len(run.size)
        for i in range(len(run.size)):
            record.path[h, first + i, q] += run.offset[i, q]
