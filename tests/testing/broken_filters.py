"""Filters with one breach of the contract each, and what their checker must say."""

import random
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.push_sum import PushSum
from netkf.algorithms.slot import Gossip, Intermittent, SlotFilter

BROKEN = {}


def says(words, **settings):
    """Register a class with the words that its checker must say."""

    def keep(cls):
        made = dataclass(frozen=True, eq=False)(cls)
        BROKEN[made.__name__] = (made, settings, words)
        return made

    return keep


@says("EulerSteps.flow: must compose over gaps", epsilon=0.3)
class EulerSteps(Hybrid):
    def flow(self, state, gap):
        A, P = state.model.A, state.P
        return state._replace(
            xhat=state.xhat + gap * A @ state.xhat,
            P=P + gap * (A @ P + P @ A.T + state.model.Q),
        )


@says(
    "TakesPayload.absorb: must leave what it is given as it is, and changed messages[0]",
    epsilon=0.3,
)
class TakesPayload(Hybrid):
    def absorb(self, state, messages):
        for _, payload, _ in messages:
            payload.xhat[:] = 0.0
        return super().absorb(state, messages)


@says("InPlace.measure: must leave what it is given as it is, and changed state.xhat", epsilon=0.3)
class InPlace(Hybrid):
    def measure(self, state, reading):
        state.xhat[:] += reading.moments[0]
        return state


@says("FlowsInPlace.flow: must leave what it is given as it is, and changed state.P", epsilon=0.3)
class FlowsInPlace(Hybrid):
    def flow(self, state, gap):
        new = super().flow(state, gap)
        state.P[:] = new.P
        return state._replace(xhat=new.xhat)


@says("Skewed.estimate after init: P must be symmetric", epsilon=0.3)
class Skewed(Hybrid):
    def estimate(self, state):
        return state.xhat, np.tril(state.P) + 2.0 * np.triu(state.P, 1) + 1e-3 * np.eye(
            len(state.P), k=1
        )


@says("Subtracts.estimate after absorb: P must be positive semidefinite", epsilon=0.3)
class Subtracts(Hybrid):
    def absorb(self, state, messages):
        return super().absorb(state, [(-20.0 * w, payload, age) for w, payload, age in messages])


@says("WrongShape.estimate after init: xhat must have the shape (1,)", epsilon=0.3)
class WrongShape(Hybrid):
    def estimate(self, state):
        return state.xhat[:, None], state.P


@says("Greedy.weight: the weights of all messages that may arrive together must sum to at most 1")
class Greedy(FlowFilter):
    def weight(self, degree, peer_degree):
        return 0.5

    def absorb(self, state, messages):
        return state


@says("Negative.weight: must be a number from 0 to 1")
class Negative(FlowFilter):
    def weight(self, degree, peer_degree):
        return -0.1

    def absorb(self, state, messages):
        return state


@says("Dice.absorb: must give the same for the same arguments", epsilon=0.3)
class Dice(Hybrid):
    def absorb(self, state, messages):
        noise = np.random.default_rng().normal(size=len(state.xhat))
        return state._replace(xhat=state.xhat + noise)


@says("GlobalNumpy.flow: must not use or seed global generators", epsilon=0.3)
class GlobalNumpy(Hybrid):
    def flow(self, state, gap):
        np.random.seed(0)  # noqa: NPY002
        return super().flow(state, gap)


@says("GlobalPython.emit: must not use or seed global generators", epsilon=0.3)
class GlobalPython(Hybrid):
    def emit(self, state):
        random.random()
        return super().emit(state)


@says("SharedBuffer.emit: returned something that a later call changed", epsilon=0.3)
class SharedBuffer(Hybrid):
    def emit(self, state):
        buffer = BUFFERS.setdefault(len(state.xhat), state.xhat.copy())
        buffer[:] = state.xhat
        return super().emit(state)._replace(xhat=buffer)


BUFFERS: dict[int, Any] = {}


class Opened(NamedTuple):
    xhat: Any
    P: Any
    model: Any
    hook: Any


@says("OpenState.init: states must be picklable", epsilon=0.3)
class OpenState(Hybrid):
    def init(self, model, mean, cov):
        return Opened(mean, cov, model, lambda: None)


@says("Counting.flow: must compose over gaps", epsilon=0.3)
class Counting(Hybrid):
    """Adds a little noise at every call, whatever the gap."""

    def flow(self, state, gap):
        new = super().flow(state, gap)
        return new._replace(P=new.P + 1e-3 * np.eye(len(new.P)))


@says("Fails.absorb: failed with ZeroDivisionError", epsilon=0.3)
class Fails(Hybrid):
    def absorb(self, state, messages):
        return state._replace(xhat=state.xhat / 0 if messages[0][2] == 1 / 0 else state.xhat)


@says("Nan.estimate after measure: xhat must be finite", epsilon=0.3)
class Nan(Hybrid):
    def measure(self, state, reading):
        return state._replace(xhat=state.xhat * np.nan)


@says("Unfinished: must define absorb")
class Unfinished(FlowFilter):
    pass


@says("Impatient.stretch: must be above 0 seconds", epsilon=0.3)
class Impatient(Hybrid):
    def stretch(self, state):
        return 0.0


@says("Hoarder.conserved: the sum of weight over all nodes must survive", gamma=2, delta=3.0)
class Hoarder(PushSum):
    def absorb(self, state, phase, messages):
        new = super().absorb(state, phase, messages)
        return new._replace(mass=new.mass * (1.1 if phase == 0 else 1.0))


@says("Empty.absorb: failed with IndexError")
class Empty(Intermittent):
    def absorb(self, state, phase, messages):
        _ = messages[0]
        return super().absorb(state, phase, messages)


@says("EmptyProgramme.programme: must be a tuple of")
class EmptyProgramme(Gossip):
    programme = ("exchange", "listen")


@says("SlotInPlace.sense: must leave what it is given as it is, and changed state.root")
class SlotInPlace(Gossip):
    def sense(self, state, reading):
        new = super().sense(state, reading)
        state.root[:] = new.root
        return new


@says("NeverFresh.redraws: must be True in step 0")
class NeverFresh(Gossip):
    def redraws(self, phase, step):
        return False


@says("ChangesReading.sense: must leave what it is given as it is, and changed reading.y")
class ChangesReading(Gossip):
    def sense(self, state, reading):
        reading.y[:] = 0.0
        return super().sense(state, reading)


@says("Lopsided.pair_weights: columns, what a node gives, must sum to at most 1")
class Lopsided(SlotFilter):
    @property
    def pair_weights(self):
        return np.full((3, 3), 0.5)

    def sense(self, state, reading):
        return state


@says("Rows.estimate after init: P must have the shape (1, 1)", epsilon=0.3)
class Rows(Hybrid):
    def estimate(self, state):
        return state.xhat, np.diagonal(state.P)


@says("Integers.estimate after init: xhat must be float64", epsilon=0.3)
class Integers(Hybrid):
    def estimate(self, state):
        return np.zeros(len(state.xhat), dtype=int), state.P


@says("Unmade: could not be made with the settings")
class Unmade(Hybrid):
    pass


@says("Inverts.init: failed with LinAlgError: Singular matrix; set inverts = True", epsilon=0.3)
class Inverts(Hybrid):
    def init(self, model, mean, cov):
        _ = np.linalg.inv(cov)
        return super().init(model, mean, cov)
