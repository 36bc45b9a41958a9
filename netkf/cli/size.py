"""``netkf size``: find the smallest (or largest) value of a key that meets a target."""

from __future__ import annotations

import argparse
import sys

from netkf.cli.options import (
    FAILED,
    Command,
    add_confidence,
    add_options,
    add_vary,
    load_scenario,
    parse_count,
    print_json,
    print_table_notes,
)
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError


def _declare(parser: argparse.ArgumentParser) -> None:
    add_vary(parser, "KEY.PATH=LOW:HIGH", "the key to search and its range")
    parser.add_argument(
        "--target",
        required=True,
        metavar="QUANTITY<=LIMIT",
        help="quantities: worst_rms, mean_rms, worst_trace, mean_trace, within_central",
    )
    parser.add_argument(
        "--by",
        choices=["theory", "simulation"],
        help="decide by theory or by simulation alone (default: the exact quantity or a bound, "
        "and simulation where the bound does not reach the target)",
    )
    parser.add_argument(
        "--runs",
        type=parse_count,
        default=1000,
        help="at most this many runs per value (default: 1000)",
    )
    add_confidence(parser, 0.95, "that all decisions are right")
    add_options(parser, "seed", "engine", "pool", "json")


def _run(options: argparse.Namespace) -> int:
    """Search the value and print it; return the exit status, 1 if there is none."""
    from netkf.studies.parameter_grid import parse_interval
    from netkf.studies.size import size
    from netkf.studies.tables import format_answer, format_sizing

    if len(options.vary) > 1:
        remedy = "size searches one key; sweep varies several"
        raise ScenarioError("--vary", "is given more than once", options.vary, remedy)
    key, low, high = parse_interval(options.vary[0])
    scenario = load_scenario(options)
    with ProgressLine() as line:
        sizing = size(
            scenario,
            key,
            low,
            high,
            options.target,
            options.by,
            options.runs,
            options.confidence,
            workers=options.workers,
            scheduler=options.scheduler,
            engine=options.engine,
            progress=line.report,
        )
    print_table_notes(scenario)
    if options.json:
        probes = [probe._asdict() for probe in sorted(sizing.probes)]
        target = sizing.target._asdict()
        print_json(
            {**vars(sizing), "target": target, "probes": probes, "answer": format_answer(sizing)}
        )
    else:
        print(format_sizing(sizing))
    if not sizing:
        print(f"netkf: {format_answer(sizing)}", file=sys.stderr)
    return 0 if sizing else FAILED


COMMAND = Command(
    "size", "find the smallest (or largest) value of a key that meets a target", _declare, _run
)
