"""Tables of TOML to a scenario: every mistake is found here, with the path of its key."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from netkf.core.errors import ScenarioError, nearest
from netkf.core.fields import Component, SourceFile, integer, source_file
from netkf.network.channels import Channel
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.imports import Origin
from netkf.scenario.model import Belief, Filtering, Network
from netkf.scenario.plugins import describe_error, explain_user_error, is_netkf_class
from netkf.scenario.registry import KINDS, SLOTTED, find_kind, list_names_of_kind
from netkf.scenario.writing import as_table, part_as_table

FORMAT = 1
MAX_DEPTH = 30
"""Tables and lists within one another."""
UNKNOWN = "is not a key here"
TABLES = ("plant", "network", "filter")

WAITING = object()
"""Stands for a part whose class waits for its import, and for what holds such a part."""

# The class to build is a parameter, so that Scenario.replace can call this module.
S = TypeVar("S", bound=DerivedScenario)


def change_keys(scenario: S, changes: Mapping[str, Any]) -> S:
    """Return the scenario with some keys changed; see Scenario.replace."""
    folder = getattr(scenario, "_folder", None)
    if folder is None:  # built in Python
        folder = next((s.folder for s in source_files(scenario)), Path.cwd())
    try:
        origin = Origin(folder, getattr(scenario, "_trust", True))
        return build_scenario(type(scenario), with_changes(as_table(scenario), changes), origin)
    except ScenarioError as error:
        raise explain_left_over(error, changes) from None


def explain_left_over(error: ScenarioError, changes: Mapping[str, Any]) -> ScenarioError:
    """Return the error, reworded if a change of kind left keys of the former kind behind."""
    table = error.key.rpartition(".")[0]
    if error.rule != UNKNOWN or f"{table}.kind" not in changes or error.key in changes:
        return error
    rule = f"is left over from the former kind of {table}"
    remedy = f"set the whole table, --set '{table}={{ kind = \"...\", ... }}'"
    return ScenarioError(error.key, rule, error.value, remedy, error.file)


def source_files(part: Any) -> list[SourceFile]:
    """Return every file that a scenario names."""
    if isinstance(part, SourceFile):
        return [part]
    if isinstance(part, tuple):
        return [source for item in part for source in source_files(item)]
    if isinstance(part, Component):
        values = [getattr(part, field.name) for field in dataclasses.fields(part)]
        return [source for value in values for source in source_files(value)]
    return []


def with_changes(table: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of the table with the values at some key paths replaced or added."""
    for path, value in changes.items():
        keys = path.replace("[", ".").replace("]", "").split(".")
        if len(keys) > MAX_DEPTH:
            raise ScenarioError(
                path, "is not a key path of a scenario", None, "see the file's keys"
            )
        table = _set_key(table, keys, value, path)
    return table


def _set_key(node: Any, keys: list[str], value: Any, path: str) -> Any:
    """Return a copy of a nested table in which the value at a key path is replaced or added."""
    if not keys:
        return value
    if isinstance(node, Component):
        node = part_as_table(node)
    key, rest = keys[0], keys[1:]
    if isinstance(node, (list, tuple)):
        if not key.isdecimal() or int(key) >= len(node):
            raise ScenarioError(
                path, f"has no entry {key!r} in a list of {len(node)}", None, "count from 0"
            )
        index = int(key)
        return [*node[:index], _set_key(node[index], rest, value, path), *node[index + 1 :]]
    if node is None:
        node = {}
    if not isinstance(node, dict) or not key:
        raise ScenarioError(path, "is not a key path of a scenario", None, "see the file's keys")
    return {**node, key: _set_key(node.get(key), rest, value, path)}


def build_scenario(cls: type[S], table: Mapping[str, Any], origin: Origin) -> S:
    """Return a scenario of class ``cls`` from the tables of a file.

    Raises ScenarioError, with the path of the key, for the first mistake.
    """
    # Importing a module executes it, and a file that is refused must execute nothing.
    scenario = _build(cls, table, origin._replace(imports=False))
    if scenario is WAITING:
        scenario = _build(cls, table, origin)
    # What replace needs to look up files and modules.
    object.__setattr__(scenario, "_folder", origin.folder)
    object.__setattr__(scenario, "_trust", origin.trust)
    made: S = scenario
    return made


def _build(cls: type[S], given: Mapping[str, Any], origin: Origin) -> Any:
    """Return the scenario of a table."""
    table = dict(given)
    version = table.pop("format", None)
    if version is None:
        raise ScenarioError("format", "is missing", None, f"write format = {FORMAT} first")
    if integer()("format", version) != FORMAT:
        raise ScenarioError("format", f"must be {FORMAT}", version, "this netkf reads no other")
    table.setdefault("sensors", [])
    time = ""
    if "plant" in table:
        table["plant"] = _read_under("plant", lambda value: _plant(value, origin), table["plant"])
        time = "slot " if isinstance(table["plant"], SLOTTED) else ""
        time = "unknown" if table["plant"] is WAITING else time
    readers: dict[str, Callable[[Any], Any]] = {
        "sensors": lambda value: _list(value, origin),
        "network": lambda value: _network(value, origin, time),
        "filter": lambda value: _filtering(value, origin),
    }
    for key, reader in readers.items():
        if key in table:
            table[key] = _read_under(key, reader, table[key])
    return _part(cls, table, origin, ("format",))


def _read_under(key: str, reader: Any, value: Any) -> Any:
    """Return ``reader(value)``; errors that it raises get ``key`` in front of their own."""
    try:
        return reader(value)
    except ScenarioError as error:
        raise error.under(key) from None


def _part(
    cls: type[Any], table: dict[str, Any], origin: Origin, others: tuple[str, ...] = ()
) -> Any:
    """Return an object of a class, or WAITING if a part of it waits.

    ``others`` are keys that stand in the same table and are read elsewhere.
    """
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    for key, value in table.items():
        if key not in fields:
            known = ", ".join([*others, *fields])
            hint = nearest(key, [*others, *fields])
            raise ScenarioError(key, UNKNOWN, value, f"{hint}keys are {known}")
    for name, field in fields.items():
        if field.default is dataclasses.MISSING and name not in table:
            remedy = f"add [{name}]" if name in TABLES else f"add {name} = ..."
            raise ScenarioError(name, "is missing", None, remedy)
    values = {
        name: SourceFile(value, origin.folder)
        if fields[name].metadata.get("rule") is source_file and isinstance(value, str)
        else value
        for name, value in table.items()
    }
    if any(map(_is_waiting, values.values())):
        for name, value in values.items():
            rule = fields[name].metadata.get("rule")
            if rule is not None and not _is_waiting(value):
                rule(name, value)
        return WAITING
    return _make_part(cls, values)


def _is_waiting(value: Any) -> bool:
    """Return True if a class of the value is not known yet."""
    return value is WAITING or (isinstance(value, tuple) and any(map(_is_waiting, value)))


def _make_part(cls: type[Any], values: dict[str, Any]) -> Any:
    """Return an object of the class with these fields; other errors become ScenarioError."""
    try:
        return cls(**values)
    except ScenarioError:
        raise
    except Exception as error:
        # A class of the user's failed, this one or one that the scenario asked.
        rule = f"{cls.__name__} could not be made ({describe_error(error)})"
        if is_netkf_class(cls):
            rule = explain_user_error(tuple(values.values()), error) or ""
        if not rule:
            raise
        raise ScenarioError("", rule, None, "correct the class or its settings") from error


def _plant(value: Any, origin: Origin) -> Any:
    """Return the plant of a table."""
    table = _table(value)
    known = table.get("kind") in ("recorded", "unknown")
    continuous = known and ("A" in table or "B" in table)
    return _kind("continuous plant" if continuous else "plant", origin, table)


def _kind(
    family: str, origin: Origin, value: Any, default: str | None = None, inner: bool = False
) -> Any:
    """Read a part by its kind; an ``inner`` one stands inside another of its family."""
    table = _table(value)
    kind = table.pop("kind", default)
    if kind is None:
        raise ScenarioError("kind", "is missing", None, 'add kind = "..."')
    cls = find_kind(family, kind, origin, table)
    keys = [key for choice in list_names_of_kind(family, kind).values() for key in choice]
    others = ("kind", *dict.fromkeys(keys))
    for key in others[1:]:
        del table[key]
    if family == "filter" and not inner:
        others = (*others, "mean", "cov", "model")
    if family == "filter" and isinstance(table.get("inner"), (Mapping, Component)):
        table["inner"] = _read_under(
            "inner", partial(_kind, family, origin, inner=True), table["inner"]
        )
    return WAITING if cls is None else _part(cls, table, origin, others)


def _table(value: Any) -> dict[str, Any]:
    """Return a value as a new dictionary; raises ScenarioError unless it is a table."""
    if isinstance(value, Component):
        return part_as_table(value)
    if not isinstance(value, Mapping):
        raise ScenarioError("", "must be a table", value, "write key = value pairs")
    return dict(value)


def _list(value: Any, origin: Origin) -> tuple[Any, ...]:
    """Return the sensors of a list of tables."""
    if not isinstance(value, (list, tuple)):
        raise ScenarioError("", "must be a list of tables", value, "write [[sensors]]")
    return tuple(
        _read_under(f"[{k}]", lambda item: _sensor(item, origin), item)
        for k, item in enumerate(value)
    )


def _sensor(value: Any, origin: Origin) -> Any:
    """Return the sensor of a table, with its sampling clock."""
    table = _table(value)
    if isinstance(table.get("sampling"), (Mapping, Component)):
        read = partial(_kind, "sampling", origin)
        table["sampling"] = _read_under("sampling", read, table["sampling"])
    return _kind("sensor", origin, table, "linear")


def _network(value: Any, origin: Origin, time: str) -> Network:
    """Return the network of a table; ``time`` tells plants in slots from continuous ones."""
    table = _table(value)
    if "graph" in table:
        table["graph"] = _read_under("graph", partial(_kind, "graph", origin), table["graph"])
    if "activation" in table:
        read = partial(_activation, origin, time)
        table["activation"] = _read_under("activation", read, table["activation"])
    if "channel" in table:
        table["channel"] = _read_under("channel", lambda v: _channel(v, origin), table["channel"])
    network: Network = _part(Network, table, origin)
    return network


def _activation(origin: Origin, time: str, value: Any) -> Any:
    """Return the activation of a table, of the plant's kind of time."""
    if time == "unknown":  # the plant waits
        kind = _table(value).get("kind")
        homes = [
            t for t in ("", "slot ") if isinstance(kind, str) and kind in KINDS[f"{t}activation"]
        ]
        if len(homes) > 1:
            return WAITING
        time = homes[0] if homes else ""
    return _kind(f"{time}activation", origin, value)


def _channel(value: Any, origin: Origin) -> Channel:
    """Return the channel of a table."""
    table = _table(value)
    for family in ("loss", "delay"):
        if family in table:
            table[family] = _read_under(family, partial(_kind, family, origin), table[family])
    channel: Channel = _part(Channel, table, origin)
    return channel


def _filtering(value: Any, origin: Origin) -> Filtering:
    """Return the filter of a table with its start and model."""
    table = _table(value)
    shared: dict[str, Any] = {
        key: table.pop(key) for key in ("mean", "cov", "model") if key in table
    }
    if "model" in shared:
        shared["model"] = _read_under(
            "model", lambda v: _part(Belief, _table(v), origin), shared["model"]
        )
    algorithm = _kind("filter", origin, table)
    filtering: Filtering = _part(Filtering, {"algorithm": algorithm, **shared}, origin)
    return filtering
