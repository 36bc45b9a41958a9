"""Rates and exact errors under the stochastic event trigger, given who sent in which slot.

A node is silent with probability ``exp(-z' Y z / 2)``, which is up to a factor the likelihood of
``z + u = 0`` with noise u of covariance Y^-1. Given its silence errors therefore have the law that
they would have after a reading with that noise more, and given that it sends that after its
reading: neither depends on what was read (Han et al. 2015, Theorem 2).
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from netkf.algorithms.registry import built_in_filters
from netkf.algorithms.stochastic_trigger import silence_noise, trigger_matrix
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.columns import ErrorColumns
from netkf.theory.common.observations import (
    Observation,
    joseph_update,
    slot_observations,
    stack_observations,
)
from netkf.theory.common.random_links import all_messages_arrive
from netkf.theory.common.slot_columns import SlotColumns
from netkf.theory.intermittent.riccati import check_system, lyapunov_step
from netkf.theory.numerics.matrices import as_covariance, as_numbers
from netkf.trace.run import Run
from netkf.trace.schema import rows_of

UNHEARD = "who misses a message takes it for silence, and the log does not show unheard decisions"
"""Why nothing is said of networks in which some decision is not heard by all."""
Decisions = set[tuple[int, int]]
"""Slots and the indices of the nodes that sent in them."""


def all_hear_all(scenario: Scenario) -> bool:
    """Return True if every node hears every other, without losses: the log shows decisions."""
    N = len(scenario.nodes)
    complete = N > 1 and len(scenario.topology.directions) == N * (N - 1)
    return complete and all_messages_arrive(scenario)


def start_equal(scenario: Scenario) -> bool:
    """Return True if all filters start alike; hearing everything, they have one estimate."""
    mean, cov = scenario.initial_estimate(scenario.nodes[0])
    starts = [scenario.initial_estimate(node) for node in scenario.nodes[1:]]
    return all(np.array_equal(mean, m) and np.array_equal(cov, P) for m, P in starts)


def decisions(scenario: Scenario, run: Run) -> Decisions:
    """Return the pairs (slot, index of the node) of all messages sent in a run."""
    index, rows = scenario.topology.index, rows_of(run.log, "send")
    slots = scenario.slot_plant.slots_of(rows["t"])
    return {(slot, index[node]) for slot, node in zip(slots, rows["node"].tolist(), strict=True)}


class ScheduleColumns(SlotColumns):
    """The error of the common estimate: all readings, silence as one of noise R + Y^-1."""

    def __init__(self, scenario: Scenario, run: Run) -> None:
        algorithm: Any = scenario.filter.algorithm
        self._Y, self._sent = algorithm.Y, decisions(scenario, run)
        self._each = slot_observations(scenario, run)
        super().__init__(_with_one_filter(scenario), run)

    def _observe(self, slot: int) -> dict[int, Observation]:
        used = [
            observation if (slot, h) in self._sent else silent_observation(observation, self._Y)
            for h, observation in self._each(slot).items()
            if len(observation.H)
        ]
        return {0: stack_observations(used, self.n)}


@lru_cache(maxsize=8)
def _with_one_filter(scenario: Scenario) -> Scenario:
    filtering = replace(scenario.filter, algorithm=built_in_filters()["central"]())
    return replace(scenario, filter=filtering)


def silent_observation(reading: Observation, Y: float | FloatArray) -> Observation:
    """Return the observation that a node's silence is to others: its H, with noise R + Y^-1."""
    R = silence_noise(reading.R, Y)
    # The true noise, whose root the reading has, may differ from the believed R.
    root = np.asarray(np.linalg.cholesky(reading.root @ reading.root.T + R - reading.R))
    return Observation(reading.H, R, root)


def error_columns(scenario: Scenario, run: Run) -> ErrorColumns:
    """Return the errors of all nodes in a run; TheoryError if silence may be a loss."""
    if not all_hear_all(scenario):
        raise TheoryError(UNHEARD)
    if not scenario.filters_know_the_truth:
        raise TheoryError("the filters take silence for what their model says, which is not true")
    if not start_equal(scenario):
        raise TheoryError(
            "the filters start with different estimates: silence is about the sender's prediction, "
            "and hearers take it to be about their own"
        )
    return ScheduleColumns(scenario, run)


def trigger_rate(P: ArrayLike, H: ArrayLike, R: ArrayLike, Y: ArrayLike) -> float:
    """Return the probability ``1 - det(I + Pi Y)^-1/2`` with which a node sends its reading.

    P (n, n) is the covariance of the prediction, H (p, n) and R (p, p) are those of the sensor,
    ``Pi = H P H' + R``, and Y (p, p) is the matrix of the trigger, which is silent with probability
    ``exp(-z' Y z / 2)`` (Han et al. 2015). Raises TheoryError if shapes or definiteness are wrong.
    """
    # P is checked in the place of Q; F is not used.
    _, C, H_, R_ = check_system(np.eye(len(np.atleast_2d(as_numbers("P", P)))), P, H, R)
    Pi = H_ @ C @ H_.T + R_
    return float(1.0 - np.linalg.det(np.eye(len(R_)) + Pi @ as_covariance("Y", Y, len(R_))) ** -0.5)


def expected_sends(scenario: Scenario, run: Run) -> tuple[int, float]:
    """Return the transmissions of a run and the sum of their probabilities, from slot 1 on."""
    algorithm: Any = scenario.filter.algorithm
    sent, Y = decisions(scenario, run), algorithm.Y
    P = np.asarray(scenario.initial_estimate(scenario.nodes[0])[1])
    sensors = {
        k: Observation(H, R, np.asarray(np.linalg.cholesky(R)))
        for k, (H, R) in enumerate(map(scenario.observation_matrices, scenario.nodes))
        if len(H)
    }
    count, expected, slot = 0, 0.0, 1
    # All nodes hear everything, so that one P, given all decisions, is that of every node.
    while not scenario.slot_plant.over(slot, scenario.horizon):
        P = lyapunov_step(P, *scenario.slot_belief_from(slot - 1))
        if slot > 1:
            for k, (H, R, _) in sensors.items():
                count += (slot, k) in sent
                expected += trigger_rate(P, H, R, trigger_matrix(Y, len(R)))
        for k, observation in sensors.items():
            used = observation if (slot, k) in sent else silent_observation(observation, Y)
            P = joseph_update(P, used)
        slot += 1
    return count, expected
