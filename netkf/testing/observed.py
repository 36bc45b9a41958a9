"""A filter of a user in a run of the SimPy engine, with every call of it checked and recorded."""

from __future__ import annotations

import math
import pickle
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import (
    Exchange,
    Filter,
    Increments,
    Message,
    NodeInfo,
    interval_rule,
    may_be_silent,
)
from netkf.algorithms.single import NodeState
from netkf.linalg.arrays import FloatArray
from netkf.testing.watching import WatchedPart, collect_leaves, demand, demand_array, differing_path

TOLERANCE = 1e-9
"""Relative to the largest entry of P: thousands of times the rounding error."""
COMPOSITION_TOLERANCE = 1e-6
"""Relative: above the rounding error of any method for the Riccati equation."""
GAPS = ((1e-3, 0.02), (0.3, 0.5), (1.0, 2.0))
"""Pairs of gaps in seconds: below, about and above the time scale of the small systems."""
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(12)


class Seen(NamedTuple):
    """An estimate ``xhat`` (n,), less the shift of the truth, and ``P`` (n, n) or None of node
    number ``node`` after a method, with the ``size`` of the estimate before that.
    """

    node: int
    after: str
    xhat: FloatArray
    P: FloatArray | None
    size: float


class Shift(NamedTuple):
    """A shift of the truth, and of all nodes with it, by ``offset`` (n,) at time ``since`` (s): it
    is ``transition(t - since) @ offset`` at any other time t.
    """

    since: float
    offset: FloatArray
    transition: Callable[[float], FloatArray]

    def at(self, time: float) -> FloatArray:
        """Return the shift (n,) at a time in seconds."""
        return np.asarray(self.transition(time - self.since) @ self.offset)


@dataclass
class Log:
    """What the nodes of one run did.

    seen : estimates in the order in which they were made
    states : the present state of each node by number
    sums, waiting, exchange : the conserved sums before an exchange, the nodes that have not
        absorbed its messages yet, and where it is
    sent : messages by sender and receiver
    """

    seen: list[Seen] = field(default_factory=list)
    states: dict[int, Any] = field(default_factory=dict)
    sums: dict[str, float] = field(default_factory=dict)
    waiting: set[int] = field(default_factory=set)
    exchange: Any = None
    sent: Counter[tuple[int, int]] = field(default_factory=Counter)


class ObservedState(NamedTuple):
    """The ``state`` of the user's filter on node number ``node`` at ``time`` seconds, whether it is
    ``shifted`` with the truth, and the H (p, n) of its sensors that give increments.
    """

    state: Any
    node: int
    time: float
    shifted: bool
    H: FloatArray


class ObservedPayload(NamedTuple):
    """A payload of the user's filter, when it was sent, and whether it was shifted then."""

    payload: Any
    time: float
    shifted: bool


@dataclass(frozen=True, eq=False)
class Observed(Filter):
    """The user's filter ``watched``, whose calls are checked and recorded in ``log``.

    With a ``shift`` it sees a shifted truth: readings and the estimates of all nodes are shifted on
    the way, and what the engine gets is shifted back. ``period`` is that of slots, 0 in continuous
    time, ``reliable`` the number of messages of a link that arrive at once, ``spread`` the
    difference between the first estimates of a node and of the one before, ``composes`` whether
    predictions over two gaps are compared with those over one.
    """

    watched: WatchedPart
    log: Log
    period: float
    reliable: int
    shift_of_truth: Shift | None = None
    spread: float = 0.0
    composes: bool = False

    @property
    def timing(self) -> Any:
        """The timing of the user's filter."""
        part, interval = self.watched.part, interval_rule(self.watched.part)
        return replace(
            part.timing,
            interval=lambda own: self._checked_interval(interval(own.state)),
            decides=may_be_silent(part),
        )

    @property
    def needs(self) -> Any:
        """Those of the user's filter, without its own checks of a scenario."""
        return replace(self.watched.part.needs, own_blocks=False, check=None, notes=None)

    @property
    def link_weights(self) -> Any:
        """Those of the user's filter."""
        return self.watched.part.link_weights

    @property
    def analysis(self) -> Any:
        """The checked rule for whether a node has stopped."""
        return replace(super().analysis, stopped=lambda own: self._has_stopped(own.state))

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> ObservedState:
        """Return the state of a node at time 0."""
        state = self.watched.call("init", model, mean + node.place * self.spread, cov, node)
        own = ObservedState(state, node.place, 0.0, False, model.H)
        self._note(own, "init")
        if node.place == 0:
            self._check_pickled(state)
        if self.composes:
            self._check_composition(state, len(mean))
        return own

    def predict(self, state: ObservedState, gap: float) -> ObservedState:
        """Return the state ``gap`` seconds later."""
        own = self._shift_with_truth(state)
        own = own._replace(state=self.watched.call("predict", own.state, gap), time=own.time + gap)
        # With increments the estimate lacks what P counts already.
        return own if len(own.H) and not self.period else self._note(own, "predict")

    def update(self, state: ObservedState, reading: Any) -> ObservedState:
        """Return the state after a reading, to which the shift of the truth is added."""
        own, timing = state, self.watched.part.timing
        moves = bool(self.period) and "predict" not in timing.schedule
        if moves:
            own = self._shift_with_truth(own)
            own = own._replace(time=own.time + (0.0 if timing.predicts else self.period))
        shift = self.shift_of_truth
        if shift is not None and own.shifted and isinstance(reading, Increments):
            effect, start = np.zeros((2, len(own.H))), own.time - reading.gap
            for z, weight in zip(POINTS, WEIGHTS, strict=True):
                y = own.H @ shift.at(start + 0.5 * reading.gap * (1.0 + z))
                effect += 0.5 * reading.gap * weight * np.outer([1.0, z], y)
            reading = reading._replace(moments=reading.moments + effect.reshape(-1))
        elif shift is not None and own.shifted:
            reading = reading._replace(y=reading.y + reading.H @ shift.at(own.time))
        own = own._replace(state=self.watched.call("update", own.state, reading))
        if moves and timing.predicts:
            own = own._replace(time=own.time + self.period)
        return self._note(own, "update")

    def emit(self, state: ObservedState, exchange: Exchange) -> tuple[ObservedState, Any]:
        """Return the state and what the node sends."""
        self._begin(exchange)
        pair = self.watched.call("emit", state.state, exchange)
        is_pair = type(pair) is tuple and len(pair) == 2
        rule = "must return (state, payload); payload None sends nothing"
        self.watched.demand("emit", is_pair, rule)
        own = self._note(state._replace(state=pair[0]), "emit")
        if pair[1] is None:
            return own, None
        self.log.waiting.update(exchange.receivers)
        self.log.sent.update((own.node, receiver) for receiver in exchange.receivers)
        return own, ObservedPayload(pair[1], own.time, own.shifted)

    def absorb(self, state: ObservedState, messages: Any, exchange: Exchange) -> ObservedState:
        """Return the state after messages, which are shifted as the node is."""
        self._begin(exchange)
        own = [message._replace(payload=self._payload(message, state)) for message in messages]
        new = state._replace(state=self.watched.call("absorb", state.state, own, exchange))
        self._note(new, "absorb")
        self._has_stopped(new.state)
        self.log.waiting.discard(new.node)
        if not self.log.waiting and self.log.sums:
            self._check_conserved("all" if self.period and not messages else "none")
        return new

    def estimate(self, state: ObservedState) -> tuple[FloatArray, FloatArray | None]:
        """Return the estimate without the shift of the truth, and its covariance."""
        xhat, P = self.watched.part.estimate(state.state)
        return xhat - self._offset(state), P

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state, or a payload under way, with another origin."""
        name = state._fields[0]
        return state._replace(**{name: self.watched.part.shift(getattr(state, name), offset)})

    def _offset(self, own: ObservedState) -> FloatArray | float:
        is_shifted = self.shift_of_truth is not None and own.shifted
        return self.shift_of_truth.at(own.time) if is_shifted else 0.0  # type: ignore[union-attr]

    def _shift_with_truth(self, own: ObservedState) -> ObservedState:
        shift = self.shift_of_truth
        if shift is None or own.shifted or own.time < shift.since:
            return own
        state = self.watched.call("shift", own.state, shift.at(own.time))
        return own._replace(state=state, shifted=True)

    def _payload(self, message: Message, receiver: ObservedState) -> Any:
        payload, time, shifted = message.payload
        if self.shift_of_truth is None or shifted == receiver.shifted:
            return payload
        # Sent before the shift, or by a node that was shifted a little earlier.
        offset = self.shift_of_truth.at(time) * (1.0 if receiver.shifted else -1.0)
        return self.watched.call("shift", payload, offset)

    def _note(self, own: ObservedState, after: str) -> ObservedState:
        xhat, P = check_estimate(self.watched, own.state, own.H.shape[1], after)
        size = float(np.abs(xhat).max())
        self.log.seen.append(Seen(own.node, after, xhat - self._offset(own), P, size))
        self.log.states[own.node] = own.state
        return own

    def _begin(self, exchange: Exchange) -> None:
        """Note the conserved sums before an exchange from which no message may be lost alone."""
        log = self.log
        place = exchange[1:4] if self.period else exchange.time
        if place == log.exchange:
            return
        clean = bool(self.period) or max(log.sent.values(), default=0) < self.reliable
        log.exchange, log.sums = place, self._sums() if clean else {}
        log.waiting = set(log.states) if self.period else set()

    def _sums(self) -> dict[str, float]:
        by_node = [self.watched.call("analysis.conserved", s) for s in self.log.states.values()]
        names = by_node[0].keys() if isinstance(by_node[0], dict) else None
        same_names = all(isinstance(terms, dict) and terms.keys() == names for terms in by_node)
        rule = "must name the same quantities at every node"
        self.watched.demand("analysis.conserved", same_names, rule, by_node[0])
        return {
            name: math.fsum(np.concatenate([np.atleast_1d(terms[name]) for terms in by_node]))
            for name in by_node[0]
        }

    def _check_conserved(self, lost: str) -> None:
        after = self._sums()
        remedy = "let absorb give to one node what it takes from another"
        for name, total in self.log.sums.items():
            survives = abs(after[name] - total) <= TOLERANCE * max(abs(total), 1.0)
            rule = f"the sum of {name} over all nodes must survive an exchange with {lost} lost"
            got = f"{total:.6g} before and {after[name]:.6g} after"
            self.watched.demand("analysis.conserved", survives, rule, got, remedy)

    def _has_stopped(self, state: Any) -> bool:
        stopped = self.watched.call("analysis.stopped", state)
        is_flag = stopped is True or stopped is False
        self.watched.demand("analysis.stopped", is_flag, "must be True or False", stopped)
        return bool(stopped)

    def _checked_interval(self, seconds: float) -> float:
        self.watched.demand("timing.interval", seconds > 0.0, "must be above 0 seconds", seconds)
        return seconds

    def _check_composition(self, state: Any, n: int) -> None:
        predict = partial(self.watched.call, "predict")
        rule = "must compose over gaps, predict(a + b) = predict(b) after predict(a)"
        remedy = (
            "solve over the gap exactly, as state.model.predict does, and keep no count of calls"
        )
        for first, second in GAPS:
            in_one_step = predict(state, first + second)
            in_two_steps = predict(predict(state, first), second)
            both = (
                check_estimate(self.watched, s, n, "predict") for s in (in_one_step, in_two_steps)
            )
            for name, (one, other) in zip(("xhat", "P"), zip(*both, strict=True), strict=True):
                if one is None or other is None:
                    continue
                size = max(float(np.abs(one).max()), float(np.abs(other).max()), 1e-300)
                difference = float(np.abs(one - other).max()) / size
                got = f"{name} that differs by {difference:.2g} of its size at a = {first:g}"
                got += f" and b = {second:g} s"
                is_same = difference <= COMPOSITION_TOLERANCE
                self.watched.demand("predict", is_same, rule, got, remedy)

    def _check_pickled(self, state: Any) -> None:
        try:
            copy = pickle.loads(pickle.dumps(state))
        except Exception as error:
            raise AssertionError(
                f"{self.watched.name}.init: states must be picklable; got {type(error).__name__}: "
                f"{error}; make the state a NamedTuple of arrays at the top level of a module"
            ) from error
        one, other = (collect_leaves(self.watched.part.estimate(s)) for s in (state, copy))
        is_same = differing_path(one, other) is None
        self.watched.demand("init", is_same, "states must be equal after pickling")


def check_estimate(
    watched: WatchedPart, state: Any, n: int, after: str
) -> tuple[FloatArray, FloatArray | None]:
    """Return xhat (n,) and P (n, n) or None of a state that the method ``after`` returned; raises
    AssertionError unless they are finite and P is symmetric and positive semidefinite.
    """
    where = f"{watched.name}.estimate after {after}"
    pair = watched.call("estimate", state)
    demand(isinstance(pair, tuple) and len(pair) == 2, where, "must be (xhat, P)", pair)
    xhat = demand_array(where, "xhat", pair[0], (n,))
    if pair[1] is None:
        return xhat, None
    P = demand_array(where, "P", pair[1], (n, n), "return None where the filter has no P")
    if isinstance(state, NodeState):  # which kernels have written
        above = float(np.abs(np.triu(state.root, 1)).max())
        rule, got = "root must be lower triangular in kernels", f"{above:.3g} above the diagonal"
        demand(above == 0.0, where, rule, got, "write a lower triangular root of the same P")
    size = max(float(np.abs(P).max()), np.finfo(float).tiny)
    asymmetry = float(np.abs(P - P.T).max())
    rule, got = "P must be symmetric", f"P - P' of up to {asymmetry:.3g}"
    demand(asymmetry <= TOLERANCE * size, where, rule, got, "return 0.5 * (P + P.T)")
    smallest = float(np.linalg.eigvalsh(P)[0])
    rule, got = "P must be positive semidefinite", f"least eigenvalue {smallest:.4g}"
    remedy = "look for a sign, or for weights that sum to more than 1"
    demand(smallest >= -TOLERANCE * size, where, rule, got, remedy)
    return xhat, P
