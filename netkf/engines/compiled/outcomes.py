"""Outcomes of messages: which are lost, and how long the others take.

Those of built-in channels are drawn in compiled code, those of a user's in Python; the numbers are
those that the SimPy engine draws message by message.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.senders import Senders, senders_of
from netkf.engines.compiled.slot_messages import next_state
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.network.channels import (
    Bernoulli,
    Channel,
    ChannelSampler,
    ConstantDelay,
    ExponentialDelay,
    GilbertElliott,
    LognormalDelay,
    NoDelay,
    NoLoss,
    PerLink,
    UniformDelay,
    checked_delay,
    delay_depends_on_message,
    delivery_probabilities,
)
from netkf.network.graphs import Link
from netkf.rng.draws import Ziggurat, next_exponential, next_unit, ziggurat
from netkf.rng.numbers import NormalZiggurat, next_normal, normal_ziggurat
from netkf.rng.streams import WIDTH, ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario

LOST = -1.0  # no delay is negative
LOSSES = (NoLoss, Bernoulli, PerLink, GilbertElliott)
DELAYS = (NoDelay, ConstantDelay, ExponentialDelay, UniformDelay, LognormalDelay)
FIXED, EXPONENTIAL, UNIFORM, LOGNORMAL = range(4)
"""Laws of delays."""


class ChannelStreams(NamedTuple):
    """The losses and delays of the messages of R runs, on W directions, from S streams a run.

    source : (W,), stream of each direction, within a run
    per_run : S
    delivery : (2, W), delivery probabilities in the good and the bad state of the link
    loss, state, delay : (R S, WIDTH), states of the random streams; (0, WIDTH): nothing is drawn
    bad : (R S,), state of each link (1: bad), -1 at first
    to_bad, to_good : transition probabilities of that state
    law, scale, width : law of the delays (FIXED, ...) and its parameters
    bits : whether outcomes are stored as arrival bits, see TickBuffer
    """

    source: IntArray
    per_run: int
    delivery: FloatArray
    loss: np.ndarray
    state: np.ndarray
    delay: np.ndarray
    bad: IntArray
    to_bad: float
    to_good: float
    law: int
    scale: float
    width: float
    bits: bool
    exponential: Ziggurat
    normal: NormalZiggurat


@kernel(inlined=True)
def draw_outcomes(
    channels: ChannelStreams,
    run: int,
    outgoing: IntArray,
    first: int,
    after: int,
    out: FloatArray,
    counts: IntArray,
) -> int:
    """Draw which messages of a tick arrive in run number ``run``, on the directed links
    ``outgoing[first:after]``, and append their delays (seconds or LOST) to ``out`` at
    ``counts[1]``, which advances. Return the ``first_outcome`` of the tick: where its outcomes
    begin, or, with ``channels.bits``, a bit for each message that arrives instead of outcomes.
    """
    outcome, uniform, bad, last = 0 if channels.bits else counts[1], 0.0, 0, -1
    delay = channels.scale
    # One draw for each stream: directions that share a stream are neighbours.
    for m in range(first, after):
        w = outgoing[m]
        if channels.source[w] != last:
            last = channels.source[w]
            k = run * channels.per_run + last
            if len(channels.loss) > 0:
                # Below 1, so that a link with probability 1 loses nothing.
                uniform = next_unit(channels.loss, k)
            if len(channels.state) > 0:
                u = next_unit(channels.state, k)
                bad = next_state(channels.bad[k], u, channels.to_bad, channels.to_good)
                channels.bad[k] = bad
            if channels.law != FIXED:
                delay = draw_delay(channels, k)
        arrives = uniform < channels.delivery[bad, w]
        if channels.bits:
            outcome |= np.int64(arrives) << (m - first)
        else:
            out[counts[1]] = delay if arrives else LOST
            counts[1] += 1
    return outcome


@kernel
def draw_delay(channels: ChannelStreams, k: int) -> float:
    """Return the next random delay (seconds) of stream ``k``."""
    if channels.law == EXPONENTIAL:
        return channels.scale * next_exponential(channels.delay, k, channels.exponential)
    if channels.law == UNIFORM:
        return channels.scale + channels.width * next_unit(channels.delay, k)
    sigma = channels.width
    z = next_normal(channels.delay, k, channels.normal)
    return channels.scale * math.exp(sigma * (z - 0.5 * sigma))


@kernel(allocates=True)
def fill_outcomes(
    channels: ChannelStreams,
    first: IntArray,
    outgoing: IntArray,
    indices: IntArray,
    counts: IntArray,
    out: FloatArray,
) -> None:
    """Write the outcomes of the next ``counts[m]`` ticks of the entity ``indices[m]``, over all
    runs, into ``out``, for each m in turn; an entity e of a run sends on the directions
    ``outgoing[first[e]:first[e + 1]]``.
    """
    entities, done = len(first) - 1, np.zeros(2, dtype=np.int64)
    for m in range(len(indices)):
        run, e = indices[m] // entities, indices[m] % entities
        for _ in range(counts[m]):
            draw_outcomes(channels, run, outgoing, first[e], first[e + 1], out, done)


class Outcomes(Protocol):
    """A source of the outcomes of messages of R runs; ``sizes`` (R E,) is the number of messages
    that each entity sends at a tick.
    """

    sizes: IntArray

    def of(self, indices: IntArray, counts: IntArray, first: IntArray) -> FloatArray:
        """Return the outcomes (K,) of the next ``counts`` (M,) ticks of M entities with the
        ``indices`` (M,), over all runs, entity by entity and tick after tick: delays in seconds, or
        LOST. ``first`` (M,) are the numbers of their first ticks, from 0.
        """


def outcomes_of(
    scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
) -> Outcomes:
    """Return the source of outcomes of a scenario, which has the ``senders``."""
    built_in = is_kernel_channel(scenario.network.channel)
    return (KernelOutcomes if built_in else PythonOutcomes)(scenario, streams, senders)


class KernelOutcomes:
    """Outcomes of built-in channels."""

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        self._channels = channel_streams(scenario, streams, senders)
        self._senders = senders
        self.sizes = np.tile(np.diff(senders.first), streams.runs)

    def of(self, indices: IntArray, counts: IntArray, first: IntArray) -> FloatArray:
        """Return the outcomes (K,) of the next ticks, see Outcomes."""
        senders, out = self._senders, np.empty(int((counts * self.sizes[indices]).sum()))
        fill_outcomes(self._channels, senders.first, senders.outgoing, indices, counts, out)
        return out


class PythonOutcomes:
    """Outcomes of a user's channels."""

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        self._channel, self._senders = scenario.network.channel, senders
        self._table = [scenario.table_probability(link) for link in senders.directions]
        self._samplers = [
            ChannelSampler(self._channel, partial(_stream, one, source))
            for one in streams.per_replica
            for source in senders.sources
        ]
        self.sizes = np.tile(np.diff(senders.first), streams.runs)

    def of(self, indices: IntArray, counts: IntArray, first: IntArray) -> FloatArray:
        """Return the outcomes (K,) of the next ticks, see Outcomes."""
        senders, parts = self._senders, [np.empty(0)]
        for index, count, number in zip(
            indices.tolist(), counts.tolist(), first.tolist(), strict=True
        ):
            run, e = divmod(index, len(senders.entities))
            directions = senders.outgoing[senders.first[e] : senders.first[e + 1]].tolist()
            columns, draws, last = [], None, -1
            for w in directions:
                # Directions that share a stream share its draws.
                source = run * len(senders.sources) + int(senders.source[w])
                if draws is None or source != last:
                    draws, last = self._samplers[source].draws(count), source
                columns.append(self._delays(w, number, *draws))
            if columns:
                parts.append(np.stack(columns, axis=1).ravel())
        return np.concatenate(parts)

    def _delays(
        self, w: int, number: int, uniform: FloatArray, bad: np.ndarray, delay: FloatArray
    ) -> FloatArray:
        """Return the outcomes (K,) of the messages on direction ``w``, numbered from ``number``."""
        channel, link = self._channel, self._senders.directions[w]
        probability = delivery_probabilities(channel.loss, link, number, bad, self._table[w])
        lost = uniform >= probability
        if delay_depends_on_message(channel.delay):
            delay = delay.copy()
            # A delay is asked only for messages that arrive.
            for k in np.flatnonzero(~lost).tolist():
                delay[k] = checked_delay(channel.delay, link, number + k, float(delay[k]))
        return np.where(lost, LOST, delay)


def _stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    """Return the random generator of a purpose for one directed link."""
    return streams.generator(purpose, *ends)


def is_kernel_channel(channel: Channel) -> bool:
    """Return True if kernels can draw the outcomes of a channel."""
    # By exact type: a subclass may override the law.
    return type(channel.loss) in LOSSES and type(channel.delay) in DELAYS


def delay_is_zero(channel: Channel) -> bool:
    """Return True if no message takes time."""
    delay = channel.delay
    return delay.fixed == 0.0 and not delay.is_random and not delay_depends_on_message(delay)


def channel_streams(
    scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders, bits: bool = False
) -> ChannelStreams:
    """Return the losses and delays of all runs, before anything is drawn. ``bits``: outcomes are
    arrival bits.
    """
    channel = scenario.network.channel
    none: np.ndarray = np.empty((0, WIDTH), dtype=np.uint64)
    loss, delay = channel.loss, channel.delay
    to_bad, to_good = loss.transitions if isinstance(loss, GilbertElliott) else (0.0, 1.0)
    law, scale, width = FIXED, float(delay.fixed or 0.0), 0.0
    if isinstance(delay, ExponentialDelay):
        law, scale = EXPONENTIAL, delay.mean
    elif isinstance(delay, UniformDelay):
        law, scale, width = UNIFORM, delay.low, delay.high - delay.low
    elif isinstance(delay, LognormalDelay):
        law, scale, width = LOGNORMAL, delay.mean, delay.sigma
    sources = senders.sources
    return ChannelStreams(
        source=senders.source,
        per_run=len(sources),
        delivery=_delivery_table(scenario),
        loss=none if loss.deterministic else streams.states("loss", sources),
        state=streams.states("weather", sources) if loss.stateful else none,
        delay=streams.states("delay", sources) if delay.is_random else none,
        bad=np.full(len(sources) * streams.runs, -1, dtype=np.int64),
        to_bad=to_bad,
        to_good=to_good,
        law=law,
        scale=scale,
        width=width,
        bits=bits,
        exponential=ziggurat(),
        normal=normal_ziggurat(),
    )


@once_per_scenario
def _delivery_table(scenario: Scenario) -> FloatArray:
    """Return the delivery probabilities (2, W) of each direction in a good and a bad state."""
    loss = scenario.network.channel.loss
    table = [
        [
            loss.delivery_probability(direction, 0, bad, scenario.table_probability(direction))
            for direction in senders_of(scenario).directions
        ]
        for bad in (False, True)
    ]
    return np.array(table)
