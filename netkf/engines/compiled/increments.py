"""How a node in the event loop gets from one time to another, with its increment sensors."""

from __future__ import annotations

from netkf.algorithms.kernels.root_flow import gain_root, propagate_root
from netkf.algorithms.kernels.run import interval_end, longest_interval
from netkf.engines.base import LONGER, MIN_GAP_SHARE
from netkf.engines.compiled.state import PathBlock, Sensing, Simulation
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE
from netkf.linalg.small import copy_matrix
from netkf.plants.paths import fill_course, fill_state_moments
from netkf.plants.sensors import divide, fill_reading
from netkf.rng.draws import Ziggurat
from netkf.rng.numbers import next_normal


@kernel
def read_increments(
    state: Simulation, run: int, h: int, piece: int, now: float, end: float, out: FloatArray
) -> None:
    """Write the two moments of what node ``h`` reads over [now, end] (seconds), in the step of
    ``piece``, into ``out`` (2 p,), of all rows the first moment before the second;
    ``scratch.state_moments``: those of x. Used noise leaves ``sensing.noise``.
    """
    sensing, early = state.sensing, state.scratch.early
    x, H, root, row = state.scratch.state_moments, sensing.H, sensing.root, 0
    step, last = state.path.step[piece], state.path.last[piece]
    for s in range(state.nodes[h].sensor, state.nodes[h].sensors):
        noise = sensing.noise[noise_index(sensing, run, s, step)]
        # A part of the step: divide its noise exactly, and keep the rest for the next call.
        if end < last:
            draw_cut(sensing, run, s, state.scratch.cut)
            left = last - now
            divide(ONE, early, noise, state.scratch.cut, (end - now) / left, left)
            noise = early
        fill_reading(ONE, state.plant, out, row, sensing.rows[s], x, H, noise, root, s)
        row += sensing.rows[s]


@kernel(inlined=True)
def noise_index(sensing: Sensing, run: int, s: int, step: int) -> int:
    """Return the index in ``sensing.noise`` of sensor ``s`` in a ``step`` of the present block."""
    return (run * len(sensing.rows) + s) * sensing.steps + step


@kernel
def draw_cut(sensing: Sensing, run: int, s: int, normals: FloatArray) -> None:
    """Draw the ``normals`` (2, p) that divide the noise of sensor ``s`` inside a step."""
    ziggurat = Ziggurat(sensing.height, sensing.width, sensing.inside)
    states, stream = sensing.cuts, run * len(sensing.rows) + s
    for half in range(2):
        for i in range(sensing.rows[s]):
            normals[half, i] = next_normal(states, stream, ziggurat)


@kernel(inlined=True)
def find_course(state: Simulation, run: int, piece: int) -> int:
    """Return the index in ``path.course`` of the polynomial of x in a ``piece``, which is computed
    once for all nodes that read in the piece.
    """
    path, k = state.path, run - state.first_run
    # The cache has 2^m entries: the index is the number of the piece modulo 2^m.
    entry: int = piece & (path.known.shape[1] - 1)
    if path.known[k, entry] != piece:
        path.known[k, entry] = piece
        length, course = path.stop[piece] - path.start[piece], path.course[k, entry]
        x_start, cubic = path.x_start[run], path.cubic[run]
        fill_course(state.plant, course, path.table, length, x_start, cubic, piece)
    return entry


@kernel
def fill_moments_of_piece(state: Simulation, run: int, piece: int, now: float, end: float) -> None:
    """Write moments of x over [now, end] (s) of one ``piece`` into ``scratch.state_moments``."""
    path, scratch = state.path, state.scratch
    start, stop = path.start[piece], path.stop[piece]
    # A whole piece has its moments already, drawn from their exact law.
    if now == start and end == stop:
        copy_matrix(scratch.state_moments, path.moments[run, piece])
        return
    # A part of it: integrate the polynomial of x in this piece.
    course = path.course[run - state.first_run, find_course(state, run, piece)]
    moments, values = scratch.state_moments, scratch.values
    fill_state_moments(state.plant, moments, course, now - start, end - now, stop - start, values)


@kernel(inlined=True)
def piece_of(path: PathBlock, piece: int, end: float) -> int:
    """Return the index of the piece that contains ``end`` (seconds), not after ``piece``."""
    # Back from the present piece: a node may be behind it.
    while piece > 0 and path.stop[piece - 1] >= end:
        piece -= 1
    return piece


@kernel
def fill_moments(state: Simulation, run: int, piece: int, now: float, end: float) -> None:
    """Write the two moments of x over [now, end] (seconds), inside one step and not after
    ``piece``, into ``scratch.state_moments``.
    """
    path = state.path
    k = piece_of(path, piece, end)
    if now >= path.start[k]:
        fill_moments_of_piece(state, run, k, now, end)
        return
    # The interval covers several pieces: sum their moments, from the last to the first.
    moments, total, gap = state.scratch.state_moments, state.scratch.total, end - now
    for i in range(moments.shape[1]):
        total[0, i] = total[1, i] = 0.0
    while True:
        first, last = max(now, path.start[k]), min(end, path.stop[k])
        fill_moments_of_piece(state, run, k, first, last)
        # P_1 of the whole interval on this part of it.
        middle, share = ((first - now) - (end - last)) / gap, (last - first) / gap
        for i in range(moments.shape[1]):
            # The moment with P_0 adds up; that with P_1 is shifted and scaled from the part to the
            # whole.
            total[0, i] += moments[0, i]
            total[1, i] += middle * moments[0, i] + share * moments[1, i]
        if path.start[k] <= now:
            break
        k -= 1
    copy_matrix(moments, total)


@kernel
def fill_readings(
    state: Simulation, run: int, h: int, piece: int, now: float, end: float, out: FloatArray
) -> None:
    """Write the moments of readings of node ``h`` over [now, end] (s), as ``read_increments``."""
    fill_moments(state, run, piece, now, end)
    read_increments(state, run, h, piece, now, end, out)


@kernel(inlined=True)
def next_interval(rate: float, now: float, time: float, least: float) -> tuple[float, float]:
    """Return where the next measurement interval from ``now`` to at most ``time`` (seconds) ends,
    short against the ``rate`` trace(P G) in 1/s, and the least next length, at first 0.
    """
    end, interval = time, longest_interval(rate)
    if interval < time - now:
        # A lower bound that is set once per gap: a diverging P would make intervals ever shorter.
        if least == 0.0:
            least = MIN_GAP_SHARE * (time - now)
        end = interval_end(now, time, max(interval, least))
    # The bound grows geometrically, so that a gap takes about a thousand intervals at most.
    return end, LONGER * least


@kernel
def predict_over_interval(
    state: Simulation, run: int, h: int, k: int, piece: int, now: float, end: float
) -> None:
    """Predict node ``h`` of run number ``run``, whose estimate is in row ``k``, from ``now`` to
    ``end`` (seconds), in the step of ``piece``, and use all increments between them in one update.
    """
    table, m, scratch, gap = state.table, state.nodes[h].model, state.scratch, end - now
    xhat, root, readings = state.xhat, state.root, scratch.moments[: state.gains.moments[m]]
    # The flow of P includes the information of the readings already, the estimate does not. Predict
    # first, with the moments of the reading used at the end: they belong to the whole interval.
    propagate_root(table, m, root, xhat, k, gap, state.flow_scratch)
    fill_readings(state, run, h, piece, now, end, readings)
    gains, reach = state.gains.series[m], state.gains.reach[m]
    gain_root(state.size, readings, gains, reach, 0, root, xhat, k, gap, scratch.values)
