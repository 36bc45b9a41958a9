"""The picture of a sweep over one or two keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from netkf.linalg.arrays import FloatArray
from netkf.runs.files import write_atomically
from netkf.studies.sweep import CompletedSweep

if TYPE_CHECKING:
    import pandas as pd

WORST, MEAN, PROMISE, CENTRAL = "#c1440e", "#3b6ea5", "#222222", "#777777"
MAX_LINES = 9
LONGEST_LABEL = 34
MAX_LETTERS = 90
SPREAD = 20.0


def sweep_picture(title: str, completed: CompletedSweep) -> bool:
    """Write ``sweep.png`` and return True; return False for grids that it cannot show.

    Over one key it has the largest and the mean RMS error with two standard errors and the roots of
    the bound and of the centralised trace; over two keys the largest RMS error, one line for each
    value of the second.
    """
    keys, table = completed.keys, completed.table
    if len(keys) > 2 or (len(keys) == 2 and table[keys[1]].astype(str).nunique() > MAX_LINES):
        return False
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(7.2, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        table = table.assign(place=_positions(axes, table[keys[0]])).sort_values("place")
        joined = all(map(_is_number, table[keys[0]]))
        if len(keys) == 1:
            _one_key(axes, table, joined)
        else:
            _two_keys(axes, table, keys[1], joined)
        axes.set_xlabel(keys[0])
        axes.set_ylabel("RMS error, units of the state")
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.04 if joined else 0.15)
        axes.legend(frameon=False, fontsize=8)
        bars = "bars: two standard errors; all on the same draws" if table["runs"].max() > 1 else ""
        which = "node with the largest error" if len(keys) == 2 else ""
        label = "; ".join(filter(None, (which, bars)))
        axes.set_title(label, fontsize=8, loc="right", color=CENTRAL)
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        with write_atomically(completed.directory / "sweep.png") as part:
            figure.savefig(part, dpi=130, format="png")
    return True


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _positions(axes: Any, values: pd.Series[Any]) -> FloatArray:
    """Return the positions of values on the axis: numbers on a scale, others side by side."""
    if all(map(_is_number, values)):
        positions = values.to_numpy(dtype=np.float64)
        if positions.min() > 0.0 and positions.max() > SPREAD * positions.min():
            axes.set_xscale("log")
            ticks = np.unique(positions)
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.minorticks_off()
        return positions
    texts = values.astype(str)
    names = list(dict.fromkeys(texts))
    labels = [_short(name) for name in names]
    axes.set_xticks(range(len(names)), labels, fontsize=8)
    if sum(map(len, labels)) > MAX_LETTERS:
        axes.tick_params(axis="x", rotation=20)
    return np.array([names.index(text) for text in texts], dtype=np.float64)


def _short(name: str) -> str:
    return name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 3] + "..."


def _one_key(axes: Any, table: pd.DataFrame, joined: bool) -> None:
    _line(axes, table, "worst_rms", "node with the largest", WORST, joined)
    _line(axes, table, "mean_rms", "all nodes", MEAN, joined)
    for name, label, colour, style in (
        ("bound", "root of the bound on trace P", PROMISE, "--"),
        ("central", "centralised filter", CENTRAL, ":"),
    ):
        if table[name].notna().any():
            roots = np.sqrt(table[name].to_numpy(dtype=np.float64))
            look = {"ls": style} if joined else {"ls": "", "marker": "_", "ms": 26}
            axes.plot(table["place"], roots, color=colour, label=label, **look)


def _two_keys(axes: Any, table: pd.DataFrame, key: str, joined: bool) -> None:
    texts = table[key].astype(str)
    names = list(dict.fromkeys(texts))
    for k, name in enumerate(names):
        colour = mpl.colormaps["viridis"](k / max(1, len(names) - 1) * 0.85)
        _line(axes, table[texts == name], "worst_rms", f"{key} = {_short(name)}", colour, joined)


def _line(axes: Any, table: pd.DataFrame, name: str, label: str, colour: Any, joined: bool) -> None:
    axes.errorbar(
        table["place"],
        table[name],
        yerr=2.0 * table[f"{name}_se"].fillna(0.0),
        marker="o",
        ms=4,
        capsize=2,
        ls="-" if joined else "",
        color=colour,
        label=label,
    )
