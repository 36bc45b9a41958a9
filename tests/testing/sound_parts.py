"""Sensors, plants and matchings such as users write, which keep their contracts."""

from dataclasses import dataclass

import numpy as np

from netkf.network.matchings import Matching
from netkf.parts import number, setting, vector
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.sensors import LinearSensor, Sensor

HEALTHY_SENSORS, HEALTHY_PLANTS, HEALTHY_MATCHINGS = [], [], []


def sound(table, **settings):
    def keep(cls):
        made = dataclass(frozen=True, eq=False)(cls)
        table.append((made, settings))
        return made

    return keep


class HeavyTailed:
    """Readings of a sensor whose noise is Laplace's."""

    def __init__(self, H, R, random):
        self.H, self.root, self.random, self.drawn = H, np.linalg.cholesky(R), random, []

    def matrix(self, slot):
        return self.H

    def reading(self, slot, x):
        while len(self.drawn) <= slot:
            self.drawn.append(self.random.laplace(scale=np.sqrt(0.5), size=len(self.root)))
        return self.H @ x + self.root @ self.drawn[slot]

    def several(self, slots, x):
        readings = [self.reading(slot, state) for slot, state in zip(slots, x, strict=True)]
        return np.array(readings), np.broadcast_to(self.H, (len(slots), *self.H.shape))


@sound(HEALTHY_SENSORS, nodes=(0, 1, 4), H=[[1.0, 0.5], [0.0, 1.0]], R=[[0.5, 0.2], [0.2, 0.3]])
class LaplaceSensor(LinearSensor):
    def slot_path(self, node, period, generator):
        return HeavyTailed(self.H, self.R, generator("noise"))


@sound(HEALTHY_SENSORS, nodes=(0, 1), direction=[3.0, 4.0], sigma=0.5)
class Bearing(Sensor):
    """From the contract alone: how far the state is along a direction."""

    direction: np.ndarray = setting(vector)
    sigma: float = setting(number(above=0.0))

    @property
    def H(self):
        return self.direction[None] / np.linalg.norm(self.direction)

    @property
    def R(self):
        return np.array([[self.sigma**2]])

    def slot_path(self, node, period, generator):
        return HeavyTailed(self.H, self.R, generator("laplace"))


@sound(
    HEALTHY_PLANTS, speed=0.3, Q=[[0.1, 0.0], [0.0, 0.1]], cov=np.eye(2), period=1.0, F=np.eye(2)
)
class Turning(LinearPlant):
    """A rotation; its F is computed."""

    speed: float = setting(number(above=0.0))

    def __post_init__(self):
        super().__post_init__()
        c, s = np.cos(self.speed), np.sin(self.speed)
        object.__setattr__(self, "F", np.array([[c, s], [-s, c]]))


class UniformPath:
    """x[k+1] = F x[k] + w[k] with uniform w, slot by slot."""

    frame_slots = None

    def __init__(self, plant, random):
        self.plant, self.random = plant, random
        self.x = [plant.start_mean + np.sqrt(plant.cov[0]) * random.standard_normal(1)]

    def state(self, slot):
        while len(self.x) <= slot:
            w = np.sqrt(3.0 * self.plant.Q[0]) * self.random.uniform(-1.0, 1.0, 1)
            self.x.append(self.plant.F @ self.x[-1] + w)
        return self.x[slot]

    local = absolute = state


@sound(HEALTHY_PLANTS, F=[[0.95]], Q=[[0.3]], cov=[[2.0]], period=0.1)
class UniformNoise(LinearPlant):
    def truth(self, random, frames=False):
        return UniformPath(self, random)


@sound(HEALTHY_PLANTS, A=[[0.0]], B=[[1.0]])
class FromTheTable(Diffusion):
    """A plant whose start is fixed by its class."""

    @property
    def start_mean(self):
        return np.array([7.0])

    @property
    def start_cov(self):
        return np.array([[0.25]])


@sound(HEALTHY_MATCHINGS, protocol="one-edge")
class FirstLinkMore(Matching):
    """Prefers a link, and says so."""

    def mean(self, topology):
        mean, count = np.zeros((len(topology.nodes),) * 2), len(topology.links)
        for k, (i, j) in enumerate(topology.links):
            a, b = topology.index[i], topology.index[j]
            mean[a, b] = mean[b, a] = (2.0 if k == 0 else 1.0) / (count + 1)
        return mean + np.diag(1.0 - mean.sum(axis=1))

    def draw(self, topology, random):
        k = int(random.integers(len(topology.links) + 1))
        return [topology.links[max(k - 1, 0)]]
