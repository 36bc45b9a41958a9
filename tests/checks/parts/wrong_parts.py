"""Parts of scenarios with one thing wrong each."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from netkf.network.clocks import Periodic, Poisson, Renewal
from netkf.network.delays import ConstantDelay, ExponentialDelay
from netkf.network.losses import Bernoulli, GilbertElliott
from netkf.network.matchings import Matching
from netkf.plants.linear import LinearPlant, SlotReadings
from netkf.plants.sensors import LinearSensor


class Other(LinearPlant):
    """Its paths are those of another plant, ``drawn``."""

    def truth(self, random, frames=False):
        return self.drawn.truth(random, frames)


@dataclass(frozen=True, eq=False)
class Noisier(Other):
    """Draws its noise with variances that are larger by a fifth."""

    @cached_property
    def drawn(self):
        return LinearPlant(
            mean=self.mean, cov=self.cov, F=self.F, Q=1.2 * self.Q, period=self.period
        )


@dataclass(frozen=True, eq=False)
class Faster(Other):
    """Follows another F."""

    @cached_property
    def drawn(self):
        return LinearPlant(
            mean=self.mean, cov=self.cov, F=self.F + 0.1, Q=self.Q, period=self.period
        )


@dataclass(frozen=True, eq=False)
class Elsewhere(Other):
    """Starts with a smaller covariance."""

    @cached_property
    def drawn(self):
        return LinearPlant(
            mean=self.mean, cov=0.9 * self.cov, F=self.F, Q=self.Q, period=self.period
        )


class Wrong(SlotReadings):
    def __init__(self, *given, change):
        super().__init__(*given)
        self.change = change

    def several(self, slots, x):
        y, H = super().several(slots, x)
        return self.change(y, (H @ x[:, :, None])[:, :, 0]), H


@dataclass(frozen=True, eq=False)
class Biased(LinearSensor):
    def slot_path(self, node, period, generator):
        return Wrong(self.H, self.R, generator("noise"), change=lambda y, seen: y + 0.1)


@dataclass(frozen=True, eq=False)
class Louder(LinearSensor):
    def slot_path(self, node, period, generator):
        return Wrong(
            self.H, self.R, generator("noise"), change=lambda y, seen: seen + 1.1 * (y - seen)
        )


@dataclass(frozen=True, eq=False)
class Coloured(LinearSensor):
    def slot_path(self, node, period, generator):
        def change(y, seen):
            v = y - seen
            v[1:] = 0.98 * v[1:] + 0.2 * v[:-1]
            return seen + v

        return Wrong(self.H, self.R, generator("noise"), change=change)


@dataclass(frozen=True, eq=False)
class Slower(Poisson):
    def ticks(self, entity, origin, index, now, random, count):
        return now + 1.1 * (super().ticks(entity, origin, index, now, random, count) - now)


@dataclass(frozen=True, eq=False)
class OneSlower(Poisson):
    def ticks(self, entity, origin, index, now, random, count):
        factor = 1.2 if entity == (0, 1) else 1.0
        return now + factor * (super().ticks(entity, origin, index, now, random, count) - now)


@dataclass(frozen=True, eq=False)
class Even(Poisson):
    """Has the rate, and gaps that are too even."""

    def ticks(self, entity, origin, index, now, random, count):
        return now + np.cumsum(random.standard_gamma(2.0, count) / 2.0 / self.mean_rate(entity))


@dataclass(frozen=True, eq=False)
class Lossier(Bernoulli):
    def delivery_probability(self, sent):
        return self.delivery - 0.03


@dataclass(frozen=True, eq=False)
class OneWay(Bernoulli):
    def delivery_probability(self, sent):
        return self.delivery - (0.15 if sent.link == (1, 0) else 0.0)


@dataclass(frozen=True, eq=False)
class Sticky(Bernoulli):
    """Loses every second message more often, and those between less often."""

    def delivery_probability(self, sent):
        return self.delivery + (0.25 if sent.number % 2 else -0.25)


@dataclass(frozen=True, eq=False)
class Preferring(Matching):
    def draw(self, topology, random):
        pairs = super().draw(topology, random)
        return (
            [topology.links[1]] if pairs == [topology.links[0]] and random.random() < 0.4 else pairs
        )


@dataclass(frozen=True, eq=False)
class Lazier(Matching):
    """Drops one pair of ten."""

    def draw(self, topology, random):
        pairs = super().draw(topology, random)
        return pairs if random.random() > 0.1 else []


@dataclass(frozen=True, eq=False)
class Rarely(LinearSensor):
    """Leaves out every tenth sample."""

    def sample_times(self, node, ordinal, generator, horizon):
        times = super().sample_times(node, ordinal, generator, horizon)
        return np.delete(times, np.arange(9, len(times), 10))


@dataclass(frozen=True, eq=False)
class Regular(LinearSensor):
    """Samples at the rate of its Poisson clock, at equal distances."""

    def sample_times(self, node, ordinal, generator, horizon):
        gap = 1.0 / self.sampling.mean_rate((node, ordinal))
        return np.arange(generator("sampling").random() * gap + 1e-9, horizon, gap)


@dataclass(frozen=True, eq=False)
class LateFirst(Poisson):
    """Every clock begins a quarter of a second late."""

    def ticks(self, entity, origin, index, now, random, count):
        late = 0.25 if index == 0 else 0.0
        return late + super().ticks(entity, origin, index, now, random, count)


@dataclass(frozen=True, eq=False)
class OtherShape(Renewal):
    """Has the rate, and gaps that vary more."""

    def ticks(self, entity, origin, index, now, random, count):
        gaps = random.standard_gamma(2.0, count) / 2.0 / self.mean_rate(entity)
        return np.add.accumulate(np.concatenate([[now], gaps]))[1:]


@dataclass(frozen=True, eq=False)
class OffBeat(Periodic):
    """Ticks a hundredth of a second late."""

    def ticks(self, entity, origin, index, now, random, count):
        return 0.01 + super().ticks(entity, origin, index, now, random, count)


@dataclass(frozen=True, eq=False)
class LongerBursts(GilbertElliott):
    """Loses as many messages, in bursts twice as long."""

    @property
    def transitions(self):
        to_bad, to_good = super().transitions
        return 0.5 * to_bad, 0.5 * to_good


@dataclass(frozen=True, eq=False)
class FirstLost(Bernoulli):
    """Loses the first two messages of every direction."""

    def delivery_probability(self, sent):
        return self.delivery if sent.number > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Slow(ExponentialDelay):
    """Takes a tenth longer."""

    def draw(self, random):
        return 1.1 * super().draw(random)


@dataclass(frozen=True, eq=False)
class OneSlow(ExponentialDelay):
    """Takes longer on one link."""

    def message_delay(self, sent, drawn):
        return drawn * (1.5 if sent.link == (0, 1) else 1.0)


@dataclass(frozen=True, eq=False)
class Sooner(ConstantDelay):
    """Takes a little less time than it says."""

    def message_delay(self, sent, drawn):
        return 0.99 * drawn


@dataclass(frozen=True, eq=False)
class EarlyJitter(Periodic):
    """Delays its ticks by small shares of the jitter more often than by large ones."""

    def ticks(self, entity, origin, index, now, random, count):
        lattice = Periodic(period=self.period, phase=self.phase, at=self.at)
        times = lattice.ticks(entity, origin, index, now, random, count)
        return times + self.jitter * random.random(count) ** 2
