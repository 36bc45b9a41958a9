"""``netkf.sweep``: one row for every point of a grid, all with the same random draws."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.core.fields import require_runs
from netkf.ensembles.pool import Pool
from netkf.ensembles.pools import ANYWHERE, PoolOptions, make_pool
from netkf.ensembles.replicas import Progress, replicate_blocks, results_of
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.runs.documents import write_sealed
from netkf.runs.failures import InterruptedRunError, explain_failures
from netkf.runs.files import check_sources, create_output_directory, write_scenario, write_text
from netkf.runs.parquet_files import write_table
from netkf.runs.provenance import versions
from netkf.runs.quantities import ensemble_names
from netkf.runs.simulate import choose_engine, require_scenario
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import (
    METRICS,
    MeanEstimate,
    RunMetrics,
    all_nodes,
    block_metrics,
    bound_traces,
    central_traces,
    is_one_truth,
    join_batches,
    mean_over_runs,
    square_root_of,
    worst_node,
)
from netkf.studies.parameter_grid import GridPoint, expand_grid, values_of_grid

if TYPE_CHECKING:
    import pandas as pd

SHOWN = 20  # instants at which truths are compared
Row = dict[str, Any]


@np.errstate(under="ignore")
def sweep(
    scenario: Scenario,
    vary: Mapping[str, Sequence[Any]],
    runs: int = 1,
    seed: int | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    engine: str = "auto",
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Simulate every point of a grid of key paths, ``vary`` =
    ``{"network.activation.rate": [1.0, 2.0]}``.

    All points use the same seed, so the same truth, readings and channel draws: differences between
    rows are due to the keys. The truth does not depend on what is sampled, probed or sent. It
    changes with the plant, and where sensors give increments also with ``plant.sensing_period``
    (its default follows the sensors) and, at instants off the sensing grid, with other such
    instants: ``status`` then says "another truth".

    A row has the varied keys, ``runs``; ``worst_rms`` (of the node with the largest), ``mean_rms``
    (of all nodes together), ``mean_trace`` and ``worst_trace`` of P, ``worst_instant``, quantiles,
    and what ``metrics.level`` and ``metrics.network`` ask for, of all nodes together as in
    summaries, each with its standard error ``_se`` over runs; ``bound`` and ``central``, mean
    traces of the bound on P (hybrid paper, H equation 12) and of the covariance of the centralised
    filter if they exist; messages ``sent``, ``delivered`` and ``lost`` per run; ``status``,
    complete or diverged, and whether the truth is another than in the first row. Averages over
    time are over the samples after time 0.

    ``workers``, ``executor``, ``scheduler`` and ``engine`` are those of ``netkf.monte_carlo``;
    ``progress(done, wanted)`` is called with numbers of points. Raises ScenarioError, before
    anything runs, for a wrong key or value.
    """
    import pandas as pd

    plan = plan_sweep(scenario, vary, runs, seed, engine)
    return pd.DataFrame(_simulate_points(plan, PoolOptions(workers, executor, scheduler), progress))


@dataclass(frozen=True)
class SweepPlan:
    """The ``base`` of a sweep, the keys that ``vary`` with their values, the points that follow,
    the runs at each of them and the engine.
    """

    base: Scenario
    vary: Mapping[str, Sequence[Any]]
    points: list[GridPoint]
    runs: int
    engine: str


def plan_sweep(
    scenario: Scenario,
    vary: Mapping[str, Sequence[Any]],
    runs: int = 1,
    seed: int | None = None,
    engine: str = "auto",
) -> SweepPlan:
    """Return the plan of a sweep, all points of which can run; raises ScenarioError."""
    require_scenario(scenario, "sweep", ", ...")
    require_runs(runs)
    base = scenario if seed is None else scenario.replace({"seed": seed})
    points = expand_grid(base, vary)
    for point in points:
        choose_engine(engine, point.scenario, announce=False)
    return SweepPlan(base=base, vary=vary, points=points, runs=runs, engine=engine)


def _simulate_points(
    plan: SweepPlan, options: PoolOptions, progress: Progress | None
) -> Iterator[Row]:
    def simulate(point: GridPoint, pool: Pool) -> RunMetrics:
        with explain_failures(point.scenario):
            task = partial(block_metrics, engine=choose_engine(plan.engine, point.scenario))
            metrics: RunMetrics = replicate_blocks(
                task, join_batches, point.scenario, plan.runs, pool=pool, form=METRICS
            )
            return metrics

    with make_pool(plan.runs, options, open_ended=True) as pool:
        found = results_of(partial(simulate, point, pool) for point in plan.points)
        for k, (point, metrics) in enumerate(zip(plan.points, found, strict=True)):
            row = _make_row(point, metrics)
            if not _same_truth(plan.points[0].scenario, point.scenario):
                row["status"] += "; another truth"
            yield row
            if progress is not None:
                progress(k + 1, len(plan.points))


def _make_row(point: GridPoint, metrics: RunMetrics) -> Row:
    quantities: dict[str, MeanEstimate] = {
        "worst_rms": square_root_of(worst_node(metrics.mean_square)),
        "mean_rms": square_root_of(all_nodes(metrics.mean_square)),
        "mean_trace": all_nodes(metrics.trace),
        "worst_trace": worst_node(metrics.trace),
    }
    columns = zip(ensemble_names(point.scenario), metrics.quantities.T, strict=True)
    quantities |= {name: mean_over_runs(values) for name, values in columns}
    row: Row = {**point.row, "runs": len(metrics.trace)}
    for name, (value, error) in quantities.items():
        row |= {name: value, f"{name}_se": error}
    row["bound"] = _value_or_nan(lambda: float(bound_traces(point.scenario).mean()))
    row["central"] = _value_or_nan(lambda: float(central_traces(point.scenario).mean()))
    sent, delivered, lost = metrics.messages[:, :3].mean(axis=0).tolist()
    row |= {"sent": sent, "delivered": delivered, "lost": lost}
    diverged, blurred = int(metrics.diverged.sum()), float(metrics.rounding_from.min())
    row["status"] = f"{diverged} diverged" if diverged else "complete"
    if np.isfinite(blurred) and point.scenario.plant.truth_known:
        row["status"] += f"; rounding blurs errors from {blurred:g} s on, they are left out"
    return row


def _same_truth(first: Scenario, other: Scenario) -> bool:
    times = np.intersect1d(first.times, other.times)
    if first is other or not len(times) or not (first.plant.is_random or other.plant.is_random):
        return True
    # Plants may change at any time of a run.
    times = times[np.unique(np.linspace(0, len(times) - 1, SHOWN).astype(int))]
    x, other_x = (_true_states(scenario, times) for scenario in (first, other))
    return is_one_truth(x, other_x)


def _true_states(scenario: Scenario, times: FloatArray) -> FloatArray:
    """Return the true states (T, n) of replica 0 at increasing ``times`` (T,), in seconds."""
    streams = Streams(scenario.seed)
    if scenario.slotted:
        truth, slots = scenario.slot_truth(streams), scenario.slot_plant.slots_of(times)
        return np.array([truth.state(slot) for slot in slots.tolist()])
    truth = scenario.continuous_truth(streams, frames=False)
    return np.array([truth.absolute(time) for time in times.tolist()])


def _value_or_nan(function: Callable[[], float]) -> float:
    try:
        return function()
    except TheoryError:
        return math.nan


@dataclass(frozen=True, eq=False)
class CompletedSweep:
    """A sweep that was written to ``directory``; ``seconds`` is its wall-clock time."""

    directory: Path
    table: pd.DataFrame
    keys: tuple[str, ...]
    seconds: float


def sweep_to_directory(
    plan: SweepPlan,
    out: Path | None = None,
    pool: PoolOptions = ANYWHERE,
    *,
    progress: Progress | None = None,
    finish: Callable[[CompletedSweep], None] | None = None,
    take: Callable[[CompletedSweep], None] | None = None,
) -> CompletedSweep:
    """Sweep and write sweep.parquet, sweep.csv, the base scenario.toml and manifest.json.

    out      : directory, new or empty; None: the first free runs/NAME-sweep-k
    progress : called with the numbers of points done and of all points after each point
    take     : called with a complete sweep before its files are written, which may fail
    finish   : adds its files to the directory before the manifest says that the sweep is complete

    An interrupted sweep keeps its rows. Raises ScenarioError and WriteError before anything runs,
    InterruptedRunError when interrupted.
    """
    import pandas as pd

    started = time.perf_counter()
    check_sources(plan.base)
    directory = create_output_directory(out, f"{plan.base.name}-sweep")
    write_scenario(directory, plan.base)
    rows: list[Row] = []
    status, is_written = "interrupted", False
    _write_manifest(directory, plan, 0, status)
    try:
        for row in _simulate_points(plan, pool, progress):
            rows.append(row)  # noqa: PERF402 - an interrupted sweep keeps its rows
        seconds = time.perf_counter() - started
        completed = CompletedSweep(directory, pd.DataFrame(rows), tuple(plan.vary), seconds)
        if take is not None:
            take(completed)
        _write_table(directory, completed.table)
        is_written = True
        if finish is not None:
            finish(completed)
        status = "complete"
    # Whatever happens, the rows so far and the status are written.
    except KeyboardInterrupt:
        raise InterruptedRunError(directory) from None
    except Exception:
        status = "failed"
        raise
    finally:
        if rows and not is_written:
            _write_table(directory, pd.DataFrame(rows))
        _write_manifest(directory, plan, len(rows), status)
    return completed


def _write_table(directory: Path, table: pd.DataFrame) -> None:
    write_table(directory / "sweep.parquet", {str(name): table[name] for name in table})
    write_text(directory / "sweep.csv", table.to_csv(index=False))


def _write_manifest(directory: Path, plan: SweepPlan, points_done: int, status: str) -> None:
    manifest = {
        "name": plan.base.name,
        "versions": versions(),
        "seed": plan.base.seed,
        "vary": values_of_grid(plan.vary),
        "runs": {"wanted": plan.runs * len(plan.points), "done": plan.runs * points_done},
        "status": status,
    }
    write_sealed(directory / "manifest.json", manifest)
