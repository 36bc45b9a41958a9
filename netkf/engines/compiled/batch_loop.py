"""Whole batches of runs through the event loop, one after the other in one compiled call.

One Simulation has the draws of all runs and space for all of their samples.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from netkf.engines.compiled.event_loop import DONE, WANT_MESSAGES, event_loop
from netkf.engines.compiled.state import NODE, Simulation, add_messages
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct, struct_at
from netkf.trace.schema import CODES, KINDS

DIVERGED = CODES["diverged"]


class BatchArrays(Struct):
    """Where R runs begin, and how they end.

    Filters at time 0: ``nodes`` (N,), xhat (N, n), root (N, n, n). The ticks of run r are those
    from ``first[r]`` up to ``first[r + 1]``, and what they send has the outcomes from
    ``first_delay[r]`` on. ``lengths`` (R,): number of samples; ``counts`` (R, len(KINDS)) of
    events; ``diverged`` (R,) is 1 where the last sample is not finite. Each filter stands for
    ``carriers`` nodes. ``heard``: it is known already which messages arrive.
    """

    nodes: np.ndarray
    xhat: FloatArray
    root: FloatArray
    first: IntArray
    first_delay: IntArray
    lengths: IntArray
    counts: IntArray
    diverged: IntArray
    carriers: int
    heard: int


ALONE = -1
"""Instead of the number of a run: the Simulation is no run of a batch."""


def simulate_batch(state: Simulation, batch: BatchArrays) -> None:
    """Simulate all runs of a batch up to the horizon, or until an estimate is no longer finite."""
    run, begun = 0, False
    while run < len(batch.lengths):
        run = int(simulate_runs(state, batch.memory, run, begun))
        # The run goes on where it stopped for a larger pool: only messages have no known number.
        if run < len(batch.lengths):
            add_messages(state, state.most_messages)
            begun = True


def run_alone(state: Simulation) -> int:
    """Run ``event_loop`` for one run through the kernel of batches, which is then compiled only
    once.
    """
    return int(simulate_runs(state, no_batch().memory, ALONE, True))


@cache
def no_batch() -> BatchArrays:
    """Return a batch without runs."""
    none = np.zeros(0, dtype=np.int64)
    return BatchArrays(
        nodes=np.zeros(0, dtype=NODE),
        xhat=np.zeros((0, 0)),
        root=np.zeros((0, 0, 0)),
        first=none,
        first_delay=none,
        lengths=none,
        counts=np.zeros((0, len(KINDS)), dtype=np.int64),
        diverged=none,
        carriers=1,
        heard=0,
    )


@kernel
def simulate_runs(state: Simulation, batch_memory: IntArray, run: int, begun: bool) -> int:
    """Simulate the runs of a batch from ``run`` on, which has ``begun`` before or not; returns the
    run that needs a larger pool of messages first, or the number of runs. For ALONE:
    ``event_loop``.
    """
    # numba identifies an array much faster than a struct.
    if run == ALONE:
        return event_loop(state, None, None, None)
    return simulate_from(state, struct_at(batch_memory, BatchArrays), run, begun)


@kernel
def simulate_from(state: Simulation, batch: BatchArrays, run: int, begun: bool) -> int:
    """``simulate_runs`` for kernels."""
    while run < len(batch.lengths):
        if not begun:
            state.first_run = run
            reset_filters(state, batch, 0)
            reset_messages(state)
            begin(state, batch, run)
        begun, wanted = False, -1
        while wanted != DONE:
            wanted = event_loop(state, None, None, None)
            if wanted == WANT_MESSAGES:
                return run
        finish(state, batch, run)
        run += 1
    return run


@kernel
def begin(state: Simulation, batch: BatchArrays, run: int) -> None:
    """Set the Simulation to time 0 of a run."""
    state.run, place = run, run - state.first_run
    # Positions in the arrays of draws: the run begins at the first frame, piece, tick and sample.
    state.frame_at = state.piece = state.grid_at = state.wake_at = state.instant_at = 0
    state.tick_at, state.ticks_stop = batch.first[run], batch.first[run + 1]
    state.delays = batch.first_delay[run]
    state.probe_at = state.row = state.samples = 0
    for kind in range(len(state.counts)):
        state.counts[kind] = 0
    for course in range(state.path.known.shape[1]):
        state.path.known[place, course] = -1


@kernel
def reset_filters(state: Simulation, batch: BatchArrays, first: int) -> None:
    """Reset estimates and covariances to time 0, from place ``first`` on."""
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
    """Empty the network: no message is under way, all of the pool is free."""
    for w in range(len(state.directions)):
        state.directions[w].messages = 0
    # Chain the whole pool into the list of free messages.
    for m in range(len(state.pool)):
        state.pool[m].next = m + 1
    # The heap needs no reset: only its first ``flying`` entries count.
    state.free = state.flying = state.order = state.receivers = state.absorbing = 0
    state.free_count, state.inbox_time = len(state.pool), 0.0


@kernel
def finish(state: Simulation, batch: BatchArrays, run: int) -> None:
    """Record how a run ended: at its first sample that is not finite, if there is one, without what
    happened later.
    """
    buffer = state.buffer
    for kind in range(batch.counts.shape[1]):
        batch.counts[run, kind] = state.counts[kind]
    for k in range(state.samples):
        batch.lengths[run] = k + 1
        broken = count_broken_filters(state, run, k)
        if broken > 0:
            # The counts are those at the broken sample, not those at the end.
            for kind in range(batch.counts.shape[1]):
                batch.counts[run, kind] = buffer.counts[run, k, kind]
            # One filter may stand for several nodes (pooled), each of which has diverged.
            batch.counts[run, DIVERGED] += broken * batch.carriers
            batch.diverged[run] = 1
            return


@kernel
def count_broken_filters(state: Simulation, run: int, k: int) -> int:
    """Return the number of filters that are not finite in sample ``k`` of a run."""
    xhat, P, n, broken = state.buffer.xhat, state.buffer.P, len(state.size), 0
    for h in range(len(state.nodes)):
        # Finiteness is enough, because P = S S' cannot be indefinite; 0 times a number that is not
        # finite is nan.
        total = 0.0
        for i in range(n):
            total += 0.0 * xhat[run, k, h, i]
            for j in range(n):
                total += 0.0 * P[run, k, h, i, j]
        broken += total != 0.0
    return broken
