"""Plants in slots that need not be linear, x[k+1] = f(x[k], u[k], t_k) + w[k]."""

from __future__ import annotations

import bisect
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from netkf.core.contracts import describe_error, error_line
from netkf.core.errors import ScenarioError
from netkf.core.fields import boolean, covariance, field, seconds
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply, noise_root
from netkf.linalg.vector_functions import VectorFunction
from netkf.plants.changes import MapChange, matrices_of_pieces, schedule_of
from netkf.plants.dynamics import MOTIONS, StackedDynamics, dynamics, functions_of
from netkf.plants.linear import BLOCK, Blocks, SlotPlant
from netkf.plants.states import RecordedStates
from netkf.plants.truth import WithoutFrames


@dataclass(frozen=True, eq=False)
class NonlinearStates(RecordedStates):
    """A plant whose ``f`` need not be linear: a map of one slot, or else a rate of change."""

    linear: ClassVar[bool] = False
    in_slots: ClassVar[bool] = False
    """Whether f is a map of one slot."""

    f: Any = field(dynamics)

    @property
    def changes(self) -> FloatArray:
        """(0,), as f knows the time: only noise changes, see ``noises``."""
        return np.zeros(0)

    @property
    @abstractmethod
    def noises(self) -> list[FloatArray]:
        """Q (n, n) before the first of ``schedule_times`` and after each."""

    @property
    def m(self) -> int:
        """Number of components of the input, 0 without one."""
        return 0 if self.input is None else self.input.m

    @cached_property
    def functions(self) -> tuple[VectorFunction, VectorFunction]:
        """F and its Jacobian."""
        f, jacobian = functions_of(self.f, self.n, self.m, self.in_slots)
        return f, jacobian

    def functions_of(self, entries: np.ndarray) -> tuple[Any, np.ndarray]:
        """Return f and Jacobian of blocks of ``entries`` (n',), and numbers of inputs (m',)."""
        stacked, inputs = self.f.chosen(entries)
        return functions_of(stacked, len(entries), len(inputs), self.in_slots), inputs

    def check_dynamics(self) -> None:
        """Raise ScenarioError if f does not fit the state or the input, or fails at the mean."""
        _check_dynamics(self, self.functions)


@dataclass(frozen=True, eq=False)
class NonlinearPlant(NonlinearStates, SlotPlant):
    """``x[k+1] = f(x[k], u[k], t_k) + w[k]``, cov(w) = Q; slot k is at time ``k * period`` seconds,
    u[k] is the ``input`` then.

    f       "unicycle" (x, y, heading, with speed and turn rate as input; over a period with both
            held the path is an arc), "coordinated-turn" (x, y, vx, vy, turn rate, without input),
            or "module:Class", the map of one slot
    Q       (n, n); ``schedule`` has others from some times on
    period  seconds

    Headings are not wrapped: they count whole turns. With a ``path`` the states are recorded, and
    with ``unknown`` there are none but those that filters assume.
    """

    in_slots: ClassVar[bool] = True

    Q: FloatArray = field(covariance)
    period: float = field(seconds)
    schedule: tuple[MapChange, ...] = field(schedule_of(MapChange), default=())
    unknown: bool = field(boolean, default=False)  # type: ignore[misc]

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.Q)

    @property
    def noises(self) -> list[FloatArray]:
        """Q (n, n) before the first of ``noise_slots`` and after each."""
        return [piece["Q"] for piece in matrices_of_pieces({"Q": self.Q}, self.schedule)]

    @cached_property
    def noise_roots(self) -> list[FloatArray]:
        """Roots (n, n) of ``noises``, by which standard normals are multiplied."""
        return [noise_root(Q) for Q in self.noises]

    @property
    def noise_slots(self) -> list[int]:
        """The slots from which on Q is the next one."""
        slots: list[int] = self.slots_of(self.schedule_times).tolist()
        return slots

    def inputs(self, slots: int) -> FloatArray:
        """Return u (S, m) of the slots 0 to S - 1."""
        if self.input is None:
            return np.zeros((slots, 0))
        return np.array(self.input.values(self.time_grid.snap(self.period * np.arange(slots))))

    def truth(self, random: np.random.Generator, frames: bool = False) -> MapPath:
        """Return the true states of one run, drawn from ``random``; frames are of linear plants."""
        start = self.start_mean + apply(self.start_root, random.standard_normal(self.n))
        return MapPath(self, start, random)


def _check_dynamics(plant: Any, functions: tuple[VectorFunction, VectorFunction]) -> None:
    """Raise ScenarioError if f does not fit the state or the input of a plant, or fails."""
    n, m = plant.n, plant.m
    # Blocks are checked one by one.
    if isinstance(plant.f, StackedDynamics):
        return
    if plant.input is not None and plant.input.G is not None:
        remedy = "leave it out: u is what f takes"
        raise ScenarioError("input.G", "means nothing with a nonlinear plant", None, remedy)
    if isinstance(plant.f, str) and plant.f in MOTIONS:
        _check_motion(plant, MOTIONS[plant.f])
        return
    u = np.zeros(m) if plant.input is None else plant.input.at(0.0)
    x = plant.start_mean if len(plant.start_mean) == n else np.zeros(n)
    for name, function in zip(("f", "jacobian"), functions, strict=True):
        try:
            value = function(x, u, 0.0, 0.0)
        except Exception as error:
            place = error_line(error)
            rule = f"{name} failed at plant.mean ({describe_error(error)}"
            rule = " ".join(f"{rule}{'; ' if place else ''}{place})".split())
            remedy = f"{name}(x, u, t) takes x ({n},), u ({m},) and t in seconds"
            raise ScenarioError("f", rule, plant.f, remedy) from error
        if not np.isfinite(value).all():
            rule = f"{name} must be finite at plant.mean, not {value.tolist()}"
            raise ScenarioError("f", rule, plant.f, "give plant.mean, or correct the class")


def _check_motion(plant: Any, motion: Any) -> None:
    """Raise ScenarioError if state or input have not the sizes of a built-in motion."""
    n, m = plant.n, plant.m
    if motion.n != n:
        key = "B" if hasattr(plant, "B") else "Q"
        rule = f"must have {motion.n} rows, for {motion.states}"
        raise ScenarioError(key, rule, f"{n} rows", f'that is the state of "{plant.f}"')
    if motion.m == m:
        return
    if not motion.m:
        raise ScenarioError("input", f'means nothing with "{plant.f}"', None, "leave it out")
    rule = f'must have {motion.m} components for "{plant.f}", {motion.inputs}'
    got = f"{m} components" if m else None
    remedy = 'write input = { kind = "constant", value = [v, w] }'
    raise ScenarioError("input", rule if m else f"is missing: it {rule}", got, remedy)


class MapPath(WithoutFrames):
    """The path of a run from x[0] = ``start`` (n,) on, drawn from ``random`` slot after slot."""

    def __init__(
        self, plant: NonlinearPlant, start: FloatArray, random: np.random.Generator
    ) -> None:
        self._plant, self._noise = plant, Blocks(random, plant.noise_roots[0].shape[1])
        self._changes = plant.noise_slots
        self._slot, self._x, self._u = 0, start, plant.inputs(BLOCK)

    def state(self, slot: int) -> FloatArray:
        """Return x (n,) in slot number ``slot``."""
        plant = self._plant
        f = plant.functions[0]
        # States beyond the horizon may overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self._slot, slot):
                if k == len(self._u):
                    self._u = plant.inputs(2 * k)
                root = plant.noise_roots[bisect.bisect_right(self._changes, k)]
                noise = apply(root, self._noise.draw())
                self._x = f(self._x, self._u[k], k * plant.period, plant.period) + noise
        self._slot = slot
        return self._x

    local = absolute = state
