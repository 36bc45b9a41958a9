"""Changes of a plant: from a time on other matrices hold. Between two changes lies a *piece*."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, ClassVar

from netkf.core.errors import ScenarioError, suggest_nearest
from netkf.core.fields import Component, Rule, covariance, field, list_of, matrix, seconds, square
from netkf.core.instants import as_fraction
from netkf.linalg.arrays import FloatArray

FROM = "from"


@dataclass(frozen=True, eq=False)
class PlantChange(Component):
    """From ``start`` on (seconds, ``from`` in files) its matrices hold; all others stay."""

    _written_keys: ClassVar[Mapping[str, str]] = {"start": FROM}

    start: float = field(seconds)

    @property
    def matrices(self) -> dict[str, FloatArray]:
        """The matrices that change, by name."""
        names = [f.name for f in dataclasses.fields(self) if f.name != "start"]
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


@dataclass(frozen=True, eq=False)
class DiffusionChange(PlantChange):
    """A change of ``A`` (n, n), ``B`` (n, m), or ``G`` (n, m) of the input."""

    A: FloatArray | None = field(square, default=None)
    B: FloatArray | None = field(matrix, default=None)
    G: FloatArray | None = field(matrix, default=None)


@dataclass(frozen=True, eq=False)
class LinearChange(PlantChange):
    """A change of ``F`` (n, n), ``Q`` (n, n), or ``G`` (n, m) of the input."""

    F: FloatArray | None = field(square, default=None)
    Q: FloatArray | None = field(covariance, default=None)
    G: FloatArray | None = field(matrix, default=None)


@dataclass(frozen=True, eq=False)
class MapChange(PlantChange):
    """A change of ``Q`` (n, n)."""

    Q: FloatArray | None = field(covariance, default=None)


@dataclass(frozen=True, eq=False)
class RateChange(PlantChange):
    """A change of ``B`` (n, q)."""

    B: FloatArray | None = field(matrix, default=None)


def schedule_of(cls: type[PlantChange]) -> Rule:
    """Return the rule for a list of changes of class ``cls``, or of tables, by their times."""
    fields = {f.name: f for f in dataclasses.fields(cls)}
    names = {FROM if name == "start" else name: name for name in fields}
    listed = ", ".join(names)

    def convert_change(value: Any) -> PlantChange:
        if isinstance(value, cls):
            return value
        if not isinstance(value, Mapping):
            raise TypeError
        for key in value:
            if key not in names:
                remedy = f"{suggest_nearest(str(key), [*names])}keys are {listed}"
                raise ScenarioError(str(key), "is not a key here", value[key], remedy)
        if FROM not in value:
            raise ScenarioError(FROM, "is missing", None, f"add {FROM} = ... in seconds")
        try:
            change = cls(**{names[key]: item for key, item in value.items()})
        except ScenarioError as error:
            key = error.key.replace("start", FROM, 1)
            raise ScenarioError(key, error.rule, error.value, error.remedy) from None
        if not change.matrices:
            remedy = f"add one of {', '.join([*names][1:])}"
            raise ScenarioError("", "must change a matrix", dict(value), remedy)
        return change

    keys = {key: dict(fields[name].metadata["rule"].schema) for key, name in names.items()}
    form = {"type": "object", "properties": keys, "required": [FROM], "additionalProperties": False}
    remedy = f"write {{ {FROM} = 10.0, {[*names][1]} = ... }}"
    entries = list_of(Rule("must be a table", convert_change, remedy, form), "tables", 0)

    def convert(value: Any) -> tuple[PlantChange, ...]:
        changes: tuple[PlantChange, ...] = entries.convert(value)
        for k, change in enumerate(changes[1:]):
            if change.start <= changes[k].start:
                rule = f"must be later than that of the entry before it, {changes[k].start:.15g}"
                key = f"[{k + 1}].{FROM}"
                raise ScenarioError(key, rule, change.start, "sort the entries by time")
        return changes

    return dataclasses.replace(entries, convert=convert)


def matrices_of_pieces(
    first: Mapping[str, Any], schedule: tuple[PlantChange, ...]
) -> list[dict[str, Any]]:
    """Return the matrices by name of the piece before all changes, ``first``, and after each."""
    pieces = [dict(first)]
    for change in schedule:
        pieces.append({**pieces[-1], **change.matrices})
    return pieces


def dividing_period(changes: FloatArray, longest: float) -> float:
    """Return a period of at most ``longest`` seconds of which all ``changes`` (C,), in seconds, are
    multiples: ``longest`` where it is one, also if the others would be a thousand times shorter.
    """
    *times, period = (as_fraction(t) or Fraction(t) for t in (*changes.tolist(), longest))
    unit = math.lcm(1, *(time.denominator for time in times))
    common = Fraction(math.gcd(*(int(time * unit) for time in times)), unit)
    shares = math.ceil(common / period)
    is_multiple = all((time / period).denominator == 1 for time in times)
    if is_multiple or 1000 * common < shares * period:
        return longest
    return float(common / shares)
