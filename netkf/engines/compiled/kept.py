"""What follows from a scenario alone, made once for all of its runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import ref

from netkf.scenario.scenario import Scenario

Result = TypeVar("Result")


def once_per_scenario(function: Callable[[Scenario], Result]) -> Callable[[Scenario], Result]:
    """Keep the results of a function as long as their scenarios live; nobody may change them."""
    # By identity: scenarios are compared field by field, which takes longer.
    kept: dict[int, tuple[ref[Scenario], Result]] = {}

    @wraps(function)
    def known(scenario: Scenario) -> Result:
        """Return the cached result for this scenario, computed at the first call."""
        key = id(scenario)
        found = kept.get(key)
        if found is None or found[0]() is not scenario:
            result = function(scenario)
            found = kept[key] = ref(scenario, lambda _: kept.pop(key, None)), result
        return found[1]

    return known
