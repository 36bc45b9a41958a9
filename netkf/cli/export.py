"""``netkf export``: write a run in another form."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from typing import Any

from netkf import export_graphml, export_netcdf, export_perfetto
from netkf.core.errors import ScenarioError
from netkf.ensembles.monte_carlo import Ensemble
from netkf.studies.opening import open as open_directory
from netkf.trace.run import Run

NEXT = {
    "netcdf": "xarray.load_dataset({0!r}) in Python",
    "graphml": "networkx.read_graphml({0!r}) in Python",
    "perfetto": "open it at https://ui.perfetto.dev",
}
"""What can be done with a file, by its form."""


def _run(options: argparse.Namespace) -> int:
    is_folder = options.to not in NEXT
    window = _window(options.window, options.to)
    if is_folder and options.out is None:
        raise ScenarioError("--out", "is missing", None, "name a new folder")
    stored: Any = open_directory(options.directory, trust=options.trust)
    if not isinstance(stored, (Run, Ensemble) if options.to == "netcdf" else Run):
        remedy = "name the directory of a single run"
        raise ScenarioError(str(options.directory), "must be a run with its events", None, remedy)
    run: Any = stored
    if is_folder:
        return _write_folder(run, options)
    out = options.directory if options.out is None else options.out
    if options.to == "perfetto":
        (path,) = export_perfetto(run, out, *window)
    else:
        (path,) = (export_netcdf if options.to == "netcdf" else export_graphml)(run, out)
    print(f"written: {path}")
    print(f"next: {NEXT[options.to].format(str(path))}")
    return 0


def _write_folder(run: Any, options: argparse.Namespace) -> int:
    from netkf.logs.exporting import export_log, export_recorded  # files of one run need none

    recorded = options.to == "recorded"
    *files, last = (export_recorded if recorded else export_log)(run, options.out)
    print(f"written: {last} with {', '.join(path.name for path in files)}")
    if recorded:
        replica = f" --replica {run.replica}" if run.replica else ""
        print(f"next: netkf run {shlex.quote(str(last))}{replica}")
    else:
        print(f"next: netkf import {shlex.quote(str(options.out))} --kind csv --out DIR")
    return 0


def _window(text: str | None, form: str) -> tuple[float, ...]:
    """Return begin and end in seconds of "FROM:TO", of which either may be left out."""
    if text is None:
        return ()
    if form != "perfetto":
        raise ScenarioError("--window", "is for --to perfetto", text, "leave it out")
    begin, colon, end = text.partition(":")
    values: tuple[float, ...] = ()
    with contextlib.suppress(ValueError):
        values = float(begin or 0.0), *((float(end),) if end else ())
    if not (colon and values):
        raise ScenarioError("--window", "must be FROM:TO in seconds", text, "write 10:20, say")
    return values
