"""The contents of a directory for a page: a run, an ensemble, a sweep, a verdict or a comparison
of filters; its worst node and sample; and which recorded runs of an ensemble are the worst.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.printable import shorten
from netkf.ensembles.stored import StoredEnsemble
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import to_json_value
from netkf.runs.parquet_files import column_names, read_numbers
from netkf.runs.stored import StoredRun, read_checked_document
from netkf.runs.summary import PromisedTraces, SampleIndices, select_averaged_samples
from netkf.runs.tables import format_number
from netkf.scenario.scenario import Scenario
from netkf.studies.compare import damage_named
from netkf.studies.opening import VERDICT, StoredComparison, StoredSweep, StoredVerdict
from netkf.studies.opening import open as open_directory
from netkf.trace.nees import traces as traces_of

RANKS = ("worst", "median")
"""Runs that can be asked for by their errors."""
QUANTILES = (0.5, 0.05, 0.95)
MAX_VALUES = 60_000
"""Numbers of a page that show how runs spread; larger networks go without."""


class Replicas(NamedTuple):
    """R recorded runs of an ensemble, with ground truth.

    numbers : (R,) of the replicas, in the order of their errors, the smallest first
    errors  : (R,) RMS error of all nodes over the samples after time 0
    spread  : (T, N, 3) median and 5 % and 95 % quantiles over the runs of |x - xhat|
    """

    numbers: np.ndarray
    errors: FloatArray
    spread: FloatArray

    def describe(self, number: int) -> str:
        """Return a replica with its rank, if it has one, and its error."""
        place = self.index_of(number)
        if place is None:
            return f"replica {number}"
        ranks = "".join(f"{rank}, " for rank in RANKS if self.index_of_rank(rank) == place)
        return f"replica {number} ({ranks}RMS error {format_number(float(self.errors[place]))})"

    def index_of_rank(self, rank: str) -> int:
        """Return the place in ``numbers`` of a rank, ``worst`` or ``median``."""
        return len(self.numbers) - 1 if rank == "worst" else (len(self.numbers) - 1) // 2

    def index_of(self, number: int) -> int | None:
        """Return the place in ``numbers`` of a replica, None if it was not recorded."""
        return next(iter(np.flatnonzero(self.numbers == number).tolist()), None)


def read_replicas(stored: StoredEnsemble) -> Replicas | None:
    """Return the recorded runs of an ensemble; None unless errors of several were kept."""
    path = stored.directory / "states.parquet"
    if not stored.summary or not path.exists() or "sq_error" not in column_names(path):
        return None
    states = read_numbers(path, ["run", "t", "node", "sq_error"], allow_empty=True)
    after = states[states["t"] > 0.0].groupby("run")["sq_error"].mean().dropna()
    if len(after) < 2:
        return None
    after = after.sort_values(kind="stable")
    by_sample = states.groupby(["t", "node"])["sq_error"].quantile(np.array(QUANTILES))
    shape = len(stored.times), len(stored.nodes), len(QUANTILES)
    size = shape[0] * shape[1] * shape[2]
    roots = np.sqrt(by_sample.to_numpy()) if len(by_sample) == size else np.full(size, np.nan)
    numbers = after.index.to_numpy().astype(int)
    return Replicas(numbers, np.sqrt(after.to_numpy()), roots.reshape(shape))


def choose_replica(
    stored: StoredEnsemble, found: Replicas | None, replica: int | str | None
) -> int | None:
    """Return the number of the ``replica`` asked for; raises ScenarioError."""
    if not isinstance(replica, str):
        return replica
    if replica not in RANKS:
        rule = f"must be a number, {' or '.join(RANKS)}"
        raise ScenarioError("replica", rule, replica, "correct it")
    if found is None:
        where, rule = shorten(Path(stored.directory)), "has not kept the errors of several runs"
        raise ScenarioError(where, rule, None, "run it with --trace full")
    return int(found.numbers[found.index_of_rank(replica)])


def describe_replica(shown: int, runs: int, replicas: Replicas | None) -> str:
    """Return which run of an ensemble moves on a page, and how to see another one."""
    sentence = f"The run that moves below is replica {shown} of {runs:,}"
    if replicas is None:
        return f"{sentence}; its trace is what was kept (--trace full keeps all)"
    place = replicas.index_of(shown)
    if place is not None:
        sentence += f", RMS error {format_number(float(replicas.errors[place]))}, number "
        sentence += f"{place + 1} from the best"
    ends = [
        f"{rank} is {replicas.numbers[k]} ({format_number(float(replicas.errors[k]))})"
        for rank, k in ((rank, replicas.index_of_rank(rank)) for rank in RANKS)
    ]
    return (
        f"{sentence}. Of {len(replicas.numbers):,} recorded runs the {', the '.join(ends)}: choose "
        "them at Run, below; netkf report --replica begins with any other"
    )


def spread_curves(replicas: Replicas | None, nodes: tuple[int, ...]) -> dict[str, Any] | None:
    """Return median, 5 % and 95 % of the errors of each node over time, as JSON values."""
    if replicas is None or replicas.spread.size > MAX_VALUES:
        return None
    return {
        str(node): [to_json_value(curve.tolist()) for curve in found.T]
        for node, found in zip(nodes, np.moveaxis(replicas.spread, 1, 0), strict=True)
    }


START_UP_RATIO, LATE_SHARE = 0.8, 0.25
"""Trace P has a start-up if its mean over the last quarter of the samples is below this share of
its first value."""


class WorstSample(NamedTuple):
    """The worst sample, at ``time`` seconds, of a node.

    value    : with ground truth the RMS error of the node over time, else the square root of its
               mean trace of P
    peak     : with ground truth the error at ``time``, else the square root of the trace of P then
    by_error : True with ground truth
    """

    node: int
    time: float
    value: float
    peak: float
    by_error: bool


class StartUp(NamedTuple):
    """The start-up of a node's filter: trace P at the ``first`` sample and at the worst one
    (``now``), and its mean over the ``last`` quarter of the samples.
    """

    first: float
    now: float
    last: float


class WorstSamples(NamedTuple):
    """The worst sample of a run.

    overall   : the worst sample of the worst node, that with the largest RMS error over time or,
                without ground truth, the largest mean trace of P
    explained : its worst sample after the start-up of its filter, in which trace P falls from its
                initial value halfway to the mean of its last ones; a page explains it
    start     : the start-up if the overall worst sample lies in it, else None
    """

    overall: WorstSample
    explained: WorstSample
    start: StartUp | None


def find_worst_samples(run: StoredRun, summary: Mapping[str, Any]) -> WorstSamples | None:
    """Return the worst samples of a run, None if no node has a finite mean."""
    if not len(run.times) or not run.nodes:
        return None
    by_error, averaged = run.truth_known, summary_samples(run, summary)
    traces = traces_of(run.P)
    square, rows = (run.sq_error, averaged.errors) if by_error else (traces, averaged.covariances)
    with np.errstate(all="ignore"):
        means = square[rows].mean(axis=0) if len(rows) else np.full(len(run.nodes), np.nan)
    if not np.isfinite(means).any():
        return None
    column = int(np.nanargmax(np.where(np.isfinite(means), means, -np.inf)))
    value = math.sqrt(max(0.0, float(means[column])))

    def worst_of(some: np.ndarray) -> WorstSample:
        row = int(some[np.argmax(square[some, column])])
        peak = math.sqrt(max(0.0, float(square[row, column])))
        return WorstSample(run.nodes[column], float(run.times[row]), value, peak, by_error)

    worst = worst_of(rows)
    trace = traces[:, column]
    first, now = float(trace[0]), float(trace[np.searchsorted(run.times, worst.time)])
    last = float(trace[-max(1, int(LATE_SHARE * len(trace))) :].mean())
    low = np.flatnonzero(trace <= 0.5 * (first + last))
    # No start-up, or the worst sample comes after it.
    if not last < START_UP_RATIO * first or not len(low) or run.times[low[0]] <= worst.time:
        return WorstSamples(worst, worst, None)
    later = rows[rows >= low[0]]
    return WorstSamples(worst, worst_of(later) if len(later) else worst, StartUp(first, now, last))


def summary_samples(run: StoredRun, summary: Mapping[str, Any]) -> SampleIndices:
    """Return the indices of the samples that the averages in summary.json are taken over."""
    rounding_from = summary.get("rounding_from")
    end = math.inf if rounding_from is None else float(rounding_from)
    return select_averaged_samples(run.times, end, run.count("diverged") > 0)


MAX_TEXT = 200_000
"""Characters of a scenario file that a page repeats."""
SLOT_ROUNDING = 1e-6
"""Fraction of a slot by which rounding may put the time of a sample before the slot begins."""


@dataclass(frozen=True, eq=False)
class ReportSource:
    """The contents of a directory for a page; None or empty if the directory does not have them.

    label         : the directory as the user has named it
    manifest      : the contents of manifest.json
    scenario_text : the scenario file
    run           : the recorded run, or one recorded run of an ensemble, with its trace
    replicas      : the recorded runs of an ensemble by their errors, if several were kept
    filters       : a comparison of filters
    verdict       : the contents of verdict.json
    """

    label: str
    manifest: dict[str, Any]
    scenario: Scenario
    scenario_text: str
    run: StoredRun | None = None
    ensemble: StoredEnsemble | None = None
    replicas: Replicas | None = None
    sweep: StoredSweep | None = None
    filters: StoredComparison | None = None
    verdict: dict[str, Any] | None = None

    @property
    def kind(self) -> str:
        """The kind of results: run, ensemble, sweep, filters or verdict."""
        if self.sweep is not None:
            return "sweep"
        if self.filters is not None:
            return "filters"
        if self.ensemble is not None:
            return "ensemble"
        return "run" if self.run is not None else "verdict"

    @property
    def shown(self) -> str:
        """The label, for an ensemble with the number of the run that is shown."""
        if self.ensemble is None or self.run is None:
            return self.label
        return f"{self.label}, replica {self.run.replica}"

    def other_runs(self) -> list[ReportSource]:
        """Return the worst and the median recorded run of an ensemble, unless shown."""
        if self.ensemble is None or self.run is None or self.replicas is None:
            return []
        numbers = {int(self.replicas.numbers[self.replicas.index_of_rank(rank)]) for rank in RANKS}
        others = sorted(numbers - {self.run.replica})
        return [replace(self, run=self.ensemble.replica(number)) for number in others]

    @property
    def summary(self) -> dict[str, Any]:
        """The contents of summary.json, empty if there is none."""
        stored = self.ensemble if self.ensemble is not None else self.run
        return {} if stored is None else stored.summary

    @property
    def promised(self) -> PromisedTraces | None:
        """Bounds and limits of trace P at the sample times, None without samples."""
        stored = self.ensemble if self.ensemble is not None else self.run
        return None if stored is None or not len(stored.times) else stored.promised

    @cached_property
    def worst(self) -> WorstSamples | None:
        """The worst samples of the run, None without a run or a finite sample."""
        return None if self.run is None else find_worst_samples(self.run, self.summary)

    @property
    def runs(self) -> int:
        """The number of finished runs."""
        return int(self.manifest["runs"]["done"])

    @property
    def status(self) -> str:
        """The status in the manifest, such as ``complete`` or ``interrupted``."""
        return str(self.manifest["status"])

    @property
    def knowledge(self) -> str:
        """Return which messages the estimates sampled at time t include: ``until`` (arrived at t
        or earlier), ``before`` (earlier than t: slots whose samples are predictions) or ``slot``
        (also those of the slot that begins at t: slots whose samples are filtered).
        """
        if not self.scenario.slotted:
            return "until"
        return "before" if self.scenario.node_filter.timing.predicts else "slot"

    @property
    def period(self) -> float:
        """The length of a slot in seconds, 0 under clocks."""
        return float(self.scenario.slot_plant.period) if self.scenario.slotted else 0.0

    def cutoffs(self, times: FloatArray) -> FloatArray:
        """Return the latest arrivals (T,) that estimates at ``times`` (T,) include."""
        knowledge = self.knowledge
        if knowledge == "until":  # under clocks: all that arrived by then
            return times
        # nextafter excludes arrivals at the very instant.
        if knowledge == "before":
            return np.nextafter(times, -np.inf)
        # Filtered samples have the exchanges of the slot that begins there: until its end.
        ends = (np.floor(times / self.period + SLOT_ROUNDING) + 1.0) * self.period
        return np.asarray(np.nextafter(ends, -np.inf))


def read_source(
    directory: Path, replica: int | str | None = None, trust: bool = False
) -> ReportSource:
    """Return the contents of a directory of netkf, and the ``replica`` of an ensemble, by number,
    "worst" or "median" by RMS error; ``trust`` imports classes. Raises ScenarioError.
    """
    stored = open_directory(directory, trust=trust)
    label, text = str(directory), (directory / "scenario.toml").read_text(encoding="utf-8")
    if len(text) > MAX_TEXT:
        text = f"{text[:MAX_TEXT]}\n# ({len(text):,} characters)"
    if replica is not None and not isinstance(stored, StoredRun | StoredEnsemble):
        raise ScenarioError(shorten(label), "holds no replica", replica, "leave out --replica")
    if isinstance(stored, StoredSweep):
        return ReportSource(label, stored.manifest, stored.scenario, text, sweep=stored)
    if isinstance(stored, StoredComparison):
        return ReportSource(label, stored.manifest, stored.base, text, filters=stored)
    if isinstance(stored, StoredVerdict):
        manifest = {
            "seed": stored.seed,
            "status": "complete",
            "runs": {"done": stored.runs, "wanted": stored.runs},
            "versions": stored.document.get("versions", {}),
        }
        return ReportSource(label, manifest, stored.scenario, text, verdict=stored.document)
    verdict = None
    if (directory / "verdict.json").exists():
        with damage_named(directory):
            verdict = read_checked_document(directory, "verdict.json", VERDICT)
    ensemble = stored if isinstance(stored, StoredEnsemble) else None
    replicas = None if ensemble is None else read_replicas(ensemble)
    scenario = stored.scenario
    assert isinstance(scenario, Scenario)
    return ReportSource(
        label=label,
        manifest=stored.manifest,
        scenario=scenario,
        scenario_text=text,
        run=_choose_run(stored, replicas, replica),
        ensemble=ensemble,
        replicas=replicas,
        verdict=verdict,
    )


def _choose_run(
    stored: StoredRun | StoredEnsemble, replicas: Replicas | None, replica: int | str | None
) -> StoredRun | None:
    if isinstance(stored, StoredRun):
        if replica is not None and replica != stored.replica:
            where = shorten(stored.directory)
            raise ScenarioError(where, "holds no replica", replica, "leave out --replica")
        return stored
    replica = choose_replica(stored, replicas, replica)
    # Without a trace (events and samples) of any run there is nothing to animate.
    if replica is None and not (stored.directory / "states.parquet").exists():
        return None
    return stored.replica(replica or 0)
