"""``netkf innovations``: test if a run fits its model, node by node, without a true state."""

from __future__ import annotations

import argparse
import sys

from netkf.cli.options import FAILED, load_scenario, print_json, print_table_notes


def _run(options: argparse.Namespace) -> int:
    from netkf.runs.simulate import simulate
    from netkf.studies.innovation_tests import format_innovations, innovations

    scenario = load_scenario(options)
    run = simulate(scenario, replica=options.replica or 0, engine=options.engine)
    result = innovations(run, options.confidence)
    print_table_notes(scenario)
    if options.json:
        print_json({**vars(result), "rows": [vars(row) for row in result.rows]})
    else:
        print(f"{result.scenario}\n\n{format_innovations(result, options.all)}")
    if not result:
        nodes = [str(row.node) for row in result.rows if row.verdict.startswith("BROKEN")]
        print(f"netkf: the model does not explain node {', '.join(nodes)}", file=sys.stderr)
    return 0 if result else FAILED
