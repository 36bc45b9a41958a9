"""The one look of all figures: colours, line styles, titles with a claim, captions, files.

Colours are those of Okabe and Ito (Color Universal Design, 2008), which people with any common
colour blindness tell apart. Series differ in lightness, dashes or markers too, for prints in grey.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextToPath

from netkf.core.printable import one_line
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import write_atomically

INK, MUTED, FAINT = "#222222", "#555555", "#bbbbbb"
VERMILLION, SKY, GREEN, ORANGE = "#D55E00", "#56B4E9", "#009E73", "#E69F00"
BLUE, PURPLE, YELLOW = "#0072B2", "#CC79A7", "#F0E442"
SENSING, RELAY, EXACT, LOST = VERMILLION, SKY, GREEN, VERMILLION


class Look(NamedTuple):
    """How a series is drawn, so that no two look alike even without colour."""

    colour: str
    dashes: str
    marker: str


SERIES = (
    Look(INK, "-", "o"),
    Look(VERMILLION, "--", "s"),
    Look(SKY, "-.", "^"),
    Look(GREEN, ":", "D"),
    Look(ORANGE, (0, (6, 1, 1, 1, 1, 1)), "v"),  # type: ignore[arg-type]
    Look(BLUE, (0, (3, 3)), "P"),  # type: ignore[arg-type]
    Look(PURPLE, (0, (1, 3)), "X"),  # type: ignore[arg-type]
    Look(MUTED, (0, (8, 3)), "*"),  # type: ignore[arg-type]
)
SEQUENTIAL = "cividis_r"
"""Colour map of quantities: its lightness falls as the quantity grows, in grey and for all eyes."""

RC: dict[str, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": MUTED,
    "axes.grid": False,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "legend.handlelength": 2.4,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,
    "svg.hashsalt": "netkf",
}
FORMATS = ("png", "svg", "pdf")
RESOLUTION = 130  # dots per inch
SECONDS = "simulated seconds"
TITLE_SIZE, CAPTION_SIZE, LEGEND_SIZE = 10.5, 7.5, 7.5


class Picture(Figure):
    """A figure that shows itself in a notebook, without pyplot."""

    def _repr_png_(self) -> bytes:
        """Return the PNG that notebooks display."""
        buffer = io.BytesIO()
        with look():
            self.savefig(buffer, format="png", dpi=RESOLUTION)
        return buffer.getvalue()


@contextlib.contextmanager
def look() -> Iterator[None]:
    """Draw the body's figures with the look of netkf, whatever the user's settings are."""
    with mpl.rc_context():
        mpl.rcdefaults()
        parameters: Any = mpl.rcParams
        parameters.update(RC)
        yield


def new_figure(width: float = 7.4, height: float = 4.4) -> Picture:
    """Return an empty figure, in inches, that lays its parts out by itself."""
    figure = Picture(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finish_figure(figure: Figure, claim: str, caption: Sequence[str]) -> None:
    """Put the claim above a figure and the sentences of its caption below, in as many lines as fit
    its width.
    """
    width = 0.94 * float(figure.get_size_inches()[0]) * 72.0
    title = break_lines(claim, width, TITLE_SIZE, "bold")
    figure.suptitle(title, x=0.01, ha="left", fontsize=TITLE_SIZE, color=INK, fontweight="bold")
    lines = [break_lines(sentence, width, CAPTION_SIZE) for sentence in caption if sentence]
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", fontsize=CAPTION_SIZE, color=MUTED)


def break_lines(text: str, width: float, size: float, weight: str = "normal") -> str:
    """Return a text on one line or more, none of them wider than ``width`` points where words allow
    it; names from files have no control characters and no formulas then.
    """
    lines = [""]
    for word in one_line(text).split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_width(longer, size, weight) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    pieces = [piece for line in lines for piece in _cut(line, width, size, weight)]
    return "\n".join(pieces).replace("$", r"\$")


def _cut(line: str, width: float, size: float, weight: str) -> list[str]:
    """Return pieces of a line that is a single word wider than ``width``."""
    pieces = []
    while len(line) > 1 and text_width(line, size, weight) > width:
        fits = max(1, int(len(line) * width / text_width(line, size, weight)) - 1)
        pieces.append(line[:fits])
        line = line[fits:]
    return [*pieces, line]


@lru_cache(maxsize=4096)
def text_width(text: str, size: float, weight: str = "normal") -> float:
    """Return the width of a text in points."""
    font = FontProperties(size=size, weight=weight)
    measured = TextToPath().get_text_width_height_descent(text, font, ismath=False)
    return float(measured[0])


def write(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all, in the format of the name of its file."""
    kind = path.suffix.removeprefix(".").lower() or "png"
    # Files of the same figure are equal.
    metadata: dict[str, Any] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[
        kind
    ]
    with look(), write_atomically(path) as part:
        figure.savefig(part, dpi=RESOLUTION, format=kind, metadata=metadata)


def draw_legend(axes: Any, columns: int | None = None) -> None:
    """Draw the legend of all labelled series above the axes, where it hides none of them."""
    handles, labels = axes.get_legend_handles_labels()
    if not labels:
        return
    figure = axes.figure
    share = axes.get_subplotspec().get_position(figure).width if axes.get_subplotspec() else 1.0
    scratch = share * float(figure.get_size_inches()[0]) * 72.0 * 1.08
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns or _columns(labels, scratch),
        columnspacing=1.4,
        borderaxespad=0.2,
    )


def _columns(labels: Sequence[str], scratch: float) -> int:
    """Return the largest number of columns of a legend that fits ``scratch`` points."""
    widths = [text_width(label, LEGEND_SIZE) + 6.0 * LEGEND_SIZE for label in labels]
    for count in range(len(labels), 1, -1):
        # Legends split their labels so: the first columns have one more where they are not equal.
        if sum(column.max() for column in np.array_split(widths, count)) <= scratch:
            return count
    return 1


def draw_message(axes: Any, message: str) -> None:
    """Replace a panel without data by a message in as many lines as fit."""
    share = axes.get_subplotspec().get_position(axes.figure).width
    width = share * float(axes.figure.get_size_inches()[0]) * 72.0 * 0.9
    text = break_lines(message, width, 9.0)
    axes.text(0.02, 0.5, text, color=MUTED, va="center", transform=axes.transAxes)
    axes.axis("off")


def message_figure(claim: str, message: str, caption: Sequence[str]) -> Picture:
    """Return a figure that says why there is nothing to draw."""
    figure = new_figure(7.4, 2.2)
    draw_message(figure.add_subplot(), message)
    finish_figure(figure, claim, caption)
    return figure


def set_scale(axes: Any, values: FloatArray) -> None:
    """Choose a logarithmic scale if the largest value is more than 100 times the median."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    if positive.size and positive.max() > 100.0 * np.median(positive):
        axes.set_yscale("log")
        axes.set_ylim(positive.min() * 0.7, positive.max() * 1.5)
    elif positive.size:
        axes.set_ylim(0.0, positive.max() * 1.06)
