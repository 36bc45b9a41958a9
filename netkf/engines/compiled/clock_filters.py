"""Filters under clocks as records: what the event loop needs, made once for each run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.algorithms.kernels.at_rest import empty_inbox, run_at_rest
from netkf.algorithms.kernels.gates import GateTables, gate_tables, no_gate, own_sizes
from netkf.algorithms.kernels.nonlinear_rows import linear_rows
from netkf.algorithms.kernels.pairs import empty_pairs, no_pairs
from netkf.algorithms.kernels.rates import RateRun
from netkf.algorithms.kernels.run import ClockRun, clock_tables, opposite_links, size_of
from netkf.algorithms.models import RateModel, changing_models
from netkf.algorithms.records import Kernels, double_past, make_records, resized
from netkf.engines.compiled.batch_arrays import BatchArrays
from netkf.engines.compiled.clock_loop import NO_MODELS, batch_loop, clock_loop, clock_verbs
from netkf.engines.compiled.nonlinear_samples import nonlinear_sensors
from netkf.engines.compiled.quantiser import PayloadQuantiser
from netkf.engines.compiled.samples import entries_of
from netkf.engines.compiled.slot_pairs import PairColumns, common_table
from netkf.engines.compiled.state import Filters, Instants, Simulation, add_messages, wide_models
from netkf.linalg.addresses import any_struct, call_kernel
from netkf.linalg.arrays import FloatArray
from netkf.linalg.generic import copy_arrays
from netkf.linalg.lanes import ONE
from netkf.linalg.plain import is_plain
from netkf.scenario.scenario import Scenario


class ClockFilters:
    """N filters of one run whose verbs are kernels, with room for C ``messages``."""

    def __init__(self, scenario: Scenario, kernels: Kernels, start: Filters, messages: int) -> None:
        self.kernels = kernels
        self._p = self._samples = 1
        columns = PairColumns(scenario, entries_of(scenario))
        self._columns, self._width, self._n = columns.width, start.xhat.shape[1], scenario.plant.n
        self._gate = scenario.filter.gate
        pooled = scenario.node_filter.timing.pooled
        infos = scenario.node_infos[:1] if pooled else scenario.node_infos
        self._own = own_sizes(infos, self._width, pooled)
        self._readings = None
        self._known_pairs: tuple[Any, ...] = ()
        if not (linear := all(sensor.linear for sensor in scenario.sensors)):
            self._readings = nonlinear_sensors(scenario)
            self._p = self._readings.R.shape[1]
            self._known_pairs = self._readings.of_pairs(scenario.filter.linearise)
        self._rates = [m for m in scenario.model_pieces[0] if isinstance(m, RateModel)]
        models = changing_models(wide_models(scenario), scenario.followed_changes.tolist())
        links = _links_by_receiver(scenario)
        starts = list(zip(start.xhat, start.root, strict=True))
        count, self._common = len(links["sender"]), common_table(scenario)
        self._degree = int(np.diff(links["first"]).max(initial=0))
        self.records = make_records(
            scenario.node_filter, starts, infos, models, links=count, messages=self._room(messages)
        )
        self.record, self.start = self.records.struct, self.records.copied()
        self.quantiser = PayloadQuantiser(scenario.network.quantise, self.records)
        self._first_models = np.ascontiguousarray(start.nodes["model"])
        self._silent = np.zeros(len(start.nodes), dtype=bool)
        self.run = self._run_of(scenario, start, links, messages)
        self._general_run = self.run.general
        reads = bool((start.nodes["sensors"] > start.nodes["sensor"]).any())
        own_models = NO_MODELS
        if self._rates:
            # The loop passes the model on, whatever it is.
            self._general_run = self.run if is_plain() else ClockRun.at(self.run)
            if scenario.views is not None and not pooled:
                self._own_models = [model.tables() for model in self._rates]
                own_models = np.stack([tables.memory for tables in self._own_models])
        self._verbs = clock_verbs(kernels, self.record, self.run, reads, linear, own_models)
        # Lost payloads take their dither too: what is drawn must not depend on what is heard.
        self._verbs.counts_sends |= scenario.network.quantise is not None
        self._conserved: tuple[str, ...] = ()
        if "conserved" in self.records.arrays:
            first = scenario.initial_estimate(infos[0].node)
            state = scenario.node_filter.init(models[0], *first, infos[0])
            self._conserved = tuple(scenario.node_filter.analysis.conserved(state))
            for h in range(len(infos)):
                call_kernel(kernels.observe, self.record, h, run=self.run)
        self._at_start = self._sums()

    def _run_of(
        self, scenario: Scenario, start: Filters, links: dict[str, Any], messages: int
    ) -> Any:
        """Return what surrounds the nodes at time 0."""
        n, unrolled = start.xhat.shape[1], self.kernels.unrolled and scenario.views is None
        size = size_of(n, unrolled and not self._rates)
        cls = ClockRun.of_size(n) if isinstance(size, tuple) else ClockRun
        own = {**links, **self._inbox(messages), "common": self._common}
        made = cls(
            **run_at_rest(n, 1, messages) | own,
            size=size,
            lanes=ONE,
            model=clock_tables(
                size,
                start.table,
                self._first_models.copy(),
                start.gains,
                np.array(scenario.followed_changes),
            ),
        )
        if not self._rates:
            return made
        fields = {name: getattr(made, name) for name in cls.struct_fields}
        return RateRun(**fields | {"model": self._rates[0].tables()})

    def begin(self, instants: Instants) -> None:
        """Go back to time 0, for a run whose sensors take samples at these ``instants``."""
        copy_arrays(self.record, self.start)
        self._silent[:] = False
        self.begin_piece(0)
        # Rows of the reading of each sample, then the largest sum over one instant.
        rows = np.concatenate([instants.rows, [0]])[instants.sensor]
        totals = np.concatenate([[0], np.cumsum(rows)])[instants.first]
        p, samples = (int(np.diff(part).max(initial=1)) for part in (totals, instants.first))
        if p > self._p or samples > self._samples:
            self._p, self._samples = max(p, self._p), max(samples, self._samples)
            self.grow(len(self.run.message))

    def restart(self, h: int, moved: FloatArray) -> None:
        """Let node ``h`` begin again, in coordinates that have ``moved`` (n',) since time 0."""
        for name in self.records.arrays:
            place = self.records.place(name, h, self.run.first)
            getattr(self.record, name)[place] = getattr(self.start, name)[place]
        if moved.any():
            arrays = {name: getattr(self.record, name) for name in self.records.arrays}
            self.records.begin_elsewhere(arrays, h, 0, moved)

    def begin_piece(self, piece: int) -> None:
        """Let nodes, predicted to its begin, believe the models of a piece of the plant."""
        model = self.run.model
        if self._rates:
            return
        # The last model of a piece has no sensors.
        own = np.where(self._silent, model.stride - 1, self._first_models)
        model.piece, model.models[:] = piece, own + piece * model.stride

    def set_reading(self, h: int, reads: bool) -> None:
        """Let node ``h`` count its increments in predictions from now on, or no more."""
        self._silent[h] = not reads
        self.begin_piece(self.run.model.piece)

    @property
    def estimates(self) -> tuple[FloatArray, FloatArray]:
        """Estimates (N, n) and roots (N, n, n): views of those of the record."""
        arrays = self.records.arrays
        return arrays["xhat"][0, ..., 0], arrays["root"][0, ..., 0]

    def sums(self) -> dict[str, tuple[float, float]]:
        """Return by name the sums that exchanges conserve, at the start and at the last sample."""
        pairs = zip(self._at_start, self._sums(), strict=True)
        return dict(zip(self._conserved, pairs, strict=True))

    def _sums(self) -> list[float]:
        """Return the sums that exchanges conserve, at the last sample."""
        columns = range(len(self._conserved))
        return [math.fsum(self.record.conserved[:, k, 0].tolist()) for k in columns]

    def _inbox(self, messages: int) -> dict[str, Any]:
        readings = 1 + messages if self.kernels.sends_readings else 1
        columns, pairs = self._columns, no_pairs()
        if columns > self._width:
            count = readings * self._samples
            rows = linear_rows(count, self._p, np.full((count, columns), -1))
            rows.R[0], rows.origin = np.eye(self._p), np.zeros((1, self._n))
            first = np.zeros(1 + readings, dtype=np.int64)
            pairs = empty_pairs(rows, self._width, first, *self._known_pairs)
        return {
            "pairs": pairs,
            "gate": self._gate_of_instants(),
            "y": np.zeros((readings, self._p, 1)),
            "H": np.zeros((readings, self._p, columns, 1)),
            "rows": np.zeros(readings, dtype=np.int64),
            "matrix": np.arange(readings),
            **empty_inbox(1, messages),
        }

    def _gate_of_instants(self) -> GateTables:
        """Return the gate with room for all samples of an instant, which the loop writes."""
        if self._gate is None:
            return no_gate()
        parts = [(0, self._p)] * self._samples
        return gate_tables(self._gate, self._width, (1, 1), [parts], self._own)

    def advance(self, state: Simulation) -> int:
        """Run the event loop until it needs something from Python; return its request."""
        record, run = any_struct(self.record), self._general_run
        request = int(clock_loop(state, record, run, self._verbs))
        for model in self._rates:
            model.raise_error()
        if self._readings is not None:
            self._readings.setup.raise_error()
        return request

    def simulate(self, state: Simulation, batch: BatchArrays) -> dict[str, FloatArray]:
        """Simulate all runs of a batch; the results are in ``batch``, samples in
        ``state.buffer``. Return by name the sums (R, 2) that exchanges conserve, at the start and
        at the last sample of each run.
        """
        run, resumed, runs, sums = 0, False, len(batch.lengths), []
        records = any_struct(self.record), any_struct(self.start)
        while run < runs:
            after = run + 1 if self._conserved else runs
            arguments = *records, self._general_run, self._verbs, batch.memory, run, after, resumed
            run = int(batch_loop(state, *arguments))
            # A run stops only if the pool of messages is too small.
            resumed = run < after
            if resumed:
                add_messages(state, state.most_messages)
                self.grow(len(state.pool))
            else:
                sums.append(self.sums())
        return {name: np.array([one[name] for one in sums]) for name in self._conserved}

    def _room(self, messages: int) -> int:
        """Return for how many messages there must be room with those that are translated, or that
        a node tells all others at once.
        """
        addressed = self._degree + 1 if self.kernels.addressed else 0
        return (2 * messages if len(self._common) else messages) + addressed

    def grow(self, messages: int) -> None:
        """Make room for so many messages; those that are there stay."""
        messages = max(messages, len(self.run.message))
        self.record.payload = resized(self.record.payload, self._room(messages))
        self.quantiser.find_payload()
        for name, array in self._inbox(messages).items():
            setattr(self.run, name, array)

    def grow_past(self) -> None:
        """Make room for twice as many past events of each node."""
        for record in (self.record, self.start):
            double_past(record, self.records.past)
        self._verbs.room = self.record.room

    def shift(self, scenario: Scenario, state: Simulation, offset: FloatArray) -> None:
        """Move all nodes and messages under way by ``offset`` (n,), as the origin has moved."""
        if self.kernels.remembers and self.record.kept.max() == self.record.room:
            self.grow_past()
        run, now = self.run, float(state.frames[state.frame_at])
        run.offset[:, 0] = offset
        for h in range(len(self.record.xhat)):
            call_kernel(self.kernels.shift, self.record, h, run=run)
        for m in state.heap[: state.in_flight].tolist():
            # A payload refers to the time of sending: predict the offset back to it.
            run.offset[:, 0] = scenario.move_back(offset, now - state.pool["sent"][m])
            call_kernel(self.kernels.shift_payload, self.record, m, run=run)


def _links_by_receiver(scenario: Scenario) -> dict[str, Any]:
    index = scenario.topology.index
    directions = scenario.topology.directions if scenario.node_filter.timing.talks else ()
    ends = sorted((index[receiver], index[sender]) for sender, receiver in directions)
    receivers = np.array([receiver for receiver, _ in ends], dtype=np.int64)
    nodes, senders = scenario.nodes, np.array([sender for _, sender in ends], dtype=np.int64)
    first = np.searchsorted(receivers, np.arange(len(nodes) + 1)).astype(np.int64)
    return {
        "first": first,
        "sender": senders,
        "opposite": opposite_links(first, senders),
        "weight": np.array([scenario.weight(nodes[r], nodes[s]) for r, s in ends], dtype=float),
    }
