"""Writing of scenarios: the tables of a scenario file, and their TOML text.

Tables leave out keys whose values equal their defaults, unless they are made ``with_defaults``:
those of a run's own copy of its scenario, which must not change when defaults of netkf do.
"""

from __future__ import annotations

import copy
import dataclasses
import datetime
import json
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.registry import split_choice
from netkf.core.contracts import is_netkf_class
from netkf.core.fields import Component, SourceFile, require_checked
from netkf.core.printable import NamedNode
from netkf.network.channels import Channel
from netkf.network.clocks import LinkClock
from netkf.network.graphs import RandomGraph
from netkf.plants.blocks import Block
from netkf.plants.diffusion import Diffusion
from netkf.plants.dynamics import CustomDynamics
from netkf.plants.plant import Plant
from netkf.plants.sensors import Sensor
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import Belief, Filtering, Network
from netkf.scenario.names import map_nodes
from netkf.scenario.plugins import GivenName
from netkf.scenario.registry import FAMILIES, name_of

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_TIMES = (datetime.date, datetime.time)  # a datetime is a date


class _Style(NamedTuple):
    """How tables are written: with keys at their defaults, and with ``names`` of nodes by id."""

    with_defaults: bool = False
    names: Mapping[int, str] = MappingProxyType({})


def _style_of(scenario: DerivedScenario, with_defaults: bool = False) -> _Style:
    return _Style(with_defaults, {node: name for name, node in scenario.topology.names.items()})


def as_table(scenario: DerivedScenario) -> dict[str, Any]:
    """Return the tables of a scenario file, without values that are equal to their defaults."""
    return _scenario_table(
        scenario, scenario.plant, scenario.network, scenario.filter, _style_of(scenario)
    )


def resolve_defaults(scenario: DerivedScenario) -> dict[str, Any]:
    """Return the tables of a scenario with all defaults, for the same runs if these change."""
    network = scenario.network
    if isinstance(network.graph, RandomGraph) and network.graph.seed is None:
        graph = dataclasses.replace(network.graph, seed=scenario.seed)
        network = dataclasses.replace(network, graph=graph)
    filtering, plant = scenario.filter, scenario.plant
    filtering = dataclasses.replace(
        filtering,
        mean=plant.start_mean if filtering.mean is None else filtering.mean,
        cov=plant.start_cov if filtering.cov is None else filtering.cov,
    )
    # A second Scenario of these parts would build and check the whole network again.
    has_matrices = not scenario.slotted and scenario.plant.linear
    plant = scenario.diffusion if has_matrices else scenario.plant
    resolved_plant = dataclasses.replace(plant, mean=plant.start_mean, cov=plant.start_cov)
    return _scenario_table(scenario, resolved_plant, network, filtering, _style_of(scenario, True))


def _scenario_table(
    scenario: DerivedScenario, plant: Plant, network: Network, filtering: Filtering, style: _Style
) -> dict[str, Any]:
    table = _field_values(scenario, style)
    table.pop("time", None)
    # A run's own copy says its grid.
    grid = scenario.time_grid.as_table() if style.with_defaults else {}
    if time := {**_field_values(scenario.time, style), **grid}:
        table["time"] = time
    if scenario.plants:
        del table["plant"]
        table["plants"] = [_block_table(block, plant, style) for block in scenario.plants]
    else:
        table.pop("plants", None)
        table["plant"] = _part_table(plant, style)
    table["sensors"] = [_part_table(sensor, style) for sensor in scenario.declared_sensors]
    table["network"] = _part_table(network, style)
    table["filter"] = _part_table(filtering, style)
    return {"format": 1, **table}


def _block_table(block: Block, stacked: Plant, style: _Style) -> dict[str, Any]:
    plant = copy.copy(block.plant)
    if style.with_defaults:
        defaults: dict[str, Any] = {"mean": plant.start_mean, "cov": plant.start_cov}
        if block.means is not None:
            del defaults["mean"]
        if isinstance(stacked, Diffusion):
            defaults["sensing_period"] = stacked.sensing_period
        for name, value in defaults.items():
            object.__setattr__(plant, name, value)
    own = _field_values(block, style)
    del own["plant"]
    if block.coupling:
        own["coupling"] = [
            {"from": _toml_value(_with_names(c.origin, style), style), "A": c.A.tolist()}
            for c in block.coupling
        ]
    return {**own, **_part_table(plant, style)}


def part_as_table(part: Component) -> dict[str, Any]:
    """Return the table of a component, without values equal to their defaults."""
    require_checked(part)
    return _part_table(part, _Style())


def _part_table(part: Component, style: _Style) -> dict[str, Any]:
    values = _field_values(part, style)
    if isinstance(part, Filtering):
        keys = ["mean", "cov", "model", "linearise", "estimates", "gate"]
        if part.model == Belief():
            keys.remove("model")
        rest = {key: values[key] for key in keys if values.get(key)}
        return {**_part_table(part.algorithm, style), **rest}
    family = next((family for family, base in FAMILIES.items() if isinstance(part, base)), None)
    if family is None:
        return values
    # Every clock of links is of two families.
    name = name_of("activation" if isinstance(part, LinkClock) else family, part)
    kind, choice = split_choice(name)
    if not is_netkf_class(type(part)):
        kind = GivenName(kind, type(part))
    return {"kind": kind, **choice, **values}


def _field_values(part: Component, style: _Style) -> dict[str, Any]:
    table: dict[str, Any] = {}
    # All keys of a network are written, whatever their values.
    with_defaults = style.with_defaults or isinstance(part, Network | Channel)
    for field in dataclasses.fields(part):
        if not field.init:
            continue
        value = getattr(part, field.name)
        is_default = field.default is not dataclasses.MISSING and (
            value is field.default or (not isinstance(value, np.ndarray) and value == field.default)
        )
        rule = field.metadata.get("rule")
        if rule is not None and rule.of_nodes:
            value = _with_names(value, style)
        if value is None or (is_default and not with_defaults):
            continue
        table[part._written_keys.get(field.name, field.name)] = _toml_value(value, style)
        if isinstance(value, LinkClock) and not isinstance(part, Network):
            # Keys of clocks of links, which another clock must not have.
            for key in ("at", "rates") if isinstance(part, Sensor) else ("at",):
                table[field.name].pop(key, None)
    return table


def _with_names(nodes: Any, style: _Style) -> Any:
    return map_nodes(nodes, lambda node: style.names.get(node, node)) if style.names else nodes


def _toml_value(value: Any, style: _Style) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_toml_value(item, style) for item in value]
    if isinstance(value, CustomDynamics):
        return GivenName(value.name, value)
    return _part_table(value, style) if isinstance(value, Component) else value


def to_toml(table: dict[str, Any]) -> str:
    """Return the TOML text of nested tables; equal tables give equal text."""
    lines = [f"{key} = {toml_text(v)}" for key, v in table.items() if not _is_section(v)]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += ["", f"[{key}]", *_key_lines(value)]
        elif _is_section(value):
            for entry in value:
                lines += ["", f"[[{key}]]", *_key_lines(entry)]
    return "\n".join(lines) + "\n"


def _key_lines(table: dict[str, Any]) -> list[str]:
    return [f"{key} = {toml_text(value)}" for key, value in table.items()]


def _is_section(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(isinstance(item, dict) for item in value)
    return isinstance(value, dict)


def toml_text(value: Any) -> str:
    """Return one value as a TOML expression on one line."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, dict):
        keys = {k: k if _BARE_KEY.fullmatch(str(k)) else _quoted(str(k)) for k in value}
        return "{ " + ", ".join(f"{keys[k]} = {toml_text(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (SourceFile, NamedNode)):
        return _quoted(value.name)
    if isinstance(value, _TIMES):
        return value.isoformat()
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def is_writable(value: Any) -> bool:
    """Return True if TOML can say a value of a user's field."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_writable(item) for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return all(map(is_writable, value))
    simple = (bool, int, float, str, np.integer, np.floating, np.bool_, *_TIMES)
    return isinstance(value, (*simple, np.ndarray, SourceFile, Component))
