"""``netkf check``: theory against simulation, one row per promise."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from netkf.algorithms.filter import takes_columns
from netkf.algorithms.registry import LINK_WEIGHTS, own_attributes
from netkf.checks import (
    diffusion,
    gossip,
    hybrid,
    intermittent,
    push_sum,
    stochastic_trigger,
    track_fusion,
)
from netkf.checks.equations import OF_EQUATIONS, UNDER_CLOCKS, WITHOUT_PAPER
from netkf.checks.evidence import (
    BASE,
    BROKEN,
    EPS,
    NOT_PROMISED,
    OPERATIONS,
    UNDECIDED,
    VERDICTS,
    Assumption,
    Evidence,
    Finding,
    Promise,
    find_identity,
    find_nothing,
    fold_followers,
    judge,
)
from netkf.checks.exact import promised_filter, with_base_filter, with_promised_filter
from netkf.checks.paper import PaperChecks
from netkf.checks.parts.events import stack_parts, summarise_parts
from netkf.checks.parts.network_rows import loss_assumptions
from netkf.checks.parts.rows import gaussian_noises, part_promises
from netkf.checks.records.rows import audit_record, audit_run, record_promises
from netkf.checks.results import RESULTS_FORM, ReplicaResult
from netkf.checks.samples import check_slots, probe_times, stack_summaries
from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import integer, number, require_runs
from netkf.core.notebook import NotebookTable
from netkf.engines.base import Engine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.ensembles.pools import PoolOptions, make_pool
from netkf.ensembles.replicas import replicate
from netkf.runs.simulate import choose_engine, require_scenario, simulate
from netkf.scenario.model import ALL_READ, HEALTHY, RIGHT_CLOCKS
from netkf.scenario.records import nodes_with_law
from netkf.scenario.registry import kind_name
from netkf.scenario.scenario import Scenario
from netkf.theory import assumptions
from netkf.theory.common.blocks import have_one_view, run_of_view, scenario_of_view
from netkf.theory.common.evidence import CONSISTENCY, LIVES
from netkf.trace.nees import without_padding
from netkf.trace.run import Run

if TYPE_CHECKING:
    import pandas as pd

MIN_RUNS, USUAL_RUNS = 10, 500
"""Smallest number of runs of a check, and that of networks of up to MANY_NODES."""
MANY_NODES, MANY_ERRORS = 100, 20_000
"""Larger networks take as many runs as have MANY_ERRORS nodes together, if none is given."""
MAX_LOOKED_RUNS = 20_000
"""Default limit on the runs of a check with ``until = "decided"``."""
MIN_GROWTH, MAX_GROWTH = 1.5, 6.0
"""Limits of the factor by which the runs grow from one look to the next."""
MARGIN = 1.1
"""Factor on the forecast number of runs: the next look has a smaller level and wider intervals."""
TWIN_RUNS = 10
"""Replicas of a user's class that are also run with the built-in filter that it derives from."""
TWIN_TOLERANCE = 1e-6
"""Difference of their errors, in standard deviations, above which the two are not the same."""


@dataclasses.dataclass(frozen=True)
class Verdict(NotebookTable):
    """Evidence for every promise; true if none is broken.

    confidence : lower bound on the probability that all intervals of all rows hold jointly, those
                 of earlier looks included
    results    : results of the replicas, to which more can be added
    looks      : number of times the rows were judged
    spent      : part of the error probability that these looks used up
    """

    scenario: str
    runs: int
    seed: int
    confidence: float
    rows: tuple[Evidence, ...]
    results: tuple[ReplicaResult, ...] = dataclasses.field(default=(), repr=False, compare=False)
    looks: int = 1
    spent: float = 0.0

    @property
    def is_decided(self) -> bool:
        """True if more runs would decide no further row."""
        return not any(row.verdict == UNDECIDED and row.needed is not None for row in self.rows)

    def __bool__(self) -> bool:
        return all(row.verdict != BROKEN for row in self.rows)

    def __repr__(self) -> str:
        counts = Counter(row.verdict for row in self.rows)
        counts_text = ", ".join(f"{counts[name]} {name}" for name in VERDICTS if counts[name])
        return (
            f"<netkf verdict on {self.scenario!r}: {counts_text or 'no row'}; {self.runs:,} runs>"
        )

    @property
    def table(self) -> pd.DataFrame:
        """One row per promise, with the fields of Evidence as columns."""
        import pandas as pd

        names = [field.name for field in dataclasses.fields(Evidence)]
        return pd.DataFrame([dataclasses.astuple(row) for row in self.rows], columns=names)


OF_PAPERS: dict[str, PaperChecks] = OF_EQUATIONS | {
    "diffusion": diffusion.CHECKS,
    "gossip": gossip.CHECKS,
    "hybrid": hybrid.CHECKS,
    "intermittent": intermittent.CHECKS,
    "push_sum": push_sum.CHECKS,
    "stochastic_trigger": stochastic_trigger.CHECKS,
    "track_fusion": track_fusion.CHECKS,
}
"""The checks of each paper, by the name that filters give it (``Analysis.paper``)."""
OF_EVENTS = {*OF_EQUATIONS, "stochastic_trigger"}
"""Papers whose promises hold given the events of a run, whatever the plant and the nodes do."""


def find_checks(scenario: Scenario) -> PaperChecks:
    """Return the checks of the paper of a scenario's filter; raises TheoryError without one."""
    if not scenario.is_linear:
        return WITHOUT_PAPER
    promised = promised_filter(scenario.filter.algorithm)
    paper, talks = promised.analysis.paper, promised.timing.talks
    if talks and paper not in OF_PAPERS and not takes_columns(promised):
        name = kind_name(promised)
        raise TheoryError(f"nothing is promised of the {name} filter that could be checked")
    # Papers are about plants that do not change and are drawn, nodes that are up, and most about
    # nodes that estimate the whole state; the equations, and what they say of P, hold for all.
    changes = len(scenario.plant.changes) or not scenario.is_random or scenario.network.lives
    in_parts = scenario.views is not None and not have_one_view(scenario)
    # Without messages the equations of a Kalman filter are all that is promised.
    if not talks or paper not in OF_PAPERS or ((changes or in_parts) and paper not in OF_EVENTS):
        return UNDER_CLOCKS
    checks = OF_PAPERS[paper]
    return UNDER_CLOCKS if checks.slots_only and not scenario.slotted else checks


def _whole(scenario: Scenario, run: Run) -> tuple[Scenario, Run]:
    """Return scenario and run as tests take them: as if all nodes estimated the whole state."""
    if have_one_view(scenario):
        return scenario_of_view(scenario), run_of_view(scenario, run)
    e, P = without_padding(run.error, run.P)
    return scenario, dataclasses.replace(run, error=e, P=P)


def with_check_times(scenario: Scenario) -> Scenario:
    """Return the scenario with samples at the times where promises are checked."""
    times = np.array(probe_times(scenario))
    if not scenario.is_random:
        # Recorded states may be known at the times of [probe] alone.
        nearest = np.abs(scenario.times[None] - times[:, None]).argmin(axis=1)
        times = scenario.times[np.unique(nearest)]
    return dataclasses.replace(scenario, probe=times)


def run_replica(
    scenario: Scenario, seed: int, replica: int, engine: str | Engine = "auto"
) -> ReplicaResult:
    """Simulate and summarise one ``replica``; a user's class also runs as its built-in base, the
    twin, for the first TWIN_RUNS replicas and where it diverged.
    """
    chosen = choose_engine(engine, scenario, announce=False)
    run, promised = simulate(scenario, seed, replica, chosen), with_promised_filter(scenario)
    diverged, difference = run.status == "diverged", math.nan
    expected = promised is scenario
    if own_attributes(scenario.filter.algorithm) and (diverged or replica < TWIN_RUNS):
        twin = simulate(with_base_filter(scenario), seed, replica, SimpyEngine())
        difference, expected = _error_difference(run, twin), twin.status == "diverged"
    audit = audit_run(scenario, run, seed, replica, chosen)
    if diverged:
        return ReplicaResult(None, difference, expected, audit=audit)
    try:
        summary = find_checks(scenario).summarise(*_whole(scenario, run))
        parts = summarise_parts(scenario, run)
    except Exception:
        # Events that contradict each other cannot be replayed: their record says what is wrong.
        audit = audit_record(scenario, run, seed, replica)
        if not audit.events and not audit.samples:
            raise
        return ReplicaResult(None, difference, expected, audit=audit)
    return ReplicaResult(summary, difference, parts=parts, audit=audit)


def _error_difference(run: Run, twin: Run) -> float:
    """Return the largest difference between errors of a ``run`` and of its built-in ``twin``."""
    common = min(len(run.times), len(twin.times))
    # Each state in units of its own; of a node with fewer blocks than others the last are nan.
    size = np.sqrt(np.diagonal(twin.P[:common], axis1=-2, axis2=-1))
    rounding = np.maximum(run.rounding[:common], twin.rounding[:common])[:, None, None]
    # Roundings of errors that were larger at earlier times are still in the estimates.
    earlier = np.maximum.accumulate(np.nan_to_num(np.abs(twin.error[:common])).max(axis=(1, 2)))
    rounding = np.maximum(rounding, OPERATIONS * EPS * earlier[:, None, None])
    gap = np.abs(run.error[:common] - twin.error[:common])
    comparable = (rounding <= 0.1 * TWIN_TOLERANCE * size) & (size > 0.0)
    relative_gap = gap / np.where(size > 0.0, size, 1.0)
    if not comparable.any():
        return math.nan
    # An error that is nan in one run only differs infinitely.
    return float(np.nan_to_num(relative_gap[comparable], nan=np.inf).max())


def _same_as_base(results: list[ReplicaResult], level: float) -> Finding:
    differences = [result.difference for result in results]
    if np.isnan(differences).all():
        return find_nothing(0.0)
    count = int(np.isfinite(differences).sum())
    message = f"{count} runs beside those of the filter that it should be"
    finding = find_identity(float(np.nanmax(differences)), TWIN_TOLERANCE, message)
    departing = np.flatnonzero(np.nan_to_num(differences) > TWIN_TOLERANCE).tolist()
    return finding._replace(replica=departing[0] if departing else None)


def _none_diverged(results: list[ReplicaResult], level: float) -> Finding:
    diverged = sum(result.diverged for result in results)
    message = f"{diverged} of {len(results)} runs ended early, so no other promise is looked at"
    margin = -diverged / len(results)
    finding = Finding((margin, margin, margin), 0.0, message)
    first = next((k for k, result in enumerate(results) if result.diverged), None)
    return finding._replace(seen=float(diverged), expected=0.0, replica=first)


SAME_AS_BASE = Promise(
    "its estimates are those of the filter that it derives from, on the same readings",
    "the class itself", (), _same_as_base, exact=True, group=BASE,
)  # fmt: skip
NONE_DIVERGED = Promise(
    "estimates are finite and covariances positive semidefinite", "the class itself", (),
    _none_diverged, exact=True, group=BASE,
)  # fmt: skip


def judge_replicas(
    scenario: Scenario, results: Iterable[ReplicaResult], seed: int, confidence: float
) -> Verdict:
    """Return the verdict from the ``results`` of replicas of ``seed``, in their order; all
    intervals hold together at ``confidence``. Raises TheoryError without covariances.
    """
    checks, replicas = find_checks(scenario), list(results)
    audits = [result.audit for result in replicas]
    records = judge(record_promises(audits), audits, assumptions=[], runs=len(replicas), level=1.0)
    make_verdict = partial(Verdict, scenario.name, len(replicas), seed, confidence)
    try:
        _require_covariances(replicas)
    except TheoryError:
        if all(row.verdict != BROKEN for row in records):
            raise
        return make_verdict(tuple(records))  # runs whose record is wrong are no evidence
    if any(result.diverged for result in replicas):
        # The test is exact: it needs no assumptions and none of the level.
        rows = judge([NONE_DIVERGED], replicas, assumptions=[], runs=len(replicas), level=1.0)
        return make_verdict((*rows, *records))
    stacked = stack_summaries([result.summary for result in replicas if result.summary is not None])
    judged = scenario_of_view(scenario) if have_one_view(scenario) else scenario
    promised = with_promised_filter(judged)
    parts = stack_parts(scenario, seed, [r.parts for r in replicas if r.parts is not None])
    # The promises of the paper and the tests of the scenario's parts may each err with half of the
    # error probability.
    rows = judge(
        checks.promises(judged),
        checks.collect(judged, stacked, seed),
        [
            *(Assumption(*row) for row in assumptions(promised).itertuples(index=False)),
            *checks.assumptions(judged),
            gaussian_noises(parts),
        ],
        len(replicas),
        0.5 * (1.0 - confidence),
    )
    rows += judge(
        part_promises(parts),
        parts,
        assumptions=loss_assumptions(scenario),
        runs=len(replicas),
        level=0.5 * (1.0 - confidence),
    )
    base = _judge_base(scenario, _run_departed(scenario, replicas, rows, seed))
    return make_verdict(tuple(fold_followers([*base, *rows, *records])))


def _run_departed(
    scenario: Scenario, results: list[ReplicaResult], rows: list[Evidence], seed: int
) -> list[ReplicaResult]:
    departed = {row.replica for row in rows if row.verdict == BROKEN} - {None}
    if not own_attributes(scenario.filter.algorithm):
        return results
    results = list(results)
    for replica in departed:
        if replica is not None and math.isnan(results[replica].difference):
            twin = simulate(with_base_filter(scenario), seed, replica, SimpyEngine())
            difference = _error_difference(simulate(scenario, seed, replica), twin)
            results[replica] = results[replica]._replace(difference=difference)
    return results


def _judge_base(scenario: Scenario, results: list[ReplicaResult]) -> list[Evidence]:
    overridden = own_attributes(scenario.filter.algorithm)
    if not overridden:
        return []
    (row,) = judge([SAME_AS_BASE], results, assumptions=[], runs=len(results), level=1.0)
    listed = ", ".join(overridden)
    by_design = set(overridden) <= set(LINK_WEIGHTS) and not _transposes(scenario)
    if row.verdict == BROKEN and by_design:
        reason = f"it differs by design: {listed} is its own; {row.evidence}"
        return [dataclasses.replace(row, verdict=NOT_PROMISED, assumptions=reason)]
    return [dataclasses.replace(row, evidence=f"{row.evidence}; its own: {listed}")]


def _transposes(scenario: Scenario) -> bool:
    own, base = (s.node_filter.link_weights.matrix for s in (scenario, with_base_filter(scenario)))
    if own is None or base is None or np.array_equal(own, base):
        return False
    return np.array_equal(own, np.transpose(base))


def _require_covariances(results: list[ReplicaResult]) -> None:
    summaries = [result.summary for result in results if result.summary is not None]
    diverged = len(results) - len(summaries)
    # A class that diverges where its base does not breaks a promise; a built-in one says nothing.
    if diverged and all(result.expected for result in results if result.diverged):
        problem = f"{diverged} of {len(results)} runs diverged, so there are no limits to look at"
        raise TheoryError(f"{problem}; shorten the horizon")
    if not diverged and all(np.isnan(summary.P).all() for summary in summaries):
        raise TheoryError("the filter gives no covariance, and promises are about covariances")


def usual_runs(scenario: Scenario) -> int:
    """Return the number of runs of a check that is given none: 500, of more than 100 nodes as many
    as have 20,000 nodes together, and at least 10.
    """
    nodes = len(scenario.nodes)
    return USUAL_RUNS if nodes <= MANY_NODES else max(MIN_RUNS, MANY_ERRORS // nodes)


@np.errstate(under="ignore")
def check(
    scenario: Scenario,
    runs: int | None = None,
    seed: int | None = None,
    confidence: float = 0.99,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    until: str | None = None,
    most: int = MAX_LOOKED_RUNS,
    earlier: Verdict | None = None,
) -> Verdict:
    """Test all promises about the scenario's filter with ``runs`` replicas, by default 500; fewer
    of more than 100 nodes, see ``usual_runs``.

    The state is sampled at the times that the promises need, whatever ``probe`` says. A user's
    class is held to the promises of the filter that it derives from. ``workers``, ``executor``,
    ``scheduler`` and ``progress`` are those of ``netkf.monte_carlo``; they do not change the
    verdict.

    With ``until = "decided"`` runs are added until every row is decided, a promise is broken or
    ``most`` runs are done. Runs can also be added to an ``earlier`` verdict on the same scenario
    and seed. All intervals of all looks hold together, so that one may stop at any of them; the
    confidence of a verdict with runs added says what the looks before have spent.

    Raises TheoryError if nothing is promised, ScenarioError for bad arguments.
    """
    require_scenario(scenario, "check")
    count = require_runs(usual_runs(scenario) if runs is None else runs, MIN_RUNS)
    confident = number(above=0.0, below=1.0)("confidence", confidence)
    root = scenario.seed if seed is None else integer(low=0)("seed", seed)
    if until not in (None, "decided"):
        raise ScenarioError("until", "must be decided, or left out", until, 'write "decided"')
    _require_earlier(scenario, earlier, root, count)
    _require_laws(scenario)
    chosen = with_check_times(scenario)
    verdict, last = earlier, max(count, require_runs(most, key="most") if until else count)
    with make_pool(last, PoolOptions(workers, executor, scheduler), open_ended=True) as pool:
        while True:
            results = list(verdict.results) if verdict is not None else []
            results += replicate(
                partial(run_replica, engine=choose_engine("auto", chosen)),
                chosen,
                count - len(results),
                root,
                first=len(results),
                pool=pool,
                progress=progress,
                form=RESULTS_FORM,
            )
            verdict = _look_again(chosen, verdict, results, root, confident, bool(until))
            if not until or not verdict or verdict.is_decided or count >= last:
                return verdict
            count = next_runs(verdict.rows, count, last)


def level_of_look(level: float, look: int) -> float:
    """Return the part of ``level`` that look number ``look`` = 1, 2, ... may spend (alpha
    spending), so that the intervals of all looks hold jointly, whenever one stops.
    """
    return float(level * 2.0**-look)


def next_runs(rows: Sequence[Evidence], runs: int, max_runs: int) -> int:
    """Return the runs of the next look, as forecast, MIN_GROWTH to MAX_GROWTH times ``runs``."""
    needed = [row.needed for row in rows if row.verdict == UNDECIDED and row.needed is not None]
    forecast = MARGIN * max(needed, default=runs)
    growth = min(max(forecast, MIN_GROWTH * runs), MAX_GROWTH * runs)
    return min(max_runs, math.ceil(growth))


def keep_decisions(earlier: Sequence[Evidence], rows: Sequence[Evidence]) -> tuple[Evidence, ...]:
    """Return the new ``rows``, undecided ones with an ``earlier`` decision: all intervals hold."""
    earlier_rows = {(row.promise, row.source): row for row in earlier}
    decisions = []
    for row in rows:
        old = earlier_rows.get((row.promise, row.source), row)
        undecided = row.verdict == UNDECIDED and old.verdict != UNDECIDED
        decisions.append(old if undecided or old.verdict == BROKEN else row)
    return tuple(decisions)


def _look_again(
    scenario: Scenario,
    earlier: Verdict | None,
    results: list[ReplicaResult],
    seed: int,
    confidence: float,
    may_continue: bool,
) -> Verdict:
    look, level = (earlier.looks if earlier is not None else 0) + 1, 1.0 - confidence
    # A single look may spend the whole level, unless others are planned.
    level_now = level_of_look(level, look) if may_continue or earlier is not None else level
    spent = (earlier.spent if earlier is not None else 0.0) + level_now
    verdict = judge_replicas(scenario, results, seed, 1.0 - level_now)
    rows = verdict.rows
    if earlier is not None:  # a broken row that is kept may be the root of one that is new
        rows = tuple(fold_followers(keep_decisions(earlier.rows, verdict.rows)))
    confident = 1.0 - max(spent, level) if may_continue else 1.0 - spent
    return dataclasses.replace(
        verdict, rows=rows, confidence=confident, results=tuple(results), looks=look, spent=spent
    )


def _require_earlier(scenario: Scenario, earlier: Verdict | None, seed: int, runs: int) -> None:
    if earlier is None:
        return
    if (earlier.scenario, earlier.seed) != (scenario.name, seed):
        problem = f"is of scenario {earlier.scenario} and seed {earlier.seed}"
        raise ScenarioError("earlier", problem, (scenario.name, seed), "check it anew")
    if runs <= len(earlier.results):
        problem = f"has {len(earlier.results):,} runs already"
        raise ScenarioError("runs", f"must be more: the verdict {problem}", runs, "give more")


def _require_laws(scenario: Scenario) -> None:
    find_checks(scenario)
    for assumption, evidence in scenario.departures:
        if assumption in (RIGHT_CLOCKS, HEALTHY, ALL_READ):
            raise TheoryError(f"{evidence}, so nothing is promised; {CONSISTENCY}")
        if scenario.network.lives:
            raise TheoryError(f"{LIVES}, and {evidence}, so nothing is promised; {CONSISTENCY}")
    if not nodes_with_law(scenario).any():
        raise TheoryError(
            "the state or the readings are recorded: there is one run, and no law to check; "
            "netkf theory says what is assumed"
        )
    # Growth is looked at from half of the horizon to its end. Limits that are not reached by then
    # are undecided, and their rows say so.
    if scenario.slotted and len(check_slots(scenario)) < 2:
        rule = "must have a slot to look at before its last one"
        raise ScenarioError("horizon", rule, scenario.horizon, "make it 3 slots or longer")
