"""The errors of the filter with constant gains as a linear system with jumps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.network.clocks import LinkClock
from netkf.scenario.scenario import Scenario
from netkf.theory.common.jumps import ClockJumps, SlotJumps
from netkf.theory.common.random_links import broadcast_directions, directions_of, poisson_ticks
from netkf.theory.hybrid.samples import sampling_clock


def link_weights(scenario: Scenario) -> dict[tuple[int, int], FloatArray]:
    """Return the matrix (n, n) of each directed link (sender, receiver): its weight times I."""
    eye = np.eye(scenario.plant.n)
    return {(i, j): scenario.weight(j, i) * eye for i, j in scenario.topology.directions}


def constant_gain_jumps(scenario: Scenario) -> SlotJumps:
    """Return the errors in slots as a linear system; raises TheoryError for recorded exchanges."""
    gains, n = _node_gains(scenario), scenario.plant.n
    sensors = [scenario.observation_matrices(node) for node in scenario.nodes]
    closed = [np.eye(n) - L @ H for L, (H, _) in zip(gains, sensors, strict=True)]
    noise = block_diagonal([L @ R @ L.T for L, (_, R) in zip(gains, sensors, strict=True)])
    plant = scenario.linear_plant
    directions = broadcast_directions(scenario, link_weights(scenario))
    return SlotJumps(plant.F, plant.Q, np.stack(closed), noise, directions)


def clock_jumps(scenario: Scenario) -> ClockJumps:
    """Return the errors as a linear system with jumps, for Poisson clocks; raises TheoryError for
    others, and for messages that take time.
    """
    gains, truth, weights = _node_gains(scenario), scenario.diffusion, link_weights(scenario)
    N, n = len(gains), len(truth.A)
    drifts, noise = np.tile(truth.A, (N, 1, 1)), np.tile(truth.B @ truth.B.T, (N, N))
    samples = []
    for k, (node, L) in enumerate(zip(scenario.nodes, gains, strict=True)):
        (H, R), rows = scenario.observation_matrices(node), slice(k * n, (k + 1) * n)
        if len(H):
            drifts[k] -= L @ H
            noise[rows, rows] += L @ R @ L.T
        for placed_sensor in scenario.sampled_sensors.get(node, ()):
            sensor = scenario.sensors[placed_sensor.entry]
            clock = sampling_clock(sensor)
            if clock is None or not clock.memoryless:
                raise TheoryError(f"node {node} does not sample by a Poisson clock")
            rate = float(clock.mean_rate((node, placed_sensor.ordinal)))
            noise[rows, rows] += rate * L @ sensor.R @ L.T
            # A sample multiplies the error by I - L H.
            samples.append((k, rate, L @ sensor.H))
    system = ClockJumps(N, block_diagonal(list(drifts)), noise, tuple(samples), None)
    if not weights or not isinstance(scenario.network.activation, LinkClock):
        return system
    if scenario.network.channel.delay.fixed:
        raise TheoryError("exact mean squares under Poisson clocks need messages that take no time")
    directions = directions_of(scenario, weights, math.inf)
    return replace(system, directions=directions, ticks=poisson_ticks(scenario, list(weights)))


def _node_gains(scenario: Scenario) -> list[FloatArray]:
    """Return the gain (n, p) of each node, without columns where it has no sensor."""
    algorithm: Any = scenario.filter.algorithm
    n = scenario.plant.n
    return [
        algorithm.gain_of(k) if node in scenario.placed_sensors else np.zeros((n, 0))
        for k, node in enumerate(scenario.nodes)
    ]
