"""What every function about a scenario demands, said once where users call it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.scenario.scenario import Scenario


def demanding(functions: dict[str, Any]) -> dict[str, Any]:
    """Those of the functions that begin with a scenario, so that they refuse anything else."""
    found = {}
    for name, function in functions.items():
        if inspect.isfunction(function):
            first = next(iter(inspect.signature(function).parameters.values()), None)
            if first is not None and first.annotation == "Scenario":
                found[name] = _demanding(name, function)
    return found


def _demanding(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def demands(scenario: Any, *args: Any, **kwargs: Any) -> Any:
        if not isinstance(scenario, Scenario):
            remedy = f"load it first: netkf.theory.{name}(netkf.load(path))"
            raise ScenarioError("", f"theory.{name} takes a netkf.Scenario", scenario, remedy)
        return function(scenario, *args, **kwargs)

    demands.__module__, demands.__qualname__ = "netkf.theory", name  # so that it can be pickled
    return demands
