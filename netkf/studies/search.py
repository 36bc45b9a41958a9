"""The search behind ``netkf.size``: values of a key, each decided by theory or by simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from netkf.ensembles.replicas import replicate_blocks
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import central_trace, join_metrics
from netkf.studies.targets import Target, by_simulation, by_theory

if TYPE_CHECKING:
    import pandas as pd

REACHED, MISSED, UNDECIDED = "reached", "missed", "undecided"
FIRST_BATCH = 32
CLOSE = 1.25
"""Values whose ratio is below it are not told apart further once one of them is undecided."""
MOST_PROBES = {"theory": 40, "simulation": 16}
DIGITS = {"theory": 4, "simulation": 2}
"""Significant digits of the values that are tried."""


class Probe(NamedTuple):
    """One value that was tried: the quantity there, between what it lies, runs, and what of it."""

    value: float
    quantity: float
    low: float
    high: float
    runs: int
    target: str


@dataclass(frozen=True)
class Sizing:
    """What came of a search; true where a value reaches the target.

    ``value`` reaches it and is the smallest (``grows`` False: the quantity falls as the key grows)
    or the largest such value, ``misses`` the nearest that was not shown to; both None where there
    is none. ``quantity`` says what was computed, ``sure`` how sure it is and what was assumed.
    """

    key: str
    target: Target
    by: str
    value: float | int | None
    misses: float | int | None
    grows: bool
    confidence: float
    probes: tuple[Probe, ...]
    quantity: str
    sure: str

    def __bool__(self) -> bool:
        return self.value is not None

    @property
    def table(self) -> pd.DataFrame:
        """A row a value that was tried, in order."""
        import pandas as pd

        return pd.DataFrame(sorted(self.probes), columns=list(Probe._fields))


class Search:
    """Tries values of a key and remembers what came of them."""

    def __init__(
        self,
        scenario: Scenario,
        key: str,
        target: Target,
        whole: bool,
        by: str,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        self._scenario, self._key, self._target = scenario, key, target
        self._whole, self._by = whole, by
        self._progress = progress or (lambda _: None)
        self.probes: list[Probe] = []

    def theory(self, value: float) -> Probe:
        """Decide by theory."""
        quantity, _ = by_theory(self._scenario.replace({self._key: value}), self._target)
        word = REACHED if quantity <= self._target.limit else MISSED
        return Probe(value, quantity, quantity, quantity, 0, word)

    def simulation(
        self, value: float, task: Any, runs: int, level: float, handed: dict[str, Any]
    ) -> Probe:
        """Decide by simulation: twice as many runs until the interval is on one side."""
        scenario = self._scenario.replace({self._key: value})
        central = central_trace(scenario) if self._target.quantity == "within_central" else None
        done, found = 0, []
        while True:
            batch = min(max(FIRST_BATCH, done), runs - done)
            found.append(
                replicate_blocks(task, join_metrics, scenario, batch, first=done, **handed)
            )
            done += batch
            interval = by_simulation(join_metrics(*found), self._target, level, central)
            word = UNDECIDED
            if interval.high <= self._target.limit:
                word = REACHED
            elif not interval.low <= self._target.limit:
                word = MISSED
            self._progress(f"{self._key} = {value:g}: {done} runs, {word}")
            if word != UNDECIDED or done >= runs:
                return Probe(value, *interval, done, word)

    def found(
        self,
        low: float,
        high: float,
        decide: Callable[[float], Probe],
        confidence: float,
        quantity: str,
    ) -> Sizing:
        """Both ends, then halves of what is left between a value that reaches and one that does
        not.
        """
        first, last = (self._tried(end, decide) for end in (low, high))
        grows = last.quantity > first.quantity
        good, bad = (first, last) if grows else (last, first)
        value: float | None = None
        misses: float | None = None
        if bad.target == REACHED:
            value = bad.value
        elif good.target == REACHED:
            value, misses = good.value, bad.value
            for middle in self._between(good.value, bad.value):
                if middle is None:
                    break
                reached = self._tried(middle, decide).target == REACHED
                value, misses = (middle, misses) if reached else (value, middle)
                self._ends = value, misses
                if self._blurred(misses) and max(value, misses) <= CLOSE * min(value, misses):
                    break
        else:
            misses = good.value
            self._tried(self._middle(low, high) or low, decide)
        probes = tuple(self.probes)
        words = _sureness(probes, self._by, confidence, grows, value is None)
        return Sizing(
            self._key,
            self._target,
            self._by,
            value,
            misses,
            grows,
            confidence,
            probes,
            quantity,
            words,
        )

    def _between(self, good: float, bad: float) -> Iterator[float | None]:
        self._ends = good, bad
        while len(self.probes) < MOST_PROBES[self._by]:
            yield self._middle(*sorted(self._ends))

    def _blurred(self, value: float) -> bool:
        """Whether a value stayed undecided: then noise hides where the target is reached."""
        return any(p.value == value and p.target == UNDECIDED for p in self.probes)

    def _tried(self, value: float, decide: Callable[[float], Probe]) -> Probe:
        self.probes.append(decide(value))
        return self.probes[-1]

    def _middle(self, low: float, high: float) -> float | None:
        """A value between, on the grid of integers or of significant digits; None without one."""
        if self._whole:
            middle = (low + high) // 2
            return int(middle) if low < middle < high else None
        far = low > 0.0 and high > 2.0 * low
        middle = math.sqrt(low * high) if far else 0.5 * (low + high)
        middle = float(f"{middle:.{DIGITS[self._by]}g}")
        return middle if low < middle < high else None


def _sureness(
    probes: tuple[Probe, ...], by: str, confidence: float, grows: bool, nothing: bool
) -> str:
    """How sure the answer is and what was assumed."""
    if by == "theory":
        words = "computed, no simulation"
    else:
        words = f"all decisions together are right with probability {confidence:g}"
        if any(probe.target == UNDECIDED for probe in probes):
            words += "; values that stayed undecided count as not reaching it (more --runs help)"
    inside = "at the ends and in the middle" if nothing else f"at {len(probes)} values"
    ordered = sorted(probes)
    for one, other in pairwise(ordered):
        turned = one.low > other.high if grows else one.high < other.low
        if turned:
            return (
                f"{words}; NOT monotone between {one.value:g} and {other.value:g}: "
                "other values may reach it too, narrow the range"
            )
    return f"{words}; taken to be monotone, as it was {inside}"
