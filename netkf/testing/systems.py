"""Small random systems on which filters are checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams


class System(NamedTuple):
    """A small random system: dynamics M and noise Q (n, n), a sensor H (p, n), R (p, p), and the
    law of x(0), mean (n,) and cov (n, n).
    """

    M: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    mean: FloatArray
    cov: FloatArray


def systems(inverts: bool) -> list[System]:
    """Return systems of 1, 2 and 3 states with 0, 1 and 2 readings.

    One starts from a certain state, unless the filter inverts covariances.
    """
    random = Streams(0).generator("testing")
    found = []
    for n, p, certain in ((1, 1, False), (2, 1, True), (3, 0, False), (3, 2, False)):
        noise, spread = random.normal(size=(2, n, n))
        eye = np.eye(n)
        found.append(
            System(
                M=0.8 * eye + 0.3 * random.normal(size=(n, n)) / np.sqrt(n),
                Q=noise @ noise.T / n + 0.1 * eye,
                H=random.normal(size=(p, n)),
                R=np.diag(random.uniform(0.5, 1.5, p)),
                mean=random.normal(size=n),
                cov=np.zeros((n, n)) if certain and not inverts else spread @ spread.T + eye,
            )
        )
    return found
