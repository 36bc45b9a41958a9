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
from netkf.algorithms.kernels.root_update import intersect_roots
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.core.fields import Rule, field, number, row
from netkf.linalg.arrays import FloatArray


class Heard(NamedTuple):
    """The last estimate that a neighbour sent, predicted to now: ``xhat`` (n,), ``root`` (n, n);
    the ``weight`` of its messages.
    """

    xhat: FloatArray
    root: FloatArray
    weight: float


class TriggeredState(NamedTuple):
    """Estimate ``xhat`` (n,) with ``root`` (n, n) and the model; the estimate that the neighbours
    have of this node, ``sent``, None before the first message; theirs by ``senders``, ``heard``.
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


def _is_information_consensus(value: Any) -> Filter:
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
                ``P <= (1 + delta) Pbar`` and ``Pbar <= (1 + delta) P``

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

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note where messages may be lost."""
        channel = scenario.network.channel
        sure = all(
            channel.loss.mean_delivery(link, scenario.table_probability(link)) == 1.0
            for link in scenario.topology.directions
        )
        if sure and channel.delay.fixed is not None:
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
        gap = np.linalg.solve(state.root, state.xhat - sent.xhat)
        # Eigenvalues of P^-1 Pbar, as squares of the singular values of S^-1 Sbar.
        ratios = np.linalg.svd(np.linalg.solve(state.root, sent.root), compute_uv=False) ** 2
        alpha, delta = self.thresholds
        within = ratios.min() * (1.0 + delta) >= 1.0 and ratios.max() <= 1.0 + delta
        return bool(gap @ gap < alpha and within)

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
        alpha, delta = self.thresholds
        wider = (1.0 + math.sqrt(alpha)) * math.sqrt(1.0 + delta)
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
