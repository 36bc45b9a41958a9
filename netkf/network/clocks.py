"""Link clocks: when each link activates by itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.clock import Clock
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    SourceFile,
    choice,
    either,
    integer,
    number,
    positive,
    row,
    setting,
    several,
    source_file,
)
from netkf.core.tables import read_columns, whole
from netkf.network.graphs import Link, Topology, demand_links


@dataclass(frozen=True, eq=False)
class LinkClock(Clock):
    """A clock of links: the contract of ``network.activation`` in continuous time.

    A link is a pair (i, j) with i < j.
    """

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError where the settings do not fit the graph."""


def _accumulate(now: float, gaps: FloatArray) -> FloatArray:
    # One addition a tick, so that the size of a block never shows in a time.
    return np.asarray(np.add.accumulate(np.concatenate([[now], gaps]))[1:])


_rate = number(above=0.0, high=1e9)
_link_rate = row(integer(), integer(), _rate, what="a triple [i, j, rate]")


@dataclass(frozen=True, eq=False)
class Poisson(LinkClock):
    """Independent Poisson processes of ``rate`` ticks a second; ``rates = [[i, j, rate], ...]``
    sets single links over that default.
    """

    rate: float | None = setting(_rate, default=None)
    rates: tuple[tuple[int, int, float], ...] = setting(
        several(_link_rate, "triples [i, j, rate]", least=0), default=()
    )

    @cached_property
    def _by_link(self) -> dict[Link, float]:
        return {(min(i, j), max(i, j)): rate for i, j, rate in self.rates}

    def mean_rate(self, link: Link) -> float:
        """The rate of the link's process."""
        rate = self._by_link.get(link, self.rate)
        return math.nan if rate is None else rate

    @property
    def memoryless(self) -> bool:
        """True."""
        return True

    def ticks(
        self,
        link: Link,
        origin: float,
        index: int,
        now: float,
        random: np.random.Generator,
        count: int,
    ) -> FloatArray:
        """Exponential gaps; a link of twice the rate has the same gaps, halved."""
        return _accumulate(now, random.standard_exponential(count) / self.mean_rate(link))

    def check(self, topology: Topology) -> None:
        """Every link has a rate, and every rate a link, once."""
        links, named = set(topology.links), set()
        for k, (i, j, _) in enumerate(self.rates):
            link = (min(i, j), max(i, j))
            if link not in links or link in named:
                words = "names a link again" if link in named else "must name a link of the graph"
                raise ScenarioError(f"rates[{k}]", words, [i, j], "remove or mend it")
            named.add(link)
        bare = sorted(links - self._by_link.keys())
        if self.rate is None and bare:
            raise ScenarioError(
                "rate",
                f"is missing, and link {bare[0]} has no rate of its own",
                None,
                "add rate = ... as the default of all links",
            )


SHORTEST = 1e-9
"""Seconds; gaps below it are not told apart from rounding."""

PARAMETERS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "gamma": (("shape",), ("mean", "rate", "scale")),
    "weibull": (("shape",), ("mean", "rate", "scale")),
    "uniform": (("low", "high"), ()),
    "constant": ((), ("mean", "rate")),
}
"""What each distribution of gaps needs, and of what it takes exactly one."""


@dataclass(frozen=True, eq=False)
class Renewal(LinkClock):
    """Independent gaps from one ``distribution``.

    gamma and weibull take ``shape`` and one of ``mean`` (seconds), ``rate`` (one over the mean) or
    ``scale``; uniform takes ``low`` and ``high``; constant takes ``mean`` or ``rate``. Gamma or
    weibull gaps of shape 1 are the Poisson clock.
    """

    distribution: str = setting(choice(*PARAMETERS))
    mean: float | None = setting(positive, default=None)
    rate: float | None = setting(_rate, default=None)
    scale: float | None = setting(positive, default=None)
    shape: float | None = setting(number(low=0.1, high=1e6), default=None)
    low: float | None = setting(number(low=0.0), default=None)
    high: float | None = setting(positive, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        needed, one_of = PARAMETERS[self.distribution]
        for name in ("shape", "low", "high", "mean", "rate", "scale"):
            value = getattr(self, name)
            if value is None and name in needed:
                words = f"is missing for {self.distribution} gaps"
                raise ScenarioError(name, words, None, f"add {name} = ...")
            if value is not None and name not in needed + one_of:
                words = f"means nothing for {self.distribution} gaps"
                raise ScenarioError(name, words, value, "remove it")
        given = [name for name in one_of if getattr(self, name) is not None]
        if one_of and len(given) != 1:
            words = f"exactly one of {', '.join(one_of)} must be given"
            raise ScenarioError("mean", words, given, "keep or add one")
        if self.low is not None and self.high is not None and self.high < self.low:
            raise ScenarioError("high", "must be at least low", self.high, "swap the two")
        if self._mean < SHORTEST:
            words = f"gaps must be at least {SHORTEST:g} s on average"
            raise ScenarioError("high" if not one_of else given[0], words, self._mean, "lengthen")

    @property
    def _mean(self) -> float:
        if self.low is not None and self.high is not None:
            return 0.5 * (self.low + self.high)
        if self.scale is not None and self.shape is not None:
            weibull = self.distribution == "weibull"
            unit = math.gamma(1.0 + 1.0 / self.shape) if weibull else self.shape
            return self.scale * unit
        return self.mean if self.mean is not None else 1.0 / (self.rate or math.nan)

    def mean_rate(self, link: Link) -> float:
        """One over the mean gap."""
        return 1.0 / self._mean

    @property
    def memoryless(self) -> bool:
        """Only gamma and weibull gaps of shape 1."""
        return self.shape == 1.0

    def ticks(
        self,
        link: Link,
        origin: float,
        index: int,
        now: float,
        random: np.random.Generator,
        count: int,
    ) -> FloatArray:
        """Gaps of the distribution, added up."""
        shape = self.shape or 1.0
        if self.distribution == "gamma":
            gaps = random.standard_gamma(shape, count)
            gaps = gaps / (shape * self.rate) if self.rate else gaps * (self._mean / shape)
        elif self.distribution == "weibull":
            scale = self._mean / math.gamma(1.0 + 1.0 / shape)
            gaps = random.standard_exponential(count) ** (1.0 / shape) * scale
        elif self.distribution == "uniform":
            assert self.low is not None
            assert self.high is not None
            gaps = self.low + (self.high - self.low) * random.random(count)
        else:
            return _lattice(0.0, self._mean, index + 1, count)
        return _accumulate(now, gaps)


def _lattice(phase: float, period: float, first: int, count: int) -> FloatArray:
    # Rounded so that lattices whose periods are multiples of each other meet exactly.
    return np.round(phase + period * np.arange(first, first + count), 12)


@dataclass(frozen=True, eq=False)
class Periodic(LinkClock):
    """Ticks at ``phase + k period``, each delayed by a uniform time in [0, ``jitter``).

    ``phase`` is a time in [0, period) or "random", one draw a link; nothing ticks at time 0.
    """

    period: float = setting(number(low=SHORTEST))
    phase: float | str = setting(
        either(number(low=0.0), choice("random"), lambda value: isinstance(value, str)), default=0.0
    )
    jitter: float = setting(number(low=0.0), default=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("phase", "jitter"):
            value = getattr(self, name)
            if isinstance(value, float) and value >= self.period:
                raise ScenarioError(name, "must be below the period", value, "give less")

    def origin(self, link: Link, random: Callable[[], np.random.Generator]) -> float:
        """The phase."""
        if isinstance(self.phase, str):
            return self.period * float(random().random())
        return self.phase

    def mean_rate(self, link: Link) -> float:
        """One over the period."""
        return 1.0 / self.period

    def ticks(
        self,
        link: Link,
        origin: float,
        index: int,
        now: float,
        random: np.random.Generator,
        count: int,
    ) -> FloatArray:
        """The lattice, shifted by the jitter."""
        times = _lattice(origin, self.period, index + (origin == 0.0), count)
        return times + self.jitter * random.random(count) if self.jitter > 0.0 else times


@dataclass(frozen=True, eq=False)
class RecordedClock(LinkClock):
    """Ticks read from a table ``t,node,peer``; a link listed twice at one time ticks once."""

    path: SourceFile = setting(source_file)

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self._times  # a bad file is refused now

    @cached_property
    def _times(self) -> dict[Link, FloatArray]:
        table = read_columns(self.path, ("t", "node", "peer"))
        nodes, peers = (whole(self.path, name, table[name]) for name in ("node", "peer"))
        early = np.flatnonzero(table["t"] <= 0.0)
        if early.size:
            raise ScenarioError(
                "path",
                f"{self.path.name}: t must be above 0, nothing is sent at time 0",
                float(table["t"][early[0]]),
                "shift the times or remove the row",
            )
        times: dict[Link, list[float]] = {}
        for t, i, j in zip(table["t"].tolist(), nodes, peers, strict=True):
            times.setdefault((min(i, j), max(i, j)), []).append(t)
        return {link: np.unique(values) for link, values in times.items()}

    def ticks(
        self,
        link: Link,
        origin: float,
        index: int,
        now: float,
        random: np.random.Generator,
        count: int,
    ) -> FloatArray:
        """The recorded times."""
        return self._times.get(link, np.empty(0))[index : index + count]

    def check(self, topology: Topology) -> None:
        """Every recorded pair is a link."""
        demand_links(self.path, self._times, topology)
