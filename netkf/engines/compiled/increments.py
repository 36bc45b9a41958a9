"""How a node in the event loop gets from one time to another, with its increment sensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.flow import stretch_end
from netkf.algorithms.kernels.root_flow import gain_root, information_rate, move_root
from netkf.algorithms.models import usable
from netkf.engines.base import LONGER, SHORTEST_SHARE
from netkf.engines.compiled.state import Sensing, Simulation
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import fill_square
from netkf.plants.paths import fill_seen
from netkf.plants.sensors import divide, fill_reading


class PathBlock(NamedTuple):
    """Some steps of the sensing grid, the last of which ends at ``end``.

    K pieces (a step is cut where a state is sampled or shown): start, stop (K,), x at both (K, n),
    moments (K, 2, n), cubic (K, 4, n), whose step (K,) it is and where that ends (K,); ``grid``
    holds the times at which sensors wake; ``to_end`` and ``to_moments`` are those of the plant's
    laws. Where nothing senses increments there is one piece without an end.
    """

    end: float
    start: FloatArray
    stop: FloatArray
    x_start: FloatArray
    x_stop: FloatArray
    moments: FloatArray
    cubic: FloatArray
    step: np.ndarray
    last: FloatArray
    grid: FloatArray
    to_end: FloatArray
    to_moments: FloatArray


@kernel
def read_increments(
    out: FloatArray,
    sensing: Sensing,
    first: int,
    x: FloatArray,
    step: int,
    u: float,
    length: float,
    early: FloatArray,
) -> None:
    """Moments (2 p,) of the readings of sensors from ``first`` on, as many as fill ``out``, where x
    has the moments ``x``, over the first share ``u`` of the ``length`` seconds left of a step (-1:
    all of it). ``early`` (2, most p) is room to work in.
    """
    rows, rest, used, H, root = sensing.rows, sensing.rest, sensing.used, sensing.H, sensing.root
    s, row = first, 0
    while 2 * row < len(out):
        if sensing.step[s] != step:
            sensing.step[s] = step
            fill_square(rest[s], sensing.noise[s, step])
        noise = rest[s]
        if u >= 0.0:
            noise = early
            divide(early, rest[s], sensing.normals[s, used[s]], u, length)
            used[s] += 1
        fill_reading(out, row, rows[s], x, H, noise, root, s)
        row += rows[s]
        s += 1


@kernel
def fill_moments_of_piece(
    state: Simulation, path: PathBlock, piece: int, now: float, end: float
) -> None:
    """Write the moments of x over [now, end], inside one piece, into ``room.seen``."""
    start, stop, room = path.start[piece], path.stop[piece], state.room
    if now == start and end == stop:
        fill_square(room.seen, path.moments[piece])
        return
    n = room.seen.shape[1]
    rooms = room.values[: 2 * n * n], room.of_x, room.from_noise
    laws, x, cubic = (path.to_end, path.to_moments), path.x_start, path.cubic
    fill_seen(room.seen, *laws, now - start, end - now, stop - start, x, cubic, piece, *rooms)


@kernel
def fill_moments(state: Simulation, path: PathBlock, now: float, end: float) -> None:
    """Write the moments of x over [now, end], inside one step, into ``room.seen``; samples of other
    nodes may cut it.
    """
    k = state.run[0].piece
    while k > 0 and path.stop[k - 1] >= end:
        k -= 1
    if now >= path.start[k]:
        fill_moments_of_piece(state, path, k, now, end)
        return
    seen, total, gap = state.room.seen, state.room.total, end - now
    for i in range(seen.shape[1]):
        total[0, i] = total[1, i] = 0.0
    while True:
        first, last = max(now, path.start[k]), min(end, path.stop[k])
        fill_moments_of_piece(state, path, k, first, last)
        # P_1 of the whole interval on this part of it.
        middle, share = ((first - now) - (end - last)) / gap, (last - first) / gap
        for i in range(seen.shape[1]):
            total[0, i] += seen[0, i]
            total[1, i] += middle * seen[0, i] + share * seen[1, i]
        if path.start[k] <= now:
            break
        k -= 1
    fill_square(seen, total)


@kernel
def predict_with_increments(state: Simulation, path: PathBlock, h: int, time: float) -> bool:
    """Bring node ``h`` to ``time``; False where it needs more normals for cuts first, and then goes
    on where it stopped.
    """
    node, piece, room, sensing = state.nodes[h], state.run[0].piece, state.room, state.sensing
    k, xhat, root, table = node.model, state.xhat, state.root, state.table
    shape, begin = state.gains.shape, state.gains.first[k]
    terms, width, last = shape[k, 1], shape[k, 2], path.last[piece]
    gains = state.gains.series[begin : begin + terms * width].reshape(terms, width)
    readings, values = room.moments[: shape[k, 0]], room.values[: width - 1]
    while node.now < time:
        now, end = node.now, time
        stretch = usable(information_rate(table, k, root, h))
        if stretch < time - now:
            if node.least == 0.0:
                node.least = SHORTEST_SHARE * (time - now)
            end = stretch_end(now, time, max(stretch, node.least))
        if end < last:
            for s in range(node.sensor, node.sensors):
                if sensing.used[s] == sensing.normals.shape[1]:
                    return False
        node.least *= LONGER
        move_root(table, k, root, xhat, h, end - now, state.flow_room)
        fill_moments(state, path, now, end)
        share = (end - now) / (last - now) if end < last else -1.0
        step = path.step[piece]
        read_increments(
            readings, sensing, node.sensor, room.seen, step, share, last - now, room.early
        )
        gain_root(readings, gains, root, xhat, h, end - now, values)
        node.now = end
    node.least = 0.0
    return True
