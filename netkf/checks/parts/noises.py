"""Noises of the plant and of the sensors, drawn again from the streams of a run, and whitened.

The plant and the sensors draw from streams of their own, so that their noises can be drawn again
without simulating filters or network. They are compared with the matrices of the scenario by plain
formulas that share no code with the plant.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from netkf.laws.noise import MIN_VARIANCE_SHARE, NoiseDraws, noise_draws, whiten
from netkf.laws.stating import stated_part
from netkf.linalg.arrays import FloatArray, square_root
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.nonlinear import NonlinearSensor
from netkf.rng.normals import StreamNormals
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.model import PlacedSensor, takes_samples
from netkf.scenario.scenario import Scenario

MAX_STEPS = 64
"""Steps of a path, and readings of a sensor, that are tested in one run."""
MAX_ROWS = 24
"""Rows of readings of all sensors together that are tested."""
VISIBLE = 1e-5
"""Largest rounding error of a state, relative to the deviation of the noise, for a usable step."""


class PathLaw(NamedTuple):
    """The law of S steps ``x(t + gap) = Phi x(t) + w`` of a path.

    times     : (S + 1,) seconds of the states
    Phi       : (n, n)
    white     : (d, n) matrix that whitens w, which has rank d
    deviation : largest standard deviation of an entry of w
    sizes     : (S, n) root mean squares of the states before the steps
    """

    times: FloatArray
    Phi: FloatArray
    white: FloatArray
    deviation: float
    sizes: FloatArray


@lru_cache(maxsize=8)
def path_law(scenario: Scenario) -> PathLaw | None:
    """Return the law of the true state at up to MAX_STEPS + 1 times of a run, by the matrices of
    the scenario: the transition (n, n) of a step between two times, and the whitening (d, n) of its
    noise, with which simulated paths are compared; None for recorded states.
    """
    if not scenario.plant.is_random:
        return None
    stated: Any = stated_part(scenario.plant, "plant")
    if scenario.slotted:
        slots = min(MAX_STEPS, int(scenario.horizon / stated.period))
        times = stated.period * np.arange(slots + 1)
        Phi, W = np.asarray(stated.F), np.asarray(stated.Q)
    else:
        even = np.linspace(0.0, scenario.horizon * (1.0 - 1e-9), MAX_STEPS + 1)
        times = scenario.time_grid.snap(even)
        Phi, W = _discretise(stated.A, stated.B, float(times[1]))
    deviation = float(np.sqrt(np.diagonal(W).max()))
    return PathLaw(
        times,
        Phi,
        whiten(W, MIN_VARIANCE_SHARE).factor,
        deviation,
        _sizes(stated, Phi, W, len(times) - 1),
    )


def _sizes(plant: Any, Phi: FloatArray, W: FloatArray, steps: int) -> FloatArray:
    """Return the root mean squares (steps, n) of the states before each of ``steps`` steps."""
    mean, covariance, sizes = plant.start_mean, plant.start_cov, []
    for _ in range(steps):
        sizes.append(np.sqrt(np.diagonal(covariance) + mean**2))
        mean, covariance = Phi @ mean, Phi @ covariance @ Phi.T + W
    return np.array(sizes).reshape(steps, len(W))


def _discretise(A: FloatArray, B: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """Return ``exp(A gap)`` and the covariance (n, n) of the noise (Van Loan 1978)."""
    n = len(A)
    blocks = np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]])
    exponential = scipy.linalg.expm(blocks * gap)
    Phi = exponential[n:, n:].T
    W = Phi @ exponential[:n, n:]
    return Phi, 0.5 * (W + W.T)


def plant_noises(scenario: Scenario, streams: Streams) -> NoiseDraws | None:
    """Return the plant's noise in the steps of one run's true path, whitened by its stated
    covariance to d entries; None for plants without noise and for recorded states.
    """
    law = path_law(scenario)
    if law is None or not len(law.white):
        return None
    x = _states(scenario, streams, law)
    noise = x[1:] - x[:-1] @ law.Phi.T
    # Where the state has outgrown the noise, x(t + gap) - Phi x(t) is mostly rounding.
    accurate = np.abs(x[1:]).max(axis=1) * np.finfo(float).eps < VISIBLE * law.deviation
    usable = np.logical_and.accumulate(accurate)
    whitened = np.where(usable[:, None], noise @ law.white.T, np.nan)
    states = _standardise(x[:-1], law.sizes)
    return noise_draws(whitened, np.repeat(states[:, :, None], whitened.shape[1], axis=2))


def _standardise(x: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return S states ``x`` (S, n) in units of their root mean squares ``sizes`` (S, n)."""
    return np.divide(x, sizes, out=np.zeros_like(x), where=sizes > 0.0)


def _states(scenario: Scenario, streams: Streams, law: PathLaw) -> FloatArray:
    """Return the true states (S + 1, n) of a run at ``law.times``, drawn again."""
    if scenario.slotted:
        truth = scenario.slot_plant.truth(streams.generator("plant"))
        return np.array([truth.absolute(slot) for slot in range(len(law.times))])
    watched = _choose_times(scenario)
    path = watched.continuous_truth(streams, frames=False)
    return np.array([path.absolute(time) for time in law.times.tolist()])


@lru_cache(maxsize=8)
def _choose_times(scenario: Scenario) -> Scenario:
    """Return the scenario with states at the times of its path law; cached for its tables."""
    law = path_law(scenario)
    assert law is not None
    return dataclasses.replace(scenario, probe=law.times)


def start_states(scenario: Scenario, seed: int, count: int) -> FloatArray:
    """Return x(0) (count, n) of replicas 0 to ``count`` - 1 of the runs of ``seed``, each drawn
    from the replica's own stream as a run would draw it.
    """
    # Built-in classes draw all replicas in one call, with the same numbers as one by one.
    if type(scenario.plant) in (LinearPlant, Diffusion):
        states = ReplicaStreams(seed, 0, count).states("plant", [()])
        return scenario.plant.starts(StreamNormals(states))
    starts = []
    for replica in range(count):
        random = Streams(seed, replica).generator("plant")
        plant: Any = scenario.plant
        if isinstance(plant, LinearPlant):
            starts.append(plant.truth(random).absolute(0))
        else:
            starts.append(scenario.diffusion.start(random))
    return np.array(starts)


class SensorLaw(NamedTuple):
    """One sensor on one node: H (p, n), None if it varies or the readings are not linear, and the
    Cholesky factor (p, p) of R.

    ``sampled`` is True for a sensor that takes samples under a continuous plant.
    """

    label: str
    node: int
    placed_sensor: PlacedSensor
    H: FloatArray | None
    root: FloatArray
    sampled: bool


@lru_cache(maxsize=8)
def sensor_laws(scenario: Scenario) -> tuple[SensorLaw, ...]:
    """Return the laws by which readings are whitened, one for each sensor with drawn (not recorded)
    noise, until their readings together have MAX_ROWS rows.
    """
    laws: list[SensorLaw] = []
    rows = 0
    for node, placed_sensors in scenario.placed_sensors.items():
        for placed_sensor in placed_sensors:
            sensor = scenario.sensors[placed_sensor.entry]
            if not sensor.is_random:
                continue
            stated: Any = stated_part(sensor, "sensor")
            rows += len(stated.R)
            if rows > MAX_ROWS:
                return tuple(laws)
            # An H that varies is random and comes with each reading.
            H = None if stated.varying else np.asarray(stated.H)
            label = (
                f"sensor {placed_sensor.ordinal} of node {node}"
                if len(placed_sensors) > 1
                else f"node {node}"
            )
            root = np.linalg.cholesky(stated.R)
            sampled = not scenario.slotted and takes_samples(sensor)
            laws.append(SensorLaw(label, node, placed_sensor, H, root, sampled))
    return tuple(laws)


def reading_labels(scenario: Scenario) -> list[str]:
    """Return a label for each of the d noises of readings that are tested, in the order of their
    sums: one for each row of each sensor.
    """
    return [
        f"reading {row} of {law.label}" if len(law.root) > 1 else f"the reading of {law.label}"
        for law in sensor_laws(scenario)
        for row in range(len(law.root))
    ]


def reading_noises(scenario: Scenario, streams: Streams) -> NoiseDraws | None:
    """Return the noises of the sensors' first readings in the run of ``streams``, whitened by their
    stated covariances to d entries; None without drawn sensors.

    Sensors read states drawn here, of typical size, since their noise must not depend on the state.
    The k-th noises of all sensors form one vector; entries of sensors with fewer readings are nan.
    """
    laws = sensor_laws(scenario)
    if not laws:
        return None
    size = sum(len(law.root) for law in laws)
    z = np.full((MAX_STEPS, size), np.nan)
    state_columns = np.zeros((MAX_STEPS, scenario.plant.n, size))
    first_entry = 0
    for law in laws:
        noises, states = _whitened_noises(scenario, streams, law)
        entries = slice(first_entry, first_entry + noises.shape[1])
        z[: len(noises), entries] = noises
        state_columns[: len(noises), :, entries] = states[:, :, None]
        first_entry = entries.stop
    return noise_draws(z, state_columns)


def _whitened_noises(
    scenario: Scenario, streams: Streams, law: SensorLaw
) -> tuple[FloatArray, FloatArray]:
    """Return whitened noises (S, p) of a sensor's first readings, and scaled states (S, n)."""
    random = streams.generator("check readings", law.node, law.placed_sensor.ordinal)
    if scenario.slotted:
        count = min(MAX_STEPS, int(scenario.horizon / scenario.slot_plant.period))
        path: Any = scenario.slot_path(streams, law.node, law.placed_sensor)
    elif law.sampled:
        times = scenario.sample_times(streams)[law.node, law.placed_sensor.ordinal]
        count = min(MAX_STEPS, len(times))
        path = scenario.sample_path(streams, law.node, law.placed_sensor)
    else:
        # A run may be shorter than one step of the sensor, and then has no reading.
        empty = np.empty((0, len(law.root))), np.empty((0, scenario.plant.n))
        steps = [empty, *_increment_noises(scenario, streams, law, random)]
        noises, states = (np.concatenate(part) for part in zip(*steps, strict=True))
        return noises, states
    x = _typical_states(scenario, random, count)
    if not count:
        return np.empty((0, len(law.root))), np.empty((0, scenario.plant.n))
    sensor = scenario.located_sensors[law.placed_sensor.entry]
    if isinstance(sensor, NonlinearSensor):
        y = np.array([_reading_of(path, k, x[k]) for k in range(count)], dtype=np.float64)
        expected = np.array([sensor.h(state, law.node) for state in x], dtype=np.float64)
    else:
        y, H = path.several(range(count), x)
        expected = np.einsum("spn,sn->sp", H, x) if law.H is None else x @ law.H.T
    noises = np.asarray(np.linalg.solve(law.root, (y - expected).T).T, dtype=np.float64)
    return noises, _standardise(x, _state_sizes(scenario, x))


def _reading_of(path: Any, k: int, x: FloatArray) -> FloatArray:
    """Return reading number ``k`` (p,) of a sensor that is not linear where the state is x (n,)."""
    reading = path.reading(k, x)
    return np.asarray(reading[0] if isinstance(reading, tuple) else reading)


def _typical_states(scenario: Scenario, random: np.random.Generator, count: int) -> FloatArray:
    """Return ``count`` Gaussian states (count, n) of the size that the plant's states have."""
    root = square_root(_typical_covariance(scenario))
    plant: Any = scenario.plant
    return np.asarray(plant.start_mean + random.standard_normal((count, len(root))) @ root.T)


def _typical_covariance(scenario: Scenario) -> FloatArray:
    """Return the covariance (n, n) of x(0) and of the noise of ten slots or seconds."""
    plant: Any = scenario.plant
    return np.asarray(plant.start_cov + 10.0 * np.asarray(plant.Q))


def _state_sizes(scenario: Scenario, x: FloatArray) -> FloatArray:
    """Return the root mean squares (S, n) of states that :func:`_typical_states` draws."""
    sizes = np.sqrt(np.diagonal(_typical_covariance(scenario)) + scenario.plant.start_mean**2)
    return np.asarray(np.broadcast_to(sizes, x.shape))


class _Grid(NamedTuple):
    """Stand-in for the path that a sensor of increments reads: sensing period and end of the
    present step in seconds.
    """

    period: float
    end: float

    def step_end(self) -> float:
        """Return the end of the present step in seconds."""
        return self.end


def _increment_noises(
    scenario: Scenario, streams: Streams, law: SensorLaw, random: np.random.Generator
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield whitened noises (2, p) of a continuous sensor's increments, and states (2, n)."""
    sensor: Any = scenario.sensors[law.placed_sensor.entry]
    node, ordinal = law.node, law.placed_sensor.ordinal
    path = sensor.path(*(streams.generator(p, node, ordinal) for p in ("noise", "cut")))
    period = scenario.diffusion.sensing_period
    assert period is not None
    assert law.H is not None
    for k in range(min(MAX_STEPS // 4, int(scenario.horizon / period))):
        start, end = k * period, (k + 1) * period
        # Whole steps and cut ones take turns.
        ends = [end] if k % 2 else [start + 0.3 * period, end]
        for piece_end in ends:
            x = _typical_states(scenario, random, 2)
            x_integral = x * (piece_end - start)
            dy = path.moments(_Grid(period, end), x_integral, start, piece_end)
            scale = np.sqrt((piece_end - start) * np.array([[1.0], [1.0 / 3.0]]))
            noises = np.linalg.solve(law.root, ((dy - x_integral @ law.H.T) / scale).T).T
            yield noises, _standardise(x, _state_sizes(scenario, x))
            start = piece_end


def whitened_starts(scenario: Scenario, x: FloatArray) -> FloatArray:
    """Return x(0) ``x`` (R, n) of R runs less the stated mean and whitened, (R, d)."""
    plant: Any = scenario.plant
    return np.asarray((x - plant.start_mean) @ whiten(plant.start_cov, MIN_VARIANCE_SHARE).factor.T)
