"""``netkf export``: write a run in another form."""

from __future__ import annotations

import argparse


def _run(options: argparse.Namespace) -> int:
    """Write the log and print its paths; return the exit status."""
    from netkf.core.errors import ScenarioError
    from netkf.logs.exporting import export_log, export_recorded
    from netkf.studies.opening import open as open_directory
    from netkf.trace.run import Run

    run = open_directory(options.directory, trust=options.trust)
    if not isinstance(run, Run):
        remedy = "name the directory of a single run"
        raise ScenarioError(str(options.directory), "must be a run with its events", None, remedy)
    recorded = options.to == "recorded"
    *files, last = (export_recorded if recorded else export_log)(run, options.out)
    print(f"written: {last} with {', '.join(path.name for path in files)}")
    if recorded:
        print(f"next: netkf run {last}" + f" --replica {run.replica}" * bool(run.replica))
    else:
        print(f"next: netkf import {options.out} --kind csv --out DIR")
    return 0
