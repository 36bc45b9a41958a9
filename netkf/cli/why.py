"""``netkf why``: explain what a node of a finished run knew at an instant."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from netkf.cli.options import (
    Command,
    add_json,
    add_trust,
    parse_count,
    parse_replica,
    print_json,
    print_notes,
)
from netkf.core.errors import ScenarioError
from netkf.core.printable import shorten

if TYPE_CHECKING:
    from netkf.studies.why import Why


def _declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``netkf why``."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="run directory")
    parser.add_argument(
        "--node", type=int, metavar="I", help="id of the node (default: the one that is most off)"
    )
    parser.add_argument(
        "--at",
        type=float,
        metavar="T",
        help="simulated time in seconds (default: when that node is most off)",
    )
    parser.add_argument(
        "--replica", type=parse_replica, help="run of an ensemble with all traces (default: 0)"
    )
    parser.add_argument(
        "--below",
        type=float,
        metavar="X",
        help="trace of P that the smallest set of messages has to reach (default: 5 percent above "
        "that without losses)",
    )
    parser.add_argument(
        "--most", type=int, default=3, choices=(1, 2, 3), help="messages of the set (default: 3)"
    )
    parser.add_argument(
        "--replays",
        type=parse_count,
        help="replays that look for the set at most (default: 100 to 1000, by the events of one)",
    )
    add_trust(parser, "DIR")
    parser.add_argument("--out", type=Path, help="keep the answer in this directory")
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    """Explain a sample of a run; return the exit status."""
    from netkf.runs.directory_lock import lock_directory

    if (options.node is None) != (options.at is None):
        remedy = "give both, or neither for the worst sample"
        raise ScenarioError("why", "takes --node and --at together", None, remedy)
    with lock_directory(options.out, must_be_empty=True):
        return _explain(options)


def _explain(options: argparse.Namespace) -> int:
    """Explain a sample, print the text and save it if asked; return the exit status."""
    from netkf.studies.why import why

    node, at = options.node, options.at
    if node is None:
        node, at = _worst_sample(options)
    found = why(
        options.directory,
        node,
        at,
        replica=options.replica,
        below=options.below,
        most=options.most,
        replays=options.replays,
        trust=options.trust,
    )
    try:
        if options.out is not None:
            _keep(found, options.out)
    finally:  # an answer that cannot be kept is one too
        if options.json:
            print_json(found.to_dict())
        else:
            print(found)
    return 0


def _worst_sample(options: argparse.Namespace) -> tuple[int, float]:
    """Return the node and the time of the worst sample after the start-up, and print a note.

    Raises ScenarioError if the directory has no samples of one run.
    """
    from netkf.report.directories import read_source

    found = read_source(options.directory, options.replica, options.trust).worst
    if found is None:
        rule = "has no samples of a run, of which the worst could be explained"
        remedy = "name a run, or an ensemble with --trace full"
        raise ScenarioError(shorten(options.directory), rule, None, remedy)
    worst = found.explained
    largest = "error" if worst.by_error else "trace of P"
    print_notes(
        [
            f"node {worst.node} at {worst.time:.10g} s: the largest {largest} after the start-up "
            f"of the node that is most off; --node and --at ask about another"
        ]
    )
    return worst.node, worst.time


def _keep(found: Why, directory: Path) -> None:
    """Write why.txt, why.json and why.csv."""
    from netkf.runs.files import write_atomically, write_json, write_text

    write_text(directory / "why.txt", f"{found}\n")
    write_json(directory / "why.json", found.to_dict())
    with write_atomically(directory / "why.csv") as part:
        found.table.to_csv(part, index=False)


COMMAND = Command(
    "why",
    "explain what a node knew at an instant: whom it heard, and which messages were missing",
    _declare,
    _run,
    takes_scenario=False,
)
