"""A scenario as TOML, so that a run directory holds the scenario of the run."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter
from netkf.algorithms.registry import split_choice
from netkf.core.fields import Component, SourceFile
from netkf.network.channels import Channel
from netkf.network.graphs import RandomGraph
from netkf.plants.plant import Plant
from netkf.plants.sensors import Sensor
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import Filtering, Network
from netkf.scenario.registry import FAMILIES, FORMER, name_of


def as_table(scenario: DerivedScenario) -> dict[str, Any]:
    """Return the tables of a scenario file without fields at their defaults."""
    return _scenario(scenario, scenario.plant, scenario.network, scenario.filter, defaults=False)


def resolve_defaults(scenario: DerivedScenario) -> dict[str, Any]:
    """Return the tables of a scenario file with all defaults; it gives the same runs."""
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
    # No second scenario is made of the parts: it would build and check the whole network again.
    return _scenario(scenario, _fill_start(scenario), network, filtering, defaults=True)


def _fill_start(scenario: DerivedScenario) -> Plant:
    """Return the plant with the mean and covariance of x(0) written out."""
    plant = scenario.plant if scenario.slotted else scenario.diffusion
    return dataclasses.replace(plant, mean=plant.start_mean, cov=plant.start_cov)


def _scenario(
    scenario: DerivedScenario, plant: Plant, network: Network, filtering: Filtering, defaults: bool
) -> dict[str, Any]:
    """Return the table of a scenario with these parts."""
    table = _fields(scenario, defaults)
    table["plant"] = _kind("plant", plant, defaults)
    table["sensors"] = [_sensor(sensor, defaults) for sensor in scenario.sensors]
    table["network"] = _network(network, defaults)
    table["filter"] = _filtering(filtering, defaults)
    return {"format": 1, **table}


def part_as_table(part: Component) -> dict[str, Any]:
    """Return the table of a scenario file for a part: a plant, a sensor, a filter, a network and
    everything inside one, or a Filtering or Belief; without fields at their defaults.
    """
    if isinstance(part, Network):
        return _network(part, defaults=False)
    if isinstance(part, Channel):
        return _channel(part, defaults=False)
    if isinstance(part, Filtering):
        return _filtering(part, defaults=False)
    if isinstance(part, Sensor):
        return _sensor(part, defaults=False)
    families = (f for f, contract in FAMILIES.items() if isinstance(part, contract))
    family = next(families, "filter" if isinstance(part, FORMER["filter"]) else None)
    if family == "sampling" and isinstance(part, FAMILIES["activation"]):
        family = "activation"  # a clock of links is a clock too
    return _fields(part, False) if family is None else _kind(family, part, defaults=False)


def _network(network: Network, defaults: bool) -> dict[str, Any]:
    """Return the table of a network."""
    table = {"graph": _kind("graph", network.graph, defaults)}
    if network.activation is not None:
        table["activation"] = _kind("activation", network.activation, defaults)
    return {**table, "channel": _channel(network.channel, defaults)}


def _channel(channel: Channel, defaults: bool) -> dict[str, Any]:
    """Return the table of a channel."""
    table = _fields(channel, True)
    table["loss"] = _kind("loss", channel.loss, defaults)
    table["delay"] = _kind("delay", channel.delay, defaults)
    return table


def _sensor(sensor: Sensor, defaults: bool) -> dict[str, Any]:
    """Return the table of a sensor with its sampling clock."""
    table, clock = _kind("sensor", sensor, defaults), getattr(sensor, "sampling", None)
    if clock is not None:
        entries = _kind("sampling", clock, defaults)
        table["sampling"] = {k: v for k, v in entries.items() if k not in ("at", "rates")}
    return table


def _filtering(filtering: Filtering, defaults: bool) -> dict[str, Any]:
    """Return the table of a filter with its start and model."""
    table = _kind("filter", filtering.algorithm, defaults)
    for name, value in _fields(filtering, defaults).items():
        if name in ("mean", "cov"):
            table[name] = value
    model = _fields(filtering.model, defaults)
    return {**table, "model": model} if model else table


def _kind(family: str, part: Component, defaults: bool) -> dict[str, Any]:
    """Return the table of a part with its kind."""
    kind, choice = split_choice(name_of(family, part))
    return {"kind": kind, **choice, **_fields(part, defaults)}


def _fields(part: Component, defaults: bool) -> dict[str, Any]:
    """Return the fields of a part as TOML values, those with default values only if asked."""
    table: dict[str, Any] = {}
    for field in (field for field in dataclasses.fields(part) if field.init):
        value = getattr(part, field.name)
        is_default = field.default is not dataclasses.MISSING and (
            value is field.default or (not isinstance(value, np.ndarray) and value == field.default)
        )
        if value is not None and (defaults or not is_default):
            table[field.name] = _toml_value(value, defaults)
    return table


def _toml_value(value: Any, defaults: bool) -> Any:
    """Return a value of a field as TOML has it."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_toml_value(item, defaults) for item in value]
    # A filter inside another one.
    return _kind("filter", value, defaults) if isinstance(value, Filter) else value


def to_toml(table: dict[str, Any]) -> str:
    """Return nested tables of numbers, strings and lists as TOML; equal tables give equal text."""
    lines = [f"{key} = {toml_text(v)}" for key, v in table.items() if not _is_section(v)]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += ["", f"[{key}]", *(f"{k} = {toml_text(v)}" for k, v in value.items())]
        elif _is_section(value):
            for entry in value:
                lines += ["", f"[[{key}]]", *(f"{k} = {toml_text(v)}" for k, v in entry.items())]
    return "\n".join(lines) + "\n"


def _is_section(value: Any) -> bool:
    """Return True if a value is written as a table of its own."""
    tables = isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)
    return isinstance(value, dict) or tables


def toml_text(value: Any) -> str:
    """Return one value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml_text(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, SourceFile):
        return json.dumps(value.name, ensure_ascii=False)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)
