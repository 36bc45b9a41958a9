"""Clocks that activate links, directions or nodes of the network."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator

from netkf.core.clock import Clock, Entity
from netkf.core.csv_files import Columns, read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Rule,
    SourceFile,
    either,
    field,
    list_of,
    node_id,
    number,
    of_time,
    one_of,
    positive,
    source_file,
    tuple_of,
)
from netkf.core.instants import OnGrid
from netkf.core.laws import EXPONENTIAL, Lattice, WaitingLaw, gamma_law, uniform_law, weibull_law
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Topology, demand_links, demand_nodes

AT = ("links", "directions", "nodes")
"""The entities that have a clock: every link, every direction of a link, or every node."""


@dataclass(frozen=True, eq=False)
class LinkClock(Clock, OnGrid):
    """The contract of a clock that activates the network, see Clock.

    ``at`` selects the entities that have a clock each. "links": both ends exchange; an entity is
    (i, j) with i < j. "directions": the sender pushes; an entity is (sender, receiver). "nodes":
    the node broadcasts to every neighbour; an entity is (node,).
    """

    at: str = field(one_of(*AT), default="links")

    def entities(self, topology: Topology) -> tuple[Entity, ...]:
        """Return the entities that have a clock, in the order in which simultaneous ticks happen:
        node ids (i, j) of links, (sender, receiver) of directions, or (node,).
        """
        if self.at == "nodes":
            return tuple((node,) for node in topology.nodes)
        return topology.directions if self.at == "directions" else topology.links

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the fields do not fit the graph."""


@dataclass(frozen=True, eq=False)
class OnReadings(LinkClock):
    """A node transmits whenever it has taken a sample, after using it; no clock ticks."""

    at: str = dataclasses.field(init=False, default="readings")

    def entities(self, topology: Topology) -> tuple[Entity, ...]:
        """Return no entities: no clock ticks."""
        return ()

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return no ticks (0,)."""
        return np.empty(0)


def _accumulate(now: float, gaps: FloatArray) -> FloatArray:
    """Return the ticks (K,) ``now + gaps[0] + ... + gaps[k]`` from ``gaps`` (K,), in seconds."""
    # Added one after the other from ``now``: times do not depend on how many are drawn at once.
    return np.asarray(np.add.accumulate(np.concatenate([[now], gaps]))[1:])


_rate = number(above=0.0, high=1e9)
_link_rate = tuple_of(node_id(), node_id(), _rate, description="a triple [i, j, rate]")
_node_rate = tuple_of(node_id(), _rate, description="a pair [i, rate]")


def _one_rate(value: Any) -> tuple[float, ...]:
    # Which of the two it must be depends on `at`; the clock checks that.
    single = isinstance(value, (list, tuple, np.ndarray)) and len(value) == 2
    rates: tuple[float, ...] = (_node_rate if single else _link_rate).convert(value)
    return rates


_entity_rate = Rule(
    _link_rate.requirement,
    _one_rate,
    _link_rate.remedy,
    {"anyOf": [dict(_link_rate.schema), dict(_node_rate.schema)]},
    of_nodes=True,
)


@dataclass(frozen=True, eq=False)
class Poisson(LinkClock):
    """Independent Poisson processes of ``rate`` ticks per second.

    ``rates = [[i, j, rate], ...]`` overrides the rate of single links or directions, and
    ``[[i, rate], ...]`` of single nodes.
    """

    memoryless = True

    rate: float | None = field(_rate, default=None)
    rates: tuple[tuple[float, ...], ...] = field(
        list_of(_entity_rate, "triples [i, j, rate]", min_length=0), default=()
    )

    def __post_init__(self) -> None:
        """Check the fields; raises ScenarioError for ``rates`` that do not fit ``at``."""
        super().__post_init__()
        length, rule = (2, _node_rate) if self.at == "nodes" else (3, _link_rate)
        for k, entry in enumerate(self.rates):
            if len(entry) != length:
                rate = entry[-1]
                printed = [*entry[:-1], int(rate) if float(rate).is_integer() else rate]
                remedy = f'{rule.remedy}, because at = "{self.at}"'
                raise ScenarioError(f"rates[{k}]", rule.requirement, printed, remedy)

    @cached_property
    def _entity_rates(self) -> dict[Entity, float]:
        return {self._entity_of(entry): entry[-1] for entry in self.rates}

    def _entity_of(self, entry: tuple[float, ...]) -> Entity:
        ids = tuple(int(number) for number in entry[:-1])
        return tuple(sorted(ids)) if self.at == "links" else ids

    def mean_rate(self, entity: Entity) -> float:
        """Return the rate of the process of ``entity``, in ticks per second; nan if it has none."""
        rate = self._entity_rates.get(entity, self.rate)
        return math.nan if rate is None else rate

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return the next ``count`` ticks (count,) of ``entity`` in seconds."""
        return _accumulate(now, random.standard_exponential(count) / self.mean_rate(entity))

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every entity has a rate and every rate has one entity."""
        entities, listed = set(self.entities(topology)), set()
        what = self.at.removesuffix("s")
        for k, entry in enumerate(self.rates):
            entity = self._entity_of(entry)
            if entity not in entities or entity in listed:
                again = f"names a {what} again"
                rule = again if entity in listed else f"must name a {what} of the graph"
                raise ScenarioError(f"rates[{k}]", rule, list(entry[:-1]), "correct it")
            listed.add(entity)
        # Without a default rate each entity needs one of its own.
        unlisted = sorted(entities - listed)
        if self.rate is None and unlisted:
            first = unlisted[0][0] if len(unlisted[0]) == 1 else unlisted[0]
            raise ScenarioError(
                "rate",
                f"is missing, and {what} {first} has no rate of its own",
                None,
                f"add rate = ... as the default of all {self.at}",
            )


MIN_GAP = 1e-9
"""The shortest allowed gap in seconds; shorter ones could not be told from rounding."""

PARAMETERS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "gamma": (("shape",), ("mean", "rate", "scale")),
    "weibull": (("shape",), ("mean", "rate", "scale")),
    "uniform": (("low", "high"), ()),
    "constant": ((), ("mean", "rate")),
}
"""The required fields of each distribution, and the fields of which it takes exactly one."""


@dataclass(frozen=True, eq=False)
class Renewal(LinkClock):
    """A renewal process: independent gaps from one ``distribution``.

    gamma and weibull take ``shape`` and one of ``mean`` (seconds), ``rate`` (one over the mean) or
    ``scale``; uniform takes ``low`` and ``high``; constant takes ``mean`` or ``rate``. Gamma or
    weibull gaps of shape 1 are the Poisson clock.
    """

    distribution: str = field(one_of(*PARAMETERS))
    mean: float | None = field(of_time(positive), default=None)
    rate: float | None = field(_rate, default=None)
    scale: float | None = field(positive, default=None)
    shape: float | None = field(number(low=0.1, high=1e6), default=None)
    low: float | None = field(number(low=0.0), default=None)
    high: float | None = field(positive, default=None)

    def __post_init__(self) -> None:
        """Check the fields; raises ScenarioError for a parameter that the distribution lacks or
        does not take, and for gaps below MIN_GAP seconds on average.
        """
        super().__post_init__()
        needed, one_of = PARAMETERS[self.distribution]
        for name in ("shape", "low", "high", "mean", "rate", "scale"):
            value = getattr(self, name)
            if value is None and name in needed:
                rule = f"is missing for {self.distribution} gaps"
                raise ScenarioError(name, rule, None, f"add {name} = ...")
            if value is not None and name not in needed + one_of:
                rule = f"means nothing for {self.distribution} gaps"
                raise ScenarioError(name, rule, value, "remove it")
        # Of mean, rate and scale the distribution takes one, or none at all (uniform).
        names = [name for name in one_of if getattr(self, name) is not None]
        if one_of and len(names) != 1:
            rule = f"exactly one of {', '.join(one_of)} must be given"
            raise ScenarioError("mean", rule, names, "keep or add one")
        if self.low is not None and self.high is not None and self.high < self.low:
            raise ScenarioError("high", "must be at least low", self.high, "swap the two")
        if self.mean_gap < MIN_GAP:
            rule = f"gaps must be at least {MIN_GAP:g} s on average"
            raise ScenarioError("high" if not one_of else names[0], rule, self.mean_gap, "lengthen")

    @property
    def mean_gap(self) -> float:
        """Mean gap in seconds."""
        if self.low is not None and self.high is not None:
            return 0.5 * (self.low + self.high)
        if self.scale is not None and self.shape is not None:
            weibull = self.distribution == "weibull"
            mean_of_unit_scale = math.gamma(1.0 + 1.0 / self.shape) if weibull else self.shape
            return self.scale * mean_of_unit_scale
        return self.mean if self.mean is not None else 1.0 / (self.rate or math.nan)

    @property
    def gamma_scale(self) -> tuple[float, float]:
        """The divisor and the factor that make a gap, seconds, of a gamma number of scale 1."""
        shape = self.shape or 1.0
        return (shape * self.rate, 1.0) if self.rate else (1.0, self.mean_gap / shape)

    @property
    def weibull_scale(self) -> float:
        """The factor that makes a gap, seconds, of a Weibull number of scale 1."""
        return self.mean_gap / math.gamma(1.0 + 1.0 / (self.shape or 1.0))

    def mean_rate(self, entity: Entity) -> float:
        """Return one over the mean gap, in ticks per second."""
        return 1.0 / self.mean_gap

    @property
    def memoryless(self) -> bool:
        """True for gamma and weibull gaps of shape 1, which are exponential."""
        return self.shape == 1.0

    @property
    def gaps(self) -> WaitingLaw | Lattice:
        """The law of gaps in units of their mean, or the lattice of constant ones."""
        if self.memoryless:
            return EXPONENTIAL
        if self.shape is not None:
            return (gamma_law if self.distribution == "gamma" else weibull_law)(self.shape)
        if self.low is not None and self.high is not None and self.low < self.high:
            return uniform_law(self.low / self.mean_gap, self.high / self.mean_gap)
        return Lattice(self.mean_gap, self.mean_gap)  # the first tick is one gap after time 0

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return the next ``count`` ticks (count,) in seconds, after the last one at ``now``."""
        # Gaps of unit scale, scaled to their mean.
        shape = self.shape or 1.0
        if self.distribution == "gamma":
            divisor, factor = self.gamma_scale
            gaps = random.standard_gamma(shape, count) / divisor * factor
        elif self.distribution == "weibull":
            # One by one: numpy's powers of arrays differ in the last bit from one CPU to another.
            drawn = random.standard_exponential(count).tolist()
            gaps = np.array([math.pow(gap, 1.0 / shape) for gap in drawn]) * self.weibull_scale
        elif self.distribution == "uniform":
            assert self.low is not None
            assert self.high is not None
            gaps = self.low + (self.high - self.low) * random.random(count)
        else:
            # Tick number 0 is at one gap after time 0, as nothing is sent at time 0. From its
            # number and not from the tick before: rounding does not add up.
            return np.asarray(self.mean_gap * np.arange(index + 1, index + 1 + count))
        return _accumulate(now, gaps)


@dataclass(frozen=True, eq=False)
class Periodic(LinkClock):
    """Ticks at ``phase + k period``, each delayed by a uniform time in [0, ``jitter``).

    ``phase`` is a time in [0, period) or "random", one draw a link; nothing ticks at time 0.
    """

    period: float = field(of_time(number(low=MIN_GAP)))
    phase: float | str = field(
        of_time(either(number(low=0.0), one_of("random"), lambda value: isinstance(value, str))),
        default=0.0,
    )
    jitter: float = field(number(low=0.0), default=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("phase", "jitter"):
            value = getattr(self, name)
            if isinstance(value, float) and value >= self.period:
                raise ScenarioError(name, "must be below the period", value, "give less")

    def origin(self, entity: Entity, random: Callable[[], Generator]) -> float:
        """Return the phase in seconds, the time from which the ticks of ``entity`` are counted."""
        if isinstance(self.phase, str):
            return self.period * float(random().random())
        return self.phase

    def mean_rate(self, entity: Entity) -> float:
        """Return one over the period, in ticks per second."""
        return 1.0 / self.period

    @property
    def gaps(self) -> Lattice:
        """The lattice of the ticks: with phase 0 it begins one period after time 0."""
        if isinstance(self.phase, str):
            return Lattice(self.period, 0.0, self.jitter, random_phase=True)
        return Lattice(self.period, self.phase or self.period, self.jitter)

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return the ticks (count,) of an entity in seconds from number ``index`` on."""
        # With phase 0 the lattice point at time 0 is no tick.
        first = index + (origin == 0.0)
        times = np.asarray(origin + self.period * np.arange(first, first + count))
        return times + self.jitter * random.random(count) if self.jitter > 0.0 else times


@dataclass(frozen=True, eq=False)
class RecordedClock(LinkClock):
    """Ticks read from a table ``t,node,peer`` (from node to peer), or ``t,node`` for nodes.

    An entity that is listed twice at one time ticks once.
    """

    path: SourceFile = field(source_file)

    grid_values: ClassVar[tuple[str, ...]] = ("_instants",)

    _reads = "_instants"

    @property
    def _ends(self) -> tuple[str, ...]:
        return ("node",) if self.at == "nodes" else ("node", "peer")

    @cached_property
    def _table(self) -> Columns:
        if self.at == "nodes" and "peer" in read_header(self.path):
            raise ScenarioError(
                "path",
                f'{self.path.name} must have no column peer, because at = "nodes"',
                None,
                'set at = "directions", or rename the column',
            )
        table = read_columns(self.path, ("t", *self._ends))
        early = np.flatnonzero(table["t"] <= 0.0)
        table.refuse_early(early, "t must be above 0, nothing is sent at time 0")
        return table

    @cached_property
    def _instants(self) -> dict[Entity, FloatArray]:
        """Increasing distinct times (K,) of each entity, in seconds."""
        times: dict[Entity, list[float]] = {}
        for entity, t in self.row_keys:
            if t > 0.0:
                times.setdefault(entity, []).append(t)
        snap = self.time_grid.snap
        return {entity: np.unique(snap(np.array(t))) for entity, t in times.items()}

    @property
    def all_apart(self) -> bool:
        """True if no two entities tick at one time."""
        times = np.concatenate([np.empty(0), *self._instants.values()])
        return len(np.unique(times)) == len(times)

    @property
    def rows(self) -> FloatArray:
        """The times (K,) of all rows in seconds, in the order of the table."""
        return self._table["t"]

    @cached_property
    def row_keys(self) -> list[tuple[Entity, float]]:
        """The entity and the time (s) of each row, in order; equal ones are one tick."""
        entities: Iterable[Entity] = zip(*map(self._table.integers, self._ends), strict=True)
        if self.at == "links":
            entities = ((min(entity), max(entity)) for entity in entities)
        return list(zip(entities, self.rows.tolist(), strict=True))

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return up to ``count`` recorded times (<= count,) of ``entity`` in seconds."""
        return self._instants.get(entity, np.empty(0))[index : index + count]

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless the graph has every entity that the table lists."""
        if self.at == "nodes":
            demand_nodes(self._table, topology.index)
        else:
            demand_links(self._table, topology, "node", "peer")
