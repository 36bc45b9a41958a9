"""Asynchronous Gaussian belief propagation on the graph of the network.

Each node has a copy of the state, and links say that the copies at their ends are equal. A message
to a neighbour is the sum of the node's own evidence and of that of all its *other* neighbours
(Weiss and Freeman, "Correctness of belief propagation in Gaussian graphical models of arbitrary
topology", Neural Computation 13, 2001). On a tree no reading can arrive on two ways: a node's
belief is the Kalman filter with all readings that have reached it, in any order of the messages.
On a graph with loops readings return to where they came from and count again: P is too small.

Evidence is information about coordinates e of the state ``x = W e``, as a root [Z, z] (n, n + 1)
with Z lower triangular: ``Z (e - c) = z + v``, cov(v) = I, relative to a centre c (n,), so that the
information is ``Z' Z`` and its estimate ``c + Z^-1 z``. Independent pieces add up: their rows are
stacked, and made triangular again. The centre of all evidence of a node is its belief ``xhat``.

What is kept is predicted with the plant. Pulled back by the inverse transition, the information
about a mode that decays would soon be so large that the others lose their digits; so W follows the
plant (``modes.ModeFrame``): such modes are those of time 0, and information about them stays as it
is. Where nothing is kept, W is the identity.

``belief_slots`` simulates many runs in the compiled engine, in place of the methods of
``BeliefPropagation``; the types of its arguments are described in ``kernels.slots``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.beliefs import (
    BeliefScratch,
    add_part,
    add_reading_to_part,
    clear_part,
    copy_part,
    gather_evidence,
    predict_part,
    predict_part_single,
    receive_evidence,
    recentre_part,
    set_growing,
    write_prior,
    write_prior_single,
)
from netkf.algorithms.kernels.constant_gains import inverse_transition
from netkf.algorithms.kernels.intersection import finish_lanes
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    move_root,
    predict_all,
    predict_mean,
    predict_root_alone,
    rebase,
    store_sample_of_slot,
    whiten_reading,
)
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.modes import ModeFrame, flow_frame, slot_frame, still_frame
from netkf.algorithms.registry import built_in
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer, one_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, ONE, aligned, blocks_of, in_lanes, load, store

MAX_STEPS = 10_000
"""Far beyond the diameter of any tree of use: a larger value is a mistake."""
MAX_LOSS = float(np.log(1e6))
"""Largest factor, as a logarithm, by which evidence about some modes may outgrow that of others."""
SLOT, ALL = "slot", "all"
"""Values of ``BeliefPropagation.memory``."""


class HeardEvidence(NamedTuple):
    """The ``evidence`` (n, n + 1) that a neighbour sent last, a root [Z, z] of information, at the
    time ``sent``, seconds.
    """

    evidence: FloatArray
    sent: float


class BeliefState(NamedTuple):
    """The state of a node; all evidence (n, n + 1), roots [Z, z], is relative to ``xhat``.

    xhat, root : the belief (n,) and the lower triangular root (n, n) of its covariance
    model : of the plant and the node's sensors
    frame, W : of the coordinates e of evidence, ``x = W e`` with W (n, n)
    centre : (n,), the belief as an e; of its first ``frame.growing`` entries see ``centre_at``
    prior : evidence of the estimate before the readings in ``own`` and ``received``
    own : evidence of the node's own readings
    senders, received : ids of the neighbours heard, and the evidence that each sent last
    node : the node's id
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    frame: ModeFrame
    W: FloatArray
    centre: FloatArray
    prior: FloatArray
    own: FloatArray
    senders: tuple[int, ...]
    received: tuple[HeardEvidence, ...]
    node: int

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class Beliefs(NamedTuple):
    """A payload for all neighbours; evidence is relative to ``xhat``. Each receiver sums all of it
    but what the sender has from the receiver itself (``evidence_for``).

    xhat, centre : the sender's belief (n,), and as an e, see ``BeliefState``
    own : evidence (n, n + 1) of the sender's own readings
    senders, heard : ids of the neighbours that the sender has heard, and the evidence of each
    """

    xhat: FloatArray
    centre: FloatArray
    own: FloatArray
    senders: tuple[int, ...]
    heard: tuple[FloatArray, ...]


class BeliefArrays(NamedTuple):
    """Arrays of belief propagation for B blocks of L runs (B = 1 for all blocks if nothing is kept
    from slot to slot); H filters and W directed links.

    steps : steps of exchange in a slot
    keeps : whether messages are kept from slot to slot, ``memory`` "all"
    inverse, growing, back : of the ``ModeFrame`` of evidence
    W : (S, n, n), its W in each slot that is simulated
    centre : (B, H, n, L), centres of the evidence of each filter
    prior, own : evidence of priors and own readings (B, H, n, n + 1, L)
    received : evidence received on each direction (B, W, n, n + 1, L)
    scratch : evidence that is sent, and scratch
    """

    steps: int
    keeps: bool
    inverse: FloatArray
    growing: int
    back: FloatArray
    W: FloatArray
    centre: FloatArray
    prior: FloatArray
    own: FloatArray
    received: FloatArray
    scratch: BeliefScratch


@kernel
def belief_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: BeliefArrays,
) -> None:
    """Simulate H filters by belief propagation over the S slots of a plan, in B blocks of L runs:
    in each slot they predict, read, exchange evidence (information about the state)
    ``arrays.steps`` times and compute their beliefs.

    Changes ``nodes.xhat`` (B, H, n, L), ``nodes.root`` (B, H, n, n, L) and the evidence in
    ``arrays`` in place, and writes ``samples`` in the slots that have one.
    """
    for b in range(plan.up.shape[0]):
        # If no message is kept for the next slot, all blocks share the arrays of evidence.
        k, lanes = min(b, arrays.own.shape[0] - 1), scratch.lanes
        own, received, centre = arrays.own[k], arrays.received[k], arrays.centre[k]
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                predict_beliefs(nodes, scratch, arrays, b)
                W = arrays.W[min(s, len(arrays.W) - 1)]
                for h in range(len(nodes.rows)):
                    add_reading_to_part(
                        lanes, own[h], readings.y, readings.H, (b, s, h), nodes.rows[h],
                        scratch.xhat, W, arrays.scratch.work,
                    )  # fmt: skip
                for e in range(arrays.steps):
                    # All messages of a step are made before any arrives: each sender's evidence
                    # but that of the receiver.
                    for h in range(len(nodes.rows)):
                        first, last = links.first[h], links.first[h + 1]
                        gather_evidence(lanes, own, received, first, last, h, arrays.scratch)
                    for h in range(len(nodes.rows)):
                        receive_evidence(
                            lanes,
                            received,
                            links,
                            plan.up,
                            (b, s, e),
                            h,
                            centre,
                            arrays.scratch,
                        )
                for h in range(len(nodes.rows)):
                    update_beliefs(nodes, links, scratch, arrays, W, b, h)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep the estimates relative to an origin near the true state; evidence is relative to
            # the estimate, and needs no shift.
            rebase(nodes, readings, scratch, b, s)


@kernel
def predict_beliefs(nodes: SlotNodes, scratch: SlotScratch, arrays: BeliefArrays, b: int) -> None:
    """Predict all H filters of block ``b`` to the next slot, ``nodes.xhat[b]`` (H, n, L), and copy
    the predictions to ``scratch.xhat`` (H, n, L): all evidence is relative to them.

    If messages are kept, all evidence in ``arrays`` is predicted, and ``nodes.root`` waits for
    ``update_beliefs``; else ``nodes.root[b]`` (H, n, n, L) is predicted too, the predicted belief
    becomes ``arrays.prior``, and all other evidence is cleared. Axes: L runs side by side.
    """
    # k is the block of evidence: there is one for all b if nothing is kept.
    lanes, beliefs, k = scratch.lanes, arrays.scratch, min(b, arrays.own.shape[0] - 1)
    if not arrays.keeps:
        predict_all(nodes, scratch, b)
    for h in range(len(nodes.rows)):
        if arrays.keeps:
            predict_mean(nodes, scratch, b, h)
        else:
            write_prior(lanes, nodes.root, b, h, arrays.prior[k, h])
            clear_part(lanes, arrays.own[k, h])
        for i in range(nodes.xhat.shape[2]):
            store(lanes, scratch.xhat, h, i, load(lanes, nodes.xhat, b, h, i))
        set_growing(
            lanes, arrays.centre[k, h], scratch.xhat[h], arrays.inverse, arrays.growing
        )  # fmt: skip
    if not arrays.keeps:
        for m in range(arrays.received.shape[1]):
            clear_part(lanes, arrays.received[k, m])
    elif arrays.growing > 0:
        # Z <- Z back, as no noise enters; information about other modes stays as it is.
        for h in range(len(nodes.rows)):
            predict_part(lanes, arrays.prior[k, h], arrays.back, beliefs.total, beliefs.work)
            predict_part(lanes, arrays.own[k, h], arrays.back, beliefs.total, beliefs.work)
        for m in range(arrays.received.shape[1]):
            predict_part(lanes, arrays.received[k, m], arrays.back, beliefs.total, beliefs.work)


@kernel
def update_beliefs(
    nodes: SlotNodes,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: BeliefArrays,
    W: FloatArray,
    b: int,
    h: int,
) -> None:
    """Compute the belief of filter ``h`` of block ``b``, the sum of its prior and all evidence
    (information): writes ``nodes.xhat[b, h]`` (n, L) and ``nodes.root[b, h]`` (n, n, L). If
    messages are kept, the evidence of the filter in ``arrays`` is made relative to the new belief;
    W (n, n) is that of the slot.

    Axes: L runs side by side.
    """
    # k is the block of evidence: there is one for all b if nothing is kept.
    lanes, beliefs, k = scratch.lanes, arrays.scratch, min(b, arrays.own.shape[0] - 1)
    # total = prior + own + sum of received, relative to the prediction, ``scratch.xhat``.
    copy_part(lanes, arrays.prior[k, h], beliefs.total)
    add_part(lanes, beliefs.total, arrays.own[k, h], beliefs.work)
    for m in range(links.first[h], links.first[h + 1]):
        add_part(lanes, beliefs.total, arrays.received[k, m], beliefs.work)
    if not arrays.keeps:
        # root = Z^-1 and xhat = centre + Z^-1 z in all lanes (False: none keeps its estimate).
        finish_lanes(
            lanes, nodes.root[b], nodes.xhat[b], h, scratch.xhat, beliefs.total, beliefs.work, False
        )  # fmt: skip
        return
    finish_lanes(
        lanes, beliefs.root[0], beliefs.step[0], 0, beliefs.origin, beliefs.total, beliefs.work,
        False,
    )  # fmt: skip
    # root = W Z^-1, made triangular, and xhat = centre + W Z^-1 z.
    n, origin, step = nodes.xhat.shape[2], beliefs.origin[0], beliefs.step[0, 0]
    for i in range(n):
        moved = load(lanes, scratch.xhat, h, i)
        for j in range(n):
            moved += W[i, j] * load(lanes, step, j)
            if j <= i:
                store(lanes, nodes.root, b, h, i, j, load(lanes, beliefs.root, 0, 0, i, j))
        store(lanes, nodes.xhat, b, h, i, moved)
        if i >= arrays.growing:
            moved = load(lanes, arrays.centre, k, h, i) + load(lanes, step, i)
            store(lanes, arrays.centre, k, h, i, moved)
    # There is no plant noise where messages are kept: ``root_Q`` is zero.
    move_root(scratch, nodes.root, b, h, W, nodes.root_Q)
    for part in (arrays.prior[k, h], arrays.own[k, h]):
        recentre_part(lanes, part, origin, step, part)
    for m in range(links.first[h], links.first[h + 1]):
        recentre_part(lanes, arrays.received[k, m], origin, step, arrays.received[k, m])


@kernel
def add_part_single(parts: FloatArray, total: FloatArray, work: FloatArray) -> None:
    """Add all ``parts`` (K, n, n + 1, 1), K pieces of independent evidence of one run, to ``total``
    (n, n + 1, 1) in place; evidence is a root [Z, z] of information Z' Z. ``work`` of the shape of
    ``total`` is scratch. For ``merge_evidence``.
    """
    for k in range(len(parts)):
        add_part(ONE, total, parts[k], work)


@kernel
def add_reading_single(
    y: FloatArray,
    H: FloatArray,
    xhat: FloatArray,
    W: FloatArray,
    total: FloatArray,
    work: FloatArray,
) -> None:
    """Add a whitened reading of one node in one run, y (1, 1, 1, p, 1) and H (1, 1, 1, p, n, 1), to
    the evidence ``total`` (n, n + 1, 1), a root [Z, z] of information relative to ``xhat``
    (1, n, 1) about e in ``x = W e``, W (n, n), in place; ``work`` (n, n + 1, 1) is scratch.
    """
    add_reading_to_part(ONE, total, y, H, (0, 0, 0), y.shape[3], xhat, W, work)


@kernel
def recentre_part_single(part: FloatArray, before: FloatArray, after: FloatArray) -> None:
    """Move the centre c that the evidence ``part`` (n, n + 1, 1) of one run, [Z, z] with
    ``Z (x - c) = z + noise``, is relative to from ``before`` (n, 1) to ``after`` (n, 1), in place.
    """
    recentre_part(ONE, part, before, after, part)


@kernel
def finish_single(
    root: FloatArray, x: FloatArray, centre: FloatArray, total: FloatArray, work: FloatArray
) -> None:
    """Write the estimate of the evidence ``total`` (n, n + 1, 1) of one run, [Z, z] relative to
    ``centre`` (1, n, 1): its root Z^-1 into ``root`` (1, 1, n, n, 1) and ``centre + Z^-1 z`` into
    ``x`` (1, 1, n, 1); ``work`` (n, n + 1, 1) is scratch.
    """
    finish_lanes(ONE, root[0], x[0], 0, centre, total, work, False)


@built_in("belief-propagation")
@dataclass(frozen=True, eq=False)
class BeliefPropagation(Filter):
    """Nodes send each neighbour the sum of their own evidence and of that of all other neighbours.

    steps   messages on each directed link in a slot; with as many as the diameter of the tree, and
            no losses, every node has the estimate of the central filter
    memory  "slot": messages are about the readings of one slot, and what a node then believes is
            its prior of the next one; "all": about all readings so far, for plants without process
            noise. Under clocks always as with "all"

    On a tree P is the covariance of the error for whatever is lost, late or out of order; with
    loops it is too small. With process noise, which enters them all, messages about older readings
    would no longer be independent, and must not be kept.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)  # type: ignore[assignment]
    memory: str = field(one_of(SLOT, ALL), default=SLOT)

    paper: ClassVar[str] = "belief_propagation"
    combination: ClassVar[str] = "beliefs"
    one_way: ClassVar[bool] = True
    needs_samples: ClassVar[bool] = True
    inverts: ClassVar[bool] = True
    slot_kernel = staticmethod(belief_slots)

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[BeliefArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for ``runs`` runs of H nodes that start
        in these ``states`` and have the degrees in ``infos``: the initial evidence of all nodes,
        and scratch.
        """
        keeps, H, n = self.memory == ALL, len(states), len(states[0].xhat)
        frame = states[0].frame
        # W directed links; D: the most that lead to one node.
        W, D = sum(info.degree for info in infos), max(info.degree for info in infos)
        blocks = blocks_of(runs) if keeps else 1
        part = n, n + 1, LANES
        shapes = [(H, *part), (W, *part), (D + 1, *part), part, part]
        shapes += [(1, 1, n, n, LANES), (1, 1, n, LANES), (1, n, LANES)]
        return (
            BeliefArrays(
                self.steps,
                keeps,
                frame.inverse,
                frame.growing,
                frame.back,
                np.array([states[0].W]),
                in_lanes(np.stack([state.centre for state in states]), blocks),
                in_lanes(np.stack([state.prior for state in states]), blocks),
                aligned((blocks, H, *part)),
                aligned((blocks, W, *part)),
                BeliefScratch(*(aligned(shape) for shape in shapes)),
            ),
        )

    def slot_gains(
        self, states: Sequence[Any], arrays: tuple[Any, ...], first: int, count: int
    ) -> tuple[BeliefArrays]:
        """Return ``arrays`` with the coordinates W of evidence in ``count`` slots from number
        ``first`` on, if messages are kept.
        """
        if self.memory == SLOT:
            return arrays
        return (arrays[0]._replace(W=states[0].frame.slots(first, count)),)

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError if messages are kept (``memory`` "all", or clocks) and the plant of a
        ``netkf.Scenario`` has process noise, which would make them dependent, or modes whose
        evidence would lose its digits before the horizon.
        """
        if scenario.slotted and self.memory == SLOT:
            return
        key, Q = ("Q", scenario.slot_belief[1]) if scenario.slotted else ("B", scenario.belief[1])
        # Process noise that two messages share would count as independent evidence.
        if Q.any():
            slots = 'memory = "slot"'
            raise ScenarioError(
                f"plant.{key}",
                "must be zero where belief propagation keeps messages: process noise enters all of "
                "them, and they would not be independent",
                float(np.abs(Q).max()),
                f"write {slots}" if scenario.slotted else f"use a plant in slots with {slots}",
            )
        key, A = ("F", scenario.slot_belief[0]) if scenario.slotted else ("A", scenario.belief[0])
        frame = slot_frame(A) if scenario.slotted else flow_frame(A)
        steps = scenario.horizon / (scenario.slot_plant.period if scenario.slotted else 1.0)
        if frame.excess * steps > MAX_LOSS:
            raise ScenarioError(
                f"plant.{key}",
                "has modes that grow and modes that decay in nearly one direction, between which "
                "evidence that is kept loses its digits",
                A.tolist(),
                f"use a horizon below {MAX_LOSS / frame.excess * scenario.horizon / steps:.3g}",
            )

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note for the user where the graph of a ``netkf.Scenario`` has loops, on which P
        is too small; else nothing.
        """
        if is_forest(scenario):
            return ()
        return (
            "belief-propagation: the graph has loops, on which readings return and count again; P "
            "is too small",
        )

    def exchange_steps(self, phase: int) -> int:
        """Return ``steps``, the number of steps of the only exchange of a slot."""
        return self.steps

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> BeliefState:
        """Return the first state of a node, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n), in which nothing was read or heard.
        """
        root, n = first_root(cov), len(mean)
        if isinstance(model, SlotModel):
            frame = still_frame(n) if self.memory == SLOT else slot_frame(model.F)
        else:
            frame = flow_frame(model.A)
        return BeliefState(
            xhat=mean,
            root=root,
            model=model,
            frame=frame,
            W=frame.basis,
            centre=frame.inverse @ mean,
            prior=transform_evidence(evidence_of(root), frame.basis),
            own=np.zeros((n, n + 1)),
            senders=(),
            received=(),
            node=node.node,
        )

    def predict(self, state: BeliefState, gap: float) -> BeliefState:
        """Return the state ``gap`` seconds later: with the belief predicted, and the evidence if
        messages are kept; otherwise the predicted belief is the prior, and all other evidence is
        dropped.
        """
        model, frame = state.model, state.frame
        xhat, root = model.predict(state.xhat, state.root, gap)
        state = state._replace(xhat=xhat, root=root)
        if not isinstance(model, SlotModel):
            state = state._replace(W=state.W @ inverse_transition(-frame.forward, gap))
            return pull_back(state, gap)
        if self.memory == SLOT:
            no_evidence = np.zeros_like(state.own)
            return state._replace(prior=evidence_of(root), own=no_evidence, senders=(), received=())
        for _ in range(round(gap / model.period)):
            state = pull_back(state._replace(W=state.W @ frame.forward), model.period)
        return state

    def update(self, state: BeliefState, reading: Reading) -> BeliefState:
        """Return the state after a sample: its evidence is added to that of the node's own
        readings, and the belief follows from all evidence.
        """
        if not len(reading.y):
            return state
        return compute_belief(state._replace(own=add_to_own_evidence(state, reading)))

    def emit(self, state: BeliefState, exchange: Exchange) -> tuple[BeliefState, Beliefs]:
        """Return the state, unchanged, and the payload: the evidence of the node's own readings and
        of each neighbour, of which a receiver leaves out its own.
        """
        heard = tuple(one.evidence for one in state.received)
        return state, Beliefs(state.xhat, state.centre, state.own, state.senders, heard)

    def absorb(
        self, state: BeliefState, messages: Sequence[Message], exchange: Exchange
    ) -> BeliefState:
        """Return the state in which the evidence of each sender is replaced by that of its message,
        unless the one it has was sent later, with the belief that follows from all evidence.
        """
        if not messages:
            return state
        received = dict(zip(state.senders, state.received, strict=True))
        for message in messages:
            # Messages may overtake each other: an older one holds nothing that the newer lacks.
            sent = exchange.time - message.age
            if message.sender in received and received[message.sender].sent > sent:
                continue
            payload = message.payload
            evidence = evidence_for(state.node, payload)
            # In slots a message is used in the slot in which it was sent.
            if message.age > 0.0 and not isinstance(state.model, SlotModel):
                evidence = transform_evidence(evidence, backward(state, message.age))
            # The sender's belief, predicted to now, is the centre of its evidence.
            xhat, _ = state.model.extrapolate(payload.xhat, state.root, message.age)
            before = centre_at(payload.centre, xhat, state.frame)
            after = centre_at(state.centre, state.xhat, state.frame)
            evidence = recentre_evidence(evidence, before, after)
            received[message.sender] = HeardEvidence(evidence, sent)
        senders = tuple(sorted(received))
        return compute_belief(
            state._replace(senders=senders, received=tuple(received[j] for j in senders))
        )

    shift = Filter.shift  # evidence is relative to the belief
    shift_payload = Filter.shift_payload


def is_forest(scenario: Any) -> bool:
    """Return True if the links of a ``netkf.Scenario``, whatever their directions, form no loop;
    then the P of belief propagation is right.
    """
    topology = scenario.topology
    # A graph is a forest if and only if it has as many links as nodes less components.
    pairs = {frozenset(link) for link in topology.directions}
    return len(pairs) == len(topology.nodes) - len(topology.components)


def merge_evidence(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the sum (n, n + 1) of several pieces of independent evidence, ``parts`` (n, n + 1)
    each, as a root [Z, z] of information; all are relative to one centre.
    """
    # The kernel adds the other pieces to the first one; the stack is a copy.
    stack = np.stack(parts)[..., None]
    add_part_single(stack[1:], stack[0], np.empty(stack.shape[1:]))
    return np.ascontiguousarray(stack[0, ..., 0])


def add_to_own_evidence(state: BeliefState, reading: Reading) -> FloatArray:
    """Return the evidence (n, n + 1) of a node's own readings plus that of a new ``reading``,
    relative to ``state.xhat``.
    """
    y, H = whiten_reading(reading.y, reading.H, reading.R)
    n = len(state.xhat)
    # The kernel takes blocks, slots, nodes and lanes: one of each here.
    y = y.reshape(1, 1, 1, -1, 1)
    H = H.reshape(1, 1, 1, -1, n, 1)
    xhat = np.array(state.xhat).reshape(1, n, 1)
    total = np.array(state.own)[..., None]
    add_reading_single(y, H, xhat, state.W, total, np.empty(total.shape))
    return np.ascontiguousarray(total[..., 0])


def evidence_for(node: int, payload: Beliefs) -> FloatArray:
    """Return the evidence (n, n + 1) of a payload for the receiver ``node``, an id: all but what
    the sender has from the receiver itself, relative to ``payload.xhat``.
    """
    others = zip(payload.senders, payload.heard, strict=True)
    return merge_evidence([payload.own, *(one for sender, one in others if sender != node)])


def evidence_of(root: FloatArray) -> FloatArray:
    """Return an estimate whose covariance has the lower triangular ``root`` S (n, n) as evidence
    (n, n + 1) relative to itself: [S^-1, 0].
    """
    n = len(root)
    part = np.zeros((n, n + 1, 1))
    write_prior_single(np.array(root).reshape(1, 1, n, n, 1), 0, part)
    return np.ascontiguousarray(part[..., 0])


def compute_belief(state: BeliefState) -> BeliefState:
    """Return the state with the belief, ``xhat`` (n,) and ``root`` (n, n), that follows from its
    prior and all evidence; the centre of the evidence moves to the new ``xhat``.
    """
    # From all evidence, and not as an update of the old belief: on an unstable plant the old one
    # may be so far off that digits are lost.
    total = merge_evidence([state.prior, state.own, *(one.evidence for one in state.received)])
    n = len(total)
    step, root, origin = np.zeros((1, 1, n, 1)), np.zeros((1, 1, n, n, 1)), np.zeros(n)
    finish_single(root, step, origin.reshape(1, n, 1), total[..., None], np.empty((n, n + 1, 1)))
    move = step.reshape(n)
    state = state._replace(
        xhat=state.xhat + state.W @ move,
        root=predict_root_alone(root.reshape(n, n), state.W, np.zeros((n, n))),
        centre=state.centre + move,
    )
    return map_evidence(state, lambda evidence: recentre_evidence(evidence, origin, move))


def centre_at(centre: FloatArray, xhat: FloatArray, frame: ModeFrame) -> FloatArray:
    """Return the belief ``xhat`` (n,) as an e (n,): its first entries, of growing modes, are those
    of the present; the others, of time 0, are those of ``centre`` (n,).
    """
    return np.concatenate([frame.inverse[: frame.growing] @ xhat, centre[frame.growing :]])


def map_evidence(state: BeliefState, change: Callable[[FloatArray], FloatArray]) -> BeliefState:
    """Return the state with ``change``, a function from evidence (n, n + 1) to evidence, applied to
    its prior, its own and all received evidence.
    """
    received = tuple(one._replace(evidence=change(one.evidence)) for one in state.received)
    return state._replace(prior=change(state.prior), own=change(state.own), received=received)


def pull_back(state: BeliefState, gap: float) -> BeliefState:
    """Return the state with all evidence predicted over a ``gap`` in seconds, a slot's if there are
    slots; only that about growing modes changes.
    """
    if state.frame.growing == 0:
        return state
    back = backward(state, gap)
    return map_evidence(state, lambda evidence: transform_evidence(evidence, back))


def backward(state: BeliefState, gap: float) -> FloatArray:
    """Return the inverse (n, n) of the transition of e over a ``gap`` in seconds, a slot's if there
    are slots, with which evidence is predicted.
    """
    if isinstance(state.model, SlotModel):
        return state.frame.back
    return inverse_transition(-state.frame.back, gap)


def transform_evidence(evidence: FloatArray, back: FloatArray) -> FloatArray:
    """Return ``evidence`` (n, n + 1), a root [Z, z] of information about some e, as that about the
    e' (n,) of ``e = back e'``, such as a later one of a plant without noise: Z times ``back``
    (n, n).
    """
    predicted = np.array(evidence)[..., None]
    back = np.ascontiguousarray(back)
    predict_part_single(predicted, back, np.empty(predicted.shape), np.empty(predicted.shape))
    return np.ascontiguousarray(predicted[..., 0])


def recentre_evidence(evidence: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return ``evidence`` (n, n + 1), a root [Z, z] of information relative to the centre
    ``before`` (n,), relative to ``after`` (n,) instead.
    """
    result, old_centre, new_centre = (
        np.array(values)[..., None] for values in (evidence, before, after)
    )
    recentre_part_single(result, old_centre, new_centre)
    return np.ascontiguousarray(result[..., 0])
