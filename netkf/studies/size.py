"""``netkf.size``: the value of one key that just reaches a target."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import choice, integer, number
from netkf.ensembles.blocks import BlockTask, each_replica
from netkf.runs.simulate import choose_engine
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import (
    block_metrics,
    expected_errors_known,
    expected_metrics,
    join_metrics,
)
from netkf.studies.parameter_grid import whole_number
from netkf.studies.pools import shared_pool
from netkf.studies.search import DIGITS, FIRST_BATCH, MOST_PROBES, Search, Sizing
from netkf.studies.targets import QUANTITIES, Target, by_theory, parse_target

LOAD = "load it first: netkf.size(netkf.load(path), ...)"


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
    if wanted.of_errors and not scenario.plant.truth_known:
        remedy = "ask for mean_trace or worst_trace"
        raise ScenarioError(
            "--target", "is about errors, and there is no ground truth", target, remedy
        )
    base = scenario if seed is None else scenario.replace({"seed": seed})
    whole = _checked_range(base, key, low, high)
    used = choose_engine(engine, base.replace({key: low}))
    chosen = by or ("theory" if _theory_tells(base, key, (low, high), wanted) else "simulation")
    if chosen == "theory":
        search = Search(base, key, wanted, whole, "theory")
        words = by_theory(base.replace({key: low}), wanted)[1]
        return search.found(low, high, search.theory, 1.0, words)
    with shared_pool(runs, workers, executor, scheduler) as handed:
        search = Search(base, key, wanted, whole, "simulation", progress)
        level = (1.0 - sure) / (MOST_PROBES["simulation"] * _looks(runs))
        exact = wanted.of_errors and expected_errors_known(base.replace({key: low}))
        task: BlockTask = partial(block_metrics, engine=used)
        if exact:
            one = partial(expected_metrics, engine=used)
            task = partial(each_replica, one, join_metrics)
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
