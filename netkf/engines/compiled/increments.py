"""How a node in the event loop gets from one time to another, with its increment sensors."""

from __future__ import annotations

from netkf.algorithms.flow import stretch_end
from netkf.algorithms.kernels.root_flow import gain_root, information_rate, move_root
from netkf.algorithms.models import usable
from netkf.engines.base import LONGER, SHORTEST_SHARE
from netkf.engines.compiled.state import Sensing, Simulation
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import copy_matrix
from netkf.linalg.structs import Size
from netkf.plants.paths import fill_course, fill_seen
from netkf.plants.sensors import divide, fill_reading


@kernel
def read_increments(
    size: Size,
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
    all of it). ``early`` (2, most p) is a scratch array.
    """
    rows, rest, used, H, root = sensing.rows, sensing.rest, sensing.used, sensing.H, sensing.root
    s, row = first, 0
    # ``out`` holds the first moments of all rows and then the second: 2 rows of it per row of H.
    while 2 * row < len(out):
        # The first reading of a step takes over the noise of that step.
        if sensing.step[s] != step:
            sensing.step[s] = step
            copy_matrix(rest[s], sensing.noise[s, step])
        noise = rest[s]
        # A part of the step: divide its noise exactly, and keep the rest for the next call.
        if u >= 0.0:
            noise = early
            divide(early, rest[s], sensing.normals[s, used[s]], u, length)
            used[s] += 1
        fill_reading(size, out, row, rows[s], x, H, noise, root, s)
        row += rows[s]
        s += 1


@kernel
def fill_moments_of_piece(state: Simulation, piece: int, now: float, end: float) -> None:
    """Write the moments of x over [now, end], inside one piece, into ``scratch.state_moments``."""
    path, scratch = state.path, state.scratch
    start, stop = path.start[piece], path.stop[piece]
    # A whole piece has its moments already, drawn from their exact law.
    if now == start and end == stop:
        copy_matrix(scratch.state_moments, path.moments[piece])
        return
    # The same for all nodes that read a part of the piece.
    if state.course != piece + 1:
        state.course = piece + 1
        x, cubic, course = path.x_start, path.cubic, scratch.course
        fill_course(state.size, course, path.to_end, stop - start, x, cubic, piece, scratch.values)
    fill_seen(
        state.size,
        scratch.state_moments,
        scratch.course,
        now - start,
        end - now,
        stop - start,
        scratch.values,
    )


@kernel
def fill_moments(state: Simulation, now: float, end: float) -> None:
    """Write the moments of x over [now, end], inside one step that samples of other nodes may cut,
    into ``scratch.state_moments``.
    """
    path, k = state.path, state.piece
    # Back to the piece that ``end`` lies in: the node may be behind the present piece.
    while k > 0 and path.stop[k - 1] >= end:
        k -= 1
    if now >= path.start[k]:
        fill_moments_of_piece(state, k, now, end)
        return
    # The interval covers several pieces: sum their moments, from the last to the first.
    seen, total, gap = state.scratch.state_moments, state.scratch.total, end - now
    for i in range(seen.shape[1]):
        total[0, i] = total[1, i] = 0.0
    while True:
        first, last = max(now, path.start[k]), min(end, path.stop[k])
        fill_moments_of_piece(state, k, first, last)
        # P_1 of the whole interval on this part of it.
        middle, share = ((first - now) - (end - last)) / gap, (last - first) / gap
        for i in range(seen.shape[1]):
            # The moment with P_0 adds up; that with P_1 is shifted and scaled from the part to the
            # whole.
            total[0, i] += seen[0, i]
            total[1, i] += middle * seen[0, i] + share * seen[1, i]
        if path.start[k] <= now:
            break
        k -= 1
    copy_matrix(seen, total)


@kernel
def predict_with_increments(state: Simulation, h: int, time: float) -> bool:
    """Bring node ``h`` to ``time``; False where it needs more normals for cuts first, and then goes
    on where it stopped.
    """
    node, path, piece = state.nodes[h], state.path, state.piece
    scratch, sensing = state.scratch, state.sensing
    k, xhat, root, table = node.model, state.xhat, state.root, state.table
    gains, reach, last = state.gains.series[k], state.gains.reach[k], path.last[piece]
    readings = scratch.moments[: state.gains.moments[k]]
    # The state of a node is whole after each stretch, so that a stop for normals may come in
    # between.
    while node.now < time:
        now, end = node.now, time
        # How much of the gap may be used at once depends on the rate of information, trace(P G).
        stretch = usable(information_rate(state.size, table, k, root, h))
        if stretch < time - now:
            # A lower bound that is set once per gap, else an exploding P asks for ever shorter
            # stretches.
            if node.least == 0.0:
                node.least = SHORTEST_SHARE * (time - now)
            end = stretch_end(now, time, max(stretch, node.least))
        # Only a stretch that ends inside a step cuts it and needs normals of each sensor.
        if end < last:
            for s in range(node.sensor, node.sensors):
                if sensing.used[s] == sensing.normals.shape[1]:
                    return False
        # The bound grows geometrically, so that a gap takes about a thousand stretches at most.
        node.least *= LONGER
        # Predict first, with the moments of the reading used at the end: they belong to the whole
        # stretch.
        move_root(table, k, root, xhat, h, end - now, state.flow_scratch)
        fill_moments(state, now, end)
        # Share of what is left of the step; -1 takes all of it.
        share = (end - now) / (last - now) if end < last else -1.0
        step = path.step[piece]
        read_increments(
            state.size,
            readings,
            sensing,
            node.sensor,
            scratch.state_moments,
            step,
            share,
            last - now,
            scratch.early,
        )
        gain_root(state.size, readings, gains, reach, 0, root, xhat, h, end - now, scratch.values)
        node.now = end
    # The next gap sets its own bound.
    node.least = 0.0
    return True
