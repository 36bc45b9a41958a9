"""The components of a scenario whose classes users wrote: their list, files and failures."""

from __future__ import annotations

import dataclasses
import sys
import traceback
from pathlib import Path
from typing import Any

from netkf.core.fields import Component


def user_components(value: Any) -> list[Component]:
    """Return the components in a scenario, a component or a tuple whose classes are not netkf's.

    Each comes before the components inside it.
    """
    if isinstance(value, Component):
        own = [] if is_netkf_class(type(value)) else [value]
        items = [getattr(value, field.name) for field in dataclasses.fields(value)]
    elif isinstance(value, tuple):
        own, items = [], list(value)
    else:
        return []
    return [*own, *(component for item in items for component in user_components(item))]


def is_netkf_class(cls: type) -> bool:
    """Return True if a class is netkf's own."""
    return cls.__module__.partition(".")[0] == "netkf"


def find_unimportable_class(scenario: Any, in_script: bool = True) -> str | None:
    """Return the name of a user's class in a scenario that other processes cannot import.

    Such a class is defined in a function, or in the module ``__main__`` of a notebook or a prompt.
    With ``in_script`` a class of the running script counts as importable: worker processes run the
    script again. Returns None if all classes can be imported.
    """
    main_file = getattr(sys.modules.get("__main__"), "__file__", None)
    has_script = main_file is not None and Path(main_file).is_file()
    for component in user_components(scenario):
        cls = type(component)
        in_main = cls.__module__ == "__main__" and not (in_script and has_script)
        if in_main or "<locals>" in cls.__qualname__:
            return cls.__name__
    return None


def find_module_files(scenario: Component) -> dict[str, Path | None]:
    """Return the file of each module of users' classes, by module name, of which a run's directory
    gets a copy.

    It is None if the module is not a file in the folder of the scenario.
    """
    folder = getattr(scenario, "_folder", None)
    files: dict[str, Path | None] = {}
    for component in user_components(scenario):
        name = type(component).__module__
        file = None if folder is None or "." in name else folder / f"{name}.py"
        files[name] = file if file is not None and _is_file_of(file, name) else None
    return files


def _is_file_of(path: Path, module_name: str) -> bool:
    """Return True if ``path`` exists and the loaded module may be it: no other file is known."""
    file = getattr(sys.modules.get(module_name), "__file__", None)
    return path.is_file() and (file is None or not Path(file).is_file() or path.samefile(file))


def explain_user_error(scenario: Any, error: Exception) -> str | None:
    """Return the message ``module:Class failed in method: error`` for an error in a user's class,
    which tells the user that the mistake is in their code.

    ``scenario`` is a scenario or a tuple of components. The class is the one whose method stands
    deepest in the traceback, else (without "in method") the first of users' classes. Returns None
    if all classes are netkf's own.
    """
    components = user_components(scenario)
    if not components:
        return None
    failed, where = components[0], ""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        for component in components:
            if frame.f_locals.get("self") is component:
                failed, where = component, f" in {frame.f_code.co_name}"
                break
    cls = type(failed)
    return f"{cls.__module__}:{cls.__qualname__} failed{where}: {describe_error(error)}"


def describe_error(error: BaseException) -> str:
    """Return the type and text of an exception on one line of at most 300 characters."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300].rstrip(": ")
