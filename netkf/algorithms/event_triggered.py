"""Event-triggered consensus on information: Battistelli, Chisci and Selvi, "A distributed Kalman
filter with event-triggered communication and guaranteed stability", Automatica 93, 2018.

In each slot a node predicts, updates with its reading, sends its estimate unless its neighbours can
predict it well enough (they keep a copy of what it sent last), and combines by covariance
intersection (Xie, Gan and Liu, paper D (8) and (9)): ``P^-1 = sum w_j P_j^-1`` and
``P^-1 x = sum w_j P_j^-1 x_j``. ``triggered_ci_slots`` simulates many runs in the compiled engine,
in place of the methods of ``EventTriggeredCi``; the types of its arguments are described in
``kernels.slots``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Estimate, Exchange, Filter, Message, NodeInfo
from netkf.algorithms.information_consensus import INFORMATION, Hcmci
from netkf.algorithms.kernels.intersection import finish_lanes, invert_lanes, merge_lanes, whiten
from netkf.algorithms.kernels.root_update import intersect_roots
from netkf.algorithms.kernels.slots import (
    ARRIVING,
    SENDING,
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    drop_silent,
    move_root,
    predict_all,
    read_all,
    rebase,
    store_sample_of_slot,
    transform_mean,
)
from netkf.algorithms.kernels.triggers import is_near
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.core.fields import Rule, field, number, tuple_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    ONE,
    Lanes,
    aligned,
    any_lane,
    blocks_of,
    load,
    load_flags,
    select,
    spread,
    store,
)


class NeighbourCopy(NamedTuple):
    """The last estimate that a neighbour sent, predicted to now: ``xhat`` (n,) and ``root`` (n, n);
    and the ``weight`` of its messages.
    """

    xhat: FloatArray
    root: FloatArray
    weight: float


class TriggeredState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    sent : the neighbours' copy of this node's estimate (what it sent last, predicted to now), None
           before the first message
    senders, copies : ids of the neighbours heard so far, and the copy of the estimate of each
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    sent: Estimate | None = None
    senders: tuple[int, ...] = ()
    copies: tuple[NeighbourCopy, ...] = ()

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class TriggeredCiArrays(NamedTuple):
    """Arrays for B blocks of runs of H nodes and W directed links, with C = W + 2 H copies of
    estimates: those received last on each link, then what each node sends now, then what it sent
    last.

    alpha : threshold of the mean, see ``EventTriggeredCi.thresholds``
    ratio : 1 + delta, threshold of the covariance
    share : part of the information of a silent neighbour's copy that counts, 1 / widening^2
    x, root : the copies (B, C, n, L) and their roots (B, C, n, n, L)
    has_copy : (B, C, L), 1 once there is a copy
    mean, inverse : (W + H, n, L) and (W + H, n, n, L), scratch
    """

    alpha: float
    ratio: float
    share: float
    x: FloatArray
    root: FloatArray
    has_copy: np.ndarray
    mean: FloatArray
    inverse: FloatArray


@kernel
def triggered_ci_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: TriggeredCiArrays,
) -> None:
    """Simulate H filters by event-triggered consensus over the S slots of a plan, in B blocks of L
    runs: in each slot they predict, read, decide whether to send, and combine.

    Changes ``nodes.xhat`` (B, H, n, L), ``nodes.root`` (B, H, n, n, L) and the copies in ``arrays``
    in place, writes 0 into ``plan.sent`` and ``plan.up`` for messages that are not sent, and writes
    ``samples``. ``plan.part`` says which part of a slot is simulated: all, up to the decisions to
    send (SENDING), or from the arrivals on (ARRIVING).
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.part != ARRIVING and plan.sensed[s]:
                predict_all(nodes, scratch, b)
                predict_copies(nodes, scratch, arrays, b)
                read_all(nodes, readings, scratch, b, s)
            if plan.part != ARRIVING and plan.exchanged[s]:
                for h in range(len(nodes.rows)):
                    decide_estimate(nodes, plan, links, scratch, arrays, b, s, h)
                drop_silent(plan, links, b, s, 0)
            if plan.part != SENDING:
                # Messages are copies from before the exchange: the order of nodes does not matter.
                if plan.exchanged[s]:
                    for h in range(len(nodes.rows)):
                        combine_copies(nodes, plan, links, scratch, arrays, b, s, h)
                store_sample_of_slot(nodes, plan, samples, scratch, b, s)
                # Keep estimates and copies relative to an origin near the true state.
                rebase(nodes, readings, scratch, b, s)
                if readings.rebased[s]:
                    rebase_copies(readings, scratch.lanes, arrays, b, s)


@kernel
def predict_copies(
    nodes: SlotNodes, scratch: SlotScratch, arrays: TriggeredCiArrays, b: int
) -> None:
    """Predict all C copies of estimates in block ``b`` to the next slot as their senders do:
    changes ``arrays.x[b]`` (C, n, L) and ``arrays.root[b]`` (C, n, n, L).

    Axes: L runs side by side.
    """
    lanes = scratch.lanes
    for k in range(arrays.x.shape[1]):
        if any_lane(load_flags(lanes, arrays.has_copy, b, k)):
            transform_mean(scratch, arrays.x, b, k, nodes.F)
            move_root(scratch, arrays.root, b, k, nodes.F, nodes.root_Q)


@kernel
def rebase_copies(
    readings: ReadingBlock, lanes: Lanes, arrays: TriggeredCiArrays, b: int, s: int
) -> None:
    """Move the origin of all C copies of estimates in block ``b`` to the true state of slot ``s``:
    subtract ``readings.local[b, s]`` (n, L) from each of ``arrays.x[b]`` (C, n, L). To be called
    in the slots in which ``rebase`` moves the origin of the estimates.

    Axes: L runs side by side.
    """
    for k in range(arrays.x.shape[1]):
        for i in range(arrays.x.shape[2]):
            origin = load(lanes, readings.local, b, s, i)
            store(lanes, arrays.x, b, k, i, load(lanes, arrays.x, b, k, i) - origin)


@kernel(inlined=True)
def copy_estimate(
    lanes: Lanes,
    target: tuple[FloatArray, FloatArray],
    index: int,
    x: FloatArray,
    root: FloatArray,
    sender: int,
    b: int,
    flags: Any,
) -> None:
    """Copy the estimate and root with index ``sender`` in block ``b`` of ``x`` (B, K, n, L) and
    ``root`` (B, K, n, n, L) to entry ``index`` of block ``b`` of ``target``, a pair of such arrays
    (estimates, roots), in the lanes with ``flags`` (L,).

    Axes: B blocks of runs, K estimates.
    """
    target_x, target_root = target
    for i in range(x.shape[2]):
        former, present = load(lanes, target_x, b, index, i), load(lanes, x, b, sender, i)
        store(lanes, target_x, b, index, i, select(flags, present, former))
        for j in range(i + 1):
            former = load(lanes, target_root, b, index, i, j)
            present = load(lanes, root, b, sender, i, j)
            store(lanes, target_root, b, index, i, j, select(flags, present, former))


@kernel
def decide_estimate(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: TriggeredCiArrays,
    b: int,
    s: int,
    h: int,
) -> None:
    """Decide whether node ``h`` of block ``b`` sends its estimate in slot ``s``, in each of L runs:
    writes 0 into ``plan.sent[b, s, 0, h]`` (L,) where it does not.

    Updates in ``arrays`` the copy of what the node sent last, where it sends, and the copy of what
    it sends now. ``plan.sent`` (B, S, E, H, L) is 1 on entry where the node is asked for a message.
    """
    lanes, copies = scratch.lanes, (arrays.x, arrays.root)
    # Indices in the C copies: W last received on each link, H sent now, H sent last by each node.
    own = len(links.sender) + h
    last = own + len(nodes.rows)
    near = is_near(
        lanes, nodes.xhat, nodes.root, arrays.x, arrays.root, (b, h, last),
        (arrays.alpha, arrays.ratio), scratch.total, scratch.noise,
    )  # fmt: skip
    store(lanes, scratch.row, 0, select(near, 1.0, 0.0))
    for q in range(len(lanes)):
        # Silent if the copy is near; the first estimate is always sent.
        if scratch.row[0, q] == 1.0 and arrays.has_copy[b, last, q] == 1:
            plan.sent[b, s, 0, h, q] = 0
        if plan.sent[b, s, 0, h, q] == 1:
            arrays.has_copy[b, last, q] = 1
    sent = load_flags(lanes, plan.sent, b, s, 0, h)
    copy_estimate(lanes, copies, last, nodes.xhat, nodes.root, h, b, sent)
    # The payload of this exchange: estimates change one after the other while nodes combine.
    all_lanes = spread(lanes, 1.0) > 0.0
    copy_estimate(lanes, copies, own, nodes.xhat, nodes.root, h, b, all_lanes)


@kernel
def combine_copies(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: TriggeredCiArrays,
    b: int,
    s: int,
    h: int,
) -> None:
    """Combine the estimate of filter ``h`` of block ``b`` with those that arrive in slot ``s`` and
    with the copies of silent neighbours' estimates, whose covariances are enlarged: paper D (8) and
    (9).

    Changes ``nodes.xhat[b, h]`` (n, L) and ``nodes.root[b, h]`` (n, n, L); the estimates that
    arrive replace the copies of their links in ``arrays``. Information P^-1 = Z' Z is added up as
    roots [Z, z] (n, n + 1) with the mean Z^-1 z relative to the node's own estimate. Axes: L runs
    side by side.
    """
    lanes = scratch.lanes
    n = nodes.xhat.shape[2]
    # Copies 0 to W - 1 are those of links, W to W + H - 1 what each node sends now.
    W = len(links.sender)
    own = W + h
    copied_weight = spread(lanes, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        copies = (arrays.x, arrays.root)
        # The estimates that arrive replace the copies of their links.
        if any_lane(arrived):
            sender = W + links.sender[m]
            copy_estimate(lanes, copies, m, arrays.x, arrays.root, sender, b, arrived)
        for q in range(len(lanes)):
            if plan.up[b, s, 0, links.direction[m], q] == 1:
                arrays.has_copy[b, m, q] = 1
        # A silent neighbour counts too: its estimate is near its copy.
        copied_weight += select(load_flags(lanes, arrays.has_copy, b, m), links.weight[m], 0.0)
        invert_lanes(lanes, arrays.inverse, m, arrays.root[b], m)
        for i in range(n):
            store(lanes, arrays.mean, m, i, load(lanes, arrays.x, b, m, i))
    # A node without any copy keeps its estimate, without rounding.
    has_no_copy = copied_weight == 0.0
    if not any_lane(copied_weight > 0.0):
        return
    invert_lanes(lanes, arrays.inverse, own, arrays.root[b], own)
    for i in range(n):
        x = load(lanes, arrays.x, b, own, i)
        store(lanes, arrays.mean, own, i, x)
        store(lanes, scratch.xhat, h, i, x)
    # Covariance intersection: sum_j w_j P_j^-1, as roots that are merged one after the other.
    own_weight = select(copied_weight < 1.0, 1.0 - copied_weight, 0.0)
    whiten(lanes, scratch.total, own_weight, arrays.inverse, arrays.mean, own, arrays.mean, own)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        has_copy = load_flags(lanes, arrays.has_copy, b, m)
        if any_lane(has_copy):
            # The covariance of a silent neighbour's copy is enlarged by 1 / share.
            weight = select(arrived, links.weight[m], arrays.share * links.weight[m])
            weight = select(has_copy, weight, 0.0)
            mean = arrays.mean
            whiten(lanes, scratch.whitened, weight, arrays.inverse, mean, m, mean, own)
            merge_lanes(lanes, scratch.total, scratch.whitened)
    # root = Z^-1 and xhat = own + Z^-1 z, but unchanged in lanes without any copy.
    finish_lanes(
        lanes, nodes.root[b], nodes.xhat[b], h, scratch.xhat, scratch.total, scratch.whitened,
        has_no_copy,
    )  # fmt: skip


@kernel
def is_near_single(
    x: FloatArray,
    root: FloatArray,
    bounds: tuple[float, float],
    ratio: FloatArray,
    work: FloatArray,
) -> bool:
    """Return True if the second of two estimates, a copy, is near the first, in one run: estimates
    ``x`` (1, 2, n, 1) with lower triangular roots ``root`` (1, 2, n, n, 1), and ``bounds``
    (alpha, 1 + delta) as in ``EventTriggeredCi.thresholds``. ``ratio`` (n, n + 1, 1) and ``work``
    (n, n, 1) are scratch. For ``EventTriggeredCi.is_near``.
    """
    near: bool = is_near(ONE, x, root, x, root, (0, 0, 1), bounds, ratio, work)
    return near


def _is_information_consensus(value: Any) -> Filter:
    """Return ``value`` if it is the filter ``Hcmci`` (no derived class) with one step of consensus
    on information a slot; raises TypeError or ValueError, which the rule of the field turns into a
    ScenarioError.
    """
    if not isinstance(value, Hcmci) or type(value) is not Hcmci:
        raise TypeError
    if value.consensus != INFORMATION or value.steps != 1:
        raise ValueError
    return value


INNER = Rule(
    "must be consensus on information with one step a slot",
    _is_information_consensus,
    'write inner = { kind = "hcmci", consensus = "information" }',
)
NOT_NEGATIVE = number(low=0.0)
THRESHOLDS = tuple_of(
    NOT_NEGATIVE,
    NOT_NEGATIVE,
    description="two numbers [estimate, covariance] that are not negative",
)


@built_in("event-triggered", trigger="consensus")
@dataclass(frozen=True, eq=False)
class EventTriggeredCi(Filter):
    """Consensus on information with one step a slot, in which a node sends only if its neighbours
    could not predict its estimate well enough; else they use what they have predicted.

    inner       the filter that decides what is combined: ``hcmci`` with consensus on information
                and one step a slot
    thresholds  [alpha, delta]: a node is silent while ``(xhat - xbar)' P^-1 (xhat - xbar) < alpha``
                where xbar and Pbar are what it sent last, predicted to now, and while
                ``P < (1 + delta) Pbar`` and ``Pbar < (1 + delta) P``

    In place of a silent neighbour's (xhat, P) there is xbar with the enlarged covariance
    ``(1 + alpha^1/2)^2 (1 + delta) Pbar``, which bounds the second moment of its error (derived
    here, not in the paper): with d = xhat - xbar that of e + d is at most
    ``(1 + a) P + (1 + 1/a) d d'`` for any a > 0, ``d d' <= alpha P``, and a = alpha^1/2 is best.
    With thresholds 0 it is consensus on information. A sender does not notice that its message was
    lost: links should lose none.
    """

    inner: Filter = field(INNER, default=Hcmci(consensus=INFORMATION))
    thresholds: tuple[float, float] = field(THRESHOLDS, default=(1.0, 1.0))

    paper: ClassVar[str] = "event_triggered"
    P_by_design: ClassVar[tuple[str, str]] = ("larger", "")
    clocks: ClassVar[tuple[str, ...]] = ()
    one_way: ClassVar[bool] = True
    inverts: ClassVar[bool] = True
    slot_kernel = staticmethod(triggered_ci_slots)
    unrolled: ClassVar[bool] = True

    def decides_in_slots(self) -> bool:
        """Return True: a node sends nothing while its neighbours' copy of its estimate is near
        enough. The engine then asks for decisions in ``SlotPlan.sent``.
        """
        return True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[TriggeredCiArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for ``runs`` runs of H nodes with W
        directed links, counted from ``infos``: thresholds, and space for W + 2 H copies of
        estimates, none of which exists yet.
        """
        (H, n), blocks = (len(states), len(states[0].xhat)), blocks_of(runs)
        W, alpha = sum(info.degree for info in infos), self.thresholds[0]
        entries = W + 2 * H
        return (
            TriggeredCiArrays(
                alpha,
                1.0 + self.thresholds[1],
                1.0 / self.widening**2,
                aligned((blocks, entries, n, LANES)),
                aligned((blocks, entries, n, n, LANES)),
                np.zeros((blocks, entries, LANES), dtype=np.uint8),
                aligned((W + H, n, LANES)),
                aligned((W + H, n, n, LANES)),
            ),
        )

    @property
    def widening(self) -> float:
        """The factor (1 + alpha^1/2) (1 + delta)^1/2 of the root of a silent neighbour's
        covariance, which enlarges it as the class describes.
        """
        alpha, delta = self.thresholds
        return (1.0 + math.sqrt(alpha)) * math.sqrt(1.0 + delta)

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note for the user where messages of a ``netkf.Scenario`` may be lost or late,
        which makes P too small; else nothing.
        """
        if scenario.delivers_all:
            return ()
        return (
            "event-triggered: messages may be lost, and a sender takes its neighbours to have "
            "what it sent; P may then be too small",
        )

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> TriggeredState:
        """Return the first state, with estimate ``mean`` (n,) and covariance ``cov`` (n, n), in
        which nothing was sent or heard.
        """
        return TriggeredState(mean, first_root(cov), model)

    def predict(self, state: TriggeredState, gap: float) -> TriggeredState:
        """Return the state ``gap`` seconds later: the estimate is predicted, and all copies of
        estimates as their senders do.
        """
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        # Sender and receivers predict the copy alike, so that it stays the same at both ends.
        sent, copies = state.sent, []
        if sent is not None:
            sent = Estimate(*state.model.predict(sent.xhat, sent.root, gap))
        for copy in state.copies:
            x, S = state.model.predict(copy.xhat, copy.root, gap)
            copies.append(NeighbourCopy(x, S, copy.weight))
        return state._replace(xhat=xhat, root=root, sent=sent, copies=tuple(copies))

    def emit(
        self, state: TriggeredState, exchange: Exchange
    ) -> tuple[TriggeredState, Estimate | None]:
        """Return the state and the payload: the estimate, which is kept as ``sent``, or None while
        the neighbours' copy of it is good enough.
        """
        if state.sent is not None and self.is_near(state, state.sent):
            return state, None
        own = Estimate(state.xhat, state.root)
        return state._replace(sent=own), own

    def is_near(self, state: TriggeredState, sent: Estimate) -> bool:
        """Return True if the copy ``sent`` of a node's estimate, predicted to now, is within both
        thresholds of the estimate in ``state``.
        """
        (alpha, delta), n = self.thresholds, len(state.xhat)
        x = np.stack([state.xhat, sent.xhat]).reshape(1, 2, n, 1)
        root = np.stack([state.root, sent.root]).reshape(1, 2, n, n, 1)
        ratio, work = np.empty((n, n + 1, 1)), np.empty((n, n, 1))
        return bool(is_near_single(x, root, (alpha, 1.0 + delta), ratio, work))

    def absorb(
        self, state: TriggeredState, messages: Sequence[Message], exchange: Exchange
    ) -> TriggeredState:
        """Return the state after covariance intersection of the node's estimate with those
        received, which become the copies of their senders, and with the copies of silent
        neighbours, whose covariances are enlarged (``widening``).
        """
        copies = dict(zip(state.senders, state.copies, strict=True))
        received = {
            m.sender: NeighbourCopy(m.payload.xhat, m.payload.root, m.weight) for m in messages
        }
        copies.update(received)
        if not copies:
            return state
        senders = tuple(sorted(copies))
        widening = self.widening
        pairs = [(state.xhat, state.root)]
        pairs += [
            (copies[j].xhat, copies[j].root if j in received else widening * copies[j].root)
            for j in senders
        ]
        # Weights of neighbours that were never heard stay with the node itself.
        link_weights = [copies[j].weight for j in senders]
        weights = np.array([max(0.0, 1.0 - math.fsum(link_weights)), *link_weights])
        means, roots = (np.stack(part) for part in zip(*pairs, strict=True))
        xhat, root = intersect_roots(weights, means, roots)
        return state._replace(
            xhat=xhat, root=root, senders=senders, copies=tuple(copies[j] for j in senders)
        )

    def shift(self, state: TriggeredState, offset: FloatArray) -> TriggeredState:
        """Return the state with ``offset`` (n,) added to the estimate and to all copies, for a move
        of the origin: the triggers look at differences.
        """
        sent = state.sent
        if sent is not None:
            sent = sent._replace(xhat=sent.xhat + offset)
        copies = tuple(copy._replace(xhat=copy.xhat + offset) for copy in state.copies)
        return state._replace(xhat=state.xhat + offset, sent=sent, copies=copies)
