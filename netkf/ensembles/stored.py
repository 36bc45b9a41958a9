"""An ensemble that is read back from its directory."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import integer
from netkf.core.printable import shorten
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.monte_carlo import Ensemble, ensemble_of
from netkf.ensembles.statistics import MESSAGES, merge
from netkf.linalg.arrays import from_upper
from netkf.network.graphs import name_rows
from netkf.runs.documents import COUNT, NUMBER, DamagedError, check_files
from netkf.runs.files import scenario_digest
from netkf.runs.parquet_files import column_names, read_numbers
from netkf.runs.stored import SUMMARY_FORM, StoredRun, WithPromises, read_checked_document, read_run
from netkf.scenario.scenario import Scenario
from netkf.trace.schema import ensemble_columns

FORM: dict[str, Any] = {**SUMMARY_FORM, "runs": COUNT, "diverged": COUNT}
FORM["messages"] = {f"{name}?": NUMBER for name in MESSAGES}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StoredEnsemble(WithPromises, Ensemble):
    """An ensemble read back from ``directory``, with its ``manifest`` and ``summary``.

    ``status`` is complete, diverged, interrupted or failed. An unfinished ensemble has the runs of
    its readable blocks, and an empty summary.
    """

    directory: Path
    manifest: dict[str, Any]
    summary: dict[str, Any]
    status: str

    def replica(self, number: int = 0) -> StoredRun:
        """Return run ``number``, from 0; raises ScenarioError if its trace was not kept."""
        assert self.scenario is not None
        where = shorten(self.directory)
        number = integer(low=0)("replica", number)
        if not self.summary:
            remedy = "finish it with netkf run --resume"
            raise ScenarioError(where, "has no traces before it is finished", None, remedy)
        try:
            run = read_run(self.directory, self.scenario, self.manifest, number)
        except DamagedError as error:
            raise ScenarioError(where, f"cannot be read: {error}", None, "run it again") from None
        if not len(run.times):
            remedy = "run it with --trace full, or simulate that replica"
            raise ScenarioError(where, "has not kept the trace of replica", number, remedy)
        return run


def read_ensemble(directory: Path, scenario: Scenario, manifest: dict[str, Any]) -> StoredEnsemble:
    """Return the ensemble that netkf run left in a directory, whose ``manifest`` has the right keys
    and types; of an interrupted one the runs of finished blocks. Raises DamagedError.
    """
    stored: dict[str, Any] = {"directory": directory, "manifest": manifest}
    stored["status"] = str(manifest["status"])
    if not (directory / "ensemble.parquet").exists():
        blocks = BlockCheckpoints(directory, scenario)
        found = blocks.readable(scenario_digest(scenario), int(manifest["seed"]))
        if not found:
            raise DamagedError("no run of it was finished")
        ensemble = ensemble_of(
            scenario, reduce(merge, found), int(manifest["seed"]), str(manifest.get("engine", ""))
        )
        values: dict[str, Any] = {f.name: getattr(ensemble, f.name) for f in fields(Ensemble)}
        return StoredEnsemble(**values, **stored, summary={})
    check_files(directory, manifest, ["ensemble.parquet", "summary.json"])
    summary = read_checked_document(directory, "summary.json", FORM)
    name_rows(summary["nodes"])
    samples = _read_samples(directory / "ensemble.parquet", scenario)
    rows = [*summary["nodes"], summary["overall"]]
    if [row["node"] for row in summary["nodes"]] != list(scenario.nodes):
        raise DamagedError("summary.json has other nodes than the scenario")
    names = "mean_sq_error", "mean_trace", "mean_nees"
    # Means (N + 1, 3) over time and runs, and their standard errors.
    average, se_average = (
        np.array([[row.get(name + ending) for name in names] for row in rows], dtype=np.float64)
        for ending in ("", "_se")
    )
    runs, messages = summary["runs"], summary["messages"]
    blurred = summary.get("rounding_from")
    return StoredEnsemble(
        **samples,
        nodes=scenario.nodes,
        average=average,
        se_average=se_average,
        messages={k: round(v * runs) for k, v in messages.items() if v is not None},
        diverged=summary["diverged"],
        events=int(manifest.get("events", 0)),
        seed=int(manifest["seed"]),
        engine=str(manifest.get("engine", "")),
        fingerprint=str(manifest.get("fingerprint", "")),
        truth_known=scenario.plant.truth_known,
        rounding_from=np.inf if blurred is None else float(blurred),
        scenario=scenario,
        **stored,
        summary=summary,
    )


def _read_samples(path: Path, scenario: Scenario) -> dict[str, Any]:
    n, N = scenario.width, len(scenario.nodes)
    names = ensemble_columns(n)
    if not scenario.plant.truth_known:
        # Time, node, runs, and means and standard errors of P only: no errors, no NEES.
        names = names[: 3 + n * (n + 1)]
    if column_names(path) != names:
        raise DamagedError(f"{path.name} does not have the columns of this scenario")
    table = read_numbers(path, names, allow_empty=True)
    T = len(scenario.times)
    times = np.repeat(scenario.times, N)
    if not (
        np.array_equal(table["t"], times)
        and np.array_equal(table["node"], np.tile(scenario.nodes, T))
    ):
        raise DamagedError(f"{path.name} does not have a row for each time and node")
    runs = table["runs"]
    if runs.dtype.kind != "i" or (runs < 0).any():
        raise DamagedError(f"{path.name} has numbers of runs that are no counts")
    # Without ground truth the columns of errors are nan.
    columns = table.reindex(columns=ensemble_columns(n)[3:])
    values = columns.to_numpy(dtype=np.float64).reshape(T, N, -1)
    # The upper triangles of four matrices, then mean and standard error of NEES.
    matrices = [from_upper(upper, n) for upper in np.split(values[:, :, :-2], 4, axis=2)]
    return {
        "times": scenario.times.copy(),
        "runs": runs.to_numpy(dtype=np.int64)[::N],
        **dict(zip(("mean_P", "se_P", "mean_error", "se_error"), matrices, strict=True)),
        "mean_nees": values[:, :, -2],
        "se_nees": values[:, :, -1],
    }
