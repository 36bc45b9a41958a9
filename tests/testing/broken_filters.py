"""Filters with one breach of the contract each, and what their checker must say."""

import random
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.baselines import Local
from netkf.algorithms.filter import Estimate, Filter
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.push_sum import MASS, PushSum
from netkf.algorithms.single import Payload
from netkf.algorithms.traits import Analysis, Timing, Weights
from netkf.kernels import Kernels, kernel, load, store, use_reading

BROKEN = {}


def says(words, **settings):
    """Register a class with the words that its checker must say."""

    def keep(cls):
        made = dataclass(frozen=True, eq=False)(cls)
        BROKEN[made.__name__] = (made, settings, words)
        return made

    return keep


@says("EulerSteps.predict: must compose over gaps, predict(a + b) = predict(b)", epsilon=0.3)
class EulerSteps(Hybrid):
    def predict(self, state, gap):
        A, P = state.model.A, state.P
        P = P + gap * (A @ P + P @ A.T + state.model.Q) + 100.0 * gap**2 * np.eye(len(P))
        return state._replace(xhat=state.xhat + gap * A @ state.xhat, root=np.linalg.cholesky(P))


@says(
    "TakesPayload.absorb: must not change its arguments, but changed messages[0]",
    epsilon=0.3,
)
class TakesPayload(Hybrid):
    def absorb(self, state, messages, exchange):
        for message in messages:
            message.payload.xhat[:] = 0.0
        return super().absorb(state, messages, exchange)


@says("InPlace.update: must not change its arguments, but changed state.xhat", epsilon=0.3)
class InPlace(Hybrid):
    def update(self, state, reading):
        state.xhat[:] += reading[0][0]
        return state


@says(
    "PredictsInPlace.predict: must not change its arguments, but changed state.root",
    epsilon=0.3,
)
class PredictsInPlace(Hybrid):
    def predict(self, state, gap):
        new = super().predict(state, gap)
        state.root[:] = new.root
        return state._replace(xhat=new.xhat)


@says("Skewed.estimate after init: P must be symmetric", epsilon=0.3)
class Skewed(Hybrid):
    def estimate(self, state):
        return state.xhat, np.tril(state.P) + 2.0 * np.triu(state.P, 1) + 1e-3 * np.eye(
            len(state.P), k=1
        )


@says("Subtracts.estimate after absorb: P must be positive semidefinite", epsilon=0.3)
class Subtracts(Hybrid):
    def estimate(self, state):
        xhat, P = super().estimate(state)
        return xhat, P if (state.root[0, 0] > 0.0) else -P

    def absorb(self, state, messages, exchange):
        new = super().absorb(state, messages, exchange)
        return new._replace(root=-np.abs(new.root))


@says("WrongShape.estimate after init: xhat must have the shape (1,)", epsilon=0.3)
class WrongShape(Hybrid):
    def estimate(self, state):
        return state.xhat[:, None], state.P


@says("Greedy.link_weights.of: the weights of all messages that may arrive together must sum")
class Greedy(Filter):
    @property
    def link_weights(self):
        return Weights(lambda degree, peer_degree: 0.5)

    def absorb(self, state, messages, exchange):
        return state


@says("Negative.link_weights.of: must be a number from 0 to 1")
class Negative(Filter):
    @property
    def link_weights(self):
        return Weights(lambda degree, peer_degree: -0.1)

    def absorb(self, state, messages, exchange):
        return state


@says("Dice.absorb: must return the same for the same arguments", epsilon=0.3)
class Dice(Hybrid):
    def absorb(self, state, messages, exchange):
        noise = np.random.default_rng().normal(size=len(state.xhat))
        return state._replace(xhat=state.xhat + noise)


@says("GlobalNumpy.predict: must not use or seed global generators", epsilon=0.3)
class GlobalNumpy(Hybrid):
    def predict(self, state, gap):
        np.random.seed(0)  # noqa: NPY002
        return super().predict(state, gap)


@says("GlobalPython.emit: must not use or seed global generators", epsilon=0.3)
class GlobalPython(Hybrid):
    def emit(self, state, exchange):
        random.random()
        return super().emit(state, exchange)


@says("SharedBuffer.emit: returned something that a later call changed", epsilon=0.3)
class SharedBuffer(Hybrid):
    def emit(self, state, exchange):
        buffer = BUFFERS.setdefault(len(state.xhat), state.xhat.copy())
        buffer[:] = state.xhat
        state, payload = super().emit(state, exchange)
        return state, payload._replace(xhat=buffer)


BUFFERS: dict[int, Any] = {}


@says("Forgets.emit: must return (state, payload)", epsilon=0.3)
class Forgets(Hybrid):
    """Returns what it sends and not its state."""

    def emit(self, state, exchange):
        return Estimate(state.xhat, state.root)


@says("Impure.emit: must return the same for the same arguments", epsilon=0.3)
class Impure(Hybrid):
    """Counts what it sent outside of its state."""

    def emit(self, state, exchange):
        SENT.append(exchange)
        return state._replace(xhat=state.xhat + len(SENT)), None


SENT: list[Any] = []


class Opened(NamedTuple):
    xhat: Any
    root: Any
    model: Any
    hook: Any


@says("OpenState.init: states must be picklable", epsilon=0.3)
class OpenState(Hybrid):
    def init(self, model, mean, cov, node):
        state = super().init(model, mean, cov, node)
        return Opened(state.xhat, state.root, state.model, lambda: None)


@says("Counting.predict: must compose over gaps", epsilon=0.3)
class Counting(Hybrid):
    """Adds a little noise at every call, whatever the gap."""

    def predict(self, state, gap):
        new = super().predict(state, gap)
        return new._replace(root=np.linalg.cholesky(new.P + 1e-3 * np.eye(len(new.P))))


@says("Fails.absorb: failed with ZeroDivisionError", epsilon=0.3)
class Fails(Hybrid):
    def absorb(self, state, messages, exchange):
        return state._replace(xhat=state.xhat / 0 if messages[0].age == 1 / 0 else state.xhat)


@says("Nan.estimate after update: xhat must be finite", epsilon=0.3)
class Nan(Hybrid):
    def update(self, state, reading):
        return state._replace(xhat=state.xhat * np.nan)


@says("NanP.estimate after init: P must be finite; got [[nan]]; return None where", epsilon=0.3)
class NanP(Hybrid):
    """Has no covariance, and says it in the wrong words."""

    def estimate(self, state):
        return state.xhat, np.full((len(state.xhat),) * 2, np.nan)


@says("Unfinished must define absorb")
class Unfinished(Filter):
    pass


@says("Impatient.timing.interval: must be above 0 seconds", epsilon=0.3)
class Impatient(Hybrid):
    timing = replace(Hybrid.timing, interval=lambda state: 0.0)


@says(
    "Hoarder.analysis.conserved: the sum of weight over all nodes must survive", gamma=2, delta=3.0
)
class Hoarder(PushSum):
    def absorb(self, state, messages, exchange):
        new = super().absorb(state, messages, exchange)
        return new._replace(mass=new.mass * (1.1 if exchange.phase == MASS else 1.0))


class Purse(NamedTuple):
    xhat: Any
    root: Any
    model: Any
    mass: float


@says("Spendthrift.analysis.conserved: the sum of weight over all nodes must survive")
class Spendthrift(Filter):
    """Under clocks it sends mass and keeps it too."""

    timing = Timing(schedule=None, clocks=("nodes", "links"))

    def init(self, model, mean, cov, node):
        return Purse(*super().init(model, mean, cov, node), 1.0)

    def emit(self, state, exchange):
        return state, state.mass / (1 + len(exchange.receivers))

    def absorb(self, state, messages, exchange):
        return state._replace(mass=state.mass + sum(message.payload for message in messages))

    analysis = Analysis(conserved=lambda state: {"weight": state.mass})


@says("Empty.absorb: failed with IndexError")
class Empty(Intermittent):
    def absorb(self, state, messages, exchange):
        _ = messages[0]
        return super().absorb(state, messages, exchange)


@says('Listens.timing.schedule: must be None or a tuple of "predict", "sense", "exchange"')
class Listens(Gossip):
    timing = replace(Gossip.timing, schedule=("exchange", "listen"))


@says('Twice.timing.schedule: must have one "predict" and one "sense" at most')
class Twice(Gossip):
    timing = replace(Gossip.timing, schedule=("exchange", "predict", "sense", "predict"))


@says('Ahead.timing.predicts: must be True where the schedule has "predict" after "sense"')
class Ahead(Gossip):
    """Its samples would be taken for the state of the slot before."""

    timing = replace(Gossip.timing, predicts=False)


@says("NoClock.timing.clocks: must be a tuple of", epsilon=0.3)
class NoClock(Hybrid):
    timing = replace(Hybrid.timing, clocks="nodes")


@says("NoSuchClock.timing.clocks: must be a tuple of", epsilon=0.3)
class NoSuchClock(Hybrid):
    timing = replace(Hybrid.timing, clocks=("node",))


@says("Nowhere.timing.clocks: must name a clock where schedule is None", epsilon=0.3)
class Nowhere(Hybrid):
    timing = replace(Hybrid.timing, clocks=())


@says("Maybe.timing.pairwise: must be True or False")
class Maybe(Gossip):
    timing = replace(Gossip.timing, pairwise="yes")


@says("SlotInPlace.update: must not change its arguments, but changed state.root")
class SlotInPlace(Gossip):
    timing = replace(Gossip.timing, clocks=())

    def update(self, state, reading):
        new = super().update(state, reading)
        state.root[:] = new.root
        return new


@says("NeverFresh.timing.redraws: must be True in step 0")
class NeverFresh(Gossip):
    timing = replace(Gossip.timing, redraws=lambda _, __: False)


@says("ChangesReading.update: must not change its arguments, but changed reading.y")
class ChangesReading(Gossip):
    timing = replace(Gossip.timing, clocks=())

    def update(self, state, reading):
        reading.y[:] = 0.0
        return super().update(state, reading)


@says("Lopsided.link_weights.matrix: columns, the weights that a node gives, must sum to at most 1")
class Lopsided(Filter):
    @property
    def link_weights(self):
        return Weights(matrix=np.full((3, 3), 0.5))

    def absorb(self, state, messages, exchange):
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


@says("Singular matrix (tests/testing/broken_filters.py, line 351); set inverts", epsilon=0.3)
class Inverts(Hybrid):
    def init(self, model, mean, cov, node):
        _ = np.linalg.inv(cov)
        return super().init(model, mean, cov, node)


@says("SamplesOnly.update: failed with AttributeError", epsilon=0.3)
class SamplesOnly(Hybrid):
    """Takes no increments and does not say that it needs samples."""

    def update(self, state, reading):
        _ = reading.y
        return super().update(state, reading)


SHIFTS = "a class that defines shift must commute with a shift of the truth"


@says(f"Shrinks.shift: {SHIFTS}", epsilon=0.3)
class Shrinks(Hybrid):
    """Pulls its estimate to the origin, which is no place of its own."""

    def absorb(self, state, messages, exchange):
        new = super().absorb(state, messages, exchange)
        return new._replace(xhat=0.9 * new.xhat)

    def shift(self, state, offset):
        return state._replace(xhat=state.xhat + offset)


@says(f"ShiftsTwice.shift: {SHIFTS}", epsilon=0.3)
class ShiftsTwice(Hybrid):
    def shift(self, state, offset):
        return state._replace(xhat=state.xhat + 2.0 * offset)


@says(f"LeavesMail.shift: {SHIFTS}", epsilon=0.3)
class LeavesMail(Hybrid):
    """Forgets what is under way."""

    def shift(self, state, offset):
        return state if isinstance(state, Payload) else super().shift(state, offset)


@says(f"Gates.shift: {SHIFTS}")
class Gates(Gossip):
    """Distrusts what is far from the origin."""

    def absorb(self, state, messages, exchange):
        near = [message for message in messages if np.abs(message.payload.xhat).max() < 4.0]
        return super().absorb(state, near, exchange)

    def shift(self, state, offset):
        return state._replace(xhat=state.xhat + offset)


@kernel
def turned(record, h, run):
    lanes, root = run.lanes, record.root
    use_reading(run, record.xhat, root, h, run.reading, True)
    if len(run.size) > 1:  # the first two columns change places
        for i in range(len(run.size)):
            first, second = load(lanes, root, h, i, 0), load(lanes, root, h, i, 1)
            store(lanes, root, h, i, 0, second)
            store(lanes, root, h, i, 1, first)


@says("Turned.estimate after update: root must be lower triangular in kernels")
class Turned(Local):
    """Its root stands for the right P, but kernels read one half of it."""

    kernels = Kernels(update=turned)
