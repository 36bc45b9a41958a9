"""Dataclass fields that validate their values, and the base class of scenario components.

``field(rule)`` declares a field; the rule converts the value that a file or a script gives and
describes a wrong one in one line. Files and Python meet the same rules because both go through
``Component.__post_init__``.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from netkf.core.contracts import (
    hold_to_contract,
    hold_to_flags,
    is_netkf_class,
    require_known_members,
)
from netkf.core.errors import ScenarioError, errors_under
from netkf.core.instants import as_written
from netkf.core.printable import MAX_NAME, MAX_RUNS
from netkf.core.stamps import TimeBase
from netkf.linalg.arrays import FloatArray, is_definite, is_semidefinite, readonly_array


@dataclass(frozen=True)
class Rule:
    """A requirement on a value: its text, the conversion that enforces it, and the remedy.

    requirement  text that begins with "must be"
    convert      returns the value to store, or raises TypeError, ValueError or OverflowError;
                 messages of these are not used, since the user is shown ``requirement``, but those
                 of _SpecificError and ScenarioError are
    remedy       text that tells the user how to correct a value that breaks the rule
    schema       JSON Schema that accepts every value of a file that obeys the rule; empty: any
    of_nodes     whether texts in the value are names of nodes, for which scenarios put their ids
    of_time      whether numbers in the value are times or durations, which instants are made of
    """

    requirement: str
    convert: Callable[[Any], Any]
    remedy: str = ""
    schema: Mapping[str, Any] = dataclasses.field(default_factory=dict, compare=False)
    of_nodes: bool = False
    of_time: bool = False

    def __call__(self, key: str, value: Any) -> Any:
        """Return the converted value; raises ScenarioError at ``key`` if it breaks the rule."""
        if getattr(value, "ndim", 0) and hasattr(value, "to_numpy"):  # a column or table of pandas
            value = value.to_numpy()
        try:
            return self.convert(value)
        except ScenarioError as error:
            raise error.under(key) from None
        except _SpecificError as error:
            raise ScenarioError(key, str(error), value, error.remedy or self.remedy) from None
        except (TypeError, ValueError, OverflowError, RecursionError):
            # The requirement tells the user more than Python's own message.
            raise ScenarioError(key, self.requirement, value, self.remedy) from None


class _SpecificError(ValueError):
    """Raised by ``Rule.convert``: a requirement, maybe a remedy, more precise than the rule's."""

    def __init__(self, requirement: str, remedy: str = "") -> None:
        super().__init__(requirement)
        self.remedy = remedy


def field(rule: Rule, default: Any = MISSING) -> Any:
    """Return a dataclass field whose values ``rule`` checks and converts.

    With a default the field is keyword-only; None is accepted if it is the default.
    """
    return dataclasses.field(
        default=default, metadata={"rule": rule}, kw_only=default is not MISSING
    )


setting = field
"""The public name of ``field``: users' classes import it from netkf.parts."""


@dataclass(frozen=True, eq=False)
class Component:
    """Base class of the parts of a scenario: an immutable dataclass with checked fields.

    Components are equal if they have the same class and equal fields.
    """

    _written_keys: ClassVar[Mapping[str, str]] = {}
    """Keys in files of fields whose names differ, since Python reserves these words."""
    _called_if: ClassVar[Mapping[str, str]] = {}
    """Methods of a contract that are called only where another member is True."""
    _values: ClassVar[Mapping[str, Rule]] = {}
    """The rules of members of a contract that are values, which users' classes may override."""
    _reads: ClassVar[str] = ""
    """A property that reads a table: on construction, so that mistakes in the file are found."""

    def __new__(cls, *values: Any, **named: Any) -> Self:
        """Return a new object; raises ScenarioError for nameless or unknown settings."""
        if not is_netkf_class(cls):
            require_known_members(cls)
        # Not of classes with an __init__ of their own, which that of a dataclass is not: it has no
        # file.
        code = getattr(cls.__init__, "__code__", None)
        if (values or named) and code is not None and code.co_filename == "<string>":
            _check_settings(cls, values, named)
        return super().__new__(cls)

    def __init_subclass__(cls) -> None:
        """Hold the methods of a user's class to the contract (``core.contracts``)."""
        super().__init_subclass__()
        if not is_netkf_class(cls):
            hold_to_contract(cls)

    def __post_init__(self) -> None:
        """Check and convert each field by its rule; raises ScenarioError if one breaks it."""
        for field in dataclasses.fields(self):
            value, rule = getattr(self, field.name), field.metadata.get("rule")
            if rule is not None and not (value is None and field.default is None):
                object.__setattr__(self, field.name, rule(field.name, value))
        if not is_netkf_class(type(self)):
            object.__setattr__(self, "_is_checked", True)
            hold_to_flags(self, self._called_if)
        if self._reads:
            getattr(self, self._reads)

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(
            _are_equal(getattr(self, f.name), getattr(other, f.name))
            for f in dataclasses.fields(self)
        )

    def __hash__(self) -> int:
        """Return a hash that equal components share: values may be arrays, which have none."""
        return hash(type(self))


def check_values(part: object) -> None:
    """Raise ScenarioError for a value that a user's class states and that breaks its rule."""
    require_checked(part)
    rules: Mapping[str, Rule] = getattr(part, "_values", {})  # a user's dynamics are no Component
    for name, rule in rules.items():
        rule(f"{type(part).__name__}.{name}", getattr(part, name))


def require_checked(part: object) -> None:
    """Raise ScenarioError for a component of a user's class whose ``__post_init__`` never ran."""
    is_own = isinstance(part, Component) and not is_netkf_class(type(part))
    if is_own and not hasattr(part, "_is_checked"):
        rule = f"{type(part).__name__} has settings that nobody checked"
        remedy = "let its __init__ or __post_init__ call that of super()"
        raise ScenarioError("", rule, None, remedy)


def walk(value: Any) -> Iterator[Any]:
    """Yield a value and all that is inside it, in components and tuples, outer ones first."""
    yield value
    if isinstance(value, Component):
        value = tuple(getattr(value, field.name) for field in dataclasses.fields(value))
    for item in value if isinstance(value, tuple) else ():
        yield from walk(item)


def rebuild(part: Any, change: Callable[[Any, dataclasses.Field[Any], Any], Any]) -> Any:
    """Return a component, or a tuple of components, with ``change(part, field, value)`` in place of
    the values of its fields; the same object if nothing changes. Errors are under the field's key.
    """
    if isinstance(part, tuple) and part and isinstance(part[0], Component):
        items = []
        for k, item in enumerate(part):
            with errors_under(f"[{k}]"):
                items.append(rebuild(item, change))
        return part if all(map(operator.is_, items, part)) else tuple(items)
    if not isinstance(part, Component):
        return part
    changed = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        # The keys of the kind of a filter, or of a block's plant, stand beside the other ones.
        beside = field.name in ("algorithm", "plant")
        key = nullcontext() if beside else errors_under(field.name)
        with key:
            new = change(part, field, value) if field.init else value
        if new is not value:
            changed[field.name] = new
    return dataclasses.replace(part, **changed) if changed else part


def _check_settings(cls: type, values: Sequence[Any], named: Mapping[str, Any]) -> None:
    fields = [f for f in dataclasses.fields(cls) if f.init]
    unnamed = [f.name for f in fields if not f.kw_only]
    listed = ", ".join(f"{f.name}=..." for f in fields)
    remedy = f"write {cls.__name__}({listed})"
    if len(values) > len(unnamed):
        rule = f"takes {', '.join(unnamed) or 'no setting'} without a name"
        raise ScenarioError(cls.__name__, rule, values[len(unnamed)], remedy)
    for name, value in named.items():
        if name not in {f.name for f in fields}:
            raise ScenarioError(f"{cls.__name__}.{name}", "is no setting", value, remedy)


_HOLDERS = (np.ndarray, tuple, list, dict)


def _are_equal(a: Any, b: Any) -> bool:
    # Fast path: scenarios that are made from each other share most of their components.
    if a is b:
        return True
    # Never by == of a user's arrays, or of what holds some.
    if isinstance(a, _HOLDERS) or isinstance(b, _HOLDERS):
        if type(a) is not type(b):
            return False
        if isinstance(a, np.ndarray):
            return np.array_equal(a, b)
        if isinstance(a, dict):
            return a.keys() == b.keys() and all(_are_equal(a[key], b[key]) for key in a)
        return len(a) == len(b) and all(map(_are_equal, a, b))
    return bool(a == b)


def _of_array(value: Any) -> Any:
    """Return the number in an array without dimensions, another value as it is."""
    return value[()] if isinstance(value, np.ndarray) and not value.ndim else value


def number(
    *,
    above: float = -math.inf,
    low: float = -math.inf,
    below: float = math.inf,
    high: float = math.inf,
) -> Rule:
    """Return the rule for a finite number x with above < x < below and low <= x <= high."""
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
        value = _of_array(value)
        if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
            raise TypeError
        result = float(value)
        if not (math.isfinite(result) and above < result < below and low <= result <= high):
            raise ValueError
        return result

    requirement, remedy = "must be a finite number", "give a finite number"
    if bounds:
        requirement = f"{requirement} {' and '.join(bounds)}"
        remedy = f"give a number {' and '.join(bounds)}"
    limits = {"exclusiveMinimum": above, "minimum": low, "exclusiveMaximum": below, "maximum": high}
    finite_limits = {name: limit for name, limit in limits.items() if math.isfinite(limit)}
    return Rule(requirement, convert, remedy, {"type": "number", **finite_limits})


positive = number(above=0.0)
MIN_SECONDS, MAX_SECONDS = 1e-9, 1e15
"""Limits of durations: times have 16 digits, and some are rounded to 1e-12 s."""


def _convert_seconds(value: Any) -> float:
    result: float = positive.convert(value)
    if not MIN_SECONDS <= result <= MAX_SECONDS:
        requirement = f"must be from {MIN_SECONDS:g} to {MAX_SECONDS:g} seconds"
        raise _SpecificError(requirement, "choose another unit of time")
    return result


def of_time(rule: Rule) -> Rule:
    """Return the rule for a value that obeys ``rule``, in which numbers are times in seconds: one
    that is a rational number up to rounding, such as 0.1 + 0.2 or 5 * (1 / 60), becomes the float64
    nearest to it (``core.instants``).
    """

    def convert(value: Any) -> Any:
        result = rule.convert(value)
        return as_written(result) if isinstance(result, float) else result

    return dataclasses.replace(rule, convert=convert, of_time=True)


_DURATION = {"type": "number", "minimum": MIN_SECONDS, "maximum": MAX_SECONDS}
seconds = of_time(Rule(positive.requirement, _convert_seconds, positive.remedy, _DURATION))
probability = number(low=0.0, high=1.0)


MAX_BITS = 12_000
"""Bits of the longest integer: Python writes at most 4300 digits."""


def integer(low: int | None = None, high: int | None = None) -> Rule:
    """Return the rule for an integer from ``low`` to ``high``; None means no limit."""

    def convert(value: Any) -> int:
        value = _of_array(value)
        if isinstance(value, np.floating) and value == np.rint(value) and abs(value) < 2**53:
            value = int(value)  # an id in a row of numbers
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
            raise TypeError
        if (low is not None and value < low) or (high is not None and value > high):
            raise ValueError
        if int(value).bit_length() > MAX_BITS:
            raise ValueError
        return int(value)

    bounds = "" if low is None else f" of at least {low}"
    bounds += "" if high is None else f" and at most {high:,}"
    limits = {"minimum": low, "maximum": high}
    schema = {"type": "integer", **{k: v for k, v in limits.items() if v is not None}}
    return Rule(f"must be an integer{bounds}", convert, f"give an integer{bounds}", schema)


def require_runs(runs: object, low: int = 1, key: str = "runs") -> int:
    """Return a number of ``runs``, from ``low`` to MAX_RUNS; raises ScenarioError at ``key``."""
    integer(low)(key, runs)  # one that is too small is not told of the largest
    result: int = integer(low, MAX_RUNS)(key, runs)
    return result


MAX_MAGNITUDE = 1e30
"""Size of the largest number: products of larger ones, or inverses, could overflow."""


def _require_bool(value: Any) -> bool:
    value = _of_array(value)
    if not isinstance(value, bool | np.bool_):
        raise TypeError
    return bool(value)


boolean = Rule(
    "must be true or false",
    _require_bool,
    "write true or false without quotes",
    {"type": "boolean"},
)


def _require_line(value: Any) -> str:
    if not isinstance(value, str) or not value.isprintable():
        raise TypeError
    return value


def _require_text(value: Any) -> str:
    if not _require_line(value):
        raise TypeError
    return str(value)


line = Rule(
    "must be one line of text",
    _require_line,
    'write it as "text" without line breaks',
    {"type": "string"},
)
text = Rule(
    "must be one line of text that is not empty",
    _require_text,
    'write it as "text"',
    {"type": "string", "minLength": 1},
)


def instance_of(*classes: type) -> Rule:
    """Return the rule for an object of one of the classes."""

    def convert(value: Any) -> Any:
        if not isinstance(value, classes):
            raise TypeError
        require_checked(value)
        return value

    names = " or ".join(
        f"a{'n' if cls.__name__[0] in 'AEIO' else ''} {cls.__name__.lower()}" for cls in classes
    )
    made = " or ".join(cls.__name__ for cls in classes)
    remedy = f'write a table {{ kind = "...", ... }}, or in Python an object of class {made}'
    return Rule(f"must be {names}", convert, remedy)


def stated(*classes: type, optional: bool = False) -> Rule:
    """Return the rule for what a class states as an object of one of the ``classes``, or None."""
    names = " or ".join(cls.__name__ for cls in classes) + (" or None" if optional else "")
    convert = instance_of(*classes, *([type(None)] if optional else [])).convert
    return Rule(f"must be {names}", convert, "see netkf.parts")


def one_of(*names: str) -> Rule:
    """Return the rule for a text that is one of ``names``."""

    def convert(value: Any) -> str:
        if value not in names:
            raise ValueError
        return str(value)

    listed = ", ".join(f'"{name}"' for name in names)
    return Rule(f"must be one of {listed}", convert, "choose one of them", {"enum": [*names]})


choice = one_of
"""``one_of`` under the name that users' classes know, ``netkf.parts.choice``."""


def either(first: Rule, second: Rule, is_second: Callable[[Any], bool]) -> Rule:
    """Return the rule ``second`` for values for which ``is_second`` is True, ``first`` for others.

    A value that breaks its rule gets a message that names both.
    """

    def convert(value: Any) -> Any:
        rule = second if is_second(value) else first
        try:
            return rule.convert(value)
        except (_SpecificError, ScenarioError):
            raise
        except (TypeError, ValueError, OverflowError):
            raise _SpecificError(requirement) from None

    requirement = f"{first.requirement}, or {second.requirement.removeprefix('must be ')}"
    schemas = [dict(rule.schema) for rule in (first, second)]
    schema = {"anyOf": schemas} if all(schemas) else {}
    of_nodes = first.of_nodes or second.of_nodes
    return Rule(requirement, convert, first.remedy, schema, of_nodes)


def has_depth(depth: int) -> Callable[[Any], bool]:
    """Return a predicate of a value: True if it is lists or an array nested at least ``depth``
    deep, as ``either`` needs it to tell a matrix from a list of matrices.
    """

    def measure_depth(value: Any) -> int:
        """Return how deep lists, tuples and arrays are nested, 0 for a number."""
        if isinstance(value, np.ndarray):
            return value.ndim
        if isinstance(value, (list, tuple)):
            return 1 + max(map(measure_depth, value), default=0)
        return 0

    return lambda value: measure_depth(value) >= depth


def array(dimensions: int, name: str) -> Rule:
    """Return the rule for an array of finite real numbers with 1 or 2 ``dimensions``: its result is
    read-only float64, (k,) or (r, c), and not empty.

    ``name`` is what messages call it, such as "vector".
    """

    def convert(value: Any) -> FloatArray:
        if isinstance(value, (str, bytes)) or _has_bool_or_text(value):
            raise TypeError
        result = readonly_array(value)
        if result.ndim == 0:
            opening, closing = "[" * dimensions, "]" * dimensions
            remedy = f"write {opening}{result.item():g}{closing}"
            raise _SpecificError(f"must be a {name}", remedy)
        if result.ndim != dimensions or result.size == 0:
            raise _SpecificError(f"must be a {name}")
        if not np.isfinite(result).all():
            raise _SpecificError(f"must be a {name} with finite numbers")
        if np.abs(result).max() > MAX_MAGNITUDE:
            largest = f"{MAX_MAGNITUDE:g} in size"
            raise _SpecificError(f"must be a {name} with numbers of at most {largest}")
        return result

    remedy = "write rows of equal length, [[a, b], [c, d]]" if dimensions == 2 else "write [a, b]"
    schema: dict[str, Any] = {"type": "number"}
    for _ in range(dimensions):
        schema = {"type": "array", "items": schema, "minItems": 1}
    return Rule(f"must be a {name} with finite numbers", convert, remedy, schema)


def _has_bool_or_text(value: Any) -> bool:
    # numpy would convert both True and "1" to 1.0.
    if isinstance(value, (list, tuple)):
        return any(map(_has_bool_or_text, value))
    return isinstance(value, (bool, str)) or getattr(value, "dtype", None) == np.bool_


vector = array(1, "vector")
matrix = array(2, "matrix")


def _convert_square(value: Any) -> FloatArray:
    result = matrix.convert(value)
    if result.shape[0] != result.shape[1]:
        raise _SpecificError(f"must be a square matrix, not {result.shape[0]} x {result.shape[1]}")
    return np.asarray(result)


square = Rule(
    "must be a square matrix of finite numbers", _convert_square, matrix.remedy, matrix.schema
)


def _convert_symmetric(value: Any) -> FloatArray:
    result = _convert_square(value)
    if not np.allclose(result, result.T, rtol=1e-9, atol=1e-12 * np.abs(result).max()):
        raise _SpecificError("must be a symmetric matrix")
    return result


def _convert_covariance(value: Any) -> FloatArray:
    result = _convert_symmetric(value)
    if not is_semidefinite(result):
        smallest = np.linalg.eigvalsh(result)[0]
        raise _SpecificError(f"must be positive semidefinite (least eigenvalue {smallest:.3g})")
    return result


def _convert_definite_covariance(value: Any) -> FloatArray:
    result = _convert_symmetric(value)
    # Its inverse must not consist of rounding errors, nor exceed MAX_MAGNITUDE.
    if not (is_definite(result) and np.diagonal(result).min() > 1.0 / MAX_MAGNITUDE):
        smallest = np.linalg.eigvalsh(result)[0]
        raise _SpecificError(f"must be positive definite (least eigenvalue {smallest:.3g})")
    return result


covariance = Rule(
    "must be a covariance matrix",
    _convert_covariance,
    "give a symmetric matrix without negative eigenvalues",
    matrix.schema,
)
definite_covariance = Rule(
    "must be a positive definite covariance matrix",
    _convert_definite_covariance,
    "give a symmetric matrix with positive eigenvalues",
    matrix.schema,
)


def list_of(rule: Rule, items: str, min_length: int = 1) -> Rule:
    """Return the rule for a list of at least ``min_length`` values that each obey ``rule``.

    ``items`` is what messages call the values, such as "node ids". Errors name the wrong index.
    """

    def convert(value: Any) -> tuple[Any, ...]:
        if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
            raise TypeError
        if len(value) < min_length:
            raise ValueError
        return tuple(rule(f"[{k}]", item) for k, item in enumerate(value))

    not_empty = "" if min_length == 0 else " that is not empty"
    schema = {"type": "array", "items": dict(rule.schema), "minItems": min_length}
    requirement = f"must be a list of {items}{not_empty}"
    return Rule(requirement, convert, f"write a list of {items}", schema, rule.of_nodes)


def tuple_of(*rules: Rule, description: str) -> Rule:
    """Return the rule for a list of fixed length; item k obeys ``rules[k]``.

    ``description`` is what messages call the list, such as "a pair of node ids".
    """

    def convert(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, (list, tuple, np.ndarray)) or len(value) != len(rules):
            raise TypeError
        return tuple(rules[k](f"[{k}]", item) for k, item in enumerate(value))

    schema = {
        "type": "array",
        "prefixItems": [dict(rule.schema) for rule in rules],
        "minItems": len(rules),
        "maxItems": len(rules),
    }
    of_nodes = any(rule.of_nodes for rule in rules)
    return Rule(f"must be {description}", convert, f"write {description}", schema, of_nodes)


def node_id(low: int | None = None, high: int | None = None) -> Rule:
    """Return the rule for a node: its integer id from ``low`` to ``high``, or its name, a text. A
    scenario replaces names by ids (netkf.scenario.names).
    """
    ids = integer(low, high)

    def convert(value: Any) -> int | str:
        if not isinstance(value, str):
            node: int = ids.convert(value)
            if abs(node) > 2**53:  # tables and arrays hold ids as numbers of 64 bits
                raise _SpecificError("must be an integer from 0 to 2^53", "correct it")
            # Ids of nodes with names are integers of a class of their own.
            return value if isinstance(value, int) else node
        if not value.strip() or len(value) > MAX_NAME or not value.isprintable():
            rule = f"must be an id, or a name of at most {MAX_NAME} printable characters"
            raise _SpecificError(rule, "correct the name")
        return value.strip()

    schema = {"anyOf": [dict(ids.schema), {"type": "string", "minLength": 1}]}
    return Rule(ids.requirement, convert, ids.remedy, schema, of_nodes=True)


MAX_BYTES = 256 << 20  # of a table, unpacked; it limits the memory that reading takes


@dataclass(frozen=True, repr=False)
class SourceFile:
    """A file that a scenario refers to: its path ``name`` as written, relative to ``folder``, and
    what the ``stamps`` in it mean.

    node_ids  the ids of nodes by name, None before a graph is known
    unknown   names in the file that were read before that, with the number -1, -2, ... that stands
              for each until then
    content   what the file had when the scenario was made, which others that are made of that, and
              the copy beside the results, have too; None before
    """

    name: str
    folder: Path
    stamps: TimeBase = TimeBase()
    node_ids: Mapping[str, int] | None = dataclasses.field(default=None, compare=False)
    unknown: dict[str, int] = dataclasses.field(default_factory=dict, compare=False)
    content: bytes | None = dataclasses.field(default=None, compare=False)

    def __repr__(self) -> str:
        return repr(self.name)

    @property
    def full(self) -> Path:
        """Path of the file, absolute or relative to the current folder."""
        return self.folder / self.name

    def read_bytes(self) -> bytes:
        """Return what the file had when the scenario was made; raises OSError."""
        return self.full.read_bytes() if self.content is None else self.content


def _convert_source_file(value: Any) -> SourceFile:
    if isinstance(value, SourceFile):
        source = value
    elif isinstance(value, (str, Path)) and str(value):
        path = Path(value)
        if path.is_absolute():
            source = SourceFile(path.name, path.parent)
        else:
            source = SourceFile(str(value), Path.cwd())
    else:
        raise TypeError
    # A scenario can come from someone else: it must not read files outside its own folder.
    name = os.path.normpath(source.name)
    if not source.name or os.path.isabs(name) or name == ".." or name.startswith("../"):
        raise _SpecificError("must stay inside the folder of the scenario file")
    try:
        folder = source.folder.resolve()
        # A symbolic link inside the folder may lead out of it.
        if not source.full.resolve().is_relative_to(folder):
            raise _SpecificError("must stay inside the folder of the scenario file")
        content = source.content
        if content is None:
            if not source.full.is_file():
                raise _SpecificError(f"no such file in {source.folder}")
            # What is larger is refused by those who read it.
            if source.full.stat().st_size <= MAX_BYTES:
                content = source.full.read_bytes()
    except (OSError, RuntimeError) as error:  # a loop of links, a name that is too long
        raise _SpecificError("must be the path of a file that can be read") from error
    return dataclasses.replace(source, name=name, content=content)


def as_path(name: str, value: object, remedy: str = "give it as text or a pathlib.Path") -> Path:
    """Return the argument ``name`` of a public function as a path.

    Raises ScenarioError unless the value is a text or a path of text.
    """
    if not isinstance(value, (str, os.PathLike)):
        raise ScenarioError(name, "must be a path", value, remedy)
    try:
        return Path(value)
    except TypeError:  # a path of bytes
        raise ScenarioError(name, "must be a path of text", value, remedy) from None


source_file = Rule(
    "must be the path of a file",
    _convert_source_file,
    "give a path relative to the scenario file",
    {"type": "string", "minLength": 1},
)


def as_class(part: Component, cls: type[Component]) -> Any:
    """Return an object of ``cls``, a base class of the component's class, with the same fields."""
    names = [f.name for f in dataclasses.fields(cls) if f.init]
    return cls(**{name: getattr(part, name) for name in names})
