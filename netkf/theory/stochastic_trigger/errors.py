"""Exact errors under the stochastic event trigger, given who sent in which slot.

A node is silent with probability ``exp(-z' Y z / 2)``, which is up to a factor the likelihood of
``z + u = 0`` with noise u of covariance Y^-1. Given its silence errors therefore have the law that
they would have after a reading with that noise more, and given that it sends that after its
reading: neither depends on what was read (Han et al. 2015, Theorem 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.stochastic_trigger import silence_noise
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.random_links import all_messages_arrive
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.updates import Observation
from netkf.trace.run import Run
from netkf.trace.schema import CODES

UNHEARD = "who misses a message takes it for silence, and the log does not show unheard decisions"
"""Why nothing is said of networks in which some decision is not heard by all."""
Decisions = set[tuple[int, int]]
"""Slots and the indices of the nodes that sent in them."""


def all_hear_all(scenario: Scenario) -> bool:
    """Return True if every node hears every other, without losses, so that the log of a run shows
    all decisions: one node alone decides too, but sends to nobody.
    """
    N = len(scenario.nodes)
    complete = N > 1 and len(scenario.topology.directions) == N * (N - 1)
    return complete and all_messages_arrive(scenario)


def start_alike(scenario: Scenario) -> bool:
    """Return True if all filters start with the same mean and covariance; hearing everything, they
    then have the same estimate at all times.
    """
    mean, cov = scenario.initial_estimate(scenario.nodes[0])
    starts = [scenario.initial_estimate(node) for node in scenario.nodes[1:]]
    return all(np.array_equal(mean, m) and np.array_equal(cov, P) for m, P in starts)


def decisions(scenario: Scenario, run: Run) -> Decisions:
    """Return the pairs (slot, index of the node) of all messages sent in a run."""
    index, rows = scenario.topology.index, run.log[run.log["kind"] == CODES["send"]]
    slots = scenario.slot_plant.slots_of(rows["t"])
    return {(slot, index[node]) for slot, node in zip(slots, rows["node"].tolist(), strict=True)}


class ScheduleRule(ErrorRule):
    """Rule of the stochastic trigger: updates by readings that were sent and by the silence of all
    other sensors.
    """

    takes_messages = False

    def __init__(self, scenario: Scenario, errors: StackedErrors, run: Run) -> None:
        super().__init__(scenario, errors)
        algorithm: Any = scenario.filter.algorithm
        self._Y, self._sent = algorithm.Y, decisions(scenario, run)
        self._observations: EstimatorObservations = {}

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Store the readings of the slot for ``exchange``. Called by the replay at every time of
        readings.
        """
        self._observations = observations

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Update the estimates of all nodes by every sensor of this ``slot``, whether it sent or
        not; changes their errors and roots of P. Called by the replay once in a slot; who sent is
        known from the log, so that ``messages`` are not used.
        """
        columns = self.errors.reading_noises(self._observations)
        for estimator, observation in self._observations.items():
            # Silence counts as a reading that equals its prediction, with the noise R + Y^-1.
            used = observation if (slot, estimator) in self._sent else silence(observation, self._Y)
            for hearer in range(self.errors.estimators):
                self.errors.update(hearer, used, columns[estimator])


def silence(reading: Observation, Y: float | FloatArray) -> Observation:
    """Return the observation to which a node's silence is equivalent for the others, who do not get
    its ``reading``: the same H (p, n), with noise R + Y^-1 (p, p).

    ``Y`` (p, p), or a number times I, is the matrix of the stochastic trigger: a node is silent
    with probability exp(-z' Y z / 2), z being the innovation of its reading.
    """
    R = silence_noise(reading.R, Y)
    # The true noise, whose root the reading has, may differ from the believed R.
    root = np.asarray(np.linalg.cholesky(reading.root @ reading.root.T + R - reading.R))
    return Observation(reading.H, R, root)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which filters under the stochastic trigger use the readings, sent or not,
    of a run. The replay of the run, which computes its exact errors from its events, calls the rule
    at each event; it changes ``errors``, the stacked errors of all nodes.

    Raises TheoryError where silence may be a loss, or the filters do not know the law of
    innovations.
    """
    if not all_hear_all(scenario):
        raise TheoryError(UNHEARD)
    if not scenario.filters_know_the_truth:
        raise TheoryError("the filters take silence for what their model says, which is not true")
    if not start_alike(scenario):
        raise TheoryError(
            "the filters start with different estimates: silence is about the sender's prediction, "
            "and hearers take it to be about their own"
        )
    return ScheduleRule(scenario, errors, run)
