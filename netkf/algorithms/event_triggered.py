"""Event-triggered consensus on information: Battistelli, Chisci and Selvi, "A distributed Kalman
filter with event-triggered communication and guaranteed stability", Automatica 93, 2018.
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
from netkf.core.fields import Rule, field, number, row
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


class Heard(NamedTuple):
    """The last estimate that a neighbour sent, predicted to now: ``xhat`` (n,), ``root`` (n, n);
    the ``weight`` of its messages.
    """

    xhat: FloatArray
    root: FloatArray
    weight: float


class TriggeredState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    sent : the estimate that the neighbours have of this node, None before the first message
    senders, heard : ids of neighbours, and the estimate of each
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    sent: Estimate | None = None
    senders: tuple[int, ...] = ()
    heard: tuple[Heard, ...] = ()

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


class TriggeredCiArrays(NamedTuple):
    """Arrays for B blocks of runs; W + 2 H copies of estimates: W heard, H sent now, H sent last.

    alpha : threshold of the mean
    ratio : 1 + delta, threshold of the covariance
    share : share of a silent neighbour's information that counts
    x, root : the copies (B, W + 2 H, n, L) and roots (B, W + 2 H, n, n, L)
    known : which copies there are (B, W + 2 H, L)
    mean, inverse : (W + H, n, L) and (W + H, n, n, L), scratch
    """

    alpha: float
    ratio: float
    share: float
    x: FloatArray
    root: FloatArray
    known: np.ndarray
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
    """Carry filters by event-triggered consensus through the slots of a plan."""
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            # A part of the plan: up to the decisions to send, or from the arrivals on.
            if plan.part != ARRIVING and plan.sensed[s]:
                predict_all(nodes, scratch, b)
                predict_copies(nodes, scratch, arrays, b)
                read_all(nodes, readings, scratch, b, s)
            if plan.part != ARRIVING and plan.exchanged[s]:
                for h in range(len(nodes.rows)):
                    decide_estimate(nodes, plan, links, scratch, arrays, b, s, h)
                drop_silent(plan, links, b, s, 0)
            if plan.part != SENDING:
                if plan.exchanged[s]:
                    for h in range(len(nodes.rows)):
                        combine_copies(nodes, plan, links, scratch, arrays, b, s, h)
                store_sample_of_slot(nodes, plan, samples, scratch, b, s)
                rebase(nodes, readings, scratch, b, s)
                if readings.rebased[s]:
                    rebase_copies(readings, scratch.lanes, arrays, b, s)


@kernel
def predict_copies(
    nodes: SlotNodes, scratch: SlotScratch, arrays: TriggeredCiArrays, b: int
) -> None:
    """Predict all copies of estimates, as those who sent them do."""
    lanes = scratch.lanes
    for k in range(arrays.x.shape[1]):
        if any_lane(load_flags(lanes, arrays.known, b, k)):
            transform_mean(scratch, arrays.x, b, k, nodes.F)
            move_root(scratch, arrays.root, b, k, nodes.F, nodes.root_Q)


@kernel
def rebase_copies(
    readings: ReadingBlock, lanes: Lanes, arrays: TriggeredCiArrays, b: int, s: int
) -> None:
    """Count copies from the state of slot ``s``, where a frame of coordinates begins."""
    for k in range(arrays.x.shape[1]):
        for i in range(arrays.x.shape[2]):
            origin = load(lanes, readings.local, b, s, i)
            store(lanes, arrays.x, b, k, i, load(lanes, arrays.x, b, k, i) - origin)


@kernel(inlined=True)
def copy_estimate(
    lanes: Lanes,
    to: tuple[FloatArray, FloatArray],
    index: int,
    x: FloatArray,
    root: FloatArray,
    sender: int,
    b: int,
    wanted: Any,
) -> None:
    """Write the pair of ``sender`` of a block to an ``index`` of other pairs, in the lanes where it
    is ``wanted``.
    """
    for i in range(x.shape[2]):
        before, now = load(lanes, to[0], b, index, i), load(lanes, x, b, sender, i)
        store(lanes, to[0], b, index, i, select(wanted, now, before))
        for j in range(i + 1):
            before, now = load(lanes, to[1], b, index, i, j), load(lanes, root, b, sender, i, j)
            store(lanes, to[1], b, index, i, j, select(wanted, now, before))


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
    """Decide whether node ``h`` sends its estimate, and keep a copy of the one that was sent."""
    lanes, copies = scratch.lanes, (arrays.x, arrays.root)
    # Copies in order: those heard on each link, what each node sends now, what it sent last.
    own = len(links.sender) + h
    last = own + len(nodes.rows)
    near = is_near(
        lanes, nodes.xhat, nodes.root, arrays.x, arrays.root, (b, h, last),
        (arrays.alpha, arrays.ratio), scratch.total, scratch.noise,
    )  # fmt: skip
    store(lanes, scratch.row, 0, select(near, 1.0, 0.0))
    for q in range(len(lanes)):
        # The first estimate is sent in any case.
        if scratch.row[0, q] == 1.0 and arrays.known[b, last, q] == 1:
            plan.sent[b, s, 0, h, q] = 0
        if plan.sent[b, s, 0, h, q] == 1:
            arrays.known[b, last, q] = 1
    sent = load_flags(lanes, plan.sent, b, s, 0, h)
    copy_estimate(lanes, copies, last, nodes.xhat, nodes.root, h, b, sent)
    # What all others hear, while estimates change one after the other.
    everyone = spread(lanes, 1.0) > 0.0
    copy_estimate(lanes, copies, own, nodes.xhat, nodes.root, h, b, everyone)


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
    """Combine the estimate of filter ``h`` of block ``b`` with those that it hears in slot ``s``,
    and with the last estimates of silent neighbours, whose covariances are enlarged.
    """
    lanes = scratch.lanes
    n = nodes.xhat.shape[2]
    # Of the stacks of estimates the first W are copies by link, then come those of the nodes.
    W = len(links.sender)
    own = W + h
    heard = spread(lanes, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        copies = (arrays.x, arrays.root)
        if any_lane(arrived):
            sender = W + links.sender[m]
            copy_estimate(lanes, copies, m, arrays.x, arrays.root, sender, b, arrived)
        for q in range(len(lanes)):
            if plan.up[b, s, 0, links.direction[m], q] == 1:
                arrays.known[b, m, q] = 1
        # Silent neighbours count too: silence says that their estimate is near the copy.
        heard += select(load_flags(lanes, arrays.known, b, m), links.weight[m], 0.0)
        invert_lanes(lanes, arrays.inverse, arrays.root, b, m)
        for i in range(n):
            store(lanes, arrays.mean, m, i, load(lanes, arrays.x, b, m, i))
    # A node that knows no neighbour's estimate keeps its own, without rounding.
    alone = heard == 0.0
    if not any_lane(heard > 0.0):
        return
    invert_lanes(lanes, arrays.inverse, arrays.root, b, own)
    for i in range(n):
        x = load(lanes, arrays.x, b, own, i)
        store(lanes, arrays.mean, own, i, x)
        store(lanes, scratch.xhat, h, i, x)
    # Covariance intersection: sum_j w_j P_j^-1, as roots that are merged one after the other.
    rest = select(heard < 1.0, 1.0 - heard, 0.0)
    whiten(lanes, scratch.total, rest, arrays.inverse, arrays.mean, own, own)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        known = load_flags(lanes, arrays.known, b, m)
        if any_lane(known):
            # A silent neighbour counts less: its covariance is taken as 1 / share times as large.
            weight = select(arrived, links.weight[m], arrays.share * links.weight[m])
            weight = select(known, weight, 0.0)
            whiten(lanes, scratch.whitened, weight, arrays.inverse, arrays.mean, m, own)
            merge_lanes(lanes, scratch.total, scratch.whitened)
    finish_lanes(
        lanes, nodes.root, nodes.xhat, b, h, scratch.xhat, scratch.total, scratch.whitened, alone
    )


@kernel
def is_near_single(
    x: FloatArray,
    root: FloatArray,
    bounds: tuple[float, float],
    ratio: FloatArray,
    work: FloatArray,
) -> bool:
    """Return ``is_near`` of the first and the second of two estimates (1, 2, n, 1), one lane."""
    near: bool = is_near(ONE, x, root, x, root, (0, 0, 1), bounds, ratio, work)
    return near


def _is_information_consensus(value: Any) -> Filter:
    """Return the filter if it is HCMCI with one step of consensus on information; raises TypeError
    or ValueError, which the rule of the field turns into a ScenarioError.
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
THRESHOLDS = row(
    NOT_NEGATIVE, NOT_NEGATIVE, what="two numbers [estimate, covariance] that are not negative"
)


@built_in("event-triggered", trigger="consensus")
@dataclass(frozen=True, eq=False)
class EventTriggeredCi(Filter):
    """Consensus on information with one step a slot, in which a node sends only if its neighbours
    could not predict its estimate well enough; else they use what they have predicted.

    inner       consensus on information with one step a slot
    thresholds  [alpha, delta]: a node is silent while ``(xhat - xbar)' P^-1 (xhat - xbar) < alpha``
                where xbar and Pbar are what it sent last, predicted to now, and while
                ``P < (1 + delta) Pbar`` and ``Pbar < (1 + delta) P``

    In place of a silent neighbour's pair there is xbar with ``(1 + alpha^1/2)^2 (1 + delta) Pbar``,
    which bounds the second moment of its error (derived): with d = xhat - xbar that of e + d is at
    most ``(1 + a) P + (1 + 1/a) d d'`` for any a, and ``d d' <= alpha P``. With thresholds 0 it is
    consensus on information. A lost message is not noticed by its sender: links should be sure.
    """

    inner: Filter = field(INNER, default=Hcmci(consensus=INFORMATION))
    thresholds: tuple[float, float] = field(THRESHOLDS, default=(1.0, 1.0))

    paper: ClassVar[str] = "event_triggered"
    P_by_design: ClassVar[tuple[str, str]] = ("larger", "")
    clocks: ClassVar[tuple[str, ...]] = ()
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True
    inverts: ClassVar[bool] = True
    slot_kernel = staticmethod(triggered_ci_slots)

    def decides_in_slots(self) -> bool:
        """Return True."""
        return True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[TriggeredCiArrays]:
        """Return the copies of estimates, none so far."""
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
        """The factor of the root of a silent neighbour's pair."""
        alpha, delta = self.thresholds
        return (1.0 + math.sqrt(alpha)) * math.sqrt(1.0 + delta)

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note where messages may be lost."""
        channel = scenario.network.channel
        lossless = all(
            channel.loss.mean_delivery(link, scenario.table_probability(link)) == 1.0
            for link in scenario.topology.directions
        )
        if lossless and channel.delay.fixed is not None:
            return ()
        return (
            "event-triggered: messages may be lost, and a sender takes its neighbours to have "
            "what it sent; P may then be too small",
        )

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> TriggeredState:
        """Return the first state, in which nothing was sent or heard."""
        return TriggeredState(mean, first_root(cov), model)

    def predict(self, state: TriggeredState, gap: float) -> TriggeredState:
        """Predict the estimate, and all copies of estimates as those who sent them do."""
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        sent, heard = state.sent, []
        if sent is not None:
            sent = Estimate(*state.model.predict(sent.xhat, sent.root, gap))
        for one in state.heard:
            x, S = state.model.predict(one.xhat, one.root, gap)
            heard.append(Heard(x, S, one.weight))
        return state._replace(xhat=xhat, root=root, sent=sent, heard=tuple(heard))

    def emit(
        self, state: TriggeredState, exchange: Exchange
    ) -> tuple[TriggeredState, Estimate | None]:
        """Send the estimate if the neighbours' copy of it is no longer good enough."""
        if state.sent is not None and self.is_near(state, state.sent):
            return state, None
        own = Estimate(state.xhat, state.root)
        return state._replace(sent=own), own

    def is_near(self, state: TriggeredState, sent: Estimate) -> bool:
        """Return True if the copy ``sent`` is within both thresholds of the estimate."""
        (alpha, delta), n = self.thresholds, len(state.xhat)
        x = np.stack([state.xhat, sent.xhat]).reshape(1, 2, n, 1)
        root = np.stack([state.root, sent.root]).reshape(1, 2, n, n, 1)
        ratio, work = np.empty((n, n + 1, 1)), np.empty((n, n, 1))
        return bool(is_near_single(x, root, (alpha, 1.0 + delta), ratio, work))

    def absorb(
        self, state: TriggeredState, messages: Sequence[Message], exchange: Exchange
    ) -> TriggeredState:
        """Combine with the pairs heard, and with the copies of those who are silent."""
        known = dict(zip(state.senders, state.heard, strict=True))
        fresh = {m.sender: Heard(m.payload.xhat, m.payload.root, m.weight) for m in messages}
        known.update(fresh)
        if not known:
            return state
        senders = tuple(sorted(known))
        wider = self.widening
        pairs = [(state.xhat, state.root)]
        pairs += [
            (known[j].xhat, known[j].root if j in fresh else wider * known[j].root) for j in senders
        ]
        heard = [known[j].weight for j in senders]
        weights = np.array([max(0.0, 1.0 - math.fsum(heard)), *heard])
        means, roots = (np.stack(part) for part in zip(*pairs, strict=True))
        xhat, root = intersect_roots(weights, means, roots)
        return state._replace(
            xhat=xhat, root=root, senders=senders, heard=tuple(known[j] for j in senders)
        )

    def shift(self, state: TriggeredState, offset: FloatArray) -> TriggeredState:
        """Return the state shifted by ``offset``: the triggers look at differences."""
        sent = state.sent
        if sent is not None:
            sent = sent._replace(xhat=sent.xhat + offset)
        heard = tuple(one._replace(xhat=one.xhat + offset) for one in state.heard)
        return state._replace(xhat=state.xhat + offset, sent=sent, heard=heard)
