"""``netkf.sweep``: one row for every place of a grid, all on the same draws."""

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

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import integer
from netkf.ensembles.replicas import replicate_blocks
from netkf.runs.failures import InterruptedRunError, explain_failures
from netkf.runs.files import (
    check_sources,
    new_directory,
    write_json,
    write_scenario,
    write_table,
    write_text,
)
from netkf.runs.provenance import versions
from netkf.runs.simulate import choose_engine
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import (
    Estimate,
    RunMetrics,
    block_metrics,
    bound_traces,
    central_trace,
    join_metrics,
    overall,
    root,
    worst,
)
from netkf.studies.parameter_grid import Cell, cells, shown
from netkf.studies.pools import shared_pool

if TYPE_CHECKING:
    import pandas as pd

LOAD = "load it first: netkf.sweep(netkf.load(path), ...)"
Row = dict[str, Any]
Progress = Callable[[int, int], None]


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
    """Simulate every place of a grid of key paths, ``{"network.activation.rate": [1.0, 2.0]}``.

    All places use the same seed, so the same truth, readings and luck: differences between rows are
    due to the keys. A row holds the varied keys, ``runs``; ``worst_rms`` (of the node with the
    largest), ``mean_rms`` (of all nodes together), ``mean_trace`` and ``worst_trace`` of P, each
    with its standard error ``_se`` over runs; ``bound`` and ``central``, mean traces of H(12) and
    of the covariance of the centralised filter where they exist; messages ``sent``, ``delivered``
    and ``lost`` a run; ``status``, complete or diverged. All but messages are averages over the
    samples after time 0.

    Raises ScenarioError, before anything runs, for a key or a value that is wrong.
    """
    import pandas as pd

    places = _checked(scenario, vary, runs, seed, engine)
    pool = (workers, executor, scheduler)
    return pd.DataFrame(_rows(places, runs, engine, pool, progress))


def _checked(
    scenario: Scenario, vary: Mapping[str, Sequence[Any]], runs: int, seed: int | None, engine: str
) -> list[Cell]:
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "sweep takes a netkf.Scenario", scenario, LOAD)
    integer(low=1)("runs", runs)
    base = scenario if seed is None else scenario.replace({"seed": seed})
    places = cells(base, vary)
    for place in places:
        choose_engine(engine, place.scenario)
    return places


def _rows(
    places: Sequence[Cell],
    runs: int,
    engine: str,
    pool: tuple[int | None, Executor | None, str | None],
    progress: Progress | None,
) -> Iterator[Row]:
    with shared_pool(runs, *pool) as handed:
        for k, place in enumerate(places):
            with explain_failures(place.scenario):
                task = partial(block_metrics, engine=choose_engine(engine, place.scenario))
                found = replicate_blocks(task, join_metrics, place.scenario, runs, **handed)
            yield _row(place, found)
            if progress is not None:
                progress(k + 1, len(places))


def _row(place: Cell, found: RunMetrics) -> Row:
    quantities: dict[str, Estimate] = {
        "worst_rms": root(worst(found.mean_square)),
        "mean_rms": root(overall(found.mean_square)),
        "mean_trace": overall(found.trace),
        "worst_trace": worst(found.trace),
    }
    row: Row = {key: shown(value) for key, value in place.changes.items()}
    row["runs"] = len(found.trace)
    for name, (value, error) in quantities.items():
        row |= {name: value, f"{name}_se": error}
    row["bound"] = _known(lambda: float(bound_traces(place.scenario).mean()))
    row["central"] = _known(lambda: central_trace(place.scenario))
    sent, delivered, lost = found.messages[:, :3].mean(axis=0).tolist()
    row |= {"sent": sent, "delivered": delivered, "lost": lost}
    diverged = int(found.diverged.sum())
    status = f"{diverged} diverged" if diverged else "complete"
    blurred = float(found.rounding_from.min())
    if np.isfinite(blurred) and place.scenario.plant.truth_known:
        status += f"; rounding blurs errors from {blurred:g} s on, they are left out"
    row["status"] = status
    return row


def _known(value: Callable[[], float]) -> float:
    try:
        return value()
    except TheoryError:
        return math.nan


@dataclass(frozen=True, eq=False)
class CompletedSweep:
    """What ``sweep_to_directory`` leaves: the directory and its table."""

    directory: Path
    table: pd.DataFrame
    keys: tuple[str, ...]
    seconds: float


def sweep_to_directory(
    scenario: Scenario,
    vary: Mapping[str, Sequence[Any]],
    runs: int = 1,
    out: Path | None = None,
    engine: str = "auto",
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
    finish: Callable[[CompletedSweep], None] | None = None,
) -> CompletedSweep:
    """A sweep with sweep.parquet, sweep.csv, the base scenario.toml and a manifest.json; ``finish``
    adds what else belongs to the directory. What is interrupted keeps the rows that it had.
    """
    import pandas as pd

    places, began = _checked(scenario, vary, runs, None, engine), time.perf_counter()
    check_sources(scenario)
    directory = new_directory(out, f"{scenario.name}-sweep")
    write_scenario(directory, scenario)
    notes = {"name": scenario.name, "versions": versions(), "seed": scenario.seed, "vary": vary}
    notes["runs"] = {"wanted": runs * len(places), "done": 0}
    rows: list[Row] = []
    status = "interrupted"
    write_json(directory / "manifest.json", {**notes, "status": status})
    try:
        for row in _rows(places, runs, engine, (workers, None, scheduler), progress):
            rows.append(row)  # noqa: PERF402 - what is interrupted keeps what it had
        status = "complete"
    except KeyboardInterrupt:
        raise InterruptedRunError(directory) from None
    except Exception:
        status = "failed"
        raise
    finally:
        table = pd.DataFrame(rows)
        if rows:
            write_table(
                directory / "sweep.parquet", {str(name): column for name, column in table.items()}
            )
            write_text(directory / "sweep.csv", table.to_csv(index=False))
        completed = CompletedSweep(directory, table, tuple(vary), time.perf_counter() - began)
        if status == "complete" and finish is not None:
            finish(completed)
        notes["runs"] = {"wanted": runs * len(places), "done": runs * len(rows)}
        write_json(directory / "manifest.json", {**notes, "status": status})
    return completed
