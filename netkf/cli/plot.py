"""``netkf plot``: draw figures of finished runs, ensembles and sweeps."""

from __future__ import annotations

import argparse
from pathlib import Path

from netkf.cli.options import Command, add_trust
from netkf.core.errors import ScenarioError

FORMATS = ("png", "svg", "pdf")
"""As in netkf.figures.style, which imports matplotlib."""


def _declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``netkf plot``, which draws figures of finished runs, on its
    ``parser``; called when the command line is built.
    """
    parser.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="run directory")
    parser.add_argument(
        "--figure",
        action="append",
        default=[],
        metavar="NAME[,NAME]",
        help="figures to draw: overview, error, quantiles, ratios, network, nees, nis, whiteness, "
        "age, links, stability, law, delivery (default: all)",
    )
    parser.add_argument(
        "--out", type=Path, help="file or directory of the figures (default: DIR/figures)"
    )
    parser.add_argument("--format", choices=FORMATS, help="format of the files (default: png)")
    add_trust(parser, "DIR")


def _run(options: argparse.Namespace) -> int:
    """Draw figures of directories into files and print their paths; return the exit status.

    Raises ScenarioError without matplotlib, for unknown figures, and for one file of several
    figures.
    """
    try:
        from netkf.figures.catalogue import plot_to_files
    except ImportError:
        rule, remedy = "needs matplotlib", "install it: pip install 'netkf[plot]'"
        raise ScenarioError("plot", rule, None, remedy) from None
    from netkf.studies.opening import open as open_directory

    # Empty: all figures.
    names = tuple(name for text in options.figure for name in _figure_names(text))
    has_several = len(options.directories) > 1
    if has_several and options.out is not None and options.out.suffix.removeprefix(".") in FORMATS:
        rule, remedy = "is one file for several directories", "name a directory"
        raise ScenarioError("--out", rule, str(options.out), remedy)
    for directory in options.directories:
        if options.out is None:
            out = directory / "figures"
        else:
            out = options.out / directory.name if has_several else options.out
        result = open_directory(directory, trust=options.trust)
        for path in plot_to_files(result, names, out, options.format or "png"):
            print(path)
    return 0


def _figure_names(text: str) -> list[str]:
    """Return the names of a list separated by commas; raises ScenarioError if it is empty."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ScenarioError("--figure", "must name figures", text, "leave it out to draw all")
    return names


COMMAND = Command(
    "plot",
    "draw figures of finished runs, ensembles and sweeps",
    _declare,
    _run,
    takes_scenario=False,
)
