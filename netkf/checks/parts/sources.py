"""The built-in part that a part of a scenario says that it is.

A user's class is held to the built-in class that it derives from, with the same fields; a class
that derives from a contract alone is held to what it states about itself.
"""

from __future__ import annotations

from typing import Any

from netkf.core.fields import as_class
from netkf.scenario.registry import KINDS


def stated_part(part: Any, family: str) -> Any:
    """Return the part that states the law: the part itself if its class is built in or derives from
    a contract alone, else one of the built-in class that it derives from, with the same fields.
    """
    known = set(KINDS[family].values())
    base = next((cls for cls in type(part).__mro__ if cls in known), type(part))
    return part if base is type(part) else as_class(part, base)
