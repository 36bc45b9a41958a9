"""What ``netkf fit`` prints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pandas as pd

from netkf.logs.fitting import LogFit
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


def format_fit(fit: LogFit) -> str:
    """Return the tables of a fit as text: links, tests of assumptions, laws, and their verdicts."""
    return "\n".join(_lines(fit))


def _lines(fit: LogFit) -> Iterator[str]:
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
