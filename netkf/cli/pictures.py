"""Pictures of finished runs; without matplotlib a run is complete but has none."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

RUN = "netkf.figures.pictures", "run_picture"
ENSEMBLE = "netkf.figures.pictures", "ensemble_picture"
SWEEP = "netkf.studies.picture", "sweep_picture"
FILTERS = "netkf.studies.filter_picture", "filter_picture"
VERDICT = "netkf.checks.picture", "verdict_picture"


def load_drawing(function: tuple[str, str]) -> Callable[..., Any] | None:
    """Return a drawing function given as (module, name); None if matplotlib is missing."""
    try:
        module = importlib.import_module(function[0])
    except ImportError:
        return None
    draw: Callable[..., Any] = getattr(module, function[1])
    return draw


def draw_picture(function: tuple[str, str], scenario: Scenario, completed: Any) -> None:
    """Draw the picture of a completed run or ensemble, or print why there is none."""
    draw = load_drawing(function)
    if draw is None:
        print_missing()
        return
    draw(scenario, completed)


def print_missing() -> None:
    """Print that matplotlib is missing and how to install it."""
    print("no picture: matplotlib is missing (pip install matplotlib)", file=sys.stderr)
