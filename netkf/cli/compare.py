"""``netkf compare``: print finished runs side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from netkf.cli.options import Command, add_confidence, add_options, print_json


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="run directory")
    add_confidence(parser, 0.95, "that all marks are right")
    add_options(parser, "json")


def _run(options: argparse.Namespace) -> int:
    """Print the comparison of run directories; return the exit status."""
    from netkf.studies.compare import compare
    from netkf.studies.tables import format_comparison

    comparison = compare(options.directories, options.confidence)
    if options.json:
        print_json(comparison.document())
    else:
        print(format_comparison(comparison))
    return 0


COMMAND = Command(
    "compare",
    "compare finished runs side by side and mark significant differences",
    _declare,
    _run,
    takes_scenario=False,
)
