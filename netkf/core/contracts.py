"""Methods of users' classes are held to the contract that they override.

A class that takes other arguments than the contract is refused when it is defined. A method that
returns nothing where a result is due says so at once, with its file and line; what any method
returned last is kept, so that an error that a wrong result causes later can name its origin.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import traceback
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

from netkf.core.errors import quote


class ContractError(TypeError):
    """A method of a user's class does not fit its contract: its place, and what it must do."""


class Call(NamedTuple):
    """A call of the method ``function`` of the user's class ``cls``, which returned ``result``."""

    cls: type
    function: FunctionType
    result: Any


class _Last:
    """The last call of any method of a user's class that has returned."""

    call: Call | None = None


def last_call() -> Call | None:
    """Return the last call of a method of a user's class that has returned, None before the
    first.
    """
    return _Last.call


def is_netkf_class(cls: type) -> bool:
    """Return True if a class is netkf's own."""
    return cls.__module__.partition(".")[0] == "netkf"


def place_of(code: CodeType, line: int | None = None) -> str:
    """Return "file, line n" of a function's ``code``, or of a ``line`` in it: the path is relative
    where the file is below the current folder.
    """
    file, line = code.co_filename, code.co_firstlineno if line is None else line
    try:
        relative = os.path.relpath(file)
    except (OSError, ValueError):
        relative = ".."
    return f"{file if relative.startswith('..') else relative}, line {line}"


def place_of_error(error: BaseException) -> str:
    """Return "file, line n" of the deepest call in a user's file that led to an error, "" if there
    is none: neither netkf's files count, nor those of installed packages and of Python.
    """
    ours, python = str(Path(__file__).parents[1]), os.path.dirname(os.__file__)
    places = [
        place_of(frame.f_code, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if not frame.f_code.co_filename.startswith(("<", ours, python))
        and "site-packages" not in frame.f_code.co_filename
    ]
    return places[-1] if places else ""


def describe_method(cls: type, function: FunctionType) -> str:
    """Return "Class.method (file, line n)"."""
    return f"{cls.__name__}.{function.__name__} ({place_of(function.__code__)})"


def hold_to_contract(cls: type) -> None:
    """Wrap the methods of a user's class that override a method of netkf, so that their results are
    looked at; raise ContractError if one takes other arguments.
    """
    for name, own in list(vars(cls).items()):
        if name.startswith("_") or not isinstance(own, FunctionType):
            continue
        contract = _method_of_netkf(cls, name)
        if contract is not None:
            _require_arguments(cls, own, contract)
            setattr(cls, name, _watched(cls, own, contract))


def _method_of_netkf(cls: type, name: str) -> FunctionType | None:
    """Return the method ``name`` of the first of netkf's classes from which ``cls`` derives."""
    for parent in cls.__mro__[1:]:
        method = vars(parent).get(name)
        if is_netkf_class(parent) and isinstance(method, FunctionType):
            return method
    return None


def _require_arguments(cls: type, own: FunctionType, contract: FunctionType) -> None:
    """Raise ContractError unless ``own`` can be called as the ``contract`` is."""
    parameters = inspect.signature(contract).parameters.values()
    positional = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    required = [p.name for p in parameters if p.kind in positional and p.default is p.empty]
    try:
        inspect.signature(own).bind(*required)
    except TypeError:
        listed = ", ".join(required[1:])
        raise ContractError(
            f"{describe_method(cls, own)} must take ({listed}), not "
            f"({', '.join(list(inspect.signature(own).parameters)[1:])})"
        ) from None


def _watched(cls: type, own: FunctionType, contract: FunctionType) -> Any:
    """Return a method that calls ``own`` and looks at what it returns."""
    returned = str(contract.__annotations__.get("return", "None"))
    is_optional = returned == "None" or returned.endswith("| None")
    pair = re.match(r"tuple\[(.*)\]$", returned)
    length = _count(pair[1]) if pair else 0

    @functools.wraps(own)
    def watched(self: Any, *arguments: Any, **options: Any) -> Any:
        try:
            result = own(self, *arguments, **options)
        except SystemExit as error:  # it would end the command without a word
            raise ContractError(f"{describe_method(cls, own)} called exit") from error
        _Last.call = Call(cls, own, result)
        if result is None and not is_optional:
            rule = "returned nothing; it must return a value"
            raise ContractError(f"{describe_method(cls, own)} {rule}")
        if length and not (isinstance(result, tuple) and len(result) == length):
            rule = f"must return a tuple of {length}, not {quote(result)}"
            raise ContractError(f"{describe_method(cls, own)} {rule}")
        return result

    return watched


def _count(inner: str) -> int:
    """Return the number of entries of a tuple type by the text ``inner`` of its brackets."""
    if inner.endswith("..."):
        return 0
    depth, count = 0, 1
    for character in inner:
        depth += (character in "[(") - (character in "])")
        count += character == "," and depth == 0
    return count
