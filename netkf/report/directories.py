"""The contents of a directory for a page: a run, an ensemble, a sweep, a verdict or a comparison
of filters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.printable import shorten
from netkf.ensembles.stored import StoredEnsemble
from netkf.linalg.arrays import FloatArray
from netkf.report.replicas import RANKS, Replicas, choose_replica, read_replicas
from netkf.report.worst import WorstSamples, find_worst_samples
from netkf.runs.stored import StoredRun, read_checked_document
from netkf.runs.summary import PromisedTraces
from netkf.scenario.scenario import Scenario
from netkf.studies.compare import damage_named
from netkf.studies.opening import VERDICT, StoredComparison, StoredSweep, StoredVerdict
from netkf.studies.opening import open as open_directory

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
