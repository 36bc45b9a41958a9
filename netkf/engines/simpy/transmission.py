"""Transmissions: messages are sent, lost or delayed, and delivered."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol

import numpy as np
import simpy

from netkf.algorithms.filter import Filter
from netkf.algorithms.single import Payload
from netkf.engines.base import Rank
from netkf.engines.reach import Reach
from netkf.engines.simpy.nodes import Envelope
from netkf.engines.simpy.timeline import Timeline
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import (
    ChannelDraw,
    ChannelSampler,
    broadcasts_of,
    conditions_of,
    has_identical_links,
    transit_time,
)
from netkf.network.graphs import Link
from netkf.network.losses import Transmission
from netkf.network.node_clocks import node_times
from netkf.network.quantise import encoders
from netkf.network.radio import Airtime
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CLIP, DELIVER, LATE, LOST, SEND

LINK_DOWN = ChannelDraw(math.inf, False, 0.0)
"""The draw for a link that is down: no uniform number is below a delivery probability."""


class Receiver(Protocol):
    """A receiver at the end of a link."""

    def in_time(self, envelope: Envelope) -> bool:
        """Return True if the message arrives in time."""

    def receive(self, envelope: Envelope) -> None:
        """Take a message that is in time."""


class DirectedLink:
    """One direction of a link, (sender, receiver): its receiver, its sampler and its count of
    messages; ``first`` is what is known of the first one. ``entity`` orders simultaneous arrivals.
    """

    def __init__(
        self,
        scenario: Scenario,
        first: Transmission,
        entity: int,
        receiver: Receiver,
        sampler: ChannelSampler,
    ) -> None:
        self.link, self.entity, self.sampler, self.receiver = first.link, entity, sampler, receiver
        self.first, link = first, first.link
        self.weight = scenario.weight(link[1], link[0])
        common = scenario.common_entries.get(link)
        self.has_nothing_to_tell = common is not None and not len(common[0])
        self.messages = 0


class Transmitter:
    """Sends and delivers all messages of a run; a message that takes time is an event."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        timeline: Timeline,
        recorder: Recorder,
        up: Callable[..., bool],
    ) -> None:
        """``up(*nodes)`` says whether one of some nodes is up now."""
        self.up = up
        self._scenario, self._streams = scenario, streams
        self._timeline, self._recorder = timeline, recorder
        self._channel = scenario.network.channel
        self._follows_distance = self._channel.loss.follows_distance
        self._alike = has_identical_links(self._channel)
        self._conditions = conditions_of(self._channel.loss, streams, scenario.horizon)
        self._airtime = Airtime(scenario, streams) if scenario.network.radio else None
        # What hearers share is drawn for each transmission of a sender.
        self.broadcasts = broadcasts_of(scenario, streams)
        self._clocks = node_times(scenario, streams)
        self._encoders = encoders(scenario, streams)
        # The last payload of each sender, as the filter made it and as it is received.
        self._encoded: dict[int, tuple[Any, Any]] = {}
        # Where the coordinates of a sender (id) begin at a time (seconds or slot), if they move
        # along with an input, and when its estimate is of.
        self.origin_at: Callable[[int, float], FloatArray] | None = None
        self.estimates_at: Callable[[int], float]
        # A slot that begins before the horizon is recorded to the end of its exchanges.
        self._horizon, self._until = scenario.horizon, scenario.horizon
        if scenario.slotted:
            self._until += scenario.slot_plant.period
        self._instant = scenario.time_grid.instant
        # Of nodes that move: who hears whom. Set when the true state of the run is known.
        self.reach: Reach | None = None
        # Payloads under way, by link and number, because a move of the origin shifts them.
        self._under_way: dict[tuple[Link, int], Envelope] = {}

    def sampler(self, link: Link) -> ChannelSampler:
        """Return the sampler of ``link``: of both directions if the channel is symmetric."""
        # The sampler makes its streams when it needs them, by purpose.
        return ChannelSampler(self._channel, link, partial(stream, self._streams, link))

    def first(self, link: Link) -> Transmission:
        """Return what is known of the first message on a directed link in this run."""
        return self._scenario.transmission(link)._replace(conditions=self._conditions)

    def begin(self, senders: Iterable[int], fresh: bool = True) -> None:
        """Begin another transmission of each of these ``senders``: draw what its hearers share;
        unless it is ``fresh`` they keep what they have.
        """
        for sender in senders:
            # The same payload takes other dither in another transmission.
            self._encoded.pop(sender, None)
            if self._airtime is not None:
                self._airtime.begin(sender)
        if self.broadcasts is not None:
            self.broadcasts.begin(senders, fresh)

    def occupy(self, sender: int) -> None:
        """Let the radio of ``sender`` send its broadcast, whether or not anybody is in range."""
        if self._airtime is not None:
            self._airtime.end(sender, self._scenario.message_size(sender, -1), self._timeline.now)

    def connects(self, i: int, j: int) -> bool:
        """Return True if nodes ``i`` and ``j`` (ids) can hear each other now."""
        return self.reach is None or self.reach.connects(i, j, self._timeline.now)

    def send(
        self,
        direction: DirectedLink,
        payload: Any,
        outcome: ChannelDraw,
        phase: int = -1,
        exchange: int = -1,
    ) -> None:
        """Send one message with its outcome: record it, and deliver it now, later or never. A
        payload of None is not sent. ``phase`` and ``exchange`` are -1 under clocks.
        """
        if payload is None or direction.has_nothing_to_tell:
            return
        now, (sender, receiver), number = self._timeline.now, direction.link, direction.messages
        direction.messages = number + 1
        append = self._recorder.append
        # Lost messages are numbered too: a recorded loss names a message by its number.
        append((now, SEND, sender, receiver, number, phase, NAN))
        # Lost ones take their dither too: what is drawn must not depend on what is heard.
        payload = self._encode(sender, payload, phase)
        if self.broadcasts is not None and outcome is not LINK_DOWN:
            outcome = self.broadcasts.over(sender, outcome)
        sent = direction.first
        if not self._alike:
            sent = sent._replace(number=number, time=now, bad=outcome.bad)
        if self._follows_distance and self.reach is not None:
            sent = sent._replace(distance=self.reach.distance(*direction.link, now))
        waits = 0.0
        if self._airtime is not None:
            if phase > 0:
                size = self._scenario.message_size(sender, phase)
                sent = sent._replace(size=size, frames=self._airtime.radio.frames(size))
            waits = self._airtime.end(sender, sent.size, now) - now
        # nan: the message is lost.
        delay = self._instant(waits + transit_time(self._channel, sent, outcome))
        if math.isnan(delay):
            append((now, LOST, sender, receiver, number, phase, NAN))
            return
        envelope = Envelope(sender, number, direction.weight, payload, now, exchange)
        # No event for a message without delay: it arrives inside the tick.
        if delay == 0.0:
            self._arrive(direction, phase, envelope, None)
        # A message that would arrive after the end is neither delivered nor lost.
        elif (arrival := self._instant(now + delay)) < self._until:
            # Delivery takes the envelope from this dictionary, since it may be shifted meanwhile.
            self._under_way[direction.link, number] = envelope
            callback = partial(self._arrive, direction, phase, envelope)
            self._timeline.call_at(arrival, Rank.DELIVER, direction.entity, callback)

    def _arrive(
        self, direction: DirectedLink, phase: int, envelope: Envelope, arrival: simpy.Event | None
    ) -> None:
        now, (sender, receiver) = self._timeline.now, direction.link
        # A message without delay arrives inside the tick, and keeps its age of 0.
        if arrival is not None:
            # The stored envelope may have been shifted since it was sent.
            envelope = self._under_way.pop((direction.link, envelope.number))
        age = self._instant(now - envelope.sent)
        if self._clocks:
            envelope = self._stamped(direction.link, envelope)
        else:
            envelope = envelope._replace(age=age)
        arrives_in_time = direction.receiver.in_time(envelope)
        # In slots what comes in time is recorded after the horizon too, as its exchange is.
        is_recorded = now < self._horizon or arrives_in_time
        if not self.up(receiver):
            if is_recorded:
                self._recorder.append((now, LOST, sender, receiver, envelope.number, phase, NAN))
            return
        if is_recorded:
            kind, number = DELIVER if arrives_in_time else LATE, envelope.number
            self._recorder.append((now, kind, receiver, sender, number, phase, age))
        if arrives_in_time:
            direction.receiver.receive(envelope)

    def _encode(self, sender: int, payload: Any, phase: int) -> Any:
        """Return what is received of a payload; all hearers of a transmission receive the same."""
        if not self._encoders:
            return payload
        if sender not in self._encoded or self._encoded[sender][0] is not payload:
            encoder, encoded = self._encoders[sender], payload
            if self.origin_at is None:
                encoded, clipped = encoder.encode(encoded)
            else:
                # The numbers of the message are those of absolute states.
                shift = self._scenario.node_filter.shift
                origin = self.origin_at(sender, self.estimates_at(sender))
                encoded, clipped = encoder.encode(shift(encoded, origin))
                encoded = shift(encoded, -origin)
            self._encoded[sender] = payload, encoded
            if clipped:
                row = (self._timeline.now, CLIP, sender, -1, clipped, phase, NAN)
                self._recorder.append(row)
        return self._encoded[sender][1]

    def _stamped(self, link: Link, envelope: Envelope) -> Envelope:
        """Return a message with the age that its stamp tells, up to the time since the start."""
        sender, receiver = (self._clocks[node] for node in link)
        now, stamp = receiver.shows(self._timeline.now), sender.shows(envelope.sent)
        age = min(max(self._instant(now - stamp), 0.0), self._instant(now - receiver.shows(0.0)))
        taken_for, payload = self._instant(now - age), envelope.payload
        if self.origin_at is not None and taken_for != stamp:
            # It is taken for one of another time than that which it is counted from.
            origin, other = (self.origin_at(link[0], time) for time in (stamp, taken_for))
            payload = self._scenario.node_filter.shift(payload, origin - other)
            if isinstance(payload, Payload):
                payload = payload.with_moved_reading(origin - other)
        return envelope._replace(age=age, payload=payload)

    def shift(self, algorithm: Filter, offset: FloatArray) -> None:
        """Shift all messages under way by ``offset`` (n,), predicted back to the time of sending,
        as the origin of coordinates has moved.
        """
        now = self._timeline.now
        for key, envelope in self._under_way.items():
            # A payload refers to the time of sending: predict the offset back to it.
            earlier = self._scenario.move_back(offset, now - envelope.sent)
            payload = algorithm.shift(envelope.payload, earlier)
            self._under_way[key] = envelope._replace(payload=payload)


class LinkExchange:
    """The directions of one link: a single one if the graph is directed, else both.

    In each activation every end sends to the other. Symmetric channels share one outcome.
    """

    def __init__(
        self,
        scenario: Scenario,
        transmitter: Transmitter,
        receivers: dict[int, Any],
        link: Link,
        entity: int,
    ) -> None:
        i, j = link
        self._transmitter, self._shared = transmitter, scenario.network.channel.symmetric
        # Outcomes of the last draw, for held links.
        self._outcomes: list[ChannelDraw] = []
        forth = transmitter.sampler((i, j))
        # Entities 2 k and 2 k + 1: the order in which simultaneous messages arrive.
        first = transmitter.first((i, j))
        self._directions = [DirectedLink(scenario, first, 2 * entity, receivers[j], forth)]
        if not scenario.topology.directed:
            back = forth if self._shared else transmitter.sampler((j, i))
            self._directions.append(
                DirectedLink(
                    scenario, transmitter.first((j, i)), 2 * entity + 1, receivers[i], back
                )
            )

    def exchange(
        self,
        payloads: tuple[Any, Any],
        phase: int = -1,
        exchange: int = -1,
        up: bool = True,
        fresh: bool = True,
    ) -> None:
        """Send the payloads of both ends, one message in each direction. All are lost if the link
        is not ``up``. Outcomes are drawn anew if ``fresh``, whether or not a payload is None.
        """
        if fresh or not self._outcomes:
            first, *others = self._directions
            # The first direction draws; with a symmetric channel its draw serves both.
            outcome_forth = first.sampler.draw()
            self._outcomes = [
                outcome_forth,
                *(
                    outcome_forth if self._shared else direction.sampler.draw()
                    for direction in others
                ),
            ]
        # Not strict: in a directed graph only the first end sends.
        for direction, payload, outcome in zip(
            self._directions, payloads, self._outcomes, strict=False
        ):
            self._transmitter.send(
                direction, payload, outcome if up else LINK_DOWN, phase, exchange
            )


def stream(streams: Streams, ends: tuple[int, ...], purpose: str) -> np.random.Generator:
    """Return the random stream for a ``purpose`` of a link with the node ids ``ends``."""
    return streams.generator(purpose, *ends)
