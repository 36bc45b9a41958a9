"""Readings of the nodes of a scenario as H, the assumed R and a square root of the true R.

Increments, and samples in slots or at times. The H of random regressors is that of the run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.root_flow import whiten_observation
from netkf.linalg.arrays import FloatArray, as_kernel_array, block_diagonal
from netkf.plants.readings import covariance_of
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.sampling import sample_path, sample_times
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


class Observation(NamedTuple):
    """Readings at one instant.

    H    : (p, n)
    R    : (p, p) noise covariance that the filter assumes
    root : (p, p) a square root of the true noise covariance
    """

    H: FloatArray
    R: FloatArray
    root: FloatArray


def stack_observations(observations: list[Observation], n: int) -> Observation:
    """Join ``observations`` with independent noises into one: H (p, n), R and root (p, p)."""
    if len(observations) == 1:
        return observations[0]
    H = np.concatenate([np.zeros((0, n)), *(observation.H for observation in observations)])
    R, root = (block_diagonal([observation[k] for observation in observations]) for k in (1, 2))
    return Observation(H, R, root)


def stack_information(observations: list[Observation], n: int) -> Observation:
    """Join ``observations`` as ``stack_observations``, with n rows of the same H' R^-1 H instead of
    more: for covariances alone.
    """
    if sum(len(observation.H) for observation in observations) <= n:
        return stack_observations(observations, n)
    rows = [whiten_observation(observation.H, observation.R) for observation in observations]
    eye = np.eye(n)
    return Observation(np.asarray(np.linalg.qr(np.concatenate(rows), mode="r")), eye, eye)


def joseph_update(P: FloatArray, observation: Observation) -> FloatArray:
    """Return ``(I - K H) P (I - K H)' + K R K'`` (n, n), Joseph's form, after a reading."""
    H, R = observation.H, observation.R
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    closed = np.eye(len(P)) - K @ H
    return np.asarray(closed @ P @ closed.T + K @ R @ K.T)


def nodes_by_estimator(scenario: Scenario) -> list[tuple[int, ...]]:
    """Return the nodes whose readings each filter uses: one filter uses all if they are pooled."""
    if scenario.filter.algorithm.timing.pooled:
        return [scenario.nodes]
    return [(node,) for node in scenario.nodes]


def _noises(scenario: Scenario) -> list[tuple[FloatArray, FloatArray]]:
    """Return for each sensor entry the assumed R (p, p) and a root of the true one."""
    # The gain is computed from the R that the filter assumes, the noise drawn with the true one.
    return [
        (
            as_kernel_array(scenario.noise_covariance(k, believed=True)),
            np.asarray(np.linalg.cholesky(scenario.noise_covariance(k, believed=False))),
        )
        for k in range(len(scenario.sensors))
    ]


def _noise(path: Any, k: int, laws: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the assumed R and the root of the true one (p, p) of reading ``k`` of a path."""
    R, root = laws
    own, true = covariance_of(path, k, R), covariance_of(path, k, root @ root.T)
    return (R, root) if own is R else (own, np.asarray(np.linalg.cholesky(true)))


def increment_observations(scenario: Scenario) -> list[Observation]:
    """Return the continuous readings of each estimator; equal ones are one object."""
    placed, n = scenario.increment_sensors, scenario.plant.n
    entries_in_use = {sensor.entry for sensors in placed.values() for sensor in sensors}
    noises = _noises(scenario)
    single = {k: Observation(scenario.sensors[k].H, *noises[k]) for k in entries_in_use}
    stacked: dict[tuple[int, ...], Observation] = {}
    observations = []
    for nodes in nodes_by_estimator(scenario):
        entries = tuple(sensor.entry for node in nodes for sensor in placed.get(node, ()))
        if entries not in stacked:
            stacked[entries] = stack_observations([single[k] for k in entries], n)
        observations.append(stacked[entries])
    return observations


def _joining_changes(join: Callable[..., Any], n: int) -> Callable[[int, list[Observation]], Any]:
    """Return a function that joins the readings of an estimator, anew only where they change."""
    joined: dict[int, tuple[list[Observation], Any]] = {}

    def join_readings(estimator: int, readings: list[Observation]) -> Any:
        known = joined.get(estimator)
        if known is None or not _are_the_same(known[0], readings):
            known = joined[estimator] = readings, join(readings, n)
        return known[1]

    return join_readings


def _are_the_same(some: list[Observation], others: list[Observation]) -> bool:
    return len(some) == len(others) and all(
        a is b
        for one, other in zip(some, others, strict=True)
        for a, b in zip(one, other, strict=True)
    )


def slot_observations(
    scenario: Scenario,
    run: Run,
    join: Callable[..., Any] = stack_observations,
    is_up: Callable[[int, int], bool] = lambda *_: True,
) -> Callable[[int], dict[int, Any]]:
    """Return a function from an increasing slot to its readings by estimator, as ``join`` makes
    them, of nodes that ``is_up(id, slot)``.
    """
    streams, n = Streams(run.seed, run.replica), scenario.plant.n
    noises = _noises(scenario)
    estimators = [
        [
            (node, sensor, scenario.slot_path(streams, node, sensor))
            for node in nodes
            for sensor in scenario.placed_sensors.get(node, ())
        ]
        for nodes in nodes_by_estimator(scenario)
    ]

    join_readings = _joining_changes(join, n)

    def observe(slot: int) -> dict[int, Any]:
        """Return the readings of ``slot``, H (p, n) and R (p, p), by index of the estimator."""
        observations = {}
        for estimator, paths in enumerate(estimators):
            if not paths:
                continue
            rows = [(node, sensor, path, path.matrix(slot)) for node, sensor, path in paths]
            # A sensor without a reading in this slot has a matrix without rows.
            readings = [
                Observation(H, *_noise(path, slot, noises[sensor.entry]))
                for node, sensor, path, H in rows
                if len(H) and is_up(node, slot)
            ]
            # Sensors that do not vary have the same matrices in all slots.
            observations[estimator] = join_readings(estimator, readings)
        return observations

    return observe


def timed_observations(
    scenario: Scenario,
    streams: Streams,
    join: Callable[..., Any] = stack_observations,
    is_up: Callable[[int, float], bool] = lambda *_: True,
    chosen: Callable[[PlacedSensor], bool] = lambda _: True,
) -> dict[float, dict[int, Any]]:
    """Return sampled readings by time (s) and estimator, as ``join`` makes them, of nodes that
    ``is_up(id, time)`` and of ``chosen`` sensors.
    """
    by_node = {node: [*filter(chosen, own)] for node, own in scenario.sampled_sensors.items()}
    if not any(by_node.values()):
        return {}
    n, noises, times = scenario.plant.n, _noises(scenario), sample_times(scenario, streams)
    fixed = [Observation(s.H, *noise) for s, noise in zip(scenario.sensors, noises, strict=True)]
    observations: dict[float, dict[int, list[Observation]]] = {}
    for estimator, nodes in enumerate(nodes_by_estimator(scenario)):
        for node in nodes:
            for placed in by_node.get(node, ()):
                sensor = scenario.sensors[placed.entry]
                # A varying H is drawn with the run's own streams, so that it is the one that the
                # engine used.
                path = sample_path(scenario, streams, node, placed) if sensor.varying else None
                for k, time in enumerate(times[node, placed.ordinal].tolist()):
                    reading = fixed[placed.entry]
                    if path is not None:
                        H = path.reading(k, np.zeros(n))[1]
                        reading = Observation(H, *_noise(path, k, noises[placed.entry]))
                    at_time = observations.setdefault(time, {}).setdefault(estimator, [])
                    if is_up(node, time):
                        at_time.append(reading)
    join_readings = _joining_changes(join, n)
    return {
        time: {estimator: join_readings(estimator, readings) for estimator, readings in own.items()}
        for time, own in observations.items()
    }
