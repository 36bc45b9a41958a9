"""Losses, delays and clocks with one breach each, and what their checkers must say."""

import math
import random as global_random
from dataclasses import dataclass

import numpy as np

from netkf.network.channels import Bernoulli, Delay, GilbertElliott, Loss
from netkf.network.clocks import LinkClock, Poisson

CHANNELS, CLOCKS = {}, {}


def says(table, words, **settings):
    def keep(cls):
        made = dataclass(frozen=True, eq=False)(cls)
        table[made.__name__] = (made, settings, words)
        return made

    return keep


@says(CHANNELS, "TooSure.delivery_probability: must be a number from 0 to 1 for message 0; got 1.2")
class TooSure(Loss):
    def delivery_probability(self, link, message, bad, table_probability):
        return 1.2


@says(CHANNELS, "Lossier.mean_delivery: must be the delivered fraction", delivery=0.5)
class Lossier(Bernoulli):
    def chance(self, link, message, bad, measured):
        return self.delivery - 0.02

    def mean_delivery(self, link, measured):
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


@says(CHANNELS, "Fickle.weather: must draw nothing where stateful is False", delivery=0.5)
class Fickle(Bernoulli):
    def weather(self, bad, random):
        return random.random() < 0.5


@says(
    CHANNELS,
    "Lazy.next_state: must draw the same at each activation",
    mean_loss=0.2,
    mean_burst=5.0,
)
class Lazy(GilbertElliott):
    def next_state(self, bad, random):
        if not bad:
            return bool(random.random() < 0.3)
        return super().next_state(random.random() < 2, random)


@says(CHANNELS, "OwnLuck.chance: must give the same for the same arguments")
class OwnLuck(Loss):
    def chance(self, link, message, bad, measured):
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
