"""The picture of a sweep that was just made; netkf.figures draws it."""

from __future__ import annotations

from netkf.figures.figure_data import UnavailableError
from netkf.figures.stability import sweep_figure
from netkf.figures.style import style_context, write_figure
from netkf.studies.sweep import CompletedSweep


def sweep_picture(title: str, completed: CompletedSweep) -> bool:
    """Write ``sweep.png`` and return True; False if more than two keys were varied."""
    try:
        with style_context():
            figure = sweep_figure(title, completed.table, completed.keys, "complete")
    except UnavailableError:
        return False
    write_figure(figure, completed.directory / "sweep.png")
    return True
