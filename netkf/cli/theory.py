"""``netkf theory``: assumptions, bounds and limits of a scenario, without a simulation."""

from __future__ import annotations

import argparse

from netkf.cli.options import Command, add_options, load_scenario, print_json, print_notes


def _declare(parser: argparse.ArgumentParser) -> None:
    add_options(parser, "json")


def _run(options: argparse.Namespace) -> int:
    scenario = load_scenario(options)
    # These imports take half a second, which an invalid scenario need not wait for.
    from netkf.runs.failures import explain_failures
    from netkf.theory.promises import compute_promises, promises_text

    with explain_failures(scenario):
        promises = compute_promises(scenario)
    print_notes(scenario.notes)
    if options.json:
        print_json(promises)
    else:
        print(promises_text(scenario, promises))
    return 0


COMMAND = Command(
    "theory", "check assumptions and compute bounds and limits; no simulation", _declare, _run
)
