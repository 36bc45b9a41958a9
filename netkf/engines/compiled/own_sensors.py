"""Sensors of users in the compiled engine: Python reads them, many readings at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import cholesky, solve_lower
from netkf.plants.nonlinear import NonlinearSensor
from netkf.plants.readings import covariance_of, read_many
from netkf.plants.recorded import RecordedSensor
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.scenario.model import takes_samples

BUILT_IN = (LinearSensor, RegressorSensor, RecordedSensor)
METHODS = ("path", "slot_path", "samples", "matrix_of", "varying")
"""What says how a sensor reads."""


def is_own(sensor: Sensor) -> bool:
    """Return True if a sensor reads in a way of its own, or is bad: kernels do not know it."""
    return sensor.fault is not None or not reads_as_built_in(sensor)


def reads_as_built_in(sensor: Sensor) -> bool:
    """Return True if healthy readings are those of a built-in class."""
    return any(
        isinstance(sensor, base)
        and all(getattr(type(sensor), m, None) is getattr(base, m, None) for m in METHODS)
        for base in BUILT_IN
    )


def reads_in_python(sensor: Sensor, slotted: bool) -> bool:
    """Return True if Python can read a user's sensor: in slots, or by samples."""
    if isinstance(sensor, NonlinearSensor):
        name = "slot_path" if slotted else "samples"
        return getattr(type(sensor), name) is getattr(NonlinearSensor, name)
    return sensor.linear and (slotted or takes_samples(sensor))


def read_whitened(
    path: Any, slots: Sequence[int], x: FloatArray, R: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return readings (S, p) and H (S, p, n) of S increasing ``slots``, whose states are x (S, n),
    multiplied by the inverse Cholesky factor of their covariance: ``root`` (p, p), that of the R
    that filters believe, unless the path states its own.
    """
    y, H = read_many(path, slots, x)
    whitened = np.concatenate([y[:, :, None], H], axis=2)
    if hasattr(path, "covariance"):
        for k, slot in enumerate(slots):
            whitened[k] = solve_lower(cholesky(covariance_of(path, slot, R)), whitened[k])
    else:
        whitened = solve_lower(root, whitened)
    return whitened[:, :, 0], whitened[:, :, 1:]
