"""A cache for values that depend on the scenario alone, computed once for all of its runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import ref

from netkf.scenario.scenario import Scenario

Result = TypeVar("Result")


def once_per_scenario(function: Callable[[Scenario], Result]) -> Callable[[Scenario], Result]:
    """Cache the results of a function as long as their scenarios live."""
    # Keyed by identity, since comparing scenarios field by field takes longer.
    results: dict[int, tuple[ref[Scenario], Result]] = {}

    @wraps(function)
    def cached(scenario: Scenario) -> Result:
        key = id(scenario)
        entry = results.get(key)
        if entry is None or entry[0]() is not scenario:
            result = function(scenario)
            entry = results[key] = ref(scenario, lambda _: results.pop(key, None)), result
        return entry[1]

    return cached
