"""Arrays that all runs of a scenario in slots share: stages, links, sensors, initial states."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo, may_be_silent
from netkf.algorithms.gates import Gate
from netkf.algorithms.kernels.run import opposite_links
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.models import SlotModel, first_roots
from netkf.core.places import Place
from netkf.engines.compiled.nonlinear_rows import NonlinearSetup
from netkf.engines.compiled.outcomes import delivery_table
from netkf.engines.compiled.own_sensors import is_own
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.samples import entries_of
from netkf.engines.compiled.senders import link_senders
from netkf.engines.compiled.slot_messages import (
    INDEPENDENT,
    NODE_WAKEUP,
    ONE_EDGE,
    UNIFORM_MAXIMAL,
    Matchings,
    SlotLinks,
    Stages,
)
from netkf.engines.compiled.slot_pairs import PairColumns, SlotPairs, common_table
from netkf.linalg.arrays import FloatArray, block_diagonal, enlarged
from netkf.linalg.lanes import LANES, aligned, blocks_of
from netkf.linalg.portable import cholesky, solve_lower
from netkf.network.channels import draws_per_link
from netkf.network.deliveries import Deliveries, DeliveringLoss
from netkf.network.graphs import Link
from netkf.network.losses import GilbertElliott, identical_per_link, law_in_kernels
from netkf.network.matchings import PROTOCOLS, Broadcast, Matching, maximal_matchings
from netkf.network.quantise import Quantisation
from netkf.plants.regressors import RegressorSensor
from netkf.plants.slot_paths import SlotSensors
from netkf.plants.transitions import frame_slots
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario


class AssignedSensor(NamedTuple):
    """A sensor of ``node``: which filter reads it (``estimator``), its first ``row`` there and the
    number of its ``rows``, of a recorded one the most in a slot; ``R`` (p, p) is the covariance of
    its noise as the filters believe it, ``root`` its Cholesky factor. ``pair`` is the first of its
    readings in ``SlotPairs``, -1 if it reads what its filter estimates and nothing else.
    """

    node: int
    placed_sensor: PlacedSensor
    estimator: int
    row: int
    rows: int
    R: FloatArray
    root: FloatArray
    pair: int = -1


class SlotSetup:
    """Times, links and sensors of a scenario in slots, and the states of its filters at slot 0."""

    def __init__(self, scenario: Scenario) -> None:
        algorithm, topology = scenario.node_filter, scenario.topology
        self.algorithm: Filter = algorithm
        self.n, self.nodes = scenario.plant.n, np.array(scenario.nodes, dtype=np.int64)
        # Frames are for exact errors of unstable plants; 0: the origin never moves.
        self.frame = frame_slots(scenario.linear_plant.F) or 0 if scenario.exact_errors else 0
        # A filter that all nodes share estimates the whole state.
        self.views = None if algorithm.timing.pooled else scenario.views
        self.forgets = bool(scenario.forgetful_nodes)
        self.width = self.n if self.views is None else scenario.model_width
        self._set_slots(scenario)
        self._set_stages(scenario)
        self._set_sensors(scenario)
        self._set_states(scenario)
        links = topology.links if algorithm.timing.talks else ()
        self.ends = topology.ends[: len(links)]
        # Directions 2 l and 2 l + 1 belong to link l, as in the SimPy engine.
        self.directions_per_link = 1 if topology.directed else 2
        symmetric = scenario.network.channel.symmetric
        self.senders = link_senders(links, topology.directed, symmetric)
        self.directions: tuple[Link, ...] = self.senders.directions
        self.links = self._make_links(scenario)
        self.opposite = opposite_links(self.links.first, self.links.sender)
        self.common = common_table(scenario)
        self._set_channel(scenario)
        self.matching = matching_of(scenario)
        self.is_drawn = self._draws_everything(scenario)

    def _set_slots(self, scenario: Scenario) -> None:
        plant = scenario.slot_plant
        # A guess below the last slot: the plant itself decides, free of this division's rounding.
        last = max(0, int(scenario.horizon / plant.period) - 2)
        while not plant.over(last, scenario.horizon):
            last += 1
        self.samples = np.array(sorted(set(scenario.sampled_slots)), dtype=np.int64)
        # The slot at the horizon exists only to be sampled.
        self.slots = last + bool(len(self.samples) and self.samples[-1] >= last)
        self.last = last
        self.sample_times = plant.slot_times(self.samples)

    def _set_stages(self, scenario: Scenario) -> None:
        algorithm, phase, step = self.algorithm, 0, 0
        length = scenario.phase_length if algorithm.timing.talks else 0.0
        stages: list[tuple[int, int, float]] = []
        fresh: list[bool] = []
        for kind in algorithm.timing.schedule or ():
            if kind == "sense":
                # -1: a reading, which is no step of an exchange.
                stages.append((-1, -1, 0.0))
            elif kind == "exchange":
                steps = algorithm.timing.steps(phase) if algorithm.timing.talks else 0
                for k in range(steps):
                    # Steps share the phase equally; ends are seconds after the slot begins.
                    stages.append((step, phase, (phase + (k + 1) / steps) * length))
                    fresh.append(algorithm.timing.redraws(phase, k))
                    step += 1
                phase += 1
        numbers, phases, ends = zip(*stages, strict=True)
        # The last step of each exchange; -1 for readings, whose phase is -1.
        last_step = {phase: step for step, phase, _ in stages}
        self.decides = may_be_silent(algorithm)
        self.stages = Stages(
            np.array(numbers, dtype=np.int64),
            np.array(phases, dtype=np.int64),
            np.array(ends, dtype=np.float64),
            last_step.get(algorithm.timing.stopping, -1),
            scenario.time_grid.per_second,
        )
        self.fresh = np.array(fresh, dtype=bool)
        self.phases = [phase for step, phase, _ in stages if step >= 0]

    def _set_sensors(self, scenario: Scenario) -> None:
        pooled = self.algorithm.timing.pooled
        self.estimators, self.p = 1 if pooled else len(scenario.nodes), 1
        rows = np.zeros(self.estimators, dtype=np.int64)
        self.entries = entries_of(scenario)
        self.columns = PairColumns(scenario, self.entries)
        self.sensing = np.array(scenario.sensing_nodes, dtype=np.int64)
        self.assigned: list[AssignedSensor] = []
        for node in scenario.sensing_nodes:
            estimator = 0 if pooled else scenario.topology.index[node]
            for placed_sensor in scenario.placed_sensors[node]:
                R = scenario.noise_covariance(placed_sensor.entry, believed=True)
                count = scenario.most_rows(node, placed_sensor)
                # A filter stacks the readings of its sensors, one below the other.
                row = int(rows[estimator])
                self.assigned.append(
                    AssignedSensor(node, placed_sensor, estimator, row, count, R, cholesky(R))
                )
                rows[estimator] += count
        self.pairs: SlotPairs | None = None
        if self.views is not None and self.algorithm.needs.blocks:
            self.pairs = SlotPairs(scenario, self.columns)
            rows = self._set_pairs(self.pairs, scenario)
        self.rows, self.p = rows, max(self.p, int(rows.max(initial=1)))
        self._sort_sensors(scenario)
        linear = not self.regressor_sensors and not self.nonlinear_sensors
        all_fixed = len(self.kernel_sensors) == len(self.assigned) and linear
        self.gate: Gate | None = scenario.filter.gate
        self.quantise: Quantisation | None = scenario.network.quantise
        # Who is down has no reading, and a gate changes H.
        self.varies = not all_fixed or bool(scenario.network.lives) or self.gate is not None
        # The same in all blocks of runs and all slots, hence 1, 1.
        self.H: FloatArray = aligned((1, 1, self.estimators, self.p, self.columns.width, LANES))
        self._set_nonlinear_rows(scenario)
        self._set_kernel_sensors(scenario)

    def _sort_sensors(self, scenario: Scenario) -> None:
        # Python reads recorded sensors and those of users, kernels read the others; some of these
        # have regressors as H.
        sensors = [(s, scenario.sensors[s.placed_sensor.entry]) for s in self.assigned]
        others = [(s, one) for s, one in sensors if not one.linear or not is_own(one)]
        self.nonlinear_sensors = [s for s, one in others if not one.linear]
        self.own_sensors = [s for s, one in sensors if one.linear and is_own(one)]
        self.recorded_sensors = [s for s, one in others if one.record is not None]
        self.kernel_sensors = [s for s, one in others if one.record is None]
        self.regressor_sensors = [s for s, one in others if isinstance(one, RegressorSensor)]

    @cached_property
    def gated_parts(self) -> list[list[tuple[int, int, int]]]:
        """First row, row count and node (id) of each reading of each filter's table."""
        parts: list[list[tuple[int, int, int]]] = [[] for _ in range(self.estimators)]
        for s in self.assigned:
            p = len(s.R)
            parts[s.estimator] += [(row, p, s.node) for row in range(s.row, s.row + s.rows, p)]
        return parts

    def _set_pairs(self, pairs: SlotPairs, scenario: Scenario) -> np.ndarray:
        """Put readings of pairs behind those of own states; return how many rows these have."""
        rows, assigned = np.zeros(self.estimators, dtype=np.int64), list[AssignedSensor]()
        others = [pairs.others(s) for s in self.assigned]
        for s, other in zip(self.assigned, others, strict=True):
            assigned.append(s._replace(row=int(rows[s.estimator])))
            # In a record each row may be about another block.
            if not other or scenario.sensors[s.placed_sensor.entry].record is not None:
                rows[s.estimator] += s.rows
        ends = rows.copy()
        for k, (s, other) in enumerate(zip(assigned, others, strict=True)):
            if other:
                row = int(ends[s.estimator])
                pair = pairs.add(s, row, other)
                is_drawn = scenario.sensors[s.placed_sensor.entry].record is None
                assigned[k] = s._replace(pair=pair, row=row if is_drawn else s.row)
                ends[s.estimator] += s.rows
        self.assigned, self.p = assigned, int(ends.max(initial=1))
        return rows

    def block_beside(self, s: AssignedSensor) -> Place | None:
        """Return the block that a sensor reads beside those of its filter, if it is drawn."""
        return self.pairs.all[s.pair].place if self.pairs and s.pair >= 0 else None

    def _set_nonlinear_rows(self, scenario: Scenario) -> None:
        self.nonlinear: NonlinearSetup | None = None
        if not self.nonlinear_sensors:
            return
        # Readings are of the whole state, and linearised in what their node estimates.
        whole = np.arange(self.n)[None]
        self.nonlinear = self.drawn = NonlinearSetup(self.estimators, self.p, whole)
        # What drawn readings are measured from, as rows of H say it.
        self.places = self.H[0, 0]
        if self.views is not None:
            self.nonlinear = NonlinearSetup(self.estimators, self.p, self.entries)
            self.places = np.zeros((self.estimators, self.p, self.n, 1))
        for s in self.nonlinear_sensors:
            sensor: Any = scenario.located_sensors[s.placed_sensor.entry]
            h, rows = s.estimator, len(s.R)
            for first in range(s.row, s.row + s.rows, rows):
                tables = {self.drawn: self.places}
                if s.pair < 0 or sensor.record is not None:
                    tables[self.nonlinear] = self.H[0, 0]
                for setup, places in tables.items():
                    setup.add(sensor, h, first, s.R)
                    if sensor.record is None:
                        place = setup.reference(sensor, s.node, h)
                        places[h, first : first + rows, : len(place)] = place[:, None]

    def _set_kernel_sensors(self, scenario: Scenario) -> None:
        count, n = len(self.kernel_sensors), self.n
        # A filter may stack far more rows than one of its sensors has.
        p = max((len(s.root) for s in self.kernel_sensors), default=1)
        H, noise = np.zeros((count, p, n)), np.zeros((count, p, p))
        regressor_index = np.full(count, -1, dtype=np.int64)
        for m, s in enumerate(self.kernel_sensors):
            sensor = scenario.sensors[s.placed_sensor.entry]
            rows = len(s.root)
            true_root = cholesky(sensor.R)
            if not sensor.linear:
                # Nonlinear rows are whitened where they are used.
                noise[m, :rows, :rows] = true_root
                continue
            # The noise of a whitened reading is L_b^-1 L times white noise, with the believed R =
            # L_b L_b' and the true R = L L'.
            noise[m, :rows, :rows] = solve_lower(s.root, true_root)
            if isinstance(sensor, RegressorSensor):
                # A regressor's one row is random: H holds the whitening factor alone.
                regressor_index[m], H[m, 0, 0] = self.regressor_sensors.index(s), 1.0 / s.root[0, 0]
                continue
            H[m, :rows] = solve_lower(s.root, sensor.H)
            place = self.block_beside(s)
            own = self.columns.of(s.estimator, H[m, :rows], place)
            self.H[0, 0, s.estimator, s.row : s.row + rows] = own[..., None]
        regressors: list[Any] = [
            scenario.sensors[s.placed_sensor.entry] for s in self.regressor_sensors
        ]
        # Regressors of different sizes are padded with zeros, which stay zero.
        k = max((len(sensor.A) for sensor in regressors), default=1)
        q = max((sensor.B.shape[1] for sensor in regressors), default=1)
        C = np.zeros((len(regressors), n, k))
        self.regressors = []
        for d, sensor in enumerate(regressors):
            size = len(sensor.A)
            A, drive, start = np.zeros((k, k)), np.zeros((k, q)), np.zeros(k)
            root = sensor.drive
            A[:size, :size], drive[:size, : root.shape[1]] = sensor.A, root
            C[d, :, :size], start[:size] = sensor.C, sensor.start
            # Columns of noise are not padded: a padded one would draw numbers from the stream.
            self.regressors.append((A, np.ascontiguousarray(drive[:, : root.shape[1]]), start))
        self.sensors = SlotSensors(
            np.array([s.estimator for s in self.kernel_sensors], dtype=np.int64),
            np.array([s.row for s in self.kernel_sensors], dtype=np.int64),
            np.array([len(s.root) for s in self.kernel_sensors], dtype=np.int64),
            H,
            noise,
            regressor_index,
            C,
        )

    def _set_states(self, scenario: Scenario) -> None:
        infos: Sequence[NodeInfo] = scenario.node_infos
        if self.algorithm.timing.pooled:
            infos = infos[:1]
        pieces: list[list[Any]] = [
            [_widened(model, rows) for model, rows in zip(piece, self.rows.tolist(), strict=True)]
            for piece in scenario.model_pieces
        ]
        models = pieces[0]
        # The models of what filters estimate; records have room for the states of the widest.
        self.infos, self.models = infos, models
        self.model_pieces: list[Sequence[Any]] = [
            [_enlarged(model, self.width) for model in piece] for piece in pieces
        ]
        self.model_slots, self.followed_slots = scenario.model_slots, scenario.followed_slots
        self.period = scenario.slot_plant.period
        starts = [scenario.initial_estimate(info.node) for info in infos]
        # Filters of the same states believe one F and Q at a time.
        count, size = len(models) if self.own_models else 1, (self.width, self.width)
        self.tables = [
            [
                (enlarged(np.array(m.F), *size), enlarged(lower_root(m.root_Q), *size))
                for m in piece[:count]
            ]
            for piece in pieces
        ]
        # Exchanges conserve quantities with these names.
        first = self.algorithm.init(models[0], *starts[0], infos[0])
        self.conserved_names = tuple(self.algorithm.analysis.conserved(first))
        starts = [(enlarged(x, size[0]), enlarged(cov, *size)) for x, cov in starts]
        self.xhat = np.stack([mean for mean, _ in starts])
        self.root = first_roots([cov for _, cov in starts])

    @property
    def own_models(self) -> bool:
        """True if filters have models of their own, since they estimate different states."""
        return bool((self.entries != self.entries[0]).any())

    @cached_property
    def index_of_direction(self) -> dict[Link, int]:
        """The index in ``directions`` of each directed link."""
        return {direction: w for w, direction in enumerate(self.directions)}

    def _make_links(self, scenario: Scenario) -> SlotLinks:
        """Return the W directed links sorted by receiver and sender, with their weights."""
        index = scenario.topology.index
        ends = [(index[sender], index[receiver]) for sender, receiver in self.directions]
        senders, receivers = np.array(ends, dtype=np.int64).reshape(-1, 2).T
        weights = [scenario.weight(receiver, sender) for sender, receiver in self.directions]
        # By receiver and sender: the order in which a filter adds the messages it receives.
        order = np.lexsort((senders, receivers))
        first = np.searchsorted(receivers[order], np.arange(self.estimators + 1))
        return SlotLinks(
            first=np.asarray(first, dtype=np.int64),
            sender=senders[order],
            direction=order,
            weight=np.array(weights, dtype=np.float64)[order],
        )

    def _set_channel(self, scenario: Scenario) -> None:
        channel = scenario.network.channel
        # A replay draws as its run does, and then delivers the chosen messages.
        self.deliveries: Deliveries | None = None
        if isinstance(channel.loss, DeliveringLoss):
            self.deliveries = channel.loss.deliveries
            loss, hops = channel.loss.given, channel.loss.channels
            channel = dataclasses.replace(channel, loss=loss, channels=hops)
        self.channel, loss = channel, channel.loss
        # Numpy computes the probabilities of a user's own loss model (slot_tables).
        has_known_law = identical_per_link(loss) or type(loss) is GilbertElliott
        self.law_in_kernels = law_in_kernels(loss)
        has_known_law = (has_known_law or self.law_in_kernels) and scenario.network.radio is None
        self.has_known_probabilities = has_known_law and draws_per_link(channel)
        self.delivery = np.ones((2, len(self.directions)))
        if self.has_known_probabilities and not self.law_in_kernels:
            self.delivery = delivery_table(scenario, loss, self.directions)
        # Some filters send nothing in some phases, the exchanges of a slot (push-sum with
        # asymptotic gains: no mass), or only from nodes that have sensors.
        sends = self.algorithm.timing.sends
        talks = [
            [sends(phase, direction[0] in scenario.placed_sensors) for direction in self.directions]
            for phase in self.phases
        ]
        self.talks = np.array(talks, dtype=np.uint8).reshape(len(talks), len(self.directions))
        # Steps in which nodes send their readings; in some slots a node may have none.
        self.sends_readings = np.array(
            [sends(phase, True) and not sends(phase, False) for phase in self.phases], dtype=bool
        )
        self._recorded_slots = self._slots_with_rows(scenario) if self.sends_readings.any() else {}

    def _slots_with_rows(self, scenario: Scenario) -> dict[int, set[int]]:
        """Return the slots with a reading of each node all of whose sensors are recorded."""
        slots: dict[int, set[int]] = {}
        for s in self.recorded_sensors:
            sensor: Any = scenario.sensors[s.placed_sensor.entry]
            recorded_slots = sensor.record.slots(s.node, scenario.slot_plant.period)
            slots.setdefault(scenario.topology.index[s.node], set()).update(recorded_slots)
        for s in self.kernel_sensors + self.own_sensors:
            slots.pop(scenario.topology.index[s.node], None)
        return slots

    @property
    def may_miss(self) -> bool:
        """True if there are slots in which a node has no reading to send."""
        return bool(self._recorded_slots)

    def unread(self, first: int, count: int) -> np.ndarray:
        """Return (S, E, N) bool: nodes with nothing to send, in ``count`` slots from ``first``."""
        missed = np.zeros((count, len(self.nodes)), dtype=bool)
        for index, slots in self._recorded_slots.items():
            missed[:, index] = [slot not in slots for slot in range(first, first + count)]
        unread: np.ndarray = missed[:, None] & self.sends_readings[:, None]
        return unread

    def _draws_everything(self, scenario: Scenario) -> bool:
        network = scenario.network
        # Which message has which number is known before the exchange, unless nodes may be silent.
        is_numbered = self.deliveries is not None or self.law_in_kernels
        if is_numbered and (self.decides or self.may_miss):
            return False
        if scenario.links_move or scenario.network.lives:
            return False
        # Kernels know broadcasts and matchings without delay, with the built-in losses.
        exchanges = (
            type(network.activation) in (Matching, Broadcast) or not self.algorithm.timing.talks
        )
        return self.has_known_probabilities and network.channel.delay.fixed == 0.0 and exchanges

    def activity(self, slots: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (S,) bool for ``slots``: if events are recorded, nodes act, and nodes exchange."""
        timing, recorded = self.algorithm.timing, slots < self.last
        # At the horizon filters that predict are only sampled: the prediction is the result.
        acts = recorded | (not timing.predicts)
        return recorded, acts, acts & timing.talks & (slots >= timing.first_exchange)

    @property
    def side_by_side(self) -> bool:
        """True if several runs can be simulated in one call: all make the same steps."""
        return self.is_drawn or not (self.decides or self.forgets)

    def matchings(self, states: np.ndarray) -> Matchings:
        """Return the matching protocol with the streams ``states`` (R, WIDTH) of R runs."""
        order, busy = (np.zeros(len(part), dtype=np.int64) for part in (self.ends, self.nodes))
        return self.matching._replace(states=states, order=order, busy=busy)

    @property
    def max_pairs(self) -> int:
        """The largest number of pairs in a matching, 0 without matchings."""
        return min(len(self.nodes) // 2, len(self.ends)) if self.matching.protocol >= 0 else 0

    def rows_of(self, slots: int) -> int:
        """Return an upper bound of the number of events in ``slots`` slots."""
        pairs, has_pairs = self.max_pairs, self.matching.protocol >= 0
        sends = self.directions_per_link * (pairs if has_pairs else len(self.ends))
        # A send and its outcome for each direction, a tick for each pair, a round, and one
        # absorption per node.
        steps = len(self.fresh) * (1 + pairs + 2 * sends + len(self.nodes))
        return slots * (len(self.sensing) + steps + len(self.nodes))

    def bytes_of_slot(self) -> int:
        """Return the bytes of states, readings and messages of one slot of one run."""
        # Readings, their H if it varies, and states.
        floats = self.estimators * self.p * (1 + self.varies * self.columns.width) + 3 * self.n
        messages = len(self.fresh) * (len(self.directions) + 8 * self.max_pairs + 8)
        mask = self.decides or self.may_miss
        asked = len(self.nodes) * (mask + 8 * self.algorithm.timing.randomised)
        return 8 * floats + messages + len(self.fresh) * asked

    def block_slots(self, runs: int, max_events: int) -> int:
        """Return how many slots of ``runs`` a call simulates, for ``max_events`` (0: no limit)."""
        slots = BLOCK_BYTES // (blocks_of(runs) * LANES * self.bytes_of_slot())
        if max_events:
            slots = min(slots, max_events // max(1, self.rows_of(1)))
        return max(1, int(slots))

    def batch_runs(self) -> int:
        """Return the number of runs that are simulated side by side: as many as fit the memory."""
        floats = self.estimators * (2 + self.width) * self.width
        sample_bytes = max(1, 8 * len(self.samples) * floats)
        # A power of two, so that a batch is one node of the merge tree; at least a block of lanes,
        # unless not even that fits.
        runs_in_memory = min(BATCH_BYTES // sample_bytes, BLOCK_BYTES // (8 * self.bytes_of_slot()))
        if not self.is_drawn:
            # Runs keep the random streams of their links.
            runs_in_memory = min(runs_in_memory, MAX_STREAMS // max(1, len(self.directions)))
        power = 1 << max(0, int(min(runs_in_memory, MAX_SLOT_RUNS)).bit_length() - 1)
        return int(min(max(power, LANES), max(1, MAX_BLOCK_BYTES // sample_bytes)))

    def quick_runs(self) -> int:
        """Return the number of runs, a power of two, that take some ten milliseconds together."""
        # A rough count for one slot: a filter's prediction and update, and its messages.
        flops = self.estimators * (50 + 4 * self.width**3)
        flops += 10 * len(self.fresh) * len(self.directions)
        runs = min(QUICK_FLOPS // (max(1, self.slots) * flops), MAX_SLOT_RUNS)
        return int(max(LANES, 1 << (runs.bit_length() - 1) if runs else 0))


@once_per_scenario
def slot_setup(scenario: Scenario) -> SlotSetup:
    """Return the arrays that all runs of a scenario in slots share, made at the first call."""
    return SlotSetup(scenario)


def _widened(model: SlotModel, rows: int) -> SlotModel:
    added = rows - len(model.H)
    if added <= 0:
        return model
    H = np.concatenate([model.H, np.zeros((added, model.H.shape[1]))])
    return dataclasses.replace(model, H=H, R=block_diagonal([model.R, np.eye(added)]))


def _enlarged(model: SlotModel, width: int) -> SlotModel:
    if len(model.Q) == width:
        return model
    F, Q = (enlarged(M, width, width) for M in (model.F, model.Q))
    return dataclasses.replace(model, F=F, Q=Q, H=enlarged(model.H, len(model.H), width))


BLOCK_BYTES = 1 << 24
"""Bytes drawn for one call of a filter's kernel. They exceed the caches of a core, but kernels read
them once and in order, which costs less than more calls would.
"""
BATCH_BYTES, MAX_BLOCK_BYTES, MAX_SLOT_RUNS = 1 << 26, 1 << 29, 1024
"""Limits of a batch in slots: bytes of its samples, the same if it is only a block of lanes, and
runs."""
MAX_STREAMS = 1 << 14
"""Links of a batch whose messages are tables, with random streams that Python keeps."""
QUICK_FLOPS = 1 << 25
"""Floating-point operations that take some ten milliseconds."""


def matching_of(scenario: Scenario) -> Matchings:
    """Return the matching protocol of a scenario, without the streams and the scratch of runs."""
    activation, topology = scenario.network.activation, scenario.topology
    none: np.ndarray = np.zeros(0, dtype=np.int64)
    if not isinstance(activation, Matching):
        return Matchings(-1, 0.0, none, np.zeros(1, dtype=np.int64), none, none, none)
    protocol, links = PROTOCOLS.index(activation.protocol), topology.links
    lists: list[list[int]] = []
    if protocol == NODE_WAKEUP:
        links_of: dict[int, dict[int, int]] = {node: {} for node in topology.nodes}
        # The links of each node, in ascending order of the peer at the other end.
        for k, (i, j) in enumerate(links):
            links_of[i][j] = links_of[j][i] = k
        lists = [[link_to[peer] for peer in sorted(link_to)] for link_to in links_of.values()]
    if protocol == UNIFORM_MAXIMAL:
        index = {link: k for k, link in enumerate(links)}
        lists = [[index[link] for link in members] for members in maximal_matchings(links)]
    probability = {ONE_EDGE: activation.lazy, INDEPENDENT: activation.p}.get(protocol) or 0.0
    first = np.cumsum([0, *map(len, lists)], dtype=np.int64)
    flat = np.array([k for members in lists for k in members], dtype=np.int64)
    return Matchings(protocol, probability, none, first, flat, none, none)
