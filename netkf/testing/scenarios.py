"""Scenario files as parameters, and promises as assertions, of a pytest suite."""

from __future__ import annotations

from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario


def scenario_files(folder: str | Path = "scenarios") -> list[Path]:
    """Return the scenario files (``*.toml``) of a folder by name, for ``pytest.mark.parametrize``.

    Raises ScenarioError if there are none: pytest skips a test without parameters.
    """
    folder = as_path("folder", folder)
    files = sorted(folder.glob("*.toml"))
    if not files:
        text = "holds no scenario files" if folder.is_dir() else "is not a folder"
        raise ScenarioError("scenario_files", text, str(folder), "name a folder of .toml files")
    return files


def assert_promises(
    scenario: Scenario | str | Path,
    runs: int = 500,
    seed: int | None = None,
    confidence: float = 0.99,
    workers: int | None = None,
) -> None:
    """Assert that ``runs`` replicas break no promise of a scenario, or of a scenario file.

    Arguments are those of ``netkf.check``. Rows of the verdict that are undecided, or about
    something that theory does not promise, pass. Raises AssertionError with a line for each broken
    promise, TheoryError if theory promises nothing about the filter, and ScenarioError for a bad
    file or bad arguments.
    """
    from netkf.checks.check import check
    from netkf.checks.evidence import BROKEN

    checked = scenario if isinstance(scenario, Scenario) else load(scenario)
    verdict = check(checked, runs, seed, confidence, workers)
    broken = [row for row in verdict.rows if row.verdict == BROKEN]
    if broken:
        lines = [
            f"  {row.promise} [{row.source}]: margin {row.margin:.3g} in [{row.low:.3g}, "
            f"{row.high:.3g}]; {row.evidence}"
            for row in broken
        ]
        title = f"{checked.name}: {len(broken)} of {len(verdict.rows)} promises are broken"
        setting = f"{verdict.runs} runs from seed {verdict.seed}, confidence {confidence:g}"
        raise AssertionError("\n".join([f"{title} ({setting})", *lines]))
