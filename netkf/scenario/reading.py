"""Scenario files: TOML text to a checked scenario."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.scenario.imports import Origin
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import build_scenario, explain_left_over, with_changes


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
    path = Path(path)
    try:
        return from_table(with_changes(_parsed(path), changes or {}), path.parent, trust)
    except ScenarioError as error:
        raise explain_left_over(error, changes or {}).in_file(str(path)) from None


def from_table(table: Mapping[str, Any], folder: Path, trust: bool = True) -> Scenario:
    """Return a scenario from the tables of a file that lies in ``folder``, see :func:`load`."""
    return build_scenario(Scenario, table, Origin(folder, trust))


def _parsed(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise ScenarioError("", "is not UTF-8 text", None, "save it as UTF-8") from None
    except OSError as error:
        words = f"cannot be read ({error.strerror})"
        raise ScenarioError("", words, None, "check the path") from None
    except RecursionError:
        words = "is not valid TOML: nested too deep"
        raise ScenarioError("", words, None, "mend the brackets") from None
    except ValueError as error:  # TOMLDecodeError among them
        words = f"is not valid TOML: {' '.join(str(error).split())[:120]}"
        raise ScenarioError("", words, None, "mend that line") from None
