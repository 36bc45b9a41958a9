"""Exact errors of belief propagation under clocks along the messages of a run, in information form.

Readings ``y = H x + v`` that were put together say ``u = U x + s``, with the sums U and s of
``H' R^-1 H`` and ``H' R^-1 v``, whatever was counted twice. The prior is one more piece, with
``s = -P_0^-1 e_0``, and a node that knows them has the error ``e = -P s``, ``P = U^-1``.

Information is about the coordinates of a ``ModeFrame``, ``x = W e``, so that none of it is pulled
back through a mode that decays.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import scipy.linalg

from netkf.algorithms.modes import flow_frame
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.prediction import triangular_root
from netkf.trace.run import Run


class BeliefRule(ErrorRule):
    """Rule of belief propagation: the information that nodes hold, and the beliefs it gives.

    A node holds the information of its own readings and the last received from each neighbour. An
    item is U = H' R^-1 H and, in terms of errors, s = H' R^-1 v, summed over the readings that it
    covers; in the stack of errors it is a vector s, whose matrix is U.
    """

    def __init__(self, scenario: Scenario, errors: StackedErrors) -> None:
        """Take the errors at time 0; each estimate is the prior of its node."""
        super().__init__(scenario, errors)
        if errors.follows:
            raise TheoryError("the filters' plant is not the true one: messages follow the state")
        self._received: dict[int, dict[int, float]] = {
            estimator: {} for estimator in range(errors.estimators)
        }
        self._evidence: set[Hashable] = set()
        self._frame = flow_frame(scenario.belief[0])
        self._W = self._frame.basis
        for estimator in range(errors.estimators):
            # S^-1 W for the root S of P_0.
            Z = np.linalg.solve(errors.roots[estimator], self._W)
            weighted = np.linalg.solve(errors.roots[estimator], errors.stack.form(estimator))
            self._put_evidence(_prior_name(estimator), Z.T @ Z, -Z.T @ weighted)

    def _put_evidence(self, name: Hashable, U: FloatArray, s: FloatArray) -> None:
        """Set an item of evidence ``name`` in the stack of errors: its information U (n, n), and
        the form (n, inputs) of its s = sum of H' R^-1 v, the coefficients of all noises in it.
        """
        self._evidence.add(name)
        self.errors.stack.put(name, s)
        self.errors.stack.matrices[self.errors.stack.index(name)] = U

    def _drop_evidence(self, names: Sequence[Hashable]) -> None:
        """Remove items of evidence."""
        self._evidence.difference_update(names)
        self.errors.stack.drop(names)

    def _sum_evidence(self, names: Sequence[Hashable]) -> tuple[FloatArray, FloatArray]:
        """Return the evidence of several readings together: the sums of U (n, n) and of the forms
        of s (n, inputs) of those of the items ``names`` that there are.
        """
        stack, n = self.errors.stack, self.errors.n
        present_names = [name for name in names if name in self._evidence]
        U = sum((stack.matrices[stack.index(name)] for name in present_names), np.zeros((n, n)))
        return U, sum((stack.form(name) for name in present_names), np.zeros((n, stack.used)))

    def elapse(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Predict all evidence over ``gap`` seconds; changes U and s of every item. The plant's
        noise, in ``columns``, is not needed. Called by the replay between events.
        """
        if gap > 0.0:
            self._W = self._W @ scipy.linalg.expm(gap * self._frame.forward)
            self._predict_evidence(np.asarray(scipy.linalg.expm(gap * self._frame.back)))

    def _predict_evidence(self, back: FloatArray) -> None:
        """Predict all evidence (U, s) to a later state: ``U <- back' U back``, ``s <- back' s``.

        ``back`` (n, n) takes the later state to the earlier one that the evidence is about. There
        is no term for process noise: evidence is kept only for plants without it.
        """
        stack = self.errors.stack
        if self._frame.growing == 0:
            return
        for name in self._evidence:
            U = stack.matrices[stack.index(name)]
            self._put_evidence(name, back.T @ U @ back, back.T @ stack.form(name))

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Add the readings of ``time`` (seconds) to the nodes' own evidence, and update the beliefs
        of the nodes that read. Called by the replay at every time of readings.
        """
        columns = self.errors.reading_noises(observations)
        for estimator, observation in observations.items():
            # A reading adds U = H' R^-1 H and, in errors, s = H' R^-1 v.
            H = observation.H @ self._W
            weighted = np.linalg.solve(observation.R, H).T
            U, s = self._sum_evidence([_own_name(estimator)])
            s[:, columns[estimator]] += weighted @ observation.root
            self._put_evidence(_own_name(estimator), U + weighted @ H, s)
        for estimator in observations:
            self._update_belief(estimator)

    def _update_belief(self, estimator: int) -> None:
        """Set the error and the root of P of node ``estimator`` from its prior, the information of
        its own readings and that received from its neighbours: their sums U of H' R^-1 H and s of
        H' R^-1 v.
        """
        errors, eye = self.errors, np.eye(self.errors.n)
        U, s = self._sum_evidence(
            [_own_name(estimator), *((estimator, j) for j in self._received[estimator])]
        )
        prior, stack = _prior_name(estimator), errors.stack
        spread = np.linalg.cholesky(U + stack.matrices[stack.index(prior)])
        root = self._W @ scipy.linalg.solve_triangular(spread, eye, lower=True).T
        s = scipy.linalg.solve_triangular(spread, s + stack.form(prior), lower=True)
        errors.stack.put(estimator, -root @ s)
        errors.roots[estimator] = triangular_root(root)

    def _evidence_for(self, sender: int, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Return U (n, n) and the form of s (n, inputs) of the message of ``sender`` to
        ``receiver``: the evidence of the sender's readings and that received from all its other
        neighbours.
        """
        others = [(sender, j) for j in self._received[sender] if j != receiver]
        return self._sum_evidence([_own_name(sender), *others])

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Store the contents of each message that arrives later. Called by the replay when messages
        leave.
        """
        for message in messages:
            if message.late:
                self._put_evidence(message, *self._evidence_for(message.sender, message.receiver))

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Replace the earlier evidence of each sender, unless that was sent later, and update the
        beliefs of the receivers at ``time`` (seconds). Called by the replay when messages arrive.
        """
        late = [message for message in messages if message.late]
        # Contents first: a message has the sender's evidence before this instant's messages.
        contents = {
            message: self._sum_evidence([message])
            if message.late
            else self._evidence_for(message.sender, message.receiver)
            for message in messages
        }
        for message in sorted(messages, key=lambda m: (m.sender, m.time, m.number)):
            received = self._received[message.receiver]
            if received.get(message.sender, -np.inf) <= message.time:
                received[message.sender] = message.time
                self._put_evidence((message.receiver, message.sender), *contents[message])
        self._drop_evidence(late)
        for estimator in {message.receiver for message in messages}:
            self._update_belief(estimator)


def _prior_name(estimator: int) -> Hashable:
    """Return the name of an estimator's prior."""
    return ("prior", estimator)


def _own_name(estimator: int) -> Hashable:
    """Return the name of the evidence of an estimator's own readings."""
    return ("own", estimator)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule of belief propagation under clocks for ``errors``, the stacked errors of all
    nodes.
    """
    return BeliefRule(scenario, errors)
