"""Pictures of finished runs, which are complete without one: it never decides the exit status."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from netkf.cli.options import print_notes
from netkf.core.errors import WriteError

RUN = "netkf.figures.pictures", "run_picture"
ENSEMBLE = "netkf.figures.pictures", "ensemble_picture"
SWEEP = "netkf.studies.picture", "sweep_picture"
FILTERS = "netkf.studies.filter_picture", "filter_picture"
VERDICT = "netkf.checks.picture", "verdict_picture"
UNSHOWN = {SWEEP: "it shows one or two keys", VERDICT: "no row has an interval"}
"""Why a drawing function has returned False."""


def load_drawing(function: tuple[str, str]) -> Callable[..., Any] | None:
    """Return a drawing function given as (module, name); None if matplotlib is missing."""
    try:
        module = importlib.import_module(function[0])
    except ImportError:
        return None
    draw: Callable[..., Any] = getattr(module, function[1])
    return draw


def draw_picture(function: tuple[str, str], *results: Any) -> None:
    """Draw a picture of ``results``, or print a note that says why there is none."""
    draw = load_drawing(function)
    if draw is None:
        print_notes(["no picture: matplotlib is missing (pip install matplotlib)"])
        return
    try:
        drawn = draw(*results)
    except WriteError as error:
        print_notes([f"no picture: {error}"])
    else:
        if drawn is False:
            print_notes([f"no picture: {UNSHOWN[function]}"])
