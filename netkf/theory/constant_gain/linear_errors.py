"""The errors of the filter with constant gains as a linear system with jumps."""

from __future__ import annotations

import numpy as np

from netkf.algorithms.constant_gain import ConstantGain
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.network.clocks import LinkClock
from netkf.network.matchings import Broadcast
from netkf.scenario.scenario import Scenario
from netkf.theory.common.jumps import ClockJumps, SlotJumps
from netkf.theory.common.random_links import Ways, poisson_ticks, ways_of
from netkf.theory.hybrid.samples import sampling_clock


def link_weights(scenario: Scenario) -> dict[tuple[int, int], FloatArray]:
    """Return the matrix (n, n) of each directed link (sender, receiver): its weight times I."""
    eye = np.eye(scenario.plant.n)
    return {(i, j): scenario.weight(j, i) * eye for i, j in scenario.topology.directions}


def slot_jumps(scenario: Scenario) -> SlotJumps:
    """Return the system in slots: predict, ``e - L (H e + v)``, reset."""
    gains, n = _gains(scenario), scenario.plant.n
    sensors = [scenario.observation(node) for node in scenario.nodes]
    closed = [np.eye(n) - L @ H for L, (H, _) in zip(gains, sensors, strict=True)]
    noise = block_diagonal([L @ R @ L.T for L, (_, R) in zip(gains, sensors, strict=True)])
    plant = scenario.slot_plant
    return SlotJumps(plant.F, plant.Q, np.stack(closed), noise, slot_ways(scenario))


def slot_ways(scenario: Scenario) -> Ways | None:
    """Return the links of a scenario with broadcasts in slots, None if there is none."""
    if not isinstance(scenario.network.activation, Broadcast):
        raise TheoryError("the exchanges are recorded: one outcome, not a law")
    weights = link_weights(scenario)
    return ways_of(scenario, weights, scenario.phase_length) if weights else None


def clock_jumps(scenario: Scenario) -> ClockJumps:
    """Return the system under Poisson clocks of links, directions or nodes."""
    gains, nodes, truth = _gains(scenario), scenario.nodes, scenario.truth
    drift, samples = [np.array(truth.A) for _ in nodes], []
    noise = np.tile(truth.B @ truth.B.T, (len(nodes), len(nodes)))
    n = len(truth.A)
    for k, node in enumerate(nodes):
        own, (H, R), L = slice(k * n, (k + 1) * n), scenario.observation(node), gains[k]
        if len(H):
            drift[k] -= L @ H
            noise[own, own] += L @ R @ L.T
        for place in scenario.sampled_sensors.get(node, ()):
            sensor = scenario.sensors[place.entry]
            sampling = sampling_clock(sensor)
            if sampling is None or not sampling.memoryless:
                raise TheoryError(f"node {node} does not sample by a Poisson clock")
            rate = float(sampling.mean_rate((node, place.ordinal)))
            samples.append((k, rate, L @ sensor.H))
            noise[own, own] += rate * L @ sensor.R @ L.T
    weights = link_weights(scenario)
    clock = scenario.network.activation
    if not weights or not isinstance(clock, LinkClock):
        return ClockJumps(len(nodes), block_diagonal(drift), noise, tuple(samples), None)
    if scenario.network.channel.delay.fixed != 0.0:
        raise TheoryError("exact mean squares under clocks are known where messages take no time")
    ways = ways_of(scenario, weights, 0.0)
    ticks = poisson_ticks(scenario, list(weights))
    return ClockJumps(len(nodes), block_diagonal(drift), noise, tuple(samples), ways, ticks)


def _gains(scenario: Scenario) -> list[FloatArray]:
    """Return the gain (n, p) of each node, without columns where it has no sensor."""
    algorithm, n = scenario.filter.algorithm, scenario.plant.n
    assert isinstance(algorithm, ConstantGain)
    return [
        algorithm.gain_of(k) if node in scenario.placed else np.zeros((n, 0))
        for k, node in enumerate(scenario.nodes)
    ]
