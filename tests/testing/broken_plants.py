"""Sensors, plants and matchings with one breach each, and what their checkers must say."""

from functools import cache
from itertools import count
from typing import ClassVar

import numpy as np

from netkf.network.clocks import Poisson
from netkf.network.matchings import Matching
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant, SlotReadings
from netkf.plants.regressors import RegressorReadings, RegressorSensor
from netkf.plants.sensors import LinearSensor, SensorPath
from netkf.rng.streams import Streams
from tests.testing.broken_channels import says

SENSORS, PLANTS, MATCHINGS = {}, {}, {}
ONE = {"nodes": (0, 3), "H": [[1.0, 0.5]], "R": [[0.5]]}
TWO = {"nodes": (0, 3), "H": [[1.0, 0.5], [0.0, 1.0]], "R": [[0.5, 0.2], [0.2, 0.3]]}
SAMPLED = {**ONE, "sampling": Poisson(rate=2.0)}
LINEAR = {
    "F": [[0.9, 0.1], [0.0, 0.5]],
    "Q": [[1.0, 0.2], [0.2, 0.4]],
    "mean": [1.0, 2.0],
    "cov": [[2.0, 0.1], [0.1, 1.0]],
    "period": 1.0,
}
FLOW = {"A": [[0.0, 0.3], [-0.3, -0.2]], "B": [[0.3, 0.0], [0.1, 0.3]], "cov": [[2.0, 0], [0, 1.0]]}
WHITE = "the noise y - H x must be uncorrelated"


class Changed(SlotReadings):
    """Readings whose noise (S, p) at the slots taken together goes through ``change``."""

    def __init__(self, H, R, random, change):
        super().__init__(H, R, random)
        self.change, self.drawn = change, []

    def noise(self, slots, x):
        last = max(slots)
        while len(self.drawn) <= last:
            self.drawn.append(self._root @ self._noise.draw())
        return np.array(
            [self.change(self.drawn, slot, state) for slot, state in zip(slots, x, strict=True)]
        )

    def reading(self, slot, x):
        return self.matrix(slot) @ x + self.noise([slot], x[None])[0]

    def several(self, slots, x):
        H = self.matrices(slots)
        return (H @ x[:, :, None])[:, :, 0] + self.noise(list(slots), x), H


class OwnNoise(LinearSensor):
    def change(self, drawn, slot, x):
        raise NotImplementedError

    def slot_path(self, node, period, generator):
        return Changed(self.H, self.R, generator("noise"), self.change)


@says(SENSORS, "Biased.slot_path: the noise y - H x must have the mean 0; got", **ONE)
class Biased(OwnNoise):
    def change(self, drawn, slot, x):
        return drawn[slot] + 0.05 * np.sqrt(0.5)


@says(SENSORS, "Louder.slot_path: the noise y - H x must have the covariance that R", **ONE)
class Louder(OwnNoise):
    def change(self, drawn, slot, x):
        return drawn[slot] * np.sqrt(1.2)


@says(SENSORS, "Diagonal.slot_path: the noise y - H x must have the covariance that R", **TWO)
class Diagonal(LinearSensor):
    def slot_path(self, node, period, generator):
        return SlotReadings(self.H, np.diag(np.diag(self.R)), generator("noise"))


@says(SENSORS, f"Coloured.slot_path: {WHITE} with the noise y - H x 1 steps apart", **ONE)
class Coloured(OwnNoise):
    def change(self, drawn, slot, x):
        return 0.98 * drawn[slot] + 0.2 * drawn[slot - 1] if slot else drawn[slot]


@says(SENSORS, "Echo.slot_path: ", **ONE)
class Echo(OwnNoise):
    def change(self, drawn, slot, x):
        return 0.98 * drawn[slot] + 0.2 * drawn[slot - 7] if slot > 6 else drawn[slot]


@says(SENSORS, "Together.slot_path: the noise y - H x must be uncorrelated with", **ONE)
class Together(LinearSensor):
    """The streams of node 0 for all nodes, but for a little."""

    def slot_path(self, node, period, generator):
        common = np.random.default_rng(generator("noise").integers(2**31) if node else 5)
        return SlotReadings(self.H, self.R, common)


@says(SENSORS, "Shared.slot_path: ", **ONE)
class Shared(LinearSensor):
    """Part of the noise is that of every other node."""

    def slot_path(self, node, period, generator):
        own, other = generator("noise"), np.random.default_rng(8)
        path = SlotReadings(self.H, 0.9 * self.R, own)
        second = SlotReadings(self.H, 0.1 * self.R, other)
        return Sum(path, second)


class Sum:
    def __init__(self, one, other):
        self.one, self.other = one, other

    def matrix(self, slot):
        return self.one.matrix(slot)

    def reading(self, slot, x):
        return self.one.reading(slot, x) + self.other.reading(slot, 0.0 * x)

    def several(self, slots, x):
        y, H = self.one.several(slots, x)
        return y + self.other.several(slots, 0.0 * x)[0], H


@says(SENSORS, "Relative.slot_path: another state must change a reading by H times", **ONE)
class Relative(OwnNoise):
    """Noise that grows with the state, of the right size on average."""

    def change(self, drawn, slot, x):
        return drawn[slot] * np.sqrt(0.5 + 0.5 * np.abs(x[0]))


@says(SENSORS, "WrongMatrix.slot_path: ", **ONE)
class WrongMatrix(LinearSensor):
    def slot_path(self, node, period, generator):
        return SlotReadings(1.001 * self.H, self.R, generator("noise"))


@says(SENSORS, "Hidden.slot_path: readings must be the same for equal streams", **ONE)
class Hidden(LinearSensor):
    """H that is used is not the one that is shown."""

    def slot_path(self, node, period, generator):
        return Stretched(self.H, self.R, generator("noise"))


class Stretched(SlotReadings):
    def several(self, slots, x):
        y, H = super().several(slots, x)
        return y + 0.1 * (H @ x[:, :, None])[:, :, 0], H


@says(SENSORS, "OwnSeed.slot_path: readings must be the same for equal streams", **ONE)
class OwnSeed(LinearSensor):
    def slot_path(self, node, period, generator):
        return SlotReadings(self.H, self.R, np.random.default_rng())


@says(SENSORS, f"FixedSeed.slot_path: {WHITE}", **ONE)
class FixedSeed(LinearSensor):
    def slot_path(self, node, period, generator):
        return SlotReadings(self.H, self.R, np.random.default_rng(3))


@says(SENSORS, "NodeSeed.slot_path: the noise y - H x must be uncorrelated", **ONE)
class NodeSeed(LinearSensor):
    def slot_path(self, node, period, generator):
        return SlotReadings(self.H, self.R, np.random.default_rng(node))


@says(SENSORS, "GlobalNoise.slot_path: must not use or seed global generators", **ONE)
class GlobalNoise(OwnNoise):
    def change(self, drawn, slot, x):
        return drawn[slot] + 0.1 * np.random.normal()  # noqa: NPY002


GENERATORS = {}


@says(SENSORS, "OneStream.slot_path: ", **ONE)
class OneStream(LinearSensor):
    """All nodes of a class draw from the stream that came first."""

    def slot_path(self, node, period, generator):
        random = GENERATORS.setdefault("first", generator("noise"))
        return SlotReadings(self.H, self.R, random)


@says(SENSORS, "LoudNode.slot_path: the noise y - H x", **ONE)
class LoudNode(LinearSensor):
    def slot_path(self, node, period, generator):
        R = 1.2 * self.R if node == 3 else self.R
        return SlotReadings(self.H, R, generator("noise"))


@says(SENSORS, "Ageing.slot_path: the noise y - H x must have the covariance", **ONE)
class Ageing(OwnNoise):
    """The mean variance of a run of 250 readings is right."""

    def change(self, drawn, slot, x):
        return drawn[slot] * np.sqrt(0.7 + 0.6 * min(slot, 249) / 249)


@says(SENSORS, "LoudPieces.path: increments of the pieces of a step must add up", **ONE)
class LoudPieces(LinearSensor):
    def path(self, random, cutting):
        return Doubling(self.H, self.R, random, cutting)


class Doubling(SensorPath):
    def moments(self, truth, seen, start, end):
        found = super().moments(truth, seen, start, end)
        return found if end == truth.step_end() else 1.05 * found


@says(SENSORS, "LoudSteps.path: the noise of increments", **ONE)
class LoudSteps(LinearSensor):
    def path(self, random, cutting):
        return SensorPath(self.H, 1.2 * self.R, random, cutting)


@says(SENSORS, "LoudSamples.samples: the noise y - H x must have the covariance", **SAMPLED)
class LoudSamples(LinearSensor):
    def samples(self, node, generator, horizon):
        return type(super().samples(node, generator, horizon))(
            self.H, 1.2 * self.R, generator("noise")
        )


@says(SENSORS, "LateTimes.sample_times: must lie in (0, ", **SAMPLED)
class LateTimes(LinearSensor):
    def sample_times(self, node, ordinal, generator, horizon):
        return super().sample_times(node, ordinal, generator, horizon) + 0.5


@says(SENSORS, "Rarely.sample_times: must be as many as the mean rate", **SAMPLED)
class Rarely(LinearSensor):
    def sample_times(self, node, ordinal, generator, horizon):
        times = 1.1 * super().sample_times(node, ordinal, generator, horizon)
        return times[times < horizon]


@says(SENSORS, "Stretches.sample_times: must ", **SAMPLED)
class Stretches(LinearSensor):
    def sample_times(self, node, ordinal, generator, horizon):
        return horizon * np.array([0.2, 0.5, 0.7])


REGRESSOR = {
    "nodes": (0, 3),
    "A": [[0.8, 0.1], [0.0, 0.5]],
    "B": [[1.0, 0.0], [0.0, 0.5]],
    "C": [[1.0, 0.0], [0.5, 1.0]],
    "start": [1.0, 0.0],
    "xi_cov": [[1.0, 0.2], [0.2, 1.0]],
    "R": [[0.3]],
}


DRIFTING = RegressorSensor(**{**REGRESSOR, "A": [[0.75, 0.1], [0.0, 0.5]]})
RESTLESS = RegressorSensor(**{**REGRESSOR, "xi_cov": [[1.25, 0.2], [0.2, 1.25]]})


@says(SENSORS, "Drifts.slot_path: ", **REGRESSOR)
class Drifts(RegressorSensor):
    def slot_path(self, node, period, generator):
        return RegressorReadings(DRIFTING, generator("noise"), generator("regressor"))


@says(SENSORS, "Restless.slot_path: ", **REGRESSOR)
class Restless(RegressorSensor):
    def slot_path(self, node, period, generator):
        return RegressorReadings(RESTLESS, generator("noise"), generator("regressor"))


@says(SENSORS, "Tied.slot_path: the noise y - H x must not depend on H", **REGRESSOR)
class Tied(RegressorSensor):
    """The noise of readings is made of what moves H."""

    def slot_path(self, node, period, generator):
        return RegressorReadings(self, generator("noise"), generator("noise"))


@cache
def moving(mean, cls):
    """The plant with the altered of a class."""
    return LinearPlant(**{**LINEAR, "mean": mean, **cls.altered})


class Other(LinearPlant):
    """Moves as the plant with ``altered``."""

    altered: ClassVar = {}

    def truth(self, random, frames=False):
        return moving(tuple(self.mean), type(self)).truth(random, frames)


@says(PLANTS, "WrongF.truth: a start that is moved must move the path by powers of F", **LINEAR)
class WrongF(Other):
    altered: ClassVar = {"F": 1.02 * np.array(LINEAR["F"])}


@says(PLANTS, "FixedF.truth: the noise x[k+1] - F x[k]", **LINEAR)
class FixedF(Other):
    """As WrongF, of a class whose mean cannot be moved."""

    altered: ClassVar = {"F": 1.02 * np.array(LINEAR["F"])}

    @property
    def start_mean(self):
        return np.array(LINEAR["mean"])


@says(PLANTS, "WrongQ.truth: the noise x[k+1] - F x[k] must have the covariance that Q", **LINEAR)
class WrongQ(Other):
    altered: ClassVar = {"Q": 1.2 * np.array(LINEAR["Q"])}


@says(PLANTS, "LostCorrelation.truth: the noise x[k+1] - F x[k] must have the cov", **LINEAR)
class LostCorrelation(Other):
    altered: ClassVar = {"Q": np.diag([1.0, 0.4])}


@says(PLANTS, "WrongStart.truth: x(0) less its mean must have the mean 0", **LINEAR)
class WrongStart(LinearPlant):
    def truth(self, random, frames=False):
        return moving((self.mean[0] + 0.1, self.mean[1]), Other).truth(random, frames)


@says(PLANTS, "WideStart.truth: x(0) less its mean must have the covariance that cov", **LINEAR)
class WideStart(Other):
    altered: ClassVar = {"cov": 1.2 * np.array(LINEAR["cov"])}


@says(PLANTS, "ZeroStart.truth: x(0) less its mean must have the covariance that cov", **LINEAR)
class ZeroStart(Other):
    altered: ClassVar = {"cov": np.zeros((2, 2))}


class Retold:
    """A path whose states are changed."""

    def __init__(self, truth, change):
        self.truth, self.change, self.frame_slots = truth, change, truth.frame_slots
        self.x = []

    def state(self, slot):
        while len(self.x) <= slot:
            self.x.append(self.change(self.x, self.truth.state(len(self.x))))
        return self.x[slot]

    local = absolute = state


@says(PLANTS, "Remembers.truth: the noise x[k+1] - F x[k] must", **LINEAR)
class Remembers(LinearPlant):
    """Noise that is correlated in time, of the right covariance."""

    def truth(self, random, frames=False):
        F, Q = self.F, np.linalg.cholesky(self.Q)
        start = super().truth(random).state(0)
        last = [np.zeros(2)]

        def change(before, x):
            z = random.standard_normal(2)
            w, last[0] = (0.98 * z + 0.2 * last[0] if before else z), z
            return F @ before[-1] + Q @ w if before else start

        return Retold(super().truth(random), change)


@says(PLANTS, "StateNoise.truth: a start that is moved must move the path", **LINEAR)
class StateNoise(LinearPlant):
    def truth(self, random, frames=False):
        F, Q = self.F, np.linalg.cholesky(self.Q)

        def change(before, x):
            if not before:
                return x
            size = np.sqrt(0.7 if abs(before[-1][0]) < 1.0 else 1.2)
            return F @ before[-1] + size * Q @ random.standard_normal(2)

        return Retold(super().truth(random), change)


@says(PLANTS, "OwnPath.truth: must make the same path from equal streams", **LINEAR)
class OwnPath(LinearPlant):
    def truth(self, random, frames=False):
        return super().truth(np.random.default_rng(), frames)


@says(PLANTS, "OnePath.truth: ", **LINEAR)
class OnePath(LinearPlant):
    def truth(self, random, frames=False):
        return super().truth(np.random.default_rng(1), frames)


@says(PLANTS, "GlobalPath.truth: must not use or seed global generators", **LINEAR)
class GlobalPath(LinearPlant):
    def truth(self, random, frames=False):
        return Retold(super().truth(random), lambda _, x: x + np.random.normal())  # noqa: NPY002


@says(
    PLANTS,
    "Forgets.truth: absolute states must be the same in frames",
    **{**LINEAR, "F": [[1.2, 0.1], [0.0, 0.5]]},
)
class Forgets(LinearPlant):
    def truth(self, random, frames=False):
        return LinearPlant(**{**LINEAR, "F": self.F, "mean": self.mean + frames}).truth(random)


@says(PLANTS, "Wider.n: must be the number of rows of the plant's matrix; got 3", **LINEAR)
class Wider(LinearPlant):
    @property
    def n(self):
        return 3


@says(PLANTS, "Signed.start_cov: must be positive semidefinite", **LINEAR)
class Signed(LinearPlant):
    @property
    def start_cov(self):
        return -np.eye(2)


class OtherFlow(Diffusion):
    altered: ClassVar = {}

    @property
    def other(self):
        mine = {name: getattr(self, name) for name in ("A", "B", "mean", "cov", "sensing_period")}
        return Diffusion(**{**mine, **self.altered})

    def paths(self, *arguments, **named):
        return self.other.paths(*arguments, **named)

    def sampled_truth(self, *arguments, **named):
        return self.other.sampled_truth(*arguments, **named)


@says(PLANTS, "WrongA.sampled_truth: a start that is moved must move the path", **FLOW)
class WrongA(OtherFlow):
    altered: ClassVar = {"A": 1.02 * np.array(FLOW["A"])}


@says(PLANTS, "WrongB.sampled_truth: the noise x(t + g) - e^(A g) x(t) over", **FLOW)
class WrongB(OtherFlow):
    altered: ClassVar = {"B": np.sqrt(1.2) * np.array(FLOW["B"])}


@says(PLANTS, "GridOnly.paths: the noise of x and its two moments", **FLOW)
class GridOnly(OtherFlow):
    altered: ClassVar = {"B": np.sqrt(1.2) * np.array(FLOW["B"])}

    def sampled_truth(self, *arguments, **named):
        return Diffusion.sampled_truth(self, *arguments, **named)


@says(PLANTS, "Alone.path: must make the same path from equal streams", **FLOW)
class Alone(OtherFlow):
    altered: ClassVar = {"B": 1.01 * np.array(FLOW["B"])}

    def paths(self, *arguments, **named):
        return Diffusion.paths(self, *arguments, **named)

    def sampled_truth(self, *arguments, **named):
        return Diffusion.sampled_truth(self, *arguments, **named)

    def path(self, *arguments, **named):
        return self.other.path(*arguments, **named)


@says(PLANTS, "Wide.start: x(0) less its mean must have the covariance", **FLOW)
class Wide(Diffusion):
    def starts(self, normals):
        drawn = np.sqrt(1.2) * normals.draw((1, self.n)) @ np.linalg.cholesky(self.start_cov).T
        return self.start_mean + drawn[:, 0]


NUMBERS = count()


@says(PLANTS, "OwnStream.sampled_truth: must make the same path from equal streams", **FLOW)
class OwnStream(Diffusion):
    def sampled_truth(self, random, *arguments, **named):
        own = Streams(next(NUMBERS)).generator("plant")
        return super().sampled_truth(own, *arguments, **named)


@says(PLANTS, "TimesMove.sampled_truth: must make the same path", **FLOW)
class TimesMove(Diffusion):
    """The path depends on how often it is looked at."""

    def sampled_truth(self, random, times, horizon, frames=False):
        random = Streams(len(times)).generator("plant")
        return super().sampled_truth(random, times, horizon, frames)


ONE_EDGE = {"protocol": "one-edge"}


@says(MATCHINGS, "Prefers.draw: must pair links as often as mean says; got", **ONE_EDGE)
class Prefers(Matching):
    def draw(self, topology, random):
        u, pair = random.random(), super().draw(topology, random)
        return [topology.links[0]] if u < 0.1 else pair


@says(MATCHINGS, "Unstated.draw: must not prefer one of equal links", **ONE_EDGE)
class Unstated(Matching):
    def mean(self, topology):
        from netkf.core.errors import ScenarioError

        raise ScenarioError("protocol", "has no exact mean", None, "")

    def draw(self, topology, random):
        u, pair = random.random(), super().draw(topology, random)
        return [topology.links[0]] if u < 0.04 else pair


LAST = {}


@says(MATCHINGS, "Keeps.draw: ", **ONE_EDGE)
class Keeps(Matching):
    """One slot in ten has the pair of the last one."""

    def draw(self, topology, random):
        u, pair = random.random(), super().draw(topology, random)
        LAST[topology.links] = pair = LAST.get(topology.links, pair) if u < 0.1 else pair
        return pair


@says(MATCHINGS, "Notes.draw: must not change its own object", **ONE_EDGE)
class Notes(Matching):
    def draw(self, topology, random):
        object.__setattr__(self, "count", getattr(self, "count", 0) + 1)
        return super().draw(topology, random)


@says(MATCHINGS, "Twice.draw: must have every node in one pair at most", **ONE_EDGE)
class Twice(Matching):
    def draw(self, topology, random):
        return [pair for _ in range(2) for pair in super(Twice, self).draw(topology, random)]


@says(MATCHINGS, "Strangers.draw: must pair the ends of links", **ONE_EDGE)
class Strangers(Matching):
    def draw(self, topology, random):
        return [tuple(sorted(random.choice(topology.nodes, 2, replace=False).tolist()))]


@says(MATCHINGS, "Reversed.draw: must pair the ends of links (i, j) with i < j", **ONE_EDGE)
class Reversed(Matching):
    def draw(self, topology, random):
        return [(j, i) for i, j in super().draw(topology, random)]


@says(MATCHINGS, "OwnDice.draw: must draw the same from equal generators", **ONE_EDGE)
class OwnDice(Matching):
    def draw(self, topology, random):
        return super().draw(topology, np.random.default_rng())


@says(MATCHINGS, "GlobalDice.draw: must not use or seed global generators", **ONE_EDGE)
class GlobalDice(Matching):
    def draw(self, topology, random):
        np.random.random()  # noqa: NPY002
        return super().draw(topology, random)


@says(MATCHINGS, "Lazier.mean: rows must sum to 1; got 0.9", **ONE_EDGE)
class Lazier(Matching):
    def mean(self, topology):
        return 0.9 * super().mean(topology)


@says(MATCHINGS, "Eager.draw: must pair links as often as mean says", protocol="one-edge", lazy=0.3)
class Eager(Matching):
    def draw(self, topology, random):
        return Matching("one-edge", lazy=0.26).draw(topology, random)
