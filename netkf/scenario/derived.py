"""Values that engines and theory compute from the fields of a scenario."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
import scipy

from netkf.algorithms.filter import UNKNOWN, NetworkInfo, NodeInfo, commutes
from netkf.algorithms.kernels.gains import longest_interval
from netkf.algorithms.models import (
    ChangingFlowModel,
    FlowModel,
    MapModel,
    RateModel,
    SlotModel,
    changing_models,
)
from netkf.algorithms.modes import rate_groups
from netkf.algorithms.traits import Weights
from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import probability
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray, block_diagonal, is_definite, symmetric
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Link
from netkf.plants.blocks import blocks_from
from netkf.plants.changes import dividing_period
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion, default_sensing_period
from netkf.plants.driven import InputResponses, MovedReadings, driven
from netkf.plants.faults import FaultyReadings
from netkf.plants.linear import LinearPlant, Readings
from netkf.plants.maps import NonlinearPlant
from netkf.plants.response import Difference, FlowResponse, Response, SlotResponse
from netkf.plants.sampling import Samples
from netkf.plants.sensors import Sensor
from netkf.plants.states import PartlyDrawnTruth, RecordedPath, StackedStates
from netkf.plants.transitions import frame_period, frame_slots
from netkf.rng.streams import Streams
from netkf.scenario import sampling
from netkf.scenario.block_sensors import support_of
from netkf.scenario.model import PlacedSensor, ScenarioModel
from netkf.scenario.positions import tick_times

MAX_DECAY = float(np.log(1e8))
"""Largest decay of a mode, as a logarithm, over which an offset of states is predicted back."""

Made = TypeVar("Made")


@dataclass(frozen=True, eq=False, repr=False)
class DerivedScenario(ScenarioModel):
    """A scenario with everything that engines and theory compute from its fields.

    A "believed" matrix is the one that the filters use: that of ``filter.model`` where it is given,
    else the true one. A scenario is in slots (``slotted``) or in continuous time, where sensors
    give increments dy = H x dt + dv or take samples y = H x + v. "Pooled" is a central filter that
    reads the sensors of all nodes.
    """

    @property
    def slot_belief(self) -> tuple[FloatArray, FloatArray]:
        """``F`` and ``Q`` (n, n) of filters in slots; TheoryError if the plant changes."""
        _ = self.linear_plant
        self._require_one_piece()
        return self.believed_pieces[0]

    @property
    def belief(self) -> tuple[FloatArray, FloatArray]:
        """``A`` and ``Q = B B'`` (n, n) of filters; TheoryError if the plant changes."""
        _ = self.diffusion
        self._require_one_piece()
        return self.believed_pieces[0]

    def _require_one_piece(self) -> None:
        if len(self.plant.changes):
            raise TheoryError(
                "this is about plants that do not change, and this one does (plant.schedule); "
                "scenario.last_piece is the one after all changes"
            )

    @cached_property
    def last_piece(self) -> Self:
        """The scenario with the plant after all its changes, and what filters believe then."""
        number, cov = len(self.plant.changes), self.filter.cov
        if not number:
            return self
        try:
            return self.piece(number)
        except ScenarioError:
            # Filters that invert P need a definite one at the start of every piece: the noise of
            # those before has driven every state by then.
            starts = (
                cov if isinstance(cov, tuple) else (self.plant.start_cov if cov is None else cov,)
            )
            wide = tuple(P + np.eye(len(P)) for P in starts)
            return self.piece(number, wide if isinstance(cov, tuple) else wide[0])

    def piece(self, number: int, cov: tuple[FloatArray, ...] | FloatArray | None = None) -> Self:
        """Return this scenario with a plant that is always as in one piece, and what filters
        believe then; they start with ``cov``, (n, n) of each node or of all.
        """
        names = "FQ" if self.slotted else "AB"
        plants: Any = self.plant.pieces
        now, believed = plants[number], plants[number if self.filter.model.schedule else 0]
        matrices: dict[str, Any] = {name: getattr(now, name) for name in names}
        if not self.slotted:
            matrices["sensing_period"] = self.diffusion.sensing_period
        if (u := self.plant.input) is not None:
            matrices["input"] = dataclasses.replace(u, G=self.plant.input_gains[number])
        wrong = {
            name: getattr(believed, name)
            for name in names
            if believed is not now and getattr(self.filter.model, name) is None
        }
        filtering = dataclasses.replace(
            self.filter, model=dataclasses.replace(self.filter.model, **wrong)
        )
        if cov is not None:
            filtering = dataclasses.replace(filtering, cov=cov)
        if self.plants:
            start = self.plant.changes[number - 1] if number else -math.inf
            keys = {} if self.slotted else {"sensing_period": matrices["sensing_period"]}
            blocks = tuple(blocks_from(self.plants, start, **keys))
            return dataclasses.replace(
                self, plants=blocks, sensors=self.declared_sensors, filter=filtering
            )
        plant = dataclasses.replace(self.plant, **matrices, schedule=())  # type: ignore[call-arg]
        return dataclasses.replace(self, plant=plant, filter=filtering)

    @cached_property
    def followed_changes(self) -> FloatArray:
        """Times (C,) in seconds, below the horizon, of changes that filters follow."""
        changes = self.plant.changes
        return changes[changes < self.horizon] if self.filter.model.schedule else changes[:0]

    @cached_property
    def believed_pieces(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """The filters' F and Q in slots, A and Q = B B' otherwise, all (n, n), at first and after
        each of ``followed_changes``; F and A are nan if not linear.
        """
        model, plant = self.filter.model, self.plant
        pieces: Any = plant.pieces[: 1 + len(self.followed_changes)]
        if not plant.linear:
            return ((np.full((plant.n, plant.n), math.nan), self.believed_noises[1][0]),)
        if isinstance(plant, LinearPlant):
            return tuple(
                (p.F if model.F is None else model.F, p.Q if model.Q is None else model.Q)
                for p in pieces
            )
        roots = [p.B if model.B is None else model.B for p in pieces]
        return tuple(
            (p.A if model.A is None else model.A, np.asarray(B @ B.T))
            for p, B in zip(pieces, roots, strict=True)
        )

    @cached_property
    def estimated_pieces(self) -> tuple[tuple[tuple[FloatArray, FloatArray], ...], ...]:
        """The ``believed_pieces`` of what each node estimates; once if all estimate all."""
        nodes = range(1 if self.views is None else len(self.nodes))
        of, pieces = self.estimated_part, self.believed_pieces
        return tuple(tuple((of(k, F), of(k, Q)) for F, Q in pieces) for k in nodes)

    def estimated_part(self, k: int, M: FloatArray) -> FloatArray:
        """Return the rows and columns (n', n') of M (n, n) that node number ``k`` estimates."""
        return _part(M, self.view(k))

    @cached_property
    def model_pieces(self) -> tuple[tuple[Any, ...], ...]:
        """The models of all nodes, or of a pooled filter, in each of ``believed_pieces``."""
        pooled, names = self.node_filter.timing.pooled, "FQ" if self.slotted else "AQ"
        first = (self._pooled_model,) if pooled else self._node_models
        pieces: list[tuple[Any, ...]] = [first]
        for matrices in self.believed_pieces[1:]:
            changed = dict(zip(names, matrices, strict=True))
            if self.model_views is not None and not pooled:
                views = zip(first, self.model_views, strict=True)
                parts = ((m, {n: M[v][:, v] for n, M in changed.items()}) for m, v in views)
                pieces.append(tuple(dataclasses.replace(model, **part) for model, part in parts))
                continue
            # Equal models stay one object.
            models = {id(model): dataclasses.replace(model, **changed) for model in first}
            pieces.append(tuple(models[id(model)] for model in first))
        return tuple(pieces)

    def model_of(self, entity: int) -> Any:
        """Return the model of a node by index, 0 for a pooled filter; of a run if it changes, or if
        increments come only while the node is up.
        """
        changes = self.followed_slots if self.slotted else self.followed_changes.tolist()
        pieces = [models[entity] for models in self.model_pieces]
        if self.nodes[entity] in self.waking_nodes and not changes:
            return ChangingFlowModel(pieces, changes)
        return changing_models([[model] for model in pieces], changes)[0]

    @cached_property
    def waking_nodes(self) -> frozenset[int]:
        """The nodes (ids) that are down at times and have sensors that give increments."""
        lives = self.network.lives
        return frozenset(i for one in lives for i in one.nodes).intersection(self.increment_sensors)

    @property
    def followed_slots(self) -> tuple[int, ...]:
        """The slots (C,) of the changes of the plant that filters follow."""
        period = self.slot_plant.period
        return tuple(round(t / period) for t in self.followed_changes.tolist())

    def slot_belief_from(self, slot: int) -> tuple[FloatArray, FloatArray]:
        """Return ``F`` and ``Q`` (n, n) by which filters predict from a ``slot`` to the next."""
        return self.believed_pieces[bisect.bisect_right(self.followed_slots, slot)]

    @property
    def model_slots(self) -> tuple[int, ...]:
        """The slots (C,) from which on filters believe the next piece: that of a change, or the one
        after it where slots begin with the prediction.
        """
        later = not self.node_filter.timing.predicts
        return tuple(slot + later for slot in self.followed_slots)

    @property
    def slot_models(self) -> tuple[SlotModel, ...]:
        """The models of nodes in slots: F, Q, and H (of slot 0) and R of all sensors together;
        raises TheoryError if the plant changes.
        """
        self._require_one_piece()
        _ = self.slot_plant
        return self._node_models

    @property
    def models(self) -> tuple[FlowModel, ...]:
        """The models of nodes in continuous time; TheoryError if the plant changes."""
        self._require_one_piece()
        _ = self.diffusion
        return self._node_models

    @cached_property
    def _node_models(self) -> tuple[Any, ...]:
        if self.model_views is not None:
            placed = self.placed_sensors if self.slotted else self.increment_sensors
            make = self._slot_model if self.slotted else self._flow_model
            return tuple(
                make(*self._own_sensors(k, placed.get(node, ())), self.model_views[k])
                for k, node in enumerate(self.nodes)
            )
        if self.slotted:
            return _shared(self._slot_model, self._believed_stacks)
        stacks = (self.observation_matrices(node, believed=True) for node in self.nodes)
        return _shared(self._flow_model, stacks)

    @property
    def pooled_slot_model(self) -> SlotModel:
        """The model of a central filter in slots; raises TheoryError if the plant changes."""
        self._require_one_piece()
        _ = self.slot_plant
        pooled: SlotModel = self._pooled_model
        return pooled

    @cached_property
    def _pooled_model(self) -> Any:
        sensors_of_nodes = self.placed_sensors if self.slotted else self.increment_sensors
        placed = tuple(itertools.chain.from_iterable(sensors_of_nodes.values()))
        stacked = self._stack_sensors(placed, believed=True)
        return self._slot_model(*stacked) if self.slotted else self._flow_model(*stacked)

    @cached_property
    def model_views(self) -> tuple[np.ndarray, ...] | None:
        """The entries (n',) of the state of which each node has a model; None for all of it. They
        begin with those that it estimates.
        """
        views = self.views
        if views is None or not self.node_filter.needs.coupled:
            return views
        whole = np.arange(self.plant.n)
        return tuple(np.append(view, np.setdiff1d(whole, view)) for view in views)

    def model_view(self, k: int) -> Any:
        """Return the entries (n,) of which filter number ``k`` has a model, or a slice."""
        views = None if self.node_filter.timing.pooled else self.model_views
        return slice(None) if views is None else views[k]

    @property
    def model_width(self) -> int:
        """The largest number of states of which a node has a model."""
        views = self.model_views
        return self.plant.n if views is None else max(map(len, views))

    def view(self, k: int) -> Any:
        """Return the entries (n',) of the state that node number ``k`` estimates, or a slice."""
        return slice(None) if self.views is None else self.views[k]

    @cached_property
    def common_entries(self) -> dict[Link, tuple[np.ndarray, np.ndarray]]:
        """The entries (k,) that both ends of a link estimate, in the state of either, where these
        differ; empty for filters whose messages say of which blocks they speak.
        """
        if self.views is None or self.node_filter.needs.blocks or self.node_filter.timing.pooled:
            return {}
        views = dict(zip(self.nodes, self.views, strict=True))
        return {
            (i, j): np.intersect1d(views[i], views[j], return_indices=True)[1:]
            for i, j in self.topology.directions
            if not np.array_equal(views[i], views[j])
        }

    def _own_sensors(
        self, k: int, placed: tuple[PlacedSensor, ...]
    ) -> tuple[FloatArray, FloatArray]:
        """Return H (p, n') and R (p, p) of sensors of node ``k`` that read only its own states."""
        if self.model_views is None:
            return self._stack_sensors(placed, believed=True)
        view = self.model_views[k]
        own = tuple(p for p in placed if np.isin(self.support(p), view).all())
        H, R = self._stack_sensors(own, believed=True)
        return np.ascontiguousarray(H[:, view]), R

    def support(self, placed: PlacedSensor) -> np.ndarray:
        """Return the entries (k,) of the state that readings of a sensor depend on."""
        return support_of(self.sensors[placed.entry], self.plant.n)

    def _slot_model(self, H: FloatArray, R: FloatArray, view: Any = slice(None)) -> SlotModel:
        plant = self.slot_plant
        if not isinstance(plant, NonlinearPlant):
            F, Q = (_part(M, view) for M in self.believed_pieces[0])
            return SlotModel(F, Q, H, R, plant.period)
        (f, jacobian), inputs, F, noises = self._curved(plant, view)
        u = self.believed_inputs[:, inputs]
        slots = plant.slots_of(self.believed_noises[0])
        return MapModel(
            F, noises[0], H, R, plant.period, f=f, jacobian=jacobian, u=u, noises=noises,
            noise_slots=slots, linearise=self.filter.linearise,
        )  # fmt: skip

    def _curved(self, plant: Any, view: Any) -> tuple[Any, ...]:
        """Return f, its Jacobian, the numbers of its inputs, nan, and each Q of a ``view``."""
        F = _part(self.believed_pieces[0][0], view)
        noises = [_part(Q, view) for Q in self.believed_noises[1]]
        if isinstance(view, slice):
            return plant.functions, np.arange(plant.m), F, noises
        return (*plant.functions_of(view), F, noises)

    @cached_property
    def believed_inputs(self) -> FloatArray:
        """The input u (S, m) of a nonlinear plant in all slots, as the filters know it."""
        plant = self.slot_plant
        assert isinstance(plant, NonlinearPlant)
        return plant.inputs(int(self.horizon / plant.period) + 2) * self._known_inputs

    @property
    def _known_inputs(self) -> FloatArray:
        """1 for each component of the input that filters know, else 0, (m,)."""
        u = self.plant.input
        return np.zeros(0) if u is None else u.known_to(self.filter.model)

    @cached_property
    def node_infos(self) -> tuple[NodeInfo, ...]:
        """The facts about node and network that each filter is given, in the order of ``nodes``."""
        total_information = self._total_information
        senders, receivers = self.topology.senders, self.topology.receivers
        max_delay = 0.0 if self.slotted else self.longest_delay
        degrees, own_weights, network = self.topology.degrees, self.own_weights, self._network_info
        rows = [
            sum(self.most_rows(node, placed) for placed in sensors)
            for node, sensors in self.placed_sensors.items()
        ]
        most_rows = max([1, *rows])
        sampled = self.placed_sensors if self.slotted else self.sampled_sensors
        counts = Counter(itertools.chain.from_iterable(self.estimated)) if self.plants else None
        whole = self.layout.places if self.node_filter.needs.coupled else ()
        places = dict(zip(self.nodes, map(self._own_blocks, range(len(self.nodes))), strict=True))
        keys = [place.key for own in places.values() for place in own]
        numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        instants = UNKNOWN
        if self.slotted:
            instants = 2 + int(self.horizon / self.slot_plant.period)
        most_pairs = self._most_pairs if self.node_filter.needs.blocks else (1, 1)
        return tuple(
            NodeInfo(
                node, degrees[node], len(receivers(node)), len(self.nodes), own_weights[node],
                self.estimated_part(k, total_information), max_delay, k, senders(node), network,
                most_rows,
                self._own_sensors(k, sampled.get(node, ())), places[node],
                self._is_alone(k, counts), whole,
                tuple(places[i] for i in senders(node)), node in self.forgetful_nodes,
                numbers, instants, most_pairs,
            )
            for k, node in enumerate(self.nodes)
        )  # fmt: skip

    def _is_alone(self, k: int, counts: Counter[Place] | None) -> bool:
        """Return True if node number ``k`` alone estimates its blocks, which ``counts`` count."""
        if counts is None:
            return len(self.nodes) == 1
        return all(counts[place] == 1 for place in self.estimated[k])

    def _own_blocks(self, k: int) -> tuple[Place, ...]:
        """Return the blocks of node number ``k`` at their places in its own state."""
        places, first = [], 0
        for place in self.estimated[k] if self.plants else ():
            places.append(place._replace(first=first))
            first += place.n
        return tuple(places)

    @property
    def _most_pairs(self) -> tuple[int, int]:
        """The most readings of pairs that an instant has at any node, and the most rows of one."""
        counts, rows, places = [1], [1], self.layout.places
        block = np.repeat(np.arange(len(places)), [place.n for place in places])
        for node, view in zip(self.nodes, self.views or (), strict=self.views is not None):
            counts.append(0)
            for placed in self.placed_sensors.get(node, ()):
                sensor = self.sensors[placed.entry]
                if (others := np.setdiff1d(self.support(placed), view)).size:
                    p = len(sensor.R)
                    # Rows of one reading may be about several blocks, each of which is a pair.
                    about = min(p, len(np.unique(block[others]))) if sensor.record is None else 1
                    counts[-1] += about * (self.most_rows(node, placed) // p)
                    rows.append(p)
        return max(counts), max(rows)

    def most_rows(self, node: int, placed: PlacedSensor) -> int:
        """Return the most rows of a sensor at one instant: a record may have several readings."""
        sensor = self.sensors[placed.entry]
        if sensor.record is None:
            return len(sensor.R)
        if not self.slotted:
            t = self.time_grid.snap(sensor.record.rows(node).t)
            return len(sensor.R) * int(np.unique(t, return_counts=True)[1].max(initial=1))
        slots = sensor.record.slots(node, self.slot_plant.period)
        return len(sensor.R) * max(1, *map(len, slots.values()), 1)

    @property
    def informations(self) -> tuple[FloatArray, ...]:
        """Believed ``H' R^-1 H`` (n, n) of the sensors of each node, in the order of ``nodes``."""
        return _shared(lambda H, R: symmetric(H.T @ np.linalg.solve(R, H)), self._believed_stacks)

    @property
    def _total_information(self) -> FloatArray:
        total = np.zeros((self.plant.n, self.plant.n))
        if self.views is None:
            for information in self.informations:
                total = total + information
            return total
        # Those of all nodes at once would fill the memory: each has few of the states.
        for H, R in self._believed_stacks:
            own = np.flatnonzero(H.any(axis=0))
            part = H[:, own]
            total[np.ix_(own, own)] += symmetric(part.T @ np.linalg.solve(R, part))
        return total

    @property
    def _believed_stacks(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """H and R of the sensors of each node together, in the order of ``nodes``."""
        for node in self.nodes:
            yield self._stack_sensors(self.placed_sensors.get(node, ()), believed=True)

    @property
    def _network_info(self) -> NetworkInfo | None:
        """The information (N, n, n) of each node's sensors, and indices of who hears whom."""
        if not self.node_filter.needs.network:
            return None
        index, senders = self.topology.index, self.topology.senders
        sender_indices = tuple(tuple(index[i] for i in senders(node)) for node in self.nodes)
        # Such filters estimate one state at all nodes.
        informations = np.stack([self.estimated_part(0, G) for G in self.informations])
        return NetworkInfo(informations, sender_indices)

    @cached_property
    def diffusion(self) -> Diffusion:
        """The plant in continuous time, with the default mean, covariance and sensing period
        filled in; raises TheoryError for a plant in slots.
        """
        plant = self.plant
        if isinstance(plant, NonlinearDiffusion):
            raise TheoryError("this is about linear plants, and the dynamics are not linear")
        if not isinstance(plant, Diffusion):
            raise TheoryError("this is about scenarios in continuous time, and this one has slots")
        plant = dataclasses.replace(plant, mean=plant.start_mean, cov=plant.start_cov)
        plant = plant.on_grid(self.time_grid)
        if plant.sensing_period is not None or not sampling.uses_grid(self):
            return plant
        # Nodes with the same sensors are counted and not listed, and G = H' R^-1 H of all nodes is
        # a sum: H and R of all nodes at once would grow with the square of the network.
        counts = Counter(
            tuple(placed_sensor.entry for placed_sensor in sensors)
            for sensors in self.increment_sensors.values()
        )
        stacks = [self._stack_entries(entries, believed=False) for entries in counts]
        informations = [np.asarray(H.T @ np.linalg.solve(R, H)) for H, R in stacks]
        weighted = (k * G for k, G in zip(counts.values(), informations, strict=True))
        # A sum of information does not always take the shortest intervals.
        updates = [sum(weighted, 0.0 * plant.A), *informations]
        period = min(
            default_sensing_period(
                piece, informations, min(longest_interval(piece.A, piece.Q, G) for G in updates)
            )
            for piece in plant.pieces
        )
        period = dividing_period(plant.changes[plant.changes < self.horizon], period)
        return dataclasses.replace(plant, sensing_period=period).on_grid(self.time_grid)

    def continuous_truth(
        self, streams: Streams, frames: bool | None = None, sampled: FloatArray | None = None
    ) -> Any:
        """Return the true state of a run, see ``plants.truth``, to be asked in increasing order for
        sample, probe and frame times.

        ``frames``, by default ``exact_errors``: local states are relative to an origin that moves.
        ``sampled`` (K,) are drawn sample times (s). Raises ScenarioError if a truth lacks a row.
        """
        frames = self.exact_errors if frames is None else frames
        if isinstance(self.plant, NonlinearDiffusion):
            return self._nonlinear_truth(self.plant, streams, sampled)
        plant, horizon = self.diffusion, self.horizon
        recorded, on_grid = not plant.is_random, sampling.uses_grid(self)
        if sampled is None or recorded:
            by_sensor = sampling.sample_times(self, streams)
            sampling.require_states(self, by_sensor, streams)
            sampled = sampling.all_sample_times(by_sensor)
        if self.links_follow_state:
            # Of a path that is drawn at some instants only, states do not depend on which.
            sampled = np.union1d(sampled, tick_times(self, streams))
        random, probes = streams.generator("plant"), self.times
        times, responses = np.union1d(sampled, probes), self.input_responses
        truth: Any
        if not plant.draws:
            truth = plant.recorded_truth
        elif not on_grid:
            truth = plant.sampled_truth(random, times, horizon, frames)
        else:
            probe_random = streams.generator("probe")
            sample_random = streams.generator("samples") if len(sampled) else None
            forcing = None if responses is None or self.tells_models else responses.surprise
            truth = plant.path(
                random, probe_random, probes, sample_random, sampled, horizon, frames, forcing
            )
        if responses is not None:
            forced = on_grid and not self.tells_models
            shown = times if self.links_follow_state else probes
            truth = driven(truth, responses, not plant.draws, forced, (times, shown))
        return self._with_given_states(truth)

    def _nonlinear_truth(
        self, plant: NonlinearDiffusion, streams: Streams, sampled: FloatArray | None
    ) -> Any:
        if sampled is None:
            sampled = sampling.all_sample_times(sampling.sample_times(self, streams))
        if not plant.is_random:
            sampling.require_states(self, sampling.sample_times(self, streams), streams)
        if not plant.draws:
            return plant.recorded_truth
        random, *inside = map(streams.generator, ("plant", "samples", "probe"))
        # Readings do not depend on when the network ticks.
        ticks = tick_times(self, streams) if self.links_follow_state else np.empty(0)
        shown = np.union1d(self.times, ticks)
        curve = plant.curve(random, (sampled, inside[0]), (shown, inside[1]))
        return self._with_given_states(curve)

    def slot_truth(self, streams: Streams, frames: bool | None = None) -> Any:
        """Return the true state of a run in slots, a plants.linear.Truth, in ``frames`` or not."""
        frames = self.exact_errors if frames is None else frames
        plant, responses = self.slot_plant, self.input_responses
        truth: Any = RecordedPath(plant.recorded_truth, plant.period)
        if plant.draws:
            truth = plant.truth(streams.generator("plant"), frames)
        if responses is not None:
            truth = driven(truth, responses, not plant.draws)
        return self._with_given_states(truth, plant.period)

    def _with_given_states(self, truth: Any, period: float | None = None) -> Any:
        """Return a ``truth`` with the states of blocks that are recorded or unknown in it."""
        if self.plant.is_random or not self.plant.draws:
            return truth
        return PartlyDrawnTruth(truth, self.plant.record, self.origin_response, period)

    @cached_property
    def unknown(self) -> np.ndarray:
        """A mask (n,) of the states that are unknown."""
        states = self.plant.record
        if isinstance(states, StackedStates):
            return states.unknown
        return np.full(self.plant.n, not self.plant.truth_known)

    @cached_property
    def unknown_samples(self) -> tuple[np.ndarray, np.ndarray] | None:
        """``unknown``, and a mask (N, n') of unknown errors; None if all states are known."""
        if not self.unknown.any():
            return None
        of_nodes = [self.unknown[self.view(k)] for k in range(len(self.nodes))]
        return self.unknown, np.array([np.resize(m, self.width) for m in of_nodes])

    @cached_property
    def knows_input(self) -> bool:
        """True if the plant has an input and the filters know it."""
        return self.plant.input is not None and self.filter.model.input

    @property
    def misses_input(self) -> bool:
        """True if the plant has an input that the filters do not know."""
        return self.plant.input is not None and not self.filter.model.input

    @property
    def has_mistimed_models(self) -> bool:
        """True if nodes with wrong clocks know an input or changes of a linear plant."""
        told = (self.plant.linear and self.knows_input) or len(self.followed_changes) > 0
        return told and bool(self.network.clocks)

    @property
    def tells_models(self) -> bool:
        """True if models tell filters of the input: those that do not commute with a shift."""
        return self.plant.linear and self.knows_input and not commutes(self.node_filter)

    @cached_property
    def input_responses(self) -> InputResponses | None:
        """The responses to the input; None without one, or if the plant is not linear."""
        if self.plant.input is None or not self.plant.linear:
            return None
        # Recorded states have the true response in them.
        surprise = self.surprise if self.plant.draws else None
        return InputResponses(self.believed_response if self._moves_along else None, surprise)

    @property
    def origin_response(self) -> Response | None:
        """The response that estimates and their readings are counted from, ``InputResponses``'
        ``believed``; None where the origin of coordinates does not move with an input.
        """
        return None if self.input_responses is None else self.input_responses.believed

    @property
    def _moves_along(self) -> bool:
        return self.knows_input and not self.tells_models

    @cached_property
    def surprise(self) -> Response | None:
        """The response to the input that filters do not follow; None if it is 0, or not linear."""
        if self.plant.input is None or not self.plant.linear:
            return None
        pieces: Any = self.plant.pieces[: 1 + int((self.plant.changes < self.horizon).sum())]
        matrices = [piece.F if self.slotted else piece.A for piece in pieces]
        true = self._response(matrices)
        if not self._moves_along:
            return true
        known = [M for M, _ in self.believed_pieces]
        if len(known) == len(matrices) and all(map(np.array_equal, matrices, known)):
            return None
        return Difference(true, self.believed_response)

    @cached_property
    def believed_response(self) -> FlowResponse | SlotResponse:
        """The response to the input by the matrices that filters believe."""
        return self._response([M for M, _ in self.believed_pieces])

    def _response(self, matrices: Sequence[FloatArray]) -> FlowResponse | SlotResponse:
        """Return the response by F or A (n, n) of so many of the first pieces of the plant."""
        u, count = self.plant.input, len(matrices)
        assert u is not None
        pieces = list(zip(matrices, self.plant.input_gains[:count], strict=True))
        if self.slotted:
            return SlotResponse(
                pieces, self.linear_plant.change_slots[: count - 1], self.linear_plant
            )
        return FlowResponse(pieces, self.plant.changes[: count - 1], u)

    def origins(self, times: np.ndarray, local: FloatArray, x: FloatArray) -> FloatArray:
        """Return where coordinates of filters begin at ``times`` (K,), (K, n), from ``local`` and
        absolute states, or from what is known where the truth is recorded.
        """
        if self.plant.is_random or self.input_responses is None:
            # A state that is not known has no coordinates but those of the filters. One that passed
            # the largest number is not a number either, but it was known in its frame.
            return np.where(np.isnan(local), 0.0, x - local)
        believed = self.origin_response
        return np.zeros(x.shape) if believed is None else believed.states(times)

    @cached_property
    def undriven(self) -> Self:
        """The scenario without input; itself if its plant is not linear."""
        if self.plant.input is None or not self.plant.linear:
            return self
        if not self.plants:
            return dataclasses.replace(self, plant=_undriven(self.plant))
        blocks = [dataclasses.replace(one, plant=_undriven(one.plant)) for one in self.plants]
        return dataclasses.replace(self, plants=tuple(blocks), sensors=self.declared_sensors)

    @cached_property
    def exact_errors(self) -> bool:
        """True if errors are simulated in frames, so that they keep their digits.

        On an unstable plant x and xhat grow beyond the size at which x - xhat has correct digits; a
        frame is an interval in which both are taken relative to an origin near x (plants.truth).
        This needs a plant whose state and readings are all drawn, linear sensors, filters that
        believe the true A (in slots F) and commute with a shift of the state, and growth so fast
        that a second frame begins before the horizon, or an input moves the origin in any case.
        """
        # Nonlinear readings depend on the absolute state.
        if not self.is_random or not self.is_linear or not commutes(self.node_filter):
            return False
        # A node that begins again does so with a mean that does not move along.
        if self.network.lives:
            return False
        # A frame would have to end where the plant changes.
        if self.views is not None or len(self.plant.changes):
            return False
        if self.input_responses is not None and self.input_responses.surprise is not None:
            return False
        plant = self.plant
        if isinstance(plant, LinearPlant):
            slots = frame_slots(plant.F)
            frame = math.inf if slots is None else slots * plant.period
            model_is_true = np.array_equal(self.slot_belief[0], plant.F)
        else:
            frame = frame_period(self.diffusion.A) or math.inf
            model_is_true = np.array_equal(self.belief[0], self.diffusion.A)
        return model_is_true and (frame < self.horizon or self.input_responses is not None)

    @property
    def delivers_all(self) -> bool:
        """True if every message is sure to arrive, after a time known beforehand."""
        # A random delay (``fixed`` is None) may bring a message too late for its slot.
        return self.network.channel.delay.fixed is not None and all(
            self.mean_delivery(link) == 1.0 for link in self.topology.directions
        )

    def move_back(self, offset: FloatArray, age: float) -> FloatArray:
        """Return exp(-A age) ``offset`` (n,), that of states ``age`` seconds earlier, without modes
        that have decayed to 1e-8 of it; in slots ``offset``. By it engines shift estimates in
        messages under way, which refer to the time of sending, when the origin moves.
        """
        if self.slotted:
            return offset
        groups = rate_groups(self.diffusion.A)
        # exp(-A age) of each group of modes. What has decayed by more than MAX_DECAY since then is
        # left out: pulled back it would swallow the digits of all else, and soon it is gone.
        decayed = groups.rates * age
        factors = np.where(decayed < MAX_DECAY, np.exp(np.minimum(decayed, MAX_DECAY)), 0.0)
        kept = np.asarray(scipy.linalg.expm(-age * groups.kept))
        return np.asarray(kept @ (factors @ (groups.projectors @ offset)))

    def observation_matrices(
        self, node: int, believed: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return ``H`` (p, n) and ``R`` (p, p), of filters if ``believed``, of all sensors of a
        node, of a diffusion those with increments. Raises TheoryError if it is not constant.
        """
        sensors_of_nodes = self.placed_sensors if self.slotted else self.increment_sensors
        placed_sensors = sensors_of_nodes.get(node, ())
        for placed_sensor in placed_sensors:
            sensor = self.sensors[placed_sensor.entry]
            if sensor.varying and sensor.linear:
                raise TheoryError(f"node {node} has a regressor sensor, whose H is random")
            if sensor.varying:
                raise TheoryError(f"node {node} has no linear sensor")
        return self._stack_sensors(placed_sensors, believed)

    def _stack_sensors(
        self, placed_sensors: tuple[PlacedSensor, ...], believed: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return the stacked H (p, n) and block diagonal R (p, p) of sensors of any nodes."""
        entries = tuple(placed_sensor.entry for placed_sensor in placed_sensors)
        return self._stack_entries(entries, believed)

    def _stack_entries(
        self, entries: tuple[int, ...], believed: bool
    ) -> tuple[FloatArray, FloatArray]:
        # Cached, because thousands of nodes may have the sensors of one [[sensors]] entry.
        if (entries, believed) not in self._stacks:
            H = [self.sensors[entry].matrix_of(self.plant.n) for entry in entries]
            R = [self.noise_covariance(entry, believed=believed) for entry in entries]
            empty = np.zeros((0, self.plant.n))
            self._stacks[entries, believed] = np.concatenate([empty, *H]), block_diagonal(R)
        return self._stacks[entries, believed]

    @cached_property
    def _stacks(self) -> dict[tuple[tuple[int, ...], bool], tuple[FloatArray, FloatArray]]:
        return {}

    def sample_times(self, streams: Streams) -> dict[tuple[int, int], FloatArray]:
        """Return sample times (K,) in seconds by sensor (node, ordinal) of a diffusion."""
        return sampling.sample_times(self, streams)

    def sample_path(self, streams: Streams, node: int, placed_sensor: PlacedSensor) -> Samples:
        """Return the samples of one sensor of a node in one run in continuous time."""
        path: Samples = sampling.sample_path(self, streams, node, placed_sensor)
        sensor = self.sensors[placed_sensor.entry]
        believed = self._moves_readings(sensor)
        if believed is None and sensor.fault is None:
            return path
        times = sampling.times_of_sensor(self, streams, node, placed_sensor)
        path = self.given_readings(path, streams, node, placed_sensor, times.tolist().__getitem__)
        return path if believed is None else MovedReadings(path, believed, times)

    def slot_path(self, streams: Streams, node: int, placed_sensor: PlacedSensor) -> Readings:
        """Return the readings of one sensor of a node in one run in slots."""
        sensor: Sensor = self.located_sensors[placed_sensor.entry]
        period = self.slot_plant.period
        path: Readings = sensor.slot_path(
            node, period, lambda purpose: streams.generator(purpose, node, placed_sensor.ordinal)
        )
        path = self.given_readings(path, streams, node, placed_sensor, self.slot_plant.slot_time)
        believed = self._moves_readings(sensor)
        return path if believed is None else MovedReadings(path, believed)

    def given_readings(
        self,
        path: Any,
        streams: Streams,
        node: int,
        placed_sensor: PlacedSensor,
        when: Callable[[int], float],
    ) -> Any:
        """Return what a sensor gives, bad or not, whose healthy readings are ``path``."""
        fault = self.fault_of(node, placed_sensor)
        if fault is None:
            return path
        random = streams.generator("fault", node, placed_sensor.ordinal)
        return FaultyReadings(path, fault, random, when)

    def _moves_readings(self, sensor: Sensor) -> Response | None:
        """Return the response that readings of the sensor depend on; None if on local states."""
        is_local = sensor.linear and sensor.is_random and sensor.fault is None
        return None if is_local else self.origin_response

    @property
    def filters_know_the_truth(self) -> bool:
        """True if the filters' matrices are the true ones, False with recorded parts."""
        if not self.is_random or self.misses_input:
            return False
        pieces: Any = self.plant.pieces[: 1 + int((self.plant.changes < self.horizon).sum())]
        if len(pieces) > len(self.believed_pieces):
            return False
        pairs: list[tuple[FloatArray, FloatArray]] = []
        for piece, matrices in zip(pieces, self.believed_pieces, strict=True):
            pairs.append((matrices[1], piece.Q))
            if self.plant.linear:
                pairs.append((matrices[0], piece.F if self.slotted else piece.A))
        if isinstance(self.plant, NonlinearPlant | NonlinearDiffusion):
            times, believed_noises = self.believed_noises
            if len(times) < int((self.plant.schedule_times < self.horizon).sum()):
                return False
            pairs += zip(believed_noises, self.plant.noises, strict=False)
        pairs += [
            (self.noise_covariance(k, believed=True), self.noise_covariance(k, believed=False))
            for k in range(len(self.sensors))
        ]
        return all(np.array_equal(believed, true) for believed, true in pairs)

    @cached_property
    def believed_noises(self) -> tuple[FloatArray, list[FloatArray]]:
        """Times (C,) in seconds, below the horizon, at which the noise of a nonlinear plant changes
        as filters believe, and its covariance (n, n) at first and after each.
        """
        plant, model = self.plant, self.filter.model
        assert isinstance(plant, NonlinearPlant | NonlinearDiffusion)
        given = model.Q if isinstance(plant, NonlinearPlant) else model.B
        if given is not None:
            return np.zeros(0), [given if self.slotted else np.asarray(given @ given.T)]
        times = plant.schedule_times
        times = times[times < self.horizon] if model.schedule else times[:0]
        return times, plant.noises[: 1 + len(times)]

    def _flow_model(self, H: FloatArray, R: FloatArray, view: Any = slice(None)) -> FlowModel:
        plant = self.plant
        if isinstance(plant, NonlinearDiffusion):
            (f, jacobian), inputs, A, noises = self._curved(plant, view)
            times, values, sine = plant.tables_of_input
            if not isinstance(view, slice) and len(times):
                # Predictions begin anew where inputs of its own blocks change.
                jumps = np.append(True, (np.diff(values[:, inputs], axis=0) != 0.0).any(axis=1))
                times, values = times[jumps], values[jumps]
            known = self._known_inputs[inputs]
            amplitudes = np.stack([known, np.ones_like(known), np.ones_like(known)])
            return RateModel(
                A, noises[0], H, R, self.horizon, self.horizon, f=f, jacobian=jacobian,
                step=plant.step, noises=noises, noise_times=self.believed_noises[0],
                tables_of_input=(times, known * values[:, inputs], sine[:, inputs] * amplitudes),
                linearise=self.filter.linearise,
            )  # fmt: skip
        A, Q = (_part(M, view) for M in self.believed_pieces[0])
        # The longest gap to predict over, and the longest step whose increment is used at once.
        period = self.diffusion.sensing_period or 0.0
        return FlowModel(A, Q, H, R, self.horizon, min(period, self.horizon))

    def initial_estimate(self, node: int) -> tuple[FloatArray, FloatArray]:
        """Return ``xhat`` (n,) and ``P`` (n, n) of a node at time 0, by default those of x(0)."""
        index, mean, cov = self.topology.index[node], self.filter.mean, self.filter.cov
        if mean is None:
            mean = self.plant.start_mean
        if cov is None:
            cov = self.plant.start_cov
        xhat = mean[index] if isinstance(mean, tuple) else mean
        P = cov[index] if isinstance(cov, tuple) else cov
        view = self.model_view(index)
        # Without views all nodes share one object.
        return (xhat, P) if isinstance(view, slice) else (xhat[view], P[np.ix_(view, view)])

    @cached_property
    def singular_start(self) -> int | None:
        """The first node (id) whose P at time 0 is singular; None if there is none."""
        starts = ((node, self.initial_estimate(node)[1]) for node in self.nodes)
        return next((node for node, P in starts if not is_definite(P)), None)

    def fresh_estimate(self, node: int, when: float) -> tuple[FloatArray, FloatArray]:
        """Return ``initial_estimate`` of a node that begins again ``when`` (s or slot)."""
        mean, cov = self.initial_estimate(node)
        if self.origin_response is None:
            return mean, cov
        origin = self.origin_response.states(np.array([when]))[0]
        return mean - origin[self.model_view(self.topology.index[node])], cov

    def prior_shift(self, node: int, when: float) -> FloatArray:
        """Return by how much the mean of ``fresh_estimate`` at ``when`` differs from that at 0."""
        # As a slot 0 is an index.
        start = 0 if self.slotted else 0.0
        return self.fresh_estimate(node, when)[0] - self.fresh_estimate(node, start)[0]

    @property
    def other_starts(self) -> list[int]:
        """The ids of nodes whose filters do not start with mean and covariance of x(0)."""
        start, filtering = self.plant, self.filter
        pairs = (filtering.mean, start.start_mean), (filtering.cov, start.start_cov)
        return [
            node
            for k, node in enumerate(self.nodes)
            if any(
                given is not None
                and not np.array_equal(given[k] if isinstance(given, tuple) else given, true)
                for given, true in pairs
            )
        ]

    @cached_property
    def start_margin(self) -> float:
        """The least eigenvalue of P_i(0) less the second moment of its error, where each state is
        in units of the larger of both.
        """
        plant, smallest = self.plant, np.inf
        starts = ((*self.initial_estimate(i), k) for k, i in enumerate(self.nodes))
        # Most networks have one start for all nodes.
        for mean, cov, k in {(id(start[0]), id(start[1])): start for start in starts}.values():
            view = self.model_view(k)
            offset = plant.start_mean[view] - mean
            moment = plant.start_cov[view][:, view] + np.outer(offset, offset)
            sizes = np.sqrt(np.maximum(np.diagonal(cov), np.diagonal(moment)))
            units = np.where(sizes > 0.0, sizes, 1.0)
            gap = (cov - moment) / np.outer(units, units)
            smallest = min(smallest, float(np.linalg.eigvalsh(gap)[0]))
        return smallest

    def weight(self, receiver: int, sender: int) -> float:
        """Return the weight of the estimate of ``sender`` (id) at ``receiver``, pi_ij of paper H
        (7), a_ji of paper D (8): of the filter's matrix, rows senders, or by the degrees of both.
        """
        weights, topology = self._link_weights, self.topology
        if weights.matrix is not None:
            return float(weights.matrix[topology.index[sender], topology.index[receiver]])
        degrees = topology.degrees[receiver], topology.degrees[sender]
        if degrees not in self._weights_by_degree:
            where = f"{type(self.node_filter).__name__}.link_weights.of"
            self._weights_by_degree[degrees] = probability(where, weights.of(*degrees))
        return self._weights_by_degree[degrees]

    @cached_property
    def _weights_by_degree(self) -> dict[tuple[int, int], float]:
        return {}

    @cached_property
    def _link_weights(self) -> Weights:
        return self.node_filter.link_weights

    @cached_property
    def own_weights(self) -> dict[int, float]:
        """The weight of each node's own estimate (by id) if all messages arrive: 1 minus theirs."""
        own_weights = dict.fromkeys(self.nodes, 1.0)
        for sender, receiver in self.topology.directions:
            own_weights[receiver] -= self.weight(receiver, sender)
        # Weights that sum to 1 may leave a rounding error below 0.
        return {node: max(weight, 0.0) for node, weight in own_weights.items()}

    def effective_rates(self) -> dict[Link, float]:
        """Return the mean rate of delivered messages by (sender, receiver), per second, nan if
        unknown before a run; empty in slots and without exchange.
        """
        return dict(self._effective_rates)

    @cached_property
    def _effective_rates(self) -> dict[Link, float]:
        clock = self.network.activation
        if not isinstance(clock, LinkClock) or not self.filter.algorithm.timing.talks:
            return {}
        return {
            link: self._send_rate(clock, link) * self.mean_delivery(link)
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


def _part(M: FloatArray, view: Any) -> FloatArray:
    """Return the rows and columns of M (n, n) that a ``view`` of the state has."""
    return np.ascontiguousarray(M[view][:, view])


def _shared(
    make: Callable[[FloatArray, FloatArray], Made], stacks: Iterable[tuple[FloatArray, FloatArray]]
) -> tuple[Made, ...]:
    """Return ``make(H, R)`` for each of many (H, R), made once for equal ones."""
    made: dict[tuple[bytes, bytes], Made] = {}
    of_objects: dict[tuple[int, int], Made] = {}
    pairs = list(stacks)  # which keeps them, and their ids
    for H, R in pairs:
        if (id(H), id(R)) not in of_objects:
            key = H.tobytes(), R.tobytes()
            if key not in made:
                made[key] = make(H, R)
            of_objects[id(H), id(R)] = made[key]
    return tuple(of_objects[id(H), id(R)] for H, R in pairs)


def _undriven(plant: Any) -> Any:
    schedule = tuple(dataclasses.replace(change, G=None) for change in plant.schedule)
    return dataclasses.replace(plant, input=None, schedule=schedule)
