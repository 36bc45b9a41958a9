"""The list of figures by name, and the one function that draws them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError, nearest
from netkf.figures.consistency import nees_figure, nis_figure, whiteness_figure
from netkf.figures.error import error_figure, quantiles_figure, ratios_figure
from netkf.figures.network import network_figure
from netkf.figures.pictures import overview
from netkf.figures.stability import law_figure, stability_figure, sweep_figure
from netkf.figures.style import FORMATS, Picture, look, message_figure, write
from netkf.figures.subject import Subject, UnavailableError, subject_of
from netkf.figures.traffic import age_figure, delivery_figure, links_figure
from netkf.runs.files import make_directory

FIGURES: Mapping[str, Callable[[Subject], Picture]] = {
    "overview": overview,
    "error": error_figure,
    "quantiles": quantiles_figure,
    "ratios": ratios_figure,
    "network": network_figure,
    "nees": nees_figure,
    "nis": nis_figure,
    "whiteness": whiteness_figure,
    "age": age_figure,
    "links": links_figure,
    "stability": stability_figure,
    "law": law_figure,
    "delivery": delivery_figure,
}
"""The figures of runs and ensembles; a sweep has ``stability`` only."""

ACRONYMS = ("nees", "nis")


def plot(result: Any, figure: str = "error") -> Picture:
    """Return a figure of a run, an ensemble or a sweep that was read from its directory, as a
    matplotlib Figure (``savefig`` writes it); if it cannot be drawn it says why.

    Raises ScenarioError for an unknown name and for anything that is no result.
    """
    return FigureSet(result).draw(figure)


class FigureSet:
    """Draws several figures of one result, which is reduced once."""

    def __init__(self, result: Any) -> None:
        is_sweep = hasattr(result, "keys") and hasattr(result, "table")
        self._sweep: Any = result if is_sweep else None
        self._subject = None if is_sweep else subject_of(result)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the figures that can be asked for."""
        return ("stability",) if self._sweep is not None else tuple(FIGURES)

    def draw(self, name: str) -> Picture:
        """Return the figure of this name; raises ScenarioError for an unknown name."""
        if name not in self.names:
            hint = nearest(name, self.names)
            remedy = f"{hint}figures of it are {', '.join(self.names)}"
            raise ScenarioError("figure", "is not known", name, remedy)
        with look():
            try:
                if self._sweep is not None:
                    sweep = self._sweep
                    return sweep_figure(sweep.scenario.name, sweep.table, sweep.keys, sweep.status)
                assert self._subject is not None
                return FIGURES[name](self._subject)
            except UnavailableError as reason:
                return message_figure(*self._explain(name, str(reason)))

    def _explain(self, name: str, reason: str) -> tuple[str, str, list[str]]:
        """Return claim, message and caption of a figure that cannot be drawn."""
        claim = f"No {name.upper() if name in ACRONYMS else name} to show"
        if self._subject is None:
            return claim, reason, [f"{self._sweep.scenario.name}, a sweep."]
        return self._subject.claim(claim), reason, self._subject.caption()


def plot_to_files(result: Any, names: tuple[str, ...], out: Path, kind: str) -> list[Path]:
    """Write figures as OUT if that is the name of a file, else as OUT/NAME.kind; return the paths.

    Raises ScenarioError for unknown names, before anything is written, and WriteError.
    """
    drawing = FigureSet(result)
    wanted = names or drawing.names
    single = out.suffix.removeprefix(".").lower() in FORMATS and not out.is_dir()
    if single and len(wanted) > 1:
        rule, remedy = "is one file for several figures", "name a directory, or one --figure"
        raise ScenarioError("--out", rule, str(out), remedy)
    figures = {name: drawing.draw(name) for name in wanted}
    paths = {name: out if single else out / f"{name}.{kind}" for name in wanted}
    for name, figure in figures.items():
        make_directory(paths[name].parent)
        write(figure, paths[name])
    return list(paths.values())
