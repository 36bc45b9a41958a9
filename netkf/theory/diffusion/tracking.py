"""The bound on the tracking error of the diffusion filter, paper D Theorem 4.2."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.matrices import as_integer

QUANTILE = 2.576  # of the standard normal law, for 99 % intervals


class TrackingLevel(NamedTuple):
    """The level of noise in paper D Theorem 4.2.

    sigma, low, high : sigma_p of paper D (29), with its 99 % interval
    shape            : ``sigma_p log^(1 + beta/2)(e + 1 / sigma_p)``, the bound on
                       limsup |error|_Lp without its constant c, which D does not give
    """

    sigma: float
    low: float
    high: float
    shape: float


def tracking_level(
    scenario: Scenario, p: float = 2.0, beta: float = 2.5, samples: int = 100_000, seed: int = 0
) -> TrackingLevel:
    """Return the level of noise sigma_p, D (29) of the diffusion paper, for the true noises of a
    scenario, and the shape of the bound on tracking errors that it gives.

    ``xi_k = |V_k| + |Delta_{k+1}|`` with the noises of all sensors and the parameter's increment,
    once for each node, and ``sigma_p = | xi log^beta(e + xi) |_Lp``. Gaussian noises have all
    moments, so that paper D Theorem 4.2 holds for every p >= 1 and beta > 2 if its other
    assumptions do: the errors stay bounded in L_p, and go to 0 with the noises (D Remark 4.1). From
    ``samples`` draws. Raises TheoryError for plants and sensors without a law and wrong arguments.
    """
    if not p >= 1.0 or not beta > 2.0:
        raise TheoryError(f"D (29) needs p >= 1 and beta > 2, got {p!r} and {beta!r}")
    samples, seed = as_integer("samples", samples, 100), as_integer("seed", seed, 0)
    xi = _draw_noises(scenario, samples, Streams(seed).generator("noises"))
    powers = (xi * np.log(math.e + xi) ** beta) ** p
    mean, error = float(powers.mean()), QUANTILE * float(powers.std(ddof=1)) / math.sqrt(samples)
    ends = (max(mean - error, 0.0) ** (1.0 / p), (mean + error) ** (1.0 / p))
    sigma = mean ** (1.0 / p)
    shape = sigma * math.log(math.e + 1.0 / sigma) ** (1.0 + beta / 2.0) if sigma > 0.0 else 0.0
    return TrackingLevel(sigma, *ends, shape)


def _draw_noises(scenario: Scenario, samples: int, random: np.random.Generator) -> FloatArray:
    """Return draws (samples,) of xi, D (29); raises TheoryError if a noise is recorded."""
    if not scenario.slotted or not scenario.is_random:
        raise TheoryError("D (29) needs noises in slots with a law, not a record")
    squares = np.zeros(samples)
    for node in scenario.sensing_nodes:
        for placed_sensor in scenario.placed_sensors[node]:
            root = square_root(scenario.noise_covariance(placed_sensor.entry, believed=False))
            squares += ((random.standard_normal((samples, len(root))) @ root.T) ** 2).sum(axis=1)
    root = square_root(scenario.slot_plant.Q)
    increment = random.standard_normal((samples, len(root))) @ root.T
    # Delta stacks one copy of the increment for each node, D III-A.
    increment_norm = math.sqrt(len(scenario.nodes)) * np.linalg.norm(increment, axis=1)
    return np.asarray(np.sqrt(squares) + increment_norm)
