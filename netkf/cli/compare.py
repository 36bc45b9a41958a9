"""``netkf compare``: print finished runs side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from netkf.cli.options import Command, add_json, print_json


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="run directory")
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.95,
        help="probability that all marks are right (default: 0.95)",
    )
    add_json(parser)


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
