"""Building a scenario from the tables of a file; errors name the path of the wrong key.

Importing a user's module executes it, so that a file is first checked as if no module could be
imported. Tables are built from the inside out: one of a user's class then gives NOT_IMPORTED
instead of an object, and so does every table that contains it; other keys are checked all the same.
In all functions ``origin`` says from where classes may be imported, and if they may be at all, and
``value`` is a table as TOML gives it, or an object that was built before.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from netkf.algorithms.gates import Gate
from netkf.core.contracts import ContractError, describe_error, error_line, is_netkf_class
from netkf.core.errors import ScenarioError, errors_under, suggest_nearest
from netkf.core.fields import Component, SourceFile, integer, source_file, walk
from netkf.network.channels import Channel
from netkf.network.graph_files import as_graph
from netkf.network.node_clocks import NodeClock
from netkf.network.quantise import Quantisation
from netkf.network.radio import Energy, Radio
from netkf.network.scheduled import Hopping
from netkf.plants.blocks import Block
from netkf.plants.states import state_file
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import Belief, Filtering, Metrics, Network
from netkf.scenario.plugins import GivenName, Origin, explain_user_error, find_class
from netkf.scenario.registry import KINDS, SLOTTED, find_kind, list_names_of_kind
from netkf.scenario.time_grid import Time
from netkf.scenario.writing import as_table, part_as_table

FORMAT = 1  # version of scenario files
MAX_DEPTH = 30  # of tables and lists inside one another
UNKNOWN = "is not a key here"
TABLES = ("plant", "network", "filter")
BLOCK_KEYS = ("name", "nodes", "coupling", "position", "means")
"""Keys in one of [[plants]], beside those of its plant."""
OF_CHANNEL = {field.name for field in dataclasses.fields(Channel)}
"""Keys of network.channel, some of which are often written into [network]."""
OF_BLOCKS = ("coupling", "position", "means")
"""Those of them that no other table has."""
FILTERING_KEYS = ("mean", "cov", "model", "linearise", "estimates", "gate")
"""Keys of the table of a filter, beside those of its kind."""

NOT_IMPORTED = object()
"""Stands for an object whose class is not imported yet, or that contains such an object."""

# The class to build is a parameter: this module cannot import Scenario, which imports it.
S = TypeVar("S", bound=DerivedScenario)


def change_keys(scenario: S, changes: Any) -> S:
    """Return a scenario with ``changes``, values by key path; files and modules are looked up in
    the folder of its file, or else of its first data file, or the current one.
    """
    if not isinstance(changes, Mapping):
        rule, remedy = "must be values by key", "write {'network.activation.rate': 5.0}"
        raise ScenarioError("changes", rule, changes, remedy)
    try:
        origin = _origin_of(scenario)
        return build_scenario(type(scenario), change_table(as_table(scenario), changes), origin)
    except ScenarioError as error:
        raise explain_left_over(error, changes) from None


def _origin_of(scenario: DerivedScenario) -> Origin:
    folder = getattr(scenario, "_folder", None)
    if folder is None:
        folder = next((s.folder for s in source_files(scenario)), Path.cwd())
    return Origin(folder, getattr(scenario, "_trust", True))


def check_filter_table(scenario: DerivedScenario, table: Mapping[str, Any]) -> None:
    """Raise ScenarioError for keys and values of [filter] that are wrong in every scenario."""
    with errors_under("filter"):
        _build_filtering(_origin_of(scenario), table)


def explain_left_over(error: ScenarioError, changes: Mapping[str, Any]) -> ScenarioError:
    """Return ``error``, reworded if it is about a key that a change of kind left behind."""
    table = error.key.rpartition(".")[0]
    if error.rule != UNKNOWN or f"{table}.kind" not in changes or error.key in changes:
        return error
    rule = f"is left over from the former kind of {table}"
    remedy = f"set the whole table, --set '{table}={{ kind = \"...\", ... }}'"
    return ScenarioError(error.key, rule, error.value, remedy, error.file)


def source_files(value: Any) -> list[SourceFile]:
    """Return all files that a scenario, or a value inside one, refers to."""
    return [item for item in walk(value) if isinstance(item, SourceFile)]


def split_path(path: str) -> list[str]:
    """Return the keys of a path: ``sensors[0].R`` and ``sensors.0.R`` are one."""
    return path.replace("[", ".").replace("]", "").split(".")


def replaces_key(path: str, earlier: str) -> bool:
    """Return True if a value at a key path replaces that of an ``earlier`` one."""
    keys = split_path(path)
    return split_path(earlier)[: len(keys)] == keys


def change_table(table: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables with values at key paths replaced or added; raises ScenarioError for a path
    through a value that is neither a table nor a list.
    """
    for path, value in changes.items():
        keys = split_path(path)
        if len(keys) > MAX_DEPTH:
            raise ScenarioError(
                path, "is not a key path of a scenario", None, "see the file's keys"
            )
        table = _set_key(table, keys, value, path)
    return table


def _set_key(target: Any, keys: list[str], value: Any, path: str) -> Any:
    if not keys:
        return value
    if isinstance(target, Component):
        target = part_as_table(target)
    key, inner_keys = keys[0], keys[1:]
    if isinstance(target, (list, tuple)):
        if not key.isdecimal() or int(key) >= len(target):
            remedy = f"give one of 0 .. {len(target) - 1}" if target else "give the whole list"
            raise ScenarioError(
                path, f"has no entry {key!r} in a list of {len(target)}", None, remedy
            )
        index = int(key)
        entry = _set_key(target[index], inner_keys, value, path)
        return [*target[:index], entry, *target[index + 1 :]]
    if target is None:
        target = {}
    if not isinstance(target, dict) or not key:
        raise ScenarioError(path, "is not a key path of a scenario", None, "see the file's keys")
    return {**target, key: _set_key(target.get(key), inner_keys, value, path)}


def build_scenario(cls: type[S], table: Mapping[str, Any], origin: Origin) -> S:
    """Return a scenario from the tables of a file; raises ScenarioError with the key's path."""
    # Importing a module executes it, and a file that is refused must execute nothing: everything
    # is checked without imports first.
    scenario = _build(cls, table, origin._replace(imports=False))
    if scenario is NOT_IMPORTED:
        scenario = _build(cls, table, origin)
    # Scenario.replace needs these to look up files and modules.
    object.__setattr__(scenario, "_folder", origin.folder)
    object.__setattr__(scenario, "_trust", origin.trust)
    result: S = scenario
    return result


def _build(cls: type[S], table: Mapping[str, Any], origin: Origin) -> Any:
    values = dict(table)
    version = values.pop("format", None)
    if version is None:
        raise ScenarioError("format", "is missing", None, f"write format = {FORMAT} first")
    if integer()("format", version) != FORMAT:
        raise ScenarioError("format", f"must be {FORMAT}", version, "this netkf reads no other")
    values.setdefault("sensors", [])
    # First of all: tables are read with it.
    values = _build_inner(values, {"time": partial(_build_table, Time, origin)})
    if "time" in values:
        origin = origin._replace(stamps=values["time"].stamps)
    if "plants" in values and "plant" in values:
        raise ScenarioError("plant", "cannot stand beside [[plants]]", None, "write one of the two")
    blocks = partial(_build_list, "plants", partial(_build_block, origin))
    values = _build_inner(values, {"plant": partial(_build_plant, origin), "plants": blocks})
    plant = values.get("plant")
    if "plants" in values:
        plant, values["plant"] = getattr(values["plants"][0], "plant", NOT_IMPORTED), None
    time = "slot " if isinstance(plant, SLOTTED) else ""
    if plant is NOT_IMPORTED:
        time = "unknown"
    builders = {
        "sensors": partial(_build_list, "sensors", partial(_build_sensor, origin)),
        "network": partial(_build_network, origin, time),
        "filter": partial(_build_filtering, origin),
        "metrics": partial(_build_table, Metrics, origin),
    }
    return _build_object(cls, _build_inner(values, builders), origin, ("format",))


def _build_inner(table: dict[str, Any], builders: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with the objects that ``builders`` make of the values of its keys."""
    built = dict(table)
    for key, builder in builders.items():
        if key in table:
            with errors_under(key):
                built[key] = builder(table[key])
    return built


def _build_table(cls: type[Any], origin: Origin, value: Any) -> Any:
    return _build_object(cls, _as_dict(value), origin)


def _build_part(family: str, origin: Origin, value: Any) -> Any:
    """Return the part of a table or a component, any other value as it is."""
    is_table = isinstance(value, (Mapping, Component))
    return _build_component(family, origin, value, is_inner=True) if is_table else value


def _build_object(
    cls: type[Any], values: dict[str, Any], origin: Origin, other_keys: tuple[str, ...] = ()
) -> Any:
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    _check_keys(fields, values, other_keys)
    rules = {name: fields[name].metadata.get("rule") for name in values}
    values = dict(values)
    for name, value in values.items():
        if rules[name] in (source_file, state_file) and isinstance(value, str):
            values[name] = SourceFile(value, origin.folder, origin.stamps)
        elif isinstance(value, SourceFile):
            # It may have been read with names of nodes of another graph.
            values[name] = SourceFile(
                value.name, value.folder, origin.stamps, content=value.content
            )
    if any(map(_has_missing_class, values.values())):
        # No object can be made yet, but mistakes in other fields are found before any import.
        for name, value in values.items():
            rule = rules[name]
            if rule is not None and not _has_missing_class(value):
                rule(name, value)
        return NOT_IMPORTED
    return _construct(cls, values)


def _check_keys(
    fields: dict[str, dataclasses.Field[Any]], values: dict[str, Any], other_keys: tuple[str, ...]
) -> None:
    for key, value in values.items():
        if key not in fields:
            allowed_keys = [*other_keys, *fields]
            hint = "it is a key of channel; " if key in OF_CHANNEL else ""
            hint = hint or suggest_nearest(key, allowed_keys)
            remedy = f"{hint}keys are {', '.join(allowed_keys)}"
            if key in OF_BLOCKS:
                remedy += f"; {key} stands in an entry of [[plants]], beside nodes"
            raise ScenarioError(key, UNKNOWN, value, remedy)
    for name, field in fields.items():
        if field.default is dataclasses.MISSING and name not in values:
            remedy = f"add [{name}]" if name in TABLES else f"add {name} = ..."
            raise ScenarioError(name, "is missing", None, remedy)


def _has_missing_class(value: Any) -> bool:
    """Return True if a value is NOT_IMPORTED or a tuple that contains it."""
    return value is NOT_IMPORTED or (
        isinstance(value, tuple) and any(map(_has_missing_class, value))
    )


def _construct(cls: type[Any], values: dict[str, Any]) -> Any:
    try:
        return cls(**values)
    except ScenarioError:
        raise
    except Exception as error:
        # The user's class is this one, or one of the values, whose methods a check called.
        place = error_line(error, cls.__module__.partition(".")[0])
        where = f"; {place}" if place else ""
        rule = f"{cls.__name__} could not be made ({describe_error(error)}{where})"
        if isinstance(error, ContractError):
            rule = str(error)
        elif is_netkf_class(cls):
            rule = explain_user_error(tuple(values.values()), error) or ""
        if not rule:
            raise
        raise ScenarioError("", rule, None, "correct the class or its settings") from error


def _build_plant(origin: Origin, value: Any) -> Any:
    build = {"f": partial(_find_dynamics, origin), "input": partial(_build_part, "input", origin)}
    table = _build_inner(_as_dict(value), build)
    if table.get("kind") in ("recorded", "unknown") and "f" in table:
        if table["kind"] == "unknown":
            table["unknown"] = True
        elif "path" not in table:
            raise ScenarioError("path", "is missing", None, "add path = ...")
        table["kind"] = "nonlinear"
    # Some kinds exist for both models of time; the keys tell which one is meant.
    in_both_times = table.get("kind") in ("nonlinear", "recorded", "unknown")
    continuous = in_both_times and not {"A", "B", "step"}.isdisjoint(table)
    return _build_component("continuous plant" if continuous else "plant", origin, table)


def _build_block(origin: Origin, value: Any) -> Any:
    if isinstance(value, Block):
        return value
    table = _as_dict(value)
    own = {key: table.pop(key) for key in BLOCK_KEYS if key in table}
    kinds = {"F": "linear", "f": "nonlinear"}
    table.setdefault("kind", next((kinds[key] for key in kinds if key in table), "diffusion"))
    return _build_object(Block, {**own, "plant": _build_plant(origin, table)}, origin)


def _find_dynamics(origin: Origin, value: Any) -> Any:
    """Return the class that "module:Class" names, other values as they are."""
    if isinstance(value, GivenName):
        return value.given
    if not isinstance(value, str) or ":" not in value:
        return value
    try:
        cls = find_class(value, origin)
    except ScenarioError as error:
        raise ScenarioError("", error.rule, error.value, error.remedy) from None
    return NOT_IMPORTED if cls is None else cls


def _build_component(
    family: str, origin: Origin, value: Any, default_kind: str | None = None, is_inner: bool = False
) -> Any:
    table = _as_dict(value)
    kind = table.pop("kind", default_kind)
    if kind is None:
        raise ScenarioError("kind", "is missing", None, 'add kind = "..."')
    cls = find_kind(family, kind, origin, table)
    # Keys that choose among classes of one kind have done their work; they are no fields.
    choices = list_names_of_kind(family, kind).values()
    choice_keys = dict.fromkeys(key for choice in choices for key in choice)
    for key in choice_keys:
        del table[key]
    other_keys = ("kind", *choice_keys)
    if family == "filter" and not is_inner:
        other_keys = (*other_keys, *FILTERING_KEYS)
    if family == "filter":
        table = _build_inner(table, {"inner": partial(_build_part, family, origin)})
    return NOT_IMPORTED if cls is None else _build_object(cls, table, origin, other_keys)


def _as_dict(value: Any) -> dict[str, Any]:
    if isinstance(value, Component):
        return part_as_table(value)
    if not isinstance(value, Mapping):
        raise ScenarioError("", "must be a table", value, "write key = value pairs")
    return dict(value)


def _build_list(key: str, build: Callable[[Any], Any], value: Any) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)) or (key == "plants" and not value):
        raise ScenarioError("", "must be a list of tables", value, f"write [[{key}]]")
    tables = {f"[{k}]": item for k, item in enumerate(value)}
    return tuple(_build_inner(tables, dict.fromkeys(tables, build)).values())


def _build_sensor(origin: Origin, value: Any) -> Any:
    parts = {key: partial(_build_part, key, origin) for key in ("sampling", "fault")}
    table = _build_inner(_as_dict(value), parts)
    return _build_component("sensor", origin, table, default_kind="linear")


def _build_network(origin: Origin, time: str, value: Any) -> Any:
    builders: dict[str, Callable[[Any], Any]] = {
        "graph": lambda graph: _build_component("graph", origin, as_graph(graph)),
        "activation": partial(_build_activation, origin, time),
        "channel": partial(_build_channel, origin),
        "lives": partial(_build_list, "network.lives", partial(_build_component, "life", origin)),
        "clocks": partial(_build_list, "network.clocks", partial(_build_table, NodeClock, origin)),
        "radio": partial(_build_table, Radio, origin),
        "quantise": partial(_build_table, Quantisation, origin),
        "energy": partial(_build_table, Energy, origin),
    }
    return _build_object(Network, _build_inner(_as_dict(value), builders), origin)


def _build_activation(origin: Origin, time: str, value: Any) -> Any:
    if time == "unknown":
        # Build it if its kind exists for one model of time only.
        kind = _as_dict(value).get("kind")
        prefixes = [
            prefix
            for prefix in ("", "slot ")
            if isinstance(kind, str) and kind in KINDS[f"{prefix}activation"]
        ]
        if len(prefixes) > 1:
            return NOT_IMPORTED
        time = prefixes[0] if prefixes else ""
    table = _build_inner(_as_dict(value), {"clock": partial(_build_part, "activation", origin)})
    return _build_component(f"{time}activation", origin, table)


def _build_channel(origin: Origin, value: Any) -> Any:
    builders: dict[str, Callable[[Any], Any]] = {
        key: partial(_build_component, key, origin) for key in ("loss", "delay")
    }
    builders["channels"] = partial(_build_table, Hopping, origin)
    return _build_object(Channel, _build_inner(_as_dict(value), builders), origin)


def _build_filtering(origin: Origin, value: Any) -> Any:
    table = _as_dict(value)
    values = {key: table.pop(key) for key in FILTERING_KEYS if key in table}
    tables = {"model": Belief, "gate": Gate}
    values = _build_inner(
        values, {key: partial(_build_table, cls, origin) for key, cls in tables.items()}
    )
    algorithm = _build_component("filter", origin, table)
    return _build_object(Filtering, {"algorithm": algorithm, **values}, origin)
