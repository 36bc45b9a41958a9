"""Which readings gates look at, and the events in slots that filters decide: readings that gates
refuse, and messages of few bits whose numbers are clipped.
"""

from __future__ import annotations

import numpy as np

from netkf.engines.compiled.slot_messages import SlotTimes
from netkf.engines.compiled.slot_setup import SlotSetup, slot_setup
from netkf.engines.compiled.slot_steps import StepTimes, step_times
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.scenario.scenario import Scenario
from netkf.trace.schema import CLIP, REFUSE, SEND, SENSE


def ungated_readings(scenario: Scenario) -> str | None:
    """Return which readings a gate judges that kernels do not; None without any."""
    algorithm, kernels = scenario.node_filter, scenario.node_filter.kernels
    if scenario.filter.gate is None:
        return None
    if algorithm.timing.talks and kernels is not None and kernels.sends_readings:
        return "readings that messages bring"
    if scenario.filter.gate.then == "inflate" and algorithm.timing.randomised:
        return "readings that a trigger weighs with the noise they had"
    if not scenario.has_linear_sensors and scenario.views is not None:
        return "nonlinear readings of nodes that estimate different states"
    if not scenario.has_linear_sensors and scenario.filter.linearise != "ekf":
        return "nonlinear readings at sigma points"
    return None


def with_refusals(
    scenario: Scenario, times: SlotTimes, refused: np.ndarray, rows: np.ndarray, before: IntArray
) -> tuple[np.ndarray, IntArray]:
    """Return EVENT ``rows`` (K,) of the first run with those of its gates, behind the readings of
    their slots, and the number of rows before each sample, of ``before`` (T,).
    """
    setup, (slots, numbers) = slot_setup(scenario), np.nonzero(refused[0, ..., 0])
    if not len(slots):
        return rows, before
    read = np.flatnonzero(rows["kind"] == SENSE)
    read_at = step_times(scenario, setup, times.first, len(times.start)).of_reading(setup)
    now = read_at[slots]
    # Behind the last reading of this time; slots of other rows have none.
    first, last = (np.searchsorted(rows["t"][read], now, side=side) for side in ("left", "right"))
    known = first < last
    made = np.zeros(int(known.sum()), dtype=rows.dtype)
    for name in ("peer", "message", "phase"):
        made[name] = -1
    made["t"], made["kind"], made["age"] = now[known], REFUSE, np.nan
    nodes = np.array([node for parts in setup.gated_parts for *_, node in parts])
    made["node"] = nodes[numbers[known]]
    places = read[last[known] - 1] + 1
    return insert_rows(rows, places, made, before)


def with_clips(
    setup: SlotSetup, times: StepTimes, clipped: np.ndarray, rows: np.ndarray, before: IntArray
) -> tuple[np.ndarray, IntArray]:
    """Return EVENT ``rows`` (K,) of the first run with those of clipped messages, behind the first
    ``send`` of each, and the number of rows before each sample, of ``before`` (T,).
    """
    slots, steps, nodes = np.nonzero(clipped[0, ..., 0])
    if not len(slots):
        return rows, before
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
    return insert_rows(rows, places[order], made[order], before)


def insert_rows(
    rows: np.ndarray, places: IntArray, made: np.ndarray, before_sample: IntArray
) -> tuple[np.ndarray, IntArray]:
    """Return ``rows`` (K,) with those ``made`` (M,) before the increasing ``places`` (M,) among
    them, and the number of rows before each sample, of ``before_sample`` (T,).
    """
    shifted = before_sample + np.searchsorted(places, before_sample, side="right")
    return np.insert(rows, places, made), shifted
