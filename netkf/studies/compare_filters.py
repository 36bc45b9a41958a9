"""``netkf.compare_filters``: filters on one truth, one network and the same draws."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter
from netkf.core.errors import EngineError, ScenarioError, suggest_nearest
from netkf.core.fields import integer, number, require_runs
from netkf.core.notebook import NotebookTable
from netkf.core.printable import one_line, shorten
from netkf.ensembles.pool import Pool
from netkf.ensembles.pools import PoolOptions, make_pool
from netkf.ensembles.replicas import Progress, replicate_blocks, results_of
from netkf.runs.curves import ErrorCurve
from netkf.runs.documents import file_digests, write_sealed
from netkf.runs.failures import explain_failures
from netkf.runs.files import check_sources, create_output_directory, write_scenario, write_text
from netkf.runs.parquet_files import write_table
from netkf.runs.provenance import versions
from netkf.runs.quantities import NETWORK, sample_names
from netkf.runs.simulate import choose_engine, require_scenario
from netkf.scenario.plugins import offered_kinds
from netkf.scenario.registry import list_kinds, name_of
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import check_filter_table
from netkf.scenario.writing import as_table, part_as_table
from netkf.studies.metrics import (
    JUDGED,
    VALUES,
    FilterValues,
    Quantity,
    block_values,
    count_traffic,
    credibility,
    curve_rows,
    estimate_quantities,
    join_batches,
    mean_curve,
)
from netkf.trace.run import plot_by_name

if TYPE_CHECKING:
    import pandas as pd

CURVES = "errors.parquet"
CARRIED = ("mean", "cov", "model", "estimates")
"""Keys of ``[filter]`` that every compared filter takes over from the scenario."""
MAX_FILTERS = 200
Choice = str | Mapping[str, Any] | Filter
"""A filter: its kind, its table in a scenario file, or an object."""


class FilterEntry(NamedTuple):
    """A filter to compare: its ``label``, and its scenario or why it cannot run there."""

    label: str
    scenario: Scenario | None
    reason: str = ""


@dataclass(frozen=True)
class ComparedFilter:
    """One filter of a comparison.

    quantities    : rms_error, nees_ratio (NEES / n), worst_instant (mean over runs of the largest
                    error of any node at any sample), and the other quantities of samples of
                    summaries; empty if it cannot run
    consistency   : "consistent", "overconfident" or "conservative", by NEES / n, "-" where unknown
                    or of recorded states or readings
    traffic       : the quantities of the network in summaries, of replica 0: transmissions (a
                    broadcast counts once), bytes, ages, ...; empty if it cannot run
    status        : "complete", how many runs diverged, or why it cannot run there
    predicts      : True if its samples in slots are predictions, not filtered
    same_losses   : False if its messages and those of the first filter that ran meet other losses
                    and delays in slots, because their exchanges are other ones
    """

    filter: str
    quantities: Mapping[str, Quantity]
    consistency: str
    traffic: Mapping[str, float]
    status: str
    predicts: bool = False
    same_losses: bool = True

    @property
    def ran(self) -> bool:
        """True if it can run there."""
        return bool(self.quantities)

    @property
    def transmissions(self) -> float:
        """Transmissions in replica 0, nan if it cannot run."""
        return self.traffic.get("transmissions", math.nan)

    @property
    def bytes(self) -> float:
        """Bytes transmitted in replica 0, nan if it cannot run."""
        return self.traffic.get("bytes", math.nan)

    @property
    def rms_error(self) -> Quantity:
        """The RMS error, with its difference from that of the first filter."""
        return self.quantities["rms_error"]

    def document(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the row of the table with the quantities ``names``, nan where one is missing."""
        row: dict[str, Any] = {"filter": self.filter}
        for name in names:
            quantity = self.quantities.get(name, Quantity(math.nan, math.nan))
            row[name] = quantity.value
            for part in ("se", "difference", "low", "high", "real"):
                row[f"{name}_{part}"] = getattr(quantity, part)
        row |= {name: self.traffic.get(name, math.nan) for name in NETWORK}
        names = ("consistency", "predicts", "same_losses", "status")
        return row | {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class FilterComparison(NotebookTable):
    """Filters side by side; all intervals of differences from the first that can run hold together
    with probability ``confidence``. ``curves`` are mean square errors of those that ran.
    """

    scenario: str
    runs: int
    seed: int
    confidence: float
    rows: tuple[ComparedFilter, ...]
    curves: tuple[ErrorCurve, ...] = field(compare=False)

    def plot(self, figure: str = "error") -> Any:
        """Return the mean square errors of all filters over time as a matplotlib Figure; there is
        ``error`` only. Raises ScenarioError for another name.
        """
        return plot_by_name(self, figure)

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per filter."""
        import pandas as pd

        return pd.DataFrame([row.document(self.quantities) for row in self.rows])

    @property
    def quantities(self) -> tuple[str, ...]:
        """The names of the quantities of filters that ran."""
        return next(tuple(row.quantities) for row in self.rows if row.ran)

    def __repr__(self) -> str:
        names = one_line(", ".join(row.filter for row in self.rows))
        return f"<netkf comparison of filters on {self.scenario!r}: {names}; {self.runs:,} runs>"

    @property
    def first(self) -> str:
        """The filter from which differences are taken."""
        return next(row.filter for row in self.rows if row.ran)

    def document(self) -> dict[str, Any]:
        """Return plain JSON values."""
        rows = [row.document(self.quantities) for row in self.rows]
        names = ("scenario", "runs", "seed", "confidence")
        return {**{name: getattr(self, name) for name in names}, "first": self.first, "rows": rows}


@np.errstate(under="ignore")
def compare_filters(
    scenario: Scenario,
    filters: Sequence[Choice],
    runs: int = 100,
    seed: int | None = None,
    confidence: float = 0.95,
    *,
    engine: str = "auto",
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> FilterComparison:
    """Simulate a scenario with each of several filters, on the same truth, readings and draws of
    the network, and compare errors, consistency and traffic run by run.

    A filter is a kind (``"hcmci"``), a table (``{"kind": "hcmci", "steps": 3}``) or an object of
    netkf.parts. All begin with the initial estimate of the scenario's own filter and use its model,
    unless a table has others; the scenario's own kind, given by name, also has its settings. The
    row of a filter that cannot run in the scenario has the reason. All marks of differences are
    right together with probability ``confidence``. ``runs``, ``seed`` and the other options are
    those of ``netkf.monte_carlo``, for each filter.

    Raises ScenarioError if no filter can run, if there is no such kind, or for a table with a wrong
    key or value.
    """
    require_scenario(scenario, "compare_filters", ", ...")
    confidence = number(above=0.0, below=1.0)("confidence", confidence)
    count = require_runs(runs)
    root = scenario.seed if seed is None else integer(low=0)("seed", seed)
    entries = _candidates(scenario, filters, engine)
    able = [entry for entry in entries if entry.scenario is not None]
    simulated: dict[str, SimulatedFilter] = {}
    with make_pool(count, PoolOptions(workers, executor, scheduler), open_ended=True) as pool:
        simulate = partial(_simulate, runs=count, seed=root, engine=engine, pool=pool)
        found = results_of(partial(simulate, entry.scenario) for entry in able)
        for entry, values in zip(able, found, strict=True):
            simulated[entry.label] = _summarise(entry, values, root, engine)
            if progress is not None:
                progress(len(simulated), len(able))
    # Bonferroni: all differences from the first filter hold together.
    level = (1.0 - confidence) / (len(JUDGED) * max(1, len(simulated) - 1))
    with explain_failures(scenario):
        rows = tuple(_make_row(scenario, entry, simulated, level) for entry in entries)
    return FilterComparison(
        scenario=scenario.name,
        runs=count,
        seed=root,
        confidence=confidence,
        rows=rows,
        curves=tuple(one.curve for one in simulated.values() if one.curve is not None),
    )


def _simulate(scenario: Scenario, pool: Pool, *, runs: int, seed: int, engine: str) -> FilterValues:
    task = partial(
        block_values, engine=choose_engine(engine, scenario), rows=curve_rows(scenario, runs)
    )
    with explain_failures(scenario):
        found: FilterValues = replicate_blocks(
            task, join_batches, scenario, runs, seed, pool=pool, form=VALUES
        )
        return found


class SimulatedFilter(NamedTuple):
    """The results of a filter in its ``scenario``: values of its runs without curves, the mean
    curve of errors (None without ground truth), and the traffic of replica 0.
    """

    scenario: Scenario
    values: FilterValues
    curve: ErrorCurve | None
    traffic: dict[str, float]


def _summarise(entry: FilterEntry, values: FilterValues, seed: int, engine: str) -> SimulatedFilter:
    scenario = entry.scenario
    assert scenario is not None
    curve = mean_curve(entry.label, scenario, values.curves) if scenario.plant.truth_known else None
    traffic = count_traffic(scenario, seed, choose_engine(engine, scenario, announce=False))
    return SimulatedFilter(scenario, values._replace(curves=np.empty((0, 0))), curve, traffic)


def _make_row(
    scenario: Scenario, entry: FilterEntry, simulated: Mapping[str, SimulatedFilter], level: float
) -> ComparedFilter:
    if entry.scenario is None:
        # No quantities, consistency and traffic, but the reason why it cannot run.
        return ComparedFilter(entry.label, {}, "-", {}, entry.reason)
    own, first = simulated[entry.label], next(iter(simulated.values()))
    base, n = None if own is first else first.values, float(scenario.sizes.mean())
    runs, diverged = len(own.values.diverged), int(own.values.diverged.sum())
    return ComparedFilter(
        entry.label,
        estimate_quantities(own.values, base, n, sample_names(scenario), level),
        # All runs have one and the same record: NEES differs from n by that as well as by P.
        credibility(own.values, n, level) if own.scenario.is_random else "-",
        own.traffic,
        f"{diverged} of {runs} runs diverged" if diverged else "complete",
        predicts=own.scenario.slotted and own.scenario.node_filter.timing.predicts,
        same_losses=_meet_same_losses(own.scenario, first.scenario),
    )


def _meet_same_losses(scenario: Scenario, other: Scenario) -> bool:
    """Return True unless messages of two filters in one slot meet different losses or delays."""
    filters = scenario.node_filter, other.node_filter
    is_ideal = scenario.delivers_all or not all(one.timing.talks for one in filters)
    if is_ideal or not scenario.slotted:
        return True
    first, second = (
        (one.timing.first_exchange, [one.timing.steps(k) for k in range(one.timing.exchanges)])
        for one in filters
    )
    return first == second


def _candidates(scenario: Scenario, filters: Any, engine: str) -> tuple[FilterEntry, ...]:
    if isinstance(filters, str) or not isinstance(filters, Sequence) or not filters:
        rule, remedy = "must be a list of filters", 'such as ["hcmci", "icf"]'
        raise ScenarioError("filters", rule, filters, remedy)
    if len(filters) > MAX_FILTERS:
        rule = f"must be at most {MAX_FILTERS} filters"
        raise ScenarioError("filters", rule, len(filters), "compare fewer at a time")
    entries = [_make_candidate(scenario, choice, engine) for choice in filters]
    labels = _distinct_labels(filters, [candidate.label for candidate in entries])
    entries = [entry._replace(label=label) for entry, label in zip(entries, labels, strict=True)]
    for label in labels:
        if labels.count(label) > 1:
            raise ScenarioError("filters", "must differ from each other", label, "remove one")
    if all(candidate.scenario is None for candidate in entries):
        problem = f"none of them can run there; {entries[0].label}: {entries[0].reason}"
        raise ScenarioError("filters", problem, None, "choose others, or change the scenario")
    return tuple(entries)


def _make_candidate(scenario: Scenario, choice: Choice, engine: str) -> FilterEntry:
    """Return the filter ``choice`` with its scenario or the reason why it cannot run there."""
    if isinstance(choice, Filter):
        filtering = dataclasses.replace(scenario.filter, algorithm=choice)
        make = partial(dataclasses.replace, scenario, filter=filtering)
        label = _make_label(name_of("filter", choice), {})
    else:  # the name of a kind, or a table of a scenario file
        table = _filter_table(scenario, choice)
        settings = (
            {} if isinstance(choice, str) else {k: v for k, v in choice.items() if k != "kind"}
        )
        label = _make_label(str(table["kind"]), settings)
        if settings:  # what is misspelled in them is no matter of the scenario
            check_filter_table(scenario, table)
        make = partial(scenario.replace, {"filter": table})
    try:
        candidate = make()
        choose_engine(engine, candidate, announce=False)
    except (ScenarioError, EngineError) as error:
        return FilterEntry(label, scenario=None, reason=f"cannot run here: {error}")
    return FilterEntry(label, candidate)


def _distinct_labels(filters: Sequence[Choice], labels: list[str]) -> list[str]:
    """Return ``labels``; those that several filters share get the settings that differ."""
    distinct = list(labels)
    for label in {item for item in labels if labels.count(item) > 1}:
        indices = [k for k, item in enumerate(labels) if item == label]
        objects = [filters[k] for k in indices]
        # A kind or a table beside an object of that kind: nothing tells what differs.
        if not all(isinstance(item, Filter) for item in objects):
            continue
        for k, settings in zip(indices, _differing_settings(objects), strict=True):
            distinct[k] = _make_label(label, settings)
    return distinct


def _differing_settings(filters: Sequence[Any]) -> list[dict[str, str]]:
    tables = [
        {name: one_line(value) for name, value in part_as_table(algorithm).items()}
        for algorithm in filters
    ]
    names = dict.fromkeys(name for table in tables for name in table)
    differing = [name for name in names if len({table.get(name) for table in tables}) > 1]
    # A setting that a table leaves out is at its default, which the filter has as an attribute.
    return [
        {name: shorten(table.get(name, str(getattr(algorithm, name)))) for name in differing}
        for algorithm, table in zip(filters, tables, strict=True)
    ]


def _make_label(kind: str, settings: Mapping[str, Any]) -> str:
    return " ".join([kind, *(f"{key}={value}" for key, value in settings.items())])


def _filter_table(scenario: Scenario, choice: Any) -> dict[str, Any]:
    """Return the table [filter] for a ``choice``, with the scenario's start and model."""
    if not isinstance(choice, (str, Mapping)):
        remedy = "give kinds, tables {kind = ...} or filters"
        raise ScenarioError("filters", "must hold filters", choice, remedy)
    own_table = as_table(scenario)["filter"]
    table = {"kind": choice} if isinstance(choice, str) else dict(choice)
    kind = table.get("kind")
    kinds = sorted([*list_kinds("filter"), *offered_kinds()])
    # A kind with a colon, module:Class, is a user's class.
    if not isinstance(kind, str) or (":" not in kind and kind not in kinds):
        hint = suggest_nearest(kind, kinds) if isinstance(kind, str) else ""
        raise ScenarioError(
            "filters", "is no filter", kind, f"{hint}filters are {', '.join(kinds)}"
        )
    carried = {key: value for key, value in own_table.items() if key in CARRIED}
    if isinstance(choice, str) and kind == own_table["kind"]:  # with the scenario's settings
        return dict(own_table)
    return {**carried, **table}


def write_comparison(
    scenario: Scenario, comparison: FilterComparison, out: Path | None = None
) -> Path:
    """Write the files of a comparison into a new directory, and return it; raises ScenarioError."""
    check_sources(scenario)
    directory = create_output_directory(out, f"{scenario.name}-filters")
    write_scenario(directory, scenario)
    table = comparison.table
    write_table(directory / "filters.parquet", {str(k): column for k, column in table.items()})
    write_text(directory / "filters.csv", table.to_csv(index=False))
    files = ["scenario.toml", "filters.parquet"]
    if comparison.curves:
        write_table(directory / CURVES, _curve_columns(comparison.curves))
        files.append(CURVES)
    manifest = {
        "name": scenario.name,
        "versions": versions(),
        "seed": comparison.seed,
        "filters": [row.filter for row in comparison.rows],
        "confidence": comparison.confidence,
        "runs": {"wanted": comparison.runs, "done": comparison.runs},
        "status": "complete",
        "files": file_digests(directory, files),
    }
    write_sealed(directory / "manifest.json", manifest)
    return directory


def _curve_columns(curves: Sequence[ErrorCurve]) -> dict[str, Any]:
    """Return columns with a row per filter and time, nan where a filter has no such value."""
    errors = [np.full(len(c.times), np.nan) if c.se is None else c.se for c in curves]
    bounds = [np.full(len(c.times), np.nan) if c.bound is None else c.bound for c in curves]
    return {
        "filter": [curve.label for curve in curves for _ in curve.times],
        "t": np.concatenate([curve.times for curve in curves]),
        "mse": np.concatenate([curve.square for curve in curves]),
        "mse_se": np.concatenate(errors),
        "bound": np.concatenate(bounds),
        "central": np.repeat([c.central for c in curves], [len(c.times) for c in curves]),
    }
