"""``netkf.size``: the value of one key that just reaches a target."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import choice, integer, number
from netkf.experiments.ensembles.replicas import replicate
from netkf.experiments.simulate import choose_engine
from netkf.experiments.studies.figures import (
    Figures,
    central_trace,
    expected_errors_known,
    one_expected_run,
    one_run,
    together,
)
from netkf.experiments.studies.pools import shared_pool
from netkf.experiments.studies.targets import (
    QUANTITIES,
    Target,
    by_simulation,
    by_theory,
    parse_target,
)
from netkf.experiments.studies.variations import whole_number
from netkf.scenario.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd

REACHED, MISSED, UNDECIDED = "reached", "missed", "undecided"
LOAD = "load it first: netkf.size(netkf.load(path), ...)"
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


def size(
    scenario: Scenario,
    key: str,
    low: float,
    high: float,
    target: str,
    by: str | None = None,
    runs: int = 1000,
    confidence: float = 0.95,
    seed: int | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    engine: str = "auto",
    progress: Callable[[str], None] | None = None,
) -> Sizing:
    """Search ``key`` between ``low`` and ``high`` for the value that just reaches ``target``, such
    as ``"worst_rms<=0.5"``; quantities are worst_rms, mean_rms, worst_trace, mean_trace and
    within_central, the largest RMS error over that of a filter with all readings.

    ``by`` is "theory" (a bound on the quantity, or its exact value), "simulation", or None: theory
    where it has an answer. By simulation, runs are added at each value until an interval decides,
    ``runs`` at most; every value meets the same draws, and all decisions together are right with
    probability ``confidence``. Where the exact covariance of the errors given the events of a run
    is known and cheap (small networks in slots) it stands for the squared errors, which takes far
    fewer runs. The quantity is taken to be monotone in the key; that is checked at the values that
    are tried.

    Raises ScenarioError for a key, a range or a target that is wrong, TheoryError with
    ``by="theory"`` where theory does not tell.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "size takes a netkf.Scenario", scenario, LOAD)
    if by is not None:
        choice(*DIGITS)("--by", by)
    wanted, sure = parse_target(target), number(above=0.0, below=1.0)("--confidence", confidence)
    integer(low=FIRST_BATCH)("--runs", runs)
    if wanted.of_errors and not scenario.plant.shown:
        remedy = "ask for mean_trace or worst_trace"
        raise ScenarioError(
            "--target", "is about errors, and nobody knows the truth", target, remedy
        )
    base = scenario if seed is None else scenario.replace({"seed": seed})
    whole = _checked_range(base, key, low, high)
    choose_engine(engine, base.replace({key: low}))
    chosen = by or ("theory" if _theory_tells(base, key, (low, high), wanted) else "simulation")
    if chosen == "theory":
        search = _Search(base, key, wanted, whole, "theory")
        words = by_theory(base.replace({key: low}), wanted)[1]
        return search.found(low, high, search.theory, 1.0, words)
    with shared_pool(base, runs, workers, executor, scheduler) as handed:
        search = _Search(base, key, wanted, whole, "simulation", progress)
        level = (1.0 - sure) / (MOST_PROBES["simulation"] * _looks(runs))
        exact = wanted.of_errors and expected_errors_known(base.replace({key: low}))
        task = partial(one_expected_run if exact else one_run, engine=engine)
        decide = partial(search.simulation, task=task, runs=runs, level=level, handed=handed)
        words = f"{QUANTITIES[wanted.quantity]}, over the runs"
        if exact:
            words += ", each with its exact expected squared error given its events"
        return search.found(low, high, decide, sure, words)


def _looks(runs: int) -> int:
    return 1 + math.ceil(math.log2(max(1.0, runs / FIRST_BATCH)))


def _checked_range(scenario: Scenario, key: str, low: float, high: float) -> bool:
    """Whether the key is an integer; raises ScenarioError for a range or a key that is wrong."""
    whole = whole_number(scenario, key)
    for end in (low, high):
        if whole and not isinstance(end, int):
            words = f"{key} is an integer, so LOW:HIGH must be integers"
            raise ScenarioError("--vary", words, f"{low}:{high}", "leave out the decimals")
    if not low < high:
        words = f"range of {key} must go from a lower to a higher number"
        raise ScenarioError("--vary", words, f"{low}:{high}", "swap or mend the ends")
    for end in (low, high):
        scenario.replace({key: end})
    return whole


def _theory_tells(scenario: Scenario, key: str, ends: tuple[float, float], target: Target) -> bool:
    try:
        for end in ends:
            by_theory(scenario.replace({key: end}), target)
    except TheoryError:
        return False
    return True


class _Search:
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
        done: list[Figures] = []
        while True:
            batch = min(max(FIRST_BATCH, len(done)), runs - len(done))
            done += replicate(task, scenario, batch, first=len(done), **handed)
            interval = by_simulation(together(done), self._target, level, central)
            word = UNDECIDED
            if interval.high <= self._target.limit:
                word = REACHED
            elif not interval.low <= self._target.limit:
                word = MISSED
            self._progress(f"{self._key} = {value:g}: {len(done)} runs, {word}")
            if word != UNDECIDED or len(done) >= runs:
                return Probe(value, *interval, len(done), word)

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
