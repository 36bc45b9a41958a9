"""Batches of runs: where each begins, and its results.

One Simulation holds the draws of all runs and space for all of their samples.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from netkf.engines.compiled.state import NODE, Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct
from netkf.trace.schema import DIVERGED, KINDS


class BatchArrays(Struct):
    """Initial data and results of R runs.

    nodes, xhat, root : filters at time 0, (N,), (N, n) and (N, n, n)
    first, first_delay : (R + 1,), run r has the ticks ``first[r]`` to ``first[r + 1]`` - 1, whose
                         outcomes begin at ``first_delay[r]``
    first_instant : (R,), where the samples of sensors of each run begin
    x, error : true states at the T sample times (R, T, n), and x - xhat (R, T, N, n)
    lengths, counts : number of samples (R,), and of events by kind (R, len(KINDS))
    diverged : (R,), 1 if the last sample is not finite
    carriers : number of nodes that share one filter, if filters are pooled
    has_bits : whether the arrival bits of ticks are already filled in
    """

    nodes: np.ndarray
    xhat: FloatArray
    root: FloatArray
    first: IntArray
    first_delay: IntArray
    first_instant: IntArray
    x: FloatArray
    error: FloatArray
    lengths: IntArray
    counts: IntArray
    diverged: IntArray
    carriers: int
    has_bits: int


@cache
def no_batch() -> BatchArrays:
    """Return a batch of no runs, for a kernel that serves batches and single runs."""
    no_runs = np.zeros(0, dtype=np.int64)
    return BatchArrays(
        nodes=np.zeros(0, dtype=NODE),
        xhat=np.zeros((0, 0)),
        root=np.zeros((0, 0, 0)),
        first=no_runs,
        first_delay=no_runs,
        first_instant=no_runs,
        x=np.zeros((0, 0, 0)),
        error=np.zeros((0, 0, 0, 0)),
        lengths=no_runs,
        counts=np.zeros((0, len(KINDS)), dtype=np.int64),
        diverged=no_runs,
        carriers=1,
        has_bits=0,
    )


@kernel
def begin_run(state: Simulation, batch: BatchArrays, run: int) -> None:
    """Set the indices of ``state`` to time 0 of run number ``run`` of a batch, its counts to 0, and
    forget the polynomials of its path.
    """
    # ``path.known`` (G, C) belongs to the G runs that are simulated together: take this run's row.
    state.run, cached = run, run - state.first_run
    state.frame_at = state.piece = state.grid_at = state.wake_at = 0
    state.instant_at = batch.first_instant[run]
    state.tick_at, state.ticks_stop = batch.first[run], batch.first[run + 1]
    state.first_delay = batch.first_delay[run]
    state.probe_at = state.row = state.samples = 0
    for kind in range(len(state.counts)):
        state.counts[kind] = 0
    # -1 is the number of no piece: entries left by the previous run must not be found.
    for course in range(state.path.known.shape[1]):
        state.path.known[cached, course] = -1


@kernel
def reset_filters(state: Simulation, batch: BatchArrays, first: int) -> None:
    """Reset the filters of a run to time 0: the rows of ``state`` from ``first`` on."""
    n = batch.xhat.shape[1]
    for h in range(len(batch.nodes)):
        state.nodes[h] = batch.nodes[h]
        state.now[first + h] = 0.0
        for i in range(n):
            # Entry by entry: an assignment of arrays costs seconds of compiling.
            state.xhat[first + h, i] = batch.xhat[h, i]
            for j in range(n):
                state.root[first + h, i, j] = batch.root[h, i, j]


@kernel
def reset_messages(state: Simulation) -> None:
    """Remove all messages of ``state``, and number those to come from 0."""
    for w in range(len(state.directions)):
        state.directions[w].messages = 0
    # Chain the whole pool into the list of free messages.
    for m in range(len(state.pool)):
        state.pool[m].next = m + 1
    # The heap needs no reset: only its first ``in_flight`` entries count.
    state.first_free = state.in_flight = state.order = state.receivers = state.absorbing = 0
    state.free_count, state.inbox_time = len(state.pool), 0.0


@kernel
def finish(state: Simulation, batch: BatchArrays, run: int) -> None:
    """Store the results of run number ``run`` in ``batch``: up to its first sample that is not
    finite, if it has ``diverged``, or to the end.
    """
    buffer = state.buffer
    fill_errors(batch, buffer.xhat, run, state.samples)
    for kind in range(batch.counts.shape[1]):
        batch.counts[run, kind] = state.counts[kind]
    for k in range(state.samples):
        batch.lengths[run] = k + 1
        diverged = count_diverged_filters(state, batch, run, k)
        if diverged > 0:
            # The counts are those at the broken sample, not those at the end.
            for kind in range(batch.counts.shape[1]):
                batch.counts[run, kind] = buffer.counts[run, k, kind]
            # A pooled filter stands for several nodes, each of which has diverged.
            batch.counts[run, DIVERGED] += diverged * batch.carriers
            batch.diverged[run] = 1
            return


@kernel
def fill_errors(batch: BatchArrays, xhat: FloatArray, run: int, samples: int) -> None:
    """Write x - xhat of the first ``samples`` samples of a run into ``batch.error``."""
    # No origin moves in these runs: local and absolute states are the same.
    x, error = batch.x, batch.error
    for k in range(samples):
        for h in range(error.shape[2]):
            for i in range(error.shape[3]):
                error[run, k, h, i] = x[run, k, i] - xhat[run, k, h, i]


@kernel
def count_diverged_filters(state: Simulation, batch: BatchArrays, run: int, k: int) -> int:
    """Return how many filters are not finite in sample ``k`` of a run, see ``sound_mask``."""
    xhat, P, n, diverged = state.buffer.xhat, state.buffer.P, len(state.size), 0
    # Where the truth is unknown it is nan from the beginning.
    truth_known = not np.isnan(batch.x[run, 0, 0])
    for h in range(len(state.nodes)):
        # P = S S' cannot be indefinite, so only finiteness is tested: 0 times a number that is not
        # finite is nan.
        total = 0.0
        for i in range(n):
            total += 0.0 * xhat[run, k, h, i]
            if truth_known:
                total += 0.0 * (batch.error[run, k, h, i] * batch.error[run, k, h, i])
            for j in range(n):
                total += 0.0 * P[run, k, h, i, j]
        diverged += total != 0.0
    return diverged
