"""``netkf consistency``: compare the NEES and NIS of a filter with their expected values."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from netkf.cli.options import (
    FAILED,
    add_engine,
    add_json,
    add_pool,
    add_scenario_command,
    add_seed,
    count,
    load_scenario,
    print_json,
)


def add_parser(commands: Any) -> None:
    """Add the options of ``netkf consistency``."""
    text = "test if P describes the errors: NEES and NIS against their expected values"
    parser = add_scenario_command(commands, "consistency", run, text)
    parser.add_argument("--runs", type=count, default=50, help="number of runs (default: 50)")
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.95,
        help="probability that no consistent filter is called broken (default: 0.95)",
    )
    add_seed(parser)
    add_engine(parser)
    add_pool(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit status: 1 if the errors of a node are inconsistent."""
    from netkf.studies.consistency import consistency
    from netkf.studies.tables import consistency_text

    found = consistency(
        load_scenario(options),
        options.runs,
        confidence=options.confidence,
        workers=options.workers,
        scheduler=options.scheduler,
        engine=options.engine,
    )
    if options.json:
        print_json({**vars(found), "rows": [vars(row) for row in found.rows]})
    else:
        print(f"{found.scenario}\n\n{consistency_text(found)}")
    if not found:
        nodes = ", ".join(str(row.node) for row in found.rows if row.verdict.startswith("BROKEN"))
        print(f"netkf: errors are not what they should be at node {nodes}", file=sys.stderr)
    return 0 if found else FAILED
