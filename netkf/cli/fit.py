"""``netkf fit``: fit laws of losses to a recorded network, and look for its replay among them; with
``--noise``, the noise of plant and sensors to the readings.
"""

from __future__ import annotations

import argparse
import json

from netkf.cli.options import parse_changes, print_json
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError


def _run(options: argparse.Namespace) -> int:
    if options.noise:
        return _fit_noise(options)
    if options.set:
        raise ScenarioError("--set", "is for --noise", options.set[0], "leave it out")
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


def _fit_noise(options: argparse.Namespace) -> int:
    from netkf.runs.tables import format_number, format_table
    from netkf.scenario.reading import load
    from netkf.studies.likelihood import fit_noise

    path, changes = options.directory, parse_changes(options.set)
    path = path / "scenario.toml" if path.is_dir() else path
    found = fit_noise(load(path, changes, trust=options.trust), confidence=options.confidence)
    if options.json:
        names = ("log_likelihood", "start_log_likelihood", "readings", "changes", "notes")
        values = {name: getattr(found, name) for name in names}
        print_json({"variances": found.table.to_dict("records"), **values})
        return 0
    columns = ["start", "value", "se", "low", "high"]
    rows = [
        [row["name"], *(format_number(row[name]) for name in columns)]
        for row in found.table.to_dict("records")
    ]
    print(f"{found.name}\n\n{format_table(['variance', *columns], rows, left_columns=1)}\n")
    print(
        f"log-likelihood of {found.readings:,} readings: {found.start_log_likelihood:.8g} in the "
        f"scenario, {found.log_likelihood:.8g} with the values; low, high: each at confidence "
        f"{found.confidence:g}"
    )
    print(*(f"note: {note}\n" for note in found.notes), sep="")
    print("the scenario with them, as --set takes it:")
    print(*(f"{key}={json.dumps(value)}" for key, value in found.changes.items()), sep="\n")
    return 0
