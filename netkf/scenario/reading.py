"""Scenario files: TOML text to a checked scenario."""

from __future__ import annotations

import json
import re
import secrets
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.scenario.imports import Origin
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import MAX_DEPTH, build_scenario, explain_left_over, with_changes

MAX_BYTES = 64 << 20
MAX_DOTS = 100  # parts of a key: tomllib takes minutes and gigabytes for very many
# Characters from which on lists of numbers are read by numpy instead of by tomllib.
LONG_TEXT, LONG_LINE = 100_000, 1000
_NUMBERS = re.compile(r"([A-Za-z0-9_-]+)[ \t]*=[ \t]*(\[[0-9eE+\-., \t\[\]]*\])[ \t]*")
_LAST_COMMA, _FIRST_COMMA = re.compile(r",[ \t]*\]"), re.compile(r"\[[ \t]*,")
_PART = r"""(?:[\w-]++|"[^"]*+"|'[^']*+')[ \t]*+"""
_MANY_PARTS = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*+){{{MAX_DOTS}}}")


def load(
    path: str | Path, changes: Mapping[str, Any] | None = None, *, trust: bool = True
) -> Scenario:
    """Return the scenario of a file, with some keys changed.

    A file can name classes of modules in its own folder or the current folder; with ``trust``, the
    default, they are imported, which executes them, as a script of yours would. Give
    ``trust=False`` for files whose author you do not trust: such classes are refused then, those of
    installed packages are not. ``netkf`` on a command line does so unless ``--trust`` is given.

    Raises ScenarioError with one line for the first mistake.
    """
    path = as_path("path", path, "load takes the path of a scenario file")
    given: object = changes or {}
    if not isinstance(given, Mapping):
        rule, remedy = "must be a table", 'give values by key: {"horizon": 10.0}'
        raise ScenarioError("changes", rule, given, remedy)
    try:
        return from_table(with_changes(_parse_file(path), changes or {}), path.parent, trust)
    except ScenarioError as error:
        raise explain_left_over(error, changes or {}).in_file(str(path)) from None


def from_table(table: Mapping[str, Any], folder: Path, trust: bool = True) -> Scenario:
    """Return a scenario from the tables of a file that lies in ``folder``, see :func:`load`."""
    return build_scenario(Scenario, table, Origin(folder, trust))


def _parse_file(path: Path) -> dict[str, Any]:
    """Return the table of a TOML file; raises ScenarioError if it cannot be read."""
    try:
        return parse_toml(_read_text(path))
    except UnicodeDecodeError:
        raise ScenarioError("", "is not UTF-8 text", None, "save it as UTF-8") from None
    except OSError as error:
        rule = f"cannot be read ({error.strerror})"
        raise ScenarioError("", rule, None, "check the path") from None
    except RecursionError:
        rule = "is not valid TOML: nested too deep"
        raise ScenarioError("", rule, None, "correct the brackets") from None
    except ScenarioError:
        raise
    except ValueError as error:  # TOMLDecodeError among them
        rule = f"is not valid TOML: {' '.join(str(error).split())[:120]}"
        raise ScenarioError("", rule, None, "correct that line") from None


def _read_text(path: Path) -> str:
    """Return the text of a file up to MAX_BYTES."""
    # Not all at once: the file may be a device that never ends.
    content = b""
    with path.open("rb") as file:
        while len(content) <= MAX_BYTES and (part := file.read(1 << 20)):
            content += part
    if len(content) > MAX_BYTES:
        rule = f"must have at most {MAX_BYTES >> 20} MiB"
        raise ScenarioError("", rule, None, "put long lists into CSV files")
    return content.decode("utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises ScenarioError for keys of very many parts, which tomllib takes minutes and gigabytes for,
    and for deep tables; ValueError and RecursionError as tomllib does.
    """
    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        if line.count(".") > MAX_DOTS and _MANY_PARTS.search(line):
            rule = f"line {number} has a key of more than {MAX_DOTS} parts"
            raise ScenarioError("", rule, None, "correct that line")
    arrays: dict[str, Any] = {}
    if len(text) > LONG_TEXT and '"""' not in text and "'''" not in text:
        mark = secrets.token_hex(16)
        text = "\n".join(_shorten_array(line, arrays, mark) for line in lines)
    found: dict[str, Any] = _insert_arrays(tomllib.loads(text), arrays)
    if _nesting_depth(found) > MAX_DEPTH:
        raise ScenarioError("", "is nested too deep", None, "see the keys of a scenario file")
    return found


def _shorten_array(line: str, arrays: dict[str, Any], mark: str) -> str:
    """Return a line ``key = [numbers]`` with a key of ``arrays`` for its value; others unchanged.

    The json module reads such arrays fifty times faster than tomllib.
    """
    found = _NUMBERS.fullmatch(line) if len(line) > LONG_LINE else None
    if found is None or _FIRST_COMMA.search(found[2]):
        return line
    try:
        value = json.loads(_LAST_COMMA.sub("]", found[2]))
    except (ValueError, RecursionError):
        return line
    index = f"{mark} {len(arrays)}"
    arrays[index] = value
    return f'{found[1]} = "{index}"'


def _insert_arrays(value: Any, arrays: dict[str, Any]) -> Any:
    """Return tables with arrays instead of their keys."""
    if not arrays:
        return value
    if isinstance(value, dict):
        return {key: _insert_arrays(entry, arrays) for key, entry in value.items()}
    if isinstance(value, list):
        return [_insert_arrays(entry, arrays) for entry in value]
    return arrays.get(value, value) if isinstance(value, str) else value


def _nesting_depth(value: Any) -> int:
    """Return how many tables and lists are inside one another, without recursion."""
    depth, level = 0, [value]
    while level and depth <= MAX_DEPTH:
        inside = [entry for entry in level if isinstance(entry, (dict, list))]
        parts = (entry.values() if isinstance(entry, dict) else entry for entry in inside)
        level = [entry for part in parts for entry in part]
        depth += bool(inside)
    return depth
