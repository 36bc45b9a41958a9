"""``netkf report``: one self-contained HTML page of finished runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from netkf.cli.options import Command, add_trust, parse_replica


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "directories",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="directory of a run, an ensemble, a sweep, a verdict or compared filters; a second "
        "one to compare with, or the verdict of the first",
    )
    parser.add_argument("--out", type=Path, help="file of the page (default: DIR/report.html)")
    parser.add_argument(
        "--replica", type=parse_replica, help="recorded run to show (default: the first)"
    )
    add_trust(parser, "the directory")


def _run(options: argparse.Namespace) -> int:
    """Write the page and print its path; return the exit status."""
    from netkf.report.page import write_report

    path = write_report(options.directories, options.out, options.replica, options.trust)
    print(f"written to {path}")
    return 0


COMMAND = Command(
    "report",
    "write a page with the network in motion, figures and verdicts of a run",
    _declare,
    _run,
    takes_scenario=False,
)
