"""Quantities that means over time hide: worst instants, quantiles, ages, connection, traffic."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.lives import lifetimes
from netkf.network.radio import Energy, Radio
from netkf.rng.streams import Streams
from netkf.runs.connectivity import ConnectivitySink
from netkf.runs.outcomes import Transmissions
from netkf.scenario.scenario import Scenario
from netkf.trace.ages import Ages
from netkf.trace.recorder import Sink

NETWORK = ("mean_age", "worst_age", "time_connected", "transmissions", "bytes", "joules")
"""Quantities of the events of a run."""
MAX_PAIRS = 10_000
"""Nodes times sensors of the largest network whose ages are followed without being asked for."""


def sample_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the quantities of samples."""
    metrics = scenario.metrics
    quantiles = (f"quantile_{100.0 * order:.10g}" for order in metrics.quantiles)
    return ("worst_instant", *quantiles, *(() if metrics.level is None else ("time_above",)))


def ensemble_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the quantities of ensembles."""
    return sample_names(scenario) + (NETWORK if scenario.metrics.network else ())


def quantities_in(row: Mapping[str, Any]) -> list[str]:
    """Return the names of the quantities that a row of summary.json has, in their order."""
    of_samples = ("worst_instant", "time_above")
    return [
        name
        for name in row
        if not name.endswith("_se")
        and (name in of_samples or name.startswith("quantile_") or name in NETWORK)
    ]


def with_network(scenario: Scenario) -> Scenario:
    """Return a scenario all of whose runs, also those of ensembles, have the quantities NETWORK."""
    return dataclasses.replace(
        scenario, metrics=dataclasses.replace(scenario.metrics, network=True)
    )


def sample_quantities(scenario: Scenario, squares: FloatArray) -> FloatArray:
    """Return ``sample_names`` (..., N + 1, K) of nodes and of all, from squared errors or traces
    (..., T, N) of T samples; T may be 0.
    """
    metrics, (*runs, count, nodes) = scenario.metrics, squares.shape
    found = np.full((*runs, nodes + 1, len(sample_names(scenario))), np.nan)
    if not count:
        return found
    by_node = np.sort(np.moveaxis(squares, -2, -1), axis=-1)
    parts = [(slice(None), by_node)]  # one node is all
    if nodes > 1:
        # From the unsorted squares: numpy sorts what is in some order already far more slowly.
        pooled = np.sort(squares.reshape(*runs, 1, nodes * count), axis=-1)
        parts = [(slice(-1), by_node), (slice(-1, None), pooled)]
    for rows, ordered in parts:
        # Where a sample is nan, it is the last one, and all quantities are.
        last, part = ordered[..., -1:], found[..., rows, :]
        places = np.array([1.0, *metrics.quantiles]) * (ordered.shape[-1] - 1)
        below = places.astype(int)
        with np.errstate(invalid="ignore"):
            low, high = (
                np.sqrt(ordered[..., np.minimum(k, ordered.shape[-1] - 1)])
                for k in (below, below + 1)
            )
            values = np.where(low == high, low, low + (places - below) * (high - low))
            if metrics.level is not None:
                above = (ordered > metrics.level * metrics.level).mean(axis=-1, keepdims=True)
                values = np.concatenate([values, above], axis=-1)
        part[:] = np.where(np.isnan(last), np.nan, values)
    return found


def traffic(scenario: Scenario, transmissions: Transmissions) -> FloatArray:
    """Return NETWORK (N + 1, 6) of nodes and of all, but for ages and connection, which are nan."""
    found = np.full((len(scenario.nodes) + 1, len(NETWORK)), np.nan)
    radio, energy = scenario.network.radio or Radio(), scenario.network.energy or Energy()
    found[:-1, 3:] = 0.0
    for phase, counts in transmissions.by_phase(scenario.nodes):
        sizes = [
            scenario.message_size(node, phase) if count else 0.0
            for node, count in zip(scenario.nodes, counts, strict=True)
        ]
        spent = {
            size: energy.joules_per_packet * radio.frames(size) + energy.joules_per_byte * size
            for size in set(sizes)
        }
        costs = [(1.0, size, spent[size]) for size in sizes]
        found[:-1, 3:] += np.array(counts)[:, None] * np.array(costs)
    found[-1, 3:] = found[:-1, 3:].sum(axis=0)
    if scenario.network.energy is None:
        found[:, 5] = np.nan
    return found


class NetworkSink(Sink):
    """Follows ages, connection and traffic of run ``replica`` of ``seed``.

    ``transmissions`` may be counted by another sink.
    """

    thread_safe: ClassVar[bool] = True

    def __init__(
        self, scenario: Scenario, seed: int, replica: int, sent: Transmissions | None = None
    ) -> None:
        self._scenario = scenario
        self.connectivity = ConnectivitySink(scenario, lifetimes(scenario, Streams(seed, replica)))
        self._counts_own = sent is None
        self._transmissions = sent or Transmissions()
        self._ages = _make_ages(scenario)
        self._last = 0.0

    def events(self, rows: np.ndarray) -> None:
        """Follow a block of EVENT rows."""
        if self._counts_own:
            self._transmissions.add(rows)
        if self._ages is not None:
            self._ages.add(rows)
        self.connectivity.events(rows)
        self._last = float(rows["t"][-1]) if len(rows) else self._last

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Look at the links at T samples."""
        self.connectivity.states(t, x, xhat, P, error)

    def values(self, complete: bool) -> FloatArray:
        """Return NETWORK (N + 1, 6), nan if missing; an incomplete run ends with its last event."""
        scenario = self._scenario
        found = traffic(scenario, self._transmissions)
        if self._ages is not None:
            mean, worst = self._ages.finish(scenario.horizon if complete else self._last)
            known = np.isfinite(mean).any(axis=1)
            found[:-1][known, 0] = np.nanmean(mean[known], axis=1)
            found[:-1][known, 1] = np.nanmax(worst[known], axis=1)
            if known.any():
                found[-1, :2] = np.nanmean(found[:-1, 0]), np.nanmax(found[:-1, 1])
        self.connectivity.finish()
        found[:, 2] = self.connectivity.shares()
        return found


def has_ages(scenario: Scenario) -> bool:
    """Return True if nodes can hear of the readings of others, whose ages runs then have."""
    timing = scenario.node_filter.timing
    alone = len(scenario.nodes) < 2 or not scenario.sensing_nodes
    return timing.talks and not timing.pooled and not alone


def _make_ages(scenario: Scenario) -> Ages | None:
    """Return the ages of a run; None if nodes do not talk or nobody asks for those of so many."""
    sources = scenario.sensing_nodes
    asked = scenario.metrics.network or len(scenario.nodes) * len(sources) <= MAX_PAIRS
    if not asked or not has_ages(scenario):
        return None
    return Ages(
        scenario.nodes,
        sorted(sources),
        scenario.topology.directions,
        sorted(scenario.increment_sensors),
        scenario.forgetful_nodes,
        scenario.node_filter.analysis.swaps,
        scenario.node_filter.analysis.tells_estimates,
        lambda nodes, times: _read_at(scenario, nodes, times),
    )


def _read_at(scenario: Scenario, nodes: np.ndarray, times: FloatArray) -> FloatArray:
    """Return when readings used at ``times`` (K,) were taken, nan where tables have none."""
    if not scenario.slotted:
        return times
    plant = scenario.slot_plant
    slots = plant.slots_of(times)
    found = plant.slot_times(slots)
    for node in set(nodes.tolist()):
        records = [scenario.sensors[p.entry].record for p in scenario.placed_sensors[node]]
        if None not in records:
            read = [slot for one in records if one for slot in one.slots(node, plant.period)]
            found[(nodes == node) & ~np.isin(slots, read)] = math.nan
    return found


def quantity_rows(
    names: Sequence[str], values: FloatArray, error: FloatArray | None = None
) -> list[dict[str, float | None]]:
    """Return ``values`` (N + 1, K) of ``names`` as rows of summary.json, and ``error`` if any."""
    columns = [*names, *(f"{name}_se" for name in (() if error is None else names))]
    table = values if error is None else np.concatenate([values, error], axis=1)
    rows = (dict(zip(columns, row, strict=True)) for row in table.tolist())
    return [{name: None if math.isnan(x) else x for name, x in row.items()} for row in rows]
