"""A node: its filter, its sensors and its inbox."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import simpy

from netkf.algorithms.filter import (
    Exchange,
    Filter,
    Increments,
    Message,
    NodeInfo,
    PairReading,
    Reading,
    interval_rule,
)
from netkf.algorithms.gates import Gate
from netkf.algorithms.kernels.maps import Spread
from netkf.algorithms.kernels.run import interval_end
from netkf.algorithms.models import (
    ChangingFlowModel,
    MapModel,
    RateModel,
    first_root,
    root_of_points,
)
from netkf.algorithms.single import Payload
from netkf.algorithms.translation import Common, state_before
from netkf.core.places import Place
from netkf.engines.base import LONGER, MIN_GAP_SHARE, Rank
from netkf.engines.simpy.driven import DrivenModel
from netkf.engines.simpy.timeline import Timeline
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.network.node_clocks import NodeTime
from netkf.plants.driven import moved_reading
from netkf.plants.nonlinear import linearise_by_points
from netkf.plants.readings import Stacked
from netkf.plants.response import Response, moments_over
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import ABSORB, REFUSE, SENSE

Sample = tuple[FloatArray, Any, FloatArray]
"""A sample y (p,), its H (p, n), or a function that linearises it, and R (p, p)."""


ASYMMETRY = 1e-6
"""The tolerated difference of P and P', as a share of its largest entry."""


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return ``value`` as a new array; ValueError unless of real numbers and of the ``shape``."""
    array = np.array(value)
    if array.dtype.kind not in "fiu" or array.shape != shape:
        got = f"{array.dtype} of the shape {array.shape}"
        raise ValueError(f"{name} must be numbers of the shape {shape}; got {got}")
    return array.astype(np.float64, copy=False)


class Envelope(NamedTuple):
    """A message under way.

    sender, number : node that sent it, and its number on the directed link
    weight : weight that the receiver gives to it
    sent, age : time of sending, and the seconds that it took once it has arrived
    exchange : in slots the number, within the run, of its exchange; -1 under clocks
    """

    sender: int
    number: int
    weight: float
    payload: Any
    sent: float
    exchange: int = -1
    age: float = 0.0


class View:
    """The part of the state that a node estimates: its ``entries`` (n',) in that of the plant."""

    def __init__(
        self,
        entries: np.ndarray,
        places: Sequence[Place],
        common: dict[int, tuple[np.ndarray, np.ndarray]],
    ) -> None:
        """``places`` are all blocks of the state; ``common`` are the entries of what senders and
        the node both estimate, by sender, where messages do not say it.
        """
        self.entries, self._places, self.common = entries, places, common
        self._n = sum(place.n for place in places)

    def readings(
        self, y: FloatArray, H: Any, R: FloatArray
    ) -> Iterator[tuple[FloatArray, Any, FloatArray] | PairReading]:
        """Yield the parts of a reading y (p,) with H (p, n), or a function that linearises it, and
        R (p, p): those of the node's states alone, with H of these, and a PairReading for each that
        depends on another block too.
        """
        for rows, part in self._parts(H):
            others = np.setdiff1d(self._support(part), self.entries)
            z, C = y[rows], R[rows][:, rows]
            if others.size:
                place = next(p for p in self._places if p.first <= others[0] < p.first + p.n)
                of_pair: Any = PairFunction(z, part, (self.entries, place.entries), self._n)
                yield PairReading(place.key, z, C, of_pair)
            elif isinstance(part, np.ndarray):
                yield z, np.ascontiguousarray(part[:, self.entries]), C
            else:
                yield z, OwnFunction(part, self.entries, self._n), C

    def _parts(self, H: Any) -> Iterator[tuple[np.ndarray, Any]]:
        """Yield the rows of parts that each depend on one other block at most, with their H."""
        if isinstance(H, np.ndarray):
            outside = np.ones(self._n, dtype=bool)
            outside[self.entries] = False
            owners = np.repeat(np.arange(len(self._places)), [place.n for place in self._places])
            others = [owners[outside & (row != 0.0)].tolist() for row in H]
            keys = np.array([own[0] if own else -1 for own in others], dtype=np.int64)
            for key in np.unique(keys):
                rows = np.flatnonzero(keys == key)
                yield rows, H[rows]
            return
        first = 0
        for part in getattr(H, "parts", [H]):
            rows = np.arange(first, first + part.size)
            first += part.size
            yield rows, part

    def _support(self, part: Any) -> np.ndarray:
        if isinstance(part, np.ndarray):
            return np.flatnonzero(part.any(axis=0))
        entries: np.ndarray = part.support(self._n)
        return entries


class OwnFunction:
    """Linearises readings of n states by ``function`` for a node that estimates ``entries``."""

    def __init__(self, function: Any, entries: np.ndarray, n: int) -> None:
        self._function, self._entries, self._n = function, entries, n
        self.size: int = function.size

    def _whole(self, x: FloatArray) -> FloatArray:
        whole = np.zeros(self._n)
        whole[self._entries] = x
        return whole

    def __call__(self, y: FloatArray, xhat: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings ``y`` (p,) linearised at the estimate ``xhat`` (n',), and H (p, n')."""
        z, J = self._function(y, self._whole(xhat))
        return z, J[:, self._entries]

    def value(self, x: FloatArray) -> FloatArray:
        """Return the readings (p,) without noise at the node's states x (n',)."""
        return np.asarray(self._function.value(self._whole(x)))

    def difference(self, y: FloatArray, expected: FloatArray) -> FloatArray:
        """Return the innovations (p,) of readings y (p,) minus the ``expected`` ones (p,)."""
        return np.asarray(self._function.difference(y, expected))


class PairFunction(NamedTuple):
    """``PairReading.H`` of a reading y (p,) with ``H`` (p, n), or the function that linearises it;
    ``entries`` are those of the node's states and of the other block.
    """

    y: FloatArray
    H: Any
    entries: tuple[np.ndarray, slice]
    n: int

    @property
    def linear(self) -> tuple[FloatArray, FloatArray] | None:
        """The matrices of both parts of the state, None if they depend on estimates."""
        own, others = self.entries
        return (self.H[:, own], self.H[:, others]) if isinstance(self.H, np.ndarray) else None

    def __call__(
        self, xhat: FloatArray, other: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return z (p,), and its matrices of both parts of the state, see PairReading."""
        z, J, (own, others) = self.y, self.H, self.entries
        if not isinstance(J, np.ndarray):
            whole = np.zeros(self.n)
            whole[own], whole[others] = xhat, other
            z, J = J(z, whole)
        return z, J[:, own], J[:, others]


class Node:
    """A filter with its inbox.

    ``entity`` is the index of the node, ``node`` its id in the trace, -1 for a filter that all
    nodes share. ``start`` is its estimate (n,) and covariance (n, n) at time 0.
    """

    def __init__(
        self,
        algorithm: Filter,
        node: int,
        entity: int,
        model: Any,
        start: tuple[FloatArray, FloatArray],
        info: NodeInfo,
        points: Spread,
        view: View | None,
        gate: Gate | None,
    ) -> None:
        """Set up the filter with its ``model`` and its estimate ``start`` = (xhat (n,), P (n, n))
        at time 0, and an empty inbox; ``node`` is an id, ``entity`` an index, ``points`` are those
        by which nonlinear sensors are linearised, and ``view`` its states, if not all.
        """
        self._points, self.view, self._gate = points, view, gate
        self.node, self.entity, self.info, self.model = node, entity, info, model
        self.width = len(model.information) if view is None else len(view.entries)
        self.moving_model = model.undriven if isinstance(model, DrivenModel) else model
        """The model in which matrices may change."""
        self.algorithm, self._timing = algorithm, algorithm.timing
        self._interval = interval_rule(algorithm)
        self.state = algorithm.init(model, *start, info)
        # By sender: absorption is in the order of senders, whatever the order of arrival.
        self.inbox: dict[int, list[Envelope]] = {}

    def restart(self, time: float, fresh: Callable[[float], tuple[FloatArray, FloatArray]]) -> None:
        """Begin again at ``time`` seconds with the estimate ``fresh(time)``, of a slot in slots."""
        self.state = self.algorithm.init(self.model, *fresh(time), self.info)

    def set_up(self, up: bool, time: float) -> None:
        """Go up or down at ``time`` (seconds)."""

    def _predict(self, start: float, gap: float) -> None:
        if isinstance(self.model, DrivenModel):
            self.state = self.model.advance(self.algorithm, self.state, start, gap)
            return
        if isinstance(self.model, MapModel):
            self.model.move_to(start)
        self.state = self.algorithm.predict(self.state, gap)

    def reported(self, time: float) -> tuple[FloatArray, FloatArray | None]:
        """Return ``estimate()`` as it stands in a trace of ``time`` (seconds)."""
        return self.estimate()

    def estimate(self) -> tuple[FloatArray, FloatArray | None]:
        """Return copies of estimate (n,) and covariance (n, n) or None; raises ValueError."""
        xhat, P = self.algorithm.estimate(self.state)
        mean = _numbers("xhat", xhat, (self.width,))
        if P is None:
            return mean, None
        cov = _numbers("P", P, (self.width, self.width))
        if (cov != cov.T).any():
            asymmetry, size = np.abs(cov - cov.T).max(), np.abs(cov).max()
            if asymmetry > ASYMMETRY * size:
                raise ValueError(f"P must be symmetric; got P - P' of up to {asymmetry:.3g}")
        return mean, cov

    def put(self, envelope: Envelope) -> None:
        """Put a message into the inbox; with ``newest_only`` only a sender's newest stays."""
        envelopes = self.inbox.setdefault(envelope.sender, [])
        if self._timing.newest_only and envelopes:
            # Delays may differ: a message that arrives later may have been sent earlier.
            if envelope.sent >= envelopes[0].sent:
                envelopes[0] = envelope
        else:
            envelopes.append(envelope)

    def take_messages(
        self, exchange: Exchange, time: float, recorder: Recorder
    ) -> tuple[list[Envelope], list[Message]]:
        """Empty the inbox; return its envelopes by sender, and the messages that filters take in
        this ``exchange``; the ``recorder`` takes what the gate refuses at this ``time``.
        """
        # A floating-point sum must not depend on the order of arrival.
        envelopes = [envelope for peer in sorted(self.inbox) for envelope in self.inbox[peer]]
        self.inbox.clear()
        own = None
        if self.view is not None and any(e.sender in self.view.common for e in envelopes):
            # What it would say itself: a filter's verbs leave its state as it is.
            own = self.algorithm.emit(self.state, exchange)[1]
        messages = [Message(e.sender, e.weight, self._translated(e, own), e.age) for e in envelopes]
        if self._gate is not None:
            messages = [m._replace(payload=self._gate_payload(m, time, recorder)) for m in messages]
        return envelopes, messages

    def _gate_payload(self, message: Message, time: float, recorder: Recorder) -> Any:
        payload, reading = message.payload, getattr(message.payload, "reading", None)
        whole = isinstance(payload, Payload) and payload.sender.kernels.sends_whole_readings
        # Errors of estimates are correlated in an unknown way with those of the node.
        if not whole or reading is None or message.age > 0.0 or self.algorithm.needs.blocks:
            return payload
        # Whitened: the covariance of its noise is 1.
        one = np.eye(len(reading.y))
        sample = reading.y, reading.H, one
        scale = self._gate_factor(sample, 0.0 * one) ** -0.5
        if scale != 1.0:
            recorder.append((time, REFUSE, self.node, message.sender, -1, -1, NAN))
        return payload.with_reading(reading._replace(y=scale * reading.y, H=scale * reading.H))

    def _translated(self, envelope: Envelope, own: Any) -> Any:
        common = None if self.view is None else self.view.common.get(envelope.sender)
        if common is None:
            return envelope.payload
        before = partial(state_before, self.model, age=envelope.age)
        return self.algorithm.needs.translate(envelope.payload, own, Common(*common, before))

    def linearise(self, samples: Sequence[Sample]) -> Sequence[Sample]:
        """Return samples with matrices at the estimate in place of nonlinear functions."""
        functions = [sample for sample in samples if not isinstance(sample[1], np.ndarray)]
        if not functions:
            return samples
        xhat, P = self.estimate()
        if not self._points.distance:
            return [
                (y, H, R) if isinstance(H, np.ndarray) else (*H(y, xhat), R) for y, H, R in samples
            ]
        root = getattr(self.state, "root", None)
        if root is None:
            root = first_root(np.zeros((len(xhat),) * 2) if P is None else P)
        # All together: deviations of functions of one state are correlated.
        y = np.concatenate([y for y, *_ in functions])
        stacked = Stacked([h for _, h, _ in functions])
        y, H, extra = linearise_by_points(stacked, y, xhat, root_of_points(root), self._points)
        is_linear = [isinstance(H, np.ndarray) for _, H, _ in samples]
        parts = [sample for sample, linear in zip(samples, is_linear, strict=True) if linear]
        parts.append((y, H, block_diagonal([R for *_, R in functions]) + extra))
        # Rows in the order of the sensors again: filters may use them one by one.
        first = np.repeat(is_linear, [len(R) for *_, R in samples])
        order = np.argsort(np.argsort(~first, kind="stable"))
        y, H = (np.concatenate([part[k] for part in parts])[order] for k in range(2))
        R = block_diagonal([R for *_, R in parts])
        return [(y, H, R[np.ix_(order, order)])]

    def gated(
        self, samples: Sequence[tuple[int, *Sample]], time: float, recorder: Recorder
    ) -> Sequence[Sample]:
        """Return the samples of this ``time`` that the gate lets pass, each by itself, with the R
        that it gives them, and record those it refuses with the node (id) before each, which took
        it; entries that are nan do not count.
        """
        if self._gate is None:
            return [(y, H, R) for _, y, H, R in samples]
        passed: list[Sample] = []
        for node, y, H, R in samples:
            ((value, J, C),) = self.linearise([(y, H, R)])
            factor = 1.0
            if self._timing.pooled or self.info.is_own(J).all():
                factor = self._gate_factor((value, J, R), C - R)
                if factor != 1.0:
                    recorder.append((time, REFUSE, node, -1, -1, -1, NAN))
            if np.isfinite(factor):
                passed.append((y, H, factor * R))
            elif self.algorithm.needs.every_reading:
                # Its gains belong to rows, which stay: zeros tell nothing.
                passed.append((0.0 * value, 0.0 * J, R))
        return passed

    def _gate_factor(self, sample: Sample, extra: FloatArray) -> float:
        """Return by what the gate multiplies R of a sample; S is H P H' + R + ``extra`` (p, p)."""
        xhat, P = self.estimate()
        y, H, R = sample
        present = np.isfinite(y)
        z, J, C = (y - H @ xhat)[present], H[present], R[np.ix_(present, present)]
        assert self._gate is not None
        assert P is not None
        spread = J @ first_root(P)
        if extra.any():
            spread = np.hstack([spread, first_root(extra)])
        return self._gate.factor(z, spread, C)

    def shift(self, offset: FloatArray) -> None:
        """Add ``offset`` (n,) to the estimate, after the origin of the coordinates has moved."""
        self.state = self.algorithm.shift(self.state, offset)


class ClockedNode(Node):
    """A node in continuous time.

    It is predicted to the present only when an event concerns it. All messages that arrive at one
    instant are absorbed in one later event of that instant, and so are all samples.
    """

    def __init__(
        self,
        timeline: Timeline,
        recorder: Recorder,
        truth: Any,
        increments: list[Any],
        clock: NodeTime,
        response: Response | None,
        **arguments: Any,
    ) -> None:
        """``response`` is that to the input which estimates are counted from: at the time of the
        ``clock``, while all else is counted from it at the true time; None if they never differ.
        """
        super().__init__(**arguments)
        self._timeline, self._recorder, self._truth = timeline, recorder, truth
        self._increments, self._clock, self._response = increments, clock, response
        # The time in seconds by its clock, to which the filter is predicted, and that up to which
        # it has used increments.
        self._now, self._read_to = clock.shows(0.0), 0.0
        # The samples of the present instant, until the update that uses all of them.
        self._samples: list[tuple[int, FloatArray, Any, FloatArray]] = []
        self._pairs: list[tuple[int, PairReading]] = []
        self.after_sample: Any = None
        """Function called with the time in seconds once the node has used its samples of an
        instant; None unless readings make the node transmit.
        """

    def restart(self, time: float, fresh: Callable[[float], tuple[FloatArray, FloatArray]]) -> None:
        """Begin again at ``time`` seconds with the estimate ``fresh(time)``."""
        shown = self._clock.shows(time)
        super().restart(shown, fresh)
        self._now, self._read_to = shown, time

    def ahead(self, time: float) -> FloatArray | None:
        """Return by how much the origin of estimates is ahead of that of the truth at ``time``
        (seconds), (n,) of the plant; None if they are one.
        """
        if self._response is None:
            return None
        shown, true = self._response.states(np.array([self._clock.shows(time), time]))
        return np.asarray(shown - true)

    def times_of(self, shown: FloatArray) -> FloatArray:
        """Return when its clock shows ``shown`` (K,), both in seconds."""
        return self._clock.grid.snap(self._clock.time_of(shown))

    def reported(self, time: float) -> tuple[FloatArray, FloatArray | None]:
        """Return ``estimate()`` counted from the origin of the truth at ``time`` (seconds)."""
        (mean, cov), ahead = self.estimate(), self.ahead(time)
        if ahead is not None:
            mean += ahead if self.view is None else ahead[self.view.entries]
        return mean, cov

    def set_up(self, up: bool, time: float) -> None:
        """Use increments from ``time`` (s) on, or no more; a shared filter those of nodes up."""
        if self._increments and self.node >= 0:
            self.predict_to(time)
            self.moving_model.set_reading(up)

    def predict_to(self, time: float) -> None:
        """Predict the filter to ``time`` (seconds), using the increments since its last event; what
        passes for it is time by its clock.
        """
        true_time, time = time, self._clock.shows(time)
        if self._now >= time:
            return
        if isinstance(self.moving_model, ChangingFlowModel | RateModel):
            self.moving_model.move_to(time)
        if not self._increments:
            self._predict(self._now, time - self._now)
            self._now = time
            return
        # A lower bound: a diverging covariance would make intervals ever shorter.
        min_interval = MIN_GAP_SHARE * (time - self._now)
        while self._now < time:
            end = time
            interval = self._interval(self.state) if self.moving_model.reads else math.inf
            if interval < time - self._now:
                # P changes too much over the whole gap: use the increments of a part of it.
                end = interval_end(self._now, time, max(interval, min_interval))
                min_interval *= LONGER
            # Predict first: the increments of a gap are an observation at its end.
            gap = end - self._now
            self._predict(self._now, gap)
            moments = self._read(true_time if end == time else self._clock.time_of(end), end)
            # The two moments of the increments, with the gains for a gap of this length.
            if self.moving_model.reads:
                self.state = self.algorithm.update(self.state, Increments(moments, gap))
            self._now = end

    def _read(self, end: float, shown: float) -> FloatArray:
        """Return the moments (2 p,) of the increments of all sensors since those before, up to
        ``end``, when the clock shows ``shown`` (both in s), whose pace does not change them.
        """
        truth, start, self._read_to = self._truth, self._read_to, end
        x_moments = truth.moments(start, end)
        if self._response is not None:
            # Counted from the response over the time that passed by the clock.
            response, grid = self._response, self._clock.grid
            x_moments = x_moments + moments_over(response, start, end, grid)
            x_moments -= moments_over(response, self._now, shown, grid)
        parts = [sensor.moments(truth, x_moments, start, end) for sensor in self._increments]
        # Stack the sensors: first moments of all rows, then the second ones.
        stacked = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return np.asarray(stacked.reshape(-1))

    def sample(self, node: int, y: FloatArray, H: Any, R: FloatArray) -> None:
        """Store a sample y (p,) that a sensor of ``node`` (id) has just taken, with its H (p, n),
        or a function that linearises it, and R (p, p): one update uses all samples of this instant.
        """
        # The first sample of an instant schedules the update, which then uses all of them.
        if not self._samples and not self._pairs:
            self._timeline.call_at(self._timeline.now, Rank.UPDATE, self.entity, self._use_samples)
        if (ahead := self.ahead(self._timeline.now)) is not None:
            y, H = moved_reading(y, H, ahead)
        if self.view is not None:
            for part in self.view.readings(y, H, R):
                if isinstance(part, PairReading):
                    self._pairs.append((node, part))
                else:
                    self._samples.append((node, *part))
            return
        self._samples.append((node, y, H, R))

    def _use_samples(self, _: simpy.Event) -> None:
        time, samples, pairs = self._timeline.now, self._samples, self._pairs
        self._samples, self._pairs = [], []
        self.predict_to(time)
        sensing = sorted({sample[0] for sample in samples} | {node for node, _ in pairs})
        for node in sensing:
            self._recorder.append((time, SENSE, node, -1, -1, -1, NAN))
        # One update with all samples: R is block diagonal, since sensors have independent noise.
        known = self.linearise(self.gated(samples, time, self._recorder))
        nothing = np.empty(0), np.empty((0, self.width))
        y, H = (np.concatenate([nothing[part], *(s[part] for s in known)]) for part in range(2))
        R = block_diagonal([R for *_, R in known])
        reading = Reading(y, H, R, self._now, tuple(pair for _, pair in pairs))
        self.state = self.algorithm.update(self.state, reading)
        # Under activation by readings the node transmits now.
        if self.after_sample is not None:
            self.after_sample(time)

    @property
    def estimates_at(self) -> float:
        """The time in seconds, by its clock, that the estimate is of."""
        return self._now

    def emit(self, time: float, receivers: tuple[int, ...]) -> Any:
        """Return the payload that the node sends to ``receivers`` (ids) at ``time``, or None."""
        # The payload is of the present state, not of that at the last event.
        self.predict_to(time)
        exchange = Exchange(time=self._now, receivers=receivers)
        self.state, payload = self.algorithm.emit(self.state, exchange)
        return payload

    def in_time(self, envelope: Envelope) -> bool:
        """Return True if the filter accepts a message that arrives now."""
        return envelope.age <= self._timing.max_age

    def receive(self, envelope: Envelope) -> None:
        """Put a message into the inbox, to be absorbed with all others of this instant."""
        # One event for all messages of this instant: filters absorb them together.
        if not self.inbox:
            self._timeline.call_at(self._timeline.now, Rank.ABSORB, self.entity, self._absorb)
        self.put(envelope)

    def _absorb(self, _: simpy.Event) -> None:
        time = self._timeline.now
        self.predict_to(time)
        exchange = Exchange(time=self._now)
        messages = self.take_messages(exchange, time, self._recorder)[1]
        self.state = self.algorithm.absorb(self.state, messages, exchange)
        oldest = max(message.age for message in messages)
        self._recorder.append((time, ABSORB, self.node, -1, -1, -1, oldest))


def distinct(nodes: dict[int, Any]) -> list[Any]:
    """Return the distinct node processes; all nodes of a pooled filter share one."""
    return list({id(node): node for node in nodes.values()}.values())
