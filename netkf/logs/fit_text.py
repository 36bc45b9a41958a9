"""What ``netkf fit`` prints."""

from __future__ import annotations

from collections.abc import Iterator

from netkf.logs.fitting import LogFit
from netkf.runs.tables import format_number, format_table, shorten_rows

MAX_LINKS = 12


def format_fit(fit: LogFit) -> str:
    """Return the tables of a fit as text: links, tests of assumptions, laws, and their verdicts."""
    return "\n".join(_lines(fit))


def _lines(fit: LogFit) -> Iterator[str]:
    worst = fit.links.sort_values("delivery_probability", kind="stable")
    columns = ("packets", "heard", "unknown", "delivery_probability", "low", "high", "mean_burst")
    header = ["link", "packets", "heard", "unknown", "delivery", "low", "high", "mean burst"]
    rows = [
        [f"{row['sender']} -> {row['receiver']}", *(format_number(row[c]) for c in columns)]
        for row in worst.to_dict("records")
    ]
    yield format_table(header, shorten_rows(rows, MAX_LINKS), 1)
    yield ""
    header = ["assumption", "departure", "estimate", "detectable", "p", "verdict", "law without it"]
    cells = [
        [
            row["assumption"],
            row["departure"],
            *(format_number(row[c]) for c in ("estimate", "detectable", "p")),
            row["verdict"],
            row["made_by"] if row["verdict"] == "rejected" else "",
        ]
        for row in fit.tests.to_dict("records")
    ]
    yield format_table(header, cells, 2)
    yield ""
    header = ["law", "parameters", "log-likelihood", "BIC", "rejected: not true that"]
    cells = [
        [
            row["law"],
            row["parameters"],
            f"{row['log_likelihood']:.1f}",
            f"{row['bic']:.1f}",
            row["rejected_by"] or "-",
        ]
        for row in fit.laws.to_dict("records")
    ]
    yield format_table(header, cells, 2)
    if len(fit.envelope):
        yield ""
        yield from _envelope_lines(fit)
    yield ""
    yield from (f"note: {note}" for note in fit.notes)
    yield f"written: {', '.join(str(path) for path in fit.scenarios.values())}"


def _envelope_lines(fit: LogFit) -> Iterator[str]:
    header = ["law", "quantity", "replay", "low", "median", "high", "p", ""]
    rows = [
        [
            row["law"],
            row["quantity"],
            *(format_number(row[c]) for c in ("replay", "low", "median", "high", "p")),
            "" if row["inside"] else "OUTSIDE",
        ]
        for row in fit.envelope.to_dict("records")
    ]
    yield format_table(header, rows, 2)
    yield ""
    for law, rows_of_law in fit.envelope.groupby("law", sort=False):
        outside = rows_of_law["quantity"][~rows_of_law["inside"]]
        if len(outside):
            yield f"{law} fails: it does not make the replay's {', '.join(outside)}"
        else:
            yield f"{law}: the replay lies in its envelope"
