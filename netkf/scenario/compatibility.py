"""Checks that filter, activation, graph and sensors can be run together."""

from __future__ import annotations

from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import SlotFilter
from netkf.core.errors import ScenarioError
from netkf.network.clocks import LinkClock
from netkf.network.matchings import SlotActivation
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import takes_samples
from netkf.scenario.registry import explain_kind_of_time, kind_name

SAMPLING = 'sampling = { kind = "periodic", period = ... }'


def check_time(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if the filter or the activation belongs to the other kind of time."""
    given, hosted, slotted = scenario.filter.algorithm, scenario.hosted, scenario.slotted
    name = kind_name(given)
    only_clocks = isinstance(given, FlowFilter) or hosted.schedule is None
    only_slots = isinstance(given, SlotFilter) or (hosted.talks and not hosted.clocks)
    if only_clocks if slotted else only_slots:
        remedy = "change the plant or choose another kind"
        raise ScenarioError("filter.kind", explain_kind_of_time(slotted), name, remedy)
    activation = scenario.network.activation
    if activation is not None and isinstance(activation, SlotActivation) != slotted:
        kind = kind_name(activation, "activation")
        remedy = "change the plant or choose another kind"
        raise ScenarioError("network.activation.kind", explain_kind_of_time(slotted), kind, remedy)


def check_activation(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if the filter cannot run under the clocks, or these not on the graph."""
    clock, hosted, topology = scenario.network.activation, scenario.hosted, scenario.topology
    if not isinstance(clock, LinkClock) or not hosted.talks:
        return
    name = kind_name(scenario.filter.algorithm)
    if topology.directed and (clock.at == "links" or hosted.clocks == ("links",)):
        others = [f'at = "{at}"' for at in ("directions", "nodes") if at in hosted.clocks]
        raise ScenarioError(
            "network.graph.directed",
            f"must be false for the {name} filter at links, which work both ways",
            True,
            " or ".join(["give an undirected graph", *others]),
        )
    if clock.at not in hosted.clocks:
        _reject_clock(clock.at, hosted.clocks, name)
    if clock.at == "readings" and not any(map(takes_samples, scenario.sensors)):
        raise ScenarioError(
            "network.activation.kind",
            "needs a sensor that takes samples, and there is none",
            "readings",
            f"add {SAMPLING} to a sensor, or choose clocks",
        )


def _reject_clock(at: str, clocks: tuple[str, ...], name: str) -> None:
    """Raise ScenarioError: the filter does not run under clocks of this kind."""
    kinds = [f'at = "{one}"' for one in clocks if one != "readings"]
    kinds += ['kind = "readings"'] if "readings" in clocks else []
    listed = " or ".join(kinds)
    key = "kind" if at == "readings" else "at"
    rule = f"must be one that the {name} filter runs under: {listed}"
    raise ScenarioError(f"network.activation.{key}", rule, at, "write that, or change the filter")


def check_readings(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if the filter cannot use the readings of a sensor."""
    if not scenario.slotted:
        for k, sensor in enumerate(scenario.sensors):
            _check_readings(scenario, f"sensors[{k}]", sensor)


def _check_readings(scenario: DerivedScenario, key: str, sensor: Sensor) -> None:
    """Raise ScenarioError if the filter cannot use the readings of a sensor."""
    algorithm, hosted = scenario.filter.algorithm, scenario.hosted
    name = kind_name(algorithm)
    if isinstance(algorithm, FlowFilter) and takes_samples(sensor):
        raise ScenarioError(
            f"{key}.sampling" if isinstance(sensor, LinearSensor) else f"{key}.kind",
            f"must be continuous for the {name} filter, a FlowFilter, which takes no samples",
            None,
            "remove it, or derive the class from netkf.parts.Filter",
        )
    if sensor.varying and hosted.fixed_sensors:
        raise ScenarioError(
            key,
            f"must have a fixed H for the {name} filter, which adds up information",
            None,
            "leave out the columns phi0, ..., or use another filter",
        )
    if hosted.needs_samples and not takes_samples(sensor):
        raise ScenarioError(
            f"{key}.sampling",
            f"is missing, and the {name} filter uses samples, no continuous increments",
            None,
            f"add {SAMPLING}",
        )
