"""The style of all figures: colours, line styles, titles, captions and legends; and their files.

Colours are those of Okabe and Ito (Color Universal Design, 2008), which people with any common
colour blindness can tell apart.
"""

from __future__ import annotations

import bisect
import contextlib
import io
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextToPath

from netkf.core.printable import one_line, shorten
from netkf.figures.names import SERIES
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import this_process, write_atomically

BLUE, VERMILLION, GREEN, PURPLE, INK, ORANGE, SKY, MUTED = (one.colour for one in SERIES)
FAINT = "#bbbbbb"
SENSING, RELAY, EXACT, LOST = VERMILLION, SKY, GREEN, VERMILLION
"""Colours of nodes with and without a sensor, of exact values of theory, and of lost messages."""
SEQUENTIAL = "cividis_r"
"""Colour map of quantities: its lightness decreases as the quantity grows, also without colour."""

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
    # Half the time of the default, which hints glyphs by an algorithm that ignores the font's own.
    "text.hinting": "no_autohint",
    "pdf.fonttype": 42,
    "svg.hashsalt": "netkf",
}
RESOLUTION = 130  # dots per inch
MAX_DRAWN = 1e100
"""Limit of the axes: logarithmic ones overflow near the largest number of a float."""
LOG_RATIO = 20.0
"""Ratio of the largest to the smallest value above which an axis is logarithmic."""
LOG_MEDIANS = 100.0
"""Ratio of the largest value to the median above which a y axis is logarithmic."""
LOG_LEVELS = 10.0
"""Ratio of the medians of the highest and the lowest curve above which it is logarithmic too."""
POINTS_PER_INCH = 72.0
SECONDS = "simulated seconds"
TITLE_SIZE, CAPTION_SIZE, LEGEND_SIZE = 10.5, 7.5, 7.5
"""Font sizes in points."""
UNIT = re.compile(r"(?<=\d) (?=s\b)")
_is_styled: list[bool] = []


class Picture(Figure):
    """A figure that notebooks display without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with style_context():
            self.savefig(buffer, format="png", dpi=RESOLUTION)
        return buffer.getvalue()


@contextlib.contextmanager
def style_context() -> Iterator[None]:
    """Set the style of netkf's figures within the block, whatever the user's settings are."""
    if _is_styled:
        yield
        return
    with mpl.rc_context():
        mpl.rcdefaults()
        parameters: Any = mpl.rcParams
        parameters.update(RC)
        _is_styled.append(True)
        try:
            yield
        finally:
            _is_styled.clear()


def new_figure(width: float = 7.4, height: float = 4.4) -> Picture:
    """Return an empty figure of ``width`` x ``height`` inches, with constrained layout."""
    figure = Picture(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finish_figure(figure: Picture, headline: str, caption: Sequence[str]) -> Picture:
    """Return a figure with the headline above and the caption below, in lines that fit."""
    width = 0.94 * float(figure.get_size_inches()[0]) * POINTS_PER_INCH
    title = break_lines(headline, width, TITLE_SIZE, "bold")
    figure.suptitle(title, x=0.01, ha="left", fontsize=TITLE_SIZE, color=INK, fontweight="bold")
    lines = [break_lines(sentence, width, CAPTION_SIZE) for sentence in caption if sentence]
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", fontsize=CAPTION_SIZE, color=MUTED)
    return figure


def break_lines(text: str, width: float, size: float, weight: str = "normal") -> str:
    """Return a text in lines of at most ``width`` points in a font of ``size`` points, without
    control characters, and with escaped dollar signs, which matplotlib takes for formulas.
    """
    # A unit stays with its number.
    words, pieces = UNIT.sub("\xa0", one_line(text)).split(" "), list[str]()
    while words:
        # As many words as one line takes, at least one.
        count = 1 + bisect.bisect_right(
            range(2, len(words) + 1),
            width,
            key=lambda k: text_width(" ".join(words[:k]), size, weight),
        )
        pieces += _split_word(" ".join(words[:count]), width, size, weight)
        words = words[count:]
    return "\n".join(pieces).replace("\xa0", " ").replace("$", r"\$")


def _split_word(line: str, width: float, size: float, weight: str) -> list[str]:
    pieces = []
    while len(line) > 1 and text_width(line, size, weight) > width:
        count = max(1, int(len(line) * width / text_width(line, size, weight)) - 1)
        pieces.append(line[:count])
        line = line[count:]
    return [*pieces, line]


def label_text(text: object, most: int = 24) -> str:
    """Return a name as one line of at most ``most`` characters for an axis or a legend, where
    matplotlib takes dollar signs for formulas.
    """
    return shorten(text, most).replace("$", r"\$")


@lru_cache(maxsize=4096)
def text_width(text: str, size: float, weight: str = "normal") -> float:
    """Return the width of a text in points, in a font of ``size`` points."""
    font = FontProperties(size=size, weight=weight)
    width, _, _ = TextToPath().get_text_width_height_descent(text, font, ismath=False)
    return float(width)


def lay_out(figure: Figure) -> None:
    """Place all artists once, instead of in a first drawing of them that is thrown away."""
    figure.set_dpi(RESOLUTION)
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all, in the format of its suffix; raises WriteError."""
    file_format = path.suffix.removeprefix(".").lower() or "png"
    # Without dates, the same figure always has the same bytes.
    undated: dict[str, Any] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
    metadata = undated[file_format]
    with style_context(), write_atomically(path, this_process()) as temporary:
        lay_out(figure)
        if file_format == "png":
            # ``savefig`` would first draw all artists to nowhere.
            canvas: Any = FigureCanvasAgg(figure)
            # Level 6 takes longer, for a file that is one or two percent smaller.
            canvas.print_png(temporary, metadata=metadata, pil_kwargs={"compress_level": 2})
        else:
            figure.savefig(temporary, dpi=RESOLUTION, format=file_format, metadata=metadata)


def draw_legend(axes: Any, columns: int | None = None) -> None:
    """Draw the legend above the axes, in ``columns`` or as many columns as fit."""
    handles, labels = axes.get_legend_handles_labels()
    if not labels:
        return
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        # A legend may be a little wider than its axes: margins and tick labels are beside them.
        ncols=columns or _legend_columns(labels, 1.08 * _axes_width(axes)),
        columnspacing=1.4,
        borderaxespad=0.2,
    )


def _axes_width(axes: Any) -> float:
    """Return the width in points of the grid cell of the axes, known before they are drawn."""
    cell = axes.get_subplotspec()
    share = cell.get_position(axes.figure).width if cell else 1.0
    return share * float(axes.figure.get_size_inches()[0]) * POINTS_PER_INCH


def _legend_columns(labels: Sequence[str], width: float) -> int:
    # Handle, gaps and column spacing take about six font sizes.
    widths = [text_width(label, LEGEND_SIZE) + 6.0 * LEGEND_SIZE for label in labels]
    for count in range(len(labels), 1, -1):
        # matplotlib fills columns as array_split does: the first ones may have one label more.
        if sum(column.max() for column in np.array_split(widths, count)) <= width:
            return count
    return 1


def draw_message(axes: Any, message: str) -> None:
    """Draw a message, broken into lines, in place of the axes of a panel."""
    text = break_lines(message, 0.9 * _axes_width(axes), 9.0)
    axes.text(0.02, 0.5, text, color=MUTED, va="center", transform=axes.transAxes)
    axes.axis("off")


def message_figure(headline: str, message: str, caption: Sequence[str]) -> Picture:
    """Return a figure that shows only a message, with a ``headline`` and a ``caption``."""
    figure = new_figure(7.4, 2.2)
    draw_message(figure.add_subplot(), message)
    return finish_figure(figure, headline, caption)


def set_scale(axes: Any, values: FloatArray, levels: Sequence[float] = ()) -> None:
    """Set the y axis: logarithmic above LOG_MEDIANS medians, or if ``levels`` differ much."""
    positive = np.minimum(values[np.isfinite(values) & (values > 0.0)], MAX_DRAWN)
    known = [level for level in levels if 0.0 < level < np.inf]
    apart = max(known, default=0.0) > LOG_LEVELS * min(known, default=0.0)
    if positive.size and (apart or positive.max() > LOG_MEDIANS * np.median(positive)):
        # Limits first: a new scale would compute its own, which can overflow.
        axes.set_ylim(positive.min() * 0.7, positive.max() * 1.5)
        axes.set_yscale("log")
    elif positive.size:
        # With the bands that are drawn, unless they are so wide that curves would be flat.
        axes.set_ylim(0.0, 1.06 * np.clip(axes.dataLim.y1, positive.max(), 1.5 * positive.max()))
