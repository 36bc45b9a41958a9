"""Pages in notebooks, without a file or a server."""

from __future__ import annotations

import html
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netkf.core.fields import as_path
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.monte_carlo import Ensemble
from netkf.report.page import make_page
from netkf.runs.files import this_process, write_text
from netkf.runs.run import save
from netkf.scenario.plugins import user_components
from netkf.trace.run import Run


@dataclass(frozen=True, repr=False)
class Page:
    """A page of results as ``html``, which a notebook shows."""

    html: str

    def __repr__(self) -> str:
        return f"<netkf page, {len(self.html):,} characters>"

    def _repr_html_(self) -> str:
        source = html.escape(self.html)
        return f'<iframe srcdoc="{source}" style="width: 100%; height: 45em; border: 0"></iframe>'

    def save(self, path: str | Path) -> Path:
        """Write the page to ``path``, in place of a file there, and return it; raises WriteError"""
        path = as_path("path", path)
        write_text(path, self.html, this_process())
        return path


def page(result: Any, other: Any = None, *, replica: int | str | None = None) -> Page:
    """Return the page that ``netkf report`` writes of a result, or of two side by side: each is a
    run or an ensemble in memory, what ``netkf.open`` returns, or a directory. The runs of an
    ensemble in memory are simulated again, with the events of replica 0. ``replica`` is the run of
    an ensemble to show, its number, "worst" or "median". Directories are read without trust: give
    what ``netkf.open(directory, trust=True)`` returns.

    Raises ScenarioError for what is no result, EngineError, and WriteError.
    """
    with tempfile.TemporaryDirectory() as folder:
        directories, trust = [], []
        for k, one in enumerate([result] if other is None else [result, other]):
            # Classes of a result in memory have been imported.
            trust.append(bool(user_components(getattr(one, "scenario", None))))
            directory = getattr(one, "directory", one)
            if directory is one and isinstance(one, Run | Ensemble):
                directory = _write(one, Path(folder) / f"RUN{k + 1}")
            elif directory is not one and directory.is_relative_to(Path.cwd()):
                # As the command on the page names it here.
                directory = directory.relative_to(Path.cwd())
            remedy = "give a run, an ensemble or its directory"
            directories.append(as_path("result", directory, remedy))
        # The command on the page names no folder that is gone.
        return Page(make_page(directories, replica, trust).replace(f"{folder}/", ""))


def _write(result: Run | Ensemble, directory: Path) -> Path:
    if isinstance(result, Run):
        return save(result, result.scenario, directory)
    assert result.scenario is not None
    scenario = result.scenario.replace({"seed": result.seed})
    runs_to_directory(scenario, int(result.runs.max()), directory, EnsembleOptions(result.engine))
    return directory
