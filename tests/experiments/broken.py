"""Filters, matchings and channels with one thing wrong each."""

from dataclasses import dataclass

from netkf.algorithms.slot import Gossip, Intermittent
from netkf.network.channels import Bernoulli
from netkf.network.matchings import Matching


@dataclass(frozen=True, eq=False)
class UpdateThenSwap(Gossip):
    """Updates first, then swaps what came of it, from slot 0 on."""

    programme = ("sense", "exchange")
    first_slot = 0


@dataclass(frozen=True, eq=False)
class SwapsOnlyP(Gossip):
    """Takes the partner's covariance and keeps its own estimate."""

    def absorb(self, state, phase, messages):
        for _, pair, _ in messages:
            state = state._replace(root=pair.root)
        return state


@dataclass(frozen=True, eq=False)
class SwapsOnlyX(Gossip):
    """Takes the partner's estimate and keeps its own covariance."""

    def absorb(self, state, phase, messages):
        for _, pair, _ in messages:
            state = state._replace(xhat=pair.xhat)
        return state


@dataclass(frozen=True, eq=False)
class Reluctant(Matching):
    """Claims the mean of its protocol, but drops the first link every other time."""

    def draw(self, topology, random):
        pairs = super().draw(topology, random)
        return [p for p in pairs if p != topology.links[0] or random.random() < 0.5]


@dataclass(frozen=True, eq=False)
class Lossier(Bernoulli):
    """Claims ``delivery``, delivers a tenth less."""

    def chance(self, link, message, bad, measured):
        return self.delivery - 0.1

    def mean_delivery(self, link, measured):
        return self.delivery


@dataclass(frozen=True, eq=False)
class Forgetful(Intermittent):
    """Uses only the first reading that arrives."""

    def absorb(self, state, phase, messages):
        return super().absorb(state, phase, messages[:1])


@dataclass(frozen=True, eq=False)
class Overconfident(Intermittent):
    """Reports half of its covariance's root."""

    def estimate(self, state):
        xhat, P = super().estimate(state)
        return xhat, 0.25 * P
