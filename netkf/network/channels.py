"""Channels: a loss and a delay model together, and the sampling of both for one link."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.fields import Component, boolean, field, instance_of
from netkf.linalg.arrays import FloatArray
from netkf.network.delays import (
    Delay,
    NoDelay,
    checked_delay,
    delay_depends_on_message,
    draw_delays,
)
from netkf.network.graphs import Link, Topology
from netkf.network.losses import (
    GilbertElliott,
    Loss,
    NoLoss,
    Transmission,
    checked_delivery_probability,
    delivery_probabilities,
    has_conditions,
    identical_per_link,
    next_state,
    stated_delivery,
)
from netkf.network.scheduled import Hopping
from netkf.rng.streams import Generators, Streams


@dataclass(frozen=True, eq=False)
class Channel(Component):
    """The loss and the delay model of all messages.

    loss       which messages are lost
    delay      how long the others take
    symmetric  both messages of an activation share one fate; false: each direction has its own
    channels   the channels over which messages hop, and a table of how well each delivers

    If symmetric, the two messages of one activation share one draw of each model: with equal
    probabilities both arrive or none, and both take the same random delay. Otherwise each direction
    has draws of its own. A link of a directed graph is a single direction.
    """

    loss: Loss = field(instance_of(Loss), default=NoLoss())
    delay: Delay = field(instance_of(Delay), default=NoDelay())
    symmetric: bool = field(boolean, default=True)
    channels: Hopping | None = field(instance_of(Hopping), default=None)

    @property
    def draws_for_senders(self) -> bool:
        """True if all hearers of a broadcast share a number or a state that is drawn for it."""
        return self.loss.fate_share > 0.0 or self.loss.state_of == "sender"

    @property
    def independent(self) -> bool:
        """True if the outcomes of different activations are independent, with one law."""
        return self.loss.independent and self.channels is None

    def mean_delivery(self, sent: Transmission, horizon: float) -> float:
        """Return the fraction of messages that arrive in the long run on the link of ``sent``, its
        message 0 at time 0, in a run of ``horizon`` seconds; nan if it is unknown before.
        """
        if sent.frames > 1 and (self.loss.stateful or self.channels is not None):
            return math.nan
        factor = 1.0 if self.channels is None else self.channels.mean(sent.link)
        mean: float = (stated_delivery(self.loss, sent, horizon) * factor) ** sent.frames
        return mean

    def deliveries(self, sent: Transmission) -> FloatArray:
        """Return the probabilities (K,) that K messages ``sent`` on one link arrive."""
        values = delivery_probabilities(self.loss, sent)
        if self.channels is not None:
            values = values * self.channels.delivery(sent)
        # With one number: all of k independent frames arrive with the k-th power.
        return values if sent.frames == 1 else np.asarray(values**sent.frames)


class BroadcastDraw(NamedTuple):
    """What all hearers of one broadcast share: a ``uniform`` number, nan if each has its own, and
    the state of the sender, None if each link has its own. Of many broadcasts they are arrays.
    """

    uniform: Any
    bad: Any

    def over(self, draw: ChannelDraw) -> ChannelDraw:
        """Return the numbers of one link for this broadcast, from its own ``draw``."""
        if not math.isnan(self.uniform):
            draw = draw._replace(uniform=self.uniform)
        return draw if self.bad is None else draw._replace(bad=self.bad)


class BroadcastSampler:
    """Draws what hearers of a sender share, broadcast by broadcast, for a ``link`` of the sender.
    ``generator`` makes the streams "broadcast" and "weather" of the sender, if several hear.
    """

    def __init__(self, loss: Loss, link: Link, several: bool, generator: Generators) -> None:
        self._loss, self._link = loss, link
        self._bad: bool | None = None
        self._random = generator("broadcast") if several and loss.fate_share > 0.0 else None
        of_sender = loss.stateful and loss.state_of == "sender"
        self._switching = generator("weather") if of_sender else None

    def draw(self) -> BroadcastDraw:
        """Return what the hearers of the next broadcast share."""
        uniform, bad = self.draws(1)
        return BroadcastDraw(float(uniform[0]), None if bad is None else bool(bad[0]))

    def draws(self, count: int) -> BroadcastDraw:
        """Return what the hearers of each of the next ``count`` broadcasts share, (count,) each."""
        uniform, bad = np.full(count, np.nan), None
        if self._random is not None:
            # Two numbers for each, whether or not the fate is shared.
            numbers = self._random.random((count, 2))
            uniform = np.where(numbers[:, 0] < self._loss.fate_share, numbers[:, 1], np.nan)
        if self._switching is not None:
            bad = np.zeros(count, dtype=bool)
            for k in range(count):
                self._bad = bad[k] = next_state(self._loss, self._link, self._bad, self._switching)
        return BroadcastDraw(uniform, bad)


def draws_per_link(channel: Channel) -> bool:
    """Return True if each link has draws of its own, with one law for all."""
    loss = channel.loss
    one_chain = not isinstance(loss, GilbertElliott) or loss.path is None
    return one_chain and channel.channels is None and not channel.draws_for_senders


def has_identical_links(channel: Channel) -> bool:
    """Return True if losses and delays depend on no number, time or state."""
    one_law = identical_per_link(channel.loss) and channel.channels is None
    return one_law and not delay_depends_on_message(channel.delay)


class ChannelDraw(NamedTuple):
    """The random numbers of one activation of a link or direction.

    ``uniform`` lies in [0, 1), ``bad`` is the state of the link and ``delay`` is in seconds.
    """

    uniform: float
    bad: bool
    delay: float


class Broadcasts:
    """What hearers share of the broadcasts of all nodes in one run: of each the last one.

    ``several``: a broadcast may have more than one hearer. ``generator`` makes a stream from a
    purpose and the id of a sender.
    """

    def __init__(
        self,
        channel: Channel,
        topology: Topology,
        several: bool,
        generator: Callable[[str, int], np.random.Generator],
    ) -> None:
        links = {link[0]: link for link in topology.directions}
        self._samplers = {
            sender: BroadcastSampler(channel.loss, link, several, _of_sender(generator, sender))
            for sender, link in links.items()
        }
        self._last: dict[int, BroadcastDraw] = {}

    def begin(self, senders: Iterable[int], fresh: bool = True) -> None:
        """Draw the next broadcast of ``senders``, or unless ``fresh`` keep the last one."""
        for sender in senders:
            if sender in self._samplers and (fresh or sender not in self._last):
                self._last[sender] = self._samplers[sender].draw()

    def draws(self, sender: int, count: int) -> BroadcastDraw:
        """Return the next ``count`` broadcasts of a sender, (count,) each."""
        return self._samplers[sender].draws(count)

    def over(self, sender: int, draw: ChannelDraw) -> ChannelDraw:
        """Return the numbers of one link for the last broadcast, from its own ``draw``."""
        return self._last[sender].over(draw)


def _of_sender(generator: Callable[[str, int], np.random.Generator], sender: int) -> Generators:
    return lambda purpose: generator(purpose, sender)


def senders_of_pairs(pairs: Iterable[Link], directed: bool) -> set[int]:
    """Return the ids of the nodes that send over these links in a step of an exchange."""
    return {node for link in pairs for node in (link[:1] if directed else link)}


def broadcasts_of(scenario: Any, streams: Streams) -> Broadcasts | None:
    """Return the broadcasts of a run of a scenario, None if hearers share nothing."""
    channel = scenario.network.channel
    if not channel.draws_for_senders:
        return None
    return Broadcasts(channel, scenario.topology, scenario.has_broadcasts, streams.generator)


class ChannelSampler:
    """Draws the outcomes of one link (symmetric channel) or direction, activation by activation.

    ``generator`` makes the streams "loss", "weather" and "delay" of that link or direction; it is
    called only for the streams that the channel draws from.
    """

    def __init__(self, channel: Channel, link: Link, generator: Generators) -> None:
        """Make a stream of ``generator(purpose)`` for each purpose, so that losses, states and
        delays do not depend on each other's number of draws.
        """
        self._loss, self._delay, self._link = channel.loss, channel.delay, link
        self._fixed_delay = channel.delay.fixed or 0.0
        self._bad: bool | None = None
        streams = {purpose: generator(purpose) for purpose in stream_purposes(channel)}
        self._loss_random = streams.get("loss")
        self._switching = streams.get("weather")
        self._delay_random = streams.get("delay")

    def draw(self) -> ChannelDraw:
        """Return the numbers of the next activation; a fixed delay is itself, or 0."""
        uniform, bad, delay = self.draws(1)
        return ChannelDraw(float(uniform[0]), bool(bad[0]), float(delay[0]))

    def draws(self, count: int) -> tuple[FloatArray, np.ndarray, FloatArray]:
        """Return uniforms, states (True: bad) and delays (s) of ``count`` activations, (count,)."""
        uniform, bad = np.zeros(count), np.zeros(count, dtype=bool)
        if self._loss_random is not None:
            uniform = self._loss_random.random(count)
        if self._switching is not None:
            for k in range(count):
                self._bad = bad[k] = next_state(self._loss, self._link, self._bad, self._switching)
        if self._delay_random is None:
            return uniform, bad, np.full(count, self._fixed_delay)
        return uniform, bad, draw_delays(self._delay, self._delay_random, count)


def stream_purposes(channel: Channel) -> tuple[str, ...]:
    """Return the purposes of the random streams that a ChannelSampler of this channel asks for."""
    purposes: list[str] = []
    if not channel.loss.deterministic or channel.channels is not None:
        purposes.append("loss")
    if channel.loss.stateful and channel.loss.state_of == "link":
        purposes.append("weather")
    if channel.delay.is_random:
        purposes.append("delay")
    return tuple(purposes)


def conditions_of(loss: Loss, streams: Streams, horizon: float) -> Any:
    """Return the conditions that the loss draws for the run of ``streams``, if it does."""
    if not has_conditions(loss):
        return None
    return loss.conditions(streams.generator("conditions"), horizon)


def transit_time(channel: Channel, sent: Transmission, draw: ChannelDraw) -> float:
    """Return the seconds that ``sent`` takes by its ``draw``, nan if lost; raises ScenarioError for
    a probability outside [0, 1] and a negative delay.
    """
    delivery = checked_delivery_probability(channel.loss, sent)
    if channel.channels is not None:
        delivery *= channel.channels.delivery(sent)
    if draw.uniform >= delivery**sent.frames:
        return math.nan
    return checked_delay(channel.delay, sent, draw.delay)
