"""The list of figures by name, and the functions that draw or write them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError, TheoryError, suggest_nearest
from netkf.figures.consistency import nees_figure, nis_figure, whiteness_figure
from netkf.figures.error import error_figure, quantiles_figure, ratios_figure
from netkf.figures.figure_data import FigureData, UnavailableError, reduce_result
from netkf.figures.names import FIT_FIGURES, is_picture
from netkf.figures.network import network_figure, plane_figure
from netkf.figures.pictures import overview
from netkf.figures.several import curves_of, errors_figure
from netkf.figures.stability import (
    law_figure,
    reason_to_omit_stability,
    stability_figure,
    sweep_figure,
)
from netkf.figures.style import Picture, message_figure, style_context, write_figure
from netkf.figures.traffic import (
    age_figure,
    delivery_figure,
    envelope_figure,
    fate_figure,
    links_figure,
    losses_figure,
    matrix_figure,
)
from netkf.runs.files import make_directory

FIGURES: Mapping[str, Callable[[FigureData], Picture]] = {
    "overview": overview,
    "error": error_figure,
    "quantiles": quantiles_figure,
    "ratios": ratios_figure,
    "network": network_figure,
    "plane": plane_figure,
    "nees": nees_figure,
    "nis": nis_figure,
    "whiteness": whiteness_figure,
    "age": age_figure,
    "links": links_figure,
    "stability": stability_figure,
    "law": law_figure,
    "delivery": delivery_figure,
    "matrix": matrix_figure,
    "fate": fate_figure,
    "losses": losses_figure,
}
"""The figures of runs and ensembles; a sweep has ``stability`` only, a fit ``envelope``."""

ACRONYMS = ("nees", "nis")
"""Names of figures that sentences write in capitals."""


def plot(result: Any, figure: str = "error") -> Picture:
    """Return a figure of a run, an ensemble, a fit, compared filters, or a sweep that was read from
    its directory, as a matplotlib Figure (``savefig`` writes it).

    Of several runs and ensembles, in a list or by their labels in a mapping, it is ``error``: the
    mean square errors of all of them over time. If the result lacks the data of that figure, it
    shows a sentence that says so. Raises ScenarioError for an unknown name, and if ``result`` is
    not a result.
    """
    return FigureSet(result).draw(figure)


class FigureSet:
    """Draws several figures of one result, whose data are computed only once."""

    def __init__(self, result: Any) -> None:
        self._data: FigureData | None = None
        self._caption: list[str] = []
        # A sweep is known by its attributes: its class is in a room above this one.
        is_sweep = hasattr(result, "keys") and hasattr(result, "table")
        envelope, curves = (getattr(result, name, None) for name in ("envelope", "curves"))
        self._figures: dict[str, Callable[[], Picture]]
        if envelope is not None:
            self._figures = {FIT_FIGURES[0]: lambda: envelope_figure(envelope)}
        elif curves is not None:  # of compared filters
            origin = f"{result.scenario}: {result.runs:,} runs, seed {result.seed}."
            self._figures = {"error": lambda: errors_figure(curves, origin)}
        elif isinstance(result, (Mapping, Sequence)):
            found = curves_of(result)
            self._figures = {"error": lambda: errors_figure(*found)}
        elif is_sweep:
            sweep = result.scenario, result.table, result.keys, result.status
            self._figures = {"stability": lambda: sweep_figure(*sweep)}
            self._caption = [f"{result.scenario.name}, a sweep."]
        else:
            self._data = data = reduce_result(result)
            self._figures = {name: partial(draw, data) for name, draw in FIGURES.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the figures of this kind of result."""
        return tuple(self._figures)

    def draw(self, name: str, *, omit_slow: bool = False) -> Picture:
        """Return the figure, or one with the reason why it cannot be drawn or, with ``omit_slow``,
        is left out because it takes minutes. Raises ScenarioError for an unknown name.
        """
        if name not in self._figures:
            remedy = f"{suggest_nearest(name, self.names)}its figures are {', '.join(self.names)}"
            raise ScenarioError("figure", "is not known", name, remedy)
        data = self._data
        with style_context():
            try:
                if omit_slow and name == "stability" and data is not None:
                    reason = reason_to_omit_stability(data)
                    if reason is not None:
                        raise UnavailableError(reason)
                return self._figures[name]()
            except (UnavailableError, TheoryError) as error:
                reason = str(error)
                if isinstance(error, TheoryError):  # one figure without an answer stops no other
                    reason = f"Theory has no answer: {reason}."
                headline = f"No {name.upper() if name in ACRONYMS else name} to show"
                if data is None:
                    return message_figure(headline, reason, self._caption)
                return message_figure(data.title(headline), reason, data.caption())


def plot_to_files(result: Any, names: tuple[str, ...], out: Path, file_format: str) -> list[Path]:
    """Write the figures of these names (default: all but slow ones) as ``out`` if that is a picture
    file, else ``out``/NAME.``file_format``; return their paths. Raises ScenarioError and
    WriteError.
    """
    figure_set = FigureSet(result)
    omit_slow = not names
    names = names or figure_set.names
    is_file = is_picture(out)
    if is_file and len(names) > 1:
        rule, remedy = "is one file for several figures", "name a directory, or one --figure"
        raise ScenarioError("--out", rule, str(out), remedy)
    paths = {name: out if is_file else out / f"{name}.{file_format}" for name in names}
    with style_context():
        # All are drawn before the first is written: unknown names leave no files.
        figures = {name: figure_set.draw(name, omit_slow=omit_slow) for name in names}
        for name, figure in figures.items():
            make_directory(paths[name].parent)
            write_figure(figure, paths[name])
    return list(paths.values())
