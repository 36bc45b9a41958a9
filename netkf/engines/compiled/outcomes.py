"""Outcomes of messages: which are lost, and how long the others take.

Those of built-in channels are drawn in compiled code, those of a user's in Python; the numbers are
those that the SimPy engine draws message by message.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.engines.compiled.moving_links import MovingLinks
from netkf.engines.compiled.senders import Senders
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.network.channels import (
    BroadcastDraw,
    Channel,
    ChannelSampler,
    broadcasts_of,
    conditions_of,
    draws_per_link,
)
from netkf.network.delays import (
    ConstantDelay,
    ExponentialDelay,
    LognormalDelay,
    NoDelay,
    UniformDelay,
    checked_delays,
    delay_depends_on_message,
)
from netkf.network.graphs import Link
from netkf.network.losses import (
    MESSAGE,
    Bernoulli,
    DistanceLoss,
    GilbertElliott,
    KernelLoss,
    Loss,
    NoLoss,
    PerLink,
    Transmission,
    demand_probability,
    identical_per_link,
    law_in_kernels,
)
from netkf.network.radio import Airtime
from netkf.network.scheduled import ScheduledLoss
from netkf.rng.draws import Ziggurat, next_exponential, next_unit, ziggurat
from netkf.rng.numbers import next_normal, normal_ziggurat
from netkf.rng.streams import WIDTH, Streams
from netkf.scenario.model import Network
from netkf.scenario.scenario import Scenario

LOST, OUT_OF_RANGE = -1.0, -2.0
"""Outcomes that are no delay: a message is lost, or not sent at all, since its ends are too far
apart.
"""
LOSSES = (NoLoss, Bernoulli, PerLink, DistanceLoss, GilbertElliott)
DELAYS = (NoDelay, ConstantDelay, ExponentialDelay, UniformDelay, LognormalDelay)
FIXED, EXPONENTIAL, UNIFORM, LOGNORMAL, LISTED = range(5)
"""Laws of delays; outcomes that are LISTED were drawn in Python."""
NUMBER = MESSAGE.index("number")


class DeliveryLaws(NamedTuple):
    """The law of a KernelLoss for the messages of R runs on W directions.

    address, settings : of the kernel (``linalg.functions``); 0: the law is a built-in one
    first : (W, M), the first message of each direction as the kernel knows it
    sent : (R W,), the number of messages so far
    message, out : (M,) and (1,), scratch
    wrong : (4,), direction, number, time and probability of a message, where that is none; -1 first
    """

    address: int
    settings: FloatArray
    first: FloatArray
    sent: IntArray
    message: FloatArray
    out: FloatArray
    wrong: FloatArray


class ChannelStreams(NamedTuple):
    """The losses and delays of the messages of R runs, on W directions, from S streams a run.

    source : (W,), stream of each direction, within a run
    per_run : S
    delivery : (2, W), delivery probabilities in the good and the bad state of the link
    delivery_laws : the delivery probabilities of a KernelLoss
    loss, state, delay : (R S, WIDTH), states of the random streams; (0, WIDTH): nothing is drawn
    bad : (R S,), state of each link (1: bad), -1 at first
    to_bad, to_good : transition probabilities of that state
    law, scale, width : law of the delays (FIXED, ...) and its parameters
    bits : whether outcomes are stored as arrival bits, see TickBuffer
    listed, following : LISTED outcomes, and the index (R W,) of the next one of each direction
    """

    source: IntArray
    per_run: int
    delivery: FloatArray
    delivery_laws: DeliveryLaws
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
    normal: Ziggurat
    listed: FloatArray
    following: IntArray


@kernel(inlined=True)
def draw_outcomes(
    channels: ChannelStreams,
    run: int,
    outgoing: IntArray,
    first: int,
    after: int,
    t: float,
    out: FloatArray,
    counts: IntArray,
) -> int:
    """Draw which messages of a tick at ``t`` seconds arrive on the directed links
    ``outgoing[first:after]``, and append their delays (seconds or LOST) to ``out`` at
    ``counts[1]``. Return the ``first_outcome`` of the tick, see TickBuffer.
    """
    outcome, uniform, bad, last = 0 if channels.bits else counts[1], 0.0, 0, -1
    delay = channels.scale
    # One draw for each stream: directions that share a stream are neighbours.
    for m in range(first, after):
        w = outgoing[m]
        if channels.law == LISTED:
            k = run * len(channels.source) + w
            delay = channels.listed[channels.following[k]]
            channels.following[k] += 1
            arrives = delay >= 0.0
        else:
            if channels.source[w] != last:
                last = channels.source[w]
                k = run * channels.per_run + last
                if len(channels.loss) > 0:
                    # Below 1, so that a link with probability 1 loses nothing.
                    uniform = next_unit(channels.loss, k)
                if len(channels.state) > 0:
                    bad = next_link_state(channels, k)
                if channels.law != FIXED:
                    delay = next_delay(channels, k)
            arrives = uniform < delivery_probability_of(channels, run, w, bad, t)
        if channels.bits:
            outcome |= np.int64(arrives) << (m - first)
        else:
            out[counts[1]] = delay if arrives or channels.law == LISTED else LOST
            counts[1] += 1
    return outcome


@kernel(inlined=True)
def delivery_probability_of(
    channels: ChannelStreams, run: int, w: int, bad: int, t: float
) -> float:
    """Return the delivery probability of the next message on direction ``w``, sent at ``t``."""
    if channels.delivery_laws.address == 0:
        return float(channels.delivery[bad, w])
    return _delivery_by_law(channels.delivery_laws, run, w, t)


@kernel
def _delivery_by_law(laws: DeliveryLaws, run: int, w: int, t: float) -> float:
    k, message = run * len(laws.first) + w, laws.message
    for i in range(len(message)):
        message[i] = laws.first[w, i]
    message[NUMBER], laws.out[0] = laws.sent[k], math.nan
    call_function(laws.address, message, laws.settings, t, 0.0, laws.out)
    probability = laws.out[0]
    if not 0.0 <= probability <= 1.0 and laws.wrong[0] < 0.0:
        laws.wrong[0], laws.wrong[1] = w, laws.sent[k]
        laws.wrong[2], laws.wrong[3] = t, probability
    laws.sent[k] += 1
    return float(probability)


@kernel
def next_link_state(channels: ChannelStreams, k: int) -> int:
    """Return the next state (1: bad, 0: good) of link ``k``, a two-state Markov chain
    (Gilbert-Elliott). The first one has the stationary law.
    """
    bad, u = channels.bad[k], next_unit(channels.state, k)
    to_bad, to_good = channels.to_bad, channels.to_good
    if bad < 0:
        bad = 1 if u < to_bad / (to_bad + to_good) else 0
    elif bad == 1:
        bad = 1 if u >= to_good else 0
    else:
        bad = 1 if u < to_bad else 0
    channels.bad[k] = bad
    return int(bad)


@kernel
def next_delay(channels: ChannelStreams, k: int) -> float:
    """Return the next random delay (seconds) of stream ``k``."""
    if channels.law == EXPONENTIAL:
        return channels.scale * next_exponential(channels.delay, k, channels.exponential)
    if channels.law == UNIFORM:
        return channels.scale + channels.width * next_unit(channels.delay, k)
    sigma = channels.width
    z = next_normal(channels.delay, k, channels.normal)
    return channels.scale * math.exp(sigma * (z - 0.5 * sigma))


def list_outcomes(
    scenario: Scenario,
    streams: Streams,
    senders: Senders,
    ticks: Sequence[FloatArray],
    moving: MovingLinks | None = None,
) -> list[FloatArray]:
    """Return the outcomes, seconds, LOST or OUT_OF_RANGE, of all messages of a user's channel, or
    between nodes that are ``moving``, on each direction of each run (R W), whose entities (R E)
    have these ``ticks`` in seconds.
    """
    channel, outcomes, entities = scenario.network.channel, [], len(senders.entities)
    for run, one in enumerate(streams.per_replica):
        of_run = [np.empty(0)] * len(senders.directions)
        conditions = conditions_of(channel.loss, one, scenario.horizon)
        own_ticks = ticks[run * entities : (run + 1) * entities]
        shared = _shared_draws(scenario, one, senders, own_ticks)
        waits = _waits(scenario, one, senders, own_ticks, moving and moving.heard)
        for e, times in enumerate(own_ticks):
            draws, last = (np.empty(0), np.empty(0), np.empty(0)), -1
            for w in senders.outgoing[senders.first[e] : senders.first[e + 1]].tolist():
                # Directions that share a stream share its draws.
                if senders.source[w] != last:
                    last = int(senders.source[w])
                    draws = sampler_of(channel, one, senders.sources[last]).draws(len(times))
                uniform, bad, delay = draws
                first = scenario.transmission(senders.directions[w])
                heard = slice(None) if moving is None else moving.heard[w]
                if (common := shared.get((e, first.link[0]))) is not None:
                    uniform = np.where(np.isnan(common.uniform), uniform, common.uniform)
                    bad = bad if common.bad is None else common.bad
                if moving is not None and scenario.links_move and channel.loss.follows_distance:
                    first = first._replace(distance=moving.distance[w][heard])
                sent = first._replace(
                    number=np.arange(len(times[heard])), time=times[heard], bad=bad[heard],
                    conditions=conditions,
                )  # fmt: skip
                of_run[w] = np.full(len(times), OUT_OF_RANGE)
                delays = message_delays(channel, sent, uniform[heard], delay[heard])
                if (wait := waits.get((e, first.link[0]))) is not None:
                    delays = np.where(delays >= 0.0, delays + wait[heard], LOST)
                of_run[w][heard] = delays
        outcomes += of_run
    return outcomes


def _transmissions(
    senders: Senders, ticks: Sequence[FloatArray]
) -> Iterator[tuple[int, IntArray, FloatArray]]:
    """Yield each node, and by which entity and when it transmits, (K,) each, in order."""
    entities_of: dict[int, set[int]] = {}
    for e in range(len(ticks)):
        for w in senders.outgoing[senders.first[e] : senders.first[e + 1]].tolist():
            entities_of.setdefault(senders.directions[w][0], set()).add(e)
    for node, entities in entities_of.items():
        times = [ticks[e] for e in sorted(entities)]
        owner = np.repeat(sorted(entities), [len(of_one) for of_one in times])
        # By (time, entity).
        order = np.lexsort((owner, np.concatenate(times)))
        yield node, owner[order], np.concatenate(times)[order]


def _shared_draws(
    scenario: Scenario, streams: Streams, senders: Senders, ticks: Sequence[FloatArray]
) -> dict[tuple[int, int], BroadcastDraw]:
    """Return what the hearers share of each tick of entity e, if anything, by (e, id of sender)."""
    broadcasts, shared = broadcasts_of(scenario, streams), {}
    if broadcasts is None:
        return {}
    for node, owner, times in _transmissions(senders, ticks):
        drawn = broadcasts.draws(node, len(times))
        for e in np.unique(owner).tolist():
            own = owner == e
            bad = None if drawn.bad is None else drawn.bad[own]
            shared[e, node] = BroadcastDraw(drawn.uniform[own], bad)
    return shared


def _waits(
    scenario: Scenario,
    streams: Streams,
    senders: Senders,
    ticks: Sequence[FloatArray],
    heard: Sequence[np.ndarray] | None,
) -> dict[tuple[int, int], FloatArray]:
    """Return the seconds on air at each tick of entity e, nan if dropped, by (e, id of sender)."""
    found: dict[tuple[int, int], FloatArray] = {}
    if not scenario.messages_queue or scenario.network.radio is None:
        return found
    airtime = Airtime(scenario, streams)
    for node, owner, times in _transmissions(senders, ticks):
        # A broadcast is sent even if nobody is in range.
        speaks = np.full(len(times), heard is None or senders.at in ("nodes", "readings"))
        for e in np.unique(owner).tolist():
            for w in senders.outgoing[senders.first[e] : senders.first[e + 1]].tolist():
                if heard is not None and senders.directions[w][0] == node:
                    speaks[owner == e] |= heard[w]
        waits = np.zeros(len(times))
        sizes = itertools.repeat(scenario.message_size(node, -1), int(speaks.sum()))
        waits[speaks] = airtime.waits(node, sizes, times[speaks])
        found |= {(e, node): waits[owner == e] for e in np.unique(owner).tolist()}
    return found


def sampler_of(channel: Channel, streams: Streams, ends: Link) -> ChannelSampler:
    """Return what draws the outcomes of the messages between two ``ends`` of one run."""
    return ChannelSampler(channel, ends, lambda purpose: streams.generator(purpose, *ends))


def message_delays(
    channel: Channel, sent: Transmission, uniform: FloatArray, delay: FloatArray
) -> FloatArray:
    """Return the outcomes (K,) of the messages ``sent`` on one link."""
    lost = uniform >= channel.deliveries(sent)
    if delay_depends_on_message(channel.delay):
        # A delay is asked only for messages that arrive.
        delay, k = delay.copy(), np.flatnonzero(~lost)
        distance = np.broadcast_to(sent.distance, lost.shape)[k]
        arriving = sent._replace(
            number=sent.number[k], time=sent.time[k], bad=sent.bad[k], distance=distance
        )
        delay[k] = checked_delays(channel.delay, arriving, delay[k])
    return np.where(lost, LOST, delay)


def unknown_outcomes(scenario: Scenario) -> str | None:
    """Return which outcomes ticks alone do not tell, since nodes may be silent at them; or None."""
    kernels = None if scenario.slotted else compiled_kernels(scenario.node_filter, clocked=True)
    if kernels is None or not kernels.decides:
        return None
    channel = scenario.network.channel
    follows_time = type(channel.loss) in (GilbertElliott, ScheduledLoss)
    is_known = follows_time or identical_per_link(channel.loss)
    if is_known and not (channel.channels or delay_depends_on_message(channel.delay)):
        return "a radio where nodes may be silent at a tick" if scenario.messages_queue else None
    return "outcomes by the number of a message where nodes may be silent at a tick"


def draws_in_kernels(network: Network) -> bool:
    """Return True if kernels can draw the outcomes of messages."""
    channel = network.channel
    # By exact type: a subclass may override the law.
    has_known_law = type(channel.loss) in LOSSES
    # Who is down sends nothing, and the messages of a KernelLoss are counted.
    has_known_law |= law_in_kernels(channel.loss) and not network.lives
    has_known_law &= type(channel.delay) in DELAYS
    return has_known_law and network.radio is None and draws_per_link(channel)


def delay_is_zero(channel: Channel) -> bool:
    """Return True if no message takes time."""
    delay = channel.delay
    return delay.fixed == 0.0 and not delay.is_random and not delay_depends_on_message(delay)


def channel_streams(
    channel: Channel,
    streams: Streams,
    senders: Senders,
    delivery: FloatArray,
    bits: bool = False,
    listed: Sequence[FloatArray] = (),
    first: Sequence[Transmission] = (),
) -> ChannelStreams:
    """Return the losses and delays of all runs, before anything is drawn. ``bits``: outcomes are
    arrival bits. ``first``: the first message of each direction, where the loss is a KernelLoss
    whose kernel is called for each. ``listed``: outcomes of a user's channel, by direction and run.
    """
    none: np.ndarray = np.empty((0, WIDTH), dtype=np.uint64)
    loss, delay = channel.loss, channel.delay
    chain = loss.chain if isinstance(loss, GilbertElliott) else None
    to_bad, to_good = (chain.to_bad, chain.to_good) if chain is not None else (0.0, 1.0)
    law, scale, width = FIXED, float(delay.fixed or 0.0), 0.0
    if listed:
        law = LISTED
    elif isinstance(delay, ExponentialDelay):
        law, scale = EXPONENTIAL, delay.mean
    elif isinstance(delay, UniformDelay):
        law, scale, width = UNIFORM, delay.low, delay.high - delay.low
    elif isinstance(delay, LognormalDelay):
        law, scale, width = LOGNORMAL, delay.mean, delay.sigma
    sources = senders.sources
    return ChannelStreams(
        source=senders.source,
        per_run=len(sources),
        delivery=delivery,
        delivery_laws=_delivery_laws(loss, first, streams.runs),
        loss=none if listed or loss.deterministic else streams.states("loss", sources),
        state=streams.states("weather", sources) if loss.stateful and not listed else none,
        delay=streams.states("delay", sources) if delay.is_random and not listed else none,
        bad=np.full(len(sources) * streams.runs, -1, dtype=np.int64),
        to_bad=to_bad,
        to_good=to_good,
        law=law,
        scale=scale,
        width=width,
        bits=bits,
        exponential=ziggurat(),
        normal=normal_ziggurat(),
        listed=np.concatenate([np.empty(0), *listed]),
        following=np.cumsum([0, *map(len, listed)], dtype=np.int64)[:-1],
    )


def _delivery_laws(loss: Loss, first: Sequence[Transmission], runs: int) -> DeliveryLaws:
    address, settings, messages = 0, np.zeros(0), np.zeros((0, len(MESSAGE)))
    if first:
        assert isinstance(loss, KernelLoss)
        address, settings = loss.kernel_call()
        messages = np.concatenate([loss.describe(sent) for sent in first])
    return DeliveryLaws(
        address=address,
        settings=settings,
        first=messages,
        sent=np.zeros(len(messages) * runs, dtype=np.int64),
        message=np.zeros(len(MESSAGE)),
        out=np.zeros(1),
        wrong=np.full(4, -1.0),
    )


def demand_probabilities(loss: Loss, channels: ChannelStreams, directions: Sequence[Link]) -> None:
    """Raise ScenarioError if a KernelLoss gave a message a probability outside [0, 1]."""
    w, number, time, value = channels.delivery_laws.wrong.tolist()
    if w >= 0.0:
        sent = Transmission(directions[int(w)], number=int(number), time=time)
        demand_probability(loss, sent, np.array(value))


def delivery_table(scenario: Scenario, loss: Loss, directions: Sequence[Link]) -> FloatArray:
    """Return the delivery probabilities (2, W) of each direction in a good and a bad state."""
    # By exact type: a subclass may override the law.
    is_common = type(loss) in (NoLoss, Bernoulli)
    first = [scenario.transmission(w) for w in (directions[:1] if is_common else directions)]
    table = [
        [float(loss.delivery_probability(sent._replace(bad=bad))) for sent in first]
        for bad in (False, True)
    ]
    return np.array(np.broadcast_to(np.array(table), (2, len(directions))))
