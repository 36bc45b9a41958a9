"""Exact errors of affine filters in slots, from their own verbs.

Given the events of a run, estimates are linear in the first state and in all noises: one *column*
for each. The filter's own kernels run on the columns side by side, as on so many runs, in each of
which one noise is 1 and all others are 0; the covariance of all errors is the sum of the products
of the columns. A filter needs no rule of its own for that. When there are many columns they are
turned into as few as their rank allows, which leaves the sum of products as it is.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.records import make_records
from netkf.engines.compiled.life_tables import LifeTable, life_table
from netkf.engines.compiled.slot_filters import SlotFilters
from netkf.engines.compiled.slot_loop import WHOLE, SlotSamples
from netkf.engines.compiled.slot_setup import SlotSetup, slot_setup
from netkf.engines.compiled.slot_steps import absent, slot_restarts, step_times
from netkf.linalg.arrays import FloatArray, square_root
from netkf.linalg.lanes import LANES, blocks_of
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import arrivals_in_slots
from netkf.theory.common.columns import ErrorColumns, padded
from netkf.theory.common.observations import Observation, slot_observations
from netkf.trace.run import Run

ZERO, MEAN, NOISE = range(3)
"""The first columns: no noise at all, whose entries are those that do not depend on noise; the
means; from NOISE on the noises.
"""

FEW = 64
"""Columns that cost no more time than fewer do."""


class SlotColumns(ErrorColumns):
    """The errors of M estimators in slots, as columns.

    ``_x`` (n, C) is the true state; its columns are ZERO, MEAN and the noises.
    """

    def __init__(self, scenario: Scenario, run: Run) -> None:
        kernels = compiled_kernels(scenario.node_filter, clocked=False)
        assert kernels is not None
        self._scenario, self._run = scenario, run
        self._setup: SlotSetup = slot_setup(scenario)
        self.estimators, self.n = self._setup.estimators, self._setup.n
        plant = scenario.linear_plant
        self._laws = [(piece.F, square_root(piece.Q)) for piece in plant.pieces]
        self._kernels = replace(kernels, decides=False)
        super().__init__()
        self._fewest = 0
        self._observations = slot_observations(scenario, run, is_up=self._is_up)
        self._lives = life_table(scenario, Streams(run.seed, run.replica))
        self._absent: tuple[int, np.ndarray] = (-1, np.zeros(0, dtype=bool))
        self._restarts = slot_restarts(scenario, self._lives)
        # The origin follows the true state, so that errors on unstable plants keep their digits,
        # but not the mean with which a node begins again.
        framed = scenario.filters_know_the_truth and not self._setup.forgets
        self._framed = framed and scenario.views is None
        # The true state (n, columns).
        self._x = np.column_stack([np.zeros(self.n), plant.start_mean, plant.start_root])
        self._filters = self._begin()

    def _observe(self, slot: int) -> dict[int, Observation]:
        return self._observations(slot)

    def _is_up(self, node: int, slot: int) -> bool:
        if not self._scenario.network.lives:
            return True
        if self._absent[0] != slot:
            times = step_times(self._scenario, self._setup, slot, 1)
            self._absent = slot, absent(self._setup, self._lives, times)[0]
        return not self._absent[1][self._scenario.topology.index[node]]

    def _begin(self) -> SlotFilters:
        setup = self._setup
        # Making filters takes longer than some slots: there is room for all columns that few are.
        in_slot = self.n + int(setup.rows.sum())
        columns = self._x.shape[1] + min(FEW, in_slot * (setup.slots + 1))
        filters = SlotFilters(setup, self._kernels, blocks_of(columns), with_means=False)
        starts = list(zip(setup.xhat, setup.root, strict=True))
        means = make_records(
            setup.algorithm, starts, setup.infos, setup.models, len(setup.links.sender), 1
        )
        self._start = {}
        for name, array in filters.records.arrays.items():
            array[0, ..., MEAN] = means.arrays[name][0, ..., 0]
            if setup.forgets:
                self._start[name] = array[0].copy()
        return filters

    def _restart(self, slot: int) -> None:
        setup, records, scenario = self._setup, self._filters.records, self._scenario
        before = max(slot - (not scenario.node_filter.timing.predicts), 0)
        for h in self._restarts.get(slot, ()):
            for name, array in records.arrays.items():
                place = records.place(name, h, setup.links.first)
                array[:, place] = self._start[name][place][..., ZERO : ZERO + 1]
                array[0, place] = self._start[name][place]
            moved = scenario.prior_shift(setup.infos[h].node, before)
            self._filters.begin_elsewhere(h, MEAN, moved)

    def replay(self) -> Iterator[None]:
        """Replay the events of the run; yield at each of ``run.times``."""
        scenario, run, setup = self._scenario, self._run, self._setup
        talks = scenario.node_filter.timing.talks
        arrivals = _used_messages(scenario, run, setup, self._lives) if talks else {}
        predicts, processed = scenario.node_filter.timing.predicts, 0
        for until in scenario.slot_plant.slots_of(run.times).tolist():
            while processed < until:
                slot = processed if predicts else processed + 1
                if predicts:
                    self._simulate(slot, self._observe(slot), arrivals)
                else:
                    self._restart(slot)
                self._move_truth(processed)
                if not predicts:
                    self._simulate(slot, self._observe(slot), arrivals)
                if self._x.shape[1] > max(FEW, 2 * self._fewest):
                    self._compress()
                    self._fewest = self._x.shape[1]
                processed += 1
                if predicts:
                    self._restart(processed)
            yield

    def _move_truth(self, slot: int) -> None:
        F, noise = self._laws[bisect.bisect_right(self._scenario.slot_plant.change_slots, slot)]
        self._x = np.column_stack([F @ self._x, noise])
        if self._scenario.surprise is not None:
            before, after = self._scenario.surprise.states(np.array([slot, slot + 1]))
            self._x[:, MEAN] += after - F @ before
        self._fit(self._x.shape[1])

    def _fit(self, columns: int) -> None:
        """Give the filters room for so many columns; unused ones are as without noise."""
        former = self._filters.records.arrays
        old, blocks = len(former["xhat"]), blocks_of(columns)
        if blocks <= old:
            return
        # Making filters takes longer than a slot of a few columns more.
        room = blocks + blocks // 4
        self._filters = SlotFilters(self._setup, self._kernels, room, with_means=False)
        for name, array in self._filters.records.arrays.items():
            array[:] = former[name][:1, ..., ZERO : ZERO + 1]
            array[:old] = former[name]

    def _simulate(
        self, slot: int, observations: dict[int, Observation], arrivals: dict[int, np.ndarray]
    ) -> None:
        setup, n = self._setup, self.n
        first = self._x.shape[1]
        columns = first + sum(o.root.shape[1] for o in observations.values())
        self._x = np.column_stack([self._x, np.zeros((n, columns - first))])
        self._fit(columns)
        blocks = len(self._filters.records.arrays["xhat"])
        width = blocks * LANES
        framed = self._framed
        state = padded(self._x, width - columns).reshape(n, 1, blocks, LANES)
        local = np.ascontiguousarray(state.transpose(2, 1, 0, 3))
        if framed and setup.algorithm.timing.predicts:
            self._x[:] = 0.0
        y = np.zeros((setup.estimators, setup.p, width))
        H = np.zeros((1, 1, setup.estimators, setup.p, n, LANES))
        for h, observation in observations.items():
            rows, noises = observation.root.shape
            whitened, noise = self._whiten(observation)
            y[h, :rows, :columns] = whitened @ self._x
            y[h, :rows, first : first + noises] += noise
            H[0, 0, h, :rows] = whitened[:, setup.entries[h], None]
            first += noises
        y = y.reshape(*y.shape[:2], blocks, LANES).transpose(2, 0, 1, 3)[:, None]
        algorithm, steps = setup.algorithm, len(setup.fresh)
        up = arrivals.get(slot, np.zeros((steps, len(setup.directions)), dtype=np.uint8))
        shape, sent = (blocks, 1, *up.shape, LANES), np.zeros((0,) * 5, dtype=np.uint8)
        if self._scenario.network.lives:
            # Who is down gives nothing away.
            begins = step_times(self._scenario, setup, slot, 1).begin[0]
            asleep = [self._lives.is_down(h, begins) for h in range(setup.estimators)]
            sent = np.zeros((blocks, 1, steps, setup.estimators, LANES), dtype=np.uint8)
            sent[:] = ~np.array(asleep).T[:, :, None]
        nothing = np.zeros(1, dtype=bool)
        self._filters.simulate(
            np.ascontiguousarray(y),
            H,
            _no_samples(local, blocks, self._filters),
            first=slot,
            sensed=~nothing,
            exchanged=np.array(
                [algorithm.timing.talks and slot >= algorithm.timing.first_exchange]
            ),
            sample=np.full(1, -1),
            rebased=~nothing if framed else nothing,
            up=np.ascontiguousarray(np.broadcast_to(up[None, None, :, :, None], shape)),
            sent=sent,
            uniform=np.zeros((0,) * 5),
            begin=WHOLE,
            stop=WHOLE,
        )
        if framed:
            self._x[:] = 0.0

    def _compress(self) -> None:
        columns = self._x.shape[1]
        linear = {}
        for name, array in self._filters.records.arrays.items():
            if array.dtype != np.float64:
                continue
            matrix = self._matrix(name)
            rows = (matrix[:, NOISE:] != matrix[:, ZERO : ZERO + 1]).any(axis=1)
            if rows.any():
                linear[name] = matrix, rows
        parts = [M[rows, NOISE:] - M[rows, ZERO : ZERO + 1] for M, rows in linear.values()]
        # Columns that came after a time are zero there.
        kept = [padded(form, columns - 1 - form.shape[1], 1) for form in self._kept]
        forms = [self._x, *kept]
        stack = np.concatenate([*(form[:, NOISE:] for form in forms), *parts])
        if len(stack) < stack.shape[1]:
            # stack' = Q R, and stack Q = R' has the same products.
            stack = cast(FloatArray, np.linalg.qr(stack.T, mode="r")).T
        count = NOISE + stack.shape[1]
        pieces = np.split(stack, np.cumsum([len(form) for form in (*forms, *parts)])[:-1])
        forms = [np.column_stack([f[:, :NOISE], p]) for f, p in zip(forms, pieces, strict=False)]
        self._x, self._kept = forms[0], [form[:, MEAN:] for form in forms[1:]]
        values = {}
        for (name, (matrix, rows)), part in zip(linear.items(), pieces[len(forms) :], strict=True):
            whole = np.repeat(matrix[:, ZERO : ZERO + 1], count, axis=1)
            whole[:, MEAN] = matrix[:, MEAN]
            whole[rows, NOISE:] += part
            values[name] = whole
        self._write(values, count)

    def _forms(self) -> FloatArray:
        """Return the errors (M n, C - 1): the means, and the columns of noises."""
        return np.asarray(self._x[self._setup.entries.ravel()] - self._matrix("xhat"))[:, MEAN:]

    def covariances(self) -> FloatArray:
        """Return P (M, n, n) of the estimators."""
        S = np.tril(self._matrix("root")[:, ZERO].reshape(self.estimators, self.n, self.n))
        return np.asarray(S @ np.swapaxes(S, 1, 2))

    def _matrix(self, name: str) -> FloatArray:
        array = self._filters.records.arrays[name]
        entries = array.transpose(*range(1, array.ndim - 1), 0, array.ndim - 1)
        return entries.reshape(-1, len(array) * LANES)[:, : self._x.shape[1]]

    def _write(self, values: dict[str, FloatArray], columns: int) -> None:
        """Give the filters so many columns, with these matrices (entries, columns)."""
        self._fit(columns)
        arrays = self._filters.records.arrays
        width = len(arrays["xhat"]) * LANES
        for name, whole in values.items():
            array = arrays[name]
            full = np.repeat(whole[:, ZERO : ZERO + 1], width, axis=1)
            full[:, :columns] = whole
            shape = (*array.shape[1:-1], len(array), LANES)
            array[:] = np.moveaxis(full.reshape(shape), -2, 0)


def _no_samples(local: FloatArray, blocks: int, filters: SlotFilters) -> SlotSamples:
    """Return room for no sample, with the true states (B, 1, n, L) of the slot."""
    nothing = np.zeros((1, 0, 1))
    return SlotSamples(
        x=nothing, xhat=nothing, P=nothing, error=nothing, absolute=local, local=local,
        framed=False, total=np.zeros((blocks, LANES)), **filters.sample_scratch,
        entries=np.zeros((0, 0), dtype=np.int64),
    )  # fmt: skip


def _used_messages(
    scenario: Scenario, run: Run, setup: SlotSetup, lives: LifeTable
) -> dict[int, np.ndarray]:
    """Return by slot which messages were used, (E, W) by exchange and directed link."""
    times = step_times(scenario, setup, 0, setup.slots) if len(lives.t) else None
    index, shape = scenario.topology.index, (len(setup.fresh), len(setup.directions))
    used: dict[int, np.ndarray] = {}
    for (slot, phase, number), sender, receiver, t, _ in arrivals_in_slots(scenario, run):
        step = setup.phases.index(max(phase, 0)) + number
        if times is not None:
            # Who goes down before the step ends has lost what arrived.
            changes = lives.t[lives.node == index[receiver]]
            if ((changes > t) & (changes <= times.end[slot, step])).any():
                continue
        w = setup.index_of_direction[sender, receiver]
        used.setdefault(slot, np.zeros(shape, dtype=np.uint8))[step, w] = 1
    return used
