"""The built-in filters: each registers in its own file, and everything else finds it here.

A filter's file says what the rest of the package must know of it: its name in scenario files, and
the paper whose theory and checks apply to it (``Filter.analysis``).

A user's class that derives from a built-in one is still covered by its theorems unless it overrides
a method or class variable on which they rely: ``own_attributes`` and ``overridden`` tell.
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import netkf.algorithms
from netkf.algorithms.filter import STEPS, Filter
from netkf.algorithms.traits import Timing
from netkf.core.fields import as_class

F = TypeVar("F", bound=type[Filter])

_REGISTERED: dict[str, type[Filter]] = {}  # by name, see split_choice

LINK_WEIGHTS = ("link_weights",)
"""What a derived class may override without losing the theory, which asks it for its weights."""

TRAITS = ("timing",)
"""Values that theorems rely on."""


def built_in(kind: str, **choice: str) -> Callable[[F], F]:
    """Return a decorator that registers a filter class under its ``kind`` in scenario files; where
    several classes share a kind, a key and its value are the ``choice`` of this one, as in
    ``@built_in("track-fusion", rule="ci")``.
    """

    def register(cls: F) -> F:
        _REGISTERED[" ".join([kind, *(f"{key}={value}" for key, value in choice.items())])] = cls
        return cls

    return register


def split_choice(name: str) -> tuple[str, dict[str, str]]:
    """Return the kind of a filter and its choice of keys and values, from its name."""
    kind, *choice = name.split(" ")
    return kind, dict(one.split("=", 1) for one in choice)


@cache
def built_in_filters() -> dict[str, type[Filter]]:
    """Return all built-in filters by name (``split_choice``)."""
    # Importing a module registers its filters: no list of them has to be kept.
    for module in pkgutil.iter_modules(netkf.algorithms.__path__, "netkf.algorithms."):
        if not module.ispkg:
            importlib.import_module(module.name)
    return dict(sorted(_REGISTERED.items()))


def default_timing(cls: Any) -> Timing | None:
    """Return the default timing of a filter class; None if a setting has no default."""
    if cls.timing is Filter.timing:
        return Timing()
    try:
        timing: Timing = cls.timing if isinstance(cls.timing, Timing) else cls().timing
    except TypeError:
        return None
    return timing


def built_in_class(algorithm: object) -> type[Filter] | None:
    """Return the built-in class of a filter, or the nearest of its bases; None without one."""
    classes = set(built_in_filters().values())
    return next((cls for cls in type(algorithm).__mro__ if cls in classes), None)


def base_filter(algorithm: Filter) -> Filter:
    """Return the built-in parent of a user's filter ``algorithm`` with the same parameters.

    Raises TypeError if it derives from none.
    """
    cls = built_in_class(algorithm)
    if cls is None:
        raise TypeError(f"{type(algorithm).__name__} derives from no built-in filter")
    base: Filter = as_class(algorithm, cls)
    return base


def own_attributes(algorithm: object) -> list[str]:
    """Return the attributes of the built-in class that the class of a user's filter ``algorithm``
    defines anew, sorted; [] if it derives from none.

    Methods, class variables, weights and private helpers alike; fields and dunder names are left
    out. Checks of papers do not certify such a class.
    """
    base = built_in_class(algorithm)
    if base is None:
        return []
    classes = type(algorithm).__mro__
    names = {
        name
        for cls in classes[: classes.index(base)]
        for name in vars(cls)
        if hasattr(base, name) and not name.startswith("__")
    }
    fields = {field.name for field in dataclasses.fields(base)}
    # Python itself sets ``_abc_impl`` and ``_is_protocol`` on classes that derive from an ABC or a
    # protocol.
    return sorted(names - fields - {"_abc_impl", "_is_protocol"})


def overridden(algorithm: object, base: type | None = None) -> list[str]:
    """Return the methods and class variables, of those on which theorems rely, that the class of a
    user's filter ``algorithm`` defines anew: theorems about the built-in class do not hold for it.

    ``base`` is that class, by default the one from which it derives. Weights of links are not
    listed: the theory asks the filter for them.
    """
    base = base or built_in_class(algorithm)
    cls = type(algorithm)
    return [
        name
        for name in (*STEPS, *TRAITS)
        if hasattr(base, name) and getattr(cls, name, None) is not getattr(base, name)
    ]
