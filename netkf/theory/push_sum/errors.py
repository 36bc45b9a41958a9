"""Exact errors of the push-sum filter along the messages of a run.

In slots the rule is P Fig. 1 with the corrected update of the mass; under clocks it is that of
broadcast rounds with running sums.

Under clocks a node of weight w among N nodes holds the mass ``(w / N) (P^-1, P^-1 xhat)``. A total
(U, u) that was sent is information U and information vector u, in parts u_g = U P_g x for groups of
modes (``algorithms.running_sums``), with the errors ``u_g - U P_g x``. Totals are predicted to the
present: over a gap with noise v, ``U+ = M' U M`` and
``(u_g - U P_g x)+ = e^{-r_g gap} M' (u_g - U P_g x) - U+ P_g v``. A node that gains (U, u), and
then has the weight w, moves to ``xhat + (N / w) P (u - U xhat)``; its error becomes
``e - (N / w) P (U e + u - U x)``. So the errors obey equations without x.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg

from netkf.algorithms.modes import rate_groups
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import arrivals_by_step
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.roots import fade_totals
from netkf.theory.numerics.updates import add_information_to_root
from netkf.trace.run import Run
from netkf.trace.schema import CODES


def require_known_errors(scenario: Scenario, run: Run) -> None:
    """Raise TheoryError if the exact errors of a run in slots cannot be computed from its events
    (:class:`AveragingRule`).

    That is so for frozen or asymptotic gains, for filters whose F differs from the plant's, for
    sensors whose H varies, and for samples at the horizon, since the trace lacks the exchanges of a
    slot that begins there.
    """
    algorithm: Any = scenario.filter.algorithm
    plant = scenario.slot_plant
    if algorithm.stop != "never" or algorithm.asymptotic:
        raise TheoryError("the exact errors are known while mass is exchanged in every slot")
    if not np.array_equal(scenario.slot_belief[0], plant.F):
        raise TheoryError("the exact errors are known for filters that have the plant's F")
    if any(sensor.varying for sensor in scenario.sensors):
        raise TheoryError("the exact errors are known for sensors whose H is fixed")


class AveragingRule(ErrorRule):
    """Rule by which errors change in a slot: push-sum masses are exchanged once (exchange 0), then
    estimates are predicted, updated by readings, and averaged in gamma steps (exchange 1).
    """

    takes_messages = False

    def __init__(self, scenario: Scenario, errors: StackedErrors, run: Run) -> None:
        """Take the stacked errors of all nodes at time 0, and which messages of the run arrived;
        the nodes' push-sum masses ``_z`` (N, 2 + n^2) begin as in P (3) of the push-sum paper.
        """
        super().__init__(scenario, errors)
        algorithm: Any = scenario.filter.algorithm
        self._gamma, self._delta = int(algorithm.gamma or 1), float(algorithm.delta or math.nan)
        self._arrivals = arrivals_by_step(scenario, run)
        self._N, n = len(scenario.nodes), errors.n
        self._nu = np.array([scenario.topology.degrees[node] + 1 for node in scenario.nodes])
        models = scenario.slot_models
        self._information = np.array([m.H.T @ np.linalg.solve(m.R, m.H) for m in models])
        information = self._information.reshape(self._N, n * n)
        # Masses z = (w, n~, C~) of each node, P (3): only the leader starts with a weight.
        self._z = np.concatenate(
            [np.zeros((self._N, 1)), np.ones((self._N, 1)), information], axis=1
        )
        self._z[scenario.topology.index[algorithm.leader], 0] = 1.0
        # Running sums: totals offered by each node, and those last heard by i of j.
        self._running = algorithm.running_sums
        self._offered = np.zeros_like(self._z)
        self._heard = np.zeros((self._N, *self._z.shape))

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Exchange the push-sum masses, paper P (3)-(5) (``phase`` 0), or average the estimates of
        all nodes in gamma steps, paper P step 5 (``phase`` 1); called by the replay for each phase
        of a slot.

        Phase 0 changes ``_z`` (and the running sums), phase 1 the errors in the stack. Which
        messages arrived is known from the log, so that ``messages`` are not used.
        """
        if phase == 0:
            received = self._arrived_weights(slot, 0, 0)
            shares = self._z / self._nu[:, None]
            if self._running:
                # A receiver gains what was offered since it last heard the sender.
                self._offered = self._offered + shares
                news = np.where(received[..., None] > 0.0, self._offered - self._heard, 0.0)
                self._heard, self._z = self._heard + news, shares + news.sum(axis=1)
                return
            # P (3)-(5) corrected: z_i+ = z_i/nu_i + sum_j [b_ij z_j/nu_j + (1 - b_ij) z_i/nu_i].
            # A node keeps the shares of its failed links, which fail in both directions.
            retained = (self._nu - received.sum(axis=1))[:, None]
            self._z = retained * shares + received @ shares
            return
        mixing, estimators = np.eye(self._N), range(self._N)
        for step in range(self._gamma):
            received = self._arrived_weights(slot, 1, step)
            # z <- (I - L / delta) z with the Laplacian L of the links that are up in this step.
            laplacian = np.diag(received.sum(axis=1)) - received
            mixing = mixing - laplacian @ mixing / self._delta
        # The errors of all nodes are mixed as their estimates are: weights sum to 1.
        stack = self.errors.stack
        indices = stack.indices(estimators)
        forms = stack.table[indices, :, : stack.used].reshape(self._N, -1)
        stack.table[indices, :, : stack.used] = (mixing @ forms).reshape(self._N, -1, stack.used)

    def _arrived_weights(self, slot: int, phase: int, step: int) -> FloatArray:
        """Return a table (N, N), receiver by sender, that is 1 where a message arrived in this
        averaging ``step`` of a ``phase`` (0: masses, 1: estimates) of a ``slot``, else 0.
        """
        return self._arrivals.get((slot, phase, step), np.zeros((self._N, self._N)))

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update the estimates of all nodes with their readings (push-sum paper, step 4), by the
        total information G and the number N of nodes that each has learned from push-sum, its
        equations 6 to 8. Changes errors and roots of P. Called by the replay at every time of
        readings.

        Columns of ``_z``: 0 the weight, 1 the mass whose ratio to the weight is N, from 2 on that
        for G.
        """
        n, errors = self.errors.n, self.errors
        heard = self._z[:, 0] > 0.0  # before any weight arrives a node knows its own sensor only
        weight = np.where(heard, self._z[:, 0], 1.0)
        learned = self._z[:, 2:].reshape(self._N, n, n) / weight[:, None, None]
        G = np.where(heard[:, None, None], learned, self._information)
        number = np.where(heard, self._z[:, 1] / weight, 1.0)
        columns = errors.reading_noises(observations)
        for estimator in range(self._N):
            root = add_information_to_root(errors.roots[estimator], G[estimator])
            if estimator not in observations:
                errors.roots[estimator] = root
                continue
            observation = observations[estimator]
            K = number[estimator] * root @ root.T @ np.linalg.solve(observation.R, observation.H).T
            errors.multiply(estimator, np.eye(n) - K @ observation.H, root)
            errors.stack.add(estimator, columns[estimator], -K @ observation.root)


class RunningTotalsRule(ErrorRule):
    """Rule under clocks: push-sum with running sums.

    It tracks the weight of each node, the total that it has offered to each receiver so far, and
    the last total that it has received over each link. What a receiver gains is the difference of
    two totals, so that a lost message only delays the gain.
    """

    def __init__(
        self, scenario: Scenario, errors: StackedErrors, rounds: Mapping[float, Sequence[int]]
    ) -> None:
        """Take the stacked errors of all nodes at time 0, and ``rounds``: the indices of the nodes
        that broadcast, by time (seconds).
        """
        super().__init__(scenario, errors, rounds)
        if errors.follows:
            raise TheoryError("the exact errors are known for filters that have the plant's A")
        plant, n = scenario.diffusion, errors.n
        self._groups, self._rounds = rate_groups(plant.A), rounds
        self._weights = [1.0] * errors.estimators
        # The weight of each total; the stack has their information and errors.
        self._totals: dict[Hashable, float] = {}
        # The number of the last message heard over each (sender, receiver).
        self._number: dict[tuple[int, int], int] = {}
        self._receivers = [0] * errors.estimators
        for sender, _ in scenario.topology.directions:
            self._receivers[scenario.topology.index[sender]] += 1
        for estimator in range(errors.estimators):
            parts = [np.zeros((n, 0)) for _ in self._groups.rates]
            self._put_total(("sent", estimator), 0.0, np.zeros((n, n)), parts)

    def _put_total(
        self, name: Hashable, weight: float, U: FloatArray, parts: Sequence[FloatArray]
    ) -> None:
        """Set the total ``name`` (of mass sent by a node, in a message, or last heard): its weight,
        its information U (n, n) and the forms (n, inputs) of the errors of its ``parts``, the
        matrices that give them as linear functions of all noises so far.
        """
        stack, self._totals[name] = self.errors.stack, weight
        for item, form in zip(self._items(name), parts, strict=True):
            stack.put(item, form)
            stack.matrices[stack.index(item)] = U

    def _items(self, name: Hashable) -> list[Hashable]:
        """Return the names, in the stack of errors, of the parts of a total ``name``."""
        return [(name, g) for g in range(len(self._groups.rates))]

    def _forms(self, name: Hashable) -> list[FloatArray]:
        """Return the forms of the errors of the parts of a total ``name``."""
        return [self.errors.stack.form(item) for item in self._items(name)]

    def _copy_information(self, name: Hashable) -> FloatArray:
        """Return a copy of the information U (n, n) of a total."""
        stack = self.errors.stack
        U: FloatArray = stack.matrices[stack.index((name, 0))].copy()
        return U

    def _copy_total(self, name: Hashable, new: Hashable) -> None:
        """Copy the total ``name`` to ``new``."""
        self._totals[new] = self._totals[name]
        for item, copy in zip(self._items(name), self._items(new), strict=True):
            self.errors.stack.copy(item, copy)

    def elapse(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Predict the information and errors of all totals by ``gap`` seconds; called by the replay
        between events. The errors of the estimates have been predicted already.

        The plant's noise over the gap is ``noise`` (n, k) times the k inputs in ``columns``.
        """
        if gap <= 0.0 or columns is None or noise is None:
            return
        groups, stack = self._groups, self.errors.stack
        inverse = np.asarray(scipy.linalg.expm(-gap * groups.kept), order="C")
        for g, rate in enumerate(groups.rates.tolist()):
            fade_totals(
                stack.arrays,
                stack.indices([self._items(name)[g] for name in self._totals]),
                inverse,
                math.exp(-rate * gap),
                as_kernel_array(groups.projectors[g] @ noise),
                columns.start,
            )

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update the errors by the readings at ``time`` (seconds), each counted N / w times (w the
        node's push-sum weight, N nodes), and then add the shares of the nodes that broadcast now to
        their totals; called by the replay at times of samples and broadcasts.
        """
        columns, number = self.errors.reading_noises(observations), self.errors.estimators
        for estimator, observation in observations.items():
            counted = observation._replace(R=observation.R * (self._weights[estimator] / number))
            self.errors.update(estimator, counted, columns[estimator])
        for estimator in self._rounds.get(time, ()):
            self._add_share(estimator)

    def _add_share(self, estimator: int) -> None:
        """Add the share 1 / (receivers + 1) of the push-sum mass of node ``estimator`` to the total
        that it has ever offered to each receiver; changes that total and the node's weight.

        The mass is ``(w / N) (P^-1, P^-1 xhat)``, and its error ``-(w / N) P^-1 e``.
        """
        count, name, stack = self._receivers[estimator], ("sent", estimator), self.errors.stack
        if count == 0:
            return
        weight, share = self._weights[estimator], 1.0 / (count + 1)
        inverse = np.linalg.inv(self.errors.roots[estimator])
        # The information of the share, and the form of its error: a form is the matrix that gives
        # an error as a linear function of all noises so far.
        U = (share * weight / self.errors.estimators) * (inverse.T @ inverse)
        old_total = self._totals[name]
        new_total, e = old_total + share * weight, stack.form(estimator)
        parts = zip(self._forms(name), self._groups.projectors, strict=True)
        forms = [form - U @ projector @ e for form, projector in parts]
        self._put_total(name, new_total, self._copy_information(name) + U, forms)
        # One share stays with the node; the others are under way to its receivers.
        self._weights[estimator] = weight - count * (new_total - old_total)

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Store the sender's present total for each message, until it arrives; called by the replay
        when messages are sent.
        """
        for message in messages:
            self._copy_total(("sent", message.sender), message)

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Add to each receiver's mass the difference between the totals received now, at ``time``
        (seconds), and last; changes weights, errors and roots of P. Called by the replay when
        messages arrive.
        """
        for estimator in sorted({message.receiver for message in messages}):
            received = [m for m in messages if m.receiver == estimator]
            self._receive_totals(estimator, sorted(received, key=lambda m: (m.sender, m.number)))
        for message in messages:
            del self._totals[message]
            self.errors.stack.drop(self._items(message))

    def _receive_totals(self, estimator: int, messages: Sequence[SentMessage]) -> None:
        """Add the growth of the received totals, since those last heard over the same links, to the
        push-sum mass of node ``estimator``, and update the error of its estimate.

        Changes the node's weight, error and root of P, and the totals last heard over the links of
        the ``messages``.
        """
        errors, n = self.errors, self.errors.n
        # The gain in weight and information, and the form of its error u - U x: the matrix that
        # gives it as a linear function of all noises so far.
        weight, U, form = 0.0, np.zeros((n, n)), np.zeros((n, 1))
        for message in messages:
            link, heard = (message.sender, estimator), ("heard", message.sender, estimator)
            # A later message of the sender came first: its total includes that of this one.
            if message.number <= self._number.get(link, -1):
                continue
            self._number[link] = message.number
            weight += self._totals[message] - self._totals.get(heard, 0.0)
            U, form = U + self._copy_information(message), form + sum(self._forms(message))
            if heard in self._totals:
                U, form = U - self._copy_information(heard), form - sum(self._forms(heard))
            self._copy_total(message, heard)
        if not weight > 0.0:
            return
        new_weight = self._weights[estimator] + weight
        share = errors.estimators / new_weight
        # Information adds up: (w+ / N) P+^-1 = (w / N) P^-1 + U.
        scaled = np.sqrt(new_weight / self._weights[estimator]) * errors.roots[estimator]
        root = add_information_to_root(scaled, share * U)
        # e+ = e - (N / w+) P+ (U e + u - U x)
        gain = share * root @ root.T
        errors.stack.put(
            estimator, (np.eye(n) - gain @ U) @ errors.stack.form(estimator) - gain @ form
        )
        errors.roots[estimator] = root
        self._weights[estimator] = new_weight


def _read_rounds(scenario: Scenario, run: Run) -> dict[float, list[int]]:
    """Return the indices of the nodes that broadcast at each time (seconds)."""
    rounds: dict[float, list[int]] = {}
    rows = run.log[run.log["kind"] == CODES["transmit"]]
    for time, node in zip(rows["t"].tolist(), rows["node"].tolist(), strict=True):
        rounds.setdefault(time, []).append(scenario.topology.index[node])
    return rounds


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the replay of a run, which computes exact errors from its events,
    changes ``errors``, the stacked errors of all nodes, as the push-sum filter uses readings and
    messages.

    ``messages`` are those of the run that arrived. Raises TheoryError if the errors in slots are
    not known.
    """
    if not scenario.slotted:
        return RunningTotalsRule(scenario, errors, _read_rounds(scenario, run))
    require_known_errors(scenario, run)
    return AveragingRule(scenario, errors, run)
