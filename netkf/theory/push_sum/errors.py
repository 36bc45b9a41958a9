"""Exact errors of the push-sum filter under clocks: broadcast rounds with running sums.

A node of weight w among N nodes holds the mass ``(w / N) (P^-1, P^-1 xhat)``. A total
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

import numpy as np
import scipy.linalg

from netkf.algorithms.modes import rate_groups
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.roots import fade_totals
from netkf.theory.numerics.updates import add_information_to_root
from netkf.trace.run import Run
from netkf.trace.schema import CODES


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

    ``messages`` are those of the run that arrived. Raises TheoryError in slots, where errors follow
    from the verbs (``theory.common.columns``), but not for nodes that decide whether to send.
    """
    if scenario.slotted:
        raise TheoryError("the exact errors are known while mass is exchanged in every slot")
    return RunningTotalsRule(scenario, errors, _read_rounds(scenario, run))
