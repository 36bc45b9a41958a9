"""Names of nodes, in fields and tables of a scenario: it replaces them by ids."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Mapping
from typing import Any

from netkf.core.errors import ScenarioError, suggest_nearest
from netkf.core.fields import SourceFile, rebuild
from netkf.network.graphs import Graph
from netkf.plants.blocks import Coupling

Names = Mapping[str, int]
"""The ids of nodes by name."""


def bind_names(part: Any, names: Names | None) -> Any:
    """Return a component with ids in place of ``names`` of nodes, in fields and tables; graphs
    stay. ``names`` is None if nodes have none. Raises ScenarioError for a name without a node.
    """
    ids = names or {}

    def change(owner: Any, field: dataclasses.Field[Any], value: Any) -> Any:
        if isinstance(value, Graph):
            return value
        if isinstance(value, SourceFile):
            # A table that was read with other names, or without those that it has, is read again.
            is_read = value.node_ids == ids or not (ids or value.node_ids or value.unknown)
            return value if is_read else dataclasses.replace(value, node_ids=ids, unknown={})
        rule = field.metadata.get("rule")
        # A word that stands for nodes, as "neighbours", is no name.
        if rule is None or not rule.of_nodes or (isinstance(value, str) and value == field.default):
            return _bind_couplings(rebuild(value, change), names)
        # Nodes that were taken from a table are taken again, when it is read again.
        codes = set(getattr(getattr(owner, "path", None), "unknown", {}).values())
        is_taken = isinstance(value, tuple) and bool(codes.intersection(value))
        listed = getattr(getattr(owner, "record", None), "listed", None)
        is_taken = is_taken or (bool(ids) and value is not None and value is listed)
        return None if is_taken else _bind_nodes(value, names)

    return rebuild(part, change)


def _bind_couplings(value: Any, names: Names | None) -> Any:
    """Return the couplings of a block with ids of nodes; any other value stays."""
    if not (isinstance(value, tuple) and value and isinstance(value[0], Coupling)):
        return value
    origins = [c.origin for c in value]
    bound = [
        origin if isinstance(origin, str) else _bind_nodes(origin, names, f"[{k}].from")
        for k, origin in enumerate(origins)
    ]
    if all(map(operator.is_, origins, bound)):
        return value
    return tuple(c._replace(origin=origin) for c, origin in zip(value, bound, strict=True))


def _bind_nodes(value: Any, names: Names | None, key: str = "") -> Any:
    if isinstance(value, tuple):
        items = tuple(_bind_nodes(item, names, f"{key}[{k}]") for k, item in enumerate(value))
        return value if all(map(operator.is_, items, value)) else items
    if not isinstance(value, str):
        return value
    if names is None:
        raise ScenarioError(key, "must be an integer", value, "give the id of a node")
    if value in names:
        return names[value]
    if value.isascii() and value.isdecimal():  # 07 is 7, as in tables
        return int(value)
    remedy = f"{suggest_nearest(value, names)}correct it, or name the nodes in the graph"
    raise ScenarioError(key, "must name a node of the graph", value, remedy)


def map_nodes(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a field of nodes with ``change`` applied to each; the same object if equal."""
    if isinstance(value, tuple):
        items = tuple(map_nodes(item, change) for item in value)
        return value if all(map(operator.is_, items, value)) else items
    return value if isinstance(value, float) else change(value)
