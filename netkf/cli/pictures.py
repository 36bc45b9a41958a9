"""Pictures of finished commands. They are optional: a missing one never changes the exit status.

Drawing functions are named as (module, function): their modules import matplotlib.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from netkf.cli.options import print_notes
from netkf.core.errors import WriteError

RUN = "netkf.figures.pictures", "run_picture"
ENSEMBLE = "netkf.figures.pictures", "ensemble_picture"
SWEEP = "netkf.studies.pictures", "sweep_picture"
FILTERS = "netkf.studies.pictures", "filter_picture"
VERDICT = "netkf.figures.verdict", "verdict_picture"
REASONS = {SWEEP: "it shows one or two keys", VERDICT: "no row has an interval"}
"""The reason for which a drawing function returns False, which means that it drew nothing."""


def load_drawing(name: tuple[str, str]) -> Callable[..., Any] | None:
    """Import and return a drawing function (module, function); None if matplotlib is missing."""
    module_name, function_name = name
    try:
        module = importlib.import_module(module_name)
    except ImportError:
        return None
    draw: Callable[..., Any] = getattr(module, function_name)
    return draw


def draw_picture(name: tuple[str, str], *results: Any) -> None:
    """Draw the picture of a finished command by ``name``; print a note if there is none."""
    draw = load_drawing(name)
    if draw is None:
        print_notes(["no picture: matplotlib is missing (pip install 'netkf[plot]')"])
        return
    try:
        is_drawn = draw(*results)
    except WriteError as error:
        print_notes([f"no picture: {error}"])
    else:
        # Functions that always draw return None.
        if is_drawn is False:
            print_notes([f"no picture: {REASONS[name]}"])
