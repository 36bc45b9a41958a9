"""``netkf compare``: print finished runs side by side."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from netkf.cli.options import add_command, add_json, print_json


def add_parser(commands: Any) -> None:
    """Add the options of ``netkf compare``."""
    text = "compare finished runs side by side and mark significant differences"
    parser = add_command(commands, "compare", run, text)
    parser.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="run directory")
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.95,
        help="probability that all marks are right (default: 0.95)",
    )
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit status."""
    from netkf.studies.compare import compare
    from netkf.studies.tables import comparison_text

    comparison = compare(options.directories, options.confidence)
    if options.json:
        print_json(comparison.document())
    else:
        print(comparison_text(comparison))
    return 0
