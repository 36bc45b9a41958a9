"""What exports write, and of what."""

from __future__ import annotations

from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.runs.files import make_directory, require_own
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


def require_run(run: object) -> Scenario:
    """Return the scenario of a run; raises ScenarioError for what is no run, or has none."""
    scenario = run.scenario if isinstance(run, Run) else None
    if not isinstance(scenario, Scenario):
        remedy = "take what netkf.simulate or netkf.open returns"
        raise ScenarioError("run", "must be a run with its scenario", None, remedy)
    return scenario


def output_file(out: str | Path, name: str) -> Path:
    """Return the path of a file to write: ``out``, or ``name`` in it if it is a folder, which must
    not exist yet. Raises ScenarioError and WriteError.
    """
    path = as_path("out", out)
    path = path / name if path.is_dir() else path
    require_own(path)
    if path.exists():
        raise ScenarioError(str(path), "exists already", None, "choose another name, or remove it")
    make_directory(path.parent)
    return path
