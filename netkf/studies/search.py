"""The search of ``netkf.size``: a bisection whose values are decided by theory or simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from netkf.core.errors import ScenarioError
from netkf.core.notebook import NotebookTable
from netkf.ensembles.blocks import BlockTask
from netkf.ensembles.pools import Pool
from netkf.ensembles.replicas import replicate_blocks
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import central_trace, join_metrics
from netkf.studies.targets import (
    Target,
    quantity_by_simulation,
    quantity_by_theory,
    theory_is_exact,
)

if TYPE_CHECKING:
    import pandas as pd

REACHED, MISSED, UNDECIDED, NOT_SHOWN = "reached", "missed", "undecided", "not shown"
"""What was found of a value; ``not shown``: a bound is above the limit, which proves nothing."""
FIRST_BATCH, FIRST_EXPECTED = 32, 8
"""Runs before the first look at a value, and those of expected squared errors."""
END_RATIO = 1.25
"""Ratio of values below which the search ends once one of them is undecided."""
MAX_PROBES = {"theory": 40, "simulation": 16, "both": 16}
DIGITS = {"theory": 4, "simulation": 2, "both": 2}
"""Significant digits of the values that are tried."""
EXACT, BOUND, SIMULATION = "exact", "bound", "simulation"
"""How a value was decided."""


MAX_EXTRAPOLATION, MARGIN = 100.0, 1.5
"""Factor beyond the range up to which a next range is advised, and the safety on its exponent."""
MAX_RUNS, FUTILE = 1e7, 10.0
"""Runs beyond which no number is advised; multiple of the runs at which a value is given up."""


class Probe(NamedTuple):
    """A value that was tried: the quantity there with the ends of its interval, the number of runs,
    whether the target was reached or missed, is undecided or not shown, and how that was decided:
    by the exact quantity, by a bound or by simulation. A bound is the upper end of its interval.
    """

    value: float
    quantity: float
    low: float
    high: float
    runs: int
    target: str
    by: str = SIMULATION


@dataclass(frozen=True)
class Sizing(NotebookTable):
    """The result of a search; true if a value reaches the target.

    ``value`` is the smallest value that reaches it (``grows`` False: the quantity falls as the key
    grows) or the largest one, ``misses`` the nearest value that was not shown to reach it; None if
    there is none. ``by`` is theory, simulation, or both: a bound where it reaches the target, and
    simulation elsewhere. ``quantity`` says what was computed, ``sure`` how sure the result is and
    what was assumed, ``advice`` what to try next (empty if nothing).
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
    advice: str = ""

    def __bool__(self) -> bool:
        return self.value is not None

    def __repr__(self) -> str:
        found = "no value reaches" if self.value is None else f"{self.value:.6g} reaches"
        return f"<netkf size of {self.key}: {found} {self.target}, by {self.by}>"

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
    """How a value is decided by simulation: at most ``runs`` runs of ``task`` on a pool, ``first``
    of them before the first look, each interval missing with probability ``level``.
    """

    task: BlockTask
    runs: int
    level: float
    pool: Pool
    progress: Callable[[str], None] | None = None
    first: int = FIRST_BATCH


def decide_by_theory(problem: SizingProblem, value: float) -> Probe:
    """Return the probe of a value from a bound or an exact quantity."""
    scenario, target = problem.at(value), problem.target
    quantity, _ = quantity_by_theory(scenario, target)
    reached = quantity <= target.limit
    if theory_is_exact(scenario, target):
        state = REACHED if reached else MISSED
        return Probe(value, quantity, quantity, quantity, 0, state, EXACT)
    return Probe(value, quantity, 0.0, quantity, 0, REACHED if reached else NOT_SHOWN, BOUND)


def decide_by_both(problem: SizingProblem, plan: SimulationPlan, value: float) -> Probe:
    """Return the probe of a value from a bound if that reaches the target, else by simulation."""
    found = decide_by_theory(problem, value)
    return decide_by_simulation(problem, plan, value) if found.target == NOT_SHOWN else found


def decide_by_simulation(problem: SizingProblem, plan: SimulationPlan, value: float) -> Probe:
    """Return the probe of a value from simulations: the number of runs is doubled until the
    interval of the quantity is on one side of the limit.
    """
    scenario, target = problem.at(value), problem.target
    central = central_trace(scenario) if target.quantity == "within_central" else None
    done, found = 0, []
    if plan.progress is not None:
        plan.progress(f"{problem.key} = {value:g}: simulating")
    while True:
        batch = min(max(plan.first, done), plan.runs - done)
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
            plan.progress(
                f"{problem.key} = {value:g}: {target.quantity} {interval.value:.4g}, between "
                f"{interval.low:.4g} and {interval.high:.4g} after {done:,} of at most "
                f"{plan.runs:,} runs, {state}"
            )
        probe = Probe(value, *interval, done, state)
        if state != UNDECIDED or done >= plan.runs or _is_futile(probe, target, plan.runs):
            return probe


def _is_futile(probe: Probe, target: Target, runs: int) -> bool:
    """Return True if a quarter of the runs says that ten times as many would not decide."""
    return probe.runs >= runs // 4 and _runs_to_decide(probe, target) > FUTILE * runs


def _runs_to_decide(probe: Probe, target: Target) -> float:
    """Return how many runs would decide an undecided value, if its estimate is right."""
    width, distance = 0.5 * (probe.high - probe.low), abs(probe.quantity - target.limit)
    if not math.isfinite(width):
        return math.nan
    return 1.1 * probe.runs * (width / distance) ** 2 if distance > 0.0 else math.inf


class Search:
    """A bisection between two values of a key, which keeps all probes."""

    def __init__(self, problem: SizingProblem, decide: Callable[[float], Probe]) -> None:
        self._problem, self._decide = problem, decide
        self.probes: list[Probe] = []

    def run(self, low: float, high: float, confidence: float, quantity: str) -> Sizing:
        """Search between two values and return the result; ``quantity`` describes the quantity."""
        first, last = self._probe(low), self._probe(high)
        grows = self._detect_growth(first, last)
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
            self._probe(self._value_between(low, high) or low)
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
            _describe_certainty(probes, confidence, grows, value is None),
            advise(problem, probes, value, misses, grows),
        )

    def _detect_growth(self, first: Probe, last: Probe) -> bool:
        """Return True if the quantity grows with the key; bounds are compared with bounds only."""
        if BOUND in (first.by, last.by) and first.by != last.by:
            first, last = (decide_by_theory(self._problem, end.value) for end in (first, last))
        return last.quantity > first.quantity

    def _bisect(self, value: float, misses: float) -> tuple[float, float]:
        """Return the values next to the limit, one that reaches the target and one that does not,
        from two such values.
        """
        while len(self.probes) < MAX_PROBES[self._problem.by]:
            middle = self._value_between(*sorted((value, misses)))
            if middle is None:
                break
            reached = self._probe(middle).target == REACHED
            value, misses = (middle, misses) if reached else (value, middle)
            # Noise hides the limit near a value that stayed undecided.
            if self._is_undecided(misses) and max(value, misses) <= END_RATIO * min(value, misses):
                break
        return value, misses

    def _is_undecided(self, value: float) -> bool:
        """Return True if a value was tried without a decision."""
        return any(p.value == value and p.target == UNDECIDED for p in self.probes)

    def _probe(self, value: float) -> Probe:
        """Try a value and keep the result."""
        self.probes.append(self._decide(value))
        return self.probes[-1]

    def _value_between(self, low: float, high: float) -> float | None:
        """Return a value between two, an integer or rounded to DIGITS; None if there is none."""
        if self._problem.integer:
            middle = (low + high) // 2
            return int(middle) if low < middle < high else None
        # A range of several octaves is halved on a logarithmic scale.
        wide = low > 0.0 and high > 2.0 * low
        middle = math.sqrt(low * high) if wide else 0.5 * (low + high)
        middle = float(f"{middle:.{DIGITS[self._problem.by]}g}")
        return middle if low < middle < high else None


def advise(
    problem: SizingProblem,
    probes: tuple[Probe, ...],
    value: float | None,
    misses: float | None,
    grows: bool,
) -> str:
    """Return what to try next if the range or the runs did not suffice, else an empty string."""
    by_value = sorted(probes)
    if value is not None and misses is None:
        end = by_value[-1] if grows else by_value[0]
        return _advise_range(problem, end.value, end.value * (10.0 if grows else 0.1))
    nearest = next((p for p in probes if p.value == misses), None)
    if nearest is None:
        return ""
    runs = _advise_runs(nearest, problem.target)
    if value is not None:
        return runs
    # The nearest end and the next value tried.
    end, inner = (by_value[0], by_value[1]) if grows else (by_value[-1], by_value[-2])
    further = _advise_beyond(problem, end, inner, grows)
    return "; ".join(text for text in (further, runs) if text)


def _advise_beyond(problem: SizingProblem, end: Probe, inner: Probe, grows: bool) -> str:
    """Return where the target may be met beyond the ``end`` of the range, an empty string if its
    two last probes do not tell.
    """
    # The quantity follows a power of the key.
    numbers = (end.value, inner.value, end.quantity, inner.quantity)
    if not all(math.isfinite(x) and x > 0.0 for x in numbers) or end.value == inner.value:
        return ""
    power = math.log(end.quantity / inner.quantity) / math.log(end.value / inner.value)
    needed = math.log(problem.target.limit / end.quantity) / power if power else math.inf
    beyond = (needed < 0.0) if grows else (needed > 0.0)
    if beyond and abs(needed) <= math.log(MAX_EXTRAPOLATION):
        return _advise_range(problem, end.value, end.value * math.exp(MARGIN * needed))
    return (
        f"{problem.target.quantity} hardly changes beyond {problem.key} = {end.value:g}, where it "
        f"is {end.quantity:.4g}: other values may not reach the target either"
    )


def _advise_range(problem: SizingProblem, end: float, other: float) -> str:
    """Return the advice to search between a value and one beyond it, if the key can have it."""
    if end == 0.0:
        return ""
    other = round(other) if problem.integer else float(f"{other:.2g}")
    try:
        problem.at(other)
    except ScenarioError as error:
        return f"{problem.key} cannot be {other:g}: {error.rule}"
    low, high = sorted((end, other))
    return f"next range: --vary {problem.key}={low:g}:{high:g}" if low < high else ""


def _advise_runs(probe: Probe, target: Target) -> str:
    """Return how many runs would decide an undecided value, if its estimate is right."""
    wanted = _runs_to_decide(probe, target) if probe.target == UNDECIDED else math.nan
    if math.isnan(wanted):
        return ""
    if wanted > MAX_RUNS:
        return f"at {probe.value:g} it is too close to the limit for runs to tell"
    return f"at {probe.value:g} about --runs {float(f'{max(wanted, probe.runs):.2g}'):g} would tell"


def _describe_certainty(
    probes: tuple[Probe, ...], confidence: float, grows: bool, none_reached: bool
) -> str:
    """Return a sentence on the certainty of the answer and its assumptions."""
    if all(probe.runs == 0 for probe in probes):
        certainty = "computed, no simulation"
        if any(probe.target == NOT_SHOWN for probe in probes):
            certainty += "; a bound above the limit proves nothing, --by simulation tells"
    else:
        certainty = f"all decisions together are right with probability {confidence:g}"
        if any(probe.target == UNDECIDED for probe in probes):
            certainty += (
                "; values that stayed undecided count as not reaching it (more --runs help)"
            )
    # Bounds are compared with bounds, since they lie above what simulation finds.
    pure = len({probe.by for probe in probes}) == 1 and probes[0].by == BOUND
    for one, other in pairwise(sorted(probes)):
        ends = [(p.quantity, p.quantity) if pure else (p.low, p.high) for p in (one, other)]
        turned = ends[0][0] > ends[1][1] if grows else ends[0][1] < ends[1][0]
        if turned:
            return (
                f"{certainty}; NOT monotone between {one.value:g} and {other.value:g}: "
                "other values may reach it too, narrow the range"
            )
    tried = "at the ends and in the middle" if none_reached else f"at {len(probes)} values"
    return f"{certainty}; taken to be monotone, as it was {tried}"
