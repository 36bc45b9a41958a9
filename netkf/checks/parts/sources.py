"""The part whose stated law a part of a scenario is tested against.

A user's class is tested against the built-in class it derives from, with the same fields. A class
that derives from an abstract base only, or that overrides a statement such as ``mean_rate``, is
tested against its own statements.
"""

from __future__ import annotations

from typing import Any

from netkf.core.fields import as_class
from netkf.scenario.registry import KINDS

CLOCK_STATEMENTS = ("mean_rate", "memoryless")
STATEMENTS = {
    "activation": CLOCK_STATEMENTS,
    "sampling": CLOCK_STATEMENTS,
    "loss": ("mean_delivery", "independent"),
    "delay": ("fixed", "longest"),
    "slot activation": ("mean",),
}
"""Methods and properties by which the parts of each family state their law."""


def is_own_class(part: Any, family: str) -> bool:
    """Return True if the class of a part is not built in."""
    return type(part) not in set(KINDS[family].values())


def stated_part(part: Any, family: str) -> Any:
    """Return the object whose stated law (rate, loss probability, covariance, ...) a clock,
    channel, plant or sensor ``part`` is tested against.

    It is the part itself if its class is built in, derives from no built-in class, or overrides one
    of the STATEMENTS of its ``family`` (kind of part, such as "loss"); otherwise an instance of the
    built-in base class with the same fields.
    """
    # The first built-in class among the ancestors; 0 if that is the class itself or there is none.
    built_in, ancestors = set(KINDS[family].values()), type(part).__mro__
    index = next((k for k, cls in enumerate(ancestors) if cls in built_in), 0)
    own_names = {name for cls in ancestors[:index] for name in vars(cls)}
    if index == 0 or own_names.intersection(STATEMENTS.get(family, ())):
        return part
    return as_class(part, ancestors[index])
