"""The table of the classes that a scenario file can name, by family and kind."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from netkf.algorithms.filter import Filter
from netkf.algorithms.registry import built_in_filters, default_timing, split_choice
from netkf.core.clock import Clock
from netkf.core.contracts import ContractError, is_netkf_class, require_known_members
from netkf.core.errors import ScenarioError, suggest_nearest
from netkf.core.fields import Component
from netkf.network import (
    clocks,
    contacts,
    delays,
    graph_files,
    graphs,
    lives,
    losses,
    matchings,
    recorded,
    scheduled,
)
from netkf.plants import faults
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.inputs import ConstantInput, Input, RecordedInput, SineInput
from netkf.plants.linear import LinearPlant, SlotPlant
from netkf.plants.maps import NonlinearPlant
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
from netkf.plants.relative import (
    RelativeBearingSensor,
    RelativeRangeBearingSensor,
    RelativeRangeSensor,
    RelativeSensor,
)
from netkf.plants.sampling import RecordedSampling
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.scenario.plugins import (
    GivenName,
    Origin,
    find_class,
    find_offered_class,
    offered_kinds,
)

FAMILIES: dict[str, type[Component]] = {
    "plant": Plant,
    "continuous plant": Plant,
    "input": Input,
    "sensor": Sensor,
    "sampling": Clock,
    "fault": faults.Fault,
    "graph": graphs.Graph,
    "activation": clocks.LinkClock,
    "life": lives.Life,
    "loss": losses.Loss,
    "delay": delays.Delay,
    "filter": Filter,
    "slot activation": matchings.SlotActivation,
    "slot filter": Filter,
}
"""The base class of the classes of each family."""

KINDS: dict[str, dict[str, type[Component]]] = {
    "plant": {
        "diffusion": Diffusion,
        "linear": LinearPlant,
        "nonlinear": NonlinearPlant,
        "recorded": RecordedPlant,
        "unknown": UnknownPlant,
    },
    "continuous plant": {
        "nonlinear": NonlinearDiffusion,
        "recorded": RecordedDiffusion,
        "unknown": UnknownDiffusion,
    },
    "input": {"constant": ConstantInput, "sine": SineInput, "recorded": RecordedInput},
    "sensor": {
        "linear": LinearSensor,
        "regressor": RegressorSensor,
        "recorded": RecordedSensor,
        "range": RangeSensor,
        "bearing": BearingSensor,
        "range-bearing": RangeBearingSensor,
        "relative": RelativeSensor,
        "relative-range": RelativeRangeSensor,
        "relative-bearing": RelativeBearingSensor,
        "relative-range-bearing": RelativeRangeBearingSensor,
    },
    "sampling": {
        "periodic": clocks.Periodic,
        "poisson": clocks.Poisson,
        "renewal": clocks.Renewal,
        "recorded": RecordedSampling,
    },
    "fault": {
        "stuck": faults.Stuck,
        "biased": faults.Biased,
        "drifting": faults.Drifting,
        "outliers": faults.Outliers,
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
        "range": graphs.RangeGraph,
        "csv": graphs.CsvGraph,
        "graphml": graph_files.GraphmlGraph,
        "gml": graph_files.GmlGraph,
        "edgelist": graph_files.EdgelistGraph,
    },
    "activation": {
        "poisson": clocks.Poisson,
        "renewal": clocks.Renewal,
        "periodic": clocks.Periodic,
        "recorded": clocks.RecordedClock,
        "contacts": contacts.Contacts,
        "readings": clocks.OnReadings,
    },
    "life": {"crashes": lives.Crashes, "duty": lives.DutyCycle, "recorded": lives.RecordedLife},
    "loss": {
        "none": losses.NoLoss,
        "bernoulli": losses.Bernoulli,
        "shared": losses.SharedLoss,
        "per-link": losses.PerLink,
        "distance": losses.DistanceLoss,
        "gilbert-elliott": losses.GilbertElliott,
        "scheduled": scheduled.ScheduledLoss,
        "recorded": recorded.RecordedLoss,
    },
    "delay": {
        "none": delays.NoDelay,
        "constant": delays.ConstantDelay,
        "exponential": delays.ExponentialDelay,
        "uniform": delays.UniformDelay,
        "lognormal": delays.LognormalDelay,
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
    name: cls
    for name, cls in KINDS["filter"].items()
    for timing in [default_timing(cls)]
    if timing is None or timing.schedule is not None
}
"""The classes by family and name.

The name is the kind. Where several classes share a kind, it is the kind and the value of another
key that chooses the class (algorithms.registry). "slot activation" is for plants in
slots; "slot filter" holds those of "filter" that run in slots.
"""

SLOTTED = (SlotPlant,)
"""Base classes of plants in slots."""


def explain_time_mismatch(slotted: bool) -> str:
    """Return the rule that a component breaks which does not fit the plant's time."""
    slots, flow = "in slots (linear)", "in continuous time (diffusion)"
    needed_time, plant_time = (flow, slots) if slotted else (slots, flow)
    return f"belongs to plants {needed_time}, and this plant is {plant_time}"


def list_names_of_kind(family: str, kind: object) -> dict[str, dict[str, str]]:
    """Return the names in KINDS[family] of one kind, each with the keys that choose it, such as
    {"rule": "ci"} of track fusion; {} for a single class.
    """
    choices: dict[str, dict[str, str]] = {}
    for name in KINDS[family]:
        kind_of_name, choice = split_choice(name)
        if kind_of_name == kind:
            choices[name] = choice
    return choices


def list_kinds(family: str) -> list[str]:
    """Return the kinds of a family, each once."""
    return list(dict.fromkeys(split_choice(name)[0] for name in KINDS[family]))


def find_kind(
    family: str, kind: object, origin: Origin, table: Mapping[str, Any] = MappingProxyType({})
) -> type[Component] | None:
    """Return the class that ``kind`` names: of the family, ``"package.module:Class"``, or offered
    by a package; other keys of ``table`` choose among several.

    Returns None for a user's class that is not loaded and must not be (:class:`Origin`). Raises
    ScenarioError if it does not exist or may not be imported.
    """
    if isinstance(kind, GivenName):
        return _require_part(family, kind, kind.given)
    choices = list_names_of_kind(family, kind)
    if choices:
        return KINDS[family][_choose_name(choices, table)]
    if isinstance(kind, str) and ":" in kind:
        return _require_part(family, kind, find_class(kind, origin))
    slotted = family.startswith("slot ")
    other = family.removeprefix("slot ") if slotted else f"slot {family}"
    if isinstance(kind, str) and kind in {*KINDS.get(other, {})} - {*KINDS[family]}:
        rule, remedy = explain_time_mismatch(slotted), "change the plant or choose another kind"
        raise ScenarioError("kind", rule, kind, remedy)
    kinds, offered = list_kinds(family), offered_kinds()
    if isinstance(kind, str) and kind in offered:
        return _require_part(family, kind, find_offered_class(kind, origin))
    listed = ", ".join(f'"{name}"' for name in kinds)
    others = ", ".join(f'"{name}"' for name in offered)
    raise ScenarioError(
        "kind",
        f"must be one of {listed}" + (f", or of those of packages, {others}" if others else ""),
        kind,
        f'{suggest_nearest(kind, [*kinds, *offered])}choose one, or write "package.module:Class"',
    )


def _choose_name(choices: Mapping[str, Mapping[str, str]], table: Mapping[str, Any]) -> str:
    for name, choice in choices.items():
        if all(table.get(key) == value for key, value in choice.items()):
            return name
    first_choice = next(iter(choices.values()))
    key = next(iter(first_choice))
    listed = ", ".join(f'"{choice[key]}"' for choice in choices.values())
    if key not in table:
        raise ScenarioError(key, "is missing", None, f"add {key}, one of {listed}")
    raise ScenarioError(key, f"must be one of {listed}", table[key], "choose one of them")


def _require_part(family: str, kind: str, cls: Any) -> type[Component] | None:
    if cls is None:
        return None
    base = FAMILIES[family]
    if not (isinstance(cls, type) and issubclass(cls, base)):
        remedy = f"derive the class from netkf.parts.{base.__name__}"
        raise ScenarioError("kind", f"must be a subclass of netkf's {base.__name__}", kind, remedy)
    missing = sorted(
        name
        for name in dir(cls)
        if getattr(getattr(cls, name, None), "__isabstractmethod__", False)
    )
    # A filter has kernels, or says in Python what it does with messages, if it has any.
    talks = getattr(getattr(cls, "timing", None), "talks", True)
    if family == "filter" and getattr(cls, "kernels", None) is None and talks:
        missing += ["absorb"] if vars(base)["absorb"] is getattr(cls, "absorb", None) else []
    rule = f"must define {', '.join(missing)}" if missing else ""
    try:
        if not is_netkf_class(cls):
            require_known_members(cls)
    except ContractError as error:  # a misspelled method is why one is missing
        rule = str(error)
    if rule:
        raise ScenarioError("kind", rule, kind, "write what the contract asks for")
    found: type[Component] = cls
    return found


def name_of(family: str, component: Component) -> str:
    """Return the name of a class in KINDS, of an offered kind, or ``package.module:Class``;
    ``family`` may lack "slot" or "continuous".
    """
    others = (KINDS.get(f"{time} {family}", {}) for time in ("slot", "continuous"))
    for classes in (KINDS[family], *others):
        for name, cls in classes.items():
            if type(component) is cls:
                return name
    for kind in offered_kinds(type(component)):
        if not list_names_of_kind(family, kind) and ":" not in kind:
            return kind
    return f"{type(component).__module__}:{type(component).__qualname__}"


def kind_name(algorithm: Filter) -> str:
    """Return the name of a filter in sentences: that in KINDS, else of its class."""
    name = name_of("filter", algorithm)
    return type(algorithm).__name__.lower() if ":" in name else name
