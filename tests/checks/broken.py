"""Filters, matchings and channels with one thing wrong each."""

from dataclasses import dataclass, replace

import numpy as np

from netkf.algorithms.baselines import Central
from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.filter import Estimate, Filter
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.push_sum import AVERAGE, PushSum
from netkf.algorithms.traits import Timing, Weights
from netkf.core.fields import positive, setting
from netkf.network.losses import Bernoulli
from netkf.network.matchings import Matching


@dataclass(frozen=True, eq=False)
class OwnReset(Filter):
    """A reset filter from scratch that forgets its own share."""

    epsilon: float = setting(positive)

    def absorb(self, state, messages, exchange):
        P = state.P + sum(message.weight * message.payload.P for message in messages)
        return state._replace(root=np.linalg.cholesky(P))

    @property
    def link_weights(self):
        return Weights(lambda degree, peer_degree: self.epsilon)


@dataclass(frozen=True, eq=False)
class OwnSwap(Filter):
    """A gossip filter from scratch that takes twice the partner's covariance."""

    timing = Timing(schedule=("exchange", "sense", "predict"), predicts=True, pairwise=True)

    def absorb(self, state, messages, exchange):
        for message in messages:
            state = state._replace(xhat=message.payload.xhat, root=1.4 * message.payload.root)
        return state


@dataclass(frozen=True, eq=False)
class UpdateThenSwap(Gossip):
    """Updates first, then swaps what came of it, from slot 0 on."""

    timing = replace(Gossip.timing, schedule=("sense", "predict", "exchange"), first_slot=0)


@dataclass(frozen=True, eq=False)
class SwapsOnlyP(Gossip):
    """Takes the partner's covariance and keeps its own estimate."""

    def absorb(self, state, messages, exchange):
        for message in messages:
            state = state._replace(root=message.payload.root)
        return state


@dataclass(frozen=True, eq=False)
class SwapsOnlyX(Gossip):
    """Takes the partner's estimate and keeps its own covariance."""

    def absorb(self, state, messages, exchange):
        for message in messages:
            state = state._replace(xhat=message.payload.xhat)
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

    def delivery_probability(self, sent):
        return self.delivery - 0.1

    def mean_delivery(self, sent):
        return self.delivery


@dataclass(frozen=True, eq=False)
class Forgetful(Intermittent):
    """Uses only the first reading that arrives."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages[:1], exchange)


@dataclass(frozen=True, eq=False)
class Overconfident(Intermittent):
    """Reports half of its covariance's root."""

    def estimate(self, state):
        xhat, P = super().estimate(state)
        return xhat, 0.25 * P


@dataclass(frozen=True, eq=False)
class WrongSign(Hybrid):
    """Moves away from what it hears."""

    def absorb(self, state, messages, exchange):
        right = super().absorb(state, messages, exchange)
        return right._replace(xhat=2.0 * state.xhat - right.xhat)


@dataclass(frozen=True, eq=False)
class MissingP(Hybrid):
    """Mixes estimates and keeps its covariance."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)._replace(root=state.root)


@dataclass(frozen=True, eq=False)
class MissingX(Hybrid):
    """Mixes covariances and keeps its estimate."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)._replace(xhat=state.xhat)


@dataclass(frozen=True, eq=False)
class WrongWeight(Hybrid):
    """Gives twice the weight."""

    def absorb(self, state, messages, exchange):
        return super().absorb(
            state, [m._replace(weight=2.0 * m.weight) for m in messages], exchange
        )


@dataclass(frozen=True, eq=False)
class OneAfterTheOther(Hybrid):
    """Resets once for each message of an instant."""

    def absorb(self, state, messages, exchange):
        for message in messages:
            state = super().absorb(state, [message], exchange)
        return state


@dataclass(frozen=True, eq=False)
class Stale(Hybrid):
    """Takes old estimates for new ones."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, [m._replace(age=0.0) for m in messages], exchange)


@dataclass(frozen=True, eq=False)
class ForgottenNoise(Hybrid):
    """Leaves the noise of the plant out of its covariance."""

    def predict(self, state, gap):
        state = super().predict(state, gap)
        P = state.P - 0.9 * gap * state.model.Q
        return state._replace(root=np.linalg.cholesky(P + 1e-12 * np.eye(len(P))))


@dataclass(frozen=True, eq=False)
class SwappedIndex(Hybrid):
    """Sends its first two states exchanged."""

    def emit(self, state, exchange):
        return state, Estimate(state.xhat[::-1].copy(), state.root)


@dataclass(frozen=True, eq=False)
class TimeOff(Hybrid):
    """Predicts what it hears too far."""

    def absorb(self, state, messages, exchange):
        late = [m._replace(age=m.age + 0.3) for m in messages]
        return super().absorb(state, late, exchange)


@dataclass(frozen=True, eq=False)
class Deaf(Hybrid):
    """Counts readings in its covariance and does not use them."""

    def update(self, state, reading):
        return state


@dataclass(frozen=True, eq=False)
class Eager(Hybrid):
    """Uses every reading twice."""

    def update(self, state, reading):
        once = super().update(state, reading)
        return once._replace(xhat=2.0 * once.xhat - state.xhat)


@dataclass(frozen=True, eq=False)
class TooSure(Hybrid):
    """Fuses estimates as if their errors were independent."""

    def absorb(self, state, messages, exchange):
        for message in messages:
            P, other = state.P, message.payload
            gain = np.linalg.solve(P + other.P + 1e-9 * np.eye(len(P)), P).T
            root = np.linalg.cholesky(P - gain @ P + 1e-9 * np.eye(len(P)))
            state = state._replace(xhat=state.xhat + gain @ (other.xhat - state.xhat), root=root)
        return state


@dataclass(frozen=True, eq=False)
class TooSureOfAll(Central):
    """Counts every reading twice in its covariance."""

    def update(self, state, reading):
        once = super().update(state, reading)
        return once._replace(root=super().update(once, reading).root)


@dataclass(frozen=True, eq=False)
class LosesMass(PushSum):
    """Does not keep what could not be sent."""

    def absorb(self, state, messages, exchange):
        if exchange.phase != AVERAGE:
            state = state._replace(degree=len(messages))
        return super().absorb(state, messages, exchange)


@dataclass(frozen=True, eq=False)
class SendsTooMuch(PushSum):
    """Divides its mass by its degree, not by one more."""

    def emit(self, state, exchange):
        state, sent = super().emit(state, exchange)
        if exchange.phase == AVERAGE:
            return state, sent
        return state, sent._replace(mass=sent.mass * (state.degree + 1) / state.degree)


@dataclass(frozen=True, eq=False)
class NeverAverages(PushSum):
    """Skips the averaging of estimates."""

    def absorb(self, state, messages, exchange):
        return state if exchange.phase == AVERAGE else super().absorb(state, messages, exchange)


@dataclass(frozen=True, eq=False)
class Overshoots(PushSum):
    """Averages with half of delta."""

    def absorb(self, state, messages, exchange):
        if exchange.phase != AVERAGE:
            return super().absorb(state, messages, exchange)
        apart = [message.payload.xhat - state.xhat for message in messages]
        return state._replace(xhat=state.xhat + sum(apart) / (0.6 * self.delta))


@dataclass(frozen=True, eq=False)
class ForgetsN(PushSum):
    """Leaves the factor N out of its gain."""

    def update(self, state, reading):
        alone = state._replace(number=1.0)
        return super().update(alone, reading)._replace(number=state.number)


@dataclass(frozen=True, eq=False)
class Arithmetic(DiffusionFilter):
    """Averages covariances in place of their inverses."""

    def absorb(self, state, messages, exchange):
        pairs = [(state.own, state), *((m.weight, m.payload) for m in messages)]
        total = sum(weight for weight, _ in pairs)
        P = sum(weight / total * pair.root @ pair.root.T for weight, pair in pairs)
        xhat = sum(weight / total * pair.xhat for weight, pair in pairs)
        return state._replace(xhat=xhat, root=np.linalg.cholesky(P))


@dataclass(frozen=True, eq=False)
class DropsWeight(DiffusionFilter):
    """Leaves the weight of lost messages out."""

    def absorb(self, state, messages, exchange):
        pairs = [(state.own, state), *((m.weight, m.payload) for m in messages)]
        P = np.linalg.inv(sum(weight * np.linalg.inv(pair.P) for weight, pair in pairs))
        xhat = P @ sum(weight * np.linalg.solve(pair.P, pair.xhat) for weight, pair in pairs)
        return state._replace(xhat=xhat, root=np.linalg.cholesky(P))


@dataclass(frozen=True, eq=False)
class KeepsX(DiffusionFilter):
    """Combines covariances and keeps its estimate."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)._replace(xhat=state.xhat)


@dataclass(frozen=True, eq=False)
class AddsUp(Hybrid):
    """Forgets its own share and every estimate."""

    def absorb(self, state, messages, exchange):
        P = state.P + sum(message.weight * message.payload.P for message in messages)
        return state._replace(root=np.linalg.cholesky(P + 1e-12 * np.eye(len(P))))


@dataclass(frozen=True, eq=False)
class SwapsTooMuch(Gossip):
    """Takes twice the partner's covariance."""

    def absorb(self, state, messages, exchange):
        for message in messages:
            sent = message.payload
            state = state._replace(xhat=sent.xhat, root=1.4 * sent.root)
        return state


@dataclass(frozen=True, eq=False)
class HeavierLinks(Hybrid):
    """Gives its neighbours another weight, which is its own choice."""

    @property
    def link_weights(self):
        return Weights(lambda degree, peer_degree: 0.5 * self.epsilon)


@dataclass(frozen=True, eq=False)
class SameWeights(Hybrid):
    """Writes down the weight that it has anyway."""

    @property
    def link_weights(self):
        return Weights(lambda degree, peer_degree: self.epsilon)


@dataclass(frozen=True, eq=False)
class LateSwaps(Gossip):
    """Swaps from slot 3 on."""

    timing = replace(Gossip.timing, first_slot=3)


@dataclass(frozen=True, eq=False)
class OverconfidentInOneState(Gossip):
    """Reports too little covariance of its last state."""

    def estimate(self, state):
        xhat, P = super().estimate(state)
        units = np.append(np.ones(len(P) - 1), 0.9)
        return xhat, P * np.outer(units, units)
