"""The components of a scenario whose classes users wrote: their list, files and failures."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

from netkf.core.contracts import (
    ContractError,
    describe_error,
    error_line,
    is_netkf_class,
    is_of_compiler,
    last_call,
    source_line,
)
from netkf.core.errors import NetkfError, quote
from netkf.core.fields import Component, walk
from netkf.plants.dynamics import CustomDynamics


def user_components(value: Any) -> list[Component]:
    """Return the components in a scenario that are not netkf's, inner ones after outer ones."""
    parts: Iterator[Any] = (part for part in walk(value) if isinstance(part, Component))
    parts = (part.part if isinstance(part, CustomDynamics) else part for part in parts)
    return [part for part in parts if not is_netkf_class(type(part))]


def find_unimportable_class(scenario: Any, in_script: bool = True) -> str | None:
    """Return the name of a user's class that other processes cannot import, defined in a function
    or a prompt, or, unless ``in_script``, in the running script; None without one.
    """
    main_file = getattr(sys.modules.get("__main__"), "__file__", None)
    has_script = main_file is not None and Path(main_file).is_file()
    for component in user_components(scenario):
        cls = type(component)
        in_main = cls.__module__ == "__main__" and not (in_script and has_script)
        if in_main or "<locals>" in cls.__qualname__:
            return cls.__name__
    return None


def unguarded_line(scenario: Any) -> tuple[int, int] | None:
    """Return the line of a class of the running script, and that of the script being executed if
    not under ``if __name__ == "__main__":``, else None: worker processes run a script again.
    """
    classes = [type(one) for one in user_components(scenario) if type(one).__module__ == "__main__"]
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    frame: FrameType | None = sys._getframe()
    while frame is not None and not (
        frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") == "__main__"
    ):
        frame = frame.f_back
    if not classes or file is None or frame is None or frame.f_code.co_filename != file:
        return None
    try:
        body = ast.parse(Path(file).read_bytes()).body
        defined = inspect.getsourcelines(classes[0])[1]
    except (OSError, SyntaxError, ValueError, TypeError):
        return None
    line = frame.f_lineno
    guarded = any(
        isinstance(one, ast.If)
        and "__name__" in ast.dump(one.test)
        and one.lineno <= line <= (one.end_lineno or line)
        for one in body
    )
    return None if guarded else (defined, line)


def find_module_files(scenario: Component) -> dict[str, Path | None]:
    """Return the files of modules of users' classes by name, None for those outside its folder."""
    folder = getattr(scenario, "_folder", None)
    files: dict[str, Path | None] = {}
    for component in user_components(scenario):
        name = type(component).__module__
        files[name] = None
        if folder is None or "." in name or not (path := folder / f"{name}.py").is_file():
            continue
        file = getattr(sys.modules.get(name), "__file__", None)
        # The loaded module may be it where no other file is known.
        if file is None or not Path(file).is_file() or path.samefile(file):
            files[name] = path
    return files


def explain_user_error(scenario: Any, error: Exception) -> str | None:
    """Return ``module:Class failed in method: error; file, line n`` for an error in a user's class:
    the deepest method of one in the traceback, or else the one that returned last, with its result.
    None if all classes are netkf's own, or what the operating system refuses was not asked by one.
    """
    components = user_components(scenario)
    if not components:
        return None
    text = describe_error(error)
    methods = {
        code: (type(component), name)
        for component in components
        for cls in reversed(type(component).__mro__)
        if not is_netkf_class(cls)
        for name, member in vars(cls).items()
        for code in _codes_of(member)
    }
    found: tuple[type, str, FrameType, int] | None = None
    for frame, line in _frames_of(error):
        if frame.f_code in methods:
            found = (*methods[frame.f_code], frame, line)
        elif found is not None and frame.f_code.co_filename == found[2].f_code.co_filename:
            found = (*found[:2], frame, line)
    if found is not None:
        cls, name, frame, line = found
        return f"{_name_of(cls)} failed in {name}: {text}; {source_line(frame.f_code, line)}"
    if isinstance(error, OSError):  # such as a full disk
        return None
    if isinstance(error, ContractError):
        return f"{_name_of(type(components[0]))}: {error}"
    call = last_call()
    if (
        is_of_compiler(error)
        or call is None
        or not any(isinstance(part, call.cls) for part in components)
    ):
        return f"{_name_of(type(components[0]))} failed: {text}"
    where = f"{call.function.__name__} ({source_line(call.function.__code__)})"
    return f"{_name_of(call.cls)} failed after {where} returned {quote(call.result)}: {text}"


@contextmanager
def explained(scenario: Any, make: Callable[[str], Exception]) -> Iterator[None]:
    """Turn an error of a user's class in the body into what ``make`` makes of its explanation."""
    try:
        yield
    except NetkfError:  # it names its cause
        raise
    except Exception as error:
        rule = explain_user_error(scenario, error)
        if rule is None:
            raise
        raise make(rule) from error


def _codes_of(member: Any) -> list[CodeType]:
    """Return the code of a method, a property or the functions in a value, and what they define."""
    if dataclasses.is_dataclass(member) and not isinstance(member, type):
        return [code for one in vars(member).values() for code in _codes_of(one)]
    function = getattr(member, "fget", member)
    function = inspect.unwrap(function) if callable(function) else function
    if not isinstance(function, FunctionType):
        return []
    code = function.__code__
    return [code, *(inner for inner in code.co_consts if isinstance(inner, CodeType))]


def _frames_of(error: BaseException) -> Iterator[tuple[FrameType, int]]:
    """Yield frame and line of each call that led to an error, or to the errors that caused it."""
    # SimPy raises a copy of an error of a process, whose cause is the error itself.
    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in chain:
        chain.append(cause)
        cause = cause.__cause__
    for one in chain:
        yield from traceback.walk_tb(one.__traceback__)


def _name_of(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def describe_failure(error: BaseException) -> str:
    """Return what an exception of a user's class says, with its file and line, on one line."""
    if isinstance(error, ContractError):
        return str(error)
    if is_of_compiler(error):
        return f"failed: {describe_error(error)}"
    place = error_line(error)
    return f"failed with {describe_error(error)}" + (f" ({place})" if place else "")
