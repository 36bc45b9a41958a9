"""Errors of all estimates of a run in one stack, roots of their P, and their propagation in time.

An estimate is a node's, a copy of it in a message under way, or a version of a node's estimate that
will include a reading still under way. Names are any hashable values, a node's is its index. The
state itself is stacked too if the errors depend on it, because the filters' A (or F) differs from
the plant's.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, as_kernel_array, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import increment_observations
from netkf.theory.numerics.prediction import ErrorFlow, Prediction, Predictor, propagate_state
from netkf.theory.numerics.roots import predict_estimates, update_estimate
from netkf.theory.numerics.stack import GaussianStack
from netkf.theory.numerics.updates import Observation

STATE, OFFSET = "state", "offset"
"""Names of two vectors of the stack that are no estimates: the true state, and the constant input
that carries the errors' means.
"""
Term = tuple[Hashable, FloatArray]
"""An estimate and the matrix (n, n) by which its error is multiplied."""


class Roots:
    """Square roots (n, n) of P of estimates, by name; each is a copy, and is set as a whole."""

    def __init__(self, stack: GaussianStack, owner: Mapping[Hashable, int | None]) -> None:
        """Take the ``stack`` that holds the roots, and by ``owner`` the estimator whose increments
        each estimate uses.
        """
        self._stack, self._owner = stack, owner

    def __contains__(self, name: Hashable) -> bool:
        return name in self._owner

    def __getitem__(self, name: Hashable) -> FloatArray:
        """Return a copy (n, n) of the root of P of the estimate ``name``."""
        root: FloatArray = self._stack.matrices[self._stack.index(name)].copy()
        return root

    def __setitem__(self, name: Hashable, root: FloatArray) -> None:
        """Overwrite the root of P of the estimate ``name`` by ``root`` (n, n)."""
        self._stack.matrices[self._stack.index(name)] = root


class StackedErrors:
    """Errors of the estimates of M estimators and of copies of them.

    roots   : a square root (n, n) of P for each estimate
    owner   : the estimator whose increments an estimate uses; None for a message, which is only
              predicted
    follows : whether the errors depend on the state
    """

    def __init__(self, scenario: Scenario, estimators: int) -> None:
        """Take the errors at time 0 of the first M = ``estimators`` nodes of a scenario, or of its
        pooled filter (M = 1).
        """
        self.n, self.estimators = scenario.plant.n, estimators
        self.stack = GaussianStack(self.n)
        self.owner: dict[Hashable, int | None] = {}
        self.roots = Roots(self.stack, self.owner)
        self._kept: list[FloatArray] = []
        first = square_root(np.asarray(scenario.plant.start_cov))
        # Estimates start at known means, so that the random part of their errors is the same.
        columns = self.stack.inputs(first.shape[1])
        self.follows = _errors_follow_state(scenario)
        if self.follows:
            self.stack.put(STATE, np.zeros((self.n, 0)))
            self.stack.add(STATE, columns, first)
        for estimator, node in enumerate(scenario.nodes[:estimators]):
            self.stack.put(estimator, np.zeros((self.n, 0)))
            self.stack.add(estimator, columns, first)
            self.owner[estimator] = estimator
            self.roots[estimator] = square_root(np.asarray(scenario.initial_estimate(node)[1]))
        self._add_offsets(scenario)

    def _add_offsets(self, scenario: Scenario) -> None:
        """Add to each error its mean at time 0: the difference of the plant's and the filter's
        first means.

        The differences multiply one more input, which is the constant 1. Reductions of the stack
        rotate the inputs; the vector OFFSET, the constant times a unit vector, is rotated with
        them, so that the mean of any error is the product of its form with the first row of OFFSET.
        """
        start, n = scenario.plant.start_mean, self.n
        offsets: dict[Hashable, FloatArray] = {
            estimator: start - scenario.initial_estimate(scenario.nodes[estimator])[0]
            for estimator in range(self.estimators)
        }
        if self.follows:
            offsets[STATE] = start
        if not any(offset.any() for offset in offsets.values()):
            return
        column = self.stack.inputs(1)
        self.stack.put(OFFSET, np.zeros((n, 0)))
        self.stack.add(OFFSET, column, np.eye(n, 1))
        for name, offset in offsets.items():
            self.stack.add(name, column, offset[:, None])

    def keep(self) -> None:
        """Store the present forms of the errors of all estimators (their coefficients of the random
        inputs) for ``law``; appends to ``_kept``.
        """
        self._kept.append(self.stack.freeze(range(self.estimators)))

    def law(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean (K M n,) and the covariance (K M n, K M n) of the errors of the M
        estimators at the K times at which ``keep`` was called.
        """
        rows, width = self.estimators * self.n, self.stack.used
        forms = np.zeros((len(self._kept), rows, width))
        for k, snapshot in enumerate(self._kept):
            forms[k, :, : snapshot.shape[2]] = snapshot.reshape(rows, -1)
        return self._mean_and_covariance(forms.reshape(-1, width))

    def _mean_and_covariance(self, forms: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean (K,) and the covariance (K, K) of K scalar errors with the ``forms``
        (K, inputs): their coefficients of the standard normal inputs.
        """
        if OFFSET not in self.stack:
            return np.zeros(len(forms)), np.asarray(forms @ forms.T)
        constant_input = self.stack.form(OFFSET)[0]
        mean = np.asarray(forms @ constant_input)
        # The covariance is that of the other inputs: the part along the constant is subtracted.
        random_part = forms - np.outer(mean, constant_input)
        return mean, np.asarray(random_part @ random_part.T)

    def covariance(self) -> FloatArray:
        """Return the joint covariance (M n, M n) of the errors of the estimators."""
        forms = self.stack.forms(range(self.estimators))
        return self._mean_and_covariance(forms.reshape(self.estimators * self.n, -1))[1]

    def second_moments(self) -> FloatArray:
        """Return the joint second moments (M n, M n) of the errors of the estimators: covariances
        and products of means, which the forms hold too.
        """
        forms = self.stack.forms(range(self.estimators)).reshape(self.estimators * self.n, -1)
        return np.asarray(forms @ forms.T)

    def covariances(self) -> FloatArray:
        """Return P (M, n, n) of the estimators."""
        # P = S S'
        S = self.stack.matrices[self.stack.indices(range(self.estimators))]
        return np.asarray(S @ np.swapaxes(S, 1, 2))

    def copy(self, name: Hashable, new: Hashable, owner: int | None) -> None:
        """Copy estimate ``name`` to ``new``: ``owner`` is the estimator whose increments the copy
        uses from now on, None for a message, which is only predicted.
        """
        self.stack.copy(name, new)
        self.owner[new] = owner

    def drop(self, names: Sequence[Hashable]) -> None:
        """Remove estimates."""
        self.stack.drop(names)
        for name in names:
            del self.owner[name]

    def replace(self, name: Hashable, form: Hashable) -> None:
        """Overwrite the estimate ``form`` by the estimate ``name``, which is removed. The owner of
        ``form`` stays the same.
        """
        self.stack.rename(name, form)
        del self.owner[name]

    def reading_noises(self, observations: Mapping[int, Observation]) -> dict[int, slice]:
        """Add inputs for the noises of readings, p for an estimator with p readings; return their
        columns by estimator.

        Inputs are independent random numbers of variance 1; all errors are linear in them, and the
        stack holds the coefficients, one column for each input. Use the columns before any other
        operation that adds inputs, which may move them.
        """
        ends = np.cumsum(
            [0, *(len(observation.H) for observation in observations.values())]
        ).tolist()
        columns = self.stack.inputs(ends[-1])
        begin = columns.start
        return {
            estimator: slice(begin + a, begin + b)
            for estimator, a, b in zip(observations, ends, ends[1:], strict=False)
        }

    def update(self, name: Hashable, observation: Observation, columns: slice) -> None:
        """Update the error and the root of P of estimate ``name`` by readings.

        The noise of the p readings is ``observation.root`` times the p inputs in ``columns``.
        """
        if not len(observation.H):
            return
        stack, (H, R, root) = self.stack, map(as_kernel_array, observation)
        index, first = stack.index(name), columns.start
        update_estimate(stack.arrays, index, H, R, root, first)

    def multiply(self, name: Hashable, matrix: FloatArray, root: FloatArray) -> None:
        """Multiply the error of estimate ``name`` by a ``matrix`` (n, n), and set the root of its P
        to ``root`` (n, n).
        """
        self.stack.put(name, matrix @ self.stack.form(name))
        self.roots[name] = root

    def combine(self, changes: Mapping[Hashable, tuple[FloatArray, Sequence[Term]]]) -> None:
        """Replace the errors and the roots of P of several estimates at once.

        ``changes`` gives for each name its new root (n, n) and the terms (estimate, W (n, n)) of
        its new error ``sum W e``, in which all e are the errors before the call.
        """
        forms = {
            name: self.stack.mix([source for source, _ in terms], np.array([W for _, W in terms]))
            for name, (_, terms) in changes.items()
        }
        self.stack.put_all(forms)
        for name, (root, _) in changes.items():
            self.roots[name] = root

    def predict(self, step: Prediction) -> slice:
        """Predict the errors of all estimates and the roots of their P by one ``step``, and the
        state if errors follow it, because the filters' A (or F) is not the plant's; changes the
        stack. Return the columns of the k inputs of the plant's noise, random numbers that the step
        adds.
        """
        stack, noise = self.stack, step.error_noise
        columns = stack.inputs(noise.shape[1])
        indices = stack.indices(self.owner)
        x = stack.form(STATE) if self.follows else None
        # e+ = F e + D x + w for all estimates, and x+ = F x + w for the state
        predict_estimates(
            stack.arrays,
            indices,
            as_kernel_array(step.error),
            as_kernel_array(noise),
            as_kernel_array(step.root),
            columns.start,
        )
        if x is not None:
            stack.table[indices, :, : stack.used] += step.follow @ x
            stack.put(STATE, step.state @ x)
            stack.add(STATE, columns, step.state_noise)
        return columns


def _errors_follow_state(scenario: Scenario) -> bool:
    """Return True if the filters' A (or F) differs from the plant's."""
    if scenario.slotted:
        return not np.array_equal(scenario.slot_belief[0], scenario.slot_plant.F)
    return not np.array_equal(scenario.belief[0], scenario.diffusion.A)


class IncrementFlows(NamedTuple):
    """Flows of errors in a run with increment sensors.

    estimators : of each estimator
    messages : of estimates under way, which use no readings
    plant    : the true A (n, n) and B (n, m)
    """

    estimators: list[ErrorFlow]
    messages: ErrorFlow
    plant: tuple[FloatArray, FloatArray]


class ErrorPropagator:
    """Propagates stacked errors through continuous time, from 0 on."""

    def __init__(self, scenario: Scenario, errors: StackedErrors) -> None:
        """Prepare to propagate ``errors``, which are those at time 0, with the plant and the
        filters' model of the scenario.
        """
        self._errors, self._now = errors, 0.0
        self._flows = _increment_flows(scenario, errors.estimators)
        A, B = scenario.diffusion.A, scenario.diffusion.B
        A_f, Q_f = scenario.belief
        # The filters' B is only known by B B' = Q; the plant's own is as good if it has that Q.
        B_f = B if np.array_equal(B @ B.T, Q_f) else square_root(Q_f)
        self._predictor = Predictor(A, B, A_f, B_f)

    def advance(self, time: float) -> tuple[float, slice | None, FloatArray | None]:
        """Advance all errors and roots of P to ``time`` (seconds); return the gap since the last
        call and the plant's noise over it.

        The noise is a matrix (n, k), by which it enters the state, and the columns of its k inputs:
        the arguments of ``ErrorRule.elapse``. Both are None if a sensor senses increments, or for
        no gap.
        """
        gap = time - self._now
        if gap <= 0.0:
            return 0.0, None, None
        self._now = time
        if self._flows is None:
            step = self._predictor(gap)
            return gap, self._errors.predict(step), step.state_noise
        # The series and the quadrature of a flow hold over one unit only.
        unit = min(flow.unit for flow in (*self._flows.estimators, self._flows.messages))
        steps = math.ceil(gap / unit)
        for _ in range(steps):
            self._step(gap / steps)
        return gap, None, None

    def _estimates_by_flow(self) -> list[tuple[ErrorFlow, list[Hashable]]]:
        """Return each flow (the dynamics of errors with certain sensors) with the names of the
        estimates that share it, so that they are propagated together.
        """
        flows = self._flows
        assert flows is not None
        groups: dict[int, tuple[ErrorFlow, list[Hashable]]] = {}
        for name, owner in self._errors.owner.items():
            flow = flows.messages if owner is None else flows.estimators[owner]
            groups.setdefault(id(flow), (flow, []))[1].append(name)
        return list(groups.values())

    def _step(self, gap: float) -> None:
        """Propagate all estimates, and the state, over ``gap`` seconds, at most the ``unit`` of any
        flow, the time over which its series and quadrature hold.
        """
        flows, errors = self._flows, self._errors
        assert flows is not None
        groups = self._estimates_by_flow()
        # The plant's noise at the 8 nodes of the quadrature enters all errors; the noises of the
        # increments take n inputs for each estimate that uses some.
        n, common = errors.n, 8 * flows.plant[1].shape[1]
        noise_counts = [n * len(names) if flow.observes else 0 for flow, names in groups]
        columns = errors.stack.inputs(common + sum(noise_counts))
        first = columns.start + common
        if not errors.follows:
            for (flow, names), count in zip(groups, noise_counts, strict=True):
                flow.move(errors.stack, names, gap, (columns.start, first))
                first += count
            return
        x = errors.stack.form(STATE)
        shared = slice(columns.start, first)
        for (flow, names), count in zip(groups, noise_counts, strict=True):
            self._step_with_state(flow, names, x, gap, (shared, first))
            first += count
        F, response = propagate_state(flows.plant, gap)
        errors.stack.put(STATE, F @ x)
        errors.stack.add(STATE, shared, response)

    def _step_with_state(
        self,
        flow: ErrorFlow,
        names: list[Hashable],
        x: FloatArray,
        gap: float,
        columns: tuple[slice, int],
    ) -> None:
        """Propagate the estimates ``names``, which share a ``flow`` and whose errors depend on the
        state, over ``gap`` seconds; changes their forms and roots of P.

        ``x`` (n, inputs) is the form of the state before. ``columns``: the slice of the inputs that
        all estimates share (the plant's noise), and the first of n further inputs of each estimate
        in turn.
        """
        errors, (shared, column) = self._errors, columns
        flow_step = flow.transition(np.stack([errors.roots[name] for name in names]), gap)
        forms = flow_step.transition @ errors.stack.forms(names) + flow_step.follow @ x
        forms[:, :, shared] += flow_step.response
        for k, name in enumerate(names):
            if flow.observes:
                forms[k, :, column : column + flow_step.reading_noise.shape[2]] += (
                    flow_step.reading_noise[k]
                )
                column += errors.n
            errors.roots[name] = flow_step.root[k]
        errors.stack.put_all(dict(zip(names, forms, strict=True)))


def integration_steps(scenario: Scenario) -> int:
    """Return the least number of steps in which the errors of a run are propagated, by which its
    cost is estimated; 0 if no sensor senses increments.
    """
    if scenario.slotted:
        return 0
    flows = _increment_flows(scenario, len(scenario.nodes))
    if flows is None:
        return 0
    unit = min(flow.unit for flow in (*flows.estimators, flows.messages))
    return math.ceil(scenario.horizon / unit)


def _increment_flows(scenario: Scenario, estimators: int) -> IncrementFlows | None:
    """Return how errors evolve between messages, or None if no sensor senses increments.

    That is an ErrorFlow for each of the first ``estimators`` nodes, with the node's own sensors,
    and one without sensors for messages under way.
    """
    observations = increment_observations(scenario)
    if not any(len(observation.H) for observation in observations):
        return None
    A, Q = scenario.belief
    plant = (scenario.diffusion.A, scenario.diffusion.B)
    B = plant[1] if np.array_equal(plant[1] @ plant[1].T, Q) else square_root(Q)
    flows: dict[bytes, ErrorFlow] = {}

    def find_flow(observation: Observation) -> ErrorFlow:
        """Return the flow of errors with these sensors."""
        # Estimators with equal sensors share a flow, and are then propagated together.
        key = b"|".join(part.tobytes() for part in observation)
        if key not in flows:
            flows[key] = ErrorFlow(A, B, observation.H, observation.R, observation.root, plant)
        return flows[key]

    empty = np.zeros((0, 0))
    unobserved = find_flow(Observation(np.zeros((0, scenario.plant.n)), empty, empty))
    return IncrementFlows(
        [find_flow(observation) for observation in observations[:estimators]], unobserved, plant
    )
