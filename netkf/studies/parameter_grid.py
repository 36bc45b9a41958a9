"""Values of keys on the command line: grids, ranges, and the type of a key of a scenario."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import date
from datetime import time as clock_time
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError, errors_under
from netkf.core.fields import Component
from netkf.network.graph_files import as_graph
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import replaces_key, split_path
from netkf.scenario.values import parse_values, split_setting
from netkf.scenario.writing import part_as_table, resolve_defaults, toml_text

MAX_POINTS = 10_000  # more are a slip
MAX_INTEGER = 2**63
"""Integers from it on fit no column of a table."""
_RANGE = re.compile(r"^([^:,\[{\"']+):([^:,]+):(\d+)$")


def parse_grid(settings: Sequence[str], fixed: Iterable[str] = ()) -> dict[str, list[Any]]:
    """Return the values of ``key.path=v1,v2,...`` or ``start:stop:count``; raises ScenarioError,
    also where they replace one of the keys that ``--set`` has ``fixed``.
    """
    grid: dict[str, list[Any]] = {}
    for setting in settings:
        key, text = split_setting("--vary", setting)
        if key in grid:
            raise ScenarioError("--vary", f"{key} is varied twice", setting, "give all in one list")
        evenly = _RANGE.match(text)
        grid[key] = (
            _even_values(key, *evenly.groups()) if evenly else parse_values("--vary", key, text)
        )
    for key, other in itertools.product(grid, fixed):
        if replaces_key(key, other):
            rule = f"{key} replaces what --set or --seed gives for {other}"
            raise ScenarioError("--vary", rule, None, "leave out one of the two")
    return grid


def _even_values(key: str, start: str, stop: str, count: str) -> list[Any]:
    """Return ``count`` evenly spaced values; integers if all are whole and both ends are."""
    try:
        low, high, number = float(start), float(stop), int(count)
        integers = [int(start), int(stop)]
    except ValueError:
        integers = []  # wrong texts are refused below
    if not _are_finite(start, stop) or not 2 <= int(count) <= MAX_POINTS:
        rule = (
            f"range of {key} must be START:STOP:COUNT, two numbers and 2 to {MAX_POINTS:,} values"
        )
        raise ScenarioError("--vary", rule, f"{start}:{stop}:{count}", "correct it")
    values = np.linspace(low, high, number)
    if integers and np.array_equal(values, np.round(values)):
        return [int(value) for value in values]
    return [float(f"{value:.12g}") for value in values]


def _are_finite(*texts: str) -> bool:
    try:
        return all(math.isfinite(float(text)) for text in texts)
    except ValueError:
        return False


def values_of_grid(grid: Any) -> dict[str, list[Any]]:
    """Return the values of each key of a user's ``grid``; raises ScenarioError."""
    if not isinstance(grid, Mapping) or not grid:
        found = None if isinstance(grid, Mapping) else grid
        raise ScenarioError("--vary", "needs a key with its values", found, "KEY=V1,V2,...")
    values_by_key = {}
    for key, values in grid.items():
        if not (isinstance(values, (list, tuple, range, np.ndarray)) and len(values)):
            raise ScenarioError("--vary", f"{key} needs a list of values", values, "give some")
        plain = values.tolist() if isinstance(values, np.ndarray) else list(values)
        with errors_under(str(key)):
            values_by_key[str(key)] = stored = list(map(_storable, plain))
        for value, count in Counter(map(_text, stored)).items():
            if count > 1:
                rule = f"{key} has one value {count} times"
                raise ScenarioError("--vary", rule, value, "give each once; --runs repeats runs")
    _require_apart(list(values_by_key))
    size = math.prod(map(len, values_by_key.values()))
    if size > MAX_POINTS:
        rule = f"is a grid of {size:,} points, at most {MAX_POINTS:,} are possible"
        raise ScenarioError("--vary", rule, None, "vary less at once")
    return values_by_key


def _storable(value: Any) -> Any:
    """Return a value as manifests and tables of results can hold it, parts as their tables."""
    value = as_graph(value)
    if isinstance(value, Component):
        return part_as_table(value)
    return value.isoformat() if isinstance(value, (date, clock_time)) else value


def _text(value: Any) -> str:
    """Return a value as TOML; of equal numbers one text."""
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return toml_text(float(value) if is_integer and abs(value) < 2**53 else value)


def _require_apart(keys: list[str]) -> None:
    """Raise ScenarioError if a key sets again what an earlier one has varied."""
    for first, key in combinations(keys, 2):
        if replaces_key(key, first):
            rule = f"{key} replaces the values of {first}, which is varied before it"
            remedy = (
                "vary the table first"
                if not replaces_key(first, key)
                else "give all values in one list"
            )
            raise ScenarioError("--vary", rule, None, remedy)


class GridPoint(NamedTuple):
    """A point of a grid: changes of keys, the scenario with them, and their entries in a table."""

    changes: dict[str, Any]
    scenario: Scenario
    row: dict[str, Any]


def expand_grid(scenario: Scenario, grid: Mapping[str, Sequence[Any]]) -> list[GridPoint]:
    """Return all points of a grid, the last key fastest; raises ScenarioError."""
    values = values_of_grid(grid)
    points, rows = (
        [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*columns)]
        for columns in (values.values(), map(table_column, values.values()))
    )
    grid_points = []
    for changes, row in zip(points, rows, strict=True):
        try:
            grid_points.append(GridPoint(changes, scenario.replace(changes), row))
        except ScenarioError as error:
            point = ", ".join(f"{key} = {toml_text(value)}" for key, value in changes.items())
            raise error.in_file(f"at {point}") from None
    return grid_points


def table_column(values: Sequence[Any]) -> list[Any]:
    """Return values for one column of a table: numbers, flags or texts unchanged, others as TOML,
    and so all if they are of several types.
    """
    are_flags = [isinstance(value, bool) for value in values]
    are_numbers = [
        isinstance(value, float) or (isinstance(value, int) and abs(value) < MAX_INTEGER)
        for value in values
    ]
    if all(are_flags) or (all(are_numbers) and not any(are_flags)):
        return list(values)
    return [value if isinstance(value, str) else toml_text(value) for value in values]


def parse_interval(setting: str) -> tuple[str, float | int, float | int]:
    """Return the key and the ends of ``key.path=LOW:HIGH``; raises ScenarioError."""
    key, text = split_setting("--vary", setting)
    low, colon, high = text.partition(":")
    if not colon or not _are_finite(low, high):
        raise ScenarioError(
            "--vary", f"range of {key} must be LOW:HIGH, two numbers", text, "write 1.0:20.0"
        )
    ends = [int(e) if re.fullmatch(r"\s*[+-]?\d+\s*", e) else float(e) for e in (low, high)]
    return key, ends[0], ends[1]


def is_integer_key(scenario: Scenario, key: str) -> bool:
    """Return True if ``key`` has an integer value; raises ScenarioError for no number."""
    value: Any = resolve_defaults(scenario)
    # Follow the path, such as sensors[0].R, through tables and lists.
    for name in split_path(key):
        try:
            value = value[int(name)] if isinstance(value, (list, tuple)) else value[name]
        except (KeyError, IndexError, ValueError, TypeError):
            rule = f"{key} is not a key of this scenario as it stands"
            raise ScenarioError("--vary", rule, None, "set it first with --set") from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        rule = f"{key} must be a number in the scenario to be searched"
        raise ScenarioError("--vary", rule, value, "choose a key with a number")
    return isinstance(value, int)
