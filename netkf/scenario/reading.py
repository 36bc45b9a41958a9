"""Reading of scenario files: TOML text to a checked scenario."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path, boolean
from netkf.scenario.plugins import Origin
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import MAX_DEPTH, build_scenario, change_table, explain_left_over

MAX_BYTES = 64 << 20  # of a scenario file
MAX_DOTS = 100  # in a dotted key: tomllib takes minutes and gigabytes for very many
_KEY_PART = r"""(?:[\w-]++|"[^"]*+"|'[^']*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_KEY_PART}\.[ \t]*+){{{MAX_DOTS}}}")
"""MAX_DOTS parts of a dotted key, bare or quoted, with the dots after them."""


def load(
    path: str | Path, changes: Mapping[str, Any] | None = None, *, trust: bool = True
) -> Scenario:
    """Return the scenario of a TOML file.

    ``changes`` maps key paths to values that replace those of the file or are added to them, e.g.
    ``{"network.activation.rate": 5.0}``.

    A file can name classes of modules in its own folder or the current folder. With ``trust``, the
    default, these modules are imported, which executes their code. Give ``trust=False`` for files
    whose author you do not trust: such classes are refused then, those that installed packages
    offer as kinds are not. The command ``netkf`` does so unless ``--trust`` is given.

    Raises ScenarioError with one line for the first mistake.
    """
    path = as_path("path", path, "load takes the path of a scenario file")
    changes = require_changes(changes)
    try:
        return from_table(change_table(_parse_file(path), changes), path.absolute().parent, trust)
    except ScenarioError as error:
        raise explain_left_over(error, changes).in_file(str(path)) from None


def require_changes(changes: object) -> Mapping[str, Any]:
    """Return ``changes``, none for None; raises ScenarioError for what is no table."""
    if changes is not None and not isinstance(changes, Mapping):
        rule, remedy = "must be a table", 'give values by key: {"horizon": 10.0}'
        raise ScenarioError("changes", rule, changes, remedy)
    return changes or {}


def from_table(table: Mapping[str, Any], folder: Path, trust: bool = True) -> Scenario:
    """Return a scenario from the tables of a file that lies in ``folder``, see :func:`load`."""
    return build_scenario(Scenario, table, Origin(folder, boolean("trust", trust)))


def _parse_file(path: Path) -> dict[str, Any]:
    try:
        return parse_toml(_read_text(path))
    except UnicodeDecodeError:
        raise ScenarioError("", "is not UTF-8 text", None, "save it as UTF-8") from None
    except OSError as error:
        rule, inside = f"cannot be read ({error.strerror})", path / "scenario.toml"
        remedy = f"give {inside}" if os.path.isfile(inside) else "check the path"
        raise ScenarioError("", rule, None, remedy) from None
    except RecursionError:
        rule = "is not valid TOML: nested too deep"
        raise ScenarioError("", rule, None, "correct the brackets") from None
    except ScenarioError:
        raise
    except ValueError as error:  # TOMLDecodeError among them
        rule = f"is not valid TOML: {' '.join(str(error).split())[:120]}"
        raise ScenarioError("", rule, None, "correct that line") from None


def _read_text(path: Path) -> str:
    # Read piece by piece: the size of a device such as /dev/zero is known only by reading it.
    content = b""
    with path.open("rb") as file:
        while len(content) <= MAX_BYTES and (piece := file.read(1 << 20)):
            content += piece
    if len(content) > MAX_BYTES:
        rule = f"must have at most {MAX_BYTES >> 20} MiB"
        raise ScenarioError("", rule, None, "put long lists into CSV files")
    return content.decode("utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text. Raises ScenarioError above MAX_DOTS and MAX_DEPTH,
    ValueError and RecursionError for other invalid texts.
    """
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") > MAX_DOTS and _LONG_KEY.search(line):
            rule = f"line {number} has a key of more than {MAX_DOTS} parts"
            raise ScenarioError("", rule, None, "correct that line")
    tables: dict[str, Any] = tomllib.loads(text)
    if _nesting_depth(tables) > MAX_DEPTH:
        raise ScenarioError("", "is nested too deep", None, "see the keys of a scenario file")
    return tables


def _nesting_depth(value: Any) -> int:
    # Level by level: recursion would fail for the very values that this is to find.
    depth, level = 0, [value]
    while level and depth <= MAX_DEPTH:
        containers = [entry for entry in level if isinstance(entry, (dict, list))]
        level = []
        for container in containers:
            level.extend(container.values() if isinstance(container, dict) else container)
        depth += bool(containers)
    return depth
