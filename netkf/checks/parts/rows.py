"""Promises that a scenario makes about its own parts."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np
import scipy

from netkf.checks.evidence import GAUSSIAN, PLANT, SENSORS, START, Assumption, Finding, Promise
from netkf.checks.laws import find
from netkf.checks.parts.events import PartSamples
from netkf.checks.parts.network_rows import network_promises
from netkf.checks.parts.noises import path_law, reading_labels, start_states, whitened_starts
from netkf.laws.noise import (
    NoiseDraws,
    compare_cells,
    compare_correlations,
    compare_means,
    compare_variances,
)
from netkf.laws.stating import is_own_class
from netkf.scenario.scenario import Scenario

STARTS = 10_000
"""States x(0) that are drawn for the tests, since each run has only one."""
LAW_LEVEL = 0.05
"""Level at which the noise of a user's class is tested for being Gaussian."""
VARIANCE_TOLERANCE, MEAN_TOLERANCE, CORRELATION_TOLERANCE = 0.1, 0.1, 0.2
"""Tolerated relative error of a variance, mean in standard deviations, and correlation."""


@lru_cache(maxsize=4)
def _start_draws(scenario: Scenario, seed: int) -> NoiseDraws:
    z = whitened_starts(scenario, start_states(scenario, seed, STARTS))
    return NoiseDraws(z[None], np.zeros((1, 2, 0, z.shape[1])))


def _draws(samples: PartSamples, group: str) -> tuple[NoiseDraws, list[str], str, bool]:
    """Return the noises of a group, their labels and noun, and if they are Gaussian."""
    scenario = samples.scenario
    if group == SENSORS:
        own = any(is_own_class(sensor, "sensor") for sensor in scenario.sensors)
        return samples.readings, reading_labels(scenario), "readings", not own
    draws = samples.steps if group == PLANT else _start_draws(scenario, samples.seed)
    # The entries are eigenvectors of the covariance, not states.
    labels = [f"direction {k}" for k in range(draws.z.shape[2])]
    noun = "directions of the noise" if group == PLANT else "directions of x(0)"
    return draws, labels, noun, not is_own_class(scenario.plant, "plant")


def _mean(group: str, samples: PartSamples, level: float) -> Finding:
    draws, labels, *_ = _draws(samples, group)
    return find(compare_means(draws.z, labels, level, draws.states), MEAN_TOLERANCE)


def _variance(group: str, samples: PartSamples, level: float) -> Finding:
    draws, labels, noun, gaussian = _draws(samples, group)
    return find(compare_variances(draws.z, labels, level, noun, gaussian), VARIANCE_TOLERANCE)


def _correlation(group: str, samples: PartSamples, level: float) -> Finding:
    draws, labels, *_ = _draws(samples, group)
    return find(compare_correlations(draws.z, labels, level), CORRELATION_TOLERANCE)


def gaussian_noises(samples: PartSamples) -> Assumption:
    """Return the assumption that all noises are Gaussian, which tests of squared errors need:
    built-in ones are, those of a user's class are tested by how they fill cells.
    """
    plant, groups = samples.scenario.plant, []
    if samples.steps is not None:
        groups.append((PLANT, "the noise of the plant"))
    if plant.is_random and np.any(plant.start_cov):
        groups.append((START, "the law of x(0)"))
    if samples.readings is not None:
        groups.append((SENSORS, "the noise of the sensors"))
    rejected = [noun for group, noun in groups if not _is_gaussian(samples, group)]
    evidence = f"{' and '.join(rejected)} is not" if rejected else "none is found that is not"
    return Assumption(GAUSSIAN, "the scenario", not rejected, evidence)


def _is_gaussian(samples: PartSamples, group: str) -> bool:
    if group == START and not is_own_class(samples.scenario.plant, "plant"):
        return True
    draws, labels, noun, gaussian = _draws(samples, group)
    if gaussian:
        return True
    return compare_cells(scipy.special.ndtr(draws.z), labels, LAW_LEVEL, noun).worst is None


def _rows(group: str, *rows: tuple[str, Callable[..., Finding]]) -> tuple[Promise, ...]:
    return tuple(
        Promise(text, "the scenario", (), partial(test, group), group=group) for text, test in rows
    )


# A bias comes first: squares about a wrong mean, and products of such, are wrong too.
START_ROWS = _rows(
    START,
    ("the state starts with its mean", _mean),
    ("the state starts with its covariance", _variance),
)
PLANT_ROWS = _rows(
    PLANT,
    ("the plant follows its equation without a bias", _mean),
    ("the plant's noise has its covariance", _variance),
    ("the plant's noise is white", _correlation),
)
SENSOR_ROWS = _rows(
    SENSORS,
    ("readings have no bias", _mean),
    ("noises of the sensors have their covariance", _variance),
    ("noises of the sensors are white and independent of each other", _correlation),
)


def part_promises(samples: PartSamples) -> tuple[Promise, ...]:
    """Return promises about start, plant, sensors, clocks, channels and matchings."""
    scenario = samples.scenario
    promises: list[Promise] = []
    if scenario.plant.is_random and np.any(scenario.plant.start_cov):
        promises += START_ROWS
    if samples.steps is not None and path_law(scenario) is not None:
        promises += PLANT_ROWS
    if samples.readings is not None:
        promises += SENSOR_ROWS
    return (*promises, *network_promises(samples))
