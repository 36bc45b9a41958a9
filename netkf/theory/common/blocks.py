"""Nodes that estimate blocks of the state, from what is known of those that estimate all of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, cast

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.columns import ErrorColumns, padded
from netkf.theory.common.evidence import require_linear
from netkf.trace.run import Run

MATRICES = ("A", "B", "F", "Q", "G", "H", "mean", "cov")
"""Names of fields with an entry, a row or a column for each state."""


def have_one_view(scenario: Scenario) -> bool:
    """Return True if all nodes estimate the same blocks, but not all there are, and the others may
    be left out: all are drawn, and links do not follow them.
    """
    views = scenario.views
    if views is None or not scenario.plant.is_random or scenario.links_follow_state:
        return False
    return all(np.array_equal(views[0], view) for view in views)


@lru_cache(maxsize=8)
def scenario_of_view(scenario: Scenario) -> Scenario:
    """Return the scenario of the blocks that all nodes estimate and nothing else moves."""
    require_linear(scenario)
    assert scenario.views is not None
    view, plant = scenario.views[0], cast(Any, scenario.plant)
    square = np.ix_(view, view)

    def part(name: str, value: Any) -> Any:
        """Return what is left of a matrix, or of a tuple of them."""
        if value is None or isinstance(value, tuple):
            return value and tuple(part(name, one) for one in value)
        if name == "H":
            return np.ascontiguousarray(value[:, view])
        return np.ascontiguousarray(value[view] if name in ("B", "G", "mean") else value[square])

    def parts(holder: Any, **others: Any) -> Any:
        """Return an object with what is left of its matrices, and ``others``."""
        names = {field.name for field in dataclasses.fields(holder)} & set(MATRICES)
        values = {name: part(name, getattr(holder, name)) for name in names}
        return dataclasses.replace(holder, **values, **others)

    changes = tuple(parts(change) for change in plant.schedule)
    u = None if plant.input is None else parts(plant.input)
    return dataclasses.replace(
        scenario,
        plant=parts(plant, input=u, schedule=changes),
        plants=(),
        sensors=tuple(parts(sensor) for sensor in scenario.sensors),
        filter=parts(scenario.filter, model=parts(scenario.filter.model), estimates="all"),
    )


def run_of_view(scenario: Scenario, run: Run) -> Run:
    """Return a run of ``scenario`` as one of :func:`scenario_of_view`."""
    assert scenario.views is not None
    return dataclasses.replace(run, x=run.x[:, scenario.views[0]])


@lru_cache(maxsize=8)
def scenario_of_all(scenario: Scenario) -> Scenario:
    """Return the scenario whose nodes estimate the whole state; cached with its tables."""
    return scenario.replace({"filter.estimates": "all"})


class SeenErrors(ErrorColumns):
    """The errors of nodes that estimate blocks, from ``whole`` ones of nodes that estimate all. If
    these do not talk, what a node has of blocks that nothing else drives, and from readings of
    these alone, does not depend on the others; else they have the own blocks first
    (``Needs.coupled``).
    """

    def __init__(self, whole: ErrorColumns, scenario: Scenario) -> None:
        super().__init__()
        views, size = scenario.views, whole.estimators * whole.n
        assert views is not None
        self._whole, self.estimators, self.n = whole, len(views), scenario.width
        # Row of each error among the whole ones; the last one, 0, beyond the states of a node.
        self._rows = np.full((self.estimators, self.n), size)
        for h, view in enumerate(views):
            own = np.arange(len(view)) if scenario.node_filter.needs.coupled else view
            self._rows[h, : len(view)] = h % whole.estimators * whole.n + own

    def replay(self) -> Iterator[None]:
        """Replay the events of the run; yield at each of ``run.times``."""
        return self._whole.replay()

    def _forms(self) -> FloatArray:
        return np.asarray(padded(self._whole._forms().T, 1).T[self._rows.ravel()])

    def covariances(self) -> FloatArray:
        """Return P (M, n, n), with the variance 1 of states that a node does not estimate."""
        size, n = self._whole.estimators * self._whole.n, self._whole.n
        P = np.eye(size + 1)
        for m, own in enumerate(self._whole.covariances()):
            P[m * n : (m + 1) * n, m * n : (m + 1) * n] = own
        blocks = P[self._rows[:, :, None], self._rows[:, None, :]]
        outside = (self._rows == size)[:, :, None] | (self._rows == size)[:, None, :]
        seen: FloatArray = np.where(outside, np.eye(self.n), blocks)
        return seen

    def keep(self) -> None:
        """Store the present errors for ``law``."""
        self._whole.keep()

    def law(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean and the covariance of the errors at the times of ``keep``."""
        mean, covariance = self._whole.law()
        size = self._whole.estimators * self._whole.n
        starts = np.arange(0, len(mean), size)[:, None]
        rows = np.where(self._rows.ravel() == size, len(mean), starts + self._rows.ravel()).ravel()
        whole: FloatArray = np.pad(covariance, (0, 1))
        return np.append(mean, 0.0)[rows], whole[np.ix_(rows, rows)]
