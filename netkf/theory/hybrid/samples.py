"""Terms of the bound H(12) for sensors that sample.

With ``g(P) = P - P H' (H P H' + R)^-1 H P`` a Poisson clock of rate s adds ``s (g(M) - M)``, and a
reading at a known time makes M jump to g(M); docs/poisson_samples.md has the proof.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.core.clock import Clock
from netkf.core.laws import Lattice
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.plants.sampling import RecordedSampling
from netkf.plants.sensors import Sensor
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import (
    Observation,
    nodes_by_estimator,
    stack_information,
    timed_observations,
)
from netkf.theory.hybrid.dense import FullMatrix, SparseOrFull, full_matrix, matrix_of

MAX_FULL = 100  # nodes up to which weights are a full matrix


class PoissonSamples(NamedTuple):
    """S sensors of p rows each that sample by Poisson clocks.

    nodes : (S,) indices of their nodes
    H, R  : (S, p, n), (S, p, p)
    rate  : (S,) samples per second
    heard : (N, S), sparse or a FullMatrix: rate (per second) at which messages that the sensor's
            node sends at its samples arrive at node i, times their weight
    """

    nodes: np.ndarray
    H: FloatArray
    R: FloatArray
    rate: FloatArray
    heard: SparseOrFull

    def update_gains(self, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the gains K (S, n, p) and ``I - K H`` (S, n, n) of the sensors at P (N, n, n)."""
        # C = P H' and K = C (H C + R)^-1
        C = P[self.nodes] @ np.swapaxes(self.H, 1, 2)
        K = np.swapaxes(np.linalg.solve(self.H @ C + self.R, np.swapaxes(C, 1, 2)), 1, 2)
        return K, np.eye(P.shape[-1]) - K @ self.H

    def sample_decrease(self, P: FloatArray) -> FloatArray:
        """Return ``P H' (H P H' + R)^-1 H P`` (S, n, n) of the node of each sensor at P."""
        C = P[self.nodes] @ np.swapaxes(self.H, 1, 2)
        return np.asarray(C @ np.linalg.solve(self.H @ C + self.R, np.swapaxes(C, 1, 2)))

    def restrict(self, node: int) -> PoissonSamples:
        """Return the sensors of the node with index ``node`` as those of a network of one node."""
        at_node = self.nodes == node
        count = int(at_node.sum())
        silent = full_matrix(1, count)
        return PoissonSamples(
            np.zeros(count, dtype=int), self.H[at_node], self.R[at_node], self.rate[at_node], silent
        )


class SampleJump(NamedTuple):
    """Samples at a known time (seconds).

    observations : by the index of the node
    weights      : (N, N) entry (i, j) is the mean weight that node i gives to the message that j
                   sends at its sample; None if nothing is sent
    """

    time: float
    observations: dict[int, Observation]
    weights: FloatArray | None


def sampling_clock(sensor: Sensor) -> Clock | None:
    """Return a sensor's sampling clock, or None without one."""
    return getattr(sensor, "sampling", None)


def has_known_times(sensor: Sensor) -> bool:
    """Return True if the times of a sampled sensor are known before a run."""
    clock = sampling_clock(sensor)
    if sensor.record is not None or isinstance(clock, RecordedSampling):
        return True
    # A periodic clock without jitter and with a given phase ticks at known times.
    law = None if clock is None else clock.gaps
    return isinstance(law, Lattice) and not (law.jitter or law.random_phase)


def randomly_sampled_sensors(scenario: Scenario) -> list[tuple[int, PlacedSensor]]:
    """Return (node, sensor) for each sampled sensor whose times are not known beforehand."""
    return [
        (node, placed_sensor)
        for node, placed_sensors in scenario.sampled_sensors.items()
        for placed_sensor in placed_sensors
        if not has_known_times(scenario.sensors[placed_sensor.entry])
    ]


def transmits_at_samples(scenario: Scenario) -> bool:
    """Return True if the nodes transmit at the instants of their samples."""
    clock = scenario.network.activation
    return isinstance(clock, LinkClock) and clock.at == "readings"


def _mean_link_weights(scenario: Scenario) -> SparseOrFull:
    """Return delivery times weight (receivers, senders) of messages sent at samples."""
    index, talks = scenario.topology.index, scenario.filter.algorithm.timing.talks
    ways = scenario.topology.directions if talks and transmits_at_samples(scenario) else ()
    values = [scenario.mean_delivery((i, j)) * scenario.weight(j, i) for i, j in ways]
    places = [index[j] for _, j in ways], [index[i] for i, _ in ways]
    return matrix_of(values, places, len(index), full=len(index) <= MAX_FULL)


def poisson_samples(scenario: Scenario) -> tuple[PoissonSamples, ...]:
    """Return all sensors with Poisson clocks, in groups of equal numbers p of rows."""
    index, estimators = scenario.topology.index, nodes_by_estimator(scenario)
    estimator_of = {node: k for k, nodes in enumerate(estimators) for node in nodes}
    entries_by_rows: dict[int, list[tuple[int, FloatArray, FloatArray, float, int]]] = {}
    for node, placed_sensor in randomly_sampled_sensors(scenario):
        sensor = scenario.sensors[placed_sensor.entry]
        clock = sampling_clock(sensor)
        assert clock is not None
        rate = clock.mean_rate((node, placed_sensor.ordinal))
        R = scenario.noise_covariance(placed_sensor.entry, believed=True)
        entry = (estimator_of[node], np.asarray(sensor.H), R, rate, index[node])
        entries_by_rows.setdefault(len(R), []).append(entry)
    groups, weights = [], _mean_link_weights(scenario)
    for entries in entries_by_rows.values():
        nodes, H, R, rates = (np.array([entry[k] for entry in entries]) for k in range(4))
        senders = [entry[4] for entry in entries]
        heard: Any = weights[: len(estimators), senders] * rates
        if not isinstance(heard, FullMatrix):
            heard = scipy.sparse.csr_array(heard)
        groups.append(PoissonSamples(nodes, H, R, rates, heard))
    return tuple(groups)


def sample_jumps(scenario: Scenario) -> tuple[SampleJump, ...]:
    """Return the samples at known times below the horizon, in the order of time."""
    # Known times do not depend on the seed; a varying H does, and is that of the scenario's seed.
    by_time = timed_observations(
        scenario,
        Streams(scenario.seed),
        join=stack_information,
        chosen=lambda placed: has_known_times(scenario.sensors[placed.entry]),
    )
    jumps, nodes = [], range(len(scenario.nodes))
    link_weights: Any = _mean_link_weights(scenario) if by_time else full_matrix(0, 0)
    for time, observations in sorted(by_time.items()):
        sends = np.isin(nodes, list(observations))
        weights = (link_weights * sends).toarray() if link_weights.nnz else None
        jumps.append(SampleJump(time, observations, weights))
    return tuple(jumps)
