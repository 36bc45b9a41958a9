"""The look of the drawings on the pages of the papers, and how they are written."""

import argparse
import re
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

HERE = Path(__file__).parent
SCENARIOS = HERE.parent.parent / "scenarios"
BLUE, ORANGE, GREEN, PINK, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#555555"
LOOK = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.hashsalt": "netkf",  # the same drawing is the same file
    "figure.facecolor": "white",
}


def options(text, arguments=None, **numbers):
    """The options of a script: the folder of its drawings, and numbers by name."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the drawings")
    for name, number in numbers.items():
        parser.add_argument(f"--{name}", type=type(number), default=number)
    return parser.parse_args(arguments)


def draw(folder, name, function, size):
    """Write NAME.svg into a folder, drawn by a function on an empty figure."""
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=size, layout="constrained")
        function(figure)
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


def page_code(before):
    """Return the names that docs/gallery.md defines up to a heading; its checks do not run."""
    page, names = (HERE.parent / "gallery.md").read_text(encoding="utf-8"), {}
    exec("import netkf, networkx, numpy as np", names)
    for code in re.findall(r"```python\n(.*?)```", page.partition(before)[0], re.DOTALL):
        if "print(" not in code:
            exec(code, names)
    return names
