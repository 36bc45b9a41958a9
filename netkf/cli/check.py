"""``netkf check``: compare simulations with the guarantees of the filter's paper."""

from __future__ import annotations

import argparse
from typing import Any

from netkf.cli.options import (
    FAILED,
    add_json,
    add_pool,
    add_scenario_command,
    add_seed,
    count,
    load_scenario,
    print_json,
    print_notes,
)
from netkf.cli.progress import ProgressLine


def add_parser(commands: Any) -> None:
    """Add the options of ``netkf check``."""
    text = "compare simulations with theory, one row per promise"
    parser = add_scenario_command(commands, "check", run, text)
    parser.add_argument("--runs", type=count, default=500, help="number of runs (default: 500)")
    add_seed(parser)
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.99,
        help="probability with which all intervals hold together (default: 0.99)",
    )
    add_pool(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit status: 1 if a promise is broken."""
    from netkf.checks.check import check, verdict_json, verdict_text
    from netkf.checks.mode_sequences import watched_note

    scenario = load_scenario(options)
    with ProgressLine() as line:
        verdict = check(
            scenario,
            options.runs,
            confidence=options.confidence,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=line.counter("runs"),
        )
    print_notes((*scenario.notes, *filter(None, [watched_note(scenario)])))
    if options.json:
        print_json(verdict_json(verdict))
    else:
        print(verdict_text(verdict, scenario.claim))
    return 0 if verdict else FAILED
