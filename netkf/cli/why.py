"""``netkf why``: explain the estimate of a node of a finished run at a sample time."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from netkf.cli.options import (
    Command,
    add_options,
    add_trust,
    parse_count,
    parse_replica,
    print_json,
    print_notes,
)
from netkf.core.errors import ScenarioError, quote
from netkf.core.printable import MAX_NAME, shorten

if TYPE_CHECKING:
    from netkf.studies.why import Why
    from netkf.trace.run import Run


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="DIR", help="run directory")
    parser.add_argument(
        "--node",
        type=_parse_node,
        metavar="I",
        help="id or name of the node (default: the worst node)",
    )
    parser.add_argument(
        "--at",
        type=float,
        metavar="T",
        help="simulated time in seconds (default: the worst sample of that node)",
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
        help="largest number of replays that search the set (default: 10 to 1000, by the events "
        "of the run)",
    )
    add_trust(parser, "DIR")
    parser.add_argument("--out", type=Path, help="directory for the answer and its table")
    add_options(parser, "json")


def _parse_node(text: str) -> str:
    """Return the id or the name of a node; raises ArgumentTypeError for a text that is neither."""
    if not text.strip() or len(text) > MAX_NAME:
        rule = f"must be the id or the name of a node, of at most {MAX_NAME} characters"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return text.strip()


def _run(options: argparse.Namespace) -> int:
    from netkf.runs.directory_lock import lock_directory

    if (options.node is None) != (options.at is None):
        remedy = "give both, or neither for the worst sample"
        raise ScenarioError("why", "takes --node and --at together", None, remedy)
    with lock_directory(options.out, must_be_empty=True):
        return _explain(options)


def _explain(options: argparse.Namespace) -> int:
    from netkf.studies.why import why

    run: Run | Path = options.directory
    node, at, notes = options.node, options.at, []
    if node is None:
        run, node, at, note = _find_worst_sample(options)
        notes.append(note)
    explanation = why(
        run,
        node,
        at,
        replica=options.replica,
        below=options.below,
        most=options.most,
        replays=options.replays,
        trust=options.trust,
    )
    # Not before: a refusal is one line.
    print_notes(notes)
    try:
        if options.out is not None:
            _write_explanation(explanation, options.out)
    finally:
        if options.json:
            print_json(explanation.to_dict())
        else:
            print(explanation)
    return 0


def _find_worst_sample(options: argparse.Namespace) -> tuple[Run, int, float, str]:
    """Return run, node and time (s) of the worst sample after the start-up, and a note on it."""
    from netkf.report.directories import read_source

    source = read_source(options.directory, options.replica, options.trust)
    samples = source.worst
    if samples is None or source.run is None:
        rule = "has no samples of a run, of which the worst could be explained"
        remedy = "name a run, or an ensemble with --trace full"
        raise ScenarioError(shorten(options.directory), rule, None, remedy)
    worst = samples.explained
    quantity = "error" if worst.by_error else "trace of P"
    note = (
        f"node {worst.node} at {worst.time:.10g} s: the largest {quantity} of the worst node after "
        "the start-up; --node and --at choose another sample"
    )
    return source.run, worst.node, worst.time, note


def _write_explanation(explanation: Why, directory: Path) -> None:
    """Write why.txt, why.json and why.csv; raises WriteError if a file cannot be written."""
    from netkf.runs.files import write_atomically, write_json, write_text

    write_text(directory / "why.txt", f"{explanation}\n")
    write_json(directory / "why.json", explanation.to_dict())
    with write_atomically(directory / "why.csv") as temporary:
        explanation.table.to_csv(temporary, index=False)


COMMAND = Command(
    "why",
    "explain the estimate of a node at a time: the messages that it received, and those missing",
    _declare,
    _run,
    takes_scenario=False,
)
