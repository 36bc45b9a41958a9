"""Consensus on information: HCMCI with its special cases, and the information-weighted filter.

Nodes exchange pairs (Omega, q) = (P^-1, P^-1 xhat) of information and replace them by convex
combinations of their own and their neighbours', ``steps`` times a slot. The filters differ in what
they combine and in how often they count it:

* CI, consensus on information: the pair after the node's reading (Battistelli and Chisci,
  Automatica 50, 2014).
* CM, consensus on measurements: the pair of the reading alone, counted ``novelty_weight`` times.
* HCMCI: both, each by itself (Battistelli, Chisci, Mugnai, Farina and Graziano, "Consensus-based
  linear and nonlinear filtering", IEEE Trans. Automatic Control 60, 2015).
* ICF: the sum of the pair of the reading and 1/N of that of the prediction, counted N times (Kamal,
  Farrell and Roy-Chowdhury, "Information weighted consensus filters and their application in
  distributed camera networks", IEEE Trans. Automatic Control 58, 2013).

A node holds K such pairs, ``parts``, and a ``Recipe`` says how the filters differ. A pair is stored
as a root [Z, z] (n, n + 1), ``Omega = Z' Z`` and ``q = Omega c + Z' z``, relative to a centre c,
the node's prediction, so that differences of near states lose no digits.

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings`` (whitened, so that
noise has variance 1), ``plan`` (the events of S slots), ``links``, ``samples`` (output) and
``scratch``. Estimates are relative to an origin near the true state, which moves in some slots
(``rebase``, ``shift``), so that large states cost no digits. A kernel
``*_single`` runs one node in one run, for the SimPy engine: both engines round alike.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Estimate, Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.information import begin_part, mix_parts, write_estimate
from netkf.algorithms.kernels.intersection import invert_lanes
from netkf.algorithms.kernels.root_update import intersect_roots
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    block_of_reading,
    predict_all,
    rebase,
    slot_scratch,
    star_of,
    store_sample_of_slot,
    whiten_reading,
)
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.pairs import weighted_pairs
from netkf.algorithms.registry import built_in
from netkf.algorithms.starts import check_information, information_notes
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer, one_of, positive
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, ONE, aligned, load, store

MAX_STEPS = 10_000  # consensus has converged long before: a larger value is a mistake
INFORMATION, MEASUREMENTS, HYBRID = "information", "measurements", "hybrid"


class Recipe(NamedTuple):
    """How the K pairs of a node begin a slot, and how its estimate follows from them after the last
    step: the information of the estimate is a sum.

    shares : (K, 2), multiples of the information of the prediction and of the reading in each pair
    counts : (K + 1,), multiples of each pair in the sum, then of the node's own prediction
    """

    shares: FloatArray
    counts: FloatArray


def recipe(shares: Sequence[Sequence[float]], counts: Sequence[float]) -> Recipe:
    """Return a recipe from plain numbers: ``shares``, K rows of 2, and K + 1 ``counts``."""
    return Recipe(np.array(shares, dtype=np.float64), np.array(counts, dtype=np.float64))


class ConsensusState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance; the prediction until the last step
                 of a slot
    model : of the plant and the node's sensors
    recipe : of what pairs are made, and how often each counts
    parts : roots (K, n, n + 1) of the node's pairs, from its reading to the last step of a slot,
            else None
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    recipe: Recipe
    parts: FloatArray | None = None

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class Pairs(NamedTuple):
    """A payload: roots ``parts`` (K, n, n + 1) of K pairs, relative to ``xhat`` (n,), the sender's
    prediction.
    """

    xhat: FloatArray
    parts: FloatArray


class ConsensusArrays(NamedTuple):
    """The ``steps`` of a slot, the ``Recipe`` as ``shares`` (K, 2) and ``counts`` (K + 1,), and two
    copies of the K pairs of all H nodes of a block, ``parts`` (2, K, H, n, n + 1, L): each step
    reads one and writes the other.
    """

    steps: int
    shares: FloatArray
    counts: FloatArray
    parts: FloatArray


@kernel
def consensus_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: ConsensusArrays,
) -> None:
    """Simulate H filters by consensus on information over the S slots of a plan, in B blocks of L
    runs: in each slot they predict, make information pairs of predictions and readings, mix these
    with their neighbours' in ``arrays.steps`` steps, and compute estimates.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples`` in the slots that have one; ``arrays.parts`` is overwritten.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            # Slot 0 has no reading and no exchange: it shows the start.
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                begin_all(nodes, readings, scratch, arrays, b, s)
                for step in range(arrays.steps):
                    for h in range(len(nodes.rows)):
                        mix_parts(
                            scratch.lanes, arrays.parts, step, h, links, plan.up, (b, s, step),
                            scratch.xhat, scratch.total, scratch.whitened,
                        )  # fmt: skip
                for h in range(len(nodes.rows)):
                    write_estimate(
                        scratch.lanes, nodes.root, nodes.xhat, b, h, arrays.parts, arrays.steps % 2,
                        arrays.counts, scratch.root, scratch.xhat, scratch.total, scratch.whitened,
                    )  # fmt: skip
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)


@kernel
def begin_all(
    nodes: SlotNodes,
    readings: ReadingBlock,
    scratch: SlotScratch,
    arrays: ConsensusArrays,
    b: int,
    s: int,
) -> None:
    """Write the K initial information pairs of all H filters of block ``b``, from their predictions
    and their readings of slot ``s``, as roots [Z, z] into copy 0 of ``arrays.parts``
    (2, K, H, n, n + 1, L).

    The predictions are copied to ``scratch.xhat`` (H, n, L) and the inverses of their roots to
    ``scratch.root`` (H, n, n, L), where the steps of the slot read them. Axes: L runs side by side.
    """
    for h in range(len(nodes.rows)):
        for i in range(nodes.xhat.shape[2]):
            store(scratch.lanes, scratch.xhat, h, i, load(scratch.lanes, nodes.xhat, b, h, i))
        invert_lanes(scratch.lanes, scratch.root, h, nodes.root[b], h)
        for k in range(len(arrays.shares)):
            begin_part(
                scratch.lanes, arrays.parts, k, arrays.shares, scratch.root, readings.y, readings.H,
                (b, s, h), nodes.rows[h], scratch.xhat, scratch.total, scratch.whitened,
            )  # fmt: skip


@kernel
def begin_part_single(
    nodes: SlotNodes, readings: ReadingBlock, scratch: SlotScratch, arrays: ConsensusArrays
) -> None:
    """Write the K initial information pairs of one filter in one run, from its prediction in
    ``nodes`` and its reading, as roots [Z, z] into ``arrays.parts[0]`` of ``arrays.parts``
    (2, K, 1, n, n + 1, 1).
    """
    begin_all(nodes, readings, scratch, arrays, 0, 0)


@kernel
def mix_parts_single(
    parts: FloatArray, links: SlotLinks, up: Any, centre: FloatArray, work: Any
) -> None:
    """Do a consensus step of one node in one run, the first of H nodes in ``parts``
    (2, K, H, n, n + 1, 1), the others its senders: read copy 0 of the K information pairs of all,
    and write copy 1 of its own.

    ``centre`` (H, n, 1) are the means that pairs are relative to, ``up`` (1, 1, 1, W, 1) flags the
    messages of W senders, and ``work`` (2, n, n + 1, 1) is scratch.
    """
    mix_parts(ONE, parts, 0, 0, links, up, (0, 0, 0), centre, work[0], work[1])


@kernel
def write_estimate_single(
    root: FloatArray,
    x: FloatArray,
    parts: FloatArray,
    counts: FloatArray,
    inverse: FloatArray,
    centre: FloatArray,
    work: FloatArray,
) -> None:
    """Write the estimate x (1, 1, n, 1) and its root (1, 1, n, n, 1) of one node in one run: its
    information is the sum of ``counts[k]`` times pair k of ``parts[0]``, of ``parts``
    (2, K, 1, n, n + 1, 1), and ``counts[K]`` times that of the prediction.

    ``root`` and ``centre`` (1, n, 1) hold the prediction; ``inverse`` (1, n, n, 1) and ``work``
    (2, n, n + 1, 1) are scratch.
    """
    invert_lanes(ONE, inverse, 0, root[0], 0)
    write_estimate(ONE, root, x, 0, 0, parts, 0, counts, inverse, centre, work[0], work[1])


@dataclass(frozen=True, eq=False)
class InformationConsensus(Filter):
    """Consensus on information pairs, ``steps`` times a slot; ``recipe`` of a derived class says
    which ones.

    The weights are Metropolis', ``1 / (1 + max degree)`` for each link; the weight of a message
    that does not come stays with the node itself, so that weights always sum to one.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)  # type: ignore[assignment]

    paper: ClassVar[str] = "information_consensus"
    combination: ClassVar[str] = "intersection"
    schedule: ClassVar[tuple[str, ...] | None] = ("predict", "sense", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ()
    inverts: ClassVar[bool] = True
    slot_kernel = staticmethod(consensus_slots)

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError if rounding of information would take the first covariance of a
        ``netkf.Scenario`` in slots.
        """
        if scenario.slotted:
            check_information(scenario)

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a line on rounding of information in slots, if there is much."""
        return information_notes(scenario) if scenario.slotted else ()

    @abstractmethod
    def recipe(self, nodes: int) -> Recipe:
        """Return the recipe for a network of N ``nodes``: from which information pairs begin, and
        how often each counts.
        """

    def exchange_steps(self, phase: int) -> int:
        """Return the setting ``steps``, the number of steps of the only exchange of a slot."""
        return self.steps

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[ConsensusArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for H nodes: steps, recipe, and scratch
        (2, K, H, n, n + 1, L) for the K pairs of all nodes; ``runs`` does not matter, since blocks
        of L runs use it one after the other.
        """
        recipe = self.recipe(infos[0].nodes)
        n, K = len(states[0].xhat), len(recipe.shares)
        parts: FloatArray = aligned((2, K, len(states), n, n + 1, LANES))
        return (ConsensusArrays(self.steps, *recipe, parts),)

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message in numbers of 64 bits: K pairs (Omega, q) of n states in
        slots, one pair under clocks (``phase`` -1).
        """
        pairs = 1 if phase < 0 else len(self.recipe(2).shares)
        return pairs * (n + n * (n + 1) // 2)

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> ConsensusState:
        """Return the first state of a node, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n), and the recipe for the number of nodes, which ``node`` tells.
        """
        return ConsensusState(mean, first_root(cov), model, self.recipe(node.nodes))

    def update(self, state: ConsensusState, reading: Any) -> ConsensusState:
        """Return the state with the pairs with which the slot begins, made of the prediction and
        the ``reading``; under clocks the state after a Kalman update.
        """
        if not isinstance(state.model, SlotModel):
            updated: ConsensusState = super().update(state, reading)
            return updated
        return state._replace(parts=first_parts(state, reading))

    def emit(self, state: ConsensusState, exchange: Exchange) -> tuple[ConsensusState, Any]:
        """Return the state, unchanged, and the payload: in slots the node's pairs of this step,
        under clocks its estimate.
        """
        if exchange.slot < 0 or state.parts is None:
            return state, Estimate(state.xhat, state.root)
        return state, Pairs(state.xhat, state.parts)

    def absorb(
        self, state: ConsensusState, messages: Sequence[Message], exchange: Exchange
    ) -> ConsensusState:
        """Return the state after a consensus step on the node's information pairs and those in
        ``messages``; after the last step of a slot with the new estimate.
        """
        if exchange.slot < 0:
            return self._intersect(state, messages)
        assert state.parts is not None
        parts = mix_node_parts(state.xhat, state.parts, messages)
        # The estimate stays the prediction, to which all pairs are relative, until the last step.
        if exchange.step < self.steps - 1:
            return state._replace(parts=parts)
        xhat, root = estimate_of(state, parts)
        return state._replace(xhat=xhat, root=root, parts=None)

    def _intersect(self, state: ConsensusState, messages: Sequence[Message]) -> ConsensusState:
        """Return the state after one step of consensus under clocks: the information pair of its
        estimate becomes the weighted sum of it and those of ``messages``, predicted to now.
        """
        weights, means, roots = weighted_pairs(state, messages)
        xhat, root = intersect_roots(weights, means, roots)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine: pairs are relative to the estimate
    shift_payload = Filter.shift_payload


@built_in("hcmci")
@dataclass(frozen=True, eq=False)
class Hcmci(InformationConsensus):
    """Hybrid consensus on measurements and on information, with CM and CI as special cases.

    steps           consensus steps a slot, L of the paper
    consensus       "hybrid": the pairs of the prediction and of the reading, each by itself;
                    "information" (CI): that of both together, P is never below the covariance of
                    the error; "measurements" (CM): that of the reading alone
    novelty_weight  how often the pair of the readings counts after the last step, omega of the
                    paper; by default N, the number of nodes, which is right in the limit of many
                    steps, where that pair is the average of all readings

    Under clocks only "information" is allowed: all messages of an instant are one step of it.
    """

    consensus: str = field(one_of(HYBRID, INFORMATION, MEASUREMENTS), default=HYBRID)
    novelty_weight: float | None = field(positive, default=None)

    clocks: ClassVar[tuple[str, ...]] = ("links", "directions", "nodes", "readings")
    one_way: ClassVar[bool] = True

    def recipe(self, nodes: int) -> Recipe:
        """Return the recipe for a network of N ``nodes`` and the variant that was chosen: from
        which shares of prediction and reading the pairs begin, and how often each counts in the
        estimate.
        """
        omega = float(nodes) if self.novelty_weight is None else self.novelty_weight
        # Rows: shares of prediction and reading in a pair; then how often each pair counts, and the
        # prediction itself.
        if self.consensus == INFORMATION:
            return recipe([[1.0, 1.0]], [1.0, 0.0])
        if self.consensus == MEASUREMENTS:
            return recipe([[0.0, 1.0]], [omega, 1.0])
        return recipe([[1.0, 0.0], [0.0, 1.0]], [1.0, omega, 0.0])

    @property
    def P_by_design(self) -> tuple[str, str]:  # type: ignore[override]
        """How P compares with the covariance of its error in slots and under clocks: "larger" for
        consensus on information, else "", nothing proved.
        """
        return ("larger", "larger") if self.consensus == INFORMATION else ("", "")

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError if a ``netkf.Scenario`` has clocks and the variant is not
        "information", if a novelty weight is given to that variant, which does not use it, or if
        rounding of information would take the first covariance.
        """
        super().check_scenario(scenario)
        if not scenario.slotted and self.consensus != INFORMATION:
            raise ScenarioError(
                "filter.consensus",
                "must be information in continuous time, where nodes do not read at one instant",
                self.consensus,
                'write consensus = "information", or use a plant in slots',
            )
        if self.consensus == INFORMATION and self.novelty_weight is not None:
            raise ScenarioError(
                "filter.novelty_weight",
                "has no meaning for consensus on information, which counts a reading once",
                self.novelty_weight,
                'leave it out, or write consensus = "hybrid"',
            )


@built_in("icf")
@dataclass(frozen=True, eq=False)
class Icf(InformationConsensus):
    """Information-weighted consensus filter, Kamal et al. 2013, Algorithm 2, in slots.

    steps  steps of average consensus a slot, K of the paper

    With the same weights of links it is HCMCI with novelty weight N, which sends twice as much.
    """

    def recipe(self, nodes: int) -> Recipe:
        """Return the recipe for a network of N ``nodes``: pairs ``V = P^-1 / N + H' R^-1 H``, of
        which N times the average is the new P^-1.
        """
        return recipe([[1.0 / nodes, 1.0]], [float(nodes), 0.0])


def first_parts(state: ConsensusState, reading: Reading) -> FloatArray:
    """Return the roots (K, n, n + 1) of the K information pairs with which a node begins a slot,
    from its prediction in ``state`` and its ``reading``.
    """
    n, (y, H, R) = len(state.xhat), reading[:3]
    if len(y):
        # The kernel takes readings whose noise has variance 1.
        y, H = whiten_reading(y, H, R)
    nodes = SlotNodes(
        state.xhat.reshape(1, 1, n, 1),
        np.ascontiguousarray(state.root).reshape(1, 1, n, n, 1),
        state.model.F,
        state.model.root_Q,
        np.array([len(y)]),
    )
    readings = block_of_reading(y, H)
    shares, counts = state.recipe
    parts = np.zeros((2, len(shares), 1, n, n + 1, 1))
    begin_part_single(
        nodes, readings, slot_scratch(1, n, False, ONE), ConsensusArrays(1, shares, counts, parts)
    )
    return parts[0, :, 0, :, :, 0]


def mix_node_parts(xhat: FloatArray, parts: FloatArray, messages: Sequence[Message]) -> FloatArray:
    """Return the roots (K, n, n + 1) of a node's K information pairs after a consensus step, from
    its own ``parts`` (K, n, n + 1), relative to ``xhat`` (n,), and those in the payloads of
    ``messages``.
    """
    # The kernel of slots on a star: node 0 is this one, the others are its senders.
    K, n, _ = parts.shape
    stack = np.zeros((2, K, 1 + len(messages), n, n + 1, 1))
    centre = np.stack([xhat, *(message.payload.xhat for message in messages)])[..., None]
    stack[0, :, 0, :, :, 0] = parts
    for m, message in enumerate(messages):
        stack[0, :, 1 + m, :, :, 0] = message.payload.parts
    links, up = star_of([message.weight for message in messages])
    mix_parts_single(stack, links, up, np.ascontiguousarray(centre), np.empty((2, n, n + 1, 1)))
    return stack[1, :, 0, :, :, 0]


def estimate_of(state: ConsensusState, parts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return estimate (n,) and root (n, n) of a node from its K information pairs after the last
    step, the roots ``parts`` (K, n, n + 1), and its prediction in ``state``, as its recipe says.
    """
    K, n, _ = parts.shape
    stack = np.zeros((2, K, 1, n, n + 1, 1))
    stack[0, :, 0, :, :, 0] = parts
    x, root = state.xhat.reshape(1, 1, n, 1).copy(), state.root.reshape(1, 1, n, n, 1).copy()
    inverse, work = np.zeros((1, n, n, 1)), np.empty((2, n, n + 1, 1))
    centre = state.xhat.reshape(1, n, 1).copy()
    write_estimate_single(root, x, stack, state.recipe.counts, inverse, centre, work)
    return x.reshape(n), np.tril(root.reshape(n, n))
