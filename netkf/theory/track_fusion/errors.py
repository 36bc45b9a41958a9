"""Exact errors of track fusion along the messages of a run."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from netkf.algorithms.kernels.pair_fusion import best_weight, common_basis
from netkf.algorithms.track_fusion import (
    TRACE,
    best_combination,
    predicted_joint,
    updated_joint,
    whitened_sensors,
)
from netkf.linalg.arrays import FloatArray, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, EstimateExchangeRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors, Term
from netkf.theory.numerics.prediction import triangular_root
from netkf.theory.numerics.updates import intersect_covariances
from netkf.trace.run import Run


def fusion_weight(
    own_root: FloatArray, other_root: FloatArray, inverse: bool, trace: bool
) -> float:
    """Return the weight, in 0 .. 1, of the first of two estimates that are fused, from the roots
    ``own_root`` and ``other_root`` (n, n) of their covariances.

    ``inverse`` is for inverse covariance intersection, else covariance intersection; the weight
    minimises the trace of the fused covariance, or its determinant without ``trace``.
    """
    n = len(own_root)
    first, second = (np.ascontiguousarray(triangular_root(S)) for S in (own_root, other_root))
    U, W, b = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    common_basis(first, second, U, W, b)
    return float(best_weight(W, b, inverse, trace))


class PairRule(EstimateExchangeRule):
    """Fusion with each estimate heard, one after the other."""

    def combine(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """Return the new root (n, n) of P and the factors (n, n) of the J errors, after fusion with
        the estimate of each message in turn, in the order of the senders.

        ``roots`` are J roots (n, n) of P: that of the ``node`` first, then those of the messages;
        ``weights`` of links are not used. Called by the replay for every receiver at every arrival.
        """
        algorithm: Any = self.scenario.filter.algorithm
        root, factors = roots[0], [np.eye(len(roots[0]))]
        for heard_root in roots[1:]:
            w = fusion_weight(root, heard_root, algorithm.inverse, algorithm.minimise == TRACE)
            fuse = fuse_inversely if algorithm.inverse else intersect_covariances
            root, (own_factor, heard_factor) = fuse([w, 1.0 - w], [root, heard_root])
            # The errors fused so far are in the estimate, whose error has the factor own_factor.
            factors = [*(own_factor @ factor for factor in factors), heard_factor]
        return root, factors


def fuse_inversely(
    weights: list[float], roots: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the fusion of two estimates by inverse covariance intersection: the root (n, n) of P,
    and the factors (n, n) by which the new error combines both errors, for two ``weights`` with sum
    1 and two ``roots`` (n, n) of their covariances.
    """
    P_a, P_b = (S @ S.T for S in roots)
    inverses = [np.linalg.inv(P_a), np.linalg.inv(P_b)]
    mixed = np.linalg.inv(weights[0] * P_a + weights[1] * P_b)
    # P^-1 = P_a^-1 + P_b^-1 - (w P_a + (1 - w) P_b)^-1: common information counts once.
    P = np.linalg.inv(inverses[0] + inverses[1] - mixed)
    factors = [P @ (V - w * mixed) for w, V in zip(weights, inverses, strict=True)]
    return triangular_root(square_root(0.5 * (P + P.T))), factors


class TrackRule(ErrorRule):
    """Tracks of the nodes, which nothing but readings changes, and combinations of them."""

    def __init__(self, scenario: Scenario, errors: StackedErrors) -> None:
        """Take the errors at time 0; each track begins as a copy of its node's estimate."""
        super().__init__(scenario, errors)
        self._models = scenario.slot_models
        self._sensors = [whitened_sensors(model) for model in self._models]
        nodes = range(errors.estimators)
        start = scenario.initial_estimate(scenario.nodes[0])[1]
        # All tracks begin with one mean: their errors are equal, and so are all covariances.
        self._joint = np.tile(start, (len(nodes), len(nodes), 1, 1))
        for estimator in nodes:
            errors.copy(estimator, _track_name(estimator), estimator)

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update the tracks by the readings of the slot ``time``; a node that hears nothing shows
        its own. Called by the replay at every time of readings.
        """
        self._joint = updated_joint(predicted_joint(self._joint, self._models[0]), self._sensors)
        columns = self.errors.reading_noises(observations)
        for estimator, observation in observations.items():
            self.errors.update(_track_name(estimator), observation, columns[estimator])
        self._combine_tracks({estimator: [] for estimator in range(self.errors.estimators)})

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Combine each node's track (the estimate of its own Kalman filter) with those that it
        heard in this ``slot``; changes the errors that nodes show, not the tracks. Called by the
        replay for each exchange of a slot.
        """
        heard: dict[int, list[int]] = {}
        for message in messages:
            heard.setdefault(message.receiver, []).append(message.sender)
        self._combine_tracks(heard)

    def _combine_tracks(self, heard: dict[int, list[int]]) -> None:
        """Set the errors and roots of P of receivers to those of their combinations with the tracks
        that they heard; ``heard`` lists the senders by receiver, all by index.
        """
        errors, n = self.errors, self.errors.n
        changes: dict[Hashable, tuple[FloatArray, Sequence[Term]]] = {}
        for estimator, senders in heard.items():
            order = [estimator, *sorted(set(senders))]
            own_root = errors.roots[_track_name(estimator)]
            terms: list[Term] = [(_track_name(estimator), np.eye(n))]
            root = own_root
            if len(order) > 1:
                gain, root = best_combination(self._joint, order, own_root)
                gains = np.split(gain, len(order) - 1, axis=1)
                # e = e_i - sum_j G_j (e_i - e_j)
                terms = [(_track_name(estimator), np.eye(n) - sum(gains))]
                terms += [(_track_name(j), G) for j, G in zip(order[1:], gains, strict=True)]
            changes[estimator] = root, terms
        errors.combine(changes)


def _track_name(estimator: int) -> Hashable:
    """Return the name of the error of an estimator's own track."""
    return ("track", estimator)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which track fusion, by cross-covariances or by pairs, uses the readings
    and messages of a run. The replay of the run, which computes its exact errors from its events,
    calls the rule at each event; it changes ``errors``, the stacked errors of all nodes.
    """
    if scenario.node_filter.combination == "tracks":
        return TrackRule(scenario, errors)
    return PairRule(scenario, errors)
