"""The hybrid filter of Tanwani (CDC 2021), paper H, with constant gains, Remark 1: simpler, and
never better than Riccati gains.

    dxhat = A xhat dt + L (dy - H xhat dt),   dP/dt = (A - L H) P + P (A - L H)' + L R L' + Q

for increments; a sample or a reading in slots moves the estimate by ``L (y - H xhat)`` and P to
``(I - L H) P (I - L H)' + L R L'``. Messages reset estimate and P to convex combinations with
those of the senders, paper H (7) and (9).

``constant_gain_slots`` simulates many runs in the compiled engine, in place of the methods of
``ConstantGain``; the types of its arguments are described in ``kernels.slots``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.closed_loops import closed_loop, gain_rate, sample_maps
from netkf.algorithms.filter import Exchange, Filter, Increments, Message, NodeInfo
from netkf.algorithms.kernels.constant_gains import correct_by_innovation, correct_by_moments
from netkf.algorithms.kernels.neighbours import combine_convex_roots, copy_pairs
from netkf.algorithms.kernels.root_update import combine_roots
from netkf.algorithms.kernels.run import usable
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    move_root,
    predict_all,
    predict_root_alone,
    rebase,
    store_sample_of_slot,
)
from netkf.algorithms.models import FlowModel, SlotModel, first_root
from netkf.algorithms.pairs import weighted_pairs
from netkf.algorithms.registry import built_in
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile, either, field, has_depth, list_of, matrix
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, store


class ConstantGainState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of P
    model : of the plant and the node's sensors
    gain : L (n, p)
    loop : model of the closed loop where sensors give increments, else None
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    gain: FloatArray
    loop: FlowModel | None

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class ConstantGainArrays(NamedTuple):
    """Constant matrices of H filters of p rows at most, for whitened readings (noise variance 1).

    closed : (H, n, n), I - L H
    noise : (H, n, n), lower triangular root of L R L'
    gain : (H, n, p), L times the Cholesky factor of R
    """

    closed: FloatArray
    noise: FloatArray
    gain: FloatArray


@kernel
def constant_gain_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: ConstantGainArrays,
) -> None:
    """Simulate H filters with constant gains, which ``arrays`` holds, over the S slots of a plan,
    in B blocks of L runs: in each slot they predict, correct by their readings and form convex
    combinations.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples`` in the slots that have one.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                for h in range(len(nodes.rows)):
                    if nodes.rows[h] > 0:
                        correct_by_gain(nodes, readings, scratch, arrays, b, s, h)
                # Messages are copies from before the exchange: all resets are simultaneous.
                copy_pairs(nodes, scratch, b)
                for h in range(len(nodes.rows)):
                    combine_convex_roots(nodes, plan, links, scratch, b, s, h)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep the estimates relative to an origin near the true state.
            rebase(nodes, readings, scratch, b, s)


@kernel
def correct_by_gain(
    nodes: SlotNodes,
    readings: ReadingBlock,
    scratch: SlotScratch,
    arrays: ConstantGainArrays,
    b: int,
    s: int,
    h: int,
) -> None:
    """Update filter ``h`` of block ``b`` by its reading of slot ``s`` and its gain L,
    ``arrays.gain[h]`` (n, p): changes ``nodes.xhat[b, h]`` (n, L) by ``xhat += L (y - H xhat)``,
    and ``nodes.root[b, h]`` (n, n, L) to the root of ``P = (I - L H) P (I - L H)' + L R L'``. The
    last axis of both is that of the runs side by side.
    """
    lanes, n = scratch.lanes, nodes.xhat.shape[2]
    # L (y - H xhat) in ``moved_mean``: all innovations refer to the estimate before the reading,
    # since L is the gain of all its rows together.
    for i in range(n):
        store(lanes, scratch.moved_mean, i, 0.0)
    for k in range(nodes.rows[h]):
        innovation = load(lanes, readings.y, b, s, h, k)
        for j in range(n):
            weight = load(lanes, readings.H, 0, 0, h, k, j)
            innovation -= weight * load(lanes, nodes.xhat, b, h, j)
        for i in range(n):
            correction = load(lanes, scratch.moved_mean, i) + arrays.gain[h, i, k] * innovation
            store(lanes, scratch.moved_mean, i, correction)
    for i in range(n):
        total = load(lanes, nodes.xhat, b, h, i) + load(lanes, scratch.moved_mean, i)
        store(lanes, nodes.xhat, b, h, i, total)
    # (I - L H) P (I - L H)' + L R L' has the form of a prediction F P F' + Q.
    move_root(scratch, nodes.root, b, h, arrays.closed[h], arrays.noise[h])


@built_in("constant-gain")
@dataclass(frozen=True, eq=False)
class ConstantGain(Filter):
    """Constant gains for the node's own readings and convex resets with Metropolis weights.

    gain  L (n, p): one for all nodes with sensors, or a list with one per node in the order of ids,
          of which those of nodes without sensors are not used

    In slots the estimate moves at each reading and then resets to the convex combination with the
    neighbours that it hears; samples are filtered. P is no smaller than the covariance of the
    error, as with Riccati gains, which make it smallest (H (15)).
    """

    gain: FloatArray | tuple[FloatArray, ...] = field(
        either(matrix, list_of(matrix, "matrices"), has_depth(3))
    )

    paper: ClassVar[str] = "constant_gain"
    combination: ClassVar[str] = "constant gain"
    P_by_design: ClassVar[tuple[str, str]] = ("larger", "larger")
    schedule: ClassVar[tuple[str, ...] | None] = ("predict", "sense", "exchange")
    one_way: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True
    every_reading: ClassVar[bool] = True
    slot_kernel = staticmethod(constant_gain_slots)

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[ConstantGainArrays]:
        """Return the last argument of ``constant_gain_slots``: the constant matrices of the H nodes
        that start in these ``states``, which all ``runs`` share.
        """
        n = len(states[0].xhat)
        max_rows = max(1, *(state.gain.shape[1] for state in states))
        closed, noise = np.zeros((len(states), n, n)), np.zeros((len(states), n, n))
        gain = np.zeros((len(states), n, max_rows))
        for k, state in enumerate(states):
            p = len(state.model.H)
            if p:
                closed[k], noise[k] = sample_maps(state.gain, state.model.H, state.model.R)
                # L times the Cholesky factor of R, because readings come whitened.
                gain[k, :, :p] = state.gain @ np.linalg.cholesky(state.model.R)
        return (ConstantGainArrays(closed, noise, gain),)

    def init(
        self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo
    ) -> ConstantGainState:
        """Return the first state of a node, with estimate ``mean`` (n,), covariance ``cov`` (n, n)
        and the node's gain.
        """
        gain = self.gain_of(node.place)
        increments = not isinstance(model, SlotModel) and len(model.H)
        loop = closed_loop(model, gain) if increments else None
        return ConstantGainState(mean, first_root(cov), model, gain, loop)

    def gain_of(self, index: int) -> FloatArray:
        """Return the gain (n, p) of the node with this ``index`` in the order of ids, from 0."""
        return self.gain[index] if isinstance(self.gain, tuple) else self.gain

    def predict(self, state: ConstantGainState, gap: float) -> ConstantGainState:
        """Return the state ``gap`` seconds later; with increments P counts the readings of the gap
        already, the estimate does not.
        """
        if state.loop is None:
            xhat, root = state.model.predict(state.xhat, state.root, gap)
            return state._replace(xhat=xhat, root=root)
        # The estimate moves without readings, which update() adds; P is that of the closed loop,
        # dP/dt = (A - L H) P + P (A - L H)' + L R L' + Q.
        xhat, _ = state.model.extrapolate(state.xhat, state.root, gap)
        _, root = state.loop.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root)

    def update(self, state: ConstantGainState, reading: Any) -> ConstantGainState:
        """Return the state after a sample, or after the increments of the gap that just passed, by
        the node's constant gain.
        """
        if isinstance(reading, Increments):
            assert state.loop is not None
            model, n = state.model, len(state.xhat)
            # The kernel changes x[0] and the moments in place; its last argument is scratch.
            x = state.xhat.reshape(1, n).copy()
            correct_by_moments(
                x, 0, model.A, state.loop.A, model.H, state.gain, reading.moments.copy(),
                reading.gap, np.empty((6, n, n)),
            )  # fmt: skip
            return state._replace(xhat=x[0])
        if not len(reading.y):
            return state
        # P+ = (I - L H) P (I - L H)' + L R L' has the form of a prediction F P F' + Q.
        closed, noise = sample_maps(state.gain, reading.H, reading.R)
        x, H = state.xhat.reshape(1, -1).copy(), np.ascontiguousarray(reading.H)
        # x[0] <- x[0] + L (y - H x[0]), in place; the last argument is scratch.
        correct_by_innovation(x, 0, H, state.gain, reading.y, np.empty(len(state.xhat)))
        return state._replace(xhat=x[0], root=predict_root_alone(state.root, closed, noise))

    def absorb(
        self, state: ConstantGainState, messages: Sequence[Message], exchange: Exchange
    ) -> ConstantGainState:
        """Return the state after a reset by paper H (7) and (9): the convex combination of the
        node's estimate and covariance with those of all messages.
        """
        if not messages:
            return state
        weights, means, roots = weighted_pairs(state, messages)
        xhat, root = combine_roots(weights, means, roots)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine: the weights sum to one

    def max_measurement_interval(self, state: ConstantGainState) -> float:
        """Return the seconds of increments that ``update`` may use at once: 1 / |L H|, the time
        scale on which the gain moves the estimate; infinity without increments.
        """
        return usable(gain_rate(state.gain, state.model.H) if state.loop is not None else 0.0)

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where the gains do not fit a ``netkf.Scenario``: recorded sensors
        in continuous time, another number of gains than of nodes, or a gain that is not n x p for
        the p rows of a node.
        """
        for k, sensor in enumerate(scenario.sensors):
            # A node may have several rows at one instant, and a gain weighs one reading.
            if not scenario.slotted and isinstance(getattr(sensor, "path", None), SourceFile):
                raise ScenarioError(
                    f"sensors[{k}].kind",
                    "must not be recorded for the constant-gain filter in continuous time",
                    "recorded",
                    "use linear sensors, slots, or another filter",
                )
        nodes, n = scenario.nodes, scenario.plant.n
        if isinstance(self.gain, tuple) and len(self.gain) != len(nodes):
            rule = f"must be one matrix, or one for each of {len(nodes)} nodes"
            raise ScenarioError("filter.gain", rule, f"{len(self.gain)} matrices", "add or remove")
        for index, node in enumerate(nodes):
            placed = scenario.placed_sensors.get(node, ())
            _check_kinds(scenario, node, placed)
            p = sum(len(scenario.sensors[placed_sensor.entry].H) for placed_sensor in placed)
            shape = self.gain_of(index).shape
            if p and shape != (n, p):
                key = f"filter.gain[{index}]" if isinstance(self.gain, tuple) else "filter.gain"
                rule = f"must be {n} x {p}, because node {node} has {p} rows of readings"
                raise ScenarioError(key, rule, f"{shape[0]} x {shape[1]}", "one column per row")


def _check_kinds(scenario: Any, node: int, placed: Sequence[Any]) -> None:
    """Raise ScenarioError if ``node``, an id, has readings at several times, which one gain cannot
    weigh; ``placed`` are its sensors.
    """
    if scenario.slotted or len(placed) < 2:
        return
    if any(
        getattr(scenario.sensors[placed_sensor.entry], "sampling", None) for placed_sensor in placed
    ):
        raise ScenarioError(
            "filter.gain",
            f"node {node} has several sensors, and one that takes samples must be its only one",
            None,
            "give it one sensor, or another filter",
        )
