"""``netkf.size``: the smallest or largest value of a key that meets a target, by a bisection whose
probes are decided by theory or simulation.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import number, one_of, require_runs
from netkf.core.notebook import NotebookTable
from netkf.ensembles.blocks import BlockTask, each_replica
from netkf.ensembles.pool import Pool
from netkf.ensembles.pools import PoolOptions, make_pool
from netkf.ensembles.replicas import replicate_blocks
from netkf.runs.quantities import ensemble_names
from netkf.runs.simulate import choose_engine, require_scenario
from netkf.scenario.scenario import Scenario
from netkf.studies import metrics
from netkf.studies.metrics import METRICS, central_traces, join_batches
from netkf.studies.parameter_grid import is_integer_key
from netkf.studies.targets import (
    BEYOND,
    MISSED,
    NOT_SHOWN,
    REACHED,
    UNDECIDED,
    Target,
    describe_help,
    parse_target,
    quantity_by_simulation,
    quantity_by_theory,
    theory_is_exact,
)

if TYPE_CHECKING:
    import pandas as pd

RUNS, CHEAP_RUNS = 1000, 10_000
"""Most runs at a value by default, and where a run takes about a millisecond."""
FIRST_BATCH, FIRST_EXPECTED = 32, 8
"""Runs before the first decision about a value: of simulated errors, and of expected ones."""
END_RATIO = 1.25
"""Ratio of values below which the search ends once one of them is undecided."""
# Number of values that a search tries at most, by how they are decided.
MAX_PROBES = {"theory": 40, "simulation": 16, "both": 16}
DIGITS = {"theory": 4, "simulation": 2, "both": 2}
"""Significant digits of the values that are tried."""
EXACT, BOUND, SIMULATION = "exact", "bound", "simulation"
"""How a value was decided."""
MAX_EXTRAPOLATION, MARGIN = 100.0, 1.5
"""Largest factor beyond the range that is advised, and safety factor on its logarithm."""
MAX_RUNS, FUTILE = 1e7, 10.0
"""Most runs that are advised; a value that needs FUTILE times the given ones is given up."""


class Probe(NamedTuple):
    """A value of the key that was tried.

    value    : of the key
    quantity, low, high : the quantity with its interval; an upper bound is the upper end
    runs     : number of simulated runs
    target   : reached, missed, undecided or not shown
    by       : exact, bound or simulation
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

    value    : the smallest value that reaches the target, or the largest if ``grows``; None if none
               does
    misses   : the nearest value that was not shown to reach it, or None
    grows    : True if the quantity grows with the key, or falls if it should be at least the limit
    by       : theory, simulation, or both (a bound where it reaches the target, else simulation)
    quantity : description of the computed quantity
    sure     : certainty of the result, and assumptions
    advice   : what to try next, or empty
    central  : what the centralised filter has at ``value`` (or ``misses``), and which key would
               help, or empty
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
    central: str = ""

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
class SimulationPlan:
    """How values are decided by simulation.

    At most ``runs`` runs of ``task`` on a ``pool``, ``first`` of them before the first decision;
    each interval misses the truth with probability ``level``.
    """

    task: BlockTask
    runs: int
    level: float
    pool: Pool
    progress: Callable[[str], None] | None = None
    first: int = FIRST_BATCH


@dataclass(frozen=True)
class Search:
    """A bisection between two values of a ``key`` of a scenario, an ``integer`` or not, for one at
    which it meets the ``target``; it keeps all ``probes``.

    Values are decided ``by`` theory, simulation, or both: a bound if that suffices, else
    simulation, for which there is a ``plan``.
    """

    scenario: Scenario
    key: str
    integer: bool
    target: Target
    by: str
    plan: SimulationPlan | None = None
    probes: list[Probe] = field(default_factory=list)

    def at(self, value: float) -> Scenario:
        """Return the scenario with a value of the key."""
        return self.scenario.replace({self.key: value})

    def run(self, low: float, high: float, confidence: float, quantity: str) -> Sizing:
        """Bisect between ``low`` and ``high`` for the smallest (or largest) value that reaches the
        target; all decisions together hold with probability ``confidence``.
        """
        first, last = self._probe(low), self._probe(high)
        ends = [first, last]
        if BOUND in (first.by, last.by) and first.by != last.by:  # compare bounds with bounds
            ends = [self._decide_by_theory(end.value) for end in ends]
        grows = (ends[1].quantity > ends[0].quantity) != self.target.least
        # The end at which the quantity is better should reach the target, the other may not.
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
            middle = self._value_between(low, high)
            between = self._probe(low if middle is None else middle)
            if between.target == REACHED:
                value, misses = self._bisect(between.value, bad.value)
        at = misses if value is None else value
        described = "" if at is None else describe_help(self.at(at), self.target, self.key)
        central = described and f"at {self.key} = {at:g} {described}"
        hopeless = value is None and central.endswith(BEYOND) and not self.key.startswith("sensors")
        return Sizing(
            self.key,
            self.target,
            self.by,
            value,
            misses,
            grows,
            confidence,
            tuple(self.probes),
            quantity,
            sure=self._describe_certainty(confidence, grows, value is None),
            advice="" if hopeless else self._advise(value, misses, grows),
            central=central,
        )

    def _bisect(self, value: float, misses: float) -> tuple[float, float]:
        while len(self.probes) < MAX_PROBES[self.by]:
            middle = self._value_between(*sorted((value, misses)))
            if middle is None:
                break
            reached = self._probe(middle).target == REACHED
            value, misses = (middle, misses) if reached else (value, middle)
            # Close to an undecided value simulation noise hides the limit.
            undecided = any(p.value == misses and p.target == UNDECIDED for p in self.probes)
            near, far = sorted((abs(value), abs(misses)))
            if undecided and value * misses > 0.0 and far <= END_RATIO * near:
                break
        return value, misses

    def _value_between(self, low: float, high: float) -> float | None:
        """Return the value to try between ``low`` and ``high``, to DIGITS, or None."""
        if self.integer:
            middle = (low + high) // 2
            return int(middle) if low < middle < high else None
        # A range of several octaves is halved on a logarithmic scale.
        middle = math.sqrt(low * high) if low > 0.0 and high > 2.0 * low else 0.5 * (low + high)
        middle = float(f"{middle:.{DIGITS[self.by]}g}")
        return middle if low < middle < high else None

    def _probe(self, value: float) -> Probe:
        probe = None if self.by == "simulation" else self._decide_by_theory(value)
        if probe is None or (self.by == "both" and probe.target == NOT_SHOWN):
            probe = self._decide_by_simulation(value)
        self.probes.append(probe)
        return probe

    def _decide_by_theory(self, value: float) -> Probe:
        """Return the probe of a ``value`` by theory: the quantity itself or an upper bound."""
        scenario = self.at(value)
        quantity, _ = quantity_by_theory(scenario, self.target)
        exact, reached = theory_is_exact(scenario, self.target), quantity <= self.target.limit
        state = REACHED if reached else MISSED if exact else NOT_SHOWN
        # The quantity lies between 0 and a bound.
        low = quantity if exact else 0.0
        return Probe(value, quantity, low, quantity, 0, state, EXACT if exact else BOUND)

    def _decide_by_simulation(self, value: float) -> Probe:
        """Return the probe of a ``value``: runs are doubled until its interval decides."""
        plan, scenario, target = self.plan, self.at(value), self.target
        assert plan is not None
        # This target divides by the traces of P of a filter with all readings.
        central = central_traces(scenario) if target.quantity == "within_central" else None
        simulated, metrics = 0, []
        say = plan.progress or (lambda _: None)
        say(f"{self.key} = {value:g}: simulating")
        while True:
            batch = min(max(plan.first, simulated), plan.runs - simulated)
            where: dict[str, Any] = {"first": simulated, "pool": plan.pool, "form": METRICS}
            metrics.append(replicate_blocks(plan.task, join_batches, scenario, batch, **where))
            simulated += batch
            joined, names = join_batches(*metrics), ensemble_names(scenario)
            rare = target.has_rare_runs(scenario)
            interval = quantity_by_simulation(joined, target, plan.level, central, names, rare)
            state = target.decide(interval)
            say(
                f"{self.key} = {value:g}: {target.quantity} {interval.value:.4g}, between "
                f"{interval.low:.4g} and {interval.high:.4g} after {simulated:,} of at most "
                f"{plan.runs:,} runs, {state}"
            )
            probe = Probe(value, *interval, simulated, state)
            is_futile = simulated >= plan.runs // 4 and (
                self._runs_to_decide(probe) > FUTILE * plan.runs
            )
            if state != UNDECIDED or simulated >= plan.runs or is_futile:
                return probe

    def _runs_to_decide(self, probe: Probe) -> float:
        """Return the forecast of the runs that decide a ``probe``; nan if unknown."""
        width, distance = 0.5 * (probe.high - probe.low), abs(probe.quantity - self.target.limit)
        if not math.isfinite(width):
            return math.nan
        # Widths fall with the root of the number of runs; 10 % are added as a margin.
        return 1.1 * probe.runs * (width / distance) ** 2 if distance > 0.0 else math.inf

    def _advise(self, value: float | None, misses: float | None, grows: bool) -> str:
        by_value = sorted(self.probes)
        if value is not None and misses is None:
            end = by_value[-1] if grows else by_value[0]
            is_further = grows == (end.value > 0.0)
            return self._advise_range(end.value, end.value * (10.0 if is_further else 0.1))
        runs = self._advise_runs(next(probe for probe in by_value if probe.value == misses))
        if value is not None:
            return runs
        # The nearest end and the next value tried.
        end, inner = (by_value[0], by_value[1]) if grows else (by_value[-1], by_value[-2])
        return "; ".join(text for text in (self._advise_beyond(end, inner, grows), runs) if text)

    def _advise_beyond(self, end: Probe, inner: Probe, grows: bool) -> str:
        """Advise on a range beyond the probe ``end``, extrapolated from it and ``inner``."""
        # The quantity is taken to be a power of the key.
        numbers = (end.value, inner.value, end.quantity, inner.quantity)
        if not all(math.isfinite(x) and x > 0.0 for x in numbers) or end.value == inner.value:
            return ""
        # quantity ~ key^power, so that the limit is at end.value exp(needed).
        power = math.log(end.quantity / inner.quantity) / math.log(end.value / inner.value)
        needed = math.log(self.target.limit / end.quantity) / power if power else math.inf
        # The quantity falls towards smaller keys if it grows with the key.
        is_outside = (needed < 0.0) if grows else (needed > 0.0)
        if is_outside and abs(needed) <= math.log(MAX_EXTRAPOLATION):
            return self._advise_range(end.value, end.value * math.exp(MARGIN * needed))
        return (
            f"{self.target.quantity} hardly changes beyond {self.key} = {end.value:g}, where it "
            f"is {end.quantity:.4g}: other values may not reach the target either"
        )

    def _advise_range(self, end: float, next_end: float) -> str:
        if end == 0.0:
            return ""
        next_end = round(next_end) if self.integer else float(f"{next_end:.2g}")
        try:
            self.at(next_end)
        except ScenarioError as error:
            return f"{self.key} cannot be {next_end:g}: {error.rule}"
        low, high = sorted((end, next_end))
        return f"next range: --vary {self.key}={low:g}:{high:g}" if low < high else ""

    def _advise_runs(self, probe: Probe) -> str:
        runs = self._runs_to_decide(probe) if probe.target == UNDECIDED else math.nan
        if math.isnan(runs):
            return ""
        if runs > MAX_RUNS:
            return f"at {probe.value:g} it is too close to the limit for runs to tell"
        enough = float(f"{max(runs, probe.runs):.2g}")
        return f"at {probe.value:g} about --runs {enough:g} would tell"

    def _describe_certainty(self, confidence: float, grows: bool, none_reached: bool) -> str:
        probes = sorted(self.probes)
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
        pure = {probe.by for probe in probes} == {BOUND}
        for first, second in pairwise(probes):
            ends = [(p.quantity, p.quantity) if pure else (p.low, p.high) for p in (first, second)]
            falls, rises = ends[0][0] > ends[1][1], ends[0][1] < ends[1][0]
            turned = falls if grows != self.target.least else rises
            if turned:
                return (
                    f"{certainty}; NOT monotone between {first.value:g} and {second.value:g}: "
                    "other values may reach it too, narrow the range"
                )
        tried = "at the ends and in the middle" if none_reached else f"at {len(probes)} values"
        return f"{certainty}; taken to be monotone, as it was {tried}"


@np.errstate(under="ignore")
def size(
    scenario: Scenario,
    key: str,
    low: float,
    high: float,
    target: str,
    by: str | None = None,
    runs: int | None = None,
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
    within_central, the largest RMS error over that of a filter with all readings of these states,
    and by simulation those of summaries over all nodes: worst_instant, quantile_99 and its kind,
    time_above, mean_age, worst_age, ``time_connected>=0.95``, transmissions, bytes, joules.

    ``by`` is "theory" (a bound on the quantity, or its exact value), "simulation", or None: the
    exact value where it is known; else the bound where that reaches the target, and simulation
    where it does not. By simulation, runs are added at each value until an interval decides, at
    most ``runs`` (None: 1,000, for small networks in the compiled engine 10,000); all values share
    the same random draws, and all decisions together are right with probability ``confidence``.
    Where runs are costly (SimPy) or few (below 1,000), the exact covariance of the errors given the
    events of a run replaces the squared errors if it is known and the network small: it takes as
    long as hundreds of compiled runs, and is worth dozens. The quantity is assumed to be monotone
    in the key; that is checked at the values that are tried.

    ``seed``, ``workers``, ``executor``, ``scheduler`` and ``engine`` are those of
    ``netkf.monte_carlo``; ``progress`` is called with a line of text as simulations go on. Raises
    ScenarioError for a wrong key, range or target, TheoryError with ``by="theory"`` if theory has
    no answer.
    """
    require_scenario(scenario, "size", ", ...")
    if by is not None:
        one_of("theory", "simulation")("--by", by)
    parsed = parse_target(target)
    confidence = number(above=0.0, below=1.0)("--confidence", confidence)
    given = None if runs is None else require_runs(runs, FIRST_BATCH, "--runs")
    if parsed.of_errors and not scenario.plant.truth_known:
        rule = "is about errors, and there is no ground truth"
        raise ScenarioError("--target", rule, target, "ask for mean_trace or worst_trace")
    base = parsed.prepare(scenario if seed is None else scenario.replace({"seed": seed}))
    is_integer = _check_range(base, key, low, high)
    engine_used = choose_engine(engine, base.replace({key: low}))
    cheap = engine_used.name == "compiled" and metrics.is_small(base) and (given or RUNS) >= RUNS
    most = given or (CHEAP_RUNS if cheap else RUNS)
    chosen = by or _choose_method(base, key, (low, high), parsed)
    search = Search(base, key, is_integer, parsed, chosen)
    if chosen == "theory":
        try:
            return search.run(low, high, 1.0, quantity_by_theory(search.at(low), parsed)[1])
        except TheoryError as error:
            raise TheoryError(f"{error}; --by simulation sizes any filter and network") from None
    quantity = f"{parsed.description}, over the runs"
    task: BlockTask = partial(metrics.block_metrics, engine=engine_used)
    first = FIRST_BATCH
    # Expected squared errors vary less from run to run than squared errors: fewer runs suffice.
    if parsed.of_errors and not cheap and metrics.expected_errors_known(search.at(low)):
        expected = partial(metrics.expected_metrics, engine=engine_used)
        task, first = partial(each_replica, expected, metrics.join_batches), FIRST_EXPECTED
        quantity += ", each with its exact expected squared error given its events"
    if chosen == "both":
        bound = quantity_by_theory(search.at(low), parsed)[1]
        quantity = f"{bound}; where that is above the limit, simulated: {quantity}"
    # Bonferroni over all values and all looks at each of them while its runs are doubled.
    looks = 1 + math.ceil(math.log2(max(1.0, most / first)))
    level = (1.0 - confidence) / (MAX_PROBES["simulation"] * looks)
    with make_pool(most, PoolOptions(workers, executor, scheduler), open_ended=True) as pool:
        plan = SimulationPlan(task, most, level, pool, progress, first)
        return dataclasses.replace(search, plan=plan).run(low, high, confidence, quantity)


def _check_range(scenario: Scenario, key: str, low: float, high: float) -> bool:
    """Return whether the ``key`` has integers as values; raises ScenarioError for a bad range."""
    if not isinstance(key, str):
        raise ScenarioError("--vary", "needs a key, as filter.epsilon", key, "give its path")
    is_integer = is_integer_key(scenario, key)
    for name, end in (("low", low), ("high", high)):
        number()(name, end)
        if is_integer and not isinstance(end, int):
            rule = f"{key} is an integer, so LOW:HIGH must be integers"
            raise ScenarioError("--vary", rule, f"{low}:{high}", "leave out the decimals")
    if not low < high:
        rule = f"range of {key} must go from a lower to a higher number"
        raise ScenarioError("--vary", rule, f"{low}:{high}", "swap or correct the ends")
    for end in (low, high):
        scenario.replace({key: end})
    return is_integer


def _choose_method(scenario: Scenario, key: str, ends: tuple[float, float], target: Target) -> str:
    """Return "theory" if exact at both ``ends``, "both" if there is a bound, else "simulation"."""
    scenarios = [scenario.replace({key: end}) for end in ends]
    try:
        for at_end in scenarios:
            quantity_by_theory(at_end, target)
    except TheoryError:
        return "simulation"
    return "theory" if all(theory_is_exact(at_end, target) for at_end in scenarios) else "both"
