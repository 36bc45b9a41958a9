"""Classes of users in a scenario: a list of them, their files, and the one that failed."""

from __future__ import annotations

import dataclasses
import sys
import traceback
from pathlib import Path
from typing import Any

from netkf.core.fields import Component


def plugged_in(part: Any) -> list[Component]:
    """Return the components of a scenario whose classes are not netkf's own."""
    if isinstance(part, tuple):
        return [found for item in part for found in plugged_in(item)]
    if not isinstance(part, Component):
        return []
    inside = [getattr(part, field.name) for field in dataclasses.fields(part)]
    own = [] if is_ours(type(part)) else [part]
    return [*own, *(found for item in inside for found in plugged_in(item))]


def is_ours(cls: type) -> bool:
    """Return True if a class is netkf's own."""
    return cls.__module__.partition(".")[0] == "netkf"


def unnamed_class(scenario: Any, in_script: bool = True) -> str | None:
    """Return the name of a class of a user that no module has, so that a file or another process
    cannot name it: one of a notebook, of a prompt or of a function. None if there is none. With
    ``in_script`` it may be one of the script that runs, which worker processes run once more.
    """
    for part in plugged_in(scenario):
        cls = type(part)
        main = sys.modules.get("__main__")
        file = getattr(main, "__file__", None)
        is_script = file is not None and Path(file).is_file()
        if "<locals>" in cls.__qualname__:
            return cls.__name__
        if cls.__module__ == "__main__" and not (in_script and is_script):
            return cls.__name__
    return None


def module_files(scenario: Component) -> dict[str, Path | None]:
    """Return the modules of users' classes: the file if it is beside the scenario, else None."""
    folder = getattr(scenario, "_folder", None)
    files: dict[str, Path | None] = {}
    for part in plugged_in(scenario):
        name = type(part).__module__
        beside = None if folder is None or "." in name else folder / f"{name}.py"
        files[name] = beside if beside is not None and _is_file_of(beside, name) else None
    return files


def _is_file_of(path: Path, module_name: str) -> bool:
    """Return True if a loaded module came from that file, not from an installed package."""
    file = getattr(sys.modules.get(module_name), "__file__", None)
    return path.is_file() and (file is None or not Path(file).is_file() or path.samefile(file))


def blame(scenario: Any, error: Exception) -> str | None:
    """Return ``module:Class failed in method: error`` for an error in a class of a user.

    It names the class in whose method the error happened, or else the first one; None if all
    classes are netkf's own.
    """
    parts = plugged_in(scenario)
    if not parts:
        return None
    part, where = parts[0], ""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        mine = [p for p in parts if frame.f_locals.get("self") is p]
        if mine:
            part, where = mine[0], f" in {frame.f_code.co_name}"
    return (
        f"{type(part).__module__}:{type(part).__qualname__} failed{where}: {describe_error(error)}"
    )


def describe_error(error: BaseException) -> str:
    """Return the type and text of an exception on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300].rstrip(": ")
