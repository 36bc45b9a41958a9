"""Asynchronous Gaussian belief propagation on the graph of the network.

Each node has a copy of the state, and links say that the copies at their ends are equal. A message
to a neighbour is what the node has read together with what all its *other* neighbours have told it
(Weiss and Freeman, "Correctness of belief propagation in Gaussian graphical models of arbitrary
topology", Neural Computation 13, 2001). On a tree no reading can arrive on two ways: a node's
belief is the Kalman filter with all readings that have reached it, in any order of the messages.
On a graph with loops readings return to where they came from and count again: P is too small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.root_update import lower_root
from netkf.algorithms.kernels.slots import whiten_reading
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.registry import built_in
from netkf.core.errors import ScenarioError
from netkf.core.fields import choice, field, integer
from netkf.linalg.arrays import FloatArray

MAX_STEPS = 10_000
SLOT, ALL = "slot", "all"


class ReadingEvidence(NamedTuple):
    """All that some readings say of the state: ``y = H x + v``, cov(v) = I, with y (p,), H (p, n)
    and p at most n; its information is ``H' H``.
    """

    y: FloatArray
    H: FloatArray


class HeardEvidence(NamedTuple):
    """What a neighbour said last: its ``evidence``, and when it was ``sent``, seconds."""

    evidence: ReadingEvidence
    sent: float


class BeliefState(NamedTuple):
    """Belief ``xhat`` (n,) with ``root`` (n, n), and the model; the evidence of the estimate before
    all readings that are kept (``prior``) and of the node's ``own`` ones, and what neighbours told,
    by ``senders``; the node's id.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    prior: ReadingEvidence
    own: ReadingEvidence
    senders: tuple[int, ...]
    told: tuple[HeardEvidence, ...]
    node: int

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


class Beliefs(NamedTuple):
    """A payload: the evidence of the sender's ``own`` readings, and of each of its ``senders``;
    a receiver leaves out what it has told itself.
    """

    own: ReadingEvidence
    senders: tuple[int, ...]
    heard: tuple[ReadingEvidence, ...]


@built_in("belief-propagation")
@dataclass(frozen=True, eq=False)
class BeliefPropagation(Filter):
    """Nodes tell each neighbour their own readings and what the other neighbours have told them.

    steps   messages on each direction in a slot; with as many as the tree is wide, and no losses,
            every node is the central filter
    memory  "slot": messages are about the readings of one slot, and what a node then believes is
            its prior of the next one; "all": about all readings so far, for plants without noise.
            Under clocks always "all"

    On a tree P is the covariance of the error for whatever is lost, late or out of order; with
    loops it is too small. With process noise messages of older readings would no longer be
    independent, and are not kept.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)  # type: ignore[assignment]
    memory: str = field(choice(SLOT, ALL), default=SLOT)

    paper: ClassVar[str] = "belief_propagation"
    combination: ClassVar[str] = "beliefs"
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True
    needs_samples: ClassVar[bool] = True
    inverts: ClassVar[bool] = True

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where messages are kept and the plant has noise."""
        if scenario.slotted and self.memory == SLOT:
            return
        key, Q = ("Q", scenario.slot_belief[1]) if scenario.slotted else ("B", scenario.belief[1])
        if Q.any():
            slots = 'memory = "slot"'
            raise ScenarioError(
                f"plant.{key}",
                "must be zero where belief propagation keeps messages: process noise enters all of "
                "them, and they would not be independent",
                float(np.abs(Q).max()),
                f"write {slots}" if scenario.slotted else f"use a plant in slots with {slots}",
            )

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note where the graph has loops."""
        if is_forest(scenario):
            return ()
        return (
            "belief-propagation: the graph has loops, on which readings return and count again; P "
            "is too small",
        )

    def exchange_steps(self, phase: int) -> int:
        """Return ``steps``."""
        return self.steps

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> BeliefState:
        """Return the first state, in which nothing was read or heard."""
        root, nothing = first_root(cov), ReadingEvidence(np.zeros(0), np.zeros((0, len(mean))))
        prior = evidence_of(mean, root)
        return BeliefState(mean, root, model, prior, nothing, (), (), node.node)

    def predict(self, state: BeliefState, gap: float) -> BeliefState:
        """Predict the belief; evidence that is kept speaks about the present state."""
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        state = state._replace(xhat=xhat, root=root)
        if isinstance(state.model, SlotModel) and self.memory == SLOT:
            prior, nothing = (
                evidence_of(xhat, root),
                ReadingEvidence(state.own.y[:0], state.own.H[:0]),
            )
            return state._replace(prior=prior, own=nothing, senders=(), told=())
        back = backward(state.model, gap)
        return with_all(state, lambda evidence: move_evidence(evidence, back))

    def update(self, state: BeliefState, reading: Reading) -> BeliefState:
        """Add a reading to the own ones."""
        if not len(reading.y):
            return state
        own = merge_evidence(
            [state.own, ReadingEvidence(*whiten_reading(reading.y, reading.H, reading.R))]
        )
        return believing(state._replace(own=own))

    def emit(self, state: BeliefState, exchange: Exchange) -> tuple[BeliefState, Beliefs]:
        """Send what was read and heard."""
        return state, Beliefs(state.own, state.senders, tuple(one.evidence for one in state.told))

    def absorb(
        self, state: BeliefState, messages: Sequence[Message], exchange: Exchange
    ) -> BeliefState:
        """Replace what the senders told before, unless it was sent later."""
        if not messages:
            return state
        known = dict(zip(state.senders, state.told, strict=True))
        for message in messages:
            sent = exchange.time - message.age
            if message.sender in known and known[message.sender].sent > sent:
                continue
            evidence = evidence_for(state.node, message.payload)
            if message.age > 0.0 and not isinstance(state.model, SlotModel):
                evidence = move_evidence(evidence, backward(state.model, message.age))
            known[message.sender] = HeardEvidence(evidence, sent)
        senders = tuple(sorted(known))
        return believing(state._replace(senders=senders, told=tuple(known[j] for j in senders)))

    def shift(self, state: BeliefState, offset: FloatArray) -> BeliefState:
        """Return the state shifted by ``offset``: readings move with it."""
        state = state._replace(xhat=state.xhat + offset)
        return with_all(state, lambda evidence: shift_evidence(evidence, offset))

    def shift_payload(self, payload: Beliefs, offset: FloatArray) -> Beliefs:
        """Move all evidence."""
        heard = tuple(shift_evidence(one, offset) for one in payload.heard)
        return payload._replace(own=shift_evidence(payload.own, offset), heard=heard)


def is_forest(scenario: Any) -> bool:
    """Return True if no loop leads through the links of a scenario, whatever their directions."""
    topology = scenario.topology
    pairs = {frozenset(link) for link in topology.directions}
    return len(pairs) == len(topology.nodes) - len(topology.components)


def merge_evidence(parts: Sequence[ReadingEvidence]) -> ReadingEvidence:
    """Return the evidence of independent readings together, with at most n rows."""
    rows = np.concatenate([np.column_stack([one.H, one.y]) for one in parts])
    n = rows.shape[1] - 1
    if len(rows) > n:
        # |y - H x|^2 changes by a constant: the residual row says nothing about x.
        rows = np.asarray(np.linalg.qr(rows, mode="r"))[:n]
    return ReadingEvidence(np.ascontiguousarray(rows[:, n]), np.ascontiguousarray(rows[:, :n]))


def evidence_for(node: int, payload: Beliefs) -> ReadingEvidence:
    """Return what a payload says to a node: all but what that node told."""
    others = zip(payload.senders, payload.heard, strict=True)
    return merge_evidence([payload.own, *(one for sender, one in others if sender != node)])


def evidence_of(xhat: FloatArray, root: FloatArray) -> ReadingEvidence:
    """Return an estimate (n,) with the root (n, n) of its covariance as evidence."""
    inverse = np.asarray(np.linalg.inv(root))
    return ReadingEvidence(inverse @ xhat, inverse)


def believing(state: BeliefState) -> BeliefState:
    """Return the state with the belief that follows from its prior and all evidence."""
    # Not an update of the prior, which on an unstable plant is so far off that digits are lost.
    y, H = merge_evidence([state.prior, state.own, *(one.evidence for one in state.told)])
    root = np.asarray(np.linalg.inv(H))
    return state._replace(xhat=root @ y, root=lower_root(root))


def with_all(
    state: BeliefState, change: Callable[[ReadingEvidence], ReadingEvidence]
) -> BeliefState:
    """Return the state with all its evidence changed."""
    told = tuple(one._replace(evidence=change(one.evidence)) for one in state.told)
    return state._replace(prior=change(state.prior), own=change(state.own), told=told)


def backward(model: Any, gap: float) -> FloatArray:
    """Return the inverse (n, n) of the plant's transition over a gap, seconds."""
    if isinstance(model, SlotModel):
        power = np.linalg.matrix_power(model.F, round(gap / model.period))
        return np.asarray(np.linalg.inv(power), dtype=np.float64)
    inverse: FloatArray = model.backward(gap).inverse
    return inverse


def move_evidence(evidence: ReadingEvidence, back: FloatArray) -> ReadingEvidence:
    """Return evidence about a later state, from which ``back`` (n, n) leads to the earlier one."""
    return evidence._replace(H=evidence.H @ back)


def shift_evidence(evidence: ReadingEvidence, offset: FloatArray) -> ReadingEvidence:
    """Return evidence about the state plus ``offset``."""
    return evidence._replace(y=evidence.y + evidence.H @ offset)
