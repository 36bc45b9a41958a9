"""Names of figures, formats of their files and the looks of series, without matplotlib."""

from pathlib import Path
from typing import Any, NamedTuple

FORMATS = ("png", "svg", "pdf")
"""Formats of picture files, which are their suffixes."""
FIGURE_NAMES = (
    *("overview", "error", "quantiles", "ratios", "network", "plane", "nees", "nis", "whiteness"),
    *("age", "links", "stability", "law", "delivery", "matrix", "fate", "losses"),
)
"""The figures of runs and ensembles; a sweep has ``stability`` only."""
FIT_FIGURES = ("envelope",)
"""The figures of a fit."""
FIT_FILE = "fit_envelope.csv"
"""The file of a fit that is drawn."""


def is_picture(out: Path) -> bool:
    """Return True if ``out`` names a file of a figure, False for a directory of them."""
    return out.suffix.removeprefix(".").lower() in FORMATS and not out.is_dir()


class SeriesStyle(NamedTuple):
    """The look of a series, ``dark`` on a dark page; no two of SERIES look alike without colour."""

    colour: str
    dark: str
    dashes: Any
    marker: str


SERIES = (
    SeriesStyle("#0072B2", "#4c9be8", "-", "o"),
    SeriesStyle("#D55E00", "#ff8f4d", "--", "s"),
    SeriesStyle("#009E73", "#2ec4a0", "-.", "^"),
    SeriesStyle("#CC79A7", "#e39cc4", ":", "D"),
    SeriesStyle("#222222", "#f0f0f0", (0, (6, 1, 1, 1, 1, 1)), "v"),
    SeriesStyle("#E69F00", "#e69f00", (0, (3, 3)), "P"),
    SeriesStyle("#56B4E9", "#a6dcff", (0, (1, 3)), "X"),
    SeriesStyle("#555555", "#a5a9ae", (0, (8, 3)), "*"),
)
"""Looks of runs, filters and other series, in figures and on pages: the first has the first."""
