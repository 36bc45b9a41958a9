"""The parts of a scenario as dataclasses: network, filter, sensors on nodes, and all fields."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.adapters import AnyFilter, adapt
from netkf.algorithms.filter import Filter
from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import SlotFilter
from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import (
    Component,
    array,
    covariance,
    definite_covariance,
    either,
    field,
    instance,
    integer,
    line,
    matrix,
    nested,
    seconds,
    several,
    square,
    text,
    vector,
)
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Graph, Link, Topology
from netkf.network.matchings import SlotActivation
from netkf.plants.linear import LinearPlant
from netkf.plants.nonlinear import NonlinearSensor
from netkf.plants.plant import Plant
from netkf.plants.recorded import RecordedSensor
from netkf.plants.sensors import LinearSensor, Sensor


@dataclass(frozen=True, eq=False)
class Network(Component):
    """The graph of a network, the activation of its links and the channel of its messages.

    graph       nodes and links
    activation  when links, directions or nodes send; only filters that do not talk need none
    channel     losses and delays of messages
    """

    graph: Graph = field(instance(Graph))
    activation: LinkClock | SlotActivation | None = field(
        instance(LinkClock, SlotActivation), default=None
    )
    channel: Channel = field(instance(Channel), default=Channel())


@dataclass(frozen=True, eq=False)
class Belief(Component):
    """The matrices that filters use where they differ from the true ones.

    A  (n, n) of a diffusion
    B  (n, m) of a diffusion
    F  (n, n) of a linear plant
    Q  (n, n) of a linear plant
    R  of the sensors: one matrix for all, or a list with one per ``[[sensors]]`` entry
    """

    A: FloatArray | None = field(square, default=None)
    B: FloatArray | None = field(matrix, default=None)
    F: FloatArray | None = field(square, default=None)
    Q: FloatArray | None = field(covariance, default=None)
    R: FloatArray | tuple[FloatArray, ...] | None = field(
        either(definite_covariance, several(definite_covariance, "covariance matrices"), nested(3)),
        default=None,
    )


@dataclass(frozen=True, eq=False)
class Filtering(Component):
    """The filter of every node: its ``algorithm``, its initial estimate and its model.

    mean   estimate (n,) with which every node begins, or a list with one per node in the order of
           node ids; the plant's by default
    cov    its covariance (n, n), or a list with one per node; the plant's by default
    model  what the filters believe where it differs from the truth
    """

    algorithm: AnyFilter = field(instance(Filter, FlowFilter, SlotFilter))
    mean: FloatArray | tuple[FloatArray, ...] | None = field(
        either(vector, several(vector, "vectors, one per node"), nested(2)), default=None
    )
    cov: FloatArray | tuple[FloatArray, ...] | None = field(
        either(covariance, several(covariance, "covariance matrices, one per node"), nested(3)),
        default=None,
    )
    model: Belief = field(instance(Belief), default=Belief())


class PlacedSensor(NamedTuple):
    """One sensor on one node.

    ``entry`` is its index in ``Scenario.sensors``, ``ordinal`` its number among the sensors of the
    node.
    """

    entry: int
    ordinal: int


def takes_samples(sensor: Sensor) -> bool:
    """Return True if a sensor over a diffusion samples it, False if it gives increments."""
    return isinstance(sensor, RecordedSensor) or (
        isinstance(sensor, (LinearSensor, NonlinearSensor)) and sensor.sampling is not None
    )


@dataclass(frozen=True, eq=False, repr=False)
class ScenarioModel(Component):
    """The fields of a scenario, and what follows from them without any mathematics.

    ``horizon`` and ``probe`` are in simulated seconds; ``probe`` is the period of the state
    samples or a tuple of increasing times.
    """

    name: str = field(text)
    horizon: float = field(seconds)
    plant: Plant = field(instance(Plant))
    sensors: tuple[Any, ...] = field(several(instance(Sensor), "sensors", least=0))
    network: Network = field(instance(Network))
    filter: Filtering = field(instance(Filtering))
    probe: float | FloatArray = field(either(seconds, array(1, "list of times"), nested(1)))
    claim: str = field(line, default="")
    seed: int = field(integer(low=0), default=0)

    @property
    def is_linear(self) -> bool:
        """True if all readings are linear in the state."""
        return all(sensor.linear for sensor in self.sensors)

    @cached_property
    def located_sensors(self) -> tuple[Any, ...]:
        """The sensors, nonlinear ones at the positions of the graph where they name no others."""
        return tuple(
            sensor if sensor.linear else sensor.located(self.topology.positions)
            for sensor in self.sensors
        )

    @cached_property
    def topology(self) -> Topology:
        """The nodes and links; raises ScenarioError if the graph cannot be built."""
        try:
            return self.network.graph.build(self.seed)
        except ScenarioError as error:
            raise error.under("network.graph") from None

    @cached_property
    def nodes(self) -> tuple[int, ...]:
        """Node ids in increasing order."""
        return self.topology.nodes

    @cached_property
    def times(self) -> FloatArray:
        """(T,) times of the state samples in seconds."""
        if isinstance(self.probe, np.ndarray):
            return self.probe
        count = int(np.floor(self.horizon / self.probe * (1.0 + 1e-12)))
        digits = 12 - min(0, int(np.floor(np.log10(self.probe))))
        return np.minimum(np.round(self.probe * np.arange(count + 1), digits), self.horizon)

    @property
    def slotted(self) -> bool:
        """True if the scenario runs in slots, False if in continuous time."""
        return isinstance(self.plant, LinearPlant)

    @property
    def slot_plant(self) -> LinearPlant:
        """The plant of a scenario in slots; raises TheoryError for one in continuous time."""
        if not isinstance(self.plant, LinearPlant):
            raise TheoryError("this is about scenarios in slots, and the plant is a diffusion")
        return self.plant

    @cached_property
    def sampled_slots(self) -> tuple[int, ...]:
        """Numbers of the slots that are sampled."""
        period = self.slot_plant.period
        return tuple(round(t / period) for t in self.times.tolist())

    @cached_property
    def node_filter(self) -> Filter:
        """The filter of every node under the present contract."""
        return adapt(self.filter.algorithm)

    @property
    def end_time(self) -> float:
        """The time in seconds after which nothing happens.

        It is the horizon, or the end of the slot that begins there if samples are taken after the
        exchanges of their slot.
        """
        if not self.slotted or self.node_filter.predicts:
            return self.horizon
        return self.horizon + self.slot_plant.period

    @property
    def phase_length(self) -> float:
        """Seconds that an exchange of a slot lasts; its steps share them evenly."""
        activation = self.network.activation
        assert isinstance(activation, SlotActivation)
        if activation.phase is not None:
            return activation.phase
        return (
            0.5
            * self.slot_plant.period
            / max(1, (self.node_filter.schedule or ()).count("exchange"))
        )

    @cached_property
    def placed_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that has any."""
        placed: dict[int, list[PlacedSensor]] = {}
        for entry, sensor in enumerate(self.sensors):
            for node in sensor.nodes:
                sensors = placed.setdefault(node, [])
                sensors.append(PlacedSensor(entry, len(sensors)))
        return {node: tuple(placed[node]) for node in sorted(placed)}

    @property
    def sensing_nodes(self) -> tuple[int, ...]:
        """Ids of the nodes that have a sensor."""
        return tuple(self.placed_sensors)

    @property
    def is_random(self) -> bool:
        """True if runs draw the state and all readings; records of them follow no known law."""
        return self.plant.is_random and all(sensor.is_random for sensor in self.sensors)

    def noise_covariance(self, entry: int, *, believed: bool) -> FloatArray:
        """Return the true or the believed R (p, p) of a ``[[sensors]]`` entry."""
        R = self.filter.model.R
        if not believed or R is None:
            true: FloatArray = self.sensors[entry].R
            return true
        return R[entry] if isinstance(R, tuple) else R

    def table_probability(self, link: Link) -> float:
        """Return the delivery probability of a direction by the graph's table, 1 without one."""
        delivery = self.topology.delivery
        return 1.0 if delivery is None else delivery.get(link, 0.0)

    @cached_property
    def increment_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that give increments of a diffusion; empty in slots."""
        return self._sensors_over_diffusion(sampled=False)

    @cached_property
    def sampled_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that sample a diffusion; empty in slots."""
        return self._sensors_over_diffusion(sampled=True)

    def _sensors_over_diffusion(self, sampled: bool) -> dict[int, tuple[PlacedSensor, ...]]:
        """Return the sensors of each node that take samples, or those that give increments."""
        if self.slotted:
            return {}
        chosen = {
            node: tuple(p for p in placed if takes_samples(self.sensors[p.entry]) == sampled)
            for node, placed in self.placed_sensors.items()
        }
        return {node: placed for node, placed in chosen.items() if placed}
