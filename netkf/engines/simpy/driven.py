"""What tells a filter of the input of its plant if its estimates cannot be counted from the
response to it: a model of the node that adds the response to what it predicts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter
from netkf.core.contracts import ContractError
from netkf.linalg.arrays import FloatArray
from netkf.plants.response import moments_over
from netkf.scenario.scenario import Scenario


class DrivenModel:
    """The ``model`` of a node that knows the input of a plant, for filters in plain Python that do
    not commute with a shift. The estimate, of the entries ``view`` (n,) of the state (None: all),
    is predicted from ``start`` to ``end``, in seconds.
    """

    def __init__(self, scenario: Scenario, model: Any, view: np.ndarray | None = None) -> None:
        response: Any = scenario.believed_response
        self.undriven, self._response = model, response
        self._view: Any = slice(None) if view is None else view
        self._grid = scenario.time_grid
        self._period = scenario.slot_plant.period if scenario.slotted else None
        self.start = self.end = 0.0
        self._predicted = False

    def __getattr__(self, name: str) -> Any:
        """Return what the input does not change."""
        return getattr(self.__dict__["undriven"], name)

    def _m(self, time: float) -> FloatArray:
        at = time if self._period is None else round(time / self._period)
        return np.asarray(self._response.states(np.array([at]))[0, self._view])

    def advance(self, algorithm: Filter, state: Any, start: float, gap: float) -> Any:
        """Return the state of the filter ``gap`` seconds after ``start``; raises ContractError if
        it did not ask the model, which alone knows the input.
        """
        self.start, self.end, self._predicted = start, self._grid.instant(start + gap), False
        state = algorithm.predict(state, gap)
        if not self._predicted:
            raise ContractError(
                f"{type(algorithm).__name__}.predict must call model.predict(xhat, root, gap), "
                "which knows the input of the plant, or the class must define shift"
            )
        return state

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate (n,) and root (n, n) after the whole ``gap``, see ``Model``."""
        self._predicted = self._grid.instant(self.start + gap) == self.end
        moved, root = self.undriven.predict(xhat - self._m(self.start), root, gap)
        return moved + self._m(self.end), root

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate (n,) and root (n, n) ``age`` s after a received one, see ``Model``."""
        if self._period is not None or age <= 0.0:
            return xhat, root
        moved, root = self.undriven.extrapolate(xhat - self._m(self.end - age), root, age)
        return moved + self._m(self.end), root

    def gain_update(
        self, xhat: FloatArray, root: FloatArray, moments: FloatArray, gap: float
    ) -> FloatArray:
        """Return the estimate (n,) after increments with these ``moments`` (2 p,), see ``Model``;
        those of the response to the input are known.
        """
        of_m = moments_over(self._response, self.start, self.end, self._grid)[:, self._view]
        known = of_m @ self.undriven.H.T
        local, m = moments - known.reshape(-1), self._m(self.end)
        return np.asarray(self.undriven.gain_update(xhat - m, root, local, gap) + m)
