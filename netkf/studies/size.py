"""``netkf.size``: the smallest or largest value of a key that meets a target."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import number, one_of, require_runs
from netkf.ensembles.blocks import BlockTask, each_replica
from netkf.ensembles.pools import PoolOptions, make_pool
from netkf.runs.simulate import choose_engine, require_scenario
from netkf.scenario.scenario import Scenario
from netkf.studies import metrics
from netkf.studies.parameter_grid import is_integer_key
from netkf.studies.search import (
    CHEAP_RUNS,
    FIRST_BATCH,
    FIRST_EXPECTED,
    MAX_PROBES,
    RUNS,
    Search,
    SimulationPlan,
    Sizing,
)
from netkf.studies.targets import Target, parse_target, quantity_by_theory, theory_is_exact


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
