"""``netkf plot``: draw figures of finished runs, ensembles and sweeps; errors of several in one."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from mimetypes import MimeTypes
from pathlib import Path
from typing import Any

from netkf.cli.options import print_notes
from netkf.core.errors import ScenarioError, suggest_nearest
from netkf.core.extras import missing
from netkf.core.printable import shorten
from netkf.figures.names import FIGURE_NAMES, FIT_FIGURES, FIT_FILE, FORMATS, is_picture
from netkf.runs.files import require_own
from netkf.studies.opening import open as open_directory


def _run(options: argparse.Namespace) -> int:
    if find_spec("matplotlib") is None:
        raise missing("matplotlib", "plot", "plot")
    # Empty: all figures.
    names = tuple(name for text in options.figure for name in _figure_names(text))
    has_several = len(options.directories) > 1
    if options.out is not None:
        count = 1 if names == ("error",) else len(options.directories)
        _check_output(options.out, count, options.format)
    results: list[Any] = []
    for directory in options.directories:
        if (directory / FIT_FILE).is_file():
            from netkf.logs.fitting import read_fit

            results.append(read_fit(directory))
        else:
            results.append(open_directory(directory, trust=options.trust))
    each = list(zip(options.directories, results, strict=True))
    notes = [
        f"{directory}: {result.status}; figures show what it has kept"
        for directory, result in each
        if getattr(result, "status", "") in ("failed", "interrupted")
    ]
    # After all that can be refused: importing matplotlib takes a second.
    from netkf.figures.catalogue import plot_to_files

    file_format = options.format or "png"
    if has_several and "error" in names:
        together = dict(zip(map(str, options.directories), results, strict=True))
        out = options.out or options.directories[0] / "figures"
        target = out if is_picture(out) else out / f"errors.{file_format}"
        print(*plot_to_files(together, ("error",), target, file_format))
        names = tuple(name for name in names if name != "error")
        # Without names all figures would be drawn.
        each = each if names else []
    for directory, result in each:
        if options.out is None:
            out = directory / "figures"
        else:
            out = options.out / directory.name if has_several else options.out
        for path in plot_to_files(result, names, out, file_format):
            print(path)
    print_notes(notes)
    return 0


def _check_output(out: Path, directories: int, file_format: str | None) -> None:
    """Raise ScenarioError or WriteError if ``out`` cannot hold the figures."""
    suffix = out.suffix.removeprefix(".").lower()
    if file_format and suffix in FORMATS and suffix != file_format:
        rule = f"is not that of {shorten(out)}"
        raise ScenarioError("--format", rule, file_format, "leave one of them out")
    if out.is_dir():
        return
    if is_picture(out):
        if directories > 1:
            rule, remedy = "is one file for several directories", "name a directory"
            raise ScenarioError("--out", rule, str(out), remedy)
        require_own(out)
    elif out.exists():
        rule, remedy = "cannot be made (File exists)", "name a directory, or a new file NAME.png"
        raise ScenarioError("--out", rule, str(out), remedy)
    elif MimeTypes().guess_type(out.name)[0]:  # a directory x.jpg would be no picture
        rule = "is no picture that netkf writes"
        remedy = f"name a directory, or a file that ends in .{', .'.join(FORMATS)}"
        raise ScenarioError("--out", rule, str(out), remedy)


def _figure_names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ScenarioError("--figure", "must name figures", text, "leave it out to draw all")
    for name in names:
        known = (*FIGURE_NAMES, *FIT_FIGURES)
        if name not in known:
            remedy = f"{suggest_nearest(name, known)}figures are {', '.join(known)}"
            raise ScenarioError("figure", "is not known", name, remedy)
    return names
