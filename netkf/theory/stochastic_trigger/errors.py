"""Exact errors under the stochastic event trigger, given who sent in which slot.

A node is silent with probability ``exp(-z' Y z / 2)``, which is up to a factor the likelihood of
``z + u = 0`` with noise u of covariance Y^-1. Given its silence errors therefore have the law that
they would have after a reading with that noise more, and given that it sends that after its
reading: neither depends on what was read (Han et al. 2015, Theorem 2).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from netkf.algorithms.stochastic_trigger import silence_noise
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.common.columns import ErrorColumns
from netkf.theory.common.forms import MEAN, Forms
from netkf.theory.common.observations import Observation, slot_observations
from netkf.theory.common.random_links import all_messages_arrive
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


class ScheduleColumns(ErrorColumns):
    """The error of the one estimate that all nodes have, as a form of the noises."""

    # Who sends depends on readings, so that the filter is not affine: it has equations of its own.

    def __init__(self, scenario: Scenario, run: Run) -> None:
        self._scenario, self._run, self._kept = scenario, run, []
        self.estimators, self.n = len(scenario.nodes), scenario.plant.n
        mean, cov = scenario.initial_estimate(scenario.nodes[0])
        plant: Any = scenario.plant
        self._table = Forms(self.n)
        self._e, self._root = self._table.take(self.n), square_root(np.asarray(cov))
        first = square_root(np.asarray(plant.start_cov))
        self._add(first)
        self._table.table[self._e, MEAN] = plant.start_mean - mean

    def _add(self, noise: FloatArray) -> None:
        """Add ``noise`` (n, k) times k new inputs to the error."""
        column, width = self._table.inputs(noise.shape[1]), noise.shape[1]
        self._table.table[self._e, column : column + width] += noise

    def replay(self) -> Iterator[None]:
        """Replay the decisions of the run; yield at each of ``run.times``."""
        scenario, slot = self._scenario, 0
        sent, observe = decisions(scenario, self._run), slot_observations(scenario, self._run)
        (F, Q), Y = scenario.slot_belief, cast(Any, scenario.filter.algorithm).Y
        noise = square_root(Q)
        for until in scenario.slot_plant.slots_of(self._run.times).tolist():
            while slot < until:
                slot += 1
                self._change(F, noise)
                self._root = triangular_root(np.column_stack([F @ self._root, noise]))
                for h, observation in observe(slot).items():
                    # Silence counts as a reading that equals its prediction, with the noise
                    # R + Y^-1.
                    self._use(observation if (slot, h) in sent else silence(observation, Y))
            yield

    def _change(self, matrix: FloatArray, noise: FloatArray) -> None:
        """Multiply the error by a ``matrix`` (n, n) and add ``noise`` (n, k) times new inputs."""
        table, used = self._table.table, self._table.used
        table[self._e, :used] = matrix @ table[self._e, :used]
        self._add(noise)

    def _use(self, observation: Observation) -> None:
        if not len(observation.H):
            return
        gain, self._root = measurement_update(self._root, observation)
        self._change(np.eye(self.n) - gain @ observation.H, -gain @ observation.root)

    def _forms(self) -> FloatArray:
        """Return the errors (N n, C): the means, and the columns of inputs."""
        return np.tile(self._table.table[self._e, : self._table.used], (self.estimators, 1))

    def covariances(self) -> FloatArray:
        """Return P (N, n, n) of the estimators."""
        return np.tile(self._root @ self._root.T, (self.estimators, 1, 1))

    def keep(self) -> None:
        """Store the present errors for ``law``."""
        error = self._table.freeze(self._table.table[self._e, : self._table.used])
        self._kept.append(np.tile(error, (self.estimators, 1)))


def triangular_root(factor: FloatArray) -> FloatArray:
    """Return the lower triangular S (n, n) with ``S S' = factor factor'``, of a ``factor`` (n, k)
    with k >= n columns.
    """
    # factor' = Z U, so factor factor' = U' U.
    return cast(FloatArray, np.linalg.qr(factor.T, mode="r")).T


def measurement_update(root: FloatArray, observation: Observation) -> tuple[FloatArray, FloatArray]:
    """Return the Kalman gain (n, p) and the root (n, n) of P after a reading, for the ``root``
    before it, by one orthogonal triangularisation, in which no subtraction loses digits.
    """
    p, n = observation.H.shape
    # [[R^1/2, H S], [0, S]] times an orthogonal matrix is [[C, 0], [K C, S+]], C C' = H P H' + R.
    rows = np.block(
        [[np.linalg.cholesky(observation.R), observation.H @ root], [np.zeros((n, p)), root]]
    )
    lower = triangular_root(rows)
    gain = np.linalg.solve(lower[:p, :p].T, lower[p:, :p].T).T
    return np.asarray(gain), lower[p:, p:]


def silence(reading: Observation, Y: float | FloatArray) -> Observation:
    """Return the observation to which a node's silence is equivalent for the others: the H of its
    ``reading`` with noise R + Y^-1 (p, p), Y the matrix of the trigger, or a number times I.
    """
    R = silence_noise(reading.R, Y)
    # The true noise, whose root the reading has, may differ from the believed R.
    root = np.asarray(np.linalg.cholesky(reading.root @ reading.root.T + R - reading.R))
    return Observation(reading.H, R, root)


def error_columns(scenario: Scenario, run: Run) -> ErrorColumns:
    """Return the errors of all nodes under the stochastic trigger, for the replay of a run. Raises
    TheoryError where silence may be a loss, or the filters do not know the law of innovations.
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
    return ScheduleColumns(scenario, run)
