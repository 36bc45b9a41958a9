"""Scenario files as parameters, and promises and bounds as assertions, of a pytest suite."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.linalg.arrays import ArrayLike, symmetric
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario
from netkf.testing.watching import demand, fail
from netkf.theory.numerics.matrices import as_number, as_numbers


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
    runs: int | None = None,
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


def assert_dominated(P: ArrayLike, bound: ArrayLike, tolerance: float = 1e-9) -> None:
    """Assert ``P <= bound``, in the order of symmetric matrices.

    Both are (n, n), or stacks (..., n, n) that broadcast, such as (T, N, n, n). Every eigenvalue of
    ``bound - P`` must be at least ``-tolerance`` times the largest absolute entry of the bound at
    that index. Raises AssertionError, which names the index with the lowest such ratio.
    """
    lower, upper = as_numbers("P", P), as_numbers("bound", bound)
    tolerance = as_number("tolerance", tolerance)
    for name, matrices in (("P", lower), ("bound", upper)):
        is_square = matrices.ndim >= 2 and matrices.shape[-1] == matrices.shape[-2]
        demand(is_square, name, "must be a square matrix or a stack of them", matrices.shape)
        not_finite = np.argwhere(~np.isfinite(matrices).all(axis=(-2, -1)))
        if not_finite.size:
            fail(name, "must be finite", f"nan or inf{_format_index(not_finite[0])}")
    try:
        shape = np.broadcast_shapes(lower.shape, upper.shape)
    except ValueError:
        fail("bound", "must have the shape of P", f"{upper.shape} for {lower.shape}")
    gap = symmetric(np.broadcast_to(upper, shape) - lower)
    smallest = np.linalg.eigvalsh(gap)[..., 0]
    size = np.maximum(np.abs(upper).max(axis=(-2, -1)), np.finfo(float).tiny)
    relative = np.asarray(smallest / size)
    if relative.size and float(relative.min()) < -tolerance:
        index = np.unravel_index(int(np.argmin(relative)), relative.shape)
        text = f"the least eigenvalue of bound - P is {float(smallest[index]):.4g}"
        count = int((relative < -tolerance).sum())
        many = f", one of {count} places of {relative.size}" if relative.size > 1 else ""
        fail(f"P{_format_index(index)}", f"must stay below the bound; {text}{many}")


def _format_index(index: object) -> str:
    numbers = [int(k) for k in index]  # type: ignore[attr-defined]
    return f"[{', '.join(map(str, numbers))}]" if numbers else ""
