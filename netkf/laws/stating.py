"""The law that a part states.

A user's class is tested against the built-in class it derives from, with the same fields. A class
that derives from an abstract base only, or that overrides a statement such as ``mean_rate``, is
tested against its own statements.
"""

from __future__ import annotations

from typing import Any

from netkf.core.clock import Clock
from netkf.core.fields import Component, as_class
from netkf.network.delays import Delay
from netkf.network.losses import Loss
from netkf.scenario.registry import KINDS

_CLOCK = ("mean_rate", "memoryless", "gaps")
STATEMENTS = {
    "activation": _CLOCK,
    "sampling": _CLOCK,
    "loss": ("mean_delivery", "independent", "chain"),
    "delay": ("fixed", "longest", "law"),
    "slot activation": ("mean",),
}
"""Methods and properties by which the parts of each family state their law; the last is the law in
the narrow sense, for which the contract has a default.
"""
CONTRACTS: dict[str, type[Component]] = {
    "activation": Clock,
    "sampling": Clock,
    "loss": Loss,
    "delay": Delay,
}


def is_own_class(part: Any, family: str) -> bool:
    """Return True if the class of a part is not built in."""
    return type(part) not in set(KINDS[family].values())


def _own_statements(part: Any, family: str) -> set[str]:
    """Return the statements that a user's class overrides of its built-in base, if it has one."""
    built_in, ancestors = set(KINDS[family].values()), type(part).__mro__
    # The first built-in class among the ancestors; 0 if that is the class itself or there is none.
    index = next((k for k, cls in enumerate(ancestors) if cls in built_in), 0)
    own_names = {name for cls in ancestors[:index] for name in vars(cls)}
    return own_names.intersection(STATEMENTS.get(family, ()))


def stated_part(part: Any, family: str) -> Any:
    """Return the object whose law a clock, channel, plant or sensor is tested against: the ``part``
    if its class is built in, derives from no built-in class, or overrides one of the STATEMENTS of
    its ``family``; else its built-in base class with the same fields.
    """
    built_in, ancestors = set(KINDS[family].values()), type(part).__mro__
    base = next((cls for cls in ancestors if cls in built_in), type(part))
    own = base is type(part) or _own_statements(part, family)
    return part if own else as_class(part, base)


def stated_law(part: Any, family: str) -> Any:
    """Return the ``gaps`` of a clock, ``chain`` of a loss or ``law`` of a delay; where a user's
    class overrides another of the STATEMENTS the default, which states another class's law.
    """
    stated, name = stated_part(part, family), STATEMENTS[family][-1]
    own = _own_statements(stated, family)
    if own and name not in own:
        return getattr(CONTRACTS[family], name).fget(stated)
    return getattr(stated, name)


def stating_class(part: Any, family: str, statement: str) -> str:
    """Return as text what states a part's law: its base class, or its own ``statement``."""
    stated = stated_part(part, family)
    if type(stated) is type(part):
        return f"its `{statement}`"
    return f"{type(stated).__name__}, from which it derives"
