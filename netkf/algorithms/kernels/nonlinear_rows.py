"""Rows of readings that are not linear in the state, linearised where their node uses them.

Until then a reading holds the values themselves, and H what they are measured from: coordinates of
a place, numbers of the states that are another node's position, or the id of a node. The update of
the node begins with ``linearise_rows``, which writes the whitened linear reading in their place.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from netkf.algorithms.kernels.maps import set_point, settle_root
from netkf.algorithms.kernels.run import Estimates
from netkf.linalg.addresses import reads_only
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.linalg.structs import Struct

LINEAR, RANGE, BEARING, CUSTOM, OF_CUSTOM = range(5)
"""Kinds of rows; those of a user's sensor after its first are OF_CUSTOM."""
H_OF, JACOBIAN, DIFFERENCE = range(3)


class NonlinearRows(Struct):
    """The rows of the readings of H filters, at most p each.

    kind : (H, p), LINEAR where a row is linear, or where there is none
    states, dimensions : (H, p, 3) and (H, p), which states are the position that a row is about
    relative, heading : (H, p), 1 where it is read from there, to another position in the state, and
        the state from which directions are measured, -1 for none
    length, functions : (H, p) and (H, p, 3), of the first row of a user's sensor the number of its
        rows, and the addresses of h, its Jacobian and the difference of two readings
    R : (S or 1, H, p, p), the covariance of the noise in each slot, in nonlinear rows
    origin : (S or 1, N), where the N states of the plant are counted from in each slot
    entries : (H or 1, n), which of these each filter estimates, -1 beyond
    count : (H or 1,), how many these are
    active : runs side by side that there are, at most L
    distance, weight : (H or 1,), with ``center`` a ``kernels.maps.Spread``
    x, y, value, mean, points, G, J, C, part, matrix, nothing : scratch, (n,), (p,) three times,
        (2 n + 1, p), (p, n) twice, (p, p), (p,), (p, n) and (0,)
    """

    kind: np.ndarray
    states: np.ndarray
    dimensions: np.ndarray
    relative: np.ndarray
    heading: np.ndarray
    length: np.ndarray
    functions: np.ndarray
    R: FloatArray
    origin: FloatArray
    entries: np.ndarray
    count: np.ndarray
    active: int
    distance: FloatArray
    weight: FloatArray
    center: float
    x: FloatArray
    y: FloatArray
    value: FloatArray
    mean: FloatArray
    points: FloatArray
    G: FloatArray
    J: FloatArray
    C: FloatArray
    part: FloatArray
    matrix: FloatArray
    nothing: FloatArray


def linear_rows(filters: int, p: int, entries: np.ndarray) -> NonlinearRows:
    """Return linear rows of H = ``filters`` filters of states ``entries`` (H, n), or all (1, n)."""
    shape, n = (filters, p), entries.shape[1]
    integers = ("kind", "dimensions", "relative", "length")
    scratch: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("y", "value", "mean", "part"), (p,)),
        **dict.fromkeys(("G", "J", "matrix"), (p, n)),
        **{"x": (n,), "points": (2 * n + 1, p), "C": (p, p), "nothing": (0,)},
    }
    made: dict[str, Any] = {name: np.zeros(size) for name, size in scratch.items()}
    made |= {name: np.zeros(shape, dtype=np.int64) for name in integers}
    made |= {name: np.zeros((*shape, 3), dtype=np.int64) for name in ("states", "functions")}
    return NonlinearRows(
        **made,
        heading=np.full(shape, -1),
        R=np.zeros((1, *shape, p)),
        origin=np.zeros((1, 1 + int(entries.max(initial=0)))),
        entries=entries,
        count=(entries >= 0).sum(axis=1),
        active=1,
        distance=np.zeros(len(entries)),
        weight=np.zeros(len(entries)),
        center=0.0,
    )


@kernel(inlined=True)
def offset_of(
    rows: NonlinearRows, h: int, i: int, H: FloatArray, place: tuple[int, int], d: int
) -> Any:
    """Return coordinate ``d`` of the offset whose length or direction row ``i`` reads;
    ``place`` = (r, q) says where H tells from what it is measured.
    """
    r, q = place
    own, other = rows.x[rows.states[h, i, d]], H[r, i, d, q]
    if rows.relative[h, i] != 0:
        return rows.x[int(other)] - own
    return other - own if rows.heading[h, i] >= 0 else own - other


@kernel
def read_rows(rows: NonlinearRows, h: int, H: FloatArray, r: int, q: int, out: FloatArray) -> None:
    """Write the values at the state ``rows.x`` of the nonlinear rows of filter ``h`` into ``out``
    (p,), measured from what ``H[r]`` (p, n, L) says in lane ``q``.
    """
    place = r, q
    for i in range(rows.kind.shape[1]):
        kind = rows.kind[h, i]
        if kind == RANGE:
            square = 0.0
            for d in range(rows.dimensions[h, i]):
                offset = offset_of(rows, h, i, H, place, d)
                square += offset * offset
            out[i] = math.sqrt(square)
        elif kind == BEARING:
            along, aside = (offset_of(rows, h, i, H, place, 0), offset_of(rows, h, i, H, place, 1))
            out[i] = math.atan2(aside, along)
            if rows.heading[h, i] >= 0:
                out[i] -= rows.x[rows.heading[h, i]]
        elif kind == CUSTOM:
            node, part = H[r, i, 0, q], rows.part
            call_function(rows.functions[h, i, H_OF], rows.x, rows.nothing, node, 0.0, part)
            for k in range(rows.length[h, i]):
                out[i + k] = part[k]


@kernel
def differentiate_rows(rows: NonlinearRows, h: int, H: FloatArray, r: int, q: int) -> None:
    """Write the Jacobian at ``rows.x`` of the nonlinear rows of filter ``h`` into ``rows.J``."""
    J = rows.J
    for i in range(rows.kind.shape[1]):
        if rows.kind[h, i] in (RANGE, BEARING):
            _differentiate_position(rows, h, i, H, (r, q))
        elif rows.kind[h, i] == CUSTOM:
            node, part = H[r, i, 0, q], rows.matrix
            call_function(rows.functions[h, i, JACOBIAN], rows.x, rows.nothing, node, 0.0, part)
            # The matrix begins at the first number, and has the rows of this sensor.
            for k in range(rows.length[h, i]):
                for j in range(J.shape[1]):
                    J[i + k, j] = part[k, j]


@kernel
def _differentiate_position(
    rows: NonlinearRows, h: int, i: int, H: FloatArray, place: tuple[int, int]
) -> None:
    J, turned, heading = rows.J, rows.kind[h, i] == BEARING, rows.heading[h, i]
    square, sign = 0.0, -1.0 if rows.relative[h, i] != 0 or heading >= 0 else 1.0
    for j in range(J.shape[1]):
        J[i, j] = 0.0
    for d in range(rows.dimensions[h, i]):
        offset = offset_of(rows, h, i, H, place, d)
        square += offset * offset
    # At distance 0 there is no derivative.
    for d in range(rows.dimensions[h, i] if square > 0.0 else 0):
        # d / |d|, or (-d_2, d_1) / |d|^2.
        if turned:
            slope = offset_of(rows, h, i, H, place, 1 - d) / square * (1.0 if d == 1 else -1.0)
        else:
            slope = offset_of(rows, h, i, H, place, d) / math.sqrt(square)
        J[i, rows.states[h, i, d]] += sign * slope
        if rows.relative[h, i] != 0:
            J[i, int(H[place[0], i, d, place[1]])] += slope
    if turned and heading >= 0:
        J[i, heading] -= 1.0


@kernel
def subtract_rows(
    rows: NonlinearRows, h: int, y: FloatArray, expected: FloatArray, out: FloatArray
) -> None:
    """Write the innovations of the nonlinear rows into ``out`` (p,): readings ``y`` (p,) minus
    those ``expected`` (p,), angles wrapped to [-pi, pi).
    """
    for i in range(rows.kind.shape[1]):
        kind = rows.kind[h, i]
        if kind in (RANGE, BEARING):
            out[i] = y[i] - expected[i]
        if kind == BEARING:
            out[i] = (out[i] + math.pi) % (2.0 * math.pi) - math.pi
        if kind == CUSTOM:
            last = i + rows.length[h, i]
            call_function(
                rows.functions[h, i, DIFFERENCE], y[i:last], expected[i:last], 0.0, 0.0, rows.part
            )
            for k in range(rows.length[h, i]):
                out[i + k] = rows.part[k]


@kernel(inlined=True)
def move_state(rows: NonlinearRows, x: FloatArray, k: int, q: int, s: int, h: int) -> None:
    """Write the states ``x[k]`` (n, L) of filter ``h`` in lane ``q``, in slot number ``s`` of the
    plan, into ``rows.x``, in the coordinates of the plant.
    """
    slot = min(s, len(rows.origin) - 1)
    for j in range(rows.count[h]):
        rows.x[j] = x[k, j, q] + rows.origin[slot, rows.entries[h, j]]


@kernel
def linearise_rows(record: Any, h: int, s: int, run: Any) -> None:
    """Replace nonlinear rows of filter ``h`` in slot ``s`` of the plan by whitened linear ones."""
    linearise_reading(run.nonlinear, record, h, run, run.first_y + h, h, s)


@kernel
def linearise_reading(
    rows: NonlinearRows, record: Any, h: int, run: Any, r: int, f: int, s: int
) -> None:
    """Replace the nonlinear rows of reading number ``r`` of node ``h``, those of filter ``f`` in
    ``rows`` and of slot number ``s``, by whitened linear ones.
    """
    n, p = len(run.size), rows.kind.shape[1]
    for q in range(rows.active):
        own = min(f, len(rows.count) - 1)
        move_state(rows, record.xhat, h, q, s, own)
        for i in range(p):
            rows.y[i] = run.y[r, i, q]
            for k in range(p):
                rows.C[i, k] = rows.R[min(s, len(rows.R) - 1), f, i, k]
        read_rows(rows, f, run.H, r, q, rows.mean)
        if rows.distance[own] > 0.0:
            _use_points(rows, record, h, run.H, (r, f), q, s)
        else:
            differentiate_rows(rows, f, run.H, r, q)
        subtract_rows(rows, f, rows.y, rows.mean, rows.value)
        for i in range(p):
            for j in range(n):
                rows.value[i] += rows.J[i, j] * record.xhat[h, j, q]
        _whiten(rows, f)
        for i in range(p):
            if rows.kind[f, i] != LINEAR:
                run.y[r, i, q] = rows.value[i]
                for j in range(n):
                    run.H[r, i, j, q] = rows.J[i, j]


@kernel
def _use_points(
    rows: NonlinearRows, record: Any, h: int, H: FloatArray, of: tuple[int, int], q: int, s: int
) -> None:
    r, f = of
    own, slot = min(f, len(rows.count) - 1), min(s, len(rows.origin) - 1)
    n, p, points = rows.count[own], rows.kind.shape[1], rows.points
    distance, weight = rows.distance[own], rows.weight[own]
    settle_root(record.root, h, q, n)
    for k in range(1, 2 * n + 1):
        set_point(record.xhat, record.root, h, q, distance, k, rows.x[:n])
        for j in range(n):
            rows.x[j] += rows.origin[slot, rows.entries[own, j]]
        read_rows(rows, f, H, r, q, rows.value)
        subtract_rows(rows, f, rows.value, rows.mean, points[k])
    for i in range(p):
        # The mean of the deviations from the reading at the estimate.
        mean = 0.0
        for k in range(1, 2 * n + 1):
            mean += weight * points[k, i]
        points[0, i] = mean
        for j in range(n):
            odd = points[2 * j + 1, i] - points[2 * j + 2, i]
            rows.G[i, j] = weight * distance * odd
        rows.J[i, n:] = 0.0
        # H = G S^-1; columns of the root that are 0 say nothing.
        for j in range(n - 1, -1, -1):
            total = rows.G[i, j]
            for m in range(j + 1, n):
                total -= rows.J[i, m] * record.root[h, m, j, q]
            pivot = record.root[h, j, j, q]
            rows.J[i, j] = total / pivot if pivot != 0.0 else 0.0
    for i in range(p):
        for k in range(p):
            if rows.kind[f, i] == LINEAR or rows.kind[f, k] == LINEAR:
                continue
            # P_yy - H P H': what is even in the deviations, H P H' has all that is odd.
            total = 0.0
            for j in range(n):
                even = points[2 * j + 1, i] + points[2 * j + 2, i] - 2.0 * points[0, i]
                other = points[2 * j + 1, k] + points[2 * j + 2, k] - 2.0 * points[0, k]
                total += even * other
            rows.C[i, k] += 0.5 * weight * total + rows.center * points[0, i] * points[0, k]
    for i in range(p):
        rows.mean[i] += points[0, i]


@kernel
def _whiten(rows: NonlinearRows, h: int) -> None:
    """Divide nonlinear rows by the Cholesky factor of ``rows.C``; those of value nan become 0."""
    p, C, J, y = rows.kind.shape[1], rows.C, rows.J, rows.value
    for i in range(p):
        if rows.kind[h, i] == LINEAR or math.isnan(y[i]):
            y[i] = 0.0
            for j in range(J.shape[1]):
                J[i, j] = 0.0
            for k in range(p):
                C[i, k] = C[k, i] = 0.0
            C[i, i] = 1.0
    for k in range(p):
        C[k, k] = math.sqrt(C[k, k])
        y[k] /= C[k, k]
        for j in range(J.shape[1]):
            J[k, j] /= C[k, k]
        for i in range(k + 1, p):
            C[i, k] /= C[k, k]
            y[i] -= C[i, k] * y[k]
            for j in range(J.shape[1]):
                J[i, j] -= C[i, k] * J[k, j]
        for i in range(k + 1, p):
            for j in range(k + 1, i + 1):
                C[i, j] -= C[i, k] * C[j, k]


reads_only(Estimates, linearise_rows)


@cache
def no_nonlinear() -> NonlinearRows:
    """Return no rows, where all readings are linear."""
    return linear_rows(0, 1, np.zeros((0, 1), dtype=np.int64))


@kernel
def copy_sensor(rows: NonlinearRows, f: int, first: int, sensors: NonlinearRows, k: int) -> int:
    """Copy what ``sensors`` say of the rows of number ``k`` to those of filter ``f`` in ``rows``
    from ``first`` on; return how many these are.
    """
    count = 0
    while count < sensors.kind.shape[1] and sensors.kind[k, count] != LINEAR:
        i = first + count
        rows.kind[f, i], rows.heading[f, i] = sensors.kind[k, count], sensors.heading[k, count]
        rows.dimensions[f, i] = sensors.dimensions[k, count]
        rows.relative[f, i] = sensors.relative[k, count]
        rows.length[f, i] = sensors.length[k, count]
        for d in range(3):
            rows.states[f, i, d] = sensors.states[k, count, d]
            rows.functions[f, i, d] = sensors.functions[k, count, d]
        count += 1
    for j in range(len(rows.x)):
        rows.entries[f, j] = sensors.entries[k, j]
    rows.count[f] = sensors.count[k]
    rows.distance[f], rows.weight[f] = sensors.distance[k], sensors.weight[k]
    return count


@kernel
def add_values(
    rows: NonlinearRows, x: FloatArray, y: FloatArray, places: FloatArray, drawn: np.ndarray
) -> None:
    """Add the values at the true states ``x`` (B, S, n, L) to the noises ``y`` (B S H, p, L) of the
    nonlinear rows with a flag in ``drawn`` (H, p); ``places`` (H, p, n, ...) says from where.
    """
    filters = len(rows.kind)
    for b in range(x.shape[0]):
        for s in range(x.shape[1]):
            for q in range(rows.active):
                move_state(rows, x[b], s, q, s, 0)
                for h in range(filters):
                    r = (b * x.shape[1] + s) * filters + h
                    read_rows(rows, h, places, h, 0, rows.value)
                    for i in range(rows.kind.shape[1]):
                        if drawn[h, i] != 0:
                            y[r, i, q] += rows.value[i]
