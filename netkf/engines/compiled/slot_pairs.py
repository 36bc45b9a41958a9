"""Readings in slots that are also about a block which their node does not estimate."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.blocks import block_numbers
from netkf.algorithms.kernels.pairs import Pairs, empty_pairs
from netkf.algorithms.kernels.run import ALIKE
from netkf.algorithms.translation import read_vector
from netkf.core.places import Place
from netkf.engines.compiled.nonlinear_rows import NonlinearSetup, has_known_h
from netkf.engines.compiled.own_sensors import reads_as_built_in
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario


class PairColumns:
    """The columns of a reading in the states of its filter and one block more."""

    def __init__(self, scenario: Scenario, entries: np.ndarray) -> None:
        """``entries`` (H, w) are those of the state that each filter estimates, -1 beyond."""
        self.entries, self.places = entries, scenario.layout.places
        self._n = scenario.plant.n
        self.numbers = block_numbers(scenario.node_infos)
        needs = scenario.node_filter.needs.blocks and scenario.views is not None
        self.width: int = entries.shape[1] + (max(p.n for p in self.places) if needs else 0)

    def other(self, h: int, support: np.ndarray) -> Place | None:
        """Return the block of the ``support`` (k,) of a reading that filter ``h`` has not."""
        outside = np.setdiff1d(support, self.entries[h])
        return next((p for p in self.places if len(outside) and outside[0] < p.first + p.n), None)

    def of_reading(self, h: int, sensor: Any, anchor: int) -> Place | None:
        """Return the block beside those of filter ``h`` that a reading is about."""
        if sensor.linear:
            support = np.flatnonzero(matrix_of(sensor, anchor, self._n).any(axis=0))
        else:
            support = sensor.support(self._n, sensor.nodes[0] if anchor < 0 else anchor)
        return self.other(h, support)

    def others(self, h: int, sensor: Any, node: int) -> dict[int, Place]:
        """Return by anchor the blocks beside those of filter ``h`` that a node's sensor reads."""
        found = {anchor: self.of_reading(h, sensor, anchor) for anchor in anchors_of(sensor, node)}
        return {anchor: place for anchor, place in found.items() if place is not None}

    def of(self, h: int, H: FloatArray, place: Place | None = None) -> FloatArray:
        """Return the columns (..., n) of H (..., N) of filter ``h``, and of a block behind them."""
        w, own = self.entries.shape[1], self.entries[h][self.entries[h] >= 0]
        made = np.zeros((*H.shape[:-1], self.width))
        made[..., : len(own)] = H[..., own]
        if place is not None:
            made[..., w : w + place.n] = H[..., place.entries]
        return made

    def number(self, place: Place | None) -> int:
        """Return the number of a block, -1 if no node estimates it."""
        return -1 if place is None else self.numbers.get(place.key, -1)


class SlotPair(NamedTuple):
    """One of at most so many readings of a slot: of filter ``h``, from ``row`` on of its reading,
    with the noise covariance ``R`` (p, p), of a ``sensor``. The other block is ``place``; of a
    record that of its row, which names an ``anchor``, else -1.
    """

    h: int
    row: int
    R: FloatArray
    sensor: Any
    anchor: int
    place: Place


class SlotPairs:
    """The readings of pairs of a scenario, in the order of their filters."""

    def __init__(self, scenario: Scenario, columns: PairColumns) -> None:
        self._scenario, self.columns = scenario, columns
        self.all: list[SlotPair] = []

    def others(self, s: Any) -> dict[int, Place]:
        """Return by anchor the blocks beside those of its filter that an AssignedSensor reads."""
        sensor: Any = self._scenario.located_sensors[s.placed_sensor.entry]
        return self.columns.others(s.estimator, sensor, s.node)

    def add(self, s: Any, row: int, others: dict[int, Place]) -> int:
        """Add an AssignedSensor, its first value in ``row``; return its first pair's number."""
        sensor: Any = self._scenario.located_sensors[s.placed_sensor.entry]
        anchor, place = next(iter(others.items()))
        first = len(self.all)
        for k in range(row, row + s.rows, len(s.R)):
            self.all.append(SlotPair(s.estimator, k, s.R, sensor, anchor, place))
        return first

    @cached_property
    def nonlinear(self) -> NonlinearSetup:
        """The tables of nonlinear pairs that kernels read."""
        columns, w = self.columns, self.columns.entries.shape[1]
        entries = np.full((len(self.all), columns.width), -1)
        for k, pair in enumerate(self.all):
            entries[k, :w] = columns.entries[pair.h]
            entries[k, w : w + pair.place.n] = np.arange(pair.place.n) + pair.place.first
        p = max((len(pair.R) for pair in self.all), default=1)
        setup = NonlinearSetup(len(entries), p, entries)
        for k, pair in enumerate(self.all):
            if not pair.sensor.linear:
                setup.add(pair.sensor, k, 0, pair.R)
        return setup

    def tables(self, method: str, active: int) -> Pairs:
        """Return the pairs as kernels take them."""
        entries = self.columns.entries
        first = np.searchsorted([pair.h for pair in self.all], np.arange(len(entries) + 1))
        rows = self.nonlinear.tables(method, active)
        pairs = empty_pairs(rows, entries.shape[1], first.astype(np.int64))
        for k, pair in enumerate(self.all):
            pairs.row[k], pairs.length[k] = pair.row, len(pair.R)
            if pair.sensor.record is None:
                pairs.block[0, k] = self.columns.number(pair.place)
            if not pair.sensor.linear:
                node = pair.sensor.nodes[0] if pair.anchor < 0 else pair.anchor
                pairs.places[k, :, :, 0] = self.nonlinear.reference(pair.sensor, node, k)
            else:
                rows.R[0, k] = np.eye(rows.kind.shape[1])
        return pairs


def anchors_of(sensor: Any, node: int) -> tuple[int, ...]:
    """Return the anchors of all readings of a sensor of ``node`` (id), -1 for the node itself."""
    if sensor.record is None:
        return (-1,)
    return tuple(dict.fromkeys(sensor.record.rows(node).anchors.tolist()))


def matrix_of(sensor: Any, anchor: int, n: int) -> FloatArray:
    """Return H (p, n) of a linear sensor, at an ``anchor`` where it has one for each."""
    matrices = getattr(sensor, "_pairs", {})
    return np.asarray(matrices[anchor] if anchor in matrices else sensor.matrix_of(n))


@once_per_scenario
def blocks_refusal(scenario: Scenario) -> str | None:
    """Return what the compiled engine cannot do where nodes estimate different states."""
    if scenario.common_entries and scenario.node_filter.timing.talks:
        rule = _translation_refusal(scenario)
        if rule is not None:
            return rule
    if any(hasattr(sensor, "C") for sensor in scenario.sensors):
        return "nodes of different states with regressors"
    for node, view in zip(scenario.nodes, scenario.model_views or (), strict=True):
        for placed in scenario.placed_sensors.get(node, ()):
            if _reads_in_its_own_way(scenario, placed, node, view):
                key = f"sensors[{scenario.sensor_entries[placed.entry]}]"
                return f"{key}, which reads other blocks than those of node {node} in its own way"
    return None


def _translation_refusal(scenario: Scenario) -> str | None:
    """Return what the compiled engine cannot do with messages that other nodes must translate."""
    kernels = scenario.node_filter.kernels
    if kernels is not None and kernels.of(not scenario.slotted).counts_sends:
        return "filters whose messages other nodes must translate, and that count what they send"
    if scenario.node_filter.needs.translate is not read_vector:
        return "filters that say in Python how their messages are translated"
    is_fresh = scenario.network.channel.delay.fixed == 0.0 and not scenario.network.clocks
    if not (scenario.slotted or is_fresh):
        return "messages that other nodes must translate and that take time, or seem to"
    if any(not len(theirs) for theirs, _ in scenario.common_entries.values()):
        return "links of nodes that estimate nothing in common"
    return None


def common_table(scenario: Scenario) -> IntArray:
    """Return for each directed link, by receiver and sender, and each component of the receiver's
    state which component of the sender's it is, -1: none; (0, 0) if messages are read as they are.
    """
    if not (scenario.common_entries and scenario.node_filter.timing.talks):
        return ALIKE
    index = scenario.topology.index
    ways = sorted(scenario.topology.directions, key=lambda way: (index[way[1]], index[way[0]]))
    table = np.tile(np.arange(scenario.width), (len(ways), 1))
    for w, way in enumerate(ways):
        if way in scenario.common_entries:
            theirs, mine = scenario.common_entries[way]
            table[w] = -1
            table[w, mine] = theirs
    return table


def _reads_in_its_own_way(
    scenario: Scenario, placed: PlacedSensor, node: int, view: np.ndarray
) -> bool:
    """Return True if a sensor is not only of a ``view``, nor with all values of one block more."""
    sensor: Any = scenario.located_sensors[placed.entry]
    if np.isin(scenario.support(placed), view).all() or scenario.node_filter.timing.pooled:
        return False
    if not sensor.linear:
        moved = scenario.input_responses is not None
        if moved and not scenario.slotted:
            return True
        return sensor.record is not None and (moved or not has_known_h(sensor))
    outside, places = np.ones(scenario.plant.n, dtype=bool), scenario.layout.places
    outside[view] = False
    block = np.repeat(np.arange(len(places)), [place.n for place in places])
    for anchor in anchors_of(sensor, node):
        H = matrix_of(sensor, anchor, scenario.plant.n)
        read = [frozenset(block[outside & (row != 0.0)].tolist()) for row in H]
        if len(set(read)) > 1:
            return True
    return not reads_as_built_in(sensor)
