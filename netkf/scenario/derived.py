"""Functions of a scenario: the models and weights of its nodes, and the truth of one run."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from netkf.algorithms.filter import NetworkInfo, NodeInfo, commutes
from netkf.algorithms.kernels.gains import longest_interval_for
from netkf.algorithms.models import FlowModel, SlotModel
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal, symmetric
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Link
from netkf.plants.diffusion import Diffusion, default_sensing_period
from netkf.plants.linear import LinearPlant, Readings
from netkf.plants.recorded import RecordedDiffusion, UnknownDiffusion
from netkf.plants.sampling import Samples
from netkf.plants.sensors import Sensor
from netkf.plants.transitions import frame_period, frame_slots
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor, ScenarioModel
from netkf.scenario.sampling import (
    all_sample_times,
    require_states,
    sample_path,
    sample_rate,
    sample_times,
    uses_grid,
)


@dataclass(frozen=True, eq=False, repr=False)
class DerivedScenario(ScenarioModel):
    """A scenario with everything that engines and theory compute from its fields."""

    @cached_property
    def slot_belief(self) -> tuple[FloatArray, FloatArray]:
        """The matrices ``F`` and ``Q`` (n, n) that the filters use in slots."""
        plant, model = self.slot_plant, self.filter.model
        return (
            plant.F if model.F is None else model.F,
            plant.Q if model.Q is None else model.Q,
        )

    @cached_property
    def slot_models(self) -> tuple[SlotModel, ...]:
        """The model of each node in slots, in the order of ``nodes``; random H as in slot 0."""
        return tuple(
            self._slot_model(self._stacked(self.placed_sensors.get(node, ()), believed=True))
            for node in self.nodes
        )

    def _slot_model(self, observation: tuple[FloatArray, FloatArray]) -> SlotModel:
        """Return the believed model in slots with these H and R."""
        return SlotModel(*self.slot_belief, *observation, self.slot_plant.period)

    @cached_property
    def node_infos(self) -> tuple[NodeInfo, ...]:
        """The facts that each node may use about itself and the network, in order of ``nodes``."""
        information = np.zeros((self.plant.n, self.plant.n))
        for one in self._informations:
            information = information + one
        degrees, own, size = self.topology.degrees, self.own_weights, len(self.nodes)
        receivers = dict.fromkeys(self.nodes, 0)
        for sender, _ in self.topology.directions:
            receivers[sender] += 1
        delay = 0.0 if self.slotted else self.network.channel.delay.longest
        network = self._network_info
        return tuple(
            NodeInfo(
                node, degrees[node], receivers[node], size, own[node], information, delay, k,
                network,
            )
            for k, node in enumerate(self.nodes)
        )  # fmt: skip

    @property
    def _informations(self) -> Iterator[FloatArray]:
        """``H' R^-1 H`` (n, n) of the sensors of each node, as the filters believe it."""
        for node in self.nodes:
            H, R = self._stacked(self.placed_sensors.get(node, ()), believed=True)
            yield symmetric(H.T @ np.linalg.solve(R, H))

    @property
    def _network_info(self) -> NetworkInfo | None:
        """The whole network, for filters that ask for it."""
        if not self.node_filter.needs_network:
            return None
        heard: dict[int, list[int]] = {node: [] for node in self.nodes}
        for sender, receiver in self.topology.directions:
            heard[receiver].append(self.topology.index[sender])
        indices = tuple(tuple(sorted(heard[node])) for node in self.nodes)
        return NetworkInfo(np.stack(list(self._informations)), indices)

    @property
    def believed_models(self) -> tuple[SlotModel, ...] | tuple[FlowModel, ...]:
        """The model of each node, in the order of ``nodes``."""
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
    def diffusion(self) -> Diffusion:
        """The diffusion with every default filled in; raises TheoryError for a plant in slots."""
        plant = self.plant
        if not isinstance(plant, Diffusion):
            raise TheoryError("this is about scenarios in continuous time, and this one has slots")
        filled = dataclasses.replace(plant, mean=plant.start_mean, cov=plant.start_cov)
        if filled.sensing_period is not None or not uses_grid(self):
            return filled
        sensing = Counter(
            tuple(placed_sensor.entry for placed_sensor in placed)
            for placed in self.increment_sensors.values()
        )
        informations = [self._true_information(entries) for entries in sensing]
        # A matrix of all readings at once would grow with the square of the network.
        G = sum((k * g for k, g in zip(sensing.values(), informations, strict=True)), 0.0 * plant.A)
        longest = longest_interval_for(plant.A, plant.Q, G)
        period = default_sensing_period(filled, informations, longest)
        return dataclasses.replace(filled, sensing_period=period)

    def _true_information(self, entries: tuple[int, ...]) -> FloatArray:
        """Return ``H' R^-1 H`` (n, n) of the increments of a node with these sensors."""
        H, R = self._stack(entries, believed=False)
        return np.asarray(H.T @ np.linalg.solve(R, H))

    def continuous_truth(self, streams: Streams, frames: bool | None = None) -> Any:
        """Return the state of one run in continuous time.

        It can be asked, in increasing order, for sample times, probe times and frame times. Its
        class is ``DiffusionPath`` with increments, else ``SampledTruth`` or ``RecordedTruth``
        (plants.truth.ContinuousTruth). ``frames`` are used by default where errors are exact.
        Raises ScenarioError if a recorded truth has no row for one of the times.
        """
        frames = self.exact_errors if frames is None else frames
        times = sample_times(self, streams)
        plant, horizon = self.diffusion, self.horizon
        if isinstance(plant, (RecordedDiffusion, UnknownDiffusion)):
            require_states(self, times)
            return plant.recorded_truth
        sampled = all_sample_times(times)
        random, probing = streams.generator("plant"), streams.generator("probe")
        if not uses_grid(self):
            return plant.sampled_truth(random, probing, sampled, self.times, horizon, frames)
        sample_random = streams.generator("samples") if len(sampled) else None
        return plant.path(random, probing, self.times, sample_random, sampled, horizon, frames)

    def slot_truth(self, streams: Streams) -> Any:
        """Return the state of one run in slots, in frames if errors are exact."""
        return self.slot_plant.truth(streams.generator("plant"), self.exact_errors)

    @cached_property
    def exact_errors(self) -> bool:
        """True if errors are simulated in frames, so that they keep their digits.

        This needs an unstable plant whose state and readings are all drawn, and filters that have
        its A (in slots F) and commute with a shift of the state; see plants.truth.
        """
        # Readings that are not linear depend on where the origin is.
        if not self.is_random or not self.is_linear or not commutes(self.node_filter):
            return False
        plant = self.plant
        if isinstance(plant, LinearPlant):
            same = np.array_equal(self.slot_belief[0], plant.F)
            return same and frame_slots(plant.F) is not None
        same = np.array_equal(self.belief[0], self.diffusion.A)
        return same and frame_period(self.diffusion.A) is not None

    def move_back(self, offset: FloatArray, age: float) -> FloatArray:
        """Return the state (n,) that the plant without noise moves to ``offset`` in ``age`` s."""
        if self.slotted:
            return offset
        return np.asarray(scipy.linalg.expm(-age * self.diffusion.A) @ offset)

    def observation_matrices(
        self, node: int, believed: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return ``H`` (p, n) and ``R`` (p, p) of all sensors of a node together, over a diffusion
        of those that give increments; p may be 0. With ``believed``, R is what the filter takes it
        to be. Raises TheoryError where H differs from slot to slot.
        """
        placed = (self.placed_sensors if self.slotted else self.increment_sensors).get(node, ())
        for sensor in (self.sensors[placed_sensor.entry] for placed_sensor in placed):
            if sensor.varying:
                what = (
                    "a regressor sensor, whose H is random" if sensor.linear else "no linear sensor"
                )
                raise TheoryError(f"node {node} has {what}")
        return self._stacked(placed, believed)

    def _stacked(
        self, placed: tuple[PlacedSensor, ...], believed: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return the stacked H (p, n) and block diagonal R (p, p) of some sensors of nodes."""
        return self._stack(tuple(placed_sensor.entry for placed_sensor in placed), believed)

    def _stack(self, entries: tuple[int, ...], believed: bool) -> tuple[FloatArray, FloatArray]:
        """Return the stacked H and R of some ``[[sensors]]`` entries, from the cache if known."""
        # Thousands of nodes may have the sensors of one [[sensors]] entry.
        if (entries, believed) not in self._stacks:
            H = [self.sensors[entry].matrix_of(self.plant.n) for entry in entries]
            R = [self.noise_covariance(entry, believed=believed) for entry in entries]
            empty = np.zeros((0, self.plant.n))
            self._stacks[entries, believed] = np.concatenate([empty, *H]), block_diagonal(R)
        return self._stacks[entries, believed]

    @cached_property
    def _stacks(self) -> dict[tuple[tuple[int, ...], bool], tuple[FloatArray, FloatArray]]:
        """Cache of stacked H and R by entries and by whether R is the believed one."""
        return {}

    def sample_times(self, streams: Streams) -> dict[tuple[int, int], FloatArray]:
        """Return the times at which each sensor (node, ordinal) samples, below the horizon."""
        return sample_times(self, streams)

    def sample_path(self, streams: Streams, node: int, placed_sensor: PlacedSensor) -> Samples:
        """Return the samples of one sensor of a node in one run in continuous time."""
        return sample_path(self, streams, node, placed_sensor)

    def slot_path(self, streams: Streams, node: int, placed_sensor: PlacedSensor) -> Readings:
        """Return the readings of one sensor of a node in one run in slots."""
        sensor: Sensor = self.located_sensors[placed_sensor.entry]
        period = self.slot_plant.period
        return sensor.slot_path(
            node, period, lambda purpose: streams.generator(purpose, node, placed_sensor.ordinal)
        )

    @cached_property
    def belief(self) -> tuple[FloatArray, FloatArray]:
        """The matrices ``A`` and ``Q = B B'`` (n, n) that the filters use."""
        model = self.filter.model
        plant = self.diffusion
        A = plant.A if model.A is None else model.A
        B = plant.B if model.B is None else model.B
        return A, np.asarray(B @ B.T)

    @property
    def filters_know_the_truth(self) -> bool:
        """True if the filters use the plant's own matrices and the sensors' own R."""
        plant = self.plant
        if not self.is_random:
            return False
        if isinstance(plant, LinearPlant):
            pairs = [*zip(self.slot_belief, (plant.F, plant.Q), strict=True)]
        else:
            pairs = [*zip(self.belief, (self.diffusion.A, self.diffusion.Q), strict=True)]
        pairs += [
            (self.noise_covariance(k, believed=True), self.noise_covariance(k, believed=False))
            for k in range(len(self.sensors))
        ]
        return all(np.array_equal(believed, true) for believed, true in pairs)

    @cached_property
    def models(self) -> tuple[FlowModel, ...]:
        """The model of each node in continuous time; equal models are one object."""
        made: dict[bytes, FlowModel] = {}
        return tuple(
            self._model(self.observation_matrices(node, believed=True), made) for node in self.nodes
        )

    @cached_property
    def pooled_model(self) -> FlowModel:
        """The model of a filter that reads the sensors of all nodes at once."""
        return self._model(self._stacked(self._everywhere, believed=True), {})

    @property
    def _everywhere(self) -> tuple[PlacedSensor, ...]:
        """All sensors that a pooled filter reads."""
        placed = self.placed_sensors if self.slotted else self.increment_sensors
        return tuple(one for sensors in placed.values() for one in sensors)

    def _model(
        self, observation: tuple[FloatArray, FloatArray], made: dict[bytes, FlowModel]
    ) -> FlowModel:
        """Return the believed model in continuous time, one object for equal H and R."""
        H, R = observation
        key = b"".join((H.tobytes(), b"|", R.tobytes()))
        if key not in made:
            interval = self.diffusion.sensing_period or 0.0
            made[key] = FlowModel(*self.belief, H, R, self.horizon, min(interval, self.horizon))
        return made[key]

    def initial_estimate(self, node: int) -> tuple[FloatArray, FloatArray]:
        """Return ``xhat`` (n,) and ``P`` (n, n) of a node at time 0."""
        index, mean, cov = self.topology.index[node], self.filter.mean, self.filter.cov
        first = self.plant.start_mean if mean is None else mean
        spread = self.plant.start_cov if cov is None else cov
        return (
            first[index] if isinstance(first, tuple) else first,
            spread[index] if isinstance(spread, tuple) else spread,
        )

    def weight(self, receiver: int, sender: int) -> float:
        """Return the weight that ``receiver`` gives to messages of ``sender``.

        It is pi_ij of H (7) and a_ji of D (8).
        """
        algorithm, topology = self.node_filter, self.topology
        given = algorithm.pair_weights
        if given is not None:
            return float(given[topology.index[sender], topology.index[receiver]])
        return algorithm.weight(topology.degrees[receiver], topology.degrees[sender])

    @cached_property
    def own_weights(self) -> dict[int, float]:
        """The weight that remains to each node if messages of all its neighbours arrive."""
        own = dict.fromkeys(self.nodes, 1.0)
        for sender, receiver in self.topology.directions:
            own[receiver] -= self.weight(receiver, sender)
        return {node: max(value, 0.0) for node, value in own.items()}

    def effective_rates(self) -> dict[Link, float]:
        """Return the messages per second that arrive on each direction in the long run.

        Keys are (sender, receiver); values are nan if they are unknown before a run.
        """
        return dict(self._effective_rates)

    @cached_property
    def _effective_rates(self) -> dict[Link, float]:
        """Rates at which messages arrive on each direction, per second; empty in slots."""
        clock, loss = self.network.activation, self.network.channel.loss
        if not isinstance(clock, LinkClock) or not self.filter.algorithm.talks:
            return {}
        return {
            link: self._send_rate(clock, link)
            * loss.mean_delivery(link, self.table_probability(link))
            for link in self.topology.directions
        }

    def _send_rate(self, clock: LinkClock, direction: Link) -> float:
        """Return the messages per second that a direction carries."""
        sender, receiver = direction
        if clock.at == "readings":
            return sample_rate(self, sender)
        entities = {
            "links": (min(sender, receiver), max(sender, receiver)),
            "directions": direction,
            "nodes": (sender,),
        }
        return clock.mean_rate(entities[clock.at])
