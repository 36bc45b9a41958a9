"""A scenario: everything that determines a run, checked as a whole when it is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from netkf.algorithms.adapters import AnyFilter, adapt
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.kernels.gains import longest_interval
from netkf.algorithms.models import FlowModel, SlotModel
from netkf.algorithms.slot import SlotFilter
from netkf.core.errors import TheoryError
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
    positive,
    several,
    square,
    text,
    vector,
)
from netkf.linalg.arrays import FloatArray, block_diagonal, symmetric
from netkf.network.channels import Channel
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Graph, Link, Topology
from netkf.network.matchings import SlotActivation
from netkf.plants.diffusion import Diffusion, default_sensing_period
from netkf.plants.linear import LinearPlant, Readings
from netkf.plants.plant import Plant
from netkf.plants.recorded import RecordedSensor
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sampling import Samples
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Streams
from netkf.scenario import sampling


@dataclass(frozen=True, eq=False)
class Network(Component):
    """Who can talk to whom, when, and what becomes of a message."""

    graph: Graph = field(instance(Graph))
    activation: LinkClock | SlotActivation | None = field(
        instance(LinkClock, SlotActivation), default=None
    )
    channel: Channel = field(instance(Channel), default=Channel())


@dataclass(frozen=True, eq=False)
class Belief(Component):
    """What the filters believe where it differs from the truth.

    ``A`` (n, n) and ``B`` (n, m) of a diffusion, ``F`` and ``Q`` (n, n) of a linear plant, ``R`` of
    the sensors: one matrix for all, or a list with one per ``[[sensors]]`` entry.
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
    """The filter of every node: its ``algorithm``, its start and what it believes.

    ``mean`` (n,) and ``cov`` (n, n) are one for all nodes or a tuple with one per node in the
    order of node ids; both default to the plant's.
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


class Placed(NamedTuple):
    """One sensor on one node: its place in ``sensors`` and its number on that node."""

    entry: int
    ordinal: int


@dataclass(frozen=True, eq=False, repr=False)
class Scenario(Component):
    """What is simulated. Every value is checked on construction, alone and against the others;
    ScenarioError says what is wrong in one line.

    ``horizon`` and ``probe`` are in simulated seconds; ``probe`` is the period of the state
    samples or a tuple of increasing times.
    """

    name: str = field(text)
    horizon: float = field(positive)
    plant: Plant = field(instance(Plant))
    sensors: tuple[LinearSensor | RegressorSensor | RecordedSensor, ...] = field(
        several(instance(Sensor), "sensors", least=0)
    )
    network: Network = field(instance(Network))
    filter: Filtering = field(instance(Filtering))
    probe: float | FloatArray = field(either(positive, array(1, "list of times"), nested(1)))
    claim: str = field(line, default="")
    seed: int = field(integer(low=0), default=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        from netkf.scenario.checks import check

        check(self)

    def __getstate__(self) -> dict[str, Any]:
        """What travels when it is pickled: the settings, and the network, which may have been read
        from a file.
        """
        kept = {field.name for field in dataclasses.fields(self)} | {"_folder", "topology"}
        return {name: value for name, value in self.__dict__.items() if name in kept}

    def __repr__(self) -> str:
        kinds = (type(self.plant), type(self.network.graph), type(self.filter.algorithm))
        plant, graph, algorithm = (kind.__name__ for kind in kinds)
        return (
            f"<netkf.Scenario {self.name!r}: {plant} of {self.plant.n} states, {graph} of "
            f"{len(self.nodes)} nodes and {len(self.topology.links)} links, {len(self.sensing)} "
            f"with sensors, {algorithm} filters, {self.horizon:g} s, seed {self.seed}>"
        )

    def replace(self, changes: Mapping[str, Any]) -> Scenario:
        """A scenario with some keys changed, e.g. ``{"network.activation.rate": 5.0}``.

        Keys are paths as in a scenario file; entries of a list are numbered, ``sensors.0.R``.
        Raises ScenarioError for a key that does not exist or a value that breaks a rule.
        """
        from netkf.scenario.reading import changed

        return changed(self, changes)

    @cached_property
    def topology(self) -> Topology:
        """Nodes and links."""
        try:
            return self.network.graph.build(self.seed)
        except Exception as error:
            from netkf.core.errors import ScenarioError

            if isinstance(error, ScenarioError):
                raise error.under("network.graph") from None
            raise

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

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """One line each about what a user should know before anything runs."""
        from netkf.scenario.records import record_notes

        notes = (
            *self.hosted.scenario_notes(self),
            *record_notes(self),
            *sampling.sampling_notes(self),
        )
        return (*self.topology.notes, *notes)

    @property
    def slotted(self) -> bool:
        """Whether the scenario runs in slots, else in continuous time."""
        return isinstance(self.plant, LinearPlant)

    @property
    def slot_plant(self) -> LinearPlant:
        """The plant of a scenario in slots; raises TheoryError for one in continuous time."""
        if not isinstance(self.plant, LinearPlant):
            raise TheoryError("this is about scenarios in slots, and the plant is a diffusion")
        return self.plant

    @cached_property
    def slots(self) -> tuple[int, ...]:
        """Numbers of the slots that are sampled."""
        period = self.slot_plant.period
        return tuple(round(t / period) for t in self.times.tolist())

    @property
    def ends(self) -> float:
        """When the last thing may happen: the horizon, or the end of the slot that begins there
        where a sample shows what is known after the exchanges of its slot.
        """
        if not self.slotted or self.hosted.predicts:
            return self.horizon
        return self.horizon + self.slot_plant.period

    @property
    def phase_length(self) -> float:
        """Seconds that an exchange of a slot lasts; its steps share them evenly."""
        activation = self.network.activation
        assert isinstance(activation, SlotActivation)
        if activation.phase is not None:
            return activation.phase
        return 0.5 * self.slot_plant.period / max(1, (self.hosted.schedule or ()).count("exchange"))

    @cached_property
    def slot_belief(self) -> tuple[FloatArray, FloatArray]:
        """``F`` and ``Q`` (n, n) as the filters have them."""
        plant, model = self.slot_plant, self.filter.model
        return (
            plant.F if model.F is None else model.F,
            plant.Q if model.Q is None else model.Q,
        )

    @cached_property
    def slot_models(self) -> tuple[SlotModel, ...]:
        """What each node believes, in the order of ``nodes``; H of slot 0 where H is random."""
        return tuple(
            self._slot_model(self._stacked(self.placed.get(node, ()), believed=True))
            for node in self.nodes
        )

    def _slot_model(self, observation: tuple[FloatArray, FloatArray]) -> SlotModel:
        return SlotModel(*self.slot_belief, *observation, self.slot_plant.period)

    @cached_property
    def hosted(self) -> Filter:
        """The filter of every node, as engines call it."""
        return adapt(self.filter.algorithm)

    @cached_property
    def node_infos(self) -> tuple[NodeInfo, ...]:
        """What each node may know about itself and the network, in the order of ``nodes``."""
        information = np.zeros((self.plant.n, self.plant.n))
        for node in self.nodes:
            H, R = self._stacked(self.placed.get(node, ()), believed=True)
            information = information + symmetric(H.T @ np.linalg.solve(R, H))
        degrees, own, size = self.topology.degrees, self.own_weights, len(self.nodes)
        receivers = dict.fromkeys(self.nodes, 0)
        for sender, _ in self.topology.directions:
            receivers[sender] += 1
        delay = 0.0 if self.slotted else self.network.channel.delay.longest
        return tuple(
            NodeInfo(node, degrees[node], receivers[node], size, own[node], information, delay)
            for node in self.nodes
        )

    @property
    def believed_models(self) -> tuple[SlotModel, ...] | tuple[FlowModel, ...]:
        """What each node believes, in the order of ``nodes``."""
        return self.slot_models if self.slotted else self.models

    @property
    def believed_pooled_model(self) -> SlotModel | FlowModel:
        """The model of a filter that reads the sensors of all nodes at once."""
        return self.pooled_slot_model if self.slotted else self.pooled_model

    @cached_property
    def pooled_slot_model(self) -> SlotModel:
        """The model of a filter that reads the sensors of all nodes at once."""
        return self._slot_model(self._stacked(self._everywhere, believed=True))

    @cached_property
    def truth(self) -> Diffusion:
        """The diffusion with every default filled in; raises TheoryError for a plant in slots."""
        plant = self.plant
        if not isinstance(plant, Diffusion):
            raise TheoryError("this is about scenarios in continuous time, and this one has slots")
        filled = dataclasses.replace(plant, mean=plant.start_mean, cov=plant.start_cov)
        if filled.sensing_period is not None or not sampling.uses_grid(self):
            return filled
        seen = (self.observation(node) for node in self.increment_sensors)
        distinct = {(H.tobytes(), R.tobytes()): (H, R) for H, R in seen}.values()
        informations = [H.T @ np.linalg.solve(R, H) for H, R in distinct]
        everything = self._stacked(self._everywhere, believed=False)
        longest = longest_interval(plant.A, plant.Q, *everything)
        period = default_sensing_period(filled, informations, longest)
        return dataclasses.replace(filled, sensing_period=period)

    @cached_property
    def placed(self) -> dict[int, tuple[Placed, ...]]:
        """The sensors of each node that has any."""
        found: dict[int, list[Placed]] = {}
        for entry, sensor in enumerate(self.sensors):
            for node in sensor.nodes:
                here = found.setdefault(node, [])
                here.append(Placed(entry, len(here)))
        return {node: tuple(found[node]) for node in sorted(found)}

    def continuous_truth(self, streams: Streams) -> Any:
        """The state of one run in continuous time, in frames where they are used; asked for at
        sample times, probe times and frame times, in order (plants.truth.ContinuousTruth).
        """
        return sampling.continuous_truth(self, streams, self.exact_errors)

    def slot_truth(self, streams: Streams) -> Any:
        """The state of one run in slots, in frames where they are used."""
        return self.slot_plant.truth(streams.generator("plant"), self.exact_errors)

    @cached_property
    def exact_errors(self) -> bool:
        """Whether errors are simulated in frames, so that they keep their digits however far an
        unstable plant has gone.
        """
        return sampling.exact_errors(self)

    def moved_back(self, offset: FloatArray, age: float) -> FloatArray:
        """The state (n,) from which the plant alone would come to ``offset`` in ``age`` seconds."""
        if self.slotted:
            return offset
        return np.asarray(scipy.linalg.expm(-age * self.truth.A) @ offset)

    @property
    def sensing(self) -> tuple[int, ...]:
        """Ids of the nodes that have a sensor."""
        return tuple(self.placed)

    def observation(self, node: int, believed: bool = False) -> tuple[FloatArray, FloatArray]:
        """``H`` (p, n) and ``R`` (p, p) of all sensors of a node together, over a diffusion of
        those that give increments; p may be 0. With ``believed``, R is what the filter takes it to
        be. Raises TheoryError where H differs from slot to slot.
        """
        placed = (self.placed if self.slotted else self.increment_sensors).get(node, ())
        if any(self.sensors[place.entry].varying for place in placed):
            raise TheoryError(f"node {node} has a regressor sensor, whose H is random")
        return self._stacked(placed, believed)

    def _stacked(self, placed: tuple[Placed, ...], believed: bool) -> tuple[FloatArray, FloatArray]:
        H = [self.sensors[place.entry].H for place in placed]
        R = [self.noise(place.entry, believed) for place in placed]
        empty = np.zeros((0, self.plant.n))
        return np.concatenate([empty, *H]), block_diagonal(R)

    @cached_property
    def increment_sensors(self) -> dict[int, tuple[Placed, ...]]:
        """The sensors of each node that give increments of a diffusion; empty in slots."""
        return sampling.increment_sensors(self)

    @cached_property
    def sampled_sensors(self) -> dict[int, tuple[Placed, ...]]:
        """The sensors of each node that sample a diffusion; empty in slots."""
        return sampling.sampled_sensors(self)

    def sample_times(self, streams: Streams) -> dict[tuple[int, int], FloatArray]:
        """The increasing times below the horizon at which each sensor (node, ordinal) samples."""
        return sampling.sample_times(self, streams)

    def sample_path(self, streams: Streams, node: int, place: Placed) -> Samples:
        """The samples of one sensor of a node in one run in continuous time."""
        return sampling.sample_path(self, streams, node, place)

    def slot_path(self, streams: Streams, node: int, place: Placed) -> Readings:
        """The readings of one sensor of a node in one run in slots."""
        sensor, period = self.sensors[place.entry], self.slot_plant.period
        return sensor.slot_path(
            node, period, lambda purpose: streams.generator(purpose, node, place.ordinal)
        )

    def noise(self, entry: int, believed: bool) -> FloatArray:
        """R (p, p) of a ``[[sensors]]`` entry, as it is or as the filters believe it."""
        R = self.filter.model.R
        if not believed or R is None:
            return self.sensors[entry].R
        return R[entry] if isinstance(R, tuple) else R

    @cached_property
    def belief(self) -> tuple[FloatArray, FloatArray]:
        """``A`` and ``Q = B B'`` (n, n) as the filters have them."""
        model = self.filter.model
        plant = self.truth
        A = plant.A if model.A is None else model.A
        B = plant.B if model.B is None else model.B
        return A, np.asarray(B @ B.T)

    @property
    def is_random(self) -> bool:
        """Whether runs draw the state and all readings; else nobody knows their law."""
        return self.plant.is_random and all(sensor.is_random for sensor in self.sensors)

    @property
    def filters_know_the_truth(self) -> bool:
        """Whether the filters have the plant's matrices and the sensors' R."""
        plant = self.plant
        if not self.is_random:
            return False
        if isinstance(plant, LinearPlant):
            pairs = [*zip(self.slot_belief, (plant.F, plant.Q), strict=True)]
        else:
            pairs = [*zip(self.belief, (self.truth.A, self.truth.Q), strict=True)]
        pairs += [(self.noise(k, True), self.noise(k, False)) for k in range(len(self.sensors))]
        return all(np.array_equal(believed, true) for believed, true in pairs)

    @cached_property
    def models(self) -> tuple[FlowModel, ...]:
        """What each node believes, in the order of ``nodes``; equal models are one object."""
        made: dict[bytes, FlowModel] = {}
        return tuple(
            self._model(self.observation(node, believed=True), made) for node in self.nodes
        )

    @cached_property
    def pooled_model(self) -> FlowModel:
        """The model of a filter that reads the sensors of all nodes at once."""
        return self._model(self._stacked(self._everywhere, believed=True), {})

    @property
    def _everywhere(self) -> tuple[Placed, ...]:
        placed = self.placed if self.slotted else self.increment_sensors
        return tuple(place for places in placed.values() for place in places)

    def _model(
        self, observation: tuple[FloatArray, FloatArray], made: dict[bytes, FlowModel]
    ) -> FlowModel:
        H, R = observation
        key = b"".join((H.tobytes(), b"|", R.tobytes()))
        if key not in made:
            interval = self.truth.sensing_period or 0.0
            made[key] = FlowModel(*self.belief, H, R, self.horizon, min(interval, self.horizon))
        return made[key]

    def start(self, node: int) -> tuple[FloatArray, FloatArray]:
        """``xhat`` (n,) and ``P`` (n, n) of a node at time 0."""
        index, mean, cov = self.topology.index[node], self.filter.mean, self.filter.cov
        first = self.plant.start_mean if mean is None else mean
        spread = self.plant.start_cov if cov is None else cov
        return (
            first[index] if isinstance(first, tuple) else first,
            spread[index] if isinstance(spread, tuple) else spread,
        )

    def weight(self, receiver: int, sender: int) -> float:
        """The weight a node gives to a message: pi_ij of H (7), a_ji of D (8)."""
        algorithm, topology = self.hosted, self.topology
        given = algorithm.pair_weights
        if given is not None:
            return float(given[topology.index[sender], topology.index[receiver]])
        return algorithm.weight(topology.degrees[receiver], topology.degrees[sender])

    @cached_property
    def own_weights(self) -> dict[int, float]:
        """What is left to each node when the messages of all its neighbours arrive together."""
        own = dict.fromkeys(self.nodes, 1.0)
        for sender, receiver in self.topology.directions:
            own[receiver] -= self.weight(receiver, sender)
        return {node: max(value, 0.0) for node, value in own.items()}

    def table_probability(self, link: Link) -> float:
        """The delivery probability of a direction in the graph's table, 1 where it has none."""
        delivery = self.topology.delivery
        return 1.0 if delivery is None else delivery.get(link, 0.0)

    def effective_rates(self) -> dict[Link, float]:
        """Messages per second that arrive on each direction (sender, receiver) in the long run;
        nan where that is not known beforehand.
        """
        clock, loss = self.network.activation, self.network.channel.loss
        if not isinstance(clock, LinkClock) or not self.filter.algorithm.talks:
            return {}
        return {
            link: self._send_rate(clock, link)
            * loss.mean_delivery(link, self.table_probability(link))
            for link in self.topology.directions
        }

    def _send_rate(self, clock: LinkClock, direction: Link) -> float:
        sender, receiver = direction
        if clock.at == "readings":
            return sampling.sample_rate(self, sender)
        entities = {
            "links": (min(sender, receiver), max(sender, receiver)),
            "directions": direction,
            "nodes": (sender,),
        }
        return clock.mean_rate(entities[clock.at])
