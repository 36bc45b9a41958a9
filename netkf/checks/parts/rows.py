"""Promises that a scenario makes about its own parts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from netkf.checks.evidence import GAUSSIAN, Assumption, Finding, Promise
from netkf.checks.parts.moments import (
    NoiseMoments,
    compare_cells,
    compare_correlations,
    compare_means,
    compare_variances,
    moments,
    total,
)
from netkf.checks.parts.network_rows import network_promises
from netkf.checks.parts.noises import path_law, reading_labels, start_states, whitened_starts
from netkf.checks.parts.samples import PartSamples
from netkf.checks.parts.sources import is_own_class
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario

STARTS = 10_000
"""States x(0) that are drawn for the tests, since each run has only one."""
LAW_LEVEL = 0.05
"""Level at which the noise of a user's class is tested for being Gaussian."""


def _number_labels(noun: str, count: int) -> list[str]:
    """Return the labels "noun 0", "noun 1", ... of ``count`` entries."""
    return [f"{noun} {k}" for k in range(count)]


@lru_cache(maxsize=4)
def _start_moments(scenario: Scenario, seed: int) -> NoiseMoments:
    """Return the moments of STARTS whitened initial states."""
    return moments(whitened_starts(scenario, start_states(scenario, seed, STARTS)))


def _start_variance(samples: PartSamples, level: float) -> Finding:
    """Compare the variances of the initial states with the stated covariance.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    sums = _start_moments(samples.scenario, samples.seed)
    labels = _number_labels("direction", len(sums.first))
    gaussian = not is_own_class(samples.scenario.plant, "plant")
    return compare_variances(sums, labels, level, "directions of x(0)", gaussian)


def _start_mean(samples: PartSamples, level: float) -> Finding:
    """Compare the means of the initial states with the stated ones.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    sums = _start_moments(samples.scenario, samples.seed)
    return compare_means(sums, _number_labels("direction", len(sums.first)), level)


def _step_moments(samples: PartSamples) -> tuple[NoiseMoments, list[str]]:
    """Return the moments of the plant's noise and their labels."""
    sums = total(samples.steps)
    return sums, _number_labels("direction", len(sums.first))


def _step_variance(samples: PartSamples, level: float) -> Finding:
    """Compare the variances of the plant's noise with the stated ones.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    sums, labels = _step_moments(samples)
    gaussian = not is_own_class(samples.scenario.plant, "plant")
    return compare_variances(sums, labels, level, "directions of the noise", gaussian)


def _step_mean(samples: PartSamples, level: float) -> Finding:
    """Compare the means of the plant's noise with zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_means(*_step_moments(samples), level)


def _step_correlation(samples: PartSamples, level: float) -> Finding:
    """Compare the correlations of the plant's noise with zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_correlations(*_step_moments(samples), level)


def _reading_variance(samples: PartSamples, level: float) -> Finding:
    """Compare the variances of the readings' noise with R.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    labels = reading_labels(samples.scenario)
    gaussian = not _own_sensors(samples.scenario)
    return compare_variances(total(samples.readings), labels, level, "readings", gaussian)


def _reading_mean(samples: PartSamples, level: float) -> Finding:
    """Compare the means of the readings' noise with zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_means(total(samples.readings), reading_labels(samples.scenario), level)


def _reading_correlation(samples: PartSamples, level: float) -> Finding:
    """Compare the correlations of the readings' noise with zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_correlations(total(samples.readings), reading_labels(samples.scenario), level)


def _own_sensors(scenario: Scenario) -> bool:
    """Return True if a sensor is of a user's class."""
    return any(is_own_class(sensor, "sensor") for sensor in scenario.sensors)


def gaussian_noises(samples: PartSamples) -> Assumption:
    """Return the assumption that all noises are Gaussian, which rows about squared errors need.

    Built-in noises are Gaussian; those of a user's class, which states only a covariance, are
    tested by their counts in cells.
    """
    scenario, tested = samples.scenario, []
    if is_own_class(scenario.plant, "plant"):
        if samples.steps is not None:
            tested.append((total(samples.steps).cells, "the noise of the plant"))
        if scenario.plant.is_random and np.any(scenario.plant.start_cov):
            tested.append((_start_moments(scenario, samples.seed).cells, "the law of x(0)"))
    if _own_sensors(scenario) and samples.readings is not None:
        tested.append((total(samples.readings).cells, "the noise of the sensors"))
    rejected = [noun for cells, noun in tested if not _fills_evenly(cells)]
    evidence = f"{' and '.join(rejected)} is not" if rejected else "none is found that is not"
    return Assumption(GAUSSIAN, "the scenario", not rejected, evidence)


def _fills_evenly(cells: FloatArray) -> bool:
    """Return False if the test of ``cells`` (CELLS, d) rejects the Gaussian law at LAW_LEVEL."""
    finding = compare_cells(cells, [""] * cells.shape[1], LAW_LEVEL, "")
    return not finding.margin[2] < 0.0


START_ROWS = (
    Promise("the state starts with its covariance", "the scenario", (), _start_variance),
    Promise("the state starts with its mean", "the scenario", (), _start_mean),
)
PLANT_ROWS = (
    Promise("the plant's noise has its covariance", "the scenario", (), _step_variance),
    Promise("the plant follows its equation without a bias", "the scenario", (), _step_mean),
    Promise("the plant's noise is white", "the scenario", (), _step_correlation),
)
SENSOR_ROWS = (
    Promise("noises of the sensors have their covariance", "the scenario", (), _reading_variance),
    Promise("readings have no bias", "the scenario", (), _reading_mean),
    Promise(
        "noises of the sensors are white and independent of each other",
        "the scenario",
        (),
        _reading_correlation,
    ),
)


def part_promises(samples: PartSamples) -> tuple[Promise, ...]:
    """Return the promises about the parts of the scenario that these samples can test."""
    scenario = samples.scenario
    promises: list[Promise] = []
    if scenario.plant.is_random and np.any(scenario.plant.start_cov):
        promises += START_ROWS
    if samples.steps is not None and path_law(scenario) is not None:
        promises += PLANT_ROWS
    if samples.readings is not None:
        promises += SENSOR_ROWS
    return (*promises, *network_promises(samples))
