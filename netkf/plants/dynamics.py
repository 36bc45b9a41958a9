"""Dynamics of plants that need not be linear: the motions that netkf knows, and users' own.

A user's class has ``f(x, u, t)`` and ``jacobian(x, u, t)``, the derivatives of f with respect to x
(n, n): of a plant in slots the state (n,) one slot after ``x`` (n,), in continuous time its rate of
change; ``u`` (m,) is the input and ``t`` the time in seconds. Instead of both it may have
``kernels``, a pair of kernels ``f(x, u, t, out)`` and ``jacobian(x, u, t, out)`` (netkf.kernels),
which write their results into ``out``: then runs need no Python between two samples. An attribute
``headings`` names the states that are angles, which recorded states may count from anywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.contracts import error_line, kernel_problem
from netkf.core.errors import ScenarioError
from netkf.core.fields import Component, Rule
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.linalg.portable import apply
from netkf.linalg.vector_functions import VectorFunction
from netkf.plants import motion

Pair = tuple[Callable[..., Any], Callable[..., Any]]


class Motion(NamedTuple):
    """A motion that netkf knows.

    n, m : numbers of states and of components of the input
    states, inputs : what they are
    headings : which states are angles
    flow, rate : the exact flow over a period, the rate of change, each with its Jacobian
    """

    n: int
    m: int
    states: str
    inputs: str
    headings: tuple[int, ...]
    flow: Pair
    rate: Pair


MOTIONS = {
    "unicycle": Motion(
        3, 2, "x, y and heading", "speed and turn rate", (2,),
        (motion.move_unicycle, motion.unicycle_jacobian),
        (motion.unicycle_rate, motion.unicycle_rate_jacobian),
    ),
    "coordinated-turn": Motion(
        5, 0, "x, y, vx, vy and turn rate", "", (),
        (motion.move_turning, motion.turning_jacobian),
        (motion.turning_rate, motion.turning_rate_jacobian),
    ),
}  # fmt: skip
"""Unicycle and coordinated turn, by the names that scenarios use."""


@dataclass(frozen=True, eq=False)
class CustomDynamics(Component):
    """An object ``part`` of a user's class whose ``name`` is "module:Class"; ``is_default`` if the
    class makes one like it without arguments.
    """

    name: str
    part: Any
    is_default: bool = True

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CustomDynamics):
            return NotImplemented
        mine, others = (getattr(one.part, "__dict__", {}) for one in (self, other))
        same = self.name == other.name
        return same and (self.part is other.part or str(mine) == str(others))

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return repr(self.name)


class BlockPart(NamedTuple):
    """A block of n states with m inputs: its f, or F or A (K, n, n) and G (K, n, m) of a linear
    one. If K > 1 there is a last input: the number of those that hold.
    """

    f: Any
    n: int
    m: int
    matrices: FloatArray | None = None
    gains: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class StackedDynamics(Component):
    """Blocks' dynamics side by side; they drive each other by ``coupling`` (n, n)."""

    parts: tuple[BlockPart, ...]
    coupling: FloatArray

    def chosen(self, entries: np.ndarray) -> tuple[StackedDynamics, np.ndarray]:
        """Return the dynamics of whole blocks whose states are ``entries`` (n',), in their order,
        and the numbers (m',) of their inputs.
        """
        ends = np.cumsum([part.n for part in self.parts])
        lasts = np.cumsum([part.m for part in self.parts])
        order = dict.fromkeys(np.searchsorted(ends, entries, side="right").tolist())
        inputs = [np.arange(lasts[k] - self.parts[k].m, lasts[k]) for k in order]
        stacked = StackedDynamics(
            tuple(self.parts[k] for k in order), self.coupling[np.ix_(entries, entries)]
        )
        return stacked, np.concatenate([np.zeros(0, int), *inputs])


class _Linear:
    """A linear block as if it were a user's."""

    def __init__(self, matrices: FloatArray, gains: FloatArray | None) -> None:
        self._matrices, self._gains = matrices, gains

    def _piece(self, u: FloatArray) -> int:
        last = len(self._matrices) - 1
        return min(max(int(u[-1]), 0), last) if last else 0

    def f(self, x: FloatArray, u: FloatArray, _: float) -> FloatArray:
        k = self._piece(u)
        moved = np.asarray(self._matrices[k] @ x)
        if self._gains is not None:
            moved += self._gains[k] @ u[: self._gains.shape[2]]
        return moved

    def jacobian(self, _x: FloatArray, u: FloatArray, _t: float) -> FloatArray:
        return np.asarray(self._matrices[self._piece(u)])


class _Stacked:
    """The values of the functions of blocks side by side, or their Jacobians as one."""

    def __init__(
        self, functions: tuple[VectorFunction, ...], f: StackedDynamics, matrices: bool
    ) -> None:
        self._functions, self._f, self._matrices = functions, f, matrices
        self._is_coupled = f.coupling.any()

    def __call__(self, x: FloatArray, u: FloatArray, t: float, period: float) -> FloatArray:
        values, i, j = [], 0, 0
        for function, part in zip(self._functions, self._f.parts, strict=True):
            values.append(function(x[i : i + part.n], u[j : j + part.m], t, period))
            i, j = i + part.n, j + part.m
        result = block_diagonal(values) if self._matrices else np.concatenate(values)
        if not self._is_coupled:
            return result
        driven = self._f.coupling if self._matrices else apply(self._f.coupling, x)
        return np.asarray(result + driven)


class _LinearMap:
    """A user's f that is linear, F x: summed as netkf sums, so that it is the linear plant to the
    bit. Wherever it is another function its value stands.
    """

    def __init__(self, f: Callable[..., Any], jacobian: Callable[..., Any]) -> None:
        self._f, self._jacobian = f, jacobian

    def __call__(self, x: FloatArray, u: FloatArray, t: float) -> Any:
        value, F = self._f(x, u, t), self._jacobian(x, u, t)
        return apply(np.asarray(F), x) if np.array_equal(value, F @ x) else value


def _is_linear(pair: Pair, n: int, m: int) -> bool:
    """Return True if f is its Jacobian times x at some points, whatever the input."""
    random = np.random.default_rng(0)
    try:
        for _ in range(3):
            x, u = random.standard_normal(n), random.standard_normal(m)
            if not np.array_equal(pair[0](x.copy(), u, 0.0), pair[1](x.copy(), u, 0.0) @ x):
                return False
    # A mistake in the class is reported where it is checked.
    except Exception:
        return False
    return True


def _convert(value: Any) -> Any:
    if isinstance(value, CustomDynamics | StackedDynamics) or value in tuple(MOTIONS):
        return value
    if value is None or isinstance(value, (str, bytes, int, float, list, tuple, dict)):
        raise TypeError
    cls = value if isinstance(value, type) else type(value)
    name = f"{cls.__module__}:{cls.__qualname__}"
    try:
        part = value() if isinstance(value, type) else value
    except Exception as error:
        place = error_line(error)
        rule = f"could not be made ({type(error).__name__}: {error}{'; ' if place else ''}{place})"
        raise ScenarioError("", rule, name, "give it an __init__ without arguments") from error
    if hasattr(part, "kernels"):
        pair, remedy = part.kernels, "write kernels = (f, jacobian)"
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise ScenarioError("", "must have a pair of kernels", name, remedy)
        for method, function in zip(("f", "jacobian"), pair, strict=True):
            if problem := kernel_problem(function, ("x", "u", "t", "out")):
                raise ScenarioError("", f"its kernel {method} {problem}", name, remedy)
        return CustomDynamics(name, part, part is not value or _is_default(part))
    wanted = ("f", "jacobian")
    for method in wanted:
        if not callable(getattr(part, method, None)):
            rule = f"must have a method {method}(x, u, t)"
            raise ScenarioError("", rule, name, "write it; x is (n,), u (m,) and t in seconds")
    return CustomDynamics(name, part, part is not value or _is_default(part))


def _is_default(part: Any) -> bool:
    """Return True if its class without arguments makes an object of the same numbers and texts."""
    try:
        other = type(part)()
    except Exception:
        return False
    return all(
        str(value) == str(getattr(other, key, None))
        for key, value in getattr(part, "__dict__", {}).items()
        if isinstance(value, bool | int | float | str | tuple | list | np.ndarray | np.generic)
    )


_listed = ", ".join(f'"{name}"' for name in MOTIONS)
dynamics = Rule(
    f'must be one of {_listed}, or "module:Class", a class with f(x, u, t) and jacobian(x, u, t)',
    _convert,
    "choose one of them",
    {"type": "string"},
)


def functions_of(f: Any, n: int, m: int, in_slots: bool) -> Any:
    """Return f and its Jacobian for n states and m components of the input, as two functions that
    kernels can call: in slots the map of one, else the rate of change.
    """
    shapes = [((n,), (m,), out) for out in ((n,), (n, n))]
    if isinstance(f, StackedDynamics) and len(f.parts) == 1 and f.parts[0].matrices is None:
        return functions_of(f.parts[0].f, n, m, in_slots)
    if isinstance(f, StackedDynamics):
        pairs = [
            functions_of(
                part.f if part.matrices is None
                else CustomDynamics("", _Linear(part.matrices, part.gains)),
                part.n, part.m, in_slots,
            )
            for part in f.parts
        ]  # fmt: skip
        return tuple(
            VectorFunction(
                _Stacked(functions, f, matrices), shape, is_kernel=False, takes_period=True
            )
            for functions, shape, matrices in zip(
                zip(*pairs, strict=True), shapes, (False, True), strict=True
            )
        )
    if isinstance(f, str):
        pair: Pair = MOTIONS[f].flow if in_slots else MOTIONS[f].rate
        is_kernel = takes_period = True
    else:
        is_kernel, takes_period = hasattr(f.part, "kernels"), False
        pair = f.part.kernels if is_kernel else (f.part.f, f.part.jacobian)
        if in_slots and not is_kernel and _is_linear(pair, n, m):
            pair = (_LinearMap(*pair), pair[1])
    return tuple(
        VectorFunction(function, shape, is_kernel, takes_period)
        for function, shape in zip(pair, shapes, strict=True)
    )
