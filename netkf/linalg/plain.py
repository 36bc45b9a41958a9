"""Kernels as plain Python: without numba, and with ``NUMBA_DISABLE_JIT=1`` to debug them.

Compiled code computes as IEEE 754 says: 1 / 0 is inf and sqrt(-1) is nan, without a word; words of
64 bits wrap around. Python raises errors and numpy warns, so that a plain kernel gets numbers of
numpy and a ``math`` that returns them, and nothing is said while it runs.
"""

from __future__ import annotations

import dis
import importlib.util
import math
import os
import sys
import threading
from collections.abc import Callable
from functools import cache, update_wrapper
from types import SimpleNamespace
from typing import Any

import numpy as np

_PREFIX = "ieee "
"""No name of Python: how plain kernels call what they know as ``math``."""


@cache
def has_numba() -> bool:
    """Return True if numba is installed."""
    return importlib.util.find_spec("numba") is not None


@cache
def is_plain() -> bool:
    """Return True if kernels are not compiled in this process."""
    return os.environ.get("NUMBA_DISABLE_JIT", "").strip() not in ("", "0") or not has_numba()


@cache
def announce_plain() -> None:
    """Print a note to stderr, once in a process, if kernels are not compiled."""
    if is_plain():
        why = "NUMBA_DISABLE_JIT is set" if has_numba() else "numba is not installed"
        print(f"netkf: {why}: runs in plain Python, many times slower", file=sys.stderr, flush=True)


class _Inside(threading.local):
    """True in a thread that runs a plain kernel, whose callees are kernels too."""

    value = False


_inside = _Inside()


def plain_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel that runs ``function`` itself, with the numbers of compiled code."""
    _replace_math(function)

    def call(*args: Any, **kwargs: Any) -> Any:
        if _inside.value:
            return function(*args, **kwargs)
        _inside.value = True
        try:
            with np.errstate(all="ignore"):
                named = {name: _of_numpy(value) for name, value in kwargs.items()}
                return _of_python(function(*map(_of_numpy, args), **named))
        finally:
            _inside.value = False

    return update_wrapper(call, function)


def with_fields(array: Any) -> Any:
    """Return an array of records with fields as attributes, any other ``array`` as it is."""
    return array.view(np.recarray) if array.dtype.names else array


def _of_numpy(value: Any) -> Any:
    """Return an argument as kernels compute with it: Python's float divides by zero its own way."""
    if type(value) is float:
        return np.float64(value)
    return with_fields(value) if type(value) is np.ndarray else value


def _of_python(value: Any) -> Any:
    """Return a result, or a tuple of results, as compiled code does: numbers of Python."""
    if type(value) is tuple:
        return tuple(map(_of_python, value))
    return value.item() if isinstance(value, np.generic) else value


def _replace_math(function: Callable[..., Any]) -> None:
    """Let a function, and no other of its module, compute with ``ieee_math`` instead of math."""
    code, known = function.__code__, function.__globals__
    # Attributes have their names from the same list, such as that of np.sqrt: these stay.
    attributes = {step.argval for step in dis.get_instructions(code) if "ATTR" in step.opname}
    replaced = {}
    for name in set(code.co_names) - attributes:
        value: Any = known.get(name)
        if value is math:
            replaced[name] = ieee_math
        elif getattr(value, "__module__", None) == "math":
            replaced[name] = getattr(ieee_math, value.__name__)
    known.update({_PREFIX + name: value for name, value in replaced.items()})
    names = tuple(_PREFIX + name if name in replaced else name for name in code.co_names)
    function.__code__ = code.replace(co_names=names)


def _without_errors(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of math that returns nan or inf where Python raises an error."""
    same = getattr(np, function.__name__, None)

    def call(*args: Any) -> Any:
        try:
            value = function(*args)
        except (ValueError, OverflowError) as error:
            if same is not None:
                return np.float64(same(*args))
            return np.float64(np.inf if isinstance(error, OverflowError) else np.nan)
        return np.float64(value) if type(value) is float else value

    return call


ieee_math = SimpleNamespace(
    **{
        name: _without_errors(value) if callable(value) else np.float64(value)
        for name, value in vars(math).items()
        if not name.startswith("_")
    }
)
"""The module math as kernels know it. Its functions are Python's, with the same digits."""
