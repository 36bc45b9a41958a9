"""``netkf fit``: fit laws of losses to a recorded network, and look for its replay among them; with
``--noise``, the noise of plant and sensors to the readings.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping

import pandas as pd

from netkf.cli.options import parse_changes, print_json
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError
from netkf.logs.fitting import LogFit, fit_log
from netkf.runs.tables import format_number, format_table, shorten_rows

MAX_LINKS = 12
LINKS = {
    **{name: name for name in ("link", "packets", "heard", "unknown")},
    "delivery_probability": "delivery",
    **{"low": "low", "high": "high", "mean_burst": "mean burst"},
}
TESTS = {
    **{name: name for name in ("assumption", "departure", "estimate", "detectable", "p")},
    **{"verdict": "verdict", "law": "law without it"},
}
LAWS = {
    **{"law": "law", "parameters": "parameters", "log_likelihood": "log-likelihood", "bic": "BIC"},
    "rejected_by": "rejected: not true that",
}
ENVELOPE = {name: name for name in ("law", "quantity", "replay", "low", "median", "high", "p", "")}
"""Headings of the columns of each table."""


def _lines(fit: LogFit) -> Iterator[str]:
    """Yield the tables of a fit: links, tests of assumptions, laws, and their verdicts."""
    links = fit.links.sort_values("delivery_probability", kind="stable")
    yield _text(links.assign(link=links["sender"] + " -> " + links["receiver"]), LINKS, 1)
    made_by = fit.tests["made_by"].where(fit.tests["verdict"] == "rejected", "")
    yield _text(fit.tests.assign(law=made_by), TESTS, 2)
    yield _text(fit.laws.assign(rejected_by=fit.laws["rejected_by"].replace("", "-")), LAWS, 2)
    if len(fit.envelope):
        mark = fit.envelope["inside"].map({True: "", False: "OUTSIDE"})
        yield _text(fit.envelope.assign(**{"": mark}), ENVELOPE, 2)
        for law, rows in fit.envelope.groupby("law", sort=False):
            outside = ", ".join(rows["quantity"][~rows["inside"]])
            fails = f"{law} fails: it does not make the replay's {outside}"
            yield fails if outside else f"{law}: the replay lies in its envelope"
        yield ""
    yield from (f"note: {note}" for note in fit.notes)
    yield f"written: {', '.join(str(path) for path in fit.scenarios.values())}"


def _text(table: pd.DataFrame, headings: Mapping[str, str], left: int) -> str:
    cells = [
        [value if isinstance(value, str) else format_number(value) for value in row]
        for row in table[[*headings]].to_numpy().tolist()
    ]
    rows = shorten_rows(cells, MAX_LINKS) if headings is LINKS else cells
    return format_table([*headings.values()], rows, left) + "\n"


def _run(options: argparse.Namespace) -> int:
    if options.noise:
        return _fit_noise(options)
    if options.set:
        raise ScenarioError("--set", "is for --noise", options.set[0], "leave it out")
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
        print("\n".join(_lines(found)))
    return 0


def _fit_noise(options: argparse.Namespace) -> int:
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
