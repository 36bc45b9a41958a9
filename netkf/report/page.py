"""``netkf report``: one self-contained HTML page of one or two directories."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError, WriteError
from netkf.core.version import __version__
from netkf.report import tables
from netkf.report.claims import difference_findings, findings
from netkf.report.data import Budget, run_data, thinning_rules
from netkf.report.directories import Opened, read_source
from netkf.report.filter_figure import filters_figure
from netkf.report.innovations import read_innovations
from netkf.report.markup import bullets, content_hash, paragraph, script_json, section, text
from netkf.report.mending import (
    central_sample,
    explain_worst,
    mending_claim,
    mending_section,
    price_claim,
)
from netkf.report.messages import MESSAGE, join_messages
from netkf.report.packing import Packer
from netkf.runs.documents import FINAL_STATUSES, DamagedError
from netkf.runs.files import write_text
from netkf.runs.innovations import Innovations
from netkf.runs.stored import StoredRun
from netkf.studies.compare import Comparison, compare, damage_named
from netkf.studies.explanation import Explanation
from netkf.studies.stored import StoredComparison
from netkf.trace.schema import KINDS

MAX_BYTES = 4_800_000
"""Size of a page above which its data are thinned further."""
BUDGET = Budget(messages=100_000, values=400_000)
MAX_NODES = 2_000
"""Nodes up to which there are live views."""
SCRIPTS = (
    "format.js",
    "decode.js",
    "state.js",
    "theme.js",
    "network.js",
    "estimates.js",
    "sequence.js",
    "why.js",
    "curves.js",
    "figures.js",
    "clock.js",
    "main.js",
)
POLICY = (
    "default-src 'none'; script-src {script}; style-src {style}; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)
MIN_BUDGET = 500
MARK = b'<meta name="generator" content="netkf '
"""What every page has among its first HEAD bytes, and other files have not."""
HEAD = 4096


class _Entry(NamedTuple):
    """A source with its MESSAGE rows, why its worst sample was what it was, and the innovations of
    its readings (or why these are not said).
    """

    source: Opened
    messages: np.ndarray
    worst: Explanation | str | None = None
    readings: Innovations | str | None = None

    @property
    def moves(self) -> bool:
        """True if there is something to show in the live views."""
        run = self.source.run
        return run is not None and len(run.times) > 0 and len(run.nodes) <= MAX_NODES


def write_report(
    directories: Sequence[str | Path],
    out: Path | None = None,
    replica: int | None = None,
    trust: bool = False,
) -> Path:
    """Write the page of one directory, or of two side by side, and return its path.

    The path is ``out``, by default ``report.html`` in the first directory. A second directory may
    hold the verdict of ``netkf check`` on the first. Raises ScenarioError for a directory that is
    not one of netkf's or a ``path`` that holds anything but a page, WriteError if the page cannot
    be written.
    """
    path = Path(directories[0]) / "report.html" if out is None else out
    _refuse_other_files(path)
    write_text(path, make_page(directories, replica, trust, path))
    return path


def _refuse_other_files(path: Path) -> None:
    """Raise ScenarioError if there is a file that is not a page: it would be lost."""
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError as error:
        raise WriteError(error, path) from error
    if MARK not in head:
        rule = "would overwrite a file that is not a page of netkf report"
        raise ScenarioError("--out", rule, str(path), "choose another name, or remove the file")


def make_page(
    directories: Sequence[str | Path],
    replica: int | None = None,
    trust: bool = False,
    out: Path | None = None,
) -> str:
    """Return the page of one or two directories as HTML; see ``write_report``."""
    if not 1 <= len(directories) <= 2:
        raise ScenarioError("report", "takes one or two directories", len(directories))
    entries = [_read_entry(Path(directory), replica, trust) for directory in directories]
    entries = _merge_verdict(entries)
    command = _report_command(directories, replica, trust, out)
    comparison = _compare(entries, directories)
    budget = Budget(*(part // len(entries) for part in BUDGET))
    while True:
        page = _assemble(entries, comparison, command, budget)
        if len(page.encode("utf-8")) <= MAX_BYTES or budget.messages < MIN_BUDGET:
            return page
        budget = budget.halve()


def _read_entry(directory: Path, replica: int | None, trust: bool) -> _Entry:
    """Return the contents of a directory, read for the page."""
    source = read_source(directory, replica, trust)
    none = np.empty(0, dtype=MESSAGE)
    if source.run is None:
        return _Entry(source, none)
    with damage_named(directory):
        try:
            messages = join_messages(source.run.log)
        except ValueError as error:
            raise DamagedError(f"events.parquet: {error}") from None
    return _Entry(source, messages, explain_worst(source), read_innovations(source))


def _merge_verdict(entries: list[_Entry]) -> list[_Entry]:
    """Return the entries, a verdict as part of the run beside it."""
    kinds = [entry.source.kind for entry in entries]
    if len(entries) == 2 and kinds[1] == "verdict" and kinds[0] in ("run", "ensemble"):
        first, verdict = entries
        source = replace(first.source, verdict=verdict.source.verdict)
        return [first._replace(source=source)]
    if len(entries) == 2 and not {*kinds} <= {"run", "ensemble"}:
        rule = "compares runs and ensembles; a verdict can stand behind a run"
        raise ScenarioError("report", rule, " and ".join(kinds), "give one directory for each page")
    return entries


def _report_command(
    directories: Sequence[str | Path], replica: int | None, trust: bool, out: Path | None
) -> str:
    """Return the command that made the page."""
    command = ["netkf", "report", *map(str, directories)]
    command += ["--replica", str(replica)] if replica is not None else []
    command += ["--trust"] if trust else []
    command += ["--out", str(out)] if out is not None else []
    return shlex.join(command)


def _compare(entries: list[_Entry], directories: Sequence[str | Path]) -> Comparison | str | None:
    """Return the comparison of two entries, or why there is none."""
    if len(entries) < 2:
        return None
    ended = all(entry.source.status in FINAL_STATUSES and entry.source.summary for entry in entries)
    return compare(directories) if ended else "A run did not finish, so nothing is compared"


def _assemble(
    entries: list[_Entry], comparison: Comparison | str | None, command: str, budget: Budget
) -> str:
    """Return the page with at most as much data as the budget allows."""
    packer = Packer()
    moving = [entry for entry in entries if entry.moves]
    runs = [
        run_data(entry.source, entry.source.run, entry.messages, entry.readings, budget, packer)
        for entry in moving
        if entry.source.run is not None
    ]
    rules = [rule for data in runs for rule in thinning_rules(data)]
    packed, sizes = packer.text()
    data = {
        "runs": runs,
        "sizes": sizes,
        "ensembles": [tables.ensemble_curves(entry.source) for entry in entries],
        "summaries": [tables.averages(entry.source) for entry in entries],
        "difference": tables.difference_curves(*(entry.source for entry in entries))
        if len(entries) == 2
        else None,
        "labels": [entry.source.label for entry in entries],
        "sweep": tables.sweep_curves(entries[0].source),
    }
    body = _page_header(entries, comparison) + _main_sections(
        entries, comparison, command, rules, bool(runs)
    )
    title = " and ".join(dict.fromkeys(entry.source.scenario.name for entry in entries))
    script, style = _script(), _style()
    policy = POLICY.format(script=content_hash(script), style=content_hash(style))
    return _asset("page.html").format(
        policy=text(policy),
        title=text(title),
        version=text(__version__),
        style=style,
        body=body,
        data=script_json(data),
        packed=packed,
        script=script,
    )


def _page_header(entries: list[_Entry], comparison: Comparison | str | None) -> str:
    """Return the head of the page: names, claims and notes on the data."""
    parts = []
    for letter, (source, messages, worst, readings) in zip("AB", entries, strict=False):
        mark = f"{letter}: " if len(entries) > 1 else ""
        level = "h2" if len(entries) > 1 else "h1"
        title = f"{mark}{source.scenario.name}"
        status = "" if source.status == "complete" else f" ({source.status})"
        parts.append(f"<{level}>{text(title + status)}</{level}>")
        if source.scenario.claim:
            parts.append(paragraph(f"Claim of the scenario: {source.scenario.claim}", "claim"))
        lines = findings(source, messages, readings)
        if isinstance(worst, Explanation):
            why = (k for k, line in enumerate(lines, 1) if line.startswith("Why: "))
            index = next(why, len(lines))
            lines.insert(index, mending_claim(worst))
            central = central_sample(source)
            if central is not None:
                lines.insert(index + 1, price_claim(source, worst, central))
        parts.append(bullets((line + "." for line in lines), "findings"))
    heading = "<h1>Two runs on one clock</h1>" if len(entries) > 1 else ""
    if comparison is not None:
        sources = [entry.source for entry in entries]
        lines = difference_findings(comparison, sources[0], sources[1])
        heading += bullets((line + "." for line in lines), "findings")
    return f'<header class="top">{heading}{"".join(parts)}</header>'


def _main_sections(
    entries: list[_Entry],
    comparison: Comparison | str | None,
    command: str,
    rules: list[str],
    live: bool,
) -> str:
    """Return the sections of the page as HTML."""
    sources = [entry.source for entry in entries]
    parts = [_asset("live.html") if live else _still_section(sources)]
    mended = [mending_section(e.source, e.worst) for e in entries if e.worst is not None]
    if mended:
        parts.append(section("mending", "What would have mended the worst sample", "".join(mended)))
    if comparison is not None:
        parts.append(section("comparison", "What differs", _difference_section(comparison)))
    if any(source.kind not in ("filters", "verdict") for source in sources):
        parts.append(section("figures", "Figures", _figure_section(entries)))
    drawn = "".join(filters_figure(s.filters) for s in sources if s.filters is not None)
    if drawn:
        parts.append(section("figures", "Errors of the filters", drawn))
    parts.append(
        section("verdicts", "Verdicts and averages", "".join(map(_result_tables, sources)))
    )
    parts.append(section("scenario", "Scenario", "".join(map(_scenario_text, sources))))
    parts.append(
        section("origin", "Versions and command", _origin_section(sources, command, rules))
    )
    return "<main>" + "".join(parts) + "</main>"


def _figure_section(entries: list[_Entry]) -> str:
    """Return the place of the curves, and why there are none of innovations."""
    reasons = dict.fromkeys(entry.readings for entry in entries if isinstance(entry.readings, str))
    notes = [paragraph(f"No innovations are shown: {reason}.", "note") for reason in reasons]
    return '<div id="curves" class="curves"></div>' + "".join(notes)


def _difference_section(comparison: Comparison | str) -> str:
    """Return the section on differences as HTML."""
    if isinstance(comparison, str):
        return paragraph(comparison)
    return tables.comparison_section(comparison)


def _still_section(sources: list[Opened]) -> str:
    """Return the section that says why nothing is shown in motion."""
    kept_nothing = {"sweep": "sweep", "verdict": "verdict", "filters": "comparison of filters"}
    if sources[0].kind in kept_nothing:
        reason = (
            f"A {kept_nothing[sources[0].kind]} keeps no trace of single runs. To see one move: "
            "netkf run SCENARIO --trace full --out DIR, then netkf report DIR."
        )
    elif all(source.run is None for source in sources):
        reason = "No run was recorded here, so nothing moves: run again with --trace full."
    elif all(source.run is None or not len(source.run.times) for source in sources):
        reason = "The run has no sample, so there is nothing to show in motion."
    else:
        reason = f"Networks of more than {MAX_NODES:,} nodes are not shown in motion."
    return section("live", "The network in motion", paragraph(reason, "note"))


def _result_tables(source: Opened) -> str:
    """Return the tables of a source as HTML."""
    parts = []
    if source.verdict is not None:
        parts.append(tables.verdict_table(source))
    if source.kind == "sweep":
        parts.append(tables.sweep_table(source))
    elif source.filters is not None:
        parts.append(tables.filters_table(source.filters))
    elif source.kind != "verdict":
        parts.append(tables.summary_section(source))
        if source.verdict is None:
            parts.append(
                paragraph(
                    "No verdict stands here. netkf check SCENARIO --out VERDICT holds the promises "
                    "of the paper against many runs; netkf report DIR VERDICT shows both.",
                    "note",
                )
            )
    return "".join(parts)


def _scenario_text(source: Opened) -> str:
    """Return the scenario file of a source as HTML."""
    label = f"scenario.toml of {source.label}"
    return (
        f"<h3>{text(label)}</h3>"
        f'<pre tabindex="0" role="group" aria-label="{text(label)}">'
        f"{text(source.scenario_text)}</pre>"
    )


def _event_counts(run: StoredRun) -> str:
    """Return how many events of each kind a run has."""
    counts = [f"{run.count(kind):,} {kind}" for kind in KINDS if run.count(kind)]
    listed = f" ({', '.join(counts)})" if counts else ""
    return f"Events of replica {run.replica}: {len(run.log):,}{listed}"


def _origin_section(sources: list[Opened], command: str, rules: list[str]) -> str:
    """Return the section on how the page and its sources were made."""
    parts = [
        paragraph("This page was made by:"),
        f'<pre tabindex="0" role="group" aria-label="command">{text(command)}</pre>',
    ]
    for source in sources:
        runs = f" --runs {source.runs}" if source.kind in ("ensemble", "filters") else ""
        verbs = {"sweep": "sweep", "verdict": "check", "filters": "compare-filters"}
        verb = verbs.get(source.kind, "run")
        again = f"netkf {verb} {shlex.quote(source.label + '/scenario.toml')}{runs}"
        if verb == "sweep":
            again += "".join(
                f" --vary {shlex.quote(key + '=' + ','.join(map(str, values)))}"
                for key, values in source.manifest.get("vary", {}).items()
            )
        if source.filters is not None:
            again += f" --filters {shlex.quote(_filter_option(source.filters))}"
        parts.append(paragraph("The results can be computed again by:"))
        parts.append(f'<pre tabindex="0" role="group" aria-label="command">{text(again)}</pre>')
        parts.append(tables.versions_table(source))
        if source.run is not None:
            parts.append(paragraph(_event_counts(source.run)))
    if rules:
        parts.append(bullets(f"Left out: {rule}." for rule in rules))
    elif any(source.run is not None for source in sources):
        whole = "Nothing was left out: the page holds every sample and every message of these runs."
        parts.append(paragraph(whole))
    return "".join(parts)


def _filter_option(found: StoredComparison) -> str:
    """Return the filters of a comparison as an option; labels are a kind and its settings."""
    tables_of = []
    for row in found.rows:
        kind, *settings = row.filter.split(" ")
        table = ", ".join([f'kind="{kind}"', *settings])
        tables_of.append(f"{{{table}}}" if settings else kind)
    return ",".join(tables_of)


@cache
def _asset(name: str) -> str:
    """Return the text of a file of this package."""
    return (resources.files("netkf.report") / "assets" / name).read_text(encoding="utf-8")


@cache
def _script() -> str:
    """Return all scripts as one: uPlot, then the page's own modules in a scope of their own."""
    # The licence of uPlot asks for its text in every copy.
    licence = "/*! uPlot\n" + _asset("uPlot.LICENSE.txt").replace("*/", "") + "*/\n"
    own = "\n".join(_asset(name) for name in SCRIPTS)
    return (
        f'{licence}{_asset("uPlot.iife.min.js")}\n(function () {{\n"use strict";\n{own}\n}})();\n'
    )


@cache
def _style() -> str:
    """Return the style sheet."""
    return _asset("uPlot.min.css") + "\n" + _asset("page.css")
