"""The Kalman filter with intermittent observations, paper R (15)-(18) (Kar, Sinopoli and Moura):
a node uses the readings that arrive, its own and its neighbours'.

In slots the state is a prediction: after the readings of a slot it is predicted to the next one.
Under clocks a message takes time, and its reading may be late. It is used exactly, as if it had
come in time: the node remembers its past events, goes back to before the reading, and repeats all
that came after it.

The origin of coordinates moves now and then to near the true state, so that large states cost no
digits (``shift``, ``rebase``). A move is an event of the past too.

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings``, ``plan`` (the events
of S slots), ``links``, ``samples`` (output) and ``scratch``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.neighbours import fuse_readings
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    predict_all,
    rebase,
    store_sample_of_slot,
)
from netkf.algorithms.models import first_root, sample_update
from netkf.algorithms.registry import built_in
from netkf.core.fields import field, of_time, one_of, positive
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

SLACK = 1.0 + 1e-6
"""Factor by which the past that is remembered is longer than needed, since ages are rounded."""

TIME_TOLERANCE = 1e-14
"""Relative difference up to which times count as equal, since the time of a state is a
sum of gaps.
"""


class Past(NamedTuple):
    """One event in the past of a node, the start, a reading or a move of the origin, to repeat when
    a late reading arrives.

    time : in seconds
    reading : the reading that was used, or None
    offset : what a move of the origin added to the estimate (n,), or None
    xhat, root : estimate (n,) and root (n, n) right after the event
    before : the event before it, None if that is forgotten or there is none
    """

    time: float
    reading: Reading | None
    offset: FloatArray | None
    xhat: FloatArray
    root: FloatArray
    before: Past | None


class IntermittentState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    unsent : own reading of this instant, which may still be sent, or None
    time : of the last prediction or reading, in seconds
    past : the newest event, linked to those before it, as far back as a late reading may reach
    lag : length of that past in seconds; 0: no events are stored
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    unsent: Reading | None
    time: float
    past: Past
    lag: float

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


@kernel
def intermittent_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
) -> None:
    """Simulate H intermittent filters over the S slots of a plan, paper R (15)-(18), in B blocks of
    L runs: in each slot they use their own readings and those that arrive, then predict.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples``, of the predictions with which slots begin.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            # Samples show the predictions with which the slot begins.
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)
            if plan.sensed[s]:
                for h in range(len(nodes.rows)):
                    # The own reading and, by True, those that arrive, one after the other: with
                    # independent noise that equals one update.
                    fuse_readings(nodes, readings, plan, links, scratch, True, b, s, h)
                predict_all(nodes, scratch, b)


@built_in("intermittent")
@dataclass(frozen=True, eq=False)
class Intermittent(Filter):
    """Every node sends its reading to its neighbours and uses its own and those that arrive.

    late    under clocks, readings that took time: "exact": the result is that of the filter that
            had all arrived readings in the order of their times, by going back to before the late
            one; "drop": they are not used
    window  seconds that a late reading may be old, at most; older ones are late for good. By
            default the longest time a message may take
    """

    late: str = field(one_of("exact", "drop"), default="exact")
    window: float | None = field(of_time(positive), default=None)

    paper: ClassVar[str] = "intermittent"
    combination: ClassVar[str] = "readings"
    schedule: ClassVar[tuple[str, ...]] = ("sense", "exchange", "predict")
    clocks: ClassVar[tuple[str, ...]] = ("readings",)
    predicts: ClassVar[bool] = True
    one_way: ClassVar[bool] = True
    needs_samples: ClassVar[bool] = True
    newest_only: ClassVar[bool] = False
    slot_kernel = staticmethod(intermittent_slots)
    unrolled: ClassVar[bool] = True

    def sends_in_slots(self, phase: int, has_sensor: bool) -> bool:
        """Return True for nodes with a sensor: they send their readings."""
        return has_sensor

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message in numbers of 64 bits: y, H and R of ``rows`` rows and n
        states.
        """
        return rows * (1 + n) + rows * (rows + 1) // 2

    def init(
        self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo
    ) -> IntermittentState:
        """Return the state of ``node`` at time 0, before any reading, with estimate ``mean`` (n,)
        and covariance ``cov`` (n, n); ``model`` is that of the plant and the node's sensors.
        """
        root = first_root(cov)
        # The start is the first entry of the past: every late reading has a state before it.
        start = Past(time=0.0, reading=None, offset=None, xhat=mean, root=root, before=None)
        return IntermittentState(
            xhat=mean,
            root=root,
            model=model,
            unsent=None,
            time=0.0,
            past=start,
            lag=self.history_span(node.max_delay),
        )

    @property
    def max_age(self) -> float:
        """Seconds beyond which a reading that arrives is too old to use: 0 if late ones are
        dropped, infinity without a window.
        """
        if self.late == "drop":
            return 0.0
        return math.inf if self.window is None else self.window

    def history_span(self, max_delay: float) -> float:
        """Return the seconds of its past that a node must keep for late readings, if no message
        takes longer than ``max_delay`` seconds.
        """
        return SLACK * min(self.max_age, max_delay)

    def predict(self, state: IntermittentState, gap: float) -> IntermittentState:
        """Return the state ``gap`` seconds later, without an unsent reading: a reading is sent at
        its own instant or never.
        """
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root, time=state.time + gap, unsent=None)

    def update(self, state: IntermittentState, reading: Reading) -> IntermittentState:
        """Return the state after the reading, paper R (15)-(18), which is kept to be sent."""
        return _use_reading(state, reading)._replace(unsent=reading if len(reading.y) else None)

    def emit(
        self, state: IntermittentState, exchange: Exchange
    ) -> tuple[IntermittentState, Reading | None]:
        """Return the state, unchanged, and the payload: the reading of this instant, None from
        nodes that have none.
        """
        return state, state.unsent

    def absorb(
        self, state: IntermittentState, messages: Sequence[Message], exchange: Exchange
    ) -> IntermittentState:
        """Return the state after the readings in ``messages``, each used as if it had come at the
        time when it was taken.
        """
        for message in messages:
            reading: Reading = message.payload
            # In slots a message is used in the slot in which it was sent.
            if exchange.slot >= 0 or message.age <= 0.0:
                state = _use_reading(state, reading)
            else:
                state = _use_late(state, reading, exchange.time)
        return state

    def accepts(self, payload: Reading, age: float) -> bool:
        """Return False if the message, ``age`` seconds old, took longer than the window, or if late
        readings are dropped.
        """
        return age <= self.max_age

    def shift(self, state: IntermittentState, offset: FloatArray) -> IntermittentState:
        """Return the state with ``offset`` (n,) added to the estimate, for a move of the origin.
        The past keeps the coordinates of its time, and the move becomes its newest event.
        """
        xhat = state.xhat + offset
        # After a late reading, the way forward from before this time must shift again.
        if state.lag > 0.0:
            past = Past(state.time, None, offset, xhat, state.root, state.past)
            state = state._replace(past=past)
        return state._replace(xhat=xhat)

    def shift_payload(self, payload: Reading, offset: FloatArray) -> Reading:
        """Return the ``payload`` of a message under way, for a move of the origin by which
        estimates change by ``offset`` (n,): unchanged, since a reading keeps the coordinates of its
        time, to which the receiver goes back.
        """
        return payload


def _use_reading(state: IntermittentState, reading: Reading) -> IntermittentState:
    """Return the state after a ``reading`` of the present instant, with updated estimate and root;
    if late readings are used exactly, the reading joins the past events, which a late one repeats.
    """
    # A reading without rows changes nothing.
    if not len(reading.y):
        return state
    xhat, root = sample_update(state.xhat, state.root, reading.y, reading.H, reading.R)
    state = state._replace(xhat=xhat, root=root)
    if state.lag <= 0.0:
        return state
    time, past = reading.time, state.past
    # Forget old events once in each interval of length lag: each time copies those that stay.
    if time // state.lag > past.time // state.lag:
        past = _drop_old(past, time - state.lag)
    return state._replace(time=time, past=Past(time, reading, None, xhat, root, past))


def _use_late(state: IntermittentState, reading: Reading, now: float) -> IntermittentState:
    """Return the state at ``now`` (seconds) as if a late reading had come in time: go back to the
    event before it, use it, and repeat all later events.
    """
    later_events: list[Past] = []
    past = state.past
    # Entries after the reading's time are taken off; times that differ by rounding count as equal.
    while past.time > reading.time + TIME_TOLERANCE * now and past.before is not None:
        later_events.append(past)
        past = past.before
    model = state.model
    # The late reading, with the state before it, takes its place in time.
    late_event = Past(reading.time, reading, None, past.xhat, past.root, None)
    # Forward again: predict to each event, and repeat it.
    for event in [late_event, *reversed(later_events)]:
        xhat, root = past.xhat, past.root
        if event.time > past.time:
            xhat, root = model.predict(xhat, root, event.time - past.time)
        if event.reading is not None:
            # R (17) and (18) with this reading.
            r = event.reading
            xhat, root = sample_update(xhat, root, r.y, r.H, r.R)
        if event.offset is not None:
            xhat = xhat + event.offset
        past = Past(event.time, event.reading, event.offset, xhat, root, past)
    xhat, root = past.xhat, past.root
    # From the last event to now.
    if now > past.time:
        xhat, root = model.predict(xhat, root, now - past.time)
    return state._replace(xhat=xhat, root=root, time=now, past=_drop_old(past, now - state.lag))


def _drop_old(past: Past, since: float) -> Past:
    """Return the past without the events that no late reading can reach: those from ``since``
    (seconds) on stay, and one before it.
    """
    recent: list[Past] = []
    event: Past | None = past
    while event is not None:
        recent.append(event)
        # One entry before ``since`` stays: a late reading of that time starts from it.
        if event.time < since:
            break
        event = event.before
    else:
        # All events are recent: no copy.
        return past
    trimmed = recent[-1]._replace(before=None)
    # Entries are immutable, so the list is built anew from its oldest entry.
    for event in reversed(recent[:-1]):
        trimmed = event._replace(before=trimmed)
    return trimmed
