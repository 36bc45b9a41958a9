"""The picture of a sweep that was just made; netkf.figures draws it."""

from __future__ import annotations

from netkf.figures.figure_data import UnavailableError
from netkf.figures.stability import sweep_figure
from netkf.figures.style import style_context, write_figure
from netkf.studies.sweep import CompletedSweep


def sweep_picture(title: str, completed: CompletedSweep) -> bool:
    """Write ``sweep.png`` to the directory of a sweep and return True; return False if more than
    two keys were varied, which have no picture.

    Over one key it has the largest and the mean RMS error with 95 % intervals and the root of the
    bound; over two keys a map of the largest RMS error. ``title`` is that of the figure.
    """
    try:
        with style_context():
            figure = sweep_figure(title, completed.table, completed.keys, "complete")
    except UnavailableError:
        return False
    write_figure(figure, completed.directory / "sweep.png")
    return True
