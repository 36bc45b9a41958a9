"""Dataclass fields that validate their values, and the base class of scenario components.

``field(rule)`` declares a field; the rule converts the value that a file or a script gives and
describes a wrong one in one line. Files and Python meet the same rules because both go through
``Component.__post_init__``.
"""

from __future__ import annotations

import dataclasses
import math
import os
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray, is_semidefinite, readonly_array

Method = TypeVar("Method", bound=Callable[..., Any])


@dataclass(frozen=True)
class Rule:
    """A requirement on a value: its text, the conversion that enforces it, and the remedy.

    ``convert`` returns the value to store, or raises ``TypeError`` or ``ValueError``. ``remedy``
    tells the user how to correct a value that breaks the rule. ``schema`` is a JSON Schema that
    every value of a file which obeys the rule validates with; empty if nothing is known.
    """

    requirement: str
    convert: Callable[[Any], Any]
    remedy: str = ""
    schema: Mapping[str, Any] = dataclasses.field(default_factory=dict, compare=False)

    def __call__(self, key: str, value: object) -> Any:
        """Return the converted value; raises ScenarioError at ``key`` if it breaks the rule."""
        try:
            return self.convert(value)
        except ScenarioError as error:
            raise error.under(key) from None
        except _SpecificError as error:
            remedy = error.remedy or self.remedy
            raise ScenarioError(key, str(error), value, remedy) from None
        except (TypeError, ValueError, OverflowError, RecursionError):
            # These messages are Python's own; the requirement tells the user more.
            raise ScenarioError(key, self.requirement, value, self.remedy) from None


class _SpecificError(ValueError):
    """A broken requirement that is narrower than the rule's own; its ``remedy`` may be, too."""

    def __init__(self, requirement: str, remedy: str = "") -> None:
        super().__init__(requirement)
        self.remedy = remedy


def field(rule: Rule, default: Any = MISSING) -> Any:
    """Declare a dataclass field whose values obey ``rule``; a default of None is not checked."""
    return dataclasses.field(
        default=default, metadata={"rule": rule}, kw_only=default is not MISSING
    )


setting = field
"""The public name of ``field``: classes of users import it from netkf.parts."""


def required(method: Method) -> Method:
    """Mark a method that subclasses must define, under its present or its former name.

    It is an abstractmethod that type checkers do not see: they know nothing of former names.
    """
    return abstractmethod(method)


@dataclass(frozen=True, eq=False)
class Component:
    """Base class of everything that a scenario is made of: an immutable set of checked fields.

    Components are equal when they have the same class and equal fields.
    """

    former_names: ClassVar[Mapping[str, str]] = {}
    """The names that attributes of a contract had before, by their present names."""

    def __init_subclass__(cls) -> None:
        """Give every attribute that has a former name both names, whichever the class defines."""
        super().__init_subclass__()
        own = vars(cls)
        for name, former in cls.former_names.items():
            # Both names refer to one function, so super() reaches the base class under either.
            if former in own and name not in own:
                setattr(cls, name, own[former])
            elif name in own:
                setattr(cls, former, own[name])

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, rule = getattr(self, field.name), field.metadata.get("rule")
            if rule is not None and not (value is None and field.default is None):
                object.__setattr__(self, field.name, rule(field.name, value))

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(
            _are_equal(getattr(self, f.name), getattr(other, f.name))
            for f in dataclasses.fields(self)
        )

    def __hash__(self) -> int:
        return hash((type(self), len(dataclasses.fields(self))))


def _are_equal(one: Any, other: Any) -> bool:
    """Return True if two values of fields are equal, arrays and tuples entry by entry."""
    # Scenarios that are made from each other share most parts: caches look them up often.
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return one is not None and other is not None and np.array_equal(one, other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_are_equal, one, other))
    return bool(one == other)


def number(
    *,
    above: float = -math.inf,
    low: float = -math.inf,
    below: float = math.inf,
    high: float = math.inf,
) -> Rule:
    """Return the rule for a finite number inside the given bounds."""
    bounds = [
        f"{relation} {bound:g}"
        for relation, bound in (
            ("above", above),
            ("at least", low),
            ("below", below),
            ("at most", high),
        )
        if math.isfinite(bound)
    ]

    def convert(value: Any) -> float:
        """Return the value as a finite float within the limits."""
        if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
            raise TypeError
        result = float(value)
        if not (math.isfinite(result) and above < result < below and low <= result <= high):
            raise ValueError
        return result

    inside = " and ".join(bounds)
    return Rule(
        f"must be a finite number{' ' if inside else ''}{inside}",
        convert,
        f"give a number {inside}" if inside else "give a finite number",
        {
            "type": "number",
            **_bounds(exclusiveMinimum=above, minimum=low),
            **_bounds(exclusiveMaximum=below, maximum=high),
        },
    )


def _bounds(**given: float) -> dict[str, float]:
    """Return the finite ones of the bounds of a JSON Schema."""
    return {name: bound for name, bound in given.items() if math.isfinite(bound)}


positive = number(above=0.0)
MIN_SECONDS, MAX_SECONDS = 1e-9, 1e15
"""Durations in seconds: times have 16 digits, and some are rounded to 1e-12 s."""


def _seconds(value: Any) -> float:
    """Return a positive time in seconds within the limits of the simulator."""
    result: float = positive.convert(value)
    if not MIN_SECONDS <= result <= MAX_SECONDS:
        requirement = f"must be from {MIN_SECONDS:g} to {MAX_SECONDS:g} seconds"
        raise _SpecificError(requirement, "choose another unit of time")
    return result


_DURATION = {"type": "number", "minimum": MIN_SECONDS, "maximum": MAX_SECONDS}
seconds = Rule(positive.requirement, _seconds, positive.remedy, _DURATION)
probability = number(low=0.0, high=1.0)


MAX_BITS = 12_000
"""Longer integers could not be written: Python prints at most 4300 digits."""


def integer(low: int | None = None, high: int | None = None) -> Rule:
    """Return the rule for an integer from ``low`` to ``high``; None leaves that side open."""

    def convert(value: Any) -> int:
        """Return the value as an int within the limits."""
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
            raise TypeError
        if (low is not None and value < low) or (high is not None and value > high):
            raise ValueError
        if int(value).bit_length() > MAX_BITS:
            raise ValueError
        return int(value)

    bound = "" if low is None else f" of at least {low}"
    bound += "" if high is None else f" and at most {high:,}"
    limits = {"minimum": low, "maximum": high}
    schema = {"type": "integer", **{k: v for k, v in limits.items() if v is not None}}
    return Rule(f"must be an integer{bound}", convert, f"give an integer{bound}", schema)


MAX_MAGNITUDE = 1e30
"""Products of larger entries, or of inverses of smaller variances, could overflow."""


def _instance_of(kind: type) -> Callable[[Any], Any]:
    """Return a conversion that lets through nonempty values of one type only."""

    def convert(value: Any) -> Any:
        """Return the value if it has the type."""
        if not isinstance(value, kind) or value == "":
            raise TypeError
        return value

    return convert


boolean = Rule(
    "must be true or false",
    _instance_of(bool),
    "write true or false without quotes",
    {"type": "boolean"},
)


def _one_line(value: Any) -> str:
    """Return the value if it is printable text without line breaks."""
    if not isinstance(value, str) or not value.isprintable():
        raise TypeError
    return value


def _nonempty_line(value: Any) -> str:
    """Return the value if it is one nonempty line of printable text."""
    if not _one_line(value):
        raise TypeError
    return str(value)


line = Rule(
    "must be one line of text",
    _one_line,
    'write it as "text" without line breaks',
    {"type": "string"},
)
text = Rule(
    "must be one line of text that is not empty",
    _nonempty_line,
    'write it as "text"',
    {"type": "string", "minLength": 1},
)


def instance(*kinds: type) -> Rule:
    """Return the rule for an object of one of the classes ``kinds``."""

    def convert(value: Any) -> Any:
        """Return the value if it is of one of the classes."""
        if not isinstance(value, kinds):
            raise TypeError
        return value

    names = " or ".join(f"a {kind.__name__.lower()}" for kind in kinds)
    return Rule(f"must be {names}", convert, 'write a table { kind = "...", ... }')


def choice(*names: str) -> Rule:
    """Return the rule for one of the given strings."""

    def convert(value: Any) -> str:
        """Return the value if it is one of the names."""
        if value not in names:
            raise ValueError
        return str(value)

    listed = ", ".join(f'"{name}"' for name in names)
    return Rule(f"must be one of {listed}", convert, "choose one of them", {"enum": [*names]})


def either(first: Rule, second: Rule, is_second: Callable[[Any], bool]) -> Rule:
    """Return a rule that applies ``second`` to values for which ``is_second``, else ``first``."""

    def convert(value: Any) -> Any:
        """Return the value as converted by the rule whose form it has."""
        rule = second if is_second(value) else first
        try:
            return rule.convert(value)
        except (_SpecificError, ScenarioError):
            raise
        except (TypeError, ValueError, OverflowError):
            # Either form would have been accepted, so the message names both.
            raise _SpecificError(requirement) from None

    requirement = f"{first.requirement}, or {second.requirement.removeprefix('must be ')}"
    known = [dict(rule.schema) for rule in (first, second)]
    return Rule(requirement, convert, first.remedy, {"anyOf": known} if all(known) else {})


def nested(depth: int) -> Callable[[Any], bool]:
    """Return a test for lists or arrays that are nested at least ``depth`` deep."""

    def measure(value: Any) -> int:
        """Return how deep lists, tuples and arrays are nested, 0 for a number."""
        if isinstance(value, np.ndarray):
            return value.ndim
        if isinstance(value, (list, tuple)):
            return 1 + max(map(measure, value), default=0)
        return 0

    return lambda value: measure(value) >= depth


def array(dimensions: int, kind: str) -> Rule:
    """Return the rule for a finite real array with that many dimensions, called a ``kind``."""

    def convert(value: Any) -> FloatArray:
        """Return the value as a read-only array of finite float64 numbers."""
        if isinstance(value, (str, bytes)) or _has_bool(value):
            raise TypeError
        result = readonly_array(value)
        if result.ndim == 0:
            open_, close = "[" * dimensions, "]" * dimensions
            raise _SpecificError(f"must be a {kind}", f"write {open_}{result.item():g}{close}")
        if result.ndim != dimensions or result.size == 0:
            raise _SpecificError(f"must be a {kind}")
        if not np.isfinite(result).all():
            raise _SpecificError(f"must be a {kind} with finite numbers")
        if np.abs(result).max() > MAX_MAGNITUDE:
            raise _SpecificError(
                f"must be a {kind} with numbers of at most {MAX_MAGNITUDE:g} in size"
            )
        return result

    remedy = "write rows of equal length, [[a, b], [c, d]]" if dimensions == 2 else "write [a, b]"
    schema: dict[str, Any] = {"type": "number"}
    for _ in range(dimensions):
        schema = {"type": "array", "items": schema, "minItems": 1}
    return Rule(f"must be a {kind} with finite numbers", convert, remedy, schema)


def _has_bool(value: Any) -> bool:
    """Return True if a bool or a text is somewhere in nested lists."""
    # numpy would convert True to 1.0 and "1" to 1.0.
    if isinstance(value, (list, tuple)):
        return any(map(_has_bool, value))
    return isinstance(value, (bool, str))


vector = array(1, "vector")
matrix = array(2, "matrix")


def _square(value: Any) -> FloatArray:
    """Return the value as a square matrix."""
    result = matrix.convert(value)
    if result.shape[0] != result.shape[1]:
        raise _SpecificError(f"must be a square matrix, not {result.shape[0]} x {result.shape[1]}")
    return np.asarray(result)


square = Rule("must be a square matrix of finite numbers", _square, matrix.remedy, matrix.schema)


def _symmetric(value: Any) -> FloatArray:
    """Return the value as a symmetric matrix, up to rounding."""
    result = _square(value)
    if not np.allclose(result, result.T, rtol=1e-9, atol=1e-12 * np.abs(result).max()):
        raise _SpecificError("must be a symmetric matrix")
    return result


def _covariance(value: Any) -> FloatArray:
    """Return the value as a positive semidefinite matrix."""
    result = _symmetric(value)
    if not is_semidefinite(result):
        least = np.linalg.eigvalsh(result)[0]
        raise _SpecificError(f"must be positive semidefinite (least eigenvalue {least:.3g})")
    return result


def _definite(value: Any) -> FloatArray:
    """Return the value as a positive definite matrix that is not close to singular."""
    result = _symmetric(value)
    values = np.linalg.eigvalsh(result)
    if not values[0] > max(1e-14 * abs(values[-1]), 1.0 / MAX_MAGNITUDE):
        raise _SpecificError(f"must be positive definite (least eigenvalue {values[0]:.3g})")
    return result


covariance = Rule(
    "must be a covariance matrix",
    _covariance,
    "give a symmetric matrix without negative eigenvalues",
    matrix.schema,
)
definite_covariance = Rule(
    "must be a positive definite covariance matrix",
    _definite,
    "give a symmetric matrix with positive eigenvalues",
    matrix.schema,
)


def several(rule: Rule, what: str, least: int = 1) -> Rule:
    """Return the rule for a list of at least ``least`` values that each obey ``rule``.

    An error names the index of the wrong value in the list.
    """

    def convert(value: Any) -> tuple[Any, ...]:
        """Return the items as a tuple, each converted by the rule."""
        if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
            raise TypeError
        if len(value) < least:
            raise ValueError
        return tuple(rule(f"[{k}]", item) for k, item in enumerate(value))

    some = "" if least == 0 else " that is not empty"
    schema = {"type": "array", "items": dict(rule.schema), "minItems": least}
    return Rule(f"must be a list of {what}{some}", convert, f"write a list of {what}", schema)


def row(*rules: Rule, what: str) -> Rule:
    """Return the rule for a list of fixed length whose entries obey one rule each."""

    def convert(value: Any) -> tuple[Any, ...]:
        """Return the items as a tuple, each converted by its own rule."""
        if not isinstance(value, (list, tuple, np.ndarray)) or len(value) != len(rules):
            raise TypeError
        return tuple(
            rule(f"[{k}]", v) for k, (rule, v) in enumerate(zip(rules, value, strict=True))
        )

    schema = {
        "type": "array",
        "prefixItems": [dict(rule.schema) for rule in rules],
        "minItems": len(rules),
        "maxItems": len(rules),
    }
    return Rule(f"must be {what}", convert, f"write {what}", schema)


@dataclass(frozen=True, repr=False)
class SourceFile:
    """A file that a scenario refers to: its path as written, relative to ``folder``."""

    name: str
    folder: Path

    def __repr__(self) -> str:
        return repr(self.name)

    @property
    def full(self) -> Path:
        """Path of the file, relative to the working directory or absolute."""
        return self.folder / self.name


def _source_file(value: Any) -> SourceFile:
    """Return the value as a SourceFile inside the folder of the scenario."""
    if isinstance(value, SourceFile):
        source = value
    elif isinstance(value, (str, Path)) and str(value):
        source = SourceFile(str(value), Path.cwd())
        if Path(value).is_absolute():
            source = SourceFile(Path(value).name, Path(value).parent)
    else:
        raise TypeError
    # A scenario can come from someone else: it must not read files outside its own folder.
    name = os.path.normpath(source.name)
    if not source.name or os.path.isabs(name) or name == ".." or name.startswith("../"):
        raise _SpecificError("must stay inside the folder of the scenario file")
    try:
        folder = source.folder.resolve()
        # A link inside the folder may still lead out of it.
        if not source.full.resolve().is_relative_to(folder):
            raise _SpecificError("must stay inside the folder of the scenario file")
        if not source.full.is_file():
            raise _SpecificError(f"no such file in {source.folder}")
    except (OSError, RuntimeError) as error:  # a loop of links, a name that is too long
        raise _SpecificError("must be the path of a file that can be read") from error
    return SourceFile(name, source.folder)


def as_path(name: str, value: object, remedy: str = "give it as text or a pathlib.Path") -> Path:
    """Return a path that a script gives as a text or a path; raises ScenarioError for other types.

    ``name`` is the argument.
    """
    if not isinstance(value, (str, os.PathLike)):
        raise ScenarioError(name, "must be a path", value, remedy)
    try:
        return Path(value)
    except TypeError:  # a path of bytes
        raise ScenarioError(name, "must be a path of text", value, remedy) from None


source_file = Rule(
    "must be the path of a file",
    _source_file,
    "give a path relative to the scenario file",
    {"type": "string", "minLength": 1},
)


def as_class(part: Component, cls: type[Component]) -> Any:
    """Return an object of a base class ``cls`` of a part, with the same fields."""
    names = [one.name for one in dataclasses.fields(cls) if one.init]
    return cls(**{name: getattr(part, name) for name in names})
