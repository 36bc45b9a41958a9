"""Values of keys to go through: grids, ranges, and what a key of a scenario is now."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.scenario.scenario import Scenario
from netkf.scenario.values import split_setting, typed_values
from netkf.scenario.writing import resolved, toml_text

MOST_CELLS = 10_000
_RANGE = re.compile(r"^([^:,\[{\"']+):([^:,]+):(\d+)$")


def parse_grid(settings: Sequence[str]) -> dict[str, list[Any]]:
    """Of ``key.path=v1,v2,...`` texts: the values of each key. ``start:stop:count`` stands for
    that many values evenly from start to stop. Raises ScenarioError at --vary.
    """
    grid: dict[str, list[Any]] = {}
    for setting in settings:
        key, text = split_setting("--vary", setting)
        if key in grid:
            raise ScenarioError("--vary", f"{key} is varied twice", setting, "give all in one list")
        evenly = _RANGE.match(text)
        grid[key] = _evenly(key, *evenly.groups()) if evenly else typed_values("--vary", key, text)
    return grid


def _evenly(key: str, start: str, stop: str, count: str) -> list[Any]:
    try:
        low, high, number = float(start), float(stop), int(count)
        whole = [int(start), int(stop)]
    except ValueError:
        whole = []
    if not _finite(start, stop) or not 2 <= int(count) <= MOST_CELLS:
        words = (
            f"range of {key} must be START:STOP:COUNT with two numbers and a count of at least 2"
        )
        raise ScenarioError("--vary", words, f"{start}:{stop}:{count}", "mend it")
    values = np.linspace(low, high, number)
    if whole and np.array_equal(values, np.round(values)):
        return [int(value) for value in values]
    return [float(f"{value:.12g}") for value in values]


def _finite(*texts: str) -> bool:
    try:
        return all(math.isfinite(float(text)) for text in texts)
    except ValueError:
        return False


def checked_grid(grid: Any) -> dict[str, list[Any]]:
    """The values of each key, at least one; raises ScenarioError at --vary."""
    if not isinstance(grid, Mapping) or not grid:
        raise ScenarioError("--vary", "needs a key with its values", grid or None, "KEY=V1,V2,...")
    found = {}
    for key, values in grid.items():
        listed = isinstance(values, (list, tuple, range, np.ndarray)) and len(values)
        if not listed:
            raise ScenarioError("--vary", f"{key} needs a list of values", values, "give some")
        found[str(key)] = values.tolist() if isinstance(values, np.ndarray) else list(values)
    size = math.prod(map(len, found.values()))
    if size > MOST_CELLS:
        words = f"is a grid of {size:,} cells, at most {MOST_CELLS:,} are possible"
        raise ScenarioError("--vary", words, None, "vary less at once")
    return found


class Cell(NamedTuple):
    """One place of a grid: what was changed, and the scenario that came of it."""

    changes: dict[str, Any]
    scenario: Scenario


def cells(scenario: Scenario, grid: Mapping[str, Sequence[Any]]) -> list[Cell]:
    """All places, the last key running fastest; raises ScenarioError before anything runs."""
    values = checked_grid(grid)
    places = [
        dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())
    ]
    return [Cell(place, _changed(scenario, place)) for place in places]


def _changed(scenario: Scenario, place: dict[str, Any]) -> Scenario:
    try:
        return scenario.replace(place)
    except ScenarioError as error:
        words = ", ".join(f"{key} = {toml_text(value)}" for key, value in place.items())
        raise error.in_file(f"at {words}") from None


def shown(value: Any) -> Any:
    """A value in a table: numbers and texts as they are, others as TOML."""
    return toml_text(value) if isinstance(value, (dict, list, tuple)) else value


def parse_interval(setting: str) -> tuple[str, float | int, float | int]:
    """Key and ends of ``key.path=LOW:HIGH``; raises ScenarioError at --vary."""
    key, text = split_setting("--vary", setting)
    low, colon, high = text.partition(":")
    if not colon or not _finite(low, high):
        raise ScenarioError(
            "--vary", f"range of {key} must be LOW:HIGH, two numbers", text, "write 1.0:20.0"
        )
    ends = [int(e) if re.fullmatch(r"\s*[+-]?\d+\s*", e) else float(e) for e in (low, high)]
    return key, ends[0], ends[1]


def whole_number(scenario: Scenario, key: str) -> bool:
    """Whether a key of a scenario is an integer, else a number; raises ScenarioError at --vary
    where it is neither.
    """
    value: Any = resolved(scenario)
    for name in key.replace("[", ".").replace("]", "").split("."):
        try:
            value = value[int(name)] if isinstance(value, (list, tuple)) else value[name]
        except (KeyError, IndexError, ValueError, TypeError):
            words = f"{key} is not a key of this scenario as it stands"
            raise ScenarioError("--vary", words, None, "set it first with --set") from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        words = f"{key} must be a number in the scenario to be searched"
        raise ScenarioError("--vary", words, value, "choose a key with a number")
    return isinstance(value, int)
