"""The one table that turns the names of a scenario file into classes, and back."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from netkf.algorithms.filter import Filter
from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.registry import built_in_filters, split_choice
from netkf.algorithms.slot import SlotFilter
from netkf.core.clock import Clock
from netkf.core.errors import ScenarioError, nearest
from netkf.core.fields import Component
from netkf.network import channels, clocks, graphs, matchings, recorded
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.nonlinear import BearingSensor, RangeBearingSensor, RangeSensor
from netkf.plants.plant import Plant
from netkf.plants.recorded import (
    RecordedDiffusion,
    RecordedPlant,
    RecordedSensor,
    UnknownDiffusion,
    UnknownPlant,
)
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sampling import RecordedSampling
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.scenario.imports import Origin, find_class

FAMILIES: dict[str, type[Component]] = {
    "plant": Plant,
    "continuous plant": Plant,
    "sensor": Sensor,
    "sampling": Clock,
    "graph": graphs.Graph,
    "activation": clocks.LinkClock,
    "loss": channels.Loss,
    "delay": channels.Delay,
    "filter": Filter,
    "slot activation": matchings.SlotActivation,
    "slot filter": Filter,
}
"""The contract that the classes of each family keep."""

FORMER: dict[str, tuple[type[Component], ...]] = {"filter": (FlowFilter, SlotFilter)}
"""Contracts that classes of users may still keep (algorithms.adapters)."""

KINDS: dict[str, dict[str, type[Component]]] = {
    "plant": {
        "diffusion": Diffusion,
        "linear": LinearPlant,
        "recorded": RecordedPlant,
        "unknown": UnknownPlant,
    },
    "continuous plant": {"recorded": RecordedDiffusion, "unknown": UnknownDiffusion},
    "sensor": {
        "linear": LinearSensor,
        "regressor": RegressorSensor,
        "recorded": RecordedSensor,
        "range": RangeSensor,
        "bearing": BearingSensor,
        "range-bearing": RangeBearingSensor,
    },
    "sampling": {
        "periodic": clocks.Periodic,
        "poisson": clocks.Poisson,
        "renewal": clocks.Renewal,
        "recorded": RecordedSampling,
    },
    "graph": {
        "cycle": graphs.Cycle,
        "path": graphs.PathGraph,
        "complete": graphs.Complete,
        "star": graphs.Star,
        "grid": graphs.Grid,
        "regular": graphs.Regular,
        "erdos-renyi": graphs.ErdosRenyi,
        "geometric": graphs.Geometric,
        "edges": graphs.Edges,
        "csv": graphs.CsvGraph,
    },
    "activation": {
        "poisson": clocks.Poisson,
        "renewal": clocks.Renewal,
        "periodic": clocks.Periodic,
        "recorded": clocks.RecordedClock,
        "readings": clocks.OnReadings,
    },
    "loss": {
        "none": channels.NoLoss,
        "bernoulli": channels.Bernoulli,
        "per-link": channels.PerLink,
        "gilbert-elliott": channels.GilbertElliott,
        "recorded": recorded.RecordedLoss,
    },
    "delay": {
        "none": channels.NoDelay,
        "constant": channels.ConstantDelay,
        "exponential": channels.ExponentialDelay,
        "uniform": channels.UniformDelay,
        "lognormal": channels.LognormalDelay,
        "recorded": recorded.RecordedDelay,
    },
    "filter": {**built_in_filters()},
    "slot activation": {
        "matching": matchings.Matching,
        "broadcast": matchings.Broadcast,
        "recorded": matchings.RecordedSlots,
    },
}
KINDS["slot filter"] = {
    name: cls for name, cls in KINDS["filter"].items() if getattr(cls, "schedule", None)
}
"""The classes by family and name: the kind, with a choice (algorithms.registry.choice_name) where
several classes share it. "slot activation" is for plants in slots; "slot filter" is the
part of "filter" that runs in slots.
"""

SLOTTED = (LinearPlant,)


def other_time(family: str, kind: object) -> str | None:
    """Return why a kind is unknown that exists in the other kind of time only, or None."""
    other = family.removeprefix("slot ") if family.startswith("slot ") else f"slot {family}"
    if not isinstance(kind, str) or kind not in KINDS.get(other, {}) or kind in KINDS[family]:
        return None
    return explain_kind_of_time(slotted=family.startswith("slot "))


def explain_kind_of_time(slotted: bool) -> str:
    """Return the rule that a part of the other kind of time than the plant breaks."""
    slots, flow = "in slots (linear)", "in continuous time (diffusion)"
    needs, has = (flow, slots) if slotted else (slots, flow)
    return f"belongs to plants {needs}, and this plant is {has}"


def names_of_kind(family: str, kind: object) -> dict[str, dict[str, str]]:
    """Return the names of the table that are of a kind, with the choice that each one is; more than
    one where a key beside ``kind`` chooses the class.
    """
    split = {name: split_choice(name) for name in KINDS[family]}
    return {name: choice for name, (known, choice) in split.items() if known == kind}


def kinds_of(family: str) -> list[str]:
    """Return the kinds of a family, each once."""
    return list(dict.fromkeys(split_choice(name)[0] for name in KINDS[family]))


def find(
    family: str, kind: object, origin: Origin, choices: Mapping[str, Any] = MappingProxyType({})
) -> type[Component] | None:
    """Return the class of ``kind``: a kind of the table, or ``"package.module:Class"``. Where
    several classes share the kind, ``choices`` has the key that tells which.

    It is None if the class waits for its import, see :class:`Origin`. Raises ScenarioError if there
    is no such class, or if it may not be imported.
    """
    named = names_of_kind(family, kind)
    if named:
        return KINDS[family][_chosen_name(named, choices)]
    if isinstance(kind, str) and ":" in kind:
        return _custom(family, kind, origin)
    reason = other_time(family, kind)
    if reason is not None:
        raise ScenarioError("kind", reason, kind, "change the plant or choose another kind")
    kinds = kinds_of(family)
    listed = ", ".join(f'"{name}"' for name in kinds)
    raise ScenarioError(
        "kind",
        f"must be one of {listed}",
        kind,
        f'{nearest(kind, kinds)}choose one, or write "package.module:Class"',
    )


def _chosen_name(named: Mapping[str, Mapping[str, str]], choices: Mapping[str, Any]) -> str:
    """Return the one of several names that is chosen; raises ScenarioError if none is."""
    for name, choice in named.items():
        if all(choices.get(key) == value for key, value in choice.items()):
            return name
    key = next(iter(next(iter(named.values()))))
    values = [choice[key] for choice in named.values()]
    listed = ", ".join(f'"{value}"' for value in values)
    if key not in choices:
        raise ScenarioError(key, "is missing", None, f"add {key}, one of {listed}")
    raise ScenarioError(key, f"must be one of {listed}", choices[key], "choose one of them")


def _custom(family: str, kind: str, origin: Origin) -> type[Component] | None:
    """Return a user's class given as "package.module:Class", None if ``kind`` has another form."""
    found = find_class(kind, origin)
    if found is None:
        return None
    contract = FAMILIES[family]
    allowed = (contract, *FORMER.get(family, ()))
    if not (isinstance(found, type) and issubclass(found, allowed)):
        raise ScenarioError(
            "kind",
            f"must be a subclass of netkf's {contract.__name__}",
            kind,
            f"derive the class from {contract.__module__}.{contract.__name__}",
        )
    missing = sorted(name for name in dir(found) if _is_abstract(getattr(found, name, None)))
    if missing:
        raise ScenarioError(
            "kind", f"must define {', '.join(missing)}", kind, "write what the contract asks for"
        )
    return found


def _is_abstract(attribute: object) -> bool:
    """Return True if a subclass must define the attribute."""
    return bool(getattr(attribute, "__isabstractmethod__", False))


def name_of(family: str, part: Component) -> str:
    """Return the name of the class of ``part`` in the table, or its ``package.module:Class``."""
    others = (KINDS.get(f"{time} {family}", {}) for time in ("slot", "continuous"))
    for table in (KINDS[family], *others):
        for name, candidate in table.items():
            if type(part) is candidate:
                return name
    return f"{type(part).__module__}:{type(part).__qualname__}"


def kind_name(part: Component, family: str = "filter") -> str:
    """Return the kind of a part in a sentence: its name, or that of a user's class."""
    name = name_of(family, part)
    return type(part).__name__.lower() if ":" in name else name
