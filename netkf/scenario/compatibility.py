"""Checks that filter, activation, graph and sensors can run together."""

from __future__ import annotations

from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import SlotFilter
from netkf.core.errors import ScenarioError
from netkf.network.clocks import LinkClock
from netkf.network.matchings import SlotActivation
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import takes_samples
from netkf.scenario.registry import explain_time_mismatch, kind_name

SAMPLING = 'sampling = { kind = "periodic", period = ... }'


def check_time(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if filter or activation need slots over a diffusion, or the reverse."""
    algorithm, node_filter = scenario.filter.algorithm, scenario.node_filter
    slotted, remedy = scenario.slotted, "change the plant or choose another kind"
    # A Filter runs in slots if it has a ``schedule`` of their phases, and in continuous time if it
    # names ``clocks`` that may make it send, or never sends. FlowFilter and SlotFilter, deprecated
    # contracts, are for one model of time each.
    if slotted:
        fits = not isinstance(algorithm, FlowFilter) and node_filter.schedule is not None
    else:
        only_slots = node_filter.talks and not node_filter.clocks
        fits = not isinstance(algorithm, SlotFilter) and not only_slots
    if not fits:
        rule = explain_time_mismatch(slotted)
        raise ScenarioError("filter.kind", rule, kind_name(algorithm), remedy)
    activation = scenario.network.activation
    if activation is not None and isinstance(activation, SlotActivation) != slotted:
        kind = kind_name(activation, "activation")
        raise ScenarioError("network.activation.kind", explain_time_mismatch(slotted), kind, remedy)


def check_activation(scenario: DerivedScenario) -> None:
    """Raise ScenarioError unless the clocks suit the filter, the graph and the sensors.

    Does nothing in slots or for filters that exchange no messages.
    """
    clock, topology = scenario.network.activation, scenario.topology
    node_filter = scenario.node_filter
    if not isinstance(clock, LinkClock) or not node_filter.talks:
        return
    name = kind_name(scenario.filter.algorithm)
    if topology.directed and (clock.at == "links" or node_filter.clocks == ("links",)):
        remedies = [f'at = "{at}"' for at in ("directions", "nodes") if at in node_filter.clocks]
        raise ScenarioError(
            "network.graph.directed",
            f"must be false for the {name} filter at links, which work both ways",
            True,
            " or ".join(["give an undirected graph", *remedies]),
        )
    if clock.at not in node_filter.clocks:
        _reject_clock(clock.at, node_filter.clocks, name)
    if clock.at == "readings" and not any(map(takes_samples, scenario.sensors)):
        raise ScenarioError(
            "network.activation.kind",
            "needs a sensor that takes samples, and there is none",
            "readings",
            f"add {SAMPLING} to a sensor, or choose clocks",
        )


def _reject_clock(at: str, clocks: tuple[str, ...], name: str) -> None:
    """Raise ScenarioError: the filter ``name`` runs under ``clocks`` only, not under those ``at``.

    Both are of "links", "directions", "nodes" and "readings", see ``Filter.clocks``.
    """
    settings = [f'at = "{clock}"' for clock in clocks if clock != "readings"]
    settings += ['kind = "readings"'] if "readings" in clocks else []
    key = "kind" if at == "readings" else "at"
    rule = f"must be one that the {name} filter runs under: {' or '.join(settings)}"
    raise ScenarioError(f"network.activation.{key}", rule, at, "write that, or change the filter")


def check_readings(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if the filter cannot use a sensor's readings (in slots it always can)."""
    if not scenario.slotted:
        for k, sensor in enumerate(scenario.sensors):
            _check_readings_of(scenario, f"sensors[{k}]", sensor)


def _check_readings_of(scenario: DerivedScenario, key: str, sensor: Sensor) -> None:
    """Raise ScenarioError if the filter cannot use samples, or only samples, or a varying H.

    ``key`` is the key path of the sensor, which is over a diffusion.
    """
    algorithm, node_filter = scenario.filter.algorithm, scenario.node_filter
    name = kind_name(algorithm)
    if isinstance(algorithm, FlowFilter) and takes_samples(sensor):
        raise ScenarioError(
            f"{key}.sampling" if isinstance(sensor, LinearSensor) else f"{key}.kind",
            f"must be continuous for the {name} filter, a FlowFilter, which takes no samples",
            None,
            "remove it, or derive the class from netkf.parts.Filter",
        )
    if sensor.varying and node_filter.fixed_sensors:
        raise ScenarioError(
            key,
            f"must have a fixed H for the {name} filter, which adds up information",
            None,
            "leave out the columns phi0, ..., or use another filter",
        )
    if node_filter.needs_samples and not takes_samples(sensor):
        raise ScenarioError(
            f"{key}.sampling",
            f"is missing, and the {name} filter uses samples, no continuous increments",
            None,
            f"add {SAMPLING}",
        )
