"""``netkf fit``: fit laws of losses to a recorded network, and look for its replay among them."""

from __future__ import annotations

import argparse

from netkf.cli.options import print_json
from netkf.cli.progress import ProgressLine


def _run(options: argparse.Namespace) -> int:
    """Fit, write and print; return the exit status."""
    from netkf.logs.fit_text import format_fit
    from netkf.logs.fitting import fit_log

    with ProgressLine() as line:
        found = fit_log(
            options.directory,
            0 if options.no_runs else options.runs,
            confidence=options.confidence,
            trust=options.trust,
            workers=options.workers,
            progress=line.make_count_update("runs"),
        )
    if options.json:
        names = ("links", "tests", "laws", "envelope")
        tables = {name: getattr(found, name).to_dict("records") for name in names}
        files = {law: str(path) for law, path in found.scenarios.items()}
        print_json({**tables, "notes": found.notes, "scenarios": files})
    else:
        print(format_fit(found))
    return 0
