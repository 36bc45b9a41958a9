"""``netkf theory``: assumptions, bounds and limits of a scenario, without a simulation."""

from __future__ import annotations

import argparse

from netkf.cli.options import load_scenario, print_json, print_notes


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
