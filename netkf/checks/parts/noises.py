"""Noises of the plant and of the sensors, drawn again from the streams of a run, and whitened.

The plant and the sensors draw from streams of their own, so that their noises can be drawn again
without simulating filters or network. They are compared with the matrices of the scenario by plain
formulas that share no code with the plant.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from netkf.laws.noise import (
    MIN_VARIANCE_SHARE,
    NoiseDraws,
    is_visible,
    noise_draws,
    transition_law,
    whiten,
)
from netkf.laws.stating import stated_part
from netkf.linalg.arrays import FloatArray, IntArray, square_root
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant, SlotPlant
from netkf.plants.maps import NonlinearPlant
from netkf.plants.nonlinear import NonlinearSensor
from netkf.plants.readings import read_many
from netkf.rng.normals import StreamNormals
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor, takes_samples
from netkf.scenario.scenario import Scenario

MAX_STEPS = 64
"""Steps of a path, and readings of a sensor, that are tested in one run."""
MAX_ROWS = 24
"""Rows of readings of all sensors together that are tested."""


class PathLaw(NamedTuple):
    """The law of S steps ``x(t + gap) = Phi x(t) + w`` of a path: ``times`` (S + 1,) of the states
    in seconds, Phi (S, n, n), ``white`` (S, d, n) that whitens w of rank d (rows of nan where the
    rank is less), and the root mean squares ``sizes`` (S, n) of states before.
    """

    times: FloatArray
    Phi: FloatArray
    white: FloatArray
    sizes: FloatArray


@lru_cache(maxsize=8)
def path_law(scenario: Scenario) -> PathLaw | None:
    """Return the law of the state at up to MAX_STEPS + 1 times; None if recorded or nonlinear."""
    if not scenario.plant.is_random or not scenario.plant.linear:
        return None
    stated: Any = stated_part(scenario.plant, "plant")
    if scenario.slotted:
        slots = np.arange(min(MAX_STEPS, int(scenario.horizon / stated.period)) + 1)
        times, numbers = stated.period * slots, slots[:-1].tolist()
        laws = [(np.asarray(piece.F), np.asarray(piece.Q)) for piece in stated.pieces]
        steps = [laws[bisect.bisect_right(stated.change_slots, slot)] for slot in numbers]
    else:
        even = np.linspace(0.0, scenario.horizon * (1.0 - 1e-9), MAX_STEPS + 1)
        times = scenario.time_grid.snap(even)
        if len(stated.changes):
            steps = [_step_law(stated, *ends) for ends in itertools.pairwise(times.tolist())]
        else:
            steps = [transition_law(stated.A, stated.B, float(times[1]))] * MAX_STEPS
    n = stated.n
    mean, covariance, sizes = stated.start_mean, stated.start_cov, []
    factors = {id(W): whiten(W, MIN_VARIANCE_SHARE).factor for _, W in steps}
    rank = max((len(factor) for factor in factors.values()), default=0)
    white = np.full((len(steps), rank, n), np.nan)
    for k, (Phi, W) in enumerate(steps):
        sizes.append(np.sqrt(np.diagonal(covariance) + mean**2))
        mean, covariance = Phi @ mean, Phi @ covariance @ Phi.T + W
        white[k, : len(factors[id(W)])] = factors[id(W)]
    Phi_of_steps = np.array([Phi for Phi, _ in steps]).reshape(-1, n, n)
    return PathLaw(times, Phi_of_steps, white, np.array(sizes).reshape(-1, n))


def pieces_between(plant: Any, changes: Sequence[Any], start: Any, end: Any) -> Iterator[Any]:
    """Yield each piece of a plant from ``start`` to ``end``, and its length (seconds, or slots)."""
    cuts = [change for change in changes if start < change < end]
    for begin, stop in itertools.pairwise([start, *cuts, end]):
        yield plant.pieces[bisect.bisect_right(changes, begin)], stop - begin


def _step_law(plant: Diffusion, start: float, end: float) -> tuple[FloatArray, FloatArray]:
    """Return the transition matrix and the covariance of the noise of a plant that changes."""
    Phi, W = np.eye(plant.n), np.zeros((plant.n, plant.n))
    for piece, gap in pieces_between(plant, plant.changes.tolist(), start, end):
        F, Q = transition_law(piece.A, piece.B, gap)
        Phi, W = F @ Phi, F @ W @ F.T + Q
    return Phi, W


def plant_noises(scenario: Scenario, streams: Streams) -> NoiseDraws | None:
    """Return the whitened noise of the plant in the steps of a run; None without noise."""
    law = path_law(scenario)
    if law is None or not law.white.size:
        return None
    x = _states(scenario, streams, law)
    noise = x[1:] - np.einsum("kij,kj->ki", law.Phi, x[:-1])
    # Where the state has outgrown the noise, x(t + gap) - Phi x(t) is mostly rounding.
    sizes = np.abs(x[1:]) + np.einsum("kij,kj->ki", np.abs(law.Phi), np.abs(x[:-1]))
    usable = np.logical_and.accumulate(is_visible(law.white, sizes))
    whitened = np.where(usable, np.einsum("kij,kj->ki", law.white, noise), np.nan)
    return noise_draws(whitened, _standardise(x[:-1], law.sizes)[:, :, None])


def _standardise(x: FloatArray, sizes: FloatArray) -> FloatArray:
    return np.divide(x, sizes, out=np.zeros_like(x), where=np.broadcast_to(sizes > 0.0, x.shape))


def _states(scenario: Scenario, streams: Streams, law: PathLaw) -> FloatArray:
    if scenario.slotted:
        truth = scenario.slot_plant.truth(streams.generator("plant"))
        return np.array([truth.absolute(slot) for slot in range(len(law.times))])
    watched = _choose_times(scenario)
    path = watched.continuous_truth(streams, frames=False)
    return np.array([path.absolute(time) for time in law.times.tolist()])


@lru_cache(maxsize=8)
def _choose_times(scenario: Scenario) -> Scenario:
    """Return the scenario with states at the times of its path law, without an input."""
    law = path_law(scenario)
    assert law is not None
    return dataclasses.replace(scenario.undriven, probe=law.times)


def start_states(scenario: Scenario, seed: int, count: int) -> FloatArray:
    """Return x(0) (count, n) of the first ``count`` replicas, from their own streams."""
    # Built-in classes draw all replicas in one call, with the same numbers as one by one.
    if type(scenario.plant) in (LinearPlant, Diffusion, NonlinearPlant, NonlinearDiffusion):
        states = Streams(seed, 0, count).states("plant", [()])
        return scenario.plant.starts(StreamNormals(states))
    starts = []
    for replica in range(count):
        random = Streams(seed, replica).generator("plant")
        plant: Any = scenario.plant
        if isinstance(plant, SlotPlant):
            starts.append(plant.truth(random).absolute(0))
        else:
            starts.append(scenario.diffusion.start(random))
    return np.array(starts)


class SensorLaw(NamedTuple):
    """One sensor on one node: H (p, n), None if it varies or the readings are not linear, and the
    Cholesky factor (p, p) of R. ``sampled``: it takes samples under a continuous plant.
    """

    label: str
    node: int
    placed_sensor: PlacedSensor
    H: FloatArray | None
    root: FloatArray
    sampled: bool


@lru_cache(maxsize=8)
def sensor_laws(scenario: Scenario) -> tuple[SensorLaw, ...]:
    """Return the laws of sensors with drawn noise, until readings have MAX_ROWS rows together."""
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
            several = f"sensor {placed_sensor.ordinal} of " if len(placed_sensors) > 1 else ""
            root = np.linalg.cholesky(stated.R)
            sampled = not scenario.slotted and takes_samples(sensor)
            laws.append(SensorLaw(f"{several}node {node}", node, placed_sensor, H, root, sampled))
    return tuple(laws)


def reading_labels(scenario: Scenario) -> list[str]:
    """Return a label for each of the d noises of readings that are tested."""
    return [
        f"reading {row} of {law.label}" if len(law.root) > 1 else f"the reading of {law.label}"
        for law in sensor_laws(scenario)
        for row in range(len(law.root))
    ]


def reading_noises(scenario: Scenario, streams: Streams) -> NoiseDraws | None:
    """Return whitened noises of the first readings of a run; None without drawn sensors.

    Sensors read states drawn here, of typical size, since their noise must not depend on the state.
    The k-th noises of all sensors form one vector; entries of sensors with fewer readings are nan.
    """
    scenario = scenario.undriven
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
    node, ordinal = law.node, law.placed_sensor.ordinal
    plant: Any = scenario.plant
    random = streams.generator("check readings", node, ordinal)
    # Gaussian states of the size of the plant's: with the noise of ten slots, or ten seconds.
    covariance = plant.start_cov + 10.0 * np.asarray(plant.Q)
    root, sizes = square_root(covariance), np.sqrt(np.diagonal(covariance) + plant.start_mean**2)

    def draw(count: int) -> FloatArray:
        return np.asarray(plant.start_mean + random.standard_normal((count, len(root))) @ root.T)

    if scenario.slotted:
        count = min(MAX_STEPS, int(scenario.horizon / scenario.slot_plant.period))
        path: Any = scenario.slot_path(streams, node, law.placed_sensor)
    elif law.sampled:
        count = min(MAX_STEPS, len(scenario.sample_times(streams)[node, ordinal]))
        path = scenario.sample_path(streams, node, law.placed_sensor)
    else:
        path = scenario.sensors[law.placed_sensor.entry].path(
            *(streams.generator(purpose, node, ordinal) for purpose in ("noise", "cut"))
        )
        period = scenario.diffusion.sensing_period
        assert period is not None
        assert law.H is not None
        steps = min(MAX_STEPS // 4, int(scenario.horizon / period))
        if not steps:
            return np.empty((0, len(law.root))), draw(0)
        # Whole steps and cut ones take turns.
        pieces = read_pieces(path, period, steps, ((0.3,), ()), lambda gap: gap * draw(2))
        noise = pieces.noise(law.H).reshape(-1, len(law.root))
        noises = np.asarray(np.linalg.solve(law.root, noise.T).T, dtype=np.float64)
        gaps = np.diff(pieces.spans)[:, :, None]
        return noises, _standardise((pieces.x / gaps).reshape(-1, len(sizes)), sizes)
    x = draw(count)
    if not count:  # a run may be shorter than the first gap of the sensor
        return np.empty((0, len(law.root))), x
    sensor = scenario.located_sensors[law.placed_sensor.entry]
    if isinstance(sensor, NonlinearSensor):
        readings = [path.reading(k, x[k]) for k in range(count)]
        # Samples in continuous time come with a function that linearises them.
        y = np.array([one[0] if isinstance(one, tuple) else one for one in readings], dtype=float)
        expected = np.array([sensor.h(state, node) for state in x], dtype=np.float64)
    else:
        y, H = read_many(path, range(count), x)
        expected = np.einsum("spn,sn->sp", H, x) if law.H is None else x @ law.H.T
    noises = np.asarray(np.linalg.solve(law.root, (y - expected).T).T, dtype=np.float64)
    return noises, _standardise(x, sizes)


class _Grid(NamedTuple):
    """Stand-in for the path that a sensor of increments reads: sensing period, end of the step."""

    period: float
    end: float

    def step_end(self) -> float:
        return self.end


class Pieces(NamedTuple):
    """Increments over K pieces of steps.

    moments : (K, 2, p), integrals of dy and of P_1 dy over the piece (P_1: Legendre polynomial)
    x       : (K, 2, n), the same of x dt
    spans   : (K, 2), start and end of the piece, seconds
    step    : (K,), index of the step that the piece belongs to
    """

    moments: FloatArray
    x: FloatArray
    spans: FloatArray
    step: IntArray

    def noise(self, H: FloatArray) -> FloatArray:
        """Return the moments (K, 2, p) without those of ``H x``, in units of their deviations."""
        gaps = (self.spans[:, 1] - self.spans[:, 0])[:, None, None]
        # The moments of unit noise over g seconds have the variances g and g / 3.
        unit = np.sqrt(gaps * np.array([[1.0], [1.0 / 3.0]]))
        return np.asarray((self.moments - self.x @ H.T) / unit)


def read_pieces(
    path: Any,
    period: float,
    steps: int,
    cuts: Sequence[Sequence[float]],
    draw: Callable[[float], FloatArray],
) -> Pieces:
    """Return the increments of a continuous sensor's ``path`` over ``steps`` of ``period`` seconds,
    which are cut at the shares ``cuts`` in turn, of states with the moments ``draw(gap)`` (2, n).
    """
    pieces = []
    for k in range(steps):
        first, last = k * period, (k + 1) * period
        times = [first, *(first + share * period for share in cuts[k % len(cuts)]), last]
        for start, end in itertools.pairwise(times):
            x = draw(end - start)
            moments = np.asarray(path.moments(_Grid(period, last), x, start, end))
            pieces.append((moments, x, (start, end), k))
    return Pieces(*(np.array(column) for column in zip(*pieces, strict=True)))


def whitened_starts(scenario: Scenario, x: FloatArray) -> FloatArray:
    """Return x(0) ``x`` (R, n) of R runs less the stated mean and whitened, (R, d)."""
    plant: Any = scenario.plant
    factor = whiten(plant.start_cov, MIN_VARIANCE_SHARE).factor
    factor = factor[is_visible(factor, np.abs(plant.start_mean))]
    return np.asarray((x - plant.start_mean) @ factor.T)
