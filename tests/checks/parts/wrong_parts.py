"""Parts of scenarios with one thing wrong each."""

from dataclasses import dataclass

import numpy as np

from netkf.network.channels import Bernoulli
from netkf.network.clocks import Poisson
from netkf.network.matchings import Matching
from netkf.plants.linear import LinearPlant, SlotReadings
from netkf.plants.sensors import LinearSensor


@dataclass(frozen=True, eq=False)
class Noisier(LinearPlant):
    """Draws its noise with variances that are larger by a fifth."""

    def truth(self, random, frames=False):
        return LinearPlant(
            mean=self.mean, cov=self.cov, F=self.F, Q=1.2 * self.Q, period=self.period
        ).truth(random, frames)


@dataclass(frozen=True, eq=False)
class Faster(LinearPlant):
    """Follows another F."""

    def truth(self, random, frames=False):
        return LinearPlant(
            mean=self.mean, cov=self.cov, F=self.F + 0.1, Q=self.Q, period=self.period
        ).truth(random, frames)


@dataclass(frozen=True, eq=False)
class Elsewhere(LinearPlant):
    """Starts with a smaller covariance."""

    def truth(self, random, frames=False):
        return LinearPlant(
            mean=self.mean, cov=0.9 * self.cov, F=self.F, Q=self.Q, period=self.period
        ).truth(random, frames)


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
            self.H, self.R, generator("noise"), change=lambda y, seen: seen + 1.05 * (y - seen)
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
    def delivery_probability(self, link, message, bad, table_probability):
        return self.delivery - 0.03


@dataclass(frozen=True, eq=False)
class OneWay(Bernoulli):
    def delivery_probability(self, link, message, bad, table_probability):
        return self.delivery - (0.15 if link == (1, 0) else 0.0)


@dataclass(frozen=True, eq=False)
class Sticky(Bernoulli):
    """Loses every second message more often, and those between less often."""

    def delivery_probability(self, link, message, bad, table_probability):
        return self.delivery + (0.25 if message % 2 else -0.25)


@dataclass(frozen=True, eq=False)
class Preferring(Matching):
    def draw(self, topology, random):
        pairs = super().draw(topology, random)
        return (
            [topology.links[1]] if pairs == [topology.links[0]] and random.random() < 0.4 else pairs
        )
