"""Losses, delays and clocks with one breach each, and what their checkers must say."""

import math
import random as global_random
from dataclasses import dataclass

import numpy as np

from netkf.core.laws import Chain
from netkf.network.clocks import LinkClock, Periodic, Poisson, Renewal
from netkf.network.delays import ConstantDelay, Delay, ExponentialDelay
from netkf.network.losses import Bernoulli, GilbertElliott, Loss

CHANNELS, CLOCKS = {}, {}


def says(table, words, **settings):
    def keep(cls):
        made = dataclass(frozen=True, eq=False)(cls)
        table[made.__name__] = (made, settings, words)
        return made

    return keep


@says(CHANNELS, "TooSure.delivery_probability: must be a number from 0 to 1 for message 0; got 1.2")
class TooSure(Loss):
    def delivery_probability(self, sent):
        return 1.2


@says(
    CHANNELS, "Falling.delivery_probability: must be a number from 0 to 1 at the distance 10; got"
)
class Falling(Loss):
    follows_distance = True

    def delivery_probability(self, sent):
        return 1.0 - sent.distance


@says(CHANNELS, "Lossier.mean_delivery: must be the delivered fraction", delivery=0.5)
class Lossier(Bernoulli):
    def delivery_probability(self, sent):
        return self.delivery - 0.02

    def mean_delivery(self, sent):
        return self.delivery


@says(CHANNELS, "Bursty.independent: must be False", mean_loss=0.2, mean_burst=5.0)
class Bursty(GilbertElliott):
    @property
    def independent(self):
        return True


@says(
    CHANNELS,
    "HalfSure.delivery_probability: must be 0 or 1 where the loss is deterministic",
    delivery=0.5,
)
class HalfSure(Bernoulli):
    @property
    def deterministic(self):
        return True


@says(CHANNELS, "Fickle.next_state (tests/testing/broken_channels.py", delivery=0.5)
class Fickle(Bernoulli):
    def next_state(self, link, bad, random):
        return random.random() < 0.5


@says(CHANNELS, "Denies.next_state: must draw nothing where stateful is False", delivery=0.5)
class Denies(Bernoulli):
    stateful = False

    def next_state(self, link, bad, random):
        return random.random() < 0.5


@says(
    CHANNELS,
    "Lazy.next_state: must draw the same at each activation",
    mean_loss=0.2,
    mean_burst=5.0,
)
class Lazy(GilbertElliott):
    def next_state(self, link, bad, random):
        if not bad:
            return bool(random.random() < 0.3)
        return super().next_state(link, random.random() < 2, random)


@says(CHANNELS, "OwnLuck.delivery_probability: must return the same for the same arguments")
class OwnLuck(Loss):
    def delivery_probability(self, sent):
        return float(np.random.default_rng().random())


@says(CHANNELS, "Backwards.draw: must be a finite number of at least 0 seconds; got -")
class Backwards(Delay):
    def draw(self, random):
        return random.normal()


@says(CHANNELS, "Redraws.draw: must draw the same for each message")
class Redraws(Delay):
    def draw(self, random):
        while (seconds := random.normal()) < 0.0:
            pass
        return seconds


@says(CHANNELS, "Mistaken.fixed: must be what draw returns, or None; got 0.1 for 0.2")
class Mistaken(Delay):
    @property
    def fixed(self):
        return 0.1

    def draw(self, random):
        return 0.2


@says(CHANNELS, "Seeds.draw: must not use or seed global generators")
class Seeds(Delay):
    def draw(self, random):
        return global_random.random()


@says(CHANNELS, "Hidden.draw: must use no generator but the one it is given")
class Hidden(Delay):
    def draw(self, random):
        return float(np.random.default_rng().random())


@says(
    CHANNELS,
    "AllAsTheFirst.delivery_probability: must give many messages the probabilities of each",
)
class AllAsTheFirst(Loss):
    vectorised = True

    def delivery_probability(self, sent):
        return np.full(np.shape(sent.number), 1.0 / (1.0 + np.ravel(sent.number)[0]))[()]


@says(CHANNELS, "AllSlow.message_delay: must give many messages the delays of each")
class AllSlow(Delay):
    vectorised = True
    is_random = False

    def draw(self, random):
        return 0.0

    def message_delay(self, sent, drawn):
        return drawn + 0.1 * float(np.max(sent.number) > 5)


@says(CLOCKS, "Halting.ticks: times must be above 0 and increase")
class Halting(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        return now + np.arange(count, dtype=float)


@says(CLOCKS, "Blocky.ticks: must not depend on the size of the blocks", rate=2.0)
class Blocky(Poisson):
    def ticks(self, link, origin, index, now, random, count):
        return now + np.cumsum(random.standard_exponential(count + 1)[1:])


@says(CLOCKS, "Boastful.mean_rate: must be the mean ticks per second", rate=2.0)
class Boastful(Poisson):
    def mean_rate(self, link):
        return 1.03 * self.rate

    def ticks(self, link, origin, index, now, random, count):
        return (
            now + np.cumsum(random.standard_exponential(count)) / self.rate
            if count == 1
            else (np.add.accumulate([now, *(random.standard_exponential(count) / self.rate)])[1:])
        )


@says(CLOCKS, "Forgetful.memoryless: must be False where ticks are no Poisson process")
class Forgetful(LinkClock):
    @property
    def memoryless(self):
        return True

    def ticks(self, link, origin, index, now, random, count):
        return np.add.accumulate([now, *(0.5 + 0.1 * random.random(count))])[1:]


@says(CLOCKS, "OwnClock.ticks: must use no generator but the one it is given")
class OwnClock(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        return np.add.accumulate([now, *np.random.default_rng().random(count)])[1:]


@says(CLOCKS, "OwnPhase.origin: must use no generator but the one it is given")
class OwnPhase(LinkClock):
    def origin(self, link, random):
        return float(np.random.default_rng().random())

    def ticks(self, link, origin, index, now, random, count):
        return origin + np.arange(index + 1.0, index + 1.0 + count)


@says(CLOCKS, "Endless.ticks: must be at most 600 times; got 601")
class Endless(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        return np.arange(index + 1.0, index + 2.0 + count)


@says(CLOCKS, "Whole.ticks: must be a vector of float64; got int64 (600,)")
class Whole(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        return np.arange(index + 1, index + 1 + count)


@says(CLOCKS, "Wakes.ticks: an empty block means stopped for good")
class Wakes(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        gaps = random.random(count)
        return np.add.accumulate([now, *gaps])[1:] if gaps[0] > 0.5 or count > 1 else np.empty(0)


@says(CLOCKS, "Late.ticks: must be finite")
class Late(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        return np.array([1.0, math.inf])


NUMBERS = {}


@says(CHANNELS, "SameWeather.conditions: must draw the same in each run; got 9 x exp")
class SameWeather(Loss):
    """The weather of the first run is that of all."""

    def conditions(self, random, horizon):
        if "weather" not in NUMBERS:
            NUMBERS["weather"] = np.cumsum(random.exponential(horizon / 5.0, 9))
        return NUMBERS["weather"]

    def delivery_probability(self, sent):
        return 0.5 + 0.5 * (np.searchsorted(sent.conditions, sent.time) % 2)


@says(CHANNELS, "OtherChain.mean_delivery: must be the delivered fraction")
class OtherChain(Loss):
    """Makes other steps than it states, and states nothing else."""

    stateful = True
    chain = Chain(to_bad=0.1, to_good=0.5, deliver_good=1.0, deliver_bad=0.2)

    def next_state(self, link, bad, random):
        return bool(random.random() < 0.3)

    def delivery_probability(self, sent):
        return 0.2 if sent.bad else 1.0


@says(CHANNELS, "OneWorse.delivery_probability: must be the same for links with eq", delivery=0.8)
class OneWorse(Bernoulli):
    def delivery_probability(self, sent):
        return 0.75 if sent.link == (2, 3) else self.delivery


@says(CHANNELS, "BackWorse.mean_delivery: must be the delivered fraction", delivery=0.8)
class BackWorse(Bernoulli):
    """One direction loses more than it says."""

    def delivery_probability(self, sent):
        return 0.77 if sent.link == (3, 1) else self.delivery

    def mean_delivery(self, sent):
        return self.delivery


@says(CHANNELS, "Slightly.mean_delivery: must be the delivered fraction", delivery=0.8)
class Slightly(Bernoulli):
    """All links lose one percent more than they say."""

    def delivery_probability(self, sent):
        return self.delivery - 0.01

    def mean_delivery(self, sent):
        return self.delivery


@says(CHANNELS, "AllAtOnce.independent: must be False where outcomes of neighb", delivery=0.8)
class AllAtOnce(Bernoulli):
    """All links lose the same messages, by their numbers."""

    def delivery_probability(self, sent):
        return 0.0 if (sent.number * 2654435761) % 5 == 0 else 1.0

    def mean_delivery(self, sent):
        return 0.8


@says(
    CHANNELS,
    "Coupled.delivery_probability: must return the same for the same arguments",
    delivery=0.8,
)
class Coupled(Bernoulli):
    def delivery_probability(self, sent):
        last, NUMBERS["last"] = NUMBERS.get("last"), (sent.link, sent.number)
        return self.delivery if last in (None, (sent.link, sent.number)) else 0.9 * self.delivery


@says(CHANNELS, "Ignores.mean_delivery: must be the delivered fraction")
class Ignores(Loss):
    """The entry of the table counts for the mean only."""

    def delivery_probability(self, sent):
        return 0.8

    def mean_delivery(self, sent):
        return sent.table_probability


@says(CHANNELS, "Ordered.draw: ")
class Ordered(Delay):
    def draw(self, random):
        NUMBERS[id(random)] = 0.5 * NUMBERS.get(id(random), 0.5) + 0.5 * random.random()
        return 1e-10 * NUMBERS[id(random)]  # light takes so long for 3 cm


@says(CHANNELS, "OneSlow.message_delay: must be from 0 to `longest` (1) seconds")
class OneSlow(Delay):
    @property
    def longest(self):
        return 1.0

    def draw(self, random):
        return random.random()

    def message_delay(self, sent, drawn):
        return 2.0 if sent.link == (3, 2) else drawn


@says(CLOCKS, "OneSlower.mean_rate: must be the mean ticks per second", rate=2.0)
class OneSlower(Poisson):
    def ticks(self, link, origin, index, now, random, count):
        slow = 1.1 if link == (2, 3) else 1.0
        return np.add.accumulate([now, *(slow * random.standard_exponential(count) / self.rate)])[
            1:
        ]


@says(CLOCKS, "Unstated.mean_rate: must be the mean ticks per second")
class Unstated(LinkClock):
    def ticks(self, link, origin, index, now, random, count):
        slow = 1.1 if link == (2, 3) else 1.0
        return np.add.accumulate([now, *(slow * random.standard_exponential(count))])[1:]


@says(CLOCKS, "Waits.ticks: ticks of a link must not depend on those of others", rate=2.0)
class Waits(Poisson):
    """Links wait for each other."""

    def ticks(self, link, origin, index, now, random, count):
        start = NUMBERS.get("tick", (link, 0.0))
        times = np.add.accumulate([now, *(random.standard_exponential(count) / self.rate)])[1:]
        NUMBERS["tick"] = (link, times[-1])
        return times if start[0] == link or count > 1 else times + 0.01


@says(CLOCKS, "OneSeed.ticks: must draw from the generator given", rate=2.0)
class OneSeed(Poisson):
    def ticks(self, link, origin, index, now, random, count):
        fixed = np.random.default_rng(4).standard_exponential(2000)[index : index + count]
        return np.add.accumulate([now, *(fixed / self.rate)])[1:]


@says(CLOCKS, "Even.memoryless: must be False where ticks are no Poisson process", rate=2.0)
class Even(Poisson):
    """Gaps of a gamma law of shape 1.1."""

    def ticks(self, link, origin, index, now, random, count):
        return np.add.accumulate([now, *(random.standard_gamma(1.1, count) / 2.2)])[1:]


@says(CHANNELS, "Slower.message_delay: delays must have the law of ExponentialDelay", mean=0.3)
class Slower(ExponentialDelay):
    def draw(self, random):
        return 1.1 * super().draw(random)


@says(CHANNELS, "Instant.message_delay: delays must have the law of ConstantDelay", seconds=0.3)
class Instant(ConstantDelay):
    def message_delay(self, sent, drawn):
        return 0.0


@says(
    CHANNELS,
    "Scattered.next_state: losses must follow each other as in GilbertElliott",
    mean_loss=0.3,
    mean_burst=4.0,
)
class Scattered(GilbertElliott):
    """Loses as many messages, one by one."""

    def next_state(self, link, bad, random):
        return super().next_state(link, None, random)


@says(
    CLOCKS,
    "OtherShape.ticks: gaps must have the law of Renewal",
    distribution="gamma",
    shape=3.0,
    rate=2.0,
)
class OtherShape(Renewal):
    def ticks(self, entity, origin, index, now, random, count):
        gaps = random.standard_gamma(2.0, count) / 4.0
        return np.add.accumulate([now, *gaps])[1:]


@says(CLOCKS, "OffBeat.ticks: must tick at the times of Periodic", period=0.5)
class OffBeat(Periodic):
    def ticks(self, entity, origin, index, now, random, count):
        return 0.01 + super().ticks(entity, origin, index, now, random, count)


@says(
    CLOCKS,
    "EarlyJitter.ticks: must have the law of Periodic",
    period=0.3,
    jitter=0.2,
    phase="random",
)
class EarlyJitter(Periodic):
    def ticks(self, entity, origin, index, now, random, count):
        lattice = Periodic(period=self.period, phase=self.phase)
        times = lattice.ticks(entity, origin, index, now, random, count)
        return times + self.jitter * random.random(count) ** 2


@says(CLOCKS, "OnePhase.ticks: must have the law of Periodic", period=0.3, phase="random")
class OnePhase(Periodic):
    def origin(self, entity, random):
        return 0.5 * super().origin(entity, random)
