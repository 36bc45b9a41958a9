"""One run in slots: the slots made, the readings drawn, the estimates carried by compiled code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.baselines import Central, Local
from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.filter import Filter
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.kernels.stopping import RULES
from netkf.algorithms.push_sum import PushSum
from netkf.engines.base import Progress
from netkf.engines.compiled.exchanges import SENSING, Slots
from netkf.engines.compiled.masses import first_masses
from netkf.engines.compiled.plain import make_exchanges
from netkf.engines.compiled.samples import recorded
from netkf.engines.compiled.slots import (
    Nodes,
    Readings,
    Shown,
    Steps,
    diffusion,
    gossip,
    intermittent,
    local,
    push_sum,
)
from netkf.linalg.arrays import FloatArray, square_root
from netkf.linalg.compiling import demanded
from netkf.plants.linear import Truth
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Recorder

KERNELS: dict[type[Filter], Callable[..., None]] = {
    Gossip: gossip,
    Intermittent: intermittent,
    DiffusionFilter: diffusion,
    PushSum: push_sum,
    Local: local,
    Central: local,
}


class _Slot(NamedTuple):
    """The state in one slot: ``absolute`` (n,), and in the coordinates of the estimates when the
    slot is ``shown`` and when it is ``sensed``; by how much their origin moves (``offset``).
    """

    absolute: FloatArray
    shown: FloatArray
    sensed: FloatArray
    offset: FloatArray


class SlotRun:
    """What one run in slots carries from one lot of slots to the next."""

    def __init__(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> None:
        self._scenario, self._recorder, self._progress = scenario, recorder, progress
        algorithm = scenario.filter.algorithm
        self._kernel, self._pooled = demanded(KERNELS[type(scenario.hosted)]), algorithm.pooled
        self._exchanges = make_exchanges(scenario, streams)
        recorder.exact_errors = scenario.exact_errors
        self._truth: Truth = scenario.slot_truth(streams)
        paths = {
            node: [scenario.slot_path(streams, node, p) for p in scenario.placed[node]]
            for node in scenario.sensing
        }
        nodes = scenario.nodes
        self._paths = [[path for some in paths.values() for path in some]]
        if not self._pooled:
            self._paths = [paths.get(node, []) for node in nodes]
        self._nodes = _nodes(scenario, self._pooled)
        self._extra, self._mass = _extra(scenario)
        self._sums = {name: math.fsum(self._mass[:, j]) for j, name in SUMS if len(self._mass)}

    def to_the_end(self) -> str:
        """Simulate up to the horizon; returns complete or diverged."""
        try:
            while (slots := self._exchanges.following()) is not None:
                if not self._lot(slots):
                    return "diverged"
        finally:
            self._recorder.flush()
        return "complete"

    def _lot(self, slots: Slots) -> bool:
        count, (size, n) = len(slots.samples), self._nodes.xhat.shape
        shown = Shown(
            np.zeros((count, size, n)), np.zeros((count, size, n, n)), np.zeros((count, size, 2))
        )
        # States first: the truth is asked for in the order of the slots.
        states = self._states(slots)
        readings = self._readings(slots, states)
        self._kernel(self._nodes, readings, Steps(*slots[:7]), shown, *self._extra)
        rows = slots.rows
        if len(self._mass) and count:
            now = {name: math.fsum(shown.mass[-1, :, j]) for j, name in SUMS}
            self._recorder.sums = {name: (self._sums[name], now[name]) for name in now}
        x = np.array([states[slot].absolute for slot, _, _ in slots.samples]).reshape(-1, n)
        local = x  # also where nobody knows the state
        if self._truth.frame_slots is not None:
            local = np.array([states[slot].shown for slot, _, _ in slots.samples]).reshape(-1, n)
        fine = recorded(
            self._scenario,
            self._recorder,
            self._progress,
            np.array([time for _, time, _ in slots.samples]),
            x,
            local,
            shown.xhat,
            shown.root @ np.swapaxes(shown.root, -1, -2),
            lambda k: self._recorder.extend(rows[: slots.samples[k][2]]),
        )
        if fine:
            self._recorder.extend(rows)
        return fine

    def _states(self, slots: Slots) -> dict[int, _Slot]:
        """The truth in every slot, which is asked for in the order of the slots."""
        truth = self._truth
        nothing, zero = np.zeros(self._scenario.plant.n), np.zeros(self._scenario.plant.n)
        if truth.frame_slots is None:
            states = ((slot, truth.absolute(slot)) for slot in slots.slots)
            return {slot: _Slot(x, x, x, nothing) for slot, x in states}
        found = {}
        for slot in slots.slots:
            x, local = truth.absolute(slot), truth.local(slot)
            moves = slot > 0 and slot % truth.frame_slots == 0
            offset = truth.rebase(slot) if moves else nothing
            # Predictions are shown before a slot's readings, filtered estimates after them.
            sensed = zero if moves and self._scenario.hosted.predicts else local
            found[slot] = _Slot(x, local, sensed, offset)
        return found

    def _readings(self, slots: Slots, states: dict[int, _Slot]) -> Readings:
        size, n = self._nodes.xhat.shape
        most = self._nodes.R.shape[1]
        y = np.zeros((len(slots.slots), size, most))
        H = np.zeros((len(slots.slots), size, most, n))
        which = slots.number[slots.kind == SENSING]
        sensed = [slots.slots[k] for k in which.tolist()]
        if sensed:
            x = np.stack([states[slot].sensed for slot in sensed])
            for h, paths in enumerate(self._paths):
                row = 0
                for path in paths:
                    values, matrices = path.several(sensed, x)
                    after = row + values.shape[1]
                    y[which, h, row:after], H[which, h, row:after] = values, matrices
                    row = after
        offsets = np.array([states[slot].offset for slot in slots.slots])
        return Readings(y, H, offsets.reshape(-1, n))


SUMS = ((0, "weight"), (1, "number"))


def _nodes(scenario: Scenario, pooled: bool) -> Nodes:
    models = [scenario.pooled_slot_model] if pooled else list(scenario.slot_models)
    most = max(len(model.R) for model in models)
    R = np.zeros((len(models), most, most))
    for k, model in enumerate(models):
        R[k, : len(model.R), : len(model.R)] = model.R
    starts = [scenario.start(node) for node in scenario.nodes[: len(models)]]
    return Nodes(
        xhat=np.stack([mean for mean, _ in starts]),
        root=np.stack([square_root(cov) for _, cov in starts]),
        F=np.array(models[0].F),
        root_Q=np.ascontiguousarray(models[0].root_Q),
        rows=np.array([len(model.R) for model in models], dtype=np.int64),
        R=R,
    )


def _extra(scenario: Scenario) -> tuple[tuple[Any, ...], FloatArray]:
    """What the function of this filter is given besides, and the mass of the nodes."""
    algorithm, infos, n = scenario.filter.algorithm, scenario.node_infos, scenario.plant.n
    if isinstance(algorithm, DiffusionFilter):
        own = np.array([info.own_weight for info in infos], dtype=np.float64)
        return (own, algorithm.on_loss == "keep-own"), np.empty((0, 2))
    if not isinstance(algorithm, PushSum):
        return (), np.empty((0, 2))
    masses, root = first_masses(scenario)
    limit = np.zeros((n, n)) if root is None else np.ascontiguousarray(root)
    rule = RULES.index(algorithm.stop)
    more = (rule, algorithm.tolerance, limit, algorithm.asymptotic, algorithm.delta)
    return (masses, *more), masses.mass
