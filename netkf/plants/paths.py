"""The path of a diffusion in one run, drawn block by block of steps of the sensing grid.

The path is drawn exactly on the sensing grid ``t_k = k h``: each step gives ``x(t_{k+1})`` and the
two moments of x over the step (core/legendre), all from one stream and whatever the network does.
Between grid points, filters that are woken by the network need part of a step. There the path is
the response to the state at the grid point plus the cubic that agrees with the step's end and with
its two moments; what that leaves out of a reading is of third order in h and less than 1e-4 h^3 of
the noise intensity. Where a state is *sampled* or *probed* off the grid, the step is cut there
beforehand: state and moments are drawn from their exact law given the step, from streams of their
own, the sampled ones first. On frames see ``truth``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, ONE, Lanes, load, spread, store
from netkf.linalg.portable import apply
from netkf.linalg.structs import Size
from netkf.plants.laws import GridLaws, grid_time
from netkf.plants.transitions import Transitions
from netkf.rng.normals import Normals

BLOCK = 64  # steps drawn at once, or a multiple of it


class PathStep(NamedTuple):
    """One stretch of the path: times, states at its ends, (2, n) moments, and the cubic of what
    noise added: (3, n) coefficients of u, u^2 and u^3 of the share u of the stretch, times its
    seconds.
    """

    start: float
    end: float
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray


class Block(NamedTuple):
    """Some steps S as K pieces, since a step is cut where a state is probed: ``start, end`` (K,), x
    at both (K, n), ``moments`` (K, 2, n), ``cubic`` (K, 3, n) and whose ``step`` (K,) each is;
    ``ends`` (S,) of the steps. What is random comes for B paths at once, (B, K, ...).
    """

    start: FloatArray
    end: FloatArray
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray
    step: np.ndarray
    ends: FloatArray

    def of(self, k: int) -> Block:
        """Return the block of path ``k``, without the first axis."""
        return self._replace(
            x_start=self.x_start[k],
            x_end=self.x_end[k],
            moments=self.moments[k],
            cubic=self.cubic[k],
        )


class Cuts(NamedTuple):
    """Increasing ``times`` at which steps are cut, and the normals of each run."""

    times: FloatArray
    normals: Normals


class DiffusionPaths:
    """The paths of B runs, which are cut at the same times: ``start`` (B, n), the normals of each,
    and where states are sampled or probed (``cuts``, one after the other).

    With ``frame_steps``, states are local: they start again from zero every so many steps, so that
    a piece may end at a state that the next one does not start from.

    Each path is to the last bit what it is alone, and however many steps are drawn at once;
    ``start`` is overwritten.
    """

    def __init__(
        self,
        laws: GridLaws,
        start: FloatArray,
        normals: Normals,
        cuts: Sequence[Cuts],
        frame_steps: int | None = None,
    ) -> None:
        self.laws, self._normals, self._cuts = laws, normals, cuts
        self.frame_steps = frame_steps
        self._x, self._drawn = start, 0

    def following(self, blocks: int = 1, most: int | None = None) -> Block:
        """Return the next steps of the sensing grid, ``blocks`` times BLOCK, but ``most``
        at most.
        """
        laws, (count, n) = self.laws, self._x.shape
        total = blocks * BLOCK if most is None else min(most, blocks * BLOCK)
        x_start, x_end = (np.empty((count, total, n)) for _ in range(2))
        moments, cubic = np.empty((count, total, 2, n)), np.empty((count, total, 3, n))
        # One kernel call draws all steps of all runs: end, moments and cubic.
        fill_steps(
            self._normals.draw((total, 3 * n)),
            laws.noise_factor,
            laws.response,
            laws.period,
            0 if self.frame_steps is None else self.frame_steps,
            self._drawn,
            self._x,
            np.empty(3 * n),
            (x_start, x_end, moments, cubic),
        )
        # Grid times from their index, and not as sums of periods.
        times = laws.grid(self._drawn, total + 1)
        self._drawn += total
        block = Block(
            start=times[:-1],
            end=times[1:],
            x_start=x_start,
            x_end=x_end,
            moments=moments,
            cubic=cubic,
            step=np.arange(total),
            ends=times[1:],
        )
        # One kind of cuts after the other: probed states are drawn given those that were sampled.
        for cuts in self._cuts:
            first, last = np.searchsorted(cuts.times, times[[0, -1]], side="right")
            due = cuts.times[first:last]
            # A time at the end of a piece needs no cut.
            inside = due[~np.isin(due, block.end)]
            if len(inside):
                block = self._cut(block, inside, cuts.normals)
        return block

    def _cut(self, block: Block, times: FloatArray, source: Normals) -> Block:
        """Return the block with pieces that also end at the ``times``, inside its
        own pieces.
        """
        # The piece that each time is in.
        owners = np.searchsorted(block.end, times)
        normals = source.draw((len(times), 3 * self.laws.n))
        # A piece with m cuts becomes m + 1 rows, copies of it at first.
        counts = 1 + np.bincount(owners, minlength=len(block.end))
        # A piece cut twice is cut at the first time, and what is left of it at the second.
        turn = np.arange(len(times)) - np.searchsorted(owners, owners)
        which = np.repeat(np.arange(len(block.end)), counts)
        pieces = Block(
            start=block.start[which],
            end=block.end[which],
            x_start=np.take(block.x_start, which, axis=1),
            x_end=np.take(block.x_end, which, axis=1),
            moments=np.take(block.moments, which, axis=1),
            cubic=np.take(block.cubic, which, axis=1),
            step=block.step[which],
            ends=block.ends,
        )
        # Row in which a time's piece is at its turn, and the end of the copies of its piece.
        firsts = np.cumsum(counts) - counts
        rows, stops = firsts[owners] + turn, (firsts + counts)[owners]
        # The k-th cuts of all pieces at once.
        for k in range(int(turn.max()) + 1):
            chosen = turn == k
            # The conditional law depends on the length and on the cut alone: equal ones are drawn
            # together. Rounding unites lengths that differ by rounding.
            lengths = np.round(pieces.end[rows[chosen]] - pieces.start[rows[chosen]], 12)
            lefts = np.round(times[chosen] - pieces.start[rows[chosen]], 12)
            laws = np.unique(np.stack([lengths, lefts]), axis=1, return_inverse=True)[1].ravel()
            for law in range(int(laws.max()) + 1):
                same = np.flatnonzero(chosen)[laws == law]
                self._split(
                    pieces, rows[same], stops[same], times[same], np.take(normals, same, axis=1)
                )
        return pieces

    def _split(
        self,
        pieces: Block,
        rows: np.ndarray,
        stops: np.ndarray,
        times: FloatArray,
        normals: FloatArray,
    ) -> None:
        """Draw the paths at ``times`` given the pieces in ``rows``, all of one length and cut at
        the same position, and divide each with the rows after it up to its ``stops``.
        """
        laws = self.laws
        length = float(pieces.end[rows[0]] - pieces.start[rows[0]])
        left = float(times[0] - pieces.start[rows[0]])
        split_pieces(
            rows,
            stops,
            normals,
            *laws.conditional_law(length, left),
            np.stack([laws.responses(gap) for gap in (length, left, length - left)]),
            np.array([length, left]),
            np.empty((4, 3 * laws.n)),
            (pieces.x_start, pieces.x_end, pieces.moments, pieces.cubic),
        )
        pieces.end[rows] = times
        for row, stop, time in zip(rows.tolist(), stops.tolist(), times.tolist(), strict=True):
            pieces.start[row + 1 : stop] = time


@kernel(compact=True)
def split_pieces(
    rows: IntArray,
    stops: IntArray,
    normals: FloatArray,
    gain: FloatArray,
    spread: FloatArray,
    responses: FloatArray,
    lengths: FloatArray,
    work: FloatArray,
    pieces: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Cut the pieces in ``rows`` (K,) of B paths, all of one length and at the same position, from
    standard normals (B, K, 3 n): a row becomes the part before the cut, and those after it up to
    its ``stops`` (K,) the rest. ``pieces`` are states at their starts and ends, moments and cubics
    as in ``fill_steps``. ``gain`` and ``spread`` (3 n, 3 n) are GridLaws.conditional_law,
    ``responses`` (3, 3, n, n) those over the whole, the part before and the rest, ``lengths`` (2,)
    the seconds of the first two; ``work`` (4, 3 n) is scratch.
    """
    x_start, x_end, moments, _ = pieces
    n, length, left = x_start.shape[2], lengths[0], lengths[1]
    known, free, noise, values = work[0], work[1], work[2], work[3]
    share = left / length
    for run in range(len(normals)):
        for k in range(len(rows)):
            row = rows[k]
            for i in range(n):
                known[i] = x_end[run, row, i]
                known[n + i], known[2 * n + i] = moments[run, row, 0, i], moments[run, row, 1, i]
            # Law of (state, moments) at the cut given (end, moments) of the piece, all without the
            # response to its start.
            add_response(free, known, -1.0, responses, 0, x_start, run, row)
            for e in range(3 * n):
                mean = deviation = 0.0
                for c in range(3 * n):
                    mean += free[c] * gain[e, c]
                    deviation += normals[run, k, c] * spread[e, c]
                noise[e] = mean + deviation
            # Add the response to the start again.
            add_response(values, noise, 1.0, responses, 1, x_start, run, row)
            set_part(pieces, run, row, left, values, noise)
            # Moments of the rest: the whole's P_1 is (share - 1) + share P_1 on the left part and
            # share + (1 - share) P_1 on the right one.
            for i in range(n):
                x_end[run, row, i] = values[i]
                first, slope = values[n + i], values[2 * n + i]
                plain = known[n + i] - first
                tilted = known[2 * n + i] - (share - 1.0) * first - share * slope
                known[n + i], known[2 * n + i] = plain, (tilted - share * plain) / (1.0 - share)
            # The rest starts from the state at the cut: what noise adds there is what the response
            # to that state leaves.
            add_response(free, known, -1.0, responses, 2, x_end, run, row)
            for after in range(row + 1, stops[k]):
                for i in range(n):
                    x_start[run, after, i] = values[i]
                set_part(pieces, run, after, length - left, known, free)


@kernel(compact=True)
def add_response(
    out: FloatArray,
    given: FloatArray,
    sign: float,
    responses: FloatArray,
    which: int,
    x: FloatArray,
    run: int,
    row: int,
) -> None:
    """Write ``given`` (3 n,) plus ``sign`` times the response of state and moments to the state
    x[run, row].
    """
    n = x.shape[2]
    for m in range(3):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += x[run, row, j] * responses[which, m, i, j]
            out[m * n + i] = given[m * n + i] + sign * total


@kernel(compact=True)
def set_part(
    pieces: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    run: int,
    row: int,
    length: float,
    values: FloatArray,
    noise: FloatArray,
) -> None:
    """Write the moments in ``values`` (3 n,) and the cubic of what ``noise`` (3 n,) adds to the end
    and to the moments of a piece of ``length`` seconds.
    """
    _, _, moments, cubic = pieces
    n = moments.shape[3]
    for i in range(n):
        moments[run, row, 0, i], moments[run, row, 1, i] = values[n + i], values[2 * n + i]
        fill_cubic(cubic, run, row, i, length, noise[i], noise[n + i], noise[2 * n + i])


@kernel(inlined=True)
def fill_cubic(
    cubic: FloatArray,
    run: int,
    row: int,
    i: int,
    length: float,
    end: float,
    plain: float,
    tilted: float,
) -> None:
    """Write the coefficients of u, u^2 and u^3, times ``length`` seconds, of the cubic that is 0 at
    u = 0, ``end`` at u = 1 and has these moments over the seconds.
    """
    # c = 6 M_0 - 10 S_1 + 3 e, 30 S_1 - 6 M_0 - 12 e, 10 e - 20 S_1 of e = length end, the moment
    # M_0 with P_0 and S_1 = 3 M_1: its integrals with P_0 and P_1 are M_0 and M_1.
    last, slope = length * end, 3.0 * tilted
    cubic[run, row, 0, i] = 6.0 * plain - 10.0 * slope + 3.0 * last
    cubic[run, row, 1, i] = 30.0 * slope - 6.0 * plain - 12.0 * last
    cubic[run, row, 2, i] = 10.0 * last - 20.0 * slope


@kernel
def fill_steps(
    normals: FloatArray,
    factor: FloatArray,
    response: FloatArray,
    period: float,
    frame_steps: int,
    drawn: int,
    x: FloatArray,
    noise: FloatArray,
    out: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Write S steps of B paths from standard normals (B, S, 3 n): states at their starts and ends
    (B, S, n), moments (B, S, 2, n) and cubics (B, S, 3, n). ``x`` (B, n) is the state before the
    steps and then after them; ``drawn`` steps were before. A frame begins every ``frame_steps``
    steps, 0: never. ``factor`` (3 n, 3 n) and ``response`` (3, n, n) are those of GridLaws;
    ``noise`` (3 n,) is scratch.
    """
    x_start, x_end, moments, cubic = out
    runs, steps, n = x_start.shape
    for run in range(runs):
        for k in range(steps):
            # What noise adds to the end of the step and to its two moments.
            for i in range(3 * n):
                noise[i] = 0.0
                for j in range(i + 1):
                    noise[i] += factor[i, j] * normals[run, k, j]
            for i in range(n):
                end, plain, tilted = noise[i], noise[n + i], noise[2 * n + i]
                fill_cubic(cubic, run, k, i, period, end, plain, tilted)
                x_start[run, k, i] = x[run, i]
                x_end[run, k, i] = end
                moments[run, k, 0, i], moments[run, k, 1, i] = plain, tilted
                # Response to the start of the step, exact for all three.
                for j in range(n):
                    x_end[run, k, i] += response[0, i, j] * x[run, j]
                    moments[run, k, 0, i] += response[1, i, j] * x[run, j]
                    moments[run, k, 1, i] += response[2, i, j] * x[run, j]
            # A frame ends with this step: the next one starts from 0 in its own coordinates.
            rebased = frame_steps > 0 and (drawn + k + 1) % frame_steps == 0
            for i in range(n):
                x[run, i] = 0.0 if rebased else x_end[run, k, i]


class DiffusionPath:
    """The path of one run, asked for step by step."""

    def __init__(self, paths: DiffusionPaths, horizon: float = 0.0) -> None:
        self.laws, self.period, self._paths = paths.laws, paths.laws.period, paths
        self.frame_times = self._frame_times(horizon)
        self._moves = Transitions(self.laws.A, self.laws.B) if len(self.frame_times) else None
        self._frame, self._origin = 0, np.zeros(self.laws.n)  # of the present frame, at its start
        self._block: Block | None = None
        self._first = self._piece = 0  # of the present step, and the one last asked for
        self._step, self._step_end = PathStep(0.0, 0.0, *[np.empty(0)] * 4), 0.0

    def grid(self, k: int) -> float:
        """Return the time (seconds) of the k-th point of the sensing grid."""
        return grid_time(self.period, k)

    def _at(self, time: float) -> PathStep:
        """Return the piece that ``time`` is in; it may lie before the last one asked for, in its
        step.
        """
        # Blocks are drawn when they are asked for: the path is never longer than it has to be.
        while self._block is None or time > self._block.ends[-1]:
            self._block, self._first, self._piece = self._paths.following().of(0), 0, -1
        # From the first piece of the present step, since a node may lag behind the last call.
        block, k = self._block, self._first
        while block.end[k] < time:
            k += 1
        if k != self._piece:
            self._piece = k
            self._step = PathStep(*(part[k] for part in block[:6]))
            self._step_end = float(block.ends[block.step[k]])
            self._first = int(np.searchsorted(block.step, block.step[k]))
        return self._step

    def step_end(self) -> float:
        """Return the time (seconds) at which the sensing step that was last asked for ends."""
        return self._step_end

    def moments(self, start: float, end: float) -> FloatArray:
        """Return moments (2, n) of x over ``[start, end]``, which lies inside one sensing step and
        not in one before the last one asked for.
        """
        step = self._at(end)
        if start >= step.start:
            return state_moments(self.laws, step, start, end)
        return self._over_pieces(start, end)

    def _over_pieces(self, start: float, end: float) -> FloatArray:
        """Return ``moments`` over several pieces of a step, which samples of other nodes
        may cut.
        """
        block, k, gap = self._block, self._piece, end - start
        assert block is not None
        total = np.zeros((2, self.laws.n))
        while True:
            step = PathStep(*(part[k] for part in block[:6]))
            first, last = max(start, step.start), min(end, step.end)
            part = state_moments(self.laws, step, first, last)
            # P_1 of the whole interval on this part of it.
            middle = ((first - start) - (end - last)) / gap
            # Moment by moment: P_0 adds up, P_1 is shifted by the middle and scaled by the share.
            total[0] += part[0]
            total[1] += middle * part[0] + (last - first) / gap * part[1]
            if step.start <= start:
                return total
            k -= 1

    def _frame_times(self, horizon: float) -> FloatArray:
        """Return the times in seconds below the horizon at which a new moving frame begins."""
        steps = self._paths.frame_steps
        if steps is None:
            return np.empty(0)
        count = int(horizon / (steps * self.period)) + 2
        times = np.array([self.grid(steps * k) for k in range(1, count)])
        return np.asarray(times[times < horizon])

    def local(self, time: float) -> FloatArray:
        """Return x (n,) in the present frame, on the sensing grid or at a time sampled or probed,
        not before the last one asked for; 0 at a frame time.
        """
        step = self._at(time)
        assert time in (step.start, step.end), f"{time} is neither on the grid nor probed"
        # The step that ends at the frame time still has coordinates of the frame before.
        if self._begins_frame(time):
            return np.zeros(self.laws.n)
        return step.x_end if time == step.end else step.x_start

    def _begins_frame(self, time: float) -> bool:
        """Return True if a frame begins at this time."""
        k = int(np.searchsorted(self.frame_times, time))
        return k < len(self.frame_times) and bool(self.frame_times[k] == time)

    def rebase(self, k: int) -> FloatArray:
        """Return the shift (n,) to subtract from estimates at ``frame_times[k]``, k = 0, 1, ...:
        the local state just before.
        """
        time = float(self.frame_times[k])
        step = self._at(time)
        start = 0.0 if k == 0 else float(self.frame_times[k - 1])
        with np.errstate(over="ignore", invalid="ignore"):
            # The new origin: the old one moved to this time, plus the local state.
            self._origin = self._move_origin(time - start) + step.x_end
        self._frame = k + 1
        return step.x_end

    def _move_origin(self, gap: float) -> FloatArray:
        """Return the origin (n,) of the present frame ``gap`` seconds after its start."""
        # An origin at 0 stays there.
        if self._moves is None or not self._origin.any():
            return self._origin
        return apply(self._moves.transitions(np.array([gap]))[0], self._origin)

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,), as ``local``; ``rebase`` must have been called for all frame
        times so far.
        """
        x = self.local(time)
        if not self._frame:
            return x
        with np.errstate(over="ignore", invalid="ignore"):
            return x + self._move_origin(time - float(self.frame_times[self._frame - 1]))

    state = absolute


def state_moments(laws: GridLaws, step: PathStep, start: float, end: float) -> FloatArray:
    """Return moments (2, n) of x over ``[start, end]`` inside a step."""
    n = len(step.x_start)
    # The moments of a whole piece were drawn from their exact law: no cubic is needed.
    if start == step.start and end == step.end:
        return step.moments
    since, gap, length = start - step.start, end - start, step.end - step.start
    table = laws.course_table
    size, out, course = np.zeros(n), np.empty((2, n)), np.empty((len(table), table.shape[2]))
    fill_course(size, course, table, length, step.x_start[None], step.cubic[None], 0)
    fill_state_moments(size, out, course, since, gap, length, np.zeros(2 * course.shape[1]))
    return out


@kernel(fused=True)
def fill_course(
    size: Size,
    out: FloatArray,
    table: FloatArray,
    length: float,
    x_start: FloatArray,
    cubic: FloatArray,
    k: int,
) -> None:
    """Write piece ``k`` of ``length`` seconds as a polynomial in the share u of the piece:
    coefficients (D, W >= 2 n) such that ``u sum_d u^d out[d, :n]`` is the integral of x up to
    there, and ``u^2 sum_d u^d out[d, n : 2 n]`` that of x times the share; ``table`` is
    GridLaws.course_table.
    """
    n, power = len(size), length
    for d in range(len(out)):
        for j in range(0, out.shape[1], LANES):
            # The response to the state at the start: exp(A s) x by powers of s = u length.
            total = spread(MANY, 0.0)
            for i in range(n):
                total += x_start[k, i] * load(MANY, table, d, i, j)
            total *= power
            # What noise adds is a cubic.
            if 0 < d < 4:
                for i in range(n):
                    total += cubic[k, d - 1, i] * load(MANY, table, d, n + i, j)
            store(MANY, out, d, j, total)
        power *= length


@kernel(fused=True)
def fill_state_moments(
    size: Size,
    out: FloatArray,
    course: FloatArray,
    since: float,
    gap: float,
    length: float,
    scratch: FloatArray,
) -> None:
    """Write the moments (2, n) of x over ``gap`` seconds from ``since`` on in a piece of ``length``
    seconds into ``out``; ``course`` is what ``fill_course`` wrote for it, ``scratch`` has two rows
    of it.
    """
    first, share = since / length, gap / length
    fill_integrals(scratch, course, first, first + share)
    fill_moments_between(ONE, size, out, scratch, course.shape[1], first, share)


@kernel(inlined=True, fused=True)
def fill_integrals(out: FloatArray, course: FloatArray, first: float, last: float) -> None:
    """Write both integrals of a ``course`` (D, W) up to the share ``first`` of the piece into
    ``out[:W]``, and up to ``last`` behind them.
    """
    width, top = course.shape[1], len(course) - 1
    # Horner's rule, of both at a time: each waits for the product before.
    for j in range(0, width, LANES):
        early = late = load(MANY, course, top, j)
        for d in range(top - 1, -1, -1):
            terms = load(MANY, course, d, j)
            early = terms + first * early
            late = terms + last * late
        store(MANY, out, j, first * early)
        store(MANY, out, width + j, last * late)


@kernel(inlined=True, fused=True)
def fill_moments_between(
    lanes: Lanes,
    size: Size,
    out: FloatArray,
    integrals: FloatArray,
    width: int,
    first: Any,
    share: Any,
) -> None:
    """Write the moments (2, n, L) of x over a ``share`` of a piece that begins at its share
    ``first``, from what ``fill_integrals`` wrote, (2 W, L) with W = ``width``.
    """
    n, last = len(size), first + share
    # P_1 of the gap is (u - middle) times 2 over its share of the piece.
    middle, scale = first + 0.5 * share, 2.0 / share
    for i in range(n):
        plain = load(lanes, integrals, width + i) - load(lanes, integrals, i)
        late, early = load(lanes, integrals, width + n + i), load(lanes, integrals, n + i)
        store(lanes, out, 0, i, plain)
        store(lanes, out, 1, i, scale * (last * late - first * early - middle * plain))
