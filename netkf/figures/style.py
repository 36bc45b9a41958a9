"""The style of all figures: colours, line styles, titles, captions, legends, and panels over time
that several figures share; and their files.

Colours are those of Okabe and Ito (Color Universal Design, 2008), which people with any common
colour blindness can tell apart.
"""

from __future__ import annotations

import bisect
import contextlib
import io
import math
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextToPath
from matplotlib.ticker import ScalarFormatter

from netkf.core.printable import one_line, shorten
from netkf.figures.figure_data import NO_TRUTH, FigureData
from netkf.figures.names import SERIES
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import this_process, write_atomically
from netkf.runs.labels import covariance_bias
from netkf.runs.outcomes import downtimes
from netkf.runs.summary import CONFIDENCE, NO_COVARIANCE, NORMAL_QUANTILE, nees_bounds

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
    """Return a name as one line of up to ``most`` characters; its dollar signs begin no formula."""
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


class WholeNumbers(ScalarFormatter):
    """Each tick with its exponent: a common one would stand above the axis, in the legend."""

    def __call__(self, value: float, pos: int | None = None) -> str:
        """Return the label of a tick."""
        return f"{value:.12g}" if super().get_offset() else str(super().__call__(value, pos))

    def get_offset(self) -> str:
        """Return nothing: there is no common exponent."""
        return ""


def draw_legend(axes: Any, columns: int | None = None) -> None:
    """Draw the legend above the axes, in ``columns`` or as many columns as fit."""
    handles, labels = axes.get_legend_handles_labels()
    if not labels:
        return
    if type(axes.yaxis.get_major_formatter()) is ScalarFormatter:
        axes.yaxis.set_major_formatter(WholeNumbers())
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


MAX_LINES = 60
"""Curves of single nodes in one panel; of larger networks evenly spaced nodes are drawn."""
MAX_FREEDOM = 100  # of a chi-square variable whose quantiles are found by bisection
RMS_ERROR, ROOT_TRACE = "RMS error", "root of trace P"


def select_evenly(indices: np.ndarray, max_count: int = MAX_LINES) -> np.ndarray:
    """Return at most ``max_count`` of the ``indices`` (K,), evenly spaced, in their order."""
    if len(indices) <= max_count:
        return indices
    return np.asarray(indices[np.linspace(0, len(indices) - 1, max_count).astype(int)])


def draw_nodes(axes: Any, data: FigureData, values: FloatArray, se: FloatArray | None) -> None:
    """Draw ``values`` (T, N) by node, with 95 % intervals if their squares have errors ``se``."""
    width = 1.1 if len(data.nodes) <= 12 else 0.6
    groups = (
        (~data.has_sensor, RELAY, 1, "without a sensor"),
        (data.has_sensor, SENSING, 2, "with a sensor"),
    )
    has_both = data.has_sensor.any() and not data.has_sensor.all()
    for group, colour, order, description in groups:
        indices = select_evenly(np.flatnonzero(group))
        if not len(indices):
            continue
        # matplotlib draws one collection far faster than as many lines.
        lines = [np.column_stack([data.times, values[:, k]]) for k in indices]
        style = {"linewidths": width, "alpha": 0.75, "zorder": order}
        axes.add_collection(LineCollection(lines, colors=colour, **style))
        if se is not None:
            for k in indices:
                squares = (values[:, k] ** 2 + s * NORMAL_QUANTILE * se[:, k] for s in (-1.0, 1.0))
                low, high = (np.sqrt(np.maximum(square, 0.0)) for square in squares)
                axes.fill_between(data.times, low, high, color=colour, alpha=0.2, lw=0)
        label = "nodes" if len(indices) > 1 else "the node"
        if has_both:
            label = f"nodes {description}"
        axes.plot([], [], color=colour, lw=1.4, label=label)  # for the legend
    if len(data.times) == 1:  # a line of one sample is invisible
        axes.plot(np.repeat(data.times, len(data.nodes)), values.ravel(), ".", color=INK, ms=4)
    axes.autoscale()


def shade_downtimes(axes: Any, data: FigureData) -> None:
    """Shade the times at which a node of a run was down, darker where several were."""
    if data.run is None or not data.scenario.network.lives:
        return
    label, end = "a node down", data.scenario.horizon
    for down in downtimes(data.scenario, data.run.seed, data.run.replica):
        axes.axvspan(down.begin, min(down.end, end), color=INK, alpha=0.12, lw=0, label=label)
        label = "_"  # only one for the legend


def draw_errors(axes: Any, data: FigureData, bound: bool = False) -> None:
    """Draw errors by node and the RMS of all, and the root of the bound; else first estimates."""
    if not data.shows_errors:
        if data.first_component is None:
            draw_message(axes, NO_TRUTH)
            return
        draw_nodes(axes, data, data.first_component, se=None)
        axes.set(ylabel=f"estimate of {label_text(data.scenario.state_labels[0])}", xlabel=SECONDS)
        shade_downtimes(axes, data)
        draw_legend(axes)
        return
    error = np.sqrt(data.sq_error)
    draw_nodes(axes, data, error, data.se_error)
    rms = np.sqrt(data.sq_error.mean(axis=1))
    if len(data.nodes) > 1:
        axes.plot(data.times, rms, color=INK, lw=2.0, label="RMS of all nodes", zorder=4)
    curves = [error]
    promised = data.promised.bound
    if bound and promised is not None:
        roots = np.sqrt(promised)
        curves.append(roots)
        _draw_bound(axes, data.times, roots)
    set_scale(axes, np.concatenate(curves))
    name = "error |x - xhat|" if data.runs == 1 else RMS_ERROR
    axes.set(ylabel=f"{name}, {data.unit}", xlabel=SECONDS)
    shade_downtimes(axes, data)
    draw_legend(axes)


def draw_covariances(axes: Any, data: FigureData) -> None:
    """Draw the roots of the traces of P over time, with bound and limits, or a message."""
    if not np.isfinite(data.trace).any():
        draw_message(axes, f"{NO_COVARIANCE}: trace P is unavailable")
        return
    root = np.sqrt(np.maximum(data.trace, 0.0))
    draw_nodes(axes, data, root, data.se_trace)
    if data.promised.bound is not None:
        _draw_bound(axes, data.times, np.sqrt(data.promised.bound))
    limits: tuple[tuple[float, str, Any], ...] = (
        (data.promised.limit, data.promised.limit_label, "-."),
        (data.promised.central, "centralised filter", (0, (6, 1, 1, 1, 1, 1))),
    )
    for value, label, style in limits:
        if math.isfinite(value):
            axes.axhline(math.sqrt(value), color=EXACT, ls=style, lw=1.1, label=label)
    bound = data.promised.bound
    set_scale(axes, root if bound is None else np.concatenate([root, np.sqrt(bound)]))
    axes.set(ylabel=f"{ROOT_TRACE}, {data.unit}", xlabel=SECONDS)
    shade_downtimes(axes, data)
    draw_legend(axes)


def _draw_bound(axes: Any, times: FloatArray, roots: FloatArray) -> None:
    """Draw ``roots`` (T, N) of the bounds on trace P; only largest and smallest if nodes differ."""
    same = np.allclose(roots.max(axis=1), roots.min(axis=1))
    label = "Tanwani's bound H(12)" if same else "Tanwani's bound H(12): largest"
    axes.plot(times, roots.max(axis=1), color=INK, lw=1.3, ls="--", label=label, zorder=3)
    if not same:
        axes.plot(
            times, roots.min(axis=1), color=INK, lw=1.3, ls=":", label="and smallest", zorder=3
        )


def nees_interval(n: int, runs: int) -> tuple[float, float]:
    """Return ``nees_bounds``, if it can without scipy.special, whose import takes 0.2 s."""
    freedom, tail = runs * n, 0.5 * (1.0 - CONFIDENCE)
    if freedom > MAX_FREEDOM:
        return nees_bounds(n, runs)
    ends = []
    for survival in (1.0 - tail, tail):
        low, high = 0.0, 10.0 * freedom + 20.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            is_below = _chi_square_survival(middle, freedom) > survival
            low, high = (middle, high) if is_below else (low, middle)
        ends.append(low / runs)
    return ends[0], ends[1]


def _chi_square_survival(x: float, freedom: int) -> float:
    """Return the probability that a chi-square variable exceeds x (Abramowitz, Stegun 26.4.4)."""
    y, odd = 0.5 * x, freedom % 2
    total = math.erfc(math.sqrt(y)) if odd else 0.0
    term = math.exp(-y) * (2.0 * math.sqrt(y / math.pi) if odd else 1.0)
    for k in range(freedom // 2):
        total += term
        term *= y / (k + 1.0 + 0.5 * odd)
    return total


def draw_nees(axes: Any, data: FigureData) -> None:
    """Draw NEES over time with its interval if P is exact, or a message if it is unknown."""
    values, runs, sizes = data.nees, data.runs, data.scenario.sizes
    # Nodes with states of different size are compared by NEES / n.
    n, unit = data.nees_unit
    values = values / unit
    if not np.isfinite(values).any():
        draw_message(axes, "NEES is unavailable: it needs an error and a regular P")
        return
    draw_nodes(axes, data, values, se=None)
    if len(data.nodes) > 1:
        mean = values.mean(axis=1)
        axes.plot(data.times, mean, color=INK, lw=2.0, label="mean of all nodes", zorder=4)
    ends = [(s, np.array(nees_interval(s, runs)) * n / s) for s in np.unique(sizes).tolist()]
    for size, (low, high) in ends:
        label = f"{CONFIDENCE:.0%} if P is exact" + (f", n = {size}" if len(ends) > 1 else "")
        axes.axhspan(low, high, color=EXACT, alpha=0.15, lw=0, label=label)
    high = max(ends[0][1])
    bias = covariance_bias(data.scenario)
    label = f"n = {n}" + (f", P is {bias} by design" if bias else "")
    axes.axhline(n, color=EXACT, lw=1.1, ls="-.", label=label if len(ends) == 1 else "expected")
    set_scale(axes, np.append(values, high))
    name = "NEES" if len(ends) == 1 else "NEES / n"
    axes.set(ylabel=name if runs == 1 else f"mean {name} of {runs:,} runs", xlabel=SECONDS)
    shade_downtimes(axes, data)
    draw_legend(axes)
