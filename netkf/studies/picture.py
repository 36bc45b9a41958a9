"""The picture of a sweep that was just made; netkf.figures draws it."""

from __future__ import annotations

from netkf.figures.stability import sweep_figure
from netkf.figures.style import look, write
from netkf.figures.subject import UnavailableError
from netkf.studies.sweep import CompletedSweep


def sweep_picture(title: str, completed: CompletedSweep) -> bool:
    """Write ``sweep.png`` and return True; return False for more than two keys.

    Over one key it has the largest and the mean RMS error with 95 % intervals and the root of the
    bound; over two keys a map of the largest RMS error.
    """
    try:
        with look():
            figure = sweep_figure(title, completed.table, completed.keys, "complete")
    except UnavailableError:
        return False
    write(figure, completed.directory / "sweep.png")
    return True
