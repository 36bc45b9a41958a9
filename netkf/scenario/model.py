"""The fields of a scenario as dataclasses: network, filter, sensors on nodes, and the whole."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter
from netkf.algorithms.gates import Gate
from netkf.algorithms.kernels.maps import METHODS
from netkf.core.errors import ScenarioError, TheoryError, errors_under
from netkf.core.fields import (
    Component,
    SourceFile,
    array,
    boolean,
    check_values,
    covariance,
    definite_covariance,
    either,
    field,
    has_depth,
    instance_of,
    integer,
    line,
    list_of,
    matrix,
    number,
    one_of,
    positive,
    seconds,
    source_file,
    square,
    text,
    vector,
)
from netkf.core.instants import OnGrid, TimeGrid
from netkf.core.places import Place
from netkf.core.printable import list_some
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.network.channels import Channel
from netkf.network.clocks import LinkClock
from netkf.network.graph_files import graph_rule
from netkf.network.graphs import Graph, Link, RangeGraph, Topology
from netkf.network.lives import Life
from netkf.network.losses import Transmission
from netkf.network.matchings import SlotActivation
from netkf.network.node_clocks import NodeClock
from netkf.network.positions import Positions, PositionTable
from netkf.network.quantise import Quantisation
from netkf.network.radio import Energy, Radio
from netkf.plants.blocks import Block, Layout, stack
from netkf.plants.faults import Fault
from netkf.plants.linear import LinearPlant, SlotPlant
from netkf.plants.nonlinear import NonlinearSensor, PositionedSensor
from netkf.plants.plant import Plant
from netkf.plants.sensors import Sensor
from netkf.scenario.block_sensors import (
    STACKED,
    estimated_blocks,
    require_no_blocks,
    stacked_sensors,
)
from netkf.scenario.names import bind_names
from netkf.scenario.plugins import user_components
from netkf.scenario.positions import placed_nodes, positions_of, table_of_positions
from netkf.scenario.time_grid import Time, choose_grid, restamp, snap_limits

EVERY_READING, HEALTHY = "every reading is used", "all sensors are healthy"
MAX_LABELS = 12
"""States that a line names."""
RIGHT_CLOCKS = "clocks of nodes are right"
ALL_READ = "nodes take all readings that gains and P count"
"""Assumptions of all filters, see ``ScenarioModel.departures``."""


NO_RADIO = Radio()


@dataclass(frozen=True, eq=False)
class Network(Component):
    """The graph of a network, the activation of its links and the channel of its messages.

    graph       nodes and links
    positions   a table node,x,y of where nodes are, or t,node,x,y, each of whose rows holds until
                the next of its node; nodes whose plant says it are left out
    activation  when links, directions or nodes send; only filters that do not talk need none
    channel     losses and delays of messages
    lives       when nodes are down: crashes, duty cycles, tables; others are always up
    clocks      what clocks of nodes show, where they are wrong
    radio       how long nodes send a message, and in how many frames
    quantise    in how many bits numbers of messages are sent; exact by default
    energy      what a transmission costs its sender, for summaries
    """

    graph: Graph = field(graph_rule)
    activation: LinkClock | SlotActivation | None = field(
        instance_of(LinkClock, SlotActivation), default=None
    )
    channel: Channel = field(instance_of(Channel), default=Channel())
    positions: SourceFile | None = field(source_file, default=None)
    lives: tuple[Life, ...] = field(list_of(instance_of(Life), "lives", min_length=0), default=())
    clocks: tuple[NodeClock, ...] = field(
        list_of(instance_of(NodeClock), "clocks", min_length=0), default=()
    )
    radio: Radio | None = field(instance_of(Radio), default=None)
    quantise: Quantisation | None = field(instance_of(Quantisation), default=None)
    energy: Energy | None = field(instance_of(Energy), default=None)

    @property
    def one_fate(self) -> bool:
        """True if both directions of a link are activated together, with one draw for both."""
        clock = self.activation
        return self.channel.symmetric and (not isinstance(clock, LinkClock) or clock.at == "links")


@dataclass(frozen=True, eq=False)
class Belief(Component):
    """The matrices that filters use where they differ from the true ones.

    A  (n, n) of a diffusion
    B  (n, m) of a diffusion
    F  (n, n) of a linear plant
    Q  (n, n) of a linear plant
    R  of the sensors: one matrix for all, or a list with one per ``[[sensors]]`` entry
    input  false: they do not know the input of the plant
    schedule  false: filters do not know that the plant changes, and keep its first matrices
    """

    A: FloatArray | None = field(square, default=None)
    B: FloatArray | None = field(matrix, default=None)
    F: FloatArray | None = field(square, default=None)
    Q: FloatArray | None = field(covariance, default=None)
    R: FloatArray | tuple[FloatArray, ...] | None = field(
        either(
            definite_covariance, list_of(definite_covariance, "covariance matrices"), has_depth(3)
        ),
        default=None,
    )
    input: bool = field(boolean, default=True)
    schedule: bool = field(boolean, default=True)


_estimates = either(text, list_of(text, "names of blocks"), has_depth(1))


@dataclass(frozen=True, eq=False)
class Filtering(Component):
    """The filter of every node: its ``algorithm``, its initial estimate and its model.

    mean   estimate (n,) with which every node begins, or a list with one per node in the order of
           node ids; the plant's by default
    cov    its covariance (n, n), or a list with one per node; the plant's by default
    model  what the filters believe where it differs from the truth

    linearise  how they use dynamics and sensors that are not linear: "ekf", by Jacobians at the
               estimate; "ukf" and "ckf", by sigma points, unscented (alpha = 1, beta = 2,
               kappa = 0) or cubature
    estimates  with [[plants]], which blocks a node estimates: "all" (default), "own",
               "own+neighbours", "shared", or a list of names of blocks that it owns or shares
    gate       which readings they refuse, as too far from what they expect
    """

    algorithm: Filter = field(instance_of(Filter))
    mean: FloatArray | tuple[FloatArray, ...] | None = field(
        either(vector, list_of(vector, "vectors, one per node"), has_depth(2)), default=None
    )
    cov: FloatArray | tuple[FloatArray, ...] | None = field(
        either(covariance, list_of(covariance, "covariance matrices, one per node"), has_depth(3)),
        default=None,
    )
    model: Belief = field(instance_of(Belief), default=Belief())
    linearise: str = field(one_of(*METHODS), default=METHODS[0])
    estimates: str | tuple[str, ...] = field(_estimates, default="all")
    gate: Gate | None = field(instance_of(Gate), default=None)


@dataclass(frozen=True, eq=False)
class Metrics(Component):
    """What summaries say beside means over time, of the length of the error |x - xhat|, or the root
    of trace P where the truth is unknown.

    level      ``time_above`` is the share of samples above it, in units of the state
    quantiles  orders of the quantiles over the samples
    network    ages, time connected and the traffic of each node: by default those of single runs,
               and ages of as many as 100 nodes with 100 sensors; true: of all, and of all runs of
               ensembles, sweeps and comparisons, which then takes longer; false: none
    """

    level: float | None = field(positive, default=None)
    quantiles: tuple[float, ...] = field(
        list_of(number(low=0.0, high=1.0), "numbers from 0 to 1", min_length=0),
        default=(0.5, 0.9, 0.99),
    )
    network: bool | None = field(boolean, default=None)


class PlacedSensor(NamedTuple):
    """One sensor on one node.

    ``entry`` is its index in ``Scenario.sensors``, ``ordinal`` its number at the node.
    """

    entry: int
    ordinal: int


def takes_samples(sensor: Sensor) -> bool:
    """Return True if a sensor of a diffusion samples y = H x + v, False for increments."""
    own_times = type(sensor).sample_times not in (Sensor.sample_times, NonlinearSensor.sample_times)
    has_clock = getattr(sensor, "sampling", None) is not None
    return sensor.record is not None or has_clock or own_times


_plant = dataclasses.replace(
    instance_of(Plant),
    convert=lambda value: None if value is None else instance_of(Plant).convert(value),
)
"""A plant, or None where there are ``plants``."""


@dataclass(frozen=True, eq=False, repr=False)
class ScenarioModel(Component):
    """The fields of a scenario, and properties that need no numerical computation.

    With ``plants``, blocks of the state, ``plant`` is the stacked one, and ``sensors`` are those of
    the stacked state; ``sensor_entries`` are indices of the ``declared_sensors`` they come from.

    ``horizon`` and ``probe`` are in simulated seconds; ``probe`` is the period of the state
    samples, or an array (T,) of their increasing times.
    """

    name: str = field(text)
    horizon: float = field(seconds)
    plant: Plant = field(_plant)
    sensors: tuple[Any, ...] = field(list_of(instance_of(Sensor), "sensors", min_length=0))
    network: Network = field(instance_of(Network))
    filter: Filtering = field(instance_of(Filtering))
    probe: float | FloatArray = field(either(seconds, array(1, "list of times"), has_depth(1)))
    claim: str = field(line, default="")
    seed: int = field(integer(low=0), default=0)
    time: Time = field(instance_of(Time), default=Time())
    metrics: Metrics = field(instance_of(Metrics), default=Metrics())
    plants: tuple[Block, ...] = field(
        list_of(instance_of(Block), "blocks", min_length=0), default=()
    )
    declared_sensors: tuple[Any, ...] = dataclasses.field(default=(), init=False, repr=False)
    sensor_entries: tuple[int, ...] = dataclasses.field(default=(), init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the fields, and read tables anew that were read without ``time`` or names; raises
        ScenarioError. Plant and sensors of blocks become those of the stacked state.
        """
        super().__post_init__()
        for part in user_components(self):
            check_values(part)
        for name in ("plants", "plant", "sensors", "network", "filter"):
            with errors_under(name):
                restamped = restamp(getattr(self, name), self.time.stamps)
            object.__setattr__(self, name, restamped)
        # Only graphs that are read, or made in Python, have nodes with names.
        names = self.topology.names if self.network.graph.may_name_nodes else None
        for name in ("plants", "sensors", "network", "filter"):
            with errors_under(name):
                bound = bind_names(getattr(self, name), names)
            object.__setattr__(self, name, bound)
        self._stack_blocks()
        self._put_on_grid()
        if self.position_table is not None and not self.position_table.timed:
            points = self.position_table.points
            placed = {node: points[node] for node in self.nodes if node in points}
            # Sensors and pictures take these for positions of the graph, if all nodes have one.
            located = placed if len(placed) == len(self.nodes) else None
            self.__dict__["topology"] = dataclasses.replace(self.topology, positions=located)

    def _stack_blocks(self) -> None:
        # A copy of a scenario is given the sensors of the original, stacked already.
        origins = (getattr(sensor, STACKED, None) for sensor in self.sensors)
        declared = next((origin for origin in origins if origin is not None), self.sensors)
        entries = tuple(range(len(self.sensors)))
        if not self.plants:
            if self.plant is None:
                raise ScenarioError("plant", "is missing", None, "add [plant] or [[plants]]")
            with errors_under("plant"):
                self.plant.read()
            with errors_under("sensors"):
                require_no_blocks(self.sensors)
        else:
            layout = self.layout
            with errors_under("plants"):
                object.__setattr__(self, "plant", stack(self.plants, layout))
            for k, block in enumerate(self.plants):
                for place, node in enumerate(block.nodes or ()):
                    if node not in self.topology.index:
                        key, rule = f"plants[{k}].nodes[{place}]", "must be a node of the graph"
                        raise ScenarioError(key, rule, node, "correct the id")
            with errors_under("sensors"):
                stacked, entries = stacked_sensors(declared, layout, self.topology)
            object.__setattr__(self, "sensors", stacked)
        object.__setattr__(self, "declared_sensors", declared)
        object.__setattr__(self, "sensor_entries", entries)

    def sensor_key(self, k: int) -> str:
        """Return the key path of the entry that number ``k`` of ``sensors`` comes from."""
        return f"sensors[{self.sensor_entries[k]}]"

    @property
    def all_plants(self) -> list[tuple[str, Any]]:
        """The plant, or that of each block, each with its key path."""
        if not self.plants:
            return [("plant", self.plant)]
        entries = enumerate(self.plants)
        return [(f"plants[{k}]", plant) for k, block in entries for plant in block.copies]

    @cached_property
    def layout(self) -> Layout:
        """The blocks of ``[[plants]]`` in the stacked state; one of all states without these."""
        if not self.plants:
            return Layout([Block(name="plant", plant=self.plant)])
        with errors_under("plants"):
            return Layout(self.plants)

    @cached_property
    def estimated(self) -> tuple[tuple[Place, ...], ...]:
        """The blocks that each node estimates, in the order of ``nodes``."""
        with errors_under("filter.estimates"):
            return estimated_blocks(self.filter.estimates, self.layout, self.topology)

    @cached_property
    def views(self) -> tuple[np.ndarray, ...] | None:
        """The entries (n',) of the state that each node estimates; None if all estimate all."""
        entries = [
            np.concatenate([np.arange(place.first, place.first + place.n) for place in places])
            for places in self.estimated
        ]
        whole = np.arange(self.plant.n)
        return None if all(np.array_equal(one, whole) for one in entries) else tuple(entries)

    @cached_property
    def is_estimated(self) -> np.ndarray:
        """A mask (N, n) of the states that nodes estimate: the first of each."""
        entries = np.arange(self.width)
        views = self.views or [entries] * len(self.nodes)
        return np.array([entries < len(view) for view in views])

    @cached_property
    def sizes(self) -> np.ndarray:
        """The numbers (N,) of states that nodes estimate."""
        return np.asarray(self.is_estimated.sum(axis=1))

    @cached_property
    def state_labels(self) -> tuple[str, ...]:
        """The labels (width,) of x0, x1, ..., as ``x (m)``; names of columns where these differ."""
        labels = {
            place.key: plant.labels
            for place, (_, plant) in zip(self.layout.places, self.all_plants, strict=True)
        }
        columns: list[set[str]] = [set() for _ in range(self.width)]
        for places in self.estimated:
            named = [label for place in places for label in labels[place.key]]
            for column, label in zip(columns, named, strict=False):
                column.add(label)
        return tuple(self._column_label(k, found) for k, found in enumerate(columns))

    @staticmethod
    def _column_label(k: int, found: set[str]) -> str:
        label = found.pop() if len(found) == 1 else ""
        return f"x{k} {label}".strip() if label[:1] in ("", "(") else label

    @cached_property
    def unit(self) -> str:
        """The unit of all states, "units of the state" where they have none or different ones."""
        return self.common_unit or "units of the state"

    @cached_property
    def common_unit(self) -> str:
        """The unit of all states, empty where they have none or different ones."""
        units = {unit for _, plant in self.all_plants for unit in plant.units or ("",)}
        return units.pop() if len(units) == 1 else ""

    @property
    def states_note(self) -> str:
        """The names and units of states by plant, as ``states: x (m), y (m)``; or empty."""
        parts = []
        for name, plant in self.all_plants:
            labels = [self._column_label(k, {label}) for k, label in enumerate(plant.labels)]
            if any(plant.labels):
                whose = f"{name}: " if self.views is not None else ""
                parts.append(whose + ", ".join(labels[:MAX_LABELS]))
                parts[-1] += ", ..." if len(labels) > MAX_LABELS else ""
        return f"states: {'; '.join(parts)}" if parts else ""

    def labels_of_readings(self, node: int) -> list[str]:
        """Return labels of the values that sensors of a ``node`` (-1: of all) read, in order."""
        of_plants = [enumerate(plant.labels) for _, plant in self.all_plants]
        states = [x and self._column_label(k, {x}) for plant in of_plants for k, x in plant]
        placed = self.sensors_of(node)
        return [label for sensor in placed for label in self._value_labels(sensor, states)]

    def sensors_of(self, node: int) -> list[Sensor]:
        """Return the sensors of a ``node`` (-1: of all) in the order of its values."""
        owners = [node] if node >= 0 else [*self.placed_sensors]
        return [self.sensors[p.entry] for i in owners for p in self.placed_sensors.get(i, ())]

    def _value_labels(self, sensor: Sensor, states: Sequence[str]) -> Iterator[str]:
        if isinstance(sensor, PositionedSensor):
            of = ", ".join(filter(None, (states[k] for k in sensor.states)))
            yield from [f"range in {of}" if of else "range"] * (sensor.rows - sensor.turns)
            yield from ["bearing (rad)"] * sensor.turns
            return
        record = sensor.record
        is_fixed = sensor.linear and not (sensor.varying if record is None else record.regressors)
        # Increments are of the integral over time.
        is_fixed &= self.slotted or takes_samples(sensor)
        for row in sensor.matrix_of(len(states)):
            # A state, or the difference of two of one name.
            of_row = {states[k] for k in np.flatnonzero(row).tolist()} if is_fixed else set()
            is_plain = len(of_row) == 1 and bool((np.abs(row[row != 0.0]) == 1.0).all())
            yield of_row.pop() if is_plain else ""

    def label_of_value(self, node: int, number: int, sizes: np.ndarray | None) -> str:
        """Return the label of value ``number`` of readings of ``sizes`` (M,), or of all; or ""."""
        labels = self.labels_of_readings(node)
        is_whole = sizes is None or bool((sizes == len(labels)).all())
        return labels[number] if is_whole else labels[0] if len(set(labels)) == 1 else ""

    def what_is_read(self, node: int) -> str:
        """Return what a ``node`` (-1: all) reads, as ``x (m), y (m)``; empty if it is unknown."""
        labels = list(dict.fromkeys(self.labels_of_readings(node)))
        more = ", ..." if len(labels) > MAX_LABELS else ""
        return ", ".join(labels[:MAX_LABELS]) + more if all(labels) else ""

    @property
    def width(self) -> int:
        """The largest number of states that a node estimates."""
        return self.plant.n if self.views is None else max(map(len, self.views))

    def _put_on_grid(self) -> None:
        grid = self.time_grid
        network, filtering = self.network, self.filter
        if isinstance(network.activation, OnGrid):
            activation = network.activation.on_grid(grid)
            if activation is not network.activation:
                network = dataclasses.replace(network, activation=activation)
        loss = network.channel.loss
        if isinstance(loss, OnGrid) and loss.on_grid(grid) is not loss:
            channel = dataclasses.replace(network.channel, loss=loss.on_grid(grid))
            network = dataclasses.replace(network, channel=channel)
        algorithm = snap_limits(filtering.algorithm, grid)
        if algorithm is not filtering.algorithm:
            filtering = dataclasses.replace(filtering, algorithm=algorithm)
        probe = self.probe
        if isinstance(probe, np.ndarray) and not np.array_equal(grid.snap(probe), probe):
            probe = readonly_array(grid.snap(probe))
        for name, value in (
            ("horizon", grid.instant(self.horizon)),
            ("probe", probe),
            ("plant", self.plant.on_grid(grid)),
            ("network", network),
            ("filter", filtering),
        ):
            object.__setattr__(self, name, value)

    @cached_property
    def position_table(self) -> PositionTable | None:
        """The table ``network.positions``, None without one."""
        return table_of_positions(self)

    @cached_property
    def positions(self) -> Positions:
        """The positions of nodes."""
        return positions_of(self)

    @property
    def links_move(self) -> bool:
        """True if it changes in a run who hears whom, or how well: nodes move."""
        follows = self.network.channel.loss.follows_distance
        return self.topology.radius is not None or (follows and self.positions.moving)

    @property
    def network_changes(self) -> bool:
        """True if who hears whom changes: nodes move or are down, or messages wait."""
        return self.links_move or bool(self.network.lives) or self.messages_queue

    @property
    def messages_queue(self) -> bool:
        """True if a node sends one message after the other, each for some time."""
        radio = self.network.radio
        return radio is not None and radio.bits_per_second is not None

    @property
    def links_follow_state(self) -> bool:
        """True if the true state says who hears whom, or how well."""
        return self.links_move and self.positions.of_state

    @cached_property
    def time_grid(self) -> TimeGrid:
        """The grid that every instant of a run lies on."""
        return choose_grid(self)

    @cached_property
    def forgetful_nodes(self) -> tuple[int, ...]:
        """The nodes (ids, in order) that forget what they know when they are down."""
        if self.node_filter.timing.pooled:  # it is in no node
            return ()
        lost = [life.nodes for life in self.network.lives if life.memory == "lost"]
        return tuple(sorted(node for nodes in lost for node in nodes))

    @cached_property
    def departures(self) -> tuple[tuple[str, str], ...]:
        """Assumptions of filters that do not hold, each with its reason."""
        found = []
        if self.network.clocks:
            evidence = (
                "clocks of nodes are wrong and filters believe them: estimates are of another "
                "time, and P does not count it"
            )
            found.append((RIGHT_CLOCKS, evidence))
        down = {node for life in self.network.lives for node in life.nodes}
        if self.slotted and self.node_filter.needs.awake and down & set(self.placed_sensors):
            evidence = (
                "nodes with sensors are down at times (network.lives), and gains and P count their "
                "readings all the same: P is too small"
            )
            found.append((ALL_READ, evidence))
        if self.faults:
            evidence = (
                f"sensors of node {list_some(list(self.faults), 5)} are bad for a time "
                "(sensors.fault): errors have a part that neither filters nor P know of"
            )
            found.append((HEALTHY, evidence))
        if self.network.quantise is not None:
            evidence = (
                "each number of a message has an error of variance "
                f"{self.network.quantise.variance:.4g} (network.quantise) that P does not count"
            )
            found.append(("messages arrive as they are sent", evidence))
        if self.filter.gate is not None:
            evidence = (
                "a gate refuses a healthy reading of a consistent filter with probability "
                f"{1.0 - self.filter.gate.probability:.4g}: gains, P and errors follow the data, "
                "and P is too small after a healthy reading that was refused"
            )
            found.append((EVERY_READING, evidence))
        return tuple(found)

    @property
    def is_linear(self) -> bool:
        """True if dynamics and readings are linear, and nothing departs from assumptions."""
        return self.plant.linear and self.has_linear_sensors and not self.departures

    @property
    def has_linear_sensors(self) -> bool:
        """True if all readings are linear in the state."""
        return all(sensor.linear for sensor in self.sensors)

    @cached_property
    def located_sensors(self) -> tuple[Any, ...]:
        """``sensors``, nonlinear ones with the positions of nodes: their own, else the graph's."""
        return tuple(
            sensor if sensor.linear else sensor.located(self.topology.positions)
            for sensor in self.sensors
        )

    @cached_property
    def topology(self) -> Topology:
        """The nodes and links; raises ScenarioError if the graph cannot be built."""
        graph = self.network.graph
        if isinstance(graph, RangeGraph) and graph.nodes is None:
            graph = dataclasses.replace(graph, nodes=tuple(placed_nodes(self)) or None)
        with errors_under("network.graph"):
            return graph.build(self.seed)

    @cached_property
    def nodes(self) -> tuple[int, ...]:
        """Node ids in increasing order."""
        return self.topology.nodes

    @cached_property
    def times(self) -> FloatArray:
        """(T,) times of the state samples in seconds."""
        if isinstance(self.probe, np.ndarray):
            return self.probe
        count = int(np.rint(self.horizon / self.probe))
        times = self.time_grid.snap(self.probe * np.arange(count + 1))
        return readonly_array(times[times <= self.horizon])

    @property
    def slotted(self) -> bool:
        """True if the scenario runs in slots, False if in continuous time."""
        return isinstance(self.plant, SlotPlant)

    @property
    def slot_plant(self) -> SlotPlant:
        """The plant of a scenario in slots; raises TheoryError for one in continuous time."""
        if not isinstance(self.plant, SlotPlant):
            raise TheoryError("this is about scenarios in slots, and the plant is a diffusion")
        return self.plant

    @property
    def linear_plant(self) -> LinearPlant:
        """The plant of a scenario in slots with linear dynamics; raises TheoryError for others."""
        plant = self.slot_plant
        if not isinstance(plant, LinearPlant):
            raise TheoryError("this is about linear plants, and the dynamics are not linear")
        return plant

    @cached_property
    def sampled_slots(self) -> tuple[int, ...]:
        """Numbers (T,) of the slots whose states are sampled, those at ``times``."""
        period = self.slot_plant.period
        return tuple(round(t / period) for t in self.times.tolist())

    @property
    def node_filter(self) -> Filter:
        """The filter of every node."""
        return self.filter.algorithm

    @property
    def end_time(self) -> float:
        """The end of simulation (s): the horizon, or the end of a slot sampled after exchanges."""
        if not self.slotted or self.node_filter.timing.predicts:
            return self.horizon
        return self.horizon + self.slot_plant.period

    @property
    def phase_length(self) -> float:
        """Seconds of an exchange phase, shared by its steps; by default all last half a period."""
        activation = self.network.activation
        assert isinstance(activation, SlotActivation)
        if activation.phase is not None:
            return activation.phase
        return 0.5 * self.slot_plant.period / max(1, self.node_filter.timing.exchanges)

    @cached_property
    def placed_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that has any, by id, without those that are held out."""
        return self._place_sensors(held_out=False)

    @cached_property
    def held_out_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that filters do not see, as ``placed_sensors``."""
        return self._place_sensors(held_out=True)

    def _place_sensors(self, held_out: bool) -> dict[int, tuple[PlacedSensor, ...]]:
        # Sensors keep their numbers, and so their draws, whichever are held out.
        sensors_of_nodes: dict[int, list[PlacedSensor]] = {}
        for entry, sensor in enumerate(self.sensors):
            for node in sensor.nodes:
                sensors = sensors_of_nodes.setdefault(node, [])
                sensors.append(PlacedSensor(entry, len(sensors)))
        chosen = {
            node: tuple(p for p in placed if self.sensors[p.entry].held_out is held_out)
            for node, placed in sorted(sensors_of_nodes.items())
        }
        return {node: placed for node, placed in chosen.items() if placed}

    @property
    def sensing_nodes(self) -> tuple[int, ...]:
        """Ids of the nodes that have a sensor."""
        return tuple(self.placed_sensors)

    @property
    def is_random(self) -> bool:
        """True if runs draw the state and all readings at random; False if any is recorded."""
        return self.plant.is_random and all(sensor.is_random for sensor in self.sensors)

    def noise_covariance(self, entry: int, *, believed: bool) -> FloatArray:
        """Return R (p, p) of a ``[[sensors]]`` entry: of filters if ``believed``, or true."""
        believed_R = self.filter.model.R
        if not believed or believed_R is None:
            true_R: FloatArray = self.sensors[entry].R
            return true_R
        if isinstance(believed_R, tuple):
            return believed_R[self.sensor_entries[entry]]
        return believed_R

    def fault_of(self, node: int, placed_sensor: PlacedSensor) -> Fault | None:
        """Return the fault that a sensor of ``node`` (id) has at some time, or None."""
        fault: Fault | None = self.sensors[placed_sensor.entry].fault
        has_it = fault is not None and (fault.nodes is None or node in fault.nodes)
        return snap_limits(fault, self.time_grid) if has_it else None

    @cached_property
    def faults(self) -> dict[int, tuple[tuple[PlacedSensor, Fault], ...]]:
        """The sensors with a fault, by node (id)."""
        found = {
            node: tuple((p, f) for p in placed for f in [self.fault_of(node, p)] if f is not None)
            for node, placed in self.placed_sensors.items()
        }
        return {node: bad for node, bad in found.items() if bad}

    def transmission(self, link: Link) -> Transmission:
        """Return message 0 on a link: its entry in the graph's table (0 without), and distance."""
        delivery, distance = self.topology.delivery, math.nan
        if self.network.channel.loss.follows_distance and not self.positions.moving:
            distance = self.positions.distance(link)
        table = 1.0 if delivery is None else delivery.get(link, 0.0)
        size = self.message_size(link[0], 0 if self.slotted else -1)
        frames = 1 if self.network.radio is None else self.network.radio.frames(size)
        hearers = self.topology.receivers(link[0]) if self.has_broadcasts else link[1:]
        return Transmission(
            link, table_probability=table, distance=distance, hearers=hearers, size=size,
            frames=frames,
        )  # fmt: skip

    def messages_of_slot(self, link: Link) -> list[tuple[float, Transmission]]:
        """Return each exchange's share of a slot's messages, and one of its messages, on a link."""
        first, radio, timing = self.transmission(link), self.network.radio, self.node_filter.timing
        if radio is None or not self.slotted:
            return [(1.0, first)]
        sender, reads = link[0], link[0] in self.placed_sensors
        sending = (phase for phase in range(timing.exchanges) if timing.sends(phase, reads))
        steps = {phase: timing.steps(phase) for phase in sending}
        found, total = [], sum(steps.values())
        for phase, count in steps.items() if total else ():
            size = self.message_size(sender, phase)
            found.append((count / total, first._replace(size=size, frames=radio.frames(size))))
        return found or [(1.0, first)]

    def message_size(self, node: int, phase: int) -> float:
        """Return the bytes of a message of ``node`` (id) in a ``phase`` of a slot, or -1."""
        if (node, phase) not in self._message_sizes:
            radio, index = self.network.radio or NO_RADIO, self.topology.index[node]
            # Some filters send their readings.
            rows = sum(len(self.sensors[p.entry].R) for p in self.placed_sensors.get(node, ()))
            numbers = self.node_filter.analysis.payload_numbers(int(self.sizes[index]), rows, phase)
            where = f"{type(self.node_filter).__name__}.analysis.payload_numbers"
            numbers = number(low=0.0)(where, numbers)
            coded = self.network.quantise
            size = radio.bytes_per_number if coded is None else coded.bits / 8.0
            self._message_sizes[node, phase] = size * numbers
        return self._message_sizes[node, phase]

    @cached_property
    def _message_sizes(self) -> dict[tuple[int, int], float]:
        return {}

    @cached_property
    def has_broadcasts(self) -> bool:
        """True if a transmission has several hearers: of nodes, but not of links or pairs."""
        if self.slotted:
            return not self.node_filter.timing.pairwise
        return getattr(self.network.activation, "at", "links") in ("nodes", "readings")

    @property
    def longest_delay(self) -> float:
        """The largest number of seconds that a message may take; inf if there is no bound."""
        radio, longest = self.network.radio, float(self.network.channel.delay.longest)
        if self.network.clocks:
            # Stamps may tell any age up to the time since the start, by the receiver's clock.
            return 2.0 * self.horizon
        if radio is None or not self.messages_queue:
            return longest
        if radio.queue == "wait":
            return math.inf
        phases = range(self.node_filter.timing.exchanges)
        sizes = (
            self.message_size(node, phase)
            for node in self.nodes
            for phase in (phases if self.slotted else (-1,))
        )
        # The central filter sends nothing.
        return longest + radio.seconds(max(sizes, default=0))

    def mean_delivery(self, link: Link) -> float:
        """Return the share of messages of a link that arrive in the long run; nan if unknown."""
        if self.topology.radius is not None or self.network_changes:
            return math.nan
        if link not in self._mean_deliveries:
            channel = self.network.channel
            self._mean_deliveries[link] = sum(
                share * channel.mean_delivery(sent, self.horizon)
                for share, sent in self.messages_of_slot(link)
            )
        return self._mean_deliveries[link]

    @cached_property
    def _mean_deliveries(self) -> dict[Link, float]:
        return {}

    @property
    def has_mistimed_increments(self) -> bool:
        """True if the clock of a node whose sensors give increments is wrong."""
        nodes = {node for clock in self.network.clocks for node in clock.nodes}
        return not nodes.isdisjoint(self.increment_sensors)

    @cached_property
    def increment_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that give increments of a diffusion; empty in slots."""
        return self._find_diffusion_sensors(sampled=False)

    @cached_property
    def sampled_sensors(self) -> dict[int, tuple[PlacedSensor, ...]]:
        """The sensors of each node that sample a diffusion; empty in slots."""
        return self._find_diffusion_sensors(sampled=True)

    def _find_diffusion_sensors(self, sampled: bool) -> dict[int, tuple[PlacedSensor, ...]]:
        """Return the sensors by node that take samples (``sampled``) or that give increments."""
        if self.slotted:
            return {}
        sensors_of_nodes = {
            node: tuple(p for p in sensors if takes_samples(self.sensors[p.entry]) == sampled)
            for node, sensors in self.placed_sensors.items()
        }
        return {node: sensors for node, sensors in sensors_of_nodes.items() if sensors}
