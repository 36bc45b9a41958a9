"""Everything that a scenario is built from in Python, under one roof.

``Scenario``, ``Network``, ``Filtering``, ``Belief`` and ``Channel``; the class of every kind that a
scenario file can name (``kinds()`` lists them); the contracts that classes of one's own derive
from; ``setting`` and the rules of its fields.
"""

from __future__ import annotations

from typing import Any

from netkf.core import fields
from netkf.network.channels import Channel
from netkf.scenario.registry import FAMILIES, KINDS
from netkf.scenario.scenario import Belief, Filtering, Network, Scenario

_CLASSES = [Scenario, Network, Filtering, Belief, Channel, *FAMILIES.values()]
_CLASSES += [cls for names in KINDS.values() for cls in names.values()]
_RULES = ("setting", "number", "positive", "probability", "integer", "boolean", "matrix", "vector")
_HERE = {cls.__name__: cls for cls in _CLASSES} | {name: getattr(fields, name) for name in _RULES}


def kinds() -> dict[str, dict[str, type]]:
    """The classes by family and kind, as scenario files name them."""
    return {family: dict(names) for family, names in KINDS.items()}


def __getattr__(name: str) -> Any:
    if name not in _HERE:
        raise AttributeError(f"module 'netkf.parts' has no attribute {name!r}")
    return _HERE[name]


def __dir__() -> list[str]:
    return sorted([*_HERE, "kinds"])


__all__ = __dir__()  # noqa: PLE0605 - as it was made
