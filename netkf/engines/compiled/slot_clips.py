"""Events in slots of messages of few bits, whose numbers are clipped."""

from __future__ import annotations

import numpy as np

from netkf.engines.compiled.gates import insert_rows
from netkf.engines.compiled.slot_messages import SEND
from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.engines.compiled.slot_steps import StepTimes
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.lanes import by_run
from netkf.trace.schema import CODES

CLIP = CODES["clip"]


def count_clips(clipped: np.ndarray, counted: np.ndarray, runs: int) -> IntArray:
    """Return the number of messages with clipped numbers in each run (R,), in the slots ``counted``
    (S,), as ``SlotPlan.clipped`` (B, S, E, N, L) says it.
    """
    messages = (clipped[:, counted] > 0).sum(axis=(1, 2, 3), dtype=np.int64)
    counts: IntArray = by_run(messages, runs)
    return counts


def with_clips(
    setup: SlotSetup,
    times: StepTimes,
    clipped: np.ndarray,
    rows: np.ndarray,
    before_sample: IntArray,
) -> tuple[np.ndarray, IntArray]:
    """Return EVENT ``rows`` (K,) of the first run with those of clipped messages, behind the first
    ``send`` of each, and the number of rows before each sample, of ``before_sample`` (T,).
    """
    slots, steps, nodes = np.nonzero(clipped[0, ..., 0])
    if not len(slots):
        return rows, before_sample
    phases, ids = np.array(setup.phases, dtype=np.int64), np.sort(setup.nodes)
    now = times.begin[slots, steps]
    moments = np.unique(now)

    def transmission(t: FloatArray, phase: IntArray, node: IntArray) -> IntArray:
        """Return a number that only the messages of one transmission share."""
        moment = np.searchsorted(moments, t) * (int(phases.max()) + 1) + phase
        return np.asarray(moment * len(ids) + np.searchsorted(ids, node))

    sends = np.flatnonzero((rows["kind"] == SEND) & np.isin(rows["t"], moments))
    known, first = np.unique(
        transmission(*(rows[name][sends] for name in ("t", "phase", "node"))), return_index=True
    )
    sought = transmission(now, phases[steps], setup.nodes[nodes])
    # Slots of other rows have none.
    there = np.isin(sought, known)
    made = np.zeros(int(there.sum()), dtype=rows.dtype)
    slots, steps, nodes = slots[there], steps[there], nodes[there]
    made["t"], made["phase"], made["node"] = now[there], phases[steps], setup.nodes[nodes]
    made["kind"], made["peer"], made["age"] = CLIP, -1, np.nan
    made["message"] = clipped[0, slots, steps, nodes, 0]
    places = sends[first[np.searchsorted(known, sought[there])]] + 1
    order = np.argsort(places)
    return insert_rows(rows, places[order], made[order], before_sample)
