"""The errors of the filter with constant gains as a linear system with jumps."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from netkf.core.clock import Clock
from netkf.core.errors import TheoryError
from netkf.core.laws import Lattice
from netkf.linalg.arrays import FloatArray, block_diagonal, square_root, symmetric
from netkf.network.clocks import LinkClock
from netkf.plants.transitions import Transitions
from netkf.scenario.scenario import Scenario
from netkf.theory.common.delayed_jumps import DelayedJumps
from netkf.theory.common.jumps import ClockJumps, SlotJumps
from netkf.theory.common.random_links import (
    Directions,
    broadcast_directions,
    directions_of,
    poisson_ticks,
)
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


class SampledNode(NamedTuple):
    """A sensor that takes samples.

    node       : index of its node
    clock      : its sampling clock, None if the times are recorded
    entity     : (node id, index among the node's sensors), by which the clock knows it
    correction : (n, n) L H: a sample multiplies the error by I - L H
    noise      : (n, n) L R L', the covariance that a sample adds
    """

    node: int
    clock: Clock | None
    entity: tuple[int, int]
    correction: FloatArray
    noise: FloatArray


def clock_jumps(scenario: Scenario) -> ClockJumps | DelayedJumps | SlotJumps:
    """Return the errors as a linear system with jumps, for Poisson clocks, or periodic ones from
    tick to tick. Raises TheoryError for others, random delays, and delays beside bursts.
    """
    drifts, noise = _error_flow(scenario)
    samples, weights = _sampled_nodes(scenario), link_weights(scenario)
    clock = scenario.network.activation
    talks = bool(weights) and isinstance(clock, LinkClock)
    delay = scenario.network.channel.delay.fixed if talks else 0.0
    lattice = clock.gaps if isinstance(clock, LinkClock) and talks else None
    if isinstance(lattice, Lattice) and delay is not None:
        directions_of_tick = directions_of(scenario, weights, lattice.period)
        return _from_tick_to_tick(lattice, (drifts, noise), samples, directions_of_tick, delay)
    directions = directions_of(scenario, weights, math.inf) if talks else None
    if delay and directions is not None and directions.modes > 1:
        raise TheoryError(
            "exact mean squares of bursts under Poisson clocks are known if messages take no time"
        )
    n, sampled_nodes = scenario.plant.n, []
    for sensor in samples:
        if sensor.clock is None or not sensor.clock.memoryless:
            raise TheoryError(
                f"node {scenario.nodes[sensor.node]} does not sample by a Poisson clock"
            )
        rate, rows = float(sensor.clock.mean_rate(sensor.entity)), _node_slice(sensor.node, n)
        noise[rows, rows] += rate * sensor.noise
        sampled_nodes.append((sensor.node, rate, sensor.correction))
    drift = block_diagonal(list(drifts))
    ticks = poisson_ticks(scenario, list(weights)) if talks else ()
    instant = ClockJumps(len(drifts), drift, noise, tuple(sampled_nodes), directions, ticks)
    if not delay or not ticks:
        return instant
    return DelayedJumps(
        instant, scenario.diffusion.A, scenario.diffusion.B @ scenario.diffusion.B.T, delay
    )


def _node_slice(k: int, n: int) -> slice:
    return slice(k * n, (k + 1) * n)


def _error_flow(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Return A - L H (N, n, n) of errors, and the noise (N n, N n) of all, per second."""
    gains, truth = _node_gains(scenario), scenario.diffusion
    N, n = len(gains), len(truth.A)
    drift, noise = np.tile(truth.A, (N, 1, 1)), np.tile(truth.B @ truth.B.T, (N, N))
    for k, node in enumerate(scenario.nodes):
        (H, R), L = scenario.observation_matrices(node), gains[k]
        if len(H):
            drift[k] -= L @ H
            noise[_node_slice(k, n), _node_slice(k, n)] += L @ R @ L.T
    return drift, noise


def _sampled_nodes(scenario: Scenario) -> list[SampledNode]:
    gains, sampled_nodes = _node_gains(scenario), []
    for k, node in enumerate(scenario.nodes):
        for placed_sensor in scenario.sampled_sensors.get(node, ()):
            sensor, L = scenario.sensors[placed_sensor.entry], gains[k]
            clock, entity = sampling_clock(sensor), (node, placed_sensor.ordinal)
            sampled_nodes.append(SampledNode(k, clock, entity, L @ sensor.H, L @ sensor.R @ L.T))
    return sampled_nodes


def _from_tick_to_tick(
    lattice: Lattice,
    flow: tuple[FloatArray, FloatArray],
    samples: list[SampledNode],
    directions: Directions,
    delay: float,
) -> SlotJumps:
    """Return the system from exchange to exchange of periodic clocks that tick together."""
    _require_one_clock(lattice, samples)
    drift, flow_noise = flow
    N, n, _ = drift.shape
    if delay > 0.0 and (delay >= lattice.period or not (drift == drift[0]).all()):
        raise TheoryError(
            "periodic clocks with a delay are known where it is below the period and sensors take "
            "samples"
        )
    closed, sample_noise = np.tile(np.eye(n), (N, 1, 1)), np.zeros_like(flow_noise)
    for sensor in samples:
        closed[sensor.node] -= sensor.correction
        sample_noise[_node_slice(sensor.node, n), _node_slice(sensor.node, n)] += sensor.noise
    # From the last arrival to the tick, its samples, and from there to the arrival of its messages.
    transitions = Transitions(block_diagonal(list(drift)), square_root(flow_noise))
    to_tick, tick_noise = transitions.law(lattice.period - delay)
    to_arrival, arrival_noise = transitions.law(delay)
    C = block_diagonal(list(closed))
    noise = to_arrival @ (C @ tick_noise @ C.T + sample_noise) @ to_arrival.T + arrival_noise
    transition = to_arrival @ C @ to_tick
    steps = np.stack([transition[_node_slice(k, n), _node_slice(k, n)] for k in range(N)])
    # ``steps`` has the whole way from exchange to exchange, so that nothing is left to predict:
    # F = I and Q = 0.
    return SlotJumps(np.eye(n), np.zeros((n, n)), steps, symmetric(noise), directions)


def _require_one_clock(lattice: Lattice, samples: list[SampledNode]) -> None:
    """Raise TheoryError unless all links tick together, and sensors sample then."""
    if lattice.jitter or lattice.random_phase:
        raise TheoryError("periodic clocks are known where all tick together, without jitter")
    for sensor in samples:
        if sensor.clock is None or sensor.clock.gaps != lattice:
            raise TheoryError("sensors do not sample at the ticks of the network's periodic clock")


def _node_gains(scenario: Scenario) -> list[FloatArray]:
    """Return the gain (n, p) of each node, without columns where it has no sensor."""
    algorithm: Any = scenario.filter.algorithm
    n = scenario.plant.n
    return [
        algorithm.gain_of(k) if node in scenario.placed_sensors else np.zeros((n, 0))
        for k, node in enumerate(scenario.nodes)
    ]
