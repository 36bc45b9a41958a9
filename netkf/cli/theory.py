"""``netkf theory``: what is promised for a scenario, computed without a simulation."""

from __future__ import annotations

import argparse
from typing import Any

from netkf.cli.options import add_json, add_scenario_command, load_scenario, print_json, print_notes


def add_parser(commands: Any) -> None:
    """Add the options of ``netkf theory``."""
    text = "check assumptions and compute bounds and limits; no simulation"
    add_json(add_scenario_command(commands, "theory", run, text))


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit status."""
    from netkf.runs.failures import explain_failures
    from netkf.runs.promises import promises, promises_text

    scenario = load_scenario(options)
    with explain_failures(scenario):
        found = promises(scenario)
    print_notes(scenario.notes)
    if options.json:
        print_json(found)
    else:
        print(promises_text(scenario, found))
    return 0
