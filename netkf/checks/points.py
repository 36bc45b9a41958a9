"""Times and nodes at which promises are checked."""

from __future__ import annotations

import numpy as np

from netkf.checks.evidence import Assumption
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.scenario.scenario import Scenario

HORIZON_SHARES = (0.125, 0.25, 0.5, 1.0)
POOLED_ERRORS, MAX_POOLED = 192, 24
"""Errors of all nodes at all times of a run that are whitened together, and times of a run at which
they are looked at: many times of one run say as much about a covariance as many runs.
"""
MAX_NODES = 60
"""Nodes of a network of which all samples are kept."""
MIN_SAMPLED, MAX_SAMPLED = 20, 50
"""Nodes that are sampled in a larger network."""
MAX_ENTRIES = 6400
"""Entries of the covariances that are kept of one sample of a larger network."""


def check_slots(scenario: Scenario) -> tuple[int, ...]:
    """Return the slots at which promises are checked: small ones, half of the horizon and its end.

    A filtered estimate at the horizon itself has seen exchanges that are not in the trace, so its
    last slot is the one before.
    """
    period = scenario.slot_plant.period
    last = max(1, int(np.floor(scenario.horizon / period + 1e-9)))
    if scenario.slotted and not scenario.hosted.predicts:
        last = max(1, int(np.ceil(scenario.horizon / period - 1e-9)) - 1)
    return tuple(sorted({min(2, last), min(5, last), max(1, last // 2), last}))


def check_times(scenario: Scenario) -> list[float]:
    """Return the times at which promises are checked, in seconds: those of :func:`check_slots`, or
    an eighth, a quarter, half and all of the horizon.
    """
    if scenario.slotted:
        return [round(scenario.slot_plant.period * slot, 12) for slot in check_slots(scenario)]
    return [scenario.horizon * share for share in HORIZON_SHARES]


def errors_at_once(scenario: Scenario) -> int:
    """Return the number of errors of all filters together at one time."""
    filters = 1 if scenario.filter.algorithm.pooled else len(scenario.nodes)
    return filters * scenario.plant.n


def probe_times(scenario: Scenario) -> list[float]:
    """Return the times at which runs are sampled: those of :func:`check_times`, and others spread
    evenly over the horizon at which only all errors together are looked at.
    """
    checked = check_times(scenario)
    count = min(MAX_POOLED, POOLED_ERRORS // errors_at_once(scenario))
    even = np.linspace(0.0, checked[-1], max(count, 0) + 1)[1:].tolist()
    if scenario.slotted:
        period = scenario.slot_plant.period
        even = [round(period * max(1, round(time / period)), 12) for time in even]
    # Further times replace none of those that rows are about.
    others = sorted(set(even) - set(checked))
    spare = min(max(count - len(checked), 0), len(others))
    chosen = np.linspace(0, len(others) - 1, spare).round().astype(int).tolist()
    return sorted({*checked, *(others[k] for k in chosen)})


def checked_samples(scenario: Scenario, times: FloatArray) -> IntArray:
    """Return the indices of :func:`check_times` among the ``times`` of a run."""
    wanted = np.array(check_times(scenario))
    return np.asarray(np.argmin(np.abs(times[None] - wanted[:, None]), axis=1), dtype=np.int64)


def sampled_indices(scenario: Scenario) -> IntArray:
    """Return the indices (W,) of the nodes whose samples are kept.

    They are all nodes of a small network, and evenly chosen ones of a network with more than
    MAX_NODES, fewer if covariances are large.
    """
    nodes, n = len(scenario.nodes), scenario.plant.n
    if nodes <= MAX_NODES:
        return np.arange(nodes)
    count = int(np.clip(MAX_ENTRIES // n**2, MIN_SAMPLED, MAX_SAMPLED))
    return np.round(np.linspace(0, nodes - 1, count)).astype(np.int64)


def sampled_nodes(scenario: Scenario) -> list[int]:
    """Return the ids of the nodes whose samples are kept."""
    return [scenario.nodes[k] for k in sampled_indices(scenario).tolist()]


def sampling_note(scenario: Scenario) -> str:
    """Return a note on the nodes of a large network that are left out; else empty."""
    count, nodes = len(sampled_indices(scenario)), len(scenario.nodes)
    if count == nodes:
        return ""
    return (
        f"looked at {count} of {nodes:,} nodes, evenly chosen: samples of all are kept in networks "
        f"of at most {MAX_NODES} nodes"
    )


def all_sampled(scenario: Scenario) -> Assumption:
    """Return the assumption that samples of all nodes are kept, which promises about the whole
    network need.
    """
    note = sampling_note(scenario)
    evidence = note or "samples of all nodes are kept"
    return Assumption("every node is watched", "netkf", not note, evidence)
