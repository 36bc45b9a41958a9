"""Whole batches of runs through the event loop: draws of all runs in, samples of all runs out.

One Simulation serves all runs of a batch. For each run its draws are copied into the arrays of the
Simulation, ``event_loop`` simulates it, and its samples are copied out: one compiled call for all
of them.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from netkf.engines.compiled.event_loop import DONE, WANT_CUTS, WANT_MESSAGES, event_loop
from netkf.engines.compiled.state import NODE, Simulation, add_messages
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct, struct_at
from netkf.rng.numbers import NormalZiggurat, next_normal, normal_ziggurat
from netkf.trace.schema import CODES

DIVERGED = CODES["diverged"]


class BatchArrays(Struct):
    """What R runs are drawn from, and what they leave.

    Filters at time 0: ``nodes`` (F,), xhat (F, n), root (F, n, n). The paths, in K pieces: x_start
    and x_stop (R, K, n), moments (R, K, 2, n), cubic (R, K, 4, n). S sensors: ``noise`` (R, S,
    steps, 2, p) and the streams of their normals for cuts, ``cuts`` (R S, 4). Ticks of run r are
    t, entity, at from ``first[r]`` up to ``first[r + 1]``, the outcomes of what they send ``delay``
    from ``first_delay[r]`` up to ``first_delay[r + 1]``.

    Samples: ``shown_xhat`` (R, T, F, n), ``shown_P`` (R, T, F, n, n), ``lengths`` (R,); ``counts``
    (R, len(KINDS)) of events; ``diverged`` (R,) is 1 where the last sample is not finite. Each
    filter stands for ``carriers`` nodes.
    """

    nodes: np.ndarray
    xhat: FloatArray
    root: FloatArray
    x_start: FloatArray
    x_stop: FloatArray
    moments: FloatArray
    cubic: FloatArray
    noise: FloatArray
    cuts: np.ndarray
    t: FloatArray
    entity: IntArray
    at: IntArray
    delay: FloatArray
    first: IntArray
    first_delay: IntArray
    shown_xhat: FloatArray
    shown_P: FloatArray
    lengths: IntArray
    counts: IntArray
    diverged: IntArray
    carriers: int


ALONE = -1
"""Instead of the number of a run: the Simulation is no run of a batch."""


def simulate_batch(state: Simulation, batch: BatchArrays) -> None:
    """Simulate all runs of a batch up to the horizon, or until an estimate is no longer finite."""
    run, begun = 0, False
    while run < len(batch.lengths):
        run = int(simulate_runs(state, batch.memory, run, begun, normal_ziggurat()))
        # The run goes on where it stopped for a larger pool. Ticks, path and noise are there up to
        # the horizon; only cuts and messages have no known number.
        if run < len(batch.lengths):
            add_messages(state, state.most_messages)
            begun = True


def run_alone(state: Simulation) -> int:
    """``event_loop`` for one run, by the kernel that batches use: it is compiled only once."""
    return int(simulate_runs(state, _no_batch().memory, ALONE, True, normal_ziggurat()))


@cache
def _no_batch() -> BatchArrays:
    """A batch without runs."""
    sizes = {
        **{"nodes": (0,), "xhat": (0, 0), "root": (0, 0, 0), "x_start": (0, 0, 0)},
        **{"x_stop": (0, 0, 0), "moments": (0,) * 4, "cubic": (0,) * 4, "noise": (0,) * 5},
        **{"cuts": (0, 4), "t": (0,), "entity": (0,), "at": (0,), "delay": (0,), "first": (0,)},
        **{"first_delay": (0,), "shown_xhat": (0,) * 4, "shown_P": (0,) * 5, "lengths": (0,)},
        **{"counts": (0, 0), "diverged": (0,)},
    }
    kinds: dict[str, np.dtype] = {"nodes": NODE, "cuts": np.dtype(np.uint64)}
    integers = ("entity", "at", "first", "first_delay", "lengths", "counts", "diverged")
    kinds.update(dict.fromkeys(integers, np.dtype(np.int64)))
    arrays: dict[str, Any] = {
        name: np.zeros(size, dtype=kinds.get(name, np.dtype(np.float64)))
        for name, size in sizes.items()
    }
    return BatchArrays(**arrays, carriers=1)


@kernel
def simulate_runs(
    state: Simulation, batch_memory: IntArray, run: int, begun: bool, ziggurat: NormalZiggurat
) -> int:
    """Simulate the runs of a batch from ``run`` on, which has ``begun`` before or not; returns the
    run that needs a larger pool of messages first, or the number of runs. For ALONE:
    ``event_loop``.
    """
    # numba identifies an array much faster than a struct.
    if run == ALONE:
        return event_loop(state, None, None)
    return simulate_from(state, struct_at(batch_memory, BatchArrays), run, begun, ziggurat)


@kernel
def simulate_from(
    state: Simulation, batch: BatchArrays, run: int, begun: bool, ziggurat: NormalZiggurat
) -> int:
    """``simulate_runs`` for kernels."""
    while run < len(batch.lengths):
        if not begun:
            begin(state, batch, run, ziggurat)
        begun = False
        if not simulate_run(state, batch, run, ziggurat):
            return run
        run += 1
    return run


@kernel
def simulate_run(state: Simulation, batch: BatchArrays, run: int, ziggurat: NormalZiggurat) -> bool:
    """Simulate one run to its end; False where it needs a larger pool of messages first."""
    wanted = -1
    while wanted != DONE:
        wanted = event_loop(state, None, None)
        # Samples first: after one that is not finite, whatever the loop wants is of no use any
        # more.
        if not keep(state, batch, run):
            return True
        if wanted == WANT_CUTS:
            refill_cuts(state, batch, run, ziggurat)
        elif wanted == WANT_MESSAGES:
            return False
    return True


@kernel
def begin(state: Simulation, batch: BatchArrays, run: int, ziggurat: NormalZiggurat) -> None:
    """Put the Simulation to time 0 of a run and copy its draws there."""
    reset_filters(state, batch)
    reset_messages(state)
    # Positions in the arrays of draws: the run begins at the first frame, piece, tick and sample.
    state.frame_at = state.piece = state.course = state.grid_at = state.wake_at = 0
    state.instant_at = 0
    state.tick_at = state.probe_at = state.row = state.samples = 0
    for kind in range(len(state.counts)):
        state.counts[kind] = 0
    copy_path(state, batch, run)
    copy_ticks(state, batch, run)
    copy_noise(state, batch, run)
    refill_cuts(state, batch, run, ziggurat)


@kernel
def reset_filters(state: Simulation, batch: BatchArrays) -> None:
    """Estimates and covariances at time 0."""
    n = batch.xhat.shape[1]
    for h in range(len(batch.nodes)):
        state.nodes[h] = batch.nodes[h]
        for i in range(n):
            # Entry by entry: an assignment of arrays costs seconds of compiling.
            state.xhat[h, i] = batch.xhat[h, i]
            for j in range(n):
                state.root[h, i, j] = batch.root[h, i, j]


@kernel
def reset_messages(state: Simulation) -> None:
    """No message is on its way; all of the pool is free."""
    for w in range(len(state.ways)):
        state.ways[w].messages = 0
    # Chain the whole pool into the list of free messages.
    for m in range(len(state.pool)):
        state.pool[m].next = m + 1
    # The heap needs no reset: only its first ``flying`` entries count.
    state.free = state.flying = state.order = state.receivers = state.absorbing = 0
    state.free_count, state.mail_time = len(state.pool), 0.0


@kernel
def copy_path(state: Simulation, batch: BatchArrays, run: int) -> None:
    """The pieces of the path; their times are the same in all runs."""
    path, n = state.path, batch.x_start.shape[2]
    for k in range(batch.x_start.shape[1]):
        for i in range(n):
            path.x_start[k, i], path.x_stop[k, i] = (
                batch.x_start[run, k, i],
                batch.x_stop[run, k, i],
            )
            for m in range(2):
                path.moments[k, m, i] = batch.moments[run, k, m, i]
            for c in range(4):
                path.cubic[k, c, i] = batch.cubic[run, k, c, i]


@kernel
def copy_ticks(state: Simulation, batch: BatchArrays, run: int) -> None:
    """Ticks and outcomes; the arrays have space for the longest run, and no tick comes after the
    last one.
    """
    ticks, first, last = state.ticks, batch.first[run], batch.first[run + 1]
    for k in range(last - first):
        ticks.t[k] = batch.t[first + k]
        ticks.entity[k], ticks.at[k] = batch.entity[first + k], batch.at[first + k]
    # Ticks of a longer run before this one must not happen again.
    for k in range(last - first, len(ticks.t)):
        ticks.t[k] = np.inf
    begin = batch.first_delay[run]
    for k in range(batch.first_delay[run + 1] - begin):
        ticks.delay[k] = batch.delay[begin + k]


@kernel
def copy_noise(state: Simulation, batch: BatchArrays, run: int) -> None:
    """The noise of all steps; no step is begun and no normals for cuts are left."""
    sensing = state.sensing
    for s in range(len(sensing.rows)):
        # No step begun (-1), and all normals of the run before count as used, so that refill_cuts()
        # draws.
        sensing.step[s], sensing.used[s] = -1, sensing.normals.shape[1]
        for k in range(batch.noise.shape[2]):
            for m in range(2):
                for i in range(sensing.rows[s]):
                    sensing.noise[s, k, m, i] = batch.noise[run, s, k, m, i]


@kernel
def refill_cuts(state: Simulation, batch: BatchArrays, run: int, ziggurat: NormalZiggurat) -> None:
    """Draw new normals for cuts where they are used up."""
    # Streams are numbered run by run, sensor by sensor.
    sensing, stream = state.sensing, run * len(state.sensing.rows)
    for s in range(len(sensing.rows)):
        # Refill only what is used up: a stream then gives the numbers that it would give a run
        # alone.
        if sensing.used[s] == sensing.normals.shape[1]:
            sensing.used[s] = 0
            for k in range(sensing.normals.shape[1]):
                for m in range(2):
                    for i in range(sensing.rows[s]):
                        sensing.normals[s, k, m, i] = next_normal(batch.cuts, stream + s, ziggurat)


@kernel
def keep(state: Simulation, batch: BatchArrays, run: int) -> bool:
    """Copy the samples that were taken into the batch, up to the first that is not finite; False
    where there is such a one. What happened after it did not happen.
    """
    # Samples are kept from the time after those that an earlier call has copied.
    taken, first = state.samples, state.probe_at - state.samples
    state.samples = 0
    for k in range(taken):
        broken = copy_sample(state, batch, run, first + k, k)
        batch.lengths[run] = first + k + 1
        # The counts are those at the broken sample, not those at the stop of the loop.
        if broken > 0:
            for kind in range(batch.counts.shape[1]):
                batch.counts[run, kind] = state.shown.counts[k, kind]
            # One filter may stand for several nodes (pooled), each of which has diverged.
            batch.counts[run, DIVERGED] += broken * batch.carriers
            batch.diverged[run] = 1
            return False
    for kind in range(batch.counts.shape[1]):
        batch.counts[run, kind] = state.counts[kind]
    return True


@kernel
def copy_sample(state: Simulation, batch: BatchArrays, run: int, t: int, k: int) -> int:
    """Copy sample k to time t of the run; returns how many filters are not finite.

    A covariance is ``S S'``, so that it is positive semidefinite where it is finite.
    """
    shown, n, broken = state.shown, batch.xhat.shape[1], 0
    for h in range(len(batch.nodes)):
        finite = True
        # Finiteness is enough here, because P = S S' cannot be indefinite.
        for i in range(n):
            value = shown.xhat[k, h, i]
            batch.shown_xhat[run, t, h, i] = value
            finite = finite and np.isfinite(value)
            for j in range(n):
                value = shown.P[k, h, i, j]
                batch.shown_P[run, t, h, i, j] = value
                finite = finite and np.isfinite(value)
        if not finite:
            broken += 1
    return broken
