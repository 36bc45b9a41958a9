"""The built-in part that a part of a scenario says that it is.

A user's class is held to the built-in class that it derives from, with the same fields; a class
that derives from a contract alone, or that defines a statement of its base anew, is held to what it
states about itself.
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
"""By which methods and properties a part states its law."""


def is_own_class(part: Any, family: str) -> bool:
    """Return True if the class of a part is not built in."""
    return type(part) not in set(KINDS[family].values())


def stated_part(part: Any, family: str) -> Any:
    """Return the part that states the law: the part itself if its class is built in, derives from
    a contract alone or has a statement of its own, else one of the built-in class that it derives
    from, with the same fields.
    """
    known, order = set(KINDS[family].values()), type(part).__mro__
    index = next((k for k, cls in enumerate(order) if cls in known), 0)
    own = {name for cls in order[:index] for name in vars(cls)}
    if index == 0 or own.intersection(STATEMENTS.get(family, ())):
        return part
    return as_class(part, order[index])
