"""The picture of a sweep over one or two keys."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from netkf.core.arrays import FloatArray
from netkf.experiments.studies.sweep import Swept

if TYPE_CHECKING:
    import pandas as pd

WORST, MEAN, PROMISE, CENTRAL = "#c1440e", "#3b6ea5", "#222222", "#777777"
MOST_LINES = 9
LONGEST_LABEL = 34
SPREAD = 20.0


def sweep_picture(title: str, swept: Swept) -> bool:
    """Write ``sweep.png``: over one key the largest and the mean RMS error with two standard errors
    and the roots of bound and centralised trace; over two keys the largest, a line for each value
    of the second. False, and nothing, for more keys.
    """
    keys, table = swept.keys, swept.table
    if len(keys) > 2 or (len(keys) == 2 and table[keys[1]].astype(str).nunique() > MOST_LINES):
        return False
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(7.2, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        places = _places(axes, table[keys[0]])
        if len(keys) == 1:
            _one_key(axes, places, table)
        else:
            _two_keys(axes, places, table, keys[1])
        axes.set_xlabel(keys[0])
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.04)
        axes.legend(frameon=False, fontsize=8)
        bars = "; bars: two standard errors, shared draws" if table["runs"].max() > 1 else ""
        axes.set_ylabel(f"RMS error, units of the state{bars}", fontsize=8)
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        path = swept.directory / "sweep.png"
        part = path.with_name("sweep.png.part")
        figure.savefig(part, dpi=130, format="png")
        os.replace(part, path)
    return True


def _places(axes: Any, values: pd.Series[Any]) -> FloatArray:
    """Where the values stand: numbers on a scale, others side by side."""
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    if numbers:
        places = values.to_numpy(dtype=np.float64)
        if places.min() > 0.0 and places.max() > SPREAD * places.min():
            axes.set_xscale("log")
            ticks = np.unique(places)
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.minorticks_off()
        return places
    texts = values.astype(str)
    names = list(dict.fromkeys(texts))
    labels = [n if len(n) <= LONGEST_LABEL else n[: LONGEST_LABEL - 3] + "..." for n in names]
    axes.set_xticks(range(len(names)), labels, rotation=20 if max(map(len, labels)) > 10 else 0)
    return np.array([names.index(text) for text in texts], dtype=np.float64)


def _one_key(axes: Any, places: FloatArray, table: pd.DataFrame) -> None:
    for name, words, colour in (
        ("worst_rms", "node with the largest", WORST),
        ("mean_rms", "all nodes", MEAN),
    ):
        _line(axes, places, table, name, words, colour)
    for name, words, colour, style in (
        ("bound", "root of the bound on trace P", PROMISE, "--"),
        ("central", "centralised filter", CENTRAL, ":"),
    ):
        if table[name].notna().any():
            order = np.argsort(places, kind="stable")
            roots = np.sqrt(table[name].to_numpy(dtype=np.float64))
            axes.plot(places[order], roots[order], style, color=colour, label=words)


def _two_keys(axes: Any, places: FloatArray, table: pd.DataFrame, key: str) -> None:
    texts = table[key].astype(str)
    names = list(dict.fromkeys(texts))
    for k, name in enumerate(names):
        chosen = (texts == name).to_numpy()
        colour = mpl.colormaps["viridis"](k / max(1, len(names) - 1) * 0.85)
        words = name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 3] + "..."
        _line(axes, places[chosen], table[chosen], "worst_rms", f"{key} = {words}", colour)
    axes.set_title("node with the largest error", fontsize=9, loc="right")


def _line(
    axes: Any, places: FloatArray, table: pd.DataFrame, name: str, words: str, colour: Any
) -> None:
    order = np.argsort(places, kind="stable")
    values = table[name].to_numpy(dtype=np.float64)[order]
    errors = 2.0 * np.nan_to_num(table[f"{name}_se"].to_numpy(dtype=np.float64))[order]
    axes.errorbar(
        places[order], values, yerr=errors, marker="o", ms=4, capsize=2, color=colour, label=words
    )
