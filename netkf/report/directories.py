"""What a page shows of one directory: a run, an ensemble, a sweep, a verdict or a comparison."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.printable import shorten
from netkf.ensembles.stored import StoredEnsemble
from netkf.linalg.arrays import FloatArray
from netkf.report.worst import WorstSample, worst_sample
from netkf.runs.documents import NUMBER, TEXT, TEXTS, require_form
from netkf.runs.stored import StoredRun, read_checked_document
from netkf.runs.summary import PromisedTraces
from netkf.runs.tables import COLUMNS
from netkf.scenario.scenario import Scenario
from netkf.studies.compare import damage_named
from netkf.studies.opening import StoredSweep
from netkf.studies.opening import open as open_directory
from netkf.studies.stored import VERDICT, StoredComparison, StoredVerdict

MAX_TEXT = 200_000
"""Characters of a scenario file that a page repeats."""
SLOT_ROUNDING = 1e-6
"""Share of a slot by which the time of a sample may lie before the slot begins."""
ROW: dict[str, Any] = dict.fromkeys(COLUMNS, NUMBER)
SUMMARY: dict[str, Any] = {
    "nodes": [ROW],
    "overall": ROW,
    **dict.fromkeys(("limit", "central"), NUMBER),
    "bound": TEXT,
    "notes": TEXTS,
    "messages": {"in_flight?": NUMBER},
}
"""What a page needs of summary.json, beside what ``netkf.open`` has checked."""


@dataclass(frozen=True, eq=False)
class Opened:
    """A directory as a page shows it; what it does not have is None or empty.

    ``label`` is the directory as the user has named it; ``run`` a recorded run with its trace, of
    an ensemble too; ``filters`` a comparison of filters; ``verdict`` the contents of verdict.json.
    """

    label: str
    manifest: dict[str, Any]
    scenario: Scenario
    scenario_text: str
    run: StoredRun | None = None
    ensemble: StoredEnsemble | None = None
    sweep: StoredSweep | None = None
    filters: StoredComparison | None = None
    verdict: dict[str, Any] | None = None

    @property
    def kind(self) -> str:
        """Return the kind of the directory: run, ensemble, sweep, filters or verdict."""
        if self.sweep is not None:
            return "sweep"
        if self.filters is not None:
            return "filters"
        if self.ensemble is not None:
            return "ensemble"
        return "run" if self.run is not None else "verdict"

    @property
    def summary(self) -> dict[str, Any]:
        """Return the contents of summary.json, empty if there is none."""
        found = self.ensemble if self.ensemble is not None else self.run
        return {} if found is None else found.summary

    @property
    def promised(self) -> PromisedTraces | None:
        """Return bounds and limits at the sample times, None without samples."""
        found = self.ensemble if self.ensemble is not None else self.run
        return None if found is None or not len(found.times) else found.promised

    @cached_property
    def worst(self) -> WorstSample | None:
        """Return the worst sample of the run, None without one."""
        return None if self.run is None else worst_sample(self.run, self.summary)

    @property
    def runs(self) -> int:
        """Return the number of runs that are done."""
        return int(self.manifest["runs"]["done"])

    @property
    def status(self) -> str:
        """Return the status of the manifest, such as ``complete`` or ``interrupted``."""
        return str(self.manifest["status"])

    @property
    def knowledge(self) -> str:
        """Return what a sample at t knows: what arrived ``until`` t, ``before`` t (slots whose
        samples are predictions), or in the ``slot`` that begins at t (slots whose samples are
        filtered).
        """
        if not self.scenario.slotted:
            return "until"
        return "before" if self.scenario.node_filter.predicts else "slot"

    @property
    def period(self) -> float:
        """Return the seconds of a slot, 0 under clocks."""
        return float(self.scenario.slot_plant.period) if self.scenario.slotted else 0.0

    def cuts(self, times: FloatArray) -> FloatArray:
        """Return, for samples at ``times`` (T,), the last instants (T,) that they know of."""
        kind = self.knowledge
        if kind == "until":
            return times
        if kind == "before":
            return np.nextafter(times, -np.inf)
        ends = (np.floor(times / self.period + SLOT_ROUNDING) + 1.0) * self.period
        return np.asarray(np.nextafter(ends, -np.inf))


def read_source(directory: Path, replica: int | None = None, trust: bool = False) -> Opened:
    """Return what a page shows of a directory of ``netkf run``, ``sweep``, ``check`` or
    ``compare-filters``.

    ``replica`` chooses one of the recorded runs of an ensemble, by default the first. Runs that
    were interrupted or failed are read as far as they came. ``trust`` imports classes that the
    scenario names. Raises ScenarioError if the directory is not one of netkf's, or if its files
    were changed since they were written.
    """
    found = open_directory(directory, trust=trust)
    text = _read_text(directory / "scenario.toml")
    if isinstance(found, StoredSweep):
        return Opened(str(directory), found.manifest, found.scenario, text, sweep=found)
    if isinstance(found, StoredComparison):
        return Opened(str(directory), found.manifest, found.base, text, filters=found)
    if isinstance(found, StoredVerdict):
        manifest = _verdict_manifest(found)
        document = found.document
        return Opened(str(directory), manifest, found.scenario, text, verdict=document)
    verdict = None
    if (directory / "verdict.json").exists():
        with damage_named(directory):
            verdict = read_checked_document(directory, "verdict.json", VERDICT)
    if found.summary:
        with damage_named(directory):
            require_form(found.summary, SUMMARY, "summary.json")
    run, ensemble = _choose_run(found, replica)
    scenario = found.scenario
    assert isinstance(scenario, Scenario)
    return Opened(str(directory), found.manifest, scenario, text, run, ensemble, verdict=verdict)


def _choose_run(
    found: StoredRun | StoredEnsemble, replica: int | None
) -> tuple[StoredRun | None, StoredEnsemble | None]:
    """Return the run to show in motion, and the ensemble that it is of."""
    if isinstance(found, StoredRun):
        if replica is not None and replica != found.replica:
            where = shorten(found.directory)
            raise ScenarioError(where, "holds no replica", replica, "leave out --replica")
        return found, None
    if replica is None and not (found.directory / "states.parquet").exists():
        return None, found
    return found.replica(replica or 0), found


def _verdict_manifest(found: StoredVerdict) -> dict[str, Any]:
    """Return what stands for the manifest of a directory that holds a verdict only."""
    runs = {"done": found.runs, "wanted": found.runs}
    versions = found.document.get("versions", {})
    return {"seed": found.seed, "status": "complete", "runs": runs, "versions": versions}


def _read_text(path: Path) -> str:
    """Return the text of a scenario file that could be loaded."""
    text = path.read_text(encoding="utf-8")
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}\n# ({len(text):,} characters)"
