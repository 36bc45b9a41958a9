"""Sensors that sample, as the bound H(12) meets them.

With ``g(P) = P - P H' (H P H' + R)^-1 H P`` a Poisson clock of rate s adds ``s (g(M) - M)``, and a
reading at a known time makes M jump to g(M); docs/poisson_samples.md has the proof.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import scipy.sparse

from netkf.core.clock import Clock
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock, Periodic
from netkf.plants.sampling import RecordedSampling
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Streams
from netkf.scenario.sampling import sample_path, sample_times, sampled_sensors
from netkf.scenario.scenario import Placed, Scenario
from netkf.theory.numerics.updates import Observation, stack_observations


class PoissonSamples(NamedTuple):
    """S sensors of p rows each that sample by Poisson clocks.

    nodes (S,) places of their nodes; H (S, p, n), R (S, p, p); rate (S,), per second; heard (N, S)
    sparse: the rate at which node i uses what the sensor's node sends at its samples, times weight.
    """

    nodes: np.ndarray
    H: FloatArray
    R: FloatArray
    rate: FloatArray
    heard: scipy.sparse.csr_array

    def gains(self, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """K (S, n, p) and ``I - K H`` (S, n, n) at covariances (N, n, n)."""
        C = P[self.nodes] @ np.swapaxes(self.H, 1, 2)
        K = np.swapaxes(np.linalg.solve(self.H @ C + self.R, np.swapaxes(C, 1, 2)), 1, 2)
        return K, np.eye(P.shape[-1]) - K @ self.H

    def sample_decrease(self, P: FloatArray) -> FloatArray:
        """(S, n, n): what a sample takes off P (N, n, n)."""
        C = P[self.nodes] @ np.swapaxes(self.H, 1, 2)
        return np.asarray(C @ np.linalg.solve(self.H @ C + self.R, np.swapaxes(C, 1, 2)))

    def noise(self, P: FloatArray) -> FloatArray:
        """``K R K'`` (S, n, n)."""
        K, _ = self.gains(P)
        return np.asarray(K @ self.R @ np.swapaxes(K, 1, 2))

    def only(self, node: int) -> PoissonSamples:
        """Those of one node, as if it were alone."""
        mine = self.nodes == node
        count = int(mine.sum())
        silent = scipy.sparse.csr_array((1, count))
        return PoissonSamples(
            np.zeros(count, dtype=int), self.H[mine], self.R[mine], self.rate[mine], silent
        )


class Jump(NamedTuple):
    """What happens at a known time: ``seen`` readings by node; ``sent`` (N, N): entry (i, j) is the
    weight that what j then sends gets at i, on average.
    """

    time: float
    seen: dict[int, Observation]
    sent: FloatArray | None


def clock_of(sensor: Sensor) -> Clock | None:
    """The sampling clock; None of increment sensors and of recorded ones."""
    return sensor.sampling if isinstance(sensor, LinearSensor) else None


def planned(sensor: Sensor) -> bool:
    """Whether the times of a sampled sensor are known before a run."""
    clock = clock_of(sensor)
    if clock is None or isinstance(clock, RecordedSampling):
        return True
    return type(clock) is Periodic and clock.jitter == 0.0 and not isinstance(clock.phase, str)


def at_random(scenario: Scenario) -> list[tuple[int, Placed]]:
    """Sampled sensors by node whose times are not known beforehand."""
    return [
        (node, place)
        for node, places in sampled_sensors(scenario).items()
        for place in places
        if not planned(scenario.sensors[place.entry])
    ]


def by_readings(scenario: Scenario) -> bool:
    """Whether nodes transmit when they have sampled."""
    clock = scenario.network.activation
    return isinstance(clock, LinkClock) and clock.at == "readings"


def deliveries(scenario: Scenario) -> dict[tuple[int, int], float]:
    """By places (receiver, sender), the share of messages that arrive times their weight."""
    if not scenario.filter.algorithm.talks or not by_readings(scenario):
        return {}
    index, loss = scenario.topology.index, scenario.network.channel.loss
    return {
        (index[j], index[i]): loss.mean_delivery((i, j), scenario.table_probability((i, j)))
        * scenario.weight(j, i)
        for i, j in scenario.topology.directions
    }


def poisson_samples(scenario: Scenario) -> tuple[PoissonSamples, ...]:
    """Of all sensors with Poisson clocks, grouped by their number of rows."""
    index, size = scenario.topology.index, len(scenario.nodes)
    weights = deliveries(scenario)
    pooled = scenario.filter.algorithm.pooled
    found: dict[int, list[tuple[int, FloatArray, FloatArray, float, int]]] = {}
    for node, place in at_random(scenario):
        sensor = scenario.sensors[place.entry]
        clock = clock_of(sensor)
        assert clock is not None
        rate, R = clock.mean_rate((node, place.ordinal)), scenario.noise(place.entry, True)
        for reader in range(size) if pooled else [index[node]]:
            entry = (reader, np.asarray(sensor.H), R, rate, index[node])
            found.setdefault(len(R), []).append(entry)
    groups = []
    for entries in found.values():
        heard = np.zeros((size, len(entries)))
        for k, (_, _, _, rate, sender) in enumerate(entries):
            for (i, j), weight in weights.items():
                if j == sender:
                    heard[i, k] = rate * weight
        nodes, H_, R_, rates = (np.array([entry[k] for entry in entries]) for k in range(4))
        groups.append(PoissonSamples(nodes, H_, R_, rates, scipy.sparse.csr_array(heard)))
    return tuple(groups)


def jumps(scenario: Scenario) -> tuple[Jump, ...]:
    """All samples at known times below the horizon."""
    places = {
        (node, place.ordinal): place
        for node, some in sampled_sensors(scenario).items()
        for place in some
        if planned(scenario.sensors[place.entry])
    }
    if not places:
        return ()
    streams, n = Streams(scenario.seed), scenario.plant.n
    times, index = sample_times(scenario, streams), scenario.topology.index
    here: dict[float, dict[int, list[Observation]]] = {}
    for (node, ordinal), place in places.items():
        sensor = scenario.sensors[place.entry]
        path = sample_path(scenario, streams, node, place) if sensor.varying else None
        R = scenario.noise(place.entry, True)
        for k, time in enumerate(times[node, ordinal].tolist()):
            H = sensor.H if path is None else path.reading(k, np.zeros(n))[1]
            here.setdefault(time, {}).setdefault(index[node], []).append(Observation(H, R, R))
    everyone = range(len(scenario.nodes))
    found = []
    for time in sorted(here):
        seen = {node: stack_observations(readings, n) for node, readings in here[time].items()}
        sent = _sent(scenario, list(seen))
        if scenario.filter.algorithm.pooled:
            whole = stack_observations(list(itertools.chain(*here[time].values())), n)
            seen = dict.fromkeys(everyone, whole)
        found.append(Jump(time, seen, sent))
    return tuple(found)


def _sent(scenario: Scenario, senders: list[int]) -> FloatArray | None:
    weights = deliveries(scenario)
    if not weights:
        return None
    matrix = np.zeros((len(scenario.nodes),) * 2)
    for (i, j), weight in weights.items():
        if j in senders:
            matrix[i, j] = weight
    return matrix
