"""The search of ``netkf.size``: a bisection whose values are decided by theory or simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from netkf.ensembles.blocks import BlockTask
from netkf.ensembles.pools import Pool
from netkf.ensembles.replicas import replicate_blocks
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import central_trace, join_metrics
from netkf.studies.targets import Target, quantity_by_simulation, quantity_by_theory

if TYPE_CHECKING:
    import pandas as pd

REACHED, MISSED, UNDECIDED = "reached", "missed", "undecided"
FIRST_BATCH = 32
CLOSE = 1.25
"""Ratio of values below which the search ends once one of them is undecided."""
MAX_PROBES = {"theory": 40, "simulation": 16}
DIGITS = {"theory": 4, "simulation": 2}
"""Significant digits of the values that are tried."""


class Probe(NamedTuple):
    """A value that was tried: the quantity there with the ends of its interval, the number of runs,
    and whether the target was reached, missed or is undecided.
    """

    value: float
    quantity: float
    low: float
    high: float
    runs: int
    target: str


@dataclass(frozen=True)
class Sizing:
    """The result of a search; true if a value reaches the target.

    ``value`` is the smallest value that reaches it (``grows`` False: the quantity falls as the key
    grows) or the largest one, ``misses`` the nearest value that was not shown to reach it; None if
    there is none. ``quantity`` says what was computed, ``sure`` how sure the result is and what was
    assumed.
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
        """One row per value that was tried, in order."""
        import pandas as pd

        return pd.DataFrame(sorted(self.probes), columns=list(Probe._fields))


@dataclass(frozen=True)
class SizingProblem:
    """The key of a scenario to search, an integer or not, and the target; ``by`` is theory or
    simulation.
    """

    scenario: Scenario
    key: str
    integer: bool
    target: Target
    by: str

    def at(self, value: float) -> Scenario:
        """Return the scenario with a value of the key."""
        return self.scenario.replace({self.key: value})


@dataclass(frozen=True)
class SimulationPlan:
    """How a value is decided by simulation: at most ``runs`` runs of ``task`` on a pool, each
    interval missing with probability ``level``.
    """

    task: BlockTask
    runs: int
    level: float
    pool: Pool
    progress: Callable[[str], None] | None = None


def decide_by_theory(problem: SizingProblem, value: float) -> Probe:
    """Return the probe of a value from a bound or an exact quantity."""
    quantity, _ = quantity_by_theory(problem.at(value), problem.target)
    reached = quantity <= problem.target.limit
    return Probe(value, quantity, quantity, quantity, 0, REACHED if reached else MISSED)


def decide_by_simulation(problem: SizingProblem, plan: SimulationPlan, value: float) -> Probe:
    """Return the probe of a value from simulations: the number of runs is doubled until the
    interval of the quantity is on one side of the limit.
    """
    scenario, target = problem.at(value), problem.target
    central = central_trace(scenario) if target.quantity == "within_central" else None
    done, found = 0, []
    while True:
        batch = min(max(FIRST_BATCH, done), plan.runs - done)
        found.append(
            replicate_blocks(plan.task, join_metrics, scenario, batch, first=done, pool=plan.pool)
        )
        done += batch
        interval = quantity_by_simulation(join_metrics(*found), target, plan.level, central)
        state = UNDECIDED
        if interval.high <= target.limit:
            state = REACHED
        elif not interval.low <= target.limit:  # also if it is not a number
            state = MISSED
        if plan.progress is not None:
            plan.progress(f"{problem.key} = {value:g}: {done} runs, {state}")
        if state != UNDECIDED or done >= plan.runs:
            return Probe(value, *interval, done, state)


class Search:
    """A bisection between two values of a key, which keeps all probes."""

    def __init__(self, problem: SizingProblem, decide: Callable[[float], Probe]) -> None:
        self._problem, self._decide = problem, decide
        self.probes: list[Probe] = []

    def run(self, low: float, high: float, confidence: float, quantity: str) -> Sizing:
        """Search between two values and return the result; ``quantity`` describes the quantity."""
        first, last = self._try(low), self._try(high)
        grows = last.quantity > first.quantity
        good, bad = (first, last) if grows else (last, first)
        value: float | None = None
        misses: float | None = None
        if bad.target == REACHED:
            value = bad.value
        elif good.target == REACHED:
            value, misses = self._bisect(good.value, bad.value)
        else:
            misses = good.value
            # One more value shows whether the quantity is monotone at all.
            self._try(self._middle(low, high) or low)
        problem, probes = self._problem, tuple(self.probes)
        return Sizing(
            problem.key,
            problem.target,
            problem.by,
            value,
            misses,
            grows,
            confidence,
            probes,
            quantity,
            _describe_certainty(probes, problem.by, confidence, grows, value is None),
        )

    def _bisect(self, value: float, misses: float) -> tuple[float, float]:
        """Return the values next to the limit, one that reaches the target and one that does not,
        from two such values.
        """
        while len(self.probes) < MAX_PROBES[self._problem.by]:
            middle = self._middle(*sorted((value, misses)))
            if middle is None:
                break
            reached = self._try(middle).target == REACHED
            value, misses = (middle, misses) if reached else (value, middle)
            # Noise hides the limit near a value that stayed undecided.
            if self._is_undecided(misses) and max(value, misses) <= CLOSE * min(value, misses):
                break
        return value, misses

    def _is_undecided(self, value: float) -> bool:
        return any(p.value == value and p.target == UNDECIDED for p in self.probes)

    def _try(self, value: float) -> Probe:
        self.probes.append(self._decide(value))
        return self.probes[-1]

    def _middle(self, low: float, high: float) -> float | None:
        """Return a value between two, an integer or rounded to DIGITS; None if there is none."""
        if self._problem.integer:
            middle = (low + high) // 2
            return int(middle) if low < middle < high else None
        # A range of several octaves is halved on a logarithmic scale.
        wide = low > 0.0 and high > 2.0 * low
        middle = math.sqrt(low * high) if wide else 0.5 * (low + high)
        middle = float(f"{middle:.{DIGITS[self._problem.by]}g}")
        return middle if low < middle < high else None


def _describe_certainty(
    probes: tuple[Probe, ...], by: str, confidence: float, grows: bool, none_reached: bool
) -> str:
    """Return how sure the answer is and what was assumed."""
    if by == "theory":
        certainty = "computed, no simulation"
    else:
        certainty = f"all decisions together are right with probability {confidence:g}"
        if any(probe.target == UNDECIDED for probe in probes):
            certainty += (
                "; values that stayed undecided count as not reaching it (more --runs help)"
            )
    for one, other in pairwise(sorted(probes)):
        turned = one.low > other.high if grows else one.high < other.low
        if turned:
            return (
                f"{certainty}; NOT monotone between {one.value:g} and {other.value:g}: "
                "other values may reach it too, narrow the range"
            )
    tried = "at the ends and in the middle" if none_reached else f"at {len(probes)} values"
    return f"{certainty}; taken to be monotone, as it was {tried}"
