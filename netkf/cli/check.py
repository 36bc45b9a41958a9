"""``netkf check``: compare simulations with the guarantees of the filter's paper."""

from __future__ import annotations

import argparse

from netkf.cli.options import (
    FAILED,
    Command,
    add_json,
    add_pool,
    add_seed,
    load_scenario,
    parse_count,
    print_json,
    print_notes,
)
from netkf.cli.progress import ProgressLine


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--runs", type=parse_count, default=500, help="number of runs (default: 500)"
    )
    add_seed(parser)
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.99,
        help="probability with which all intervals hold together (default: 0.99)",
    )
    add_pool(parser)
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    """Return the exit status: 1 if a promise is broken."""
    from netkf.checks.check import check
    from netkf.checks.points import sampling_note
    from netkf.checks.report import verdict_json, verdict_text

    # Promises are checked at times of their own, so that the file's may not fit the horizon.
    scenario = load_scenario(options, {"probe": [0.0]})
    with ProgressLine() as line:
        verdict = check(
            scenario,
            options.runs,
            confidence=options.confidence,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=line.counter("runs"),
        )
    print_notes((*scenario.notes, *filter(None, [sampling_note(scenario)])))
    if options.json:
        print_json(verdict_json(verdict))
    else:
        print(verdict_text(verdict, scenario.claim))
    return 0 if verdict else FAILED


COMMAND = Command("check", "compare simulations with theory, one row per promise", _declare, _run)
