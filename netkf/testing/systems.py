"""Small random systems on which filters are checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams


class System(NamedTuple):
    """A small random system in slots of one second.

    M, Q      : (n, n), transition matrix and noise covariance of a slot; A = M - I and Q per second
                in continuous time
    H, R      : (p, n) and (p, p), matrix and covariance of the noise of the sensor
    mean, cov : (n,) and (n, n), mean and covariance of x(0)
    spread    : difference between the first estimates of a node and of the one before: where all
                nodes hear the same readings, weights of estimates show only if these differ
    """

    M: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    mean: FloatArray
    cov: FloatArray
    spread: float = 0.0


def make_systems(inverts: bool) -> list[System]:
    """Return four systems of n = 1, 2 and 3 states with p = 0, 1 and 2 rows of readings.

    One has cov = 0, unless the filter ``inverts`` covariances.
    """
    random = Streams(0).generator("testing")
    systems = []
    for n, p, is_certain in ((1, 1, False), (2, 1, True), (3, 0, False), (3, 2, False)):
        noise_factor, cov_factor = random.normal(size=(2, n, n))
        eye = np.eye(n)
        systems.append(
            System(
                M=0.8 * eye + 0.3 * random.normal(size=(n, n)) / np.sqrt(n),
                Q=noise_factor @ noise_factor.T / n + 0.1 * eye,
                H=random.normal(size=(p, n)),
                R=np.diag(random.uniform(0.5, 1.5, p)),
                mean=random.normal(size=n),
                cov=np.zeros((n, n))
                if is_certain and not inverts
                else cov_factor @ cov_factor.T + eye,
            )
        )
    return systems
