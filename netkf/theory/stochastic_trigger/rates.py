"""How often nodes send under the stochastic event trigger."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.stochastic_trigger import trigger_matrix
from netkf.linalg.arrays import ArrayLike
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import Observation, joseph_update
from netkf.theory.intermittent.riccati import check_system, lyapunov_step
from netkf.theory.numerics.matrices import as_covariance
from netkf.theory.stochastic_trigger.errors import decisions, silence
from netkf.trace.run import Run


def trigger_rate(P: ArrayLike, H: ArrayLike, R: ArrayLike, Y: ArrayLike) -> float:
    """Return the probability ``1 - det(I + Pi Y)^-1/2`` with which a node sends its reading.

    P (n, n) is the covariance of the prediction, H (p, n) and R (p, p) are those of the sensor,
    ``Pi = H P H' + R``, and Y (p, p) is the matrix of the trigger, which is silent with probability
    ``exp(-z' Y z / 2)`` (Han et al. 2015). Raises TheoryError if shapes or definiteness are wrong.
    """
    spread = np.asarray(P, dtype=np.float64)
    # P is checked in the place of Q; F is not used.
    _, C, H_, R_ = check_system(np.eye(len(np.atleast_2d(spread))), P, H, R)
    Pi = H_ @ C @ H_.T + R_
    return float(1.0 - np.linalg.det(np.eye(len(R_)) + Pi @ as_covariance("Y", Y, len(R_))) ** -0.5)


def expected_sends(scenario: Scenario, run: Run) -> tuple[int, float]:
    """Return the transmissions of a run and the sum of their probabilities, from slot 1 on."""
    algorithm: Any = scenario.filter.algorithm
    sent = decisions(scenario, run)
    (F, Q), Y = scenario.slot_belief, algorithm.Y
    P = np.asarray(scenario.initial_estimate(scenario.nodes[0])[1])
    sensors = {
        k: Observation(H, R, np.asarray(np.linalg.cholesky(R)))
        for k, (H, R) in enumerate(map(scenario.observation_matrices, scenario.nodes))
        if len(H)
    }
    count, expected, slot = 0, 0.0, 1
    # All nodes hear everything, so that one P, given all decisions, is that of every node.
    while not scenario.slot_plant.over(slot, scenario.horizon):
        P = lyapunov_step(P, F, Q)
        if slot > 1:
            for k, (H, R, _) in sensors.items():
                count += (slot, k) in sent
                expected += trigger_rate(P, H, R, trigger_matrix(Y, len(R)))
        for k, observation in sensors.items():
            used = observation if (slot, k) in sent else silence(observation, Y)
            P = joseph_update(P, used)
        slot += 1
    return count, expected
