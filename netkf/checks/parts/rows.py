"""Promises that a scenario makes about its own parts."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from netkf.checks.evidence import (
    GAUSSIAN,
    PLANT,
    SENSORS,
    START,
    Assumption,
    Finding,
    Promise,
)
from netkf.checks.parts.moments import (
    NoiseMoments,
    compare_cells,
    compare_correlations,
    compare_means,
    compare_variances,
    moments,
    total,
)
from netkf.checks.parts.network_rows import loss_assumptions, network_promises
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
    """Return the sums of STARTS states x(0), drawn again from their streams and whitened by the
    stated mean and covariance, by which rows about the start are tested; cached.
    """
    return moments(whitened_starts(scenario, start_states(scenario, seed, STARTS)))


def _start_variance(samples: PartSamples, level: float) -> Finding:
    """Test that x(0) has the stated covariance: whitened by it, states x(0) have variance 1.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    sums = _start_moments(samples.scenario, samples.seed)
    # The entries of a whitened state are numbered: they are eigenvectors, not states.
    labels = _number_labels("direction", len(sums.first))
    gaussian = not is_own_class(samples.scenario.plant, "plant")
    return compare_variances(sums, labels, level, "directions of x(0)", gaussian)


def _start_mean(samples: PartSamples, level: float) -> Finding:
    """Test that x(0) has the stated mean: less that and whitened, states x(0) have mean 0.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    sums = _start_moments(samples.scenario, samples.seed)
    return compare_means(sums, _number_labels("direction", len(sums.first)), level)


def _step_moments(samples: PartSamples) -> tuple[NoiseMoments, list[str]]:
    """Return the sums over all runs of the plant's noise, whitened by its stated covariance, and a
    label for each of its entries.
    """
    sums = total(samples.steps)
    return sums, _number_labels("direction", len(sums.first))


def _step_variance(samples: PartSamples, level: float) -> Finding:
    """Test that the plant's noise has its stated covariance: whitened by it, it has variance 1.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    sums, labels = _step_moments(samples)
    gaussian = not is_own_class(samples.scenario.plant, "plant")
    return compare_variances(sums, labels, level, "directions of the noise", gaussian)


def _step_mean(samples: PartSamples, level: float) -> Finding:
    """Compare the means of the plant's noise, and its correlations with the states before, with
    zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_means(*_step_moments(samples), level)


def _step_correlation(samples: PartSamples, level: float) -> Finding:
    """Compare the correlations of the plant's noise, between its entries and in time, with zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_correlations(*_step_moments(samples), level)


def _reading_variance(samples: PartSamples, level: float) -> Finding:
    """Test that noises of the readings have their stated covariances R: whitened by these, they
    have variance 1.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    labels = reading_labels(samples.scenario)
    gaussian = not _own_sensors(samples.scenario)
    return compare_variances(total(samples.readings), labels, level, "readings", gaussian)


def _reading_mean(samples: PartSamples, level: float) -> Finding:
    """Compare the means of the readings' noise, and its correlations with the states read, with
    zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_means(total(samples.readings), reading_labels(samples.scenario), level)


def _reading_correlation(samples: PartSamples, level: float) -> Finding:
    """Compare the correlations of the readings' noise, between readings and in time, with zero.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    return compare_correlations(total(samples.readings), reading_labels(samples.scenario), level)


def _own_sensors(scenario: Scenario) -> bool:
    """Return True if a sensor is of a user's class."""
    return any(is_own_class(sensor, "sensor") for sensor in scenario.sensors)


def gaussian_noises(samples: PartSamples) -> Assumption:
    """Return the assumption that all noises are Gaussian, a row of the table of assumptions, which
    tests of squared errors need.

    Built-in noises are Gaussian; those of a user's class, which states only a covariance, are
    tested by how they fill cells that have equal probability under the normal law.
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
    """Return False if noises are found not to be Gaussian, at LAW_LEVEL: ``cells`` (CELLS, d) are
    the numbers of d whitened entries in cells of equal probability under the normal law.
    """
    finding = compare_cells(cells, [""] * cells.shape[1], LAW_LEVEL, "")
    # Rejected if the upper end of the margin (value, low, high) is below 0.
    return not finding.margin[2] < 0.0


def _noise_rows(group: str, *rows: tuple[str, Callable[..., Finding]]) -> tuple[Promise, ...]:
    """Return promises of the scenario about one noise, from statements and tests."""
    return tuple(Promise(text, "the scenario", (), test, group=group) for text, test in rows)


# A bias comes first: squares about a wrong mean, and products of such, are wrong too.
START_ROWS = _noise_rows(
    START,
    ("the state starts with its mean", _start_mean),
    ("the state starts with its covariance", _start_variance),
)
PLANT_ROWS = _noise_rows(
    PLANT,
    ("the plant follows its equation without a bias", _step_mean),
    ("the plant's noise has its covariance", _step_variance),
    ("the plant's noise is white", _step_correlation),
)
SENSOR_ROWS = _noise_rows(
    SENSORS,
    ("readings have no bias", _reading_mean),
    ("noises of the sensors have their covariance", _reading_variance),
    ("noises of the sensors are white and independent of each other", _reading_correlation),
)


def part_assumptions(samples: PartSamples) -> list[Assumption]:
    """Return the assumptions of the tests of a scenario's parts, each with whether it holds."""
    return loss_assumptions(samples.scenario)


def part_promises(samples: PartSamples) -> tuple[Promise, ...]:
    """Return what a scenario itself states about its start, plant, sensors, clocks, channels and
    matchings, as promises that these samples can test; a user's own class may break one.
    """
    scenario = samples.scenario
    promises: list[Promise] = []
    if scenario.plant.is_random and np.any(scenario.plant.start_cov):
        promises += START_ROWS
    if samples.steps is not None and path_law(scenario) is not None:
        promises += PLANT_ROWS
    if samples.readings is not None:
        promises += SENSOR_ROWS
    return (*promises, *network_promises(samples))
