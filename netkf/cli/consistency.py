"""``netkf consistency``: compare the NEES and NIS of a filter with their expected values."""

from __future__ import annotations

import argparse
import sys

from netkf.cli.options import FAILED, load_scenario, pool_settings, print_json, print_table_notes


def _run(options: argparse.Namespace) -> int:
    from netkf.studies.consistency import consistency
    from netkf.studies.tables import format_consistency

    scenario = load_scenario(options)
    result = consistency(
        scenario, options.runs, confidence=options.confidence, **pool_settings(options)
    )
    print_table_notes(scenario)
    if options.json:
        print_json({**vars(result), "rows": [vars(row) for row in result.rows]})
    else:
        print(f"{result.scenario}\n\n{format_consistency(result, full=options.all)}")
    if not result:
        nodes = ", ".join(row.label for row in result.rows if row.verdict.startswith("BROKEN"))
        print(f"netkf: errors are inconsistent with P at node {nodes}", file=sys.stderr)
    return 0 if result else FAILED
