"""Errors of filters that hear nothing in slots, in their steady state."""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.scenario.scenario import Scenario
from netkf.theory.common.jumps import SlotJumps
from netkf.theory.intermittent.riccati import steady_covariance


def steady_gain(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """Return the steady Kalman gain (n, p) of one filter in slots, for predictions
    ``x+ = F x + w``.

    ``F`` and ``Q`` (n, n): transition of a slot and covariance of w; ``H`` (p, n) and ``R`` (p, p):
    all readings of a slot, stacked. The gain belongs to the covariance before the readings. Raises
    TheoryError if that covariance has no limit.
    """
    if not len(H):
        return np.zeros((len(F), 0))
    P = steady_covariance(F, Q, H, R)
    return np.asarray(np.linalg.solve(H @ P @ H.T + R, H @ P).T)


def silent_jumps(scenario: Scenario) -> SlotJumps:
    """Return the errors of filters in slots that exchange nothing, at their steady gains K (n, p),
    as a linear system: a matrix I - K H (n, n) for each filter, and the noise of all.

    One block of n errors for each node, or a single block if all nodes share one pooled filter.
    Gains follow from the R that filters assume, the noise of the readings from the true one.
    """
    F, Q = scenario.slot_belief
    if scenario.node_filter.timing.pooled:
        model = scenario.pooled_slot_model
        sensors = [(model.H, model.R)]
        true = [block_diagonal([scenario.observation_matrices(node)[1] for node in scenario.nodes])]
    else:
        sensors = [scenario.observation_matrices(node, believed=True) for node in scenario.nodes]
        true = [scenario.observation_matrices(node)[1] for node in scenario.nodes]
    gains = [steady_gain(F, Q, *sensor) for sensor in sensors]
    closed = np.stack([np.eye(len(F)) - K @ H for K, (H, _) in zip(gains, sensors, strict=True)])
    noise = block_diagonal([K @ R @ K.T for K, R in zip(gains, true, strict=True)])
    return SlotJumps(scenario.slot_plant.F, scenario.slot_plant.Q, closed, noise, directions=None)
