"""Readings in the compiled replay: how a host with sensors gets from one time to another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.flow import stretch_end
from netkf.algorithms.gains import gain_move
from netkf.algorithms.models import usable
from netkf.algorithms.riccati import move_part, move_units
from netkf.core.arrays import FloatArray
from netkf.core.compiling import in_place
from netkf.core.small import fill_square
from netkf.engines.base import LONGER, SHORTEST_SHARE
from netkf.engines.compiled.tables import Hosts, Models, Room, Sensing
from netkf.plants.paths import fill_seen
from netkf.plants.sensors import divide, fill_reading


class Stretch(NamedTuple):
    """Some steps of the sensing grid, the last of which ends at ``end``.

    K pieces (a step is cut where a state is shown): start, stop (K,), x at both (K, n), moments
    (K, 2, n), cubic (K, 4, n), whose step (K,) it is and where that ends (K,); ``grid`` holds the
    times at which sensors wake; ``to_end`` and ``to_moments`` are those of the plant's laws.
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


@in_place
def read(
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


@in_place
def advance(
    hosts: Hosts,
    models: Models,
    sensing: Sensing,
    path: Stretch,
    piece: int,
    h: int,
    time: float,
    room: Room,
) -> bool:
    """Bring host ``h``, which has sensors, to ``time`` as a Host of the processes does; False where
    it needs more normals for cuts first, and then goes on where it stopped.
    """
    now, k, n = hosts.now[h], hosts.model[h], hosts.xhat.shape[1]
    first, after = hosts.sensors[h], hosts.sensors[h + 1]
    P, xhat, least, G = hosts.P, hosts.xhat, hosts.least, models.information
    unit, series, normals = models.unit[k], models.series[k], sensing.normals.shape[1]
    terms, width, begin = models.shape[k, 1], models.shape[k, 2], models.first[k]
    gains = models.gains[begin : begin + terms * width].reshape(terms, width)
    to_end, to_moments, used = path.to_end, path.to_moments, sensing.used
    start, stop, last = path.start[piece], path.stop[piece], path.last[piece]
    readings, seen, values = room.moments[: models.shape[k, 0]], room.seen, room.values
    while now < time:
        end, rate = time, 0.0
        for i in range(n):
            for j in range(n):
                rate += P[h, i, j] * G[k, i, j]
        stretch = usable(rate)
        if stretch < time - now:
            if least[h] == 0.0:
                least[h] = SHORTEST_SHARE * (time - now)
            end = stretch_end(now, time, max(stretch, least[h]))
        if end < last:
            for s in range(first, after):
                if used[s] == normals:
                    hosts.now[h] = now
                    return False
        least[h] *= LONGER
        gap = end - now
        rest = gap if gap < unit else move_far(models, k, P, xhat, h, gap, room)
        if rest > 0.0:
            move_part(series, P, xhat, h, rest, room.E, room.X, room.Y)
        if now == start and end == stop:
            fill_square(seen, path.moments[piece])
        else:
            since, x_start, cubic = now - start, path.x_start, path.cubic
            rooms = values[: 2 * n * n], room.of_x, room.from_noise
            whole = stop - start
            fill_seen(seen, to_end, to_moments, since, gap, whole, x_start, cubic, piece, *rooms)
        share = gap / (last - now) if end < last else -1.0
        read(readings, sensing, first, seen, path.step[piece], share, last - now, room.early)
        gain_move(readings, gains, P, xhat, h, gap, values[: width - 1])
        now = end
    hosts.now[h], least[h] = now, 0.0
    return True


@in_place
def move_far(
    models: Models, m: int, P: FloatArray, x: FloatArray, k: int, gap: float, room: Room
) -> float:
    """Move place ``k`` of P and x over the whole units of a long gap by model ``m``; returns what
    is left of it.
    """
    whole = int(gap / models.unit[m])
    jump, F, G, Q = models.jump[m], models.F[m], models.G[m], models.Q[m]
    move_units(whole, jump, F, G, Q, P, x, k, room.X, room.Y)
    return gap - whole * float(models.unit[m])
