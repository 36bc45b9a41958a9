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
)

if TYPE_CHECKING:
    from netkf.studies.why import Why


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="DIR", help="run directory")
    parser.add_argument("--node", type=int, required=True, metavar="I", help="id of the node")
    parser.add_argument(
        "--at", type=float, required=True, metavar="T", help="simulated time in seconds"
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
    from netkf.studies.why import why

    found = why(
        options.directory,
        options.node,
        options.at,
        replica=options.replica,
        below=options.below,
        most=options.most,
        replays=options.replays,
        trust=options.trust,
    )
    if options.out is not None:
        _keep(found, options.out)
    if options.json:
        print_json(found.to_dict())
    else:
        print(found)
    return 0


def _keep(found: Why, directory: Path) -> None:
    """Write why.txt, why.json and why.csv into a new directory."""
    from netkf.runs.files import new_directory, write_atomically, write_json, write_text

    folder = new_directory(directory, "why")
    write_text(folder / "why.txt", f"{found}\n")
    write_json(folder / "why.json", found.to_dict())
    with write_atomically(folder / "why.csv") as part:
        found.table.to_csv(part, index=False)


COMMAND = Command(
    "why",
    "explain what a node knew at an instant: whom it heard, and which messages were missing",
    _declare,
    _run,
    takes_scenario=False,
)
