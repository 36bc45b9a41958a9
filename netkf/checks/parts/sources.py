"""The built-in part that a part of a scenario says that it is.

A user's class is held to the built-in class that it derives from, with the same fields; a class
that derives from a contract alone is held to what it states about itself.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from netkf.scenario.registry import KINDS


def stated_part(part: Any, *families: str) -> Any:
    """Return the part itself if its class is built in, or one of the built-in class that it derives
    from; None if there is none.
    """
    known = {cls for family in families for cls in KINDS[family].values()}
    for cls in type(part).__mro__:
        if cls in known:
            if cls is type(part):
                return part
            names = [field.name for field in dataclasses.fields(cls) if field.init]
            return cls(**{name: getattr(part, name) for name in names})
    return None
