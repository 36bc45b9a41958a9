"""The contract of plants."""

from __future__ import annotations

import copy
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np

from netkf.core.errors import ScenarioError, errors_under
from netkf.core.fields import (
    Component,
    boolean,
    covariance,
    field,
    instance_of,
    integer,
    list_of,
    text,
    vector,
)
from netkf.core.instants import OnGrid, TimeGrid
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import noise_root, product
from netkf.plants.changes import matrices_of_pieces
from netkf.plants.inputs import Input, RecordedInput
from netkf.plants.truth import RecordedTruth
from netkf.rng.normals import Normals


@dataclass(frozen=True, eq=False)
class Plant(Component, OnGrid):
    """The contract of a plant, whose x(0) is Gaussian of ``mean`` (n,) and ``cov`` (n, n).

    Both are zero by default. ``input`` drives the state beside the noise (``response``); what the
    methods of plants return is the state without it. ``states`` are the names and ``units`` the
    units of its n components, for figures and pages.
    """

    _values = MappingProxyType(
        {
            "n": integer(1),
            **{"start_mean": vector, "start_cov": covariance},
            **dict.fromkeys(("is_random", "truth_known", "linear"), boolean),
        }
    )

    is_random: ClassVar[bool] = True
    """True if runs draw the state from the model; else the model is what the filters assume of a
    state that is recorded or unknown.
    """
    truth_known: ClassVar[bool] = True
    """True if the state is known, so that errors can be computed."""
    linear: ClassVar[bool] = True
    """Whether the dynamics are linear in the state."""
    record: ClassVar[Any] = None
    """The states of its table, ``states.StateTable``; None if it has none."""
    node: ClassVar[int | None] = None
    """The node (id) whose rows count in tables with a column ``node``."""

    mean: FloatArray | None = field(vector, default=None)
    cov: FloatArray | None = field(covariance, default=None)
    input: Input | None = field(instance_of(Input), default=None)
    states: tuple[str, ...] | None = field(list_of(text, "names"), default=None)
    units: tuple[str, ...] | None = field(list_of(text, "units"), default=None)

    def check_names(self) -> None:
        """Raise ScenarioError unless there is a name and a unit for each component, or none."""
        for key, given in (("states", self.states), ("units", self.units)):
            if given is not None and len(given) != self.n:
                rule = f"must be {self.n}, one for each component of the state"
                raise ScenarioError(key, rule, list(given), "add or remove some")
        names = list(self.states or ())
        if len(set(names)) < len(names):
            raise ScenarioError("states", "must differ from each other", names, "rename one")

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the n components, such as ``x (m)``; empty where one has no name or unit."""
        names, units = self.states or ("",) * self.n, self.units or ("",) * self.n
        pairs = zip(names, (f"({unit})" if unit else "" for unit in units), strict=True)
        return tuple(" ".join(filter(None, pair)) for pair in pairs)

    def on_grid(self, grid: TimeGrid) -> Self:
        """Return the plant with its instants, and those of its input, on the ``grid``."""
        plant = super().on_grid(grid)
        if plant is not self and plant.input is not None:
            object.__setattr__(plant, "input", plant.input.on_grid(grid))
        return plant

    @property
    def recorded_truth(self) -> RecordedTruth:
        """The states of its table as engines read them; nan at all times without one."""
        if self.record is None:
            return RecordedTruth(np.empty(0), np.empty((0, self.n)), self.n)
        truth: RecordedTruth = self.record.truth
        return truth

    def owned_by(self, node: int | None) -> Self:
        """Return the plant as the block of ``node`` (id), whose rows count in its tables."""
        if node is None:
            return self
        plant = copy.copy(self)
        plant.__dict__.pop("record", None)
        object.__setattr__(plant, "node", node)
        if isinstance(plant.input, RecordedInput):
            object.__setattr__(plant, "input", plant.input.owned_by(node))
        return plant

    def read(self) -> None:
        """Raise ScenarioError for a mistake in its tables."""
        if self.input is not None:
            with errors_under("input"):
                _ = self.input.exogenous

    @property
    def draws(self) -> bool:
        """True if runs draw states of it, as those of some of its blocks."""
        return self.is_random

    @property
    @abstractmethod
    def n(self) -> int:
        """Dimension of the state."""

    @property
    def pieces(self) -> tuple[Any, ...]:
        """The plants before the first change and after each, without changes of their own."""
        return (self,)

    @property
    def input_gains(self) -> list[FloatArray]:
        """G (n, m) of the input before the first change and after each."""
        assert self.input is not None
        first = {"G": self.input.G}
        return [piece["G"] for piece in matrices_of_pieces(first, getattr(self, "schedule", ()))]

    @property
    def changes(self) -> FloatArray:
        """(C,) times in seconds, increasing, at which the matrices of the plant change."""
        return self.schedule_times

    @property
    def schedule_times(self) -> FloatArray:
        """(C,) times in seconds, increasing, of ``schedule``; none of plants without one."""
        starts = [change.start for change in getattr(self, "schedule", ())]
        return self.time_grid.snap(np.array(starts, dtype=np.float64))

    @property
    def start_mean(self) -> FloatArray:
        """(n,) mean of x(0)."""
        return np.zeros(self.n) if self.mean is None else self.mean

    @property
    def start_cov(self) -> FloatArray:
        """(n, n) covariance of x(0)."""
        return np.zeros((self.n, self.n)) if self.cov is None else self.cov

    @cached_property
    def start_root(self) -> FloatArray:
        """A root S (n, n) of ``start_cov = S S'``, by which standard normals are multiplied."""
        return noise_root(self.start_cov)

    def starts(self, normals: Normals) -> FloatArray:
        """Return x(0) (B, n) of B runs, with a stream of ``normals`` for each."""
        # A product for each run: its state has the same bits whatever the other runs are.
        deviations = product(normals.draw((1, self.n)), self.start_root.T)
        return np.asarray(self.start_mean + deviations[:, 0])
