"""Values of keys on the command line: grids, ranges, and the type of a key of a scenario."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import Component
from netkf.scenario.scenario import Scenario
from netkf.scenario.values import parse_values, split_setting
from netkf.scenario.writing import part_as_table, resolve_defaults, toml_text

MAX_POINTS = 10_000  # more are a slip
_RANGE = re.compile(r"^([^:,\[{\"']+):([^:,]+):(\d+)$")


def parse_grid(settings: Sequence[str]) -> dict[str, list[Any]]:
    """Return the values of ``key.path=v1,v2,...`` or ``start:stop:count``; raises ScenarioError."""
    grid: dict[str, list[Any]] = {}
    for setting in settings:
        key, text = split_setting("--vary", setting)
        if key in grid:
            raise ScenarioError("--vary", f"{key} is varied twice", setting, "give all in one list")
        evenly = _RANGE.match(text)
        grid[key] = (
            _even_values(key, *evenly.groups()) if evenly else parse_values("--vary", key, text)
        )
    return grid


def _even_values(key: str, start: str, stop: str, count: str) -> list[Any]:
    """Return ``count`` evenly spaced values; integers if all are whole and both ends are."""
    try:
        low, high, number = float(start), float(stop), int(count)
        integers = [int(start), int(stop)]
    except ValueError:
        integers = []  # wrong texts are refused below
    if not _are_finite(start, stop) or not 2 <= int(count) <= MAX_POINTS:
        rule = f"range of {key} must be START:STOP:COUNT with two numbers and a count of at least 2"
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


def check_grid(grid: Any) -> dict[str, list[Any]]:
    """Return the values of each key of a user's ``grid``; raises ScenarioError."""
    if not isinstance(grid, Mapping) or not grid:
        raise ScenarioError("--vary", "needs a key with its values", grid or None, "KEY=V1,V2,...")
    values_by_key = {}
    for key, values in grid.items():
        listed = isinstance(values, (list, tuple, range, np.ndarray)) and len(values)
        if not listed:
            raise ScenarioError("--vary", f"{key} needs a list of values", values, "give some")
        plain = values.tolist() if isinstance(values, np.ndarray) else list(values)
        # Parts stand for their tables, which manifests and tables of results can hold.
        values_by_key[str(key)] = [
            part_as_table(v) if isinstance(v, Component) else v for v in plain
        ]
    size = math.prod(map(len, values_by_key.values()))
    if size > MAX_POINTS:
        rule = f"is a grid of {size:,} points, at most {MAX_POINTS:,} are possible"
        raise ScenarioError("--vary", rule, None, "vary less at once")
    return values_by_key


class GridPoint(NamedTuple):
    """A point of a grid: the changes of keys, and the scenario with these changes."""

    changes: dict[str, Any]
    scenario: Scenario


def expand_grid(scenario: Scenario, grid: Mapping[str, Sequence[Any]]) -> list[GridPoint]:
    """Return all points of a grid, the last key fastest; raises ScenarioError."""
    values = check_grid(grid)
    points = [
        dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())
    ]
    grid_points = []
    for changes in points:
        try:
            grid_points.append(GridPoint(changes, scenario.replace(changes)))
        except ScenarioError as error:
            point = ", ".join(f"{key} = {toml_text(value)}" for key, value in changes.items())
            raise error.in_file(f"at {point}") from None
    return grid_points


def table_value(value: Any) -> Any:
    """Return a value for a table: numbers and texts unchanged, others as TOML."""
    return toml_text(value) if isinstance(value, (dict, list, tuple)) else value


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
    for name in key.replace("[", ".").replace("]", "").split("."):
        try:
            value = value[int(name)] if isinstance(value, (list, tuple)) else value[name]
        except (KeyError, IndexError, ValueError, TypeError):
            rule = f"{key} is not a key of this scenario as it stands"
            raise ScenarioError("--vary", rule, None, "set it first with --set") from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        rule = f"{key} must be a number in the scenario to be searched"
        raise ScenarioError("--vary", rule, value, "choose a key with a number")
    return isinstance(value, int)
