"""``netkf size``: find the smallest (or largest) value of a key that meets a target."""

from __future__ import annotations

import argparse
import sys

from netkf.cli.options import FAILED, load_scenario, pool_settings, print_json, print_table_notes
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError


def _run(options: argparse.Namespace) -> int:
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
            **pool_settings(options),
            progress=line.replace,
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
    # Each worker of a plan finds the same answer, which merge prints.
    if not sizing and not getattr(options, "works", False):
        print(f"netkf: {format_answer(sizing)}", file=sys.stderr)
    return 0 if sizing else FAILED
