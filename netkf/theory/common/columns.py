"""Errors of filters as columns: one for each independent noise.

Given the events of a run, errors of affine filters are linear in the first state and in all noises.
The covariance of all errors is the sum of the products of the columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from netkf.algorithms.filter import commutes, compiled_kernels
from netkf.linalg.arrays import FloatArray
from netkf.plants.transitions import Transitions
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import Observation
from netkf.trace.run import Run


def has_columns(scenario: Scenario) -> bool:
    """Return True if errors follow from the verbs: affine kernels that commute with a shift."""
    kernels = compiled_kernels(scenario.node_filter, clocked=not scenario.slotted)
    return kernels is not None and kernels.affine and commutes(scenario.node_filter)


class ErrorColumns:
    """The errors of M estimators as columns: derived classes have the filters.

    ``_kept`` are the errors (M n, C) at earlier times: their means, and a column for each noise.
    """

    estimators: int
    n: int

    def __init__(self) -> None:
        self._kept: list[FloatArray] = []
        self._whitened: dict[int, tuple[Observation, FloatArray, FloatArray]] = {}

    def _whiten(self, observation: Observation) -> tuple[FloatArray, FloatArray]:
        """Return H (p, n) and root (p, p) in units of the assumed root of R; by object."""
        key = id(observation)
        if key not in self._whitened:
            root = np.linalg.cholesky(observation.R)
            H, noise = (np.linalg.solve(root, part) for part in (observation.H, observation.root))
            self._whitened[key] = observation, H, noise
        return self._whitened[key][1:]

    def replay(self) -> Iterator[None]:
        """Replay the events of the run; yield at each of ``run.times``."""
        raise NotImplementedError

    def _forms(self) -> FloatArray:
        """Return the errors (M n, C): the means, and the columns of noises."""
        raise NotImplementedError

    def covariances(self) -> FloatArray:
        """Return P (M, n, n) of the estimators."""
        raise NotImplementedError

    def keep(self) -> None:
        """Store the present errors for ``law``."""
        self._kept.append(self._forms())

    def moments(self, about_mean: bool, stacked: bool) -> FloatArray:
        """Return E[e e'] of the error of each estimator (M, n, n), or ``stacked`` of all together
        (M n, M n); ``about_mean`` their covariances.
        """
        forms = self._forms()[:, int(about_mean) :]
        if not stacked:
            forms = forms.reshape(self.estimators, self.n, -1)
        return np.asarray(forms @ np.swapaxes(forms, -1, -2))

    def law(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean (K M n,) and the covariance of the errors at the K times of ``keep``."""
        width = max(form.shape[1] for form in self._kept)
        # Columns that came after a time are zero there.
        forms = np.concatenate([padded(form, width - form.shape[1]) for form in self._kept])
        noises = forms[:, 1:]
        return forms[:, 0], np.asarray(noises @ noises.T)


class LoggedColumns(ErrorColumns):
    """Errors under clocks, along the log of a run, whose plant may change: derived classes apply a
    row, move everything to a time, and begin a piece of the plant, which sets ``_piece``.
    """

    _scenario: Scenario
    _run: Run
    _log: list[tuple[Any, ...]]  # rows that begin with their times
    _changes: list[float]
    _samples: dict[float, Any]
    _piece: int

    def _lay_laws(self, piece: int) -> None:
        """Compute the laws of a piece of the plant by gap between readings, samples and changes."""
        plant, self._piece = cast(Any, self._scenario.plant).pieces[piece], piece
        self._transitions = Transitions(plant.A, plant.B)
        times = np.unique([0.0, *self._changes, *self._samples, *self._run.times.tolist()])
        gaps = np.unique(np.diff(times))
        laws = zip(*self._transitions.laws(gaps), strict=True)
        self._laws: dict[float, tuple[FloatArray, FloatArray]] = dict(
            zip(gaps.tolist(), laws, strict=True)
        )

    def _law(self, gap: float) -> tuple[FloatArray, FloatArray]:
        """Return F and the root of the plant's noise (n, n) over a gap, in seconds."""
        if gap not in self._laws:
            F, root = self._transitions.laws(np.array([gap]))
            self._laws[gap] = F[0], root[0]
        return self._laws[gap]

    def _apply(self, *row: Any) -> None:
        raise NotImplementedError

    def _move_all(self, time: float) -> None:
        """Move the true state and all estimates to ``time``."""
        raise NotImplementedError

    def _begin_piece(self, piece: int) -> None:
        """Take a piece of the plant, from its first instant on."""
        raise NotImplementedError

    def replay(self) -> Iterator[None]:
        """Repeat the log of the run; yield at each of ``run.times``."""
        rows = iter(self._log)
        row = next(rows, None)
        for until in self._run.times.tolist():
            while row is not None and row[0] <= until:
                self._pass_changes(row[0])
                self._apply(*row)
                row = next(rows, None)
            self._pass_changes(until)
            self._move_all(until)
            yield

    def _pass_changes(self, time: float) -> None:
        """Move all to each change of the plant up to ``time``, where its next piece begins."""
        for change in [c for c in self._changes[self._piece :] if c <= time]:
            self._move_all(change)
            self._begin_piece(self._piece + 1)


def padded(form: FloatArray, after: int, before: int = 0) -> FloatArray:
    """Return a form with so many columns of zeros added: np.pad takes ten times as long."""
    rows, columns = form.shape
    whole = np.zeros((rows, before + columns + after))
    whole[:, before : before + columns] = form
    return whole
