"""The path of a diffusion in one run, drawn block by block of steps of the sensing grid.

The path is drawn exactly on the sensing grid ``t_k = k h``, over whose steps sensors read
increments: each step gives ``x(t_{k+1})`` and the two moments of x over the step, ``int x dt``
(*plain* in the code) and ``int x P_1 dt`` (*tilted*) with the Legendre polynomial P_1, -1 .. 1 over
the step (linalg/legendre). All come from one stream and do not depend on the network.

A filter that has an event between grid points, such as a tick or a message, needs the moments over
part of a step. There the path is approximated by the response to the state at the grid point plus
the cubic that agrees with the end and the two moments of the step; the error in a reading is of
third order in h, less than 1e-4 h^3 of the noise intensity. Where a state is *sampled* (read by a
sensor at an instant) or *probed* (recorded by the run) off the grid, the step is cut into pieces
beforehand: state and moments at the cut are drawn from their exact law given the step, from
separate streams, sample times first.

On an unstable plant states may be *local*: relative to an origin that is moved to the state at
regular times. The interval between two moves is a *frame* (``truth`` says why).

Some kernels take a ``size`` of which only the length n, the number of states, matters: it can be
known when they are compiled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, ONE, Lanes, load, spread, store
from netkf.linalg.portable import apply
from netkf.linalg.structs import Size
from netkf.plants.laws import GridLaws
from netkf.plants.transitions import Transitions
from netkf.plants.truth import absolute_states
from netkf.rng.normals import Normals

BLOCK = 64  # steps drawn at once, or a multiple of it


class PathStep(NamedTuple):
    """One piece of the path: a sensing step, or a part of one that was cut.

    ``start, end`` are in seconds, ``x_start, x_end`` (n,) the states there and ``moments`` (2, n)
    the integrals of x and of x P_1 over the piece (P_1: Legendre polynomial). ``cubic`` (3, n)
    stands for the contribution of the noise to x: coefficients of u, u^2 and u^3, times the length
    in seconds, where u is the share of the piece that has passed.
    """

    start: float
    end: float
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray


class StepBlock(NamedTuple):
    """S consecutive sensing steps of B paths, cut into K >= S pieces at the sample and probe times.

    Of the pieces: ``start, end`` (K,) in seconds, states ``x_start, x_end`` (B, K, n), ``moments``
    (B, K, 2, n) and ``cubic`` (B, K, 3, n) as in PathStep, and the index ``step`` (K,) of the step
    that each belongs to. ``ends`` (S,) are the end times of the steps.

    The first six fields are those of PathStep, in its order. The block of a single path (``of``)
    has states, moments and cubics without the first axis.
    """

    start: FloatArray
    end: FloatArray
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray
    step: np.ndarray
    ends: FloatArray

    def of(self, k: int) -> StepBlock:
        """Return the block of path ``k`` alone, without the axis of the B paths."""
        return self._replace(
            x_start=self.x_start[k],
            x_end=self.x_end[k],
            moments=self.moments[k],
            cubic=self.cubic[k],
        )

    def piece(self, k: int) -> PathStep:
        """Return piece ``k`` of the block of a single path."""
        return PathStep(*(array[k] for array in self[: len(PathStep._fields)]))


class DiffusionPaths:
    """The paths of B runs from x(0) = ``start`` (B, n), drawn with the ``normals`` of each run.

    All are cut at the same times, (T,) and increasing: those of the first of ``cuts``, then those
    of the second given the first, with streams of normals for the states there. ``start`` is
    overwritten: it holds the state at the end of the last step drawn.

    With ``frame_steps`` states are local: they restart from zero after every ``frame_steps`` steps,
    so that a piece may end at a state from which the next one does not start. Other laws may hold
    from some steps on, ``later`` by the number of the first; a block ends where they begin.
    ``forcing`` is a response to an input that is added to all paths (``response``), or None.

    A path has the same bits alone or among others, and however many steps one call draws.
    """

    def __init__(
        self,
        laws: GridLaws,
        start: FloatArray,
        normals: Normals,
        cuts: Sequence[tuple[FloatArray, Normals]],
        frame_steps: int | None = None,
        later: Mapping[int, GridLaws] = MappingProxyType({}),
        forcing: Any = None,
    ) -> None:
        self.laws, self._normals, self._cuts, self._later = laws, normals, cuts, later
        self._forcing = forcing
        self.frame_steps = frame_steps
        self._x, self._drawn = start, 0

    def frame_times(self, horizon: float) -> FloatArray:
        """Return the times (F,) in seconds, below the ``horizon``, at which a frame begins."""
        steps, period = self.frame_steps, self.laws.period
        if steps is None:
            return np.empty(0)
        count = int(horizon / (steps * period)) + 2
        times = self.laws.time_grid.snap(period * (steps * np.arange(1, count)))
        return np.asarray(times[times < horizon])

    def following(self, blocks: int = 1, most: int | None = None) -> StepBlock:
        """Return the next ``blocks`` times BLOCK steps, at most ``most`` and up to where other laws
        begin, with their cuts; ``laws`` are theirs.
        """
        self.laws = laws = self._later.get(self._drawn, self.laws)
        paths, n = self._x.shape
        changes = (step - self._drawn for step in self._later if step > self._drawn)
        limits = blocks * BLOCK, blocks * BLOCK if most is None else most, *changes
        total = min(limits)
        x_start, x_end = (np.empty((paths, total, n)) for _ in range(2))
        moments, cubic = np.empty((paths, total, 2, n)), np.empty((paths, total, 3, n))
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
        block = StepBlock(
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
        for cut_times, cut_normals in self._cuts:
            first, last = np.searchsorted(cut_times, times[[0, -1]], side="right")
            block_times = cut_times[first:last]
            # A time at the end of a piece needs no cut.
            inside = block_times[block.end[np.searchsorted(block.end, block_times)] != block_times]
            if len(inside):
                block = self._cut(block, inside, cut_normals)
        return block if self._forcing is None else self._forced(block)

    def _forced(self, block: StepBlock) -> StepBlock:
        """Return the block with the response to an input, approximated as noise is in a piece."""
        laws, snap = self.laws, self.laws.time_grid.snap
        start, pieces = self._forcing.over_pieces(block.start, block.end, laws.time_grid)
        gaps, index = np.unique(snap(block.end - block.start), return_inverse=True)
        responses = np.stack([laws.responses(gap) for gap in gaps.tolist()])[index]
        # What is not the response to the state at the start of a piece, (K, 3, n).
        driven = pieces - apply(responses, start[:, None])
        cubic = np.zeros((1, len(start), 3, laws.n))
        for k, length in enumerate(block.end - block.start):
            for i in range(laws.n):
                fill_cubic(cubic, 0, k, i, length, *driven[k, :, i])
        return block._replace(
            x_start=block.x_start + start,
            x_end=block.x_end + pieces[:, 0],
            moments=block.moments + pieces[:, 1:],
            cubic=block.cubic + cubic,
        )

    def _cut(self, block: StepBlock, times: FloatArray, source: Normals) -> StepBlock:
        """Return the block cut further at C ``times`` (C,), drawn from ``source``."""
        # owners: the index of the piece that contains each time.
        owners = np.searchsorted(block.end, times)
        normals = source.draw((len(times), 3 * self.laws.n))
        # A piece with m cuts becomes m + 1 rows of the arrays, copies of it at first.
        counts = 1 + np.bincount(owners, minlength=len(block.end))
        parents = np.repeat(np.arange(len(block.end)), counts)
        pieces = StepBlock(
            start=block.start[parents],
            end=block.end[parents],
            x_start=np.take(block.x_start, parents, axis=1),
            x_end=np.take(block.x_end, parents, axis=1),
            moments=np.take(block.moments, parents, axis=1),
            cubic=np.take(block.cubic, parents, axis=1),
            step=block.step[parents],
            ends=block.ends,
        )
        # A piece with several cuts is cut at the first time, then its remainder at the second, ...
        stops, laws = np.cumsum(counts)[owners].tolist(), []
        rows, lengths = np.empty((len(times), 2), dtype=np.int64), np.empty((len(times), 2))
        for cut, (owner, stop) in enumerate(zip(owners.tolist(), stops, strict=True)):
            row, time = owner + cut, float(times[cut])
            start = float(pieces.start[row])
            rows[cut], lengths[cut] = (row, stop), (float(pieces.end[row]) - start, time - start)
            laws.append(self.laws.cut_law(*lengths[cut].tolist()))
            pieces.end[row] = pieces.start[row + 1 : stop] = time
        gains, factors, responses = (np.array(part) for part in zip(*laws, strict=True))
        work = np.empty((4, normals.shape[2]))
        parts = pieces.x_start, pieces.x_end, pieces.moments, pieces.cubic
        split_pieces(rows, normals, gains, factors, responses, lengths, work, parts)
        return pieces


@kernel
def split_pieces(
    rows: IntArray,
    normals: FloatArray,
    gains: FloatArray,
    factors: FloatArray,
    responses: FloatArray,
    lengths: FloatArray,
    work: FloatArray,
    pieces: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Make C cuts of the pieces of B paths one after the other, as ``split_piece`` makes one.

    rows    (C, 2) the row that is cut, and the row before which its remainder ends
    normals (B, C, 3 n) standard normal numbers; the other arguments are those of each cut
    """
    for cut in range(len(rows)):
        row, stop, gain, response = rows[cut, 0], rows[cut, 1], gains[cut], responses[cut]
        of_cut = lengths[cut]
        split_piece(row, stop, cut, normals, gain, factors[cut], response, of_cut, work, pieces)


@kernel
def split_piece(
    row: int,
    stop: int,
    number: int,
    normals: FloatArray,
    gain: FloatArray,
    factor: FloatArray,
    responses: FloatArray,
    lengths: FloatArray,
    work: FloatArray,
    pieces: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Cut the piece in ``row`` of B paths in place, given its end and moments. The row becomes the
    part before the cut, and the rows after it up to ``stop`` the part after it.

    normals   (B, C, 3 n) standard normal numbers, of which this cut takes those with its ``number``
    gain      (3 n, 3 n) and ``factor`` (3 n, 3 n): GridLaws.conditional_law
    responses (3, 3, n, n) GridLaws.responses over the whole piece and the parts before and after
    lengths   (2,) seconds of the whole piece and of the part before the cut
    work      (4, 3 n) scratch
    pieces    the first arrays of a StepBlock but its times

    Vectors of 3 n numbers hold a state x and its plain and tilted moments, one after the other.
    """
    x_start, x_end, moments, _ = pieces
    n, length, before = x_start.shape[2], lengths[0], lengths[1]
    whole, noise, cut_noise, cut = work[0], work[1], work[2], work[3]
    share = before / length
    for run in range(len(normals)):
        # whole = (end, moments) of the piece
        for i in range(n):
            whole[i] = x_end[run, row, i]
            whole[n + i], whole[2 * n + i] = moments[run, row, 0, i], moments[run, row, 1, i]
        # noise = whole - response to the start: the contribution of the noise
        add_response(noise, whole, -1.0, responses, 0, x_start, run, row)
        # cut_noise = gain noise + factor z: that contribution to (state, moments) at the cut, drawn
        # from its conditional law
        for e in range(3 * n):
            mean = deviation = 0.0
            for c in range(3 * n):
                mean += noise[c] * gain[e, c]
                deviation += normals[run, number, c] * factor[e, c]
            cut_noise[e] = mean + deviation
        # cut = cut_noise + response to the start: state at the cut and moments before it
        add_response(cut, cut_noise, 1.0, responses, 1, x_start, run, row)
        set_part(pieces, run, row, before, cut, cut_noise)
        # Moments after the cut, written to ``whole``. P_1 of the whole piece is (share - 1) + share
        # P_1 on the part before and share + (1 - share) P_1 on the part after, which is solved for
        # the moments after.
        for i in range(n):
            x_end[run, row, i] = cut[i]
            plain_before, tilted_before = cut[n + i], cut[2 * n + i]
            plain = whole[n + i] - plain_before
            tilted = whole[2 * n + i] - (share - 1.0) * plain_before - share * tilted_before
            whole[n + i], whole[2 * n + i] = plain, (tilted - share * plain) / (1.0 - share)
        # noise = whole - response to the state at the cut, where the part after starts
        add_response(noise, whole, -1.0, responses, 2, x_end, run, row)
        for after in range(row + 1, stop):
            for i in range(n):
                x_start[run, after, i] = cut[i]
            set_part(pieces, run, after, length - before, whole, noise)


@kernel
def add_response(
    out: FloatArray,
    values: FloatArray,
    sign: float,
    responses: FloatArray,
    which: int,
    x: FloatArray,
    run: int,
    row: int,
) -> None:
    """Write ``out`` = ``values`` + ``sign`` R x[run, row], both (3 n,), where R (3 n, n) is
    ``responses[which]``: the response of end state and moments to the state at the start.
    """
    n = x.shape[2]
    for m in range(3):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += x[run, row, j] * responses[which, m, i, j]
            out[m * n + i] = values[m * n + i] + sign * total


@kernel
def set_part(
    pieces: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    run: int,
    row: int,
    length: float,
    values: FloatArray,
    noise: FloatArray,
) -> None:
    """Set moments and cubic of the piece ``row`` of ``length`` seconds from its end state and
    moments, ``values`` (3 n,), and the contribution of the noise to them, ``noise`` (3 n,).
    """
    _, _, moments, cubic = pieces
    n = moments.shape[3]
    for i in range(n):
        moments[run, row, 0, i], moments[run, row, 1, i] = values[n + i], values[2 * n + i]
        fill_cubic(cubic, run, row, i, length, noise[i], noise[n + i], noise[2 * n + i])


@kernel(inlined=True)
def fill_cubic(
    cubic: FloatArray, run: int, row: int, i: int, gap: float, end: float, plain: float, tilt: float
) -> None:
    """Set ``cubic[run, row, :, i]``: the coefficients, times ``gap``, of u, u^2 and u^3 of the
    cubic that is 0 at u = 0 and ``end`` at u = 1, and has the moments ``plain`` and ``tilt``:
    what the noise contributed to x.
    """
    # With e = gap end, M_0 = plain and S_1 = 3 tilt these conditions give the coefficients
    # 6 M_0 - 10 S_1 + 3 e, 30 S_1 - 6 M_0 - 12 e and 10 e - 20 S_1.
    last, slope = gap * end, 3.0 * tilt
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
    """Write S sensing steps of B paths into ``out``: states at their starts and ends (B, S, n),
    moments (B, S, 2, n) and cubics (B, S, 3, n).

    normals     (B, S, 3 n) standard normal numbers
    factor      (3 n, 3 n) GridLaws.noise_factor: covariance root of end and moments of one step
    response    (3, n, n) GridLaws.response: their response to the state at the start
    period      length of a step in seconds
    frame_steps steps from one frame to the next; 0: no frames
    drawn       number of steps of these paths before this call
    x           (B, n) state before the steps, replaced by the one after them
    noise       (3 n,) scratch
    """
    x_start, x_end, moments, cubic = out
    runs, steps, n = x_start.shape
    for run in range(runs):
        for k in range(steps):
            # noise = factor z: the contribution of the noise to the end and to the two moments.
            # factor is lower triangular.
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
                # Plus the response to the start: end += e^{A h} x, and likewise the moments.
                for j in range(n):
                    x_end[run, k, i] += response[0, i, j] * x[run, j]
                    moments[run, k, 0, i] += response[1, i, j] * x[run, j]
                    moments[run, k, 1, i] += response[2, i, j] * x[run, j]
            # The next step starts from 0 in the coordinates of its own frame.
            rebased = frame_steps > 0 and (drawn + k + 1) % frame_steps == 0
            for i in range(n):
                x[run, i] = 0.0 if rebased else x_end[run, k, i]


class DiffusionPath:
    """The path of one run: states and moments at times that do not decrease.

    Blocks of steps are drawn when a time beyond the last one is asked for. With frames, those that
    begin before the ``horizon`` (seconds) do so at ``frame_times`` (F,); the caller calls
    ``rebase`` at each of them, in their order.
    """

    def __init__(self, paths: DiffusionPaths, horizon: float = 0.0) -> None:
        self.period, self._paths = paths.laws.period, paths
        self.time_grid = paths.laws.time_grid
        self.frame_times = paths.frame_times(horizon)
        self._moves = Transitions(paths.laws.A, paths.laws.B) if len(self.frame_times) else None
        # The local states just before the frames so far began.
        self._offsets: list[FloatArray] = []
        self._block: StepBlock | None = None
        # Indices of the first piece of the present step, and of the piece last asked for; that
        # piece, of which there is none yet, and the end of its step.
        self._first = self._piece = 0
        self._step, self._step_end = PathStep(0.0, 0.0, *[np.empty(0)] * 4), 0.0

    @property
    def laws(self) -> GridLaws:
        """The laws of the steps that were drawn last."""
        return self._paths.laws

    def grid(self, k: int) -> float:
        """Return the time (seconds) of the k-th point of the sensing grid."""
        return self.laws.time_grid.instant(k * self.period)

    def _at(self, time: float) -> PathStep:
        """Return the piece that contains ``time``, in the sensing step last asked for or later."""
        while self._block is None or time > self._block.ends[-1]:
            self._block, self._first, self._piece = self._paths.following().of(0), 0, -1
        # Search from the first piece of the present step: nodes ask in any order within a step.
        block, k = self._block, self._first
        while block.end[k] < time:
            k += 1
        if k != self._piece:
            self._piece = k
            self._step = block.piece(k)
            self._step_end = float(block.ends[block.step[k]])
            self._first = int(np.searchsorted(block.step, block.step[k]))
        return self._step

    def step_end(self) -> float:
        """Return the time (seconds) at which the sensing step that was last asked for ends."""
        return self._step_end

    def moments(self, start: float, end: float) -> FloatArray:
        """Return the two moments (2, n) of x over [start, end] seconds, inside one sensing step."""
        step = self._at(end)
        if start >= step.start:
            return state_moments(self.laws, step, start, end)
        return self._over_pieces(start, end)

    def _over_pieces(self, start: float, end: float) -> FloatArray:
        """Return the moments (2, n) of x over [start, end], inside one step."""
        block, k, gap = self._block, self._piece, end - start
        assert block is not None
        total = np.zeros((2, self.laws.n))
        while True:
            piece = block.piece(k)
            first, last = max(start, piece.start), min(end, piece.end)
            moments = state_moments(self.laws, piece, first, last)
            # On [first, last] P_1 of [start, end] is middle + share P_1 of [first, last] with
            # share = (last - first) / gap.
            middle = ((first - start) - (end - last)) / gap
            total[0] += moments[0]
            total[1] += middle * moments[0] + (last - first) / gap * moments[1]
            if piece.start <= start:
                return total
            k -= 1

    def local(self, time: float) -> FloatArray:
        """Return x (n,) in the frame at a grid, sample or probe ``time``; 0 at frame times."""
        step = self._at(time)
        assert time in (step.start, step.end), f"{time} is neither on the grid nor probed"
        # The step that ends at the frame time is in coordinates of the previous frame.
        if (self.frame_times == time).any():
            return np.zeros(self.laws.n)
        return step.x_end if time == step.end else step.x_start

    def rebase(self, k: int) -> FloatArray:
        """Return the local state (n,) just before ``frame_times[k]``, the new origin."""
        x = self._at(float(self.frame_times[k])).x_end
        self._offsets.append(x)
        return x

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,) in the plant's coordinates at a ``time`` that ``local`` takes."""
        x = self.local(time)
        if self._moves is None or not self._offsets:
            return x
        begun, offsets = self.frame_times[: len(self._offsets)], np.stack(self._offsets)
        at = np.array([time])
        return np.asarray(absolute_states(self._moves, begun, offsets, at, x[None])[0])

    state = absolute


def state_moments(laws: GridLaws, step: PathStep, start: float, end: float) -> FloatArray:
    """Return the two moments (2, n) of x over [start, end] seconds inside a piece ``step``."""
    n = len(step.x_start)
    # The moments of a whole piece were drawn from their exact law; those of a part are approximated
    # by the cubic.
    if start == step.start and end == step.end:
        return step.moments
    since, gap, length = start - step.start, end - start, step.end - step.start
    # The integrals of x from the start of the piece as polynomials, then their differences.
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
    """Write the running integrals of x over piece ``k`` of ``length`` seconds as polynomials in u =
    (t - start) / length, 0 <= u <= 1.

    The coefficients ``out`` (D, W >= 2 n) are such that the integral of x from the start to u is
    ``u sum_d u^d out[d, :n]``, and that of x u is ``u^2 sum_d u^d out[d, n : 2 n]``: from them
    the moments of x over any part of the piece are computed. W is 2 n rounded up to whole lanes.

    x is e^{A s} x_start, s seconds after the start, plus a cubic for the contribution of the
    noise. ``x_start`` (K, n) are the states at the starts of K pieces and ``cubic`` (K, 3, n) the
    coefficients of u, u^2 and u^3, times the length. Rows 0 .. n - 1 of each ``table[d]``
    (D, 2 n, W) multiply the former, for a length of 1, and the other n rows the latter
    (GridLaws.course_table). ``size`` has length n.
    """
    n, power = len(size), length  # power = length^(d + 1)
    for d in range(len(out)):
        for j in range(0, out.shape[1], LANES):
            # Response to the state at the start: the term A^d / d! (u length)^d of e^{A s} x.
            total = spread(MANY, 0.0)
            for i in range(n):
                total += x_start[k, i] * load(MANY, table, d, i, j)
            total *= power
            # Contribution of the noise: a cubic without a term of degree 0.
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
    """Write the two moments of x over ``gap`` seconds, which begin ``since`` seconds after the
    start of a piece of ``length`` s, into ``out`` (2, n), from its ``course`` (D, W).
    """
    first, share = since / length, gap / length
    fill_integrals(scratch, course, first, first + share)
    fill_moments_between(ONE, size, out, scratch, course.shape[1], first, share)


@kernel(inlined=True, fused=True)
def fill_integrals(out: FloatArray, course: FloatArray, first: float, last: float) -> None:
    """Write the values of the W polynomials of a ``course`` at u = ``first`` and at u = ``last``
    into both halves of ``out`` (2 W,).
    """
    width, top = course.shape[1], len(course) - 1
    # Horner's rule at both points in one loop: each product waits for the one before it, so two
    # independent chains take the time of one.
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
    lanes: Lanes, size: Size, out: FloatArray, parts: FloatArray, width: int, first: Any, share: Any
) -> None:
    """Write the two moments of x over u in [first, first + share] of a piece into ``out`` (2, n,
    L), from the ``parts`` (2 W, L) that ``fill_integrals`` wrote; W = ``width``.
    """
    n, last = len(size), first + share
    # P_1 of the interval is (u - middle) scale. Row 0: int x. Row 1: int x P_1. The second integral
    # of the course still lacks a factor u: int x u = u (that value).
    middle, scale = first + 0.5 * share, 2.0 / share
    for i in range(n):
        plain = load(lanes, parts, width + i) - load(lanes, parts, i)
        late, early = load(lanes, parts, width + n + i), load(lanes, parts, n + i)
        store(lanes, out, 0, i, plain)
        store(lanes, out, 1, i, scale * (last * late - first * early - middle * plain))
