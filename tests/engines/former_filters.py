"""Filters as the documentation of the former contracts had them."""

from dataclasses import dataclass

from netkf.algorithms.flow import FlowFilter, predict
from netkf.algorithms.slot import SlotFilter, update_and_predict
from netkf.core.fields import positive, setting


@dataclass(frozen=True, eq=False)
class OwnReset(FlowFilter):
    """A reset filter from scratch that forgets its own share."""

    epsilon: float = setting(positive)

    def absorb(self, state, messages):
        P = state.P
        for weight, payload, _ in messages:
            P = P + weight * payload.P
        return state._replace(P=P)

    def weight(self, degree, peer_degree):
        return self.epsilon


@dataclass(frozen=True, eq=False)
class OwnSwap(SlotFilter):
    """A gossip filter from scratch that takes twice the partner's covariance."""

    first_slot = 1
    pairwise = True

    def emit(self, state, phase):
        return state.xhat, state.root

    def absorb(self, state, phase, messages):
        for _, (xhat, root), _ in messages:
            state = state._replace(xhat=xhat, root=1.4 * root)
        return state

    def sense(self, state, reading):
        xhat, root = update_and_predict(state.xhat, state.root, state.model, reading)
        return state._replace(xhat=xhat, root=root)


@dataclass(frozen=True, eq=False)
class SoundReset(OwnReset):
    """The hybrid filter."""

    def absorb(self, state, messages):
        own = 1.0 - sum(weight for weight, _, _ in messages)
        xhat, P = own * state.xhat, own * state.P
        for weight, payload, age in messages:
            there = predict(state.model, payload, age)
            xhat, P = xhat + weight * there.xhat, P + weight * there.P
        return state._replace(xhat=xhat, P=P)

    def largest_degree(self):
        return 1.0 / self.epsilon


@dataclass(frozen=True, eq=False)
class SoundSwap(OwnSwap):
    """The gossip filter."""

    def absorb(self, state, phase, messages):
        for _, (xhat, root), _ in messages:
            state = state._replace(xhat=xhat, root=root)
        return state


@dataclass(frozen=True, eq=False)
class Placed(SoundSwap):
    """Knows its id and degree, from before slot 0."""

    def place(self, state, role):
        return state._replace(xhat=state.xhat + role.node + 0.25 * role.neighbours)
