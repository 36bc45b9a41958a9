"""Times and nodes at which promises are checked."""

from __future__ import annotations

import numpy as np

from netkf.checks.evidence import Assumption
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.scenario.records import nodes_with_law
from netkf.scenario.scenario import Scenario

HORIZON_SHARES = (0.125, 0.25, 0.5, 1.0)
"""Times, as shares of the horizon, at which promises are checked in continuous time."""
POOLED_ERRORS, MAX_POOLED = 192, 24
"""Largest number of errors (nodes times states times sample times) of a run that are whitened
together, and largest number of sample times. Many times of one run tell as much about a covariance
as many runs.
"""
MAX_NODES = 60
"""Largest network of which the samples of all nodes are kept."""
MIN_SAMPLED, MAX_SAMPLED = 20, 50
"""Number of nodes that are sampled in a larger network."""
MAX_ENTRIES = 6400
"""Entries of the covariances that are kept of one sample of a larger network."""


def check_slots(scenario: Scenario) -> tuple[int, ...]:
    """Return the slots at which promises are checked: 2, 5, half of the horizon, its last one."""
    period = scenario.slot_plant.period
    # 1e-9: a horizon of a whole number of periods keeps its last slot despite rounding.
    last = max(1, int(np.floor(scenario.horizon / period + 1e-9)))
    if scenario.slotted and not scenario.node_filter.timing.predicts:
        last = max(1, int(np.ceil(scenario.horizon / period - 1e-9)) - 1)
    return tuple(sorted({min(2, last), min(5, last), max(1, last // 2), last}))


def check_times(scenario: Scenario) -> list[float]:
    """Return the times (s) at which promises are checked: of slots, or shares of the horizon."""
    if scenario.slotted:
        return [scenario.slot_plant.slot_time(slot) for slot in check_slots(scenario)]
    return [scenario.time_grid.instant(scenario.horizon * share) for share in HORIZON_SHARES]


def errors_at_once(scenario: Scenario) -> int:
    """Return the number of scalar errors of all filters at one time."""
    pooled = scenario.filter.algorithm.timing.pooled and scenario.views is None
    filters = 1 if pooled else len(scenario.nodes)
    return filters * scenario.width


def probe_times(scenario: Scenario) -> list[float]:
    """Return the times (s) at which runs are sampled: :func:`check_times`, and further ones for
    tests that pool errors of all times (POOLED_ERRORS, MAX_POOLED).
    """
    checked = check_times(scenario)
    count = min(MAX_POOLED, POOLED_ERRORS // errors_at_once(scenario))
    even = scenario.time_grid.snap(np.linspace(0.0, checked[-1], max(count, 0) + 1)[1:]).tolist()
    if scenario.slotted:
        plant = scenario.slot_plant
        even = [plant.slot_time(max(1, round(time / plant.period))) for time in even]
    # The further times are thinned evenly: with the checked ones there are ``count``.
    others = sorted(set(even) - set(checked))
    spare = min(max(count - len(checked), 0), len(others))
    chosen = np.linspace(0, len(others) - 1, spare).round().astype(int).tolist()
    return sorted({*checked, *(others[k] for k in chosen)})


def checked_samples(scenario: Scenario, times: FloatArray) -> IntArray:
    """Return the indices (K,) in the sample ``times`` (T,) at which promises are checked."""
    targets = np.array(check_times(scenario))
    return np.asarray(np.argmin(np.abs(times[None] - targets[:, None]), axis=1), dtype=np.int64)


def sampled_indices(scenario: Scenario) -> IntArray:
    """Return the nodes (W,) whose samples are kept: all with a known law, or spaced ones."""
    chosen, n = np.flatnonzero(nodes_with_law(scenario)), scenario.width
    if len(chosen) <= MAX_NODES:
        return chosen
    count = int(np.clip(MAX_ENTRIES // n**2, MIN_SAMPLED, MAX_SAMPLED))
    return chosen[np.round(np.linspace(0, len(chosen) - 1, count)).astype(np.int64)]


def sampled_nodes(scenario: Scenario) -> list[int]:
    """Return the ids of the nodes whose samples are kept."""
    return [scenario.nodes[k] for k in sampled_indices(scenario).tolist()]


def sampling_note(scenario: Scenario) -> str:
    """Return a text on the nodes of a large network whose samples are not kept; or empty."""
    count, nodes = len(sampled_indices(scenario)), len(scenario.nodes)
    if count == nodes:
        return ""
    return (
        f"looked at {count} of {nodes:,} nodes, evenly chosen: samples of all are kept in networks "
        f"of at most {MAX_NODES} nodes"
    )


def all_sampled(scenario: Scenario) -> Assumption:
    """Return the assumption that samples of all nodes are kept, as promises about all need."""
    note = sampling_note(scenario)
    evidence = note or "samples of all nodes are kept"
    return Assumption("every node is watched", "netkf", not note, evidence)
