"""``netkf consistency``: compare the NEES and NIS of a filter with their expected values."""

from __future__ import annotations

import argparse
import sys

from netkf.cli.options import (
    FAILED,
    Command,
    add_confidence,
    add_options,
    load_scenario,
    parse_count,
    print_json,
    print_table_notes,
)


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--runs", type=parse_count, default=50, help="number of runs (default: 50)")
    add_confidence(parser, 0.99, "that no consistent filter is called broken")
    add_options(parser, "seed", "engine", "pool", "all", "json")


def _run(options: argparse.Namespace) -> int:
    from netkf.studies.consistency import consistency
    from netkf.studies.tables import format_consistency

    scenario = load_scenario(options)
    result = consistency(
        scenario,
        options.runs,
        confidence=options.confidence,
        workers=options.workers,
        scheduler=options.scheduler,
        engine=options.engine,
    )
    print_table_notes(scenario)
    if options.json:
        print_json({**vars(result), "rows": [vars(row) for row in result.rows]})
    else:
        print(f"{result.scenario}\n\n{format_consistency(result, full=options.all)}")
    if not result:
        nodes = ", ".join(str(row.node) for row in result.rows if row.verdict.startswith("BROKEN"))
        print(f"netkf: errors are inconsistent with P at node {nodes}", file=sys.stderr)
    return 0 if result else FAILED


COMMAND = Command(
    "consistency",
    "test if P describes the errors: NEES and NIS against their expected values",
    _declare,
    _run,
)
