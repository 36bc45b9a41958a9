"""Exact errors of the Kalman-consensus filter along the messages of a run.

With predictions ``xbar`` and their errors ``ebar`` the update by readings is that of a Kalman
filter, and the consensus term adds ``gamma P sum_j (ebar_j - ebar_i)`` to the error.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.trace.run import Run


class KcfRule(ErrorRule):
    """Readings of the neighbourhood and consensus on predictions, in slots and under clocks.

    The prediction of an instant is kept beside the estimate once a reading has changed the latter.
    """

    def __init__(self, scenario: Scenario, errors: StackedErrors) -> None:
        """Take the errors at time 0 and the filter's settings."""
        super().__init__(scenario, errors)
        algorithm: Any = scenario.filter.algorithm
        self._epsilon, self._share = algorithm.epsilon, algorithm.share_readings
        self._observations: EstimatorObservations = {}
        self._columns: dict[int, slice] = {}

    def elapse(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Forget the predictions and readings of an earlier instant if ``gap`` (seconds) is
        positive; a message of this instant must find those of this instant only.

        The plant's noise is not needed: predictions are not kept over a gap. Called by the replay
        between events.
        """
        if gap > 0.0:
            self._forget()

    def _forget(self) -> None:
        """Drop the predictions and readings that are kept of the slot or instant before; the
        consensus is on predictions of one instant only.
        """
        self.errors.drop(
            [
                name
                for name in map(_prior_name, range(self.errors.estimators))
                if self._has_error(name)
            ]
        )
        self._observations, self._columns = {}, {}

    def _has_error(self, name: Hashable) -> bool:
        """Return True if there is an error of this name."""
        return name in self.errors.roots

    def _prediction_name(self, estimator: int) -> Hashable:
        """Return the name of the error of the prediction of node ``estimator`` at this instant: the
        estimate itself until a reading has changed it.
        """
        return _prior_name(estimator) if self._has_error(_prior_name(estimator)) else estimator

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update by the nodes' own readings of ``time`` (seconds, or the slot), and keep their
        predictions from before them. Called by the replay at every time of readings.
        """
        self._forget()
        for estimator in observations:
            self.errors.copy(estimator, _prior_name(estimator), estimator)
        self._observations, self._columns = observations, self.errors.reading_noises(observations)
        for estimator, observation in observations.items():
            self.errors.update(estimator, observation, self._columns[estimator])

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Copy the sender's prediction for each message that arrives later. Called by the replay
        when messages leave.
        """
        for message in messages:
            if message.late:
                self.errors.copy(self._prediction_name(message.sender), message, None)

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Add the consensus terms of messages that arrive at ``time`` (seconds, or the slot), and
        use the readings of those without delay; changes errors, and roots of P where readings are
        used. Called by the replay when messages arrive.
        """
        inboxes: dict[int, dict[int, SentMessage]] = {}
        # Messages of one sender can overtake each other: the last one sent counts.
        for message in sorted(messages, key=lambda m: (m.sender, m.time, m.number)):
            inboxes.setdefault(message.receiver, {})[message.sender] = message
        # All terms before any estimate changes, since predictions may be estimates.
        terms = {
            estimator: self._consensus_term(estimator, list(inbox.values()))
            for estimator, inbox in inboxes.items()
        }
        for estimator, inbox in inboxes.items():
            for message in inbox.values():
                if self._share and not message.late and message.sender in self._observations:
                    observation, columns = (
                        self._observations[message.sender],
                        self._columns[message.sender],
                    )
                    self.errors.update(estimator, observation, columns)
            # Updates may have added inputs since: the term covers the first ones.
            form = self.errors.stack.form(estimator)
            form[:, : terms[estimator].shape[1]] += terms[estimator]
            self.errors.stack.put(estimator, form)
        self.errors.drop([message for message in messages if message.late])

    def _consensus_term(self, estimator: int, inbox: list[SentMessage]) -> FloatArray:
        """Return the form (n, inputs) of ``gamma P sum_j (ebar_j - ebar)``, which the consensus
        adds to the error of ``estimator``; the sum is over the messages of its ``inbox``.
        """
        prediction, stack = self._prediction_name(estimator), self.errors.stack
        root = self.errors.roots[prediction]
        # The gain uses the predicted P, as the consensus term does predictions.
        P = root @ root.T
        total = np.zeros_like(stack.form(prediction))
        for message in inbox:
            source = message if message.late else self._prediction_name(message.sender)
            total += stack.form(source) - stack.form(prediction)
        # gamma = epsilon / (1 + |P|) keeps the gain bounded where P is large.
        return np.asarray(self._epsilon / (1.0 + np.linalg.norm(P)) * P @ total)


def _prior_name(estimator: int) -> Hashable:
    """Return the name of an estimator's prediction."""
    return ("prediction", estimator)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the Kalman-consensus filter uses the readings and messages of a run.
    The replay of the run, which computes its exact errors from its events, calls the rule at each
    event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return KcfRule(scenario, errors)
