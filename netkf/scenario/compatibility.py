"""Checks that filter, activation and graph can run together."""

from __future__ import annotations

from netkf.algorithms.filter import Filter
from netkf.core.errors import ScenarioError
from netkf.core.fields import walk
from netkf.network.clocks import LinkClock
from netkf.network.contacts import Contacts
from netkf.network.matchings import SlotActivation
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import takes_samples
from netkf.scenario.registry import explain_time_mismatch, kind_name

SAMPLING = 'sampling = { kind = "periodic", period = ... }'


def filter_name(scenario: DerivedScenario) -> str:
    """Return what messages call the filter: its kind, and that of the one that it wraps."""
    algorithm = scenario.filter.algorithm
    filters = [kind_name(part) for part in walk(algorithm) if isinstance(part, Filter)]
    return " around ".join([f"{filters[0]} filter", *filters[1:]])


def check_time(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if filter or activation need slots over a diffusion, or the reverse."""
    algorithm, slotted = scenario.node_filter, scenario.slotted
    remedy = "change the plant or choose another kind"
    # A filter runs in slots if it has a ``schedule`` of their phases, and in continuous time if it
    # names ``clocks`` that may make it send, or never sends.
    if slotted:
        fits = algorithm.timing.schedule is not None
    else:
        fits = bool(algorithm.timing.clocks) or not algorithm.timing.talks
    if not fits:
        rule = explain_time_mismatch(slotted)
        raise ScenarioError("filter.kind", rule, kind_name(algorithm), remedy)
    activation = scenario.network.activation
    if activation is not None and isinstance(activation, SlotActivation) != slotted:
        kind = kind_name(activation, "activation")
        raise ScenarioError("network.activation.kind", explain_time_mismatch(slotted), kind, remedy)


def check_activation(scenario: DerivedScenario) -> None:
    """Raise ScenarioError unless clocks suit filter, graph and sensors; not in slots."""
    clock, topology = scenario.network.activation, scenario.topology
    node_filter = scenario.node_filter
    if not isinstance(clock, LinkClock) or not node_filter.timing.talks:
        return
    name = filter_name(scenario)
    if topology.directed and (clock.at == "links" or node_filter.timing.clocks == ("links",)):
        remedies = [
            f'at = "{at}"' for at in ("directions", "nodes") if at in node_filter.timing.clocks
        ]
        rule = f"must be false for the {name} at links, which work both ways"
        remedy = " or ".join(["give an undirected graph", *remedies])
        raise ScenarioError("network.graph.directed", rule, True, remedy)
    if clock.at not in node_filter.timing.clocks:
        clocks, at = node_filter.timing.clocks, clock.at
        settings = [f'at = "{one}"' for one in clocks if one != "readings"]
        if isinstance(clock, Contacts) and "nodes" in clocks:
            settings[settings.index('at = "nodes"')] += " of another kind than contacts"
        settings += ['kind = "readings"'] if "readings" in clocks else []
        key = "kind" if at == "readings" else "at"
        rule, remedy = f"must be one that the {name} runs under", "write that, or change the filter"
        listed = " or ".join(settings)
        raise ScenarioError(f"network.activation.{key}", f"{rule}: {listed}", at, remedy)
    # A filter that needs samples says so itself, of the sensors that there are.
    says_so = bool(scenario.sensors) and node_filter.needs.samples
    if clock.at == "readings" and not says_so and not any(map(takes_samples, scenario.sensors)):
        rule = "needs a sensor that takes samples, and there is none"
        remedy = f"add {SAMPLING} to a sensor, or choose clocks"
        raise ScenarioError("network.activation.kind", rule, "readings", remedy)
