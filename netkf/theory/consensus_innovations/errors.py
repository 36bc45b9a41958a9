"""Exact errors of consensus plus innovations along the messages of a run.

Beside the errors e of states each node has the difference ``u = G xhat - yhat`` of its estimates of
the pseudo-state, which no noise of the plant enters: it is predicted by ``G F G^+``. The error of
yhat is ``u + G e``.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from netkf.algorithms.consensus_innovations import design_of, gain_sequence, pseudo_states
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.trace.run import Run


class PseudoStateRule(ErrorRule):
    """Corrections by the gains of a network without losses; what is lost is left out."""

    def __init__(self, scenario: Scenario, errors: StackedErrors) -> None:
        """Take the errors at time 0, and add a difference yhat - G xhat = 0 for each node."""
        super().__init__(scenario, errors)
        self._observations: EstimatorObservations = {}
        model, network = scenario.slot_models[0], scenario.node_infos[0].network
        assert network is not None
        _, cov = scenario.initial_estimate(scenario.nodes[0])
        self._design = design_of(model, network, cov)
        self._pseudo = pseudo_states(model.F, network.information.sum(axis=0))
        self._slot = 0
        for estimator in range(errors.estimators):
            errors.stack.put(_difference_name(estimator), np.zeros((errors.n, 0)))

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Predict the differences of all nodes over a slot between the estimate yhat of the
        pseudo-state G x (G the information of all sensors) and G xhat, and keep the readings of the
        slot for ``exchange``; ``time`` is not used. Called by the replay at every time of
        readings.
        """
        self._observations, self._slot, stack = observations, self._slot + 1, self.errors.stack
        # yhat - G xhat does not depend on the plant's noise, since yhat and G xhat share it.
        for estimator in range(self.errors.estimators):
            stack.put(
                _difference_name(estimator),
                self._pseudo.A @ stack.form(_difference_name(estimator)),
            )
        gains = gain_sequence(self._design).at(self._slot)
        for estimator, node_gains in enumerate(gains):
            self.errors.roots[estimator] = node_gains.predicted

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Correct the estimates of all nodes by the messages and readings of the present slot;
        changes their errors, differences and roots of P.

        ``slot`` and ``phase`` are not used. Called by the replay for each exchange of a slot.
        """
        errors, G, estimators = self.errors, self._pseudo.G, range(self.errors.estimators)
        columns = errors.reading_noises(self._observations)
        states = [errors.stack.form(estimator) for estimator in estimators]
        # The error of yhat: what is stored is that of yhat - G xhat.
        old_estimates = [errors.stack.form(_difference_name(i)) + G @ states[i] for i in estimators]
        new_estimates = [form.copy() for form in old_estimates]
        gains = gain_sequence(self._design).at(self._slot)
        # e_i+ = e_i + sum_j B_ij (e_j - e_i): the true pseudo-state cancels.
        for message in messages:
            i, j = message.receiver, message.sender
            B = gains[i].B[self._design.heard[i].index(j)]
            new_estimates[i] += B @ (old_estimates[j] - old_estimates[i])
        for i, observation in self._observations.items():
            weighted = np.linalg.solve(observation.R, observation.H).T
            weighted_H = weighted @ observation.H
            # Innovation H' R^-1 (y - H G^+ yhat), with y = H x + v.
            new_estimates[i] -= gains[i].M @ weighted_H @ self._pseudo.inverse @ old_estimates[i]
            new_estimates[i][:, columns[i]] -= gains[i].M @ weighted @ observation.root
        for i in estimators:
            # xhat+ = xhat + K (yhat+ - G xhat), in errors.
            e = states[i] - gains[i].K @ (G @ states[i] - new_estimates[i])
            self._set_errors(i, e, new_estimates[i] - G @ e)
            errors.roots[i] = gains[i].root

    def _set_errors(self, estimator: int, e: FloatArray, u: FloatArray) -> None:
        """Set the errors of an estimator: ``e`` of xhat and ``u`` of yhat - G xhat, both (n,
        inputs).
        """
        self.errors.stack.put(estimator, e)
        self.errors.stack.put(_difference_name(estimator), u)


def _difference_name(estimator: int) -> Hashable:
    """Return the name of the error of yhat - G xhat of node ``estimator`` (its index)."""
    return ("difference", estimator)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the filter by consensus plus innovations uses the readings and
    messages of a run. The replay of the run, which computes its exact errors from its events, calls
    the rule at each event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return PseudoStateRule(scenario, errors)
