"""``netkf report``: one self-contained HTML page of one or two directories."""

from __future__ import annotations

import ast
import errno
import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from mimetypes import MimeTypes
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.innovations import Innovations
from netkf.core.errors import ScenarioError, WriteError
from netkf.core.version import __version__
from netkf.figures.names import SERIES
from netkf.report import tables
from netkf.report.claims import describe_differences, describe_source
from netkf.report.data import Budget, positions, read_innovations, run_data, thinning_rules
from netkf.report.directories import ReportSource, read_source
from netkf.report.markup import Packer, bullets, content_hash, paragraph, script_json, section, text
from netkf.report.mending import describe_central, describe_mending, explain_worst, mending_section
from netkf.report.outcome_figure import filters_figure, outcome_figures
from netkf.runs.documents import FINAL_STATUSES, DamagedError
from netkf.runs.files import require_own, this_process, write_text
from netkf.scenario.writing import toml_text
from netkf.studies.compare import Comparison, compare, damage_named
from netkf.studies.explanation import Why
from netkf.trace.messages import MESSAGE, join_messages
from netkf.trace.schema import KINDS

MAX_BYTES = 4_800_000
"""Size of a page above which its data are thinned further."""
BUDGET = Budget(messages=100_000, values=400_000)
"""What a page holds of one run at first; half of it for each of two runs."""
MAX_NODES = 2_000
"""Nodes up to which a page has live views."""
SCRIPTS = (
    *("format", "decode", "state", "theme", "brush", "network", "estimates", "sequence", "why"),
    *("tracks", "curves", "figures", "clock", "main"),
)
POLICY = (
    "default-src 'none'; script-src {script}; style-src {style}; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)
"""Content security policy of a page, with the hashes of its script and its style sheet."""
MIN_BUDGET = 500
"""Messages below which the limits on data are not halved again."""
MARK = b'<meta name="generator" content="netkf '
"""Bytes among the first HEAD ones of every page, by which a page is told from other files."""
HEAD = 4096


class _AnalysedSource(NamedTuple):
    """The contents of a directory with its MESSAGE rows, worst sample, innovations and layout, and
    ``others``, the same with other runs of an ensemble, which a reader may choose.
    """

    source: ReportSource
    messages: np.ndarray
    worst: Why | str | None = None
    readings: Innovations | str | None = None
    layout: list[list[float]] | None = None
    others: tuple[_AnalysedSource, ...] = ()

    @property
    def is_live(self) -> bool:
        """True if the run can be shown in the live views, in which the page animates it."""
        run = self.source.run
        return run is not None and len(run.times) > 0 and len(run.nodes) <= MAX_NODES


def write_report(
    directories: Sequence[str | Path],
    out: Path | None = None,
    replica: int | str | None = None,
    trust: bool = False,
) -> Path:
    """Write the page of one or two directories, by default to ``report.html`` in the first; return
    its path. ``replica`` and ``trust`` as in ``read_source``. Raises ScenarioError for other
    directories, or if ``out`` is a file other than a page, and WriteError.
    """
    path = Path(directories[0]) / "report.html" if out is None else out
    if out is not None or path.parent.is_dir():
        _require_page(path)
    write_text(path, make_page(directories, replica, (trust, trust), path), this_process())
    return path


def _require_page(path: Path) -> None:
    """Raise ScenarioError if ``path`` is or would be a file but no page; WriteError if no file."""
    require_own(path)
    if MimeTypes().guess_type(path.name)[0] not in (None, "text/html"):
        rule = "is no name of a page, which is HTML"
        raise ScenarioError("--out", rule, str(path), f"name a file {path.stem}.html")
    if path.is_dir():
        raise WriteError(OSError(errno.EISDIR, ""), path)
    if not path.is_file():
        if not path.parent.is_dir():  # before what takes time
            raise WriteError(OSError(errno.ENOENT, ""), path)
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
    replica: int | str | None = None,
    trust: Sequence[bool] = (False, False),
    out: Path | None = None,
) -> str:
    """Return the page of one or two directories, of which each has its ``trust``, as HTML, see
    ``write_report``; ``out`` is only named in the command on the page. Raises ScenarioError.
    """
    if not 1 <= len(directories) <= 2:
        raise ScenarioError("report", "takes one or two directories", len(directories))
    # One of two directories may be trusted alone.
    entries = [
        _analyse_directory(Path(directory), replica, trusted)
        for directory, trusted in zip(directories, trust, strict=False)
    ]
    entries = _merge_verdict(entries)
    command = ["netkf", "report", *map(str, directories)]
    command += ["--replica", str(replica)] if replica is not None else []
    command += ["--trust"] if any(trust) else []
    command += ["--out", str(out)] if out is not None else []
    comparison: Comparison | str | None = None
    if len(entries) > 1:
        sources = [entry.source for entry in entries]
        have_ended = all(s.status in FINAL_STATUSES and s.summary for s in sources)
        reason = "A run did not finish, so nothing is compared"
        comparison = compare(directories) if have_ended else reason
    # Data of the runs are thinned until the page is small enough.
    count = sum(1 + len(entry.others) for entry in entries)
    data_limits = Budget(BUDGET.messages // count, BUDGET.values // count)
    while True:
        page = _assemble_page(entries, comparison, shlex.join(command), data_limits)
        size = len(page.encode("utf-8"))
        if size <= MAX_BYTES or data_limits.messages < MIN_BUDGET:
            return page
        # In proportion, so that a large page takes few attempts; a part of it never shrinks.
        data_limits = data_limits.scaled(min(0.5, 0.9 * MAX_BYTES / size))


def _analyse_directory(directory: Path, replica: int | str | None, trust: bool) -> _AnalysedSource:
    """Read a directory and compute what takes long once; raises ScenarioError."""
    source = read_source(directory, replica, trust)
    with damage_named(directory):
        entry = _analyse_run(source)._replace(worst=explain_worst(source))
        others = map(_analyse_run, source.other_runs()) if entry.is_live else ()
        return entry._replace(others=tuple(others))


def _analyse_run(source: ReportSource) -> _AnalysedSource:
    """Return a source with what its run needs for the live views; raises DamagedError."""
    if source.run is None:
        return _AnalysedSource(source, np.empty(0, dtype=MESSAGE))
    try:
        messages = join_messages(source.run.log)
    except ValueError as error:
        raise DamagedError(f"events.parquet: {error}") from None
    entry = _AnalysedSource(source, messages, readings=read_innovations(source))
    return entry._replace(layout=positions(source, source.run)) if entry.is_live else entry


def _merge_verdict(entries: list[_AnalysedSource]) -> list[_AnalysedSource]:
    """Return the entries; a run and its verdict become one; raises ScenarioError for others."""
    kinds = [entry.source.kind for entry in entries]
    if len(entries) == 2 and kinds[1] == "verdict" and kinds[0] in ("run", "ensemble"):
        first, verdict = entries
        return [first._replace(source=replace(first.source, verdict=verdict.source.verdict))]
    if len(entries) == 2 and not {*kinds} <= {"run", "ensemble"}:
        rule = "compares runs and ensembles, and takes a verdict only after its run"
        raise ScenarioError("report", rule, " and ".join(kinds), "give one directory for each page")
    return entries


def _assemble_page(
    entries: list[_AnalysedSource],
    comparison: Comparison | str | None,
    command: str,
    data_limits: Budget,
) -> str:
    packer = Packer()  # collects columns of numbers as one compressed text
    choices = [
        [_live_data(one, data_limits, packer) for one in (entry, *entry.others)]
        for entry in entries
        if entry.layout is not None
    ]
    runs = [first for first, *_ in choices]
    rules = [
        f"{run['words']}{': ' if run['words'] else ''}{rule}"
        for data in choices
        for run in data
        for rule in thinning_rules(run)
    ]
    rules = list(dict.fromkeys(rules))
    packed, sizes = packer.text()
    sources = [entry.source for entry in entries]
    data = {
        "runs": runs,
        "replicas": [others for _, *others in choices],
        "sizes": sizes,
        "ensembles": [tables.ensemble_curves(source) for source in sources],
        "summaries": [tables.averages(source) for source in sources],
        "difference": tables.difference_curves(*sources) if len(sources) == 2 else None,
        "labels": [source.label for source in sources],
        "sweep": tables.sweep_curves(sources[0]),
        "filters": tables.filter_curves(sources[0]),
        "series": [f"series-{k}" for k in range(len(SERIES))],
        "states": "; ".join(dict.fromkeys(s.scenario.states_note for s in sources)).strip("; "),
        "unit": " or ".join(dict.fromkeys(source.scenario.unit for source in sources)),
    }
    body = _page_header(entries, comparison) + _main_sections(
        entries, comparison, command, rules, bool(runs)
    )
    title = " and ".join(dict.fromkeys(source.scenario.name for source in sources))
    script = _script()
    style = f"{_asset('uPlot.min.css')}\n{_asset('page.css')}{_series_css()}"
    policy = POLICY.format(script=content_hash(script), style=content_hash(style))
    escaped = {"policy": text(policy), "title": text(title), "version": text(__version__)}
    parts = {"style": style, "body": body, "packed": packed, "script": script}
    return _asset("page.html").format(**escaped, **parts, data=script_json(data))


def _live_data(entry: _AnalysedSource, limits: Budget, packer: Packer) -> dict[str, Any]:
    assert entry.source.run is not None
    assert entry.layout is not None
    run, layout = entry.source.run, entry.layout
    return run_data(entry.source, run, entry.messages, entry.readings, layout, limits, packer)


def _page_header(entries: list[_AnalysedSource], comparison: Comparison | str | None) -> str:
    sources = [entry.source for entry in entries]
    names = list(dict.fromkeys(source.scenario.name for source in sources))
    title, parts = names[0], []
    if len(entries) > 1:
        title = f"{' and '.join(names)}: A against B"
    if comparison is not None:
        sentences = describe_differences(comparison, *sources)
        parts.append(bullets((line + "." for line in sentences), "findings"))
        if isinstance(comparison, Comparison):
            parts.append(tables.differences_table(comparison))
    claims = list(dict.fromkeys(s.scenario.claim for s in sources if s.scenario.claim))
    parts += [paragraph(f"Claim of the scenario: {claim}", "claim") for claim in claims]
    columns = []
    for k, entry in enumerate(entries):
        status = "" if entry.source.status == "complete" else f" ({entry.source.status})"
        findings = bullets((line + "." for line in _source_sentences(entry)), "findings")
        if len(entries) > 1:
            heading = text(f"{'AB'[k]}: {entry.source.label}{status}")
            findings = f'<div><h2 class="series-{k}">{heading}</h2>{findings}</div>'
        else:
            title += status
        columns.append(findings)
    joined = "".join(columns)
    parts.append(f'<div class="views">{joined}</div>' if len(entries) > 1 else joined)
    return f'<header class="top"><h1>{text(title)}</h1>{"".join(parts)}</header>'


def _source_sentences(entry: _AnalysedSource) -> list[str]:
    """Return the sentences about a directory: its data, and after "Why" the replays."""
    sentences = describe_source(entry.source, entry.messages, entry.readings)
    if isinstance(entry.worst, Why):
        after_why = (k for k, line in enumerate(sentences, 1) if line.startswith("Why: "))
        index = next(after_why, len(sentences))
        sentences.insert(index, describe_mending(entry.worst))
        central = describe_central(entry.source, entry.worst)
        if central is not None:
            sentences.insert(index + 1, central)
    return sentences


def _main_sections(
    entries: list[_AnalysedSource],
    comparison: Comparison | str | None,
    command: str,
    rules: list[str],
    live: bool,
) -> str:
    sources = [entry.source for entry in entries]
    parts = [_asset("live.html") if live else _explain_no_live_views(sources)]
    # What would have reduced the worst error of each run.
    explanations = [mending_section(e.source, e.worst) for e in entries if e.worst is not None]
    if explanations:
        title = "What would have mended the worst sample"
        parts.append(section("mending", title, "".join(explanations)))
    if comparison is not None:
        differences = (
            paragraph(comparison)
            if isinstance(comparison, str)
            else tables.comparison_section(comparison)
        )
        parts.append(section("comparison", "What differs", differences))
    if any(source.kind not in ("filters", "verdict") for source in sources):
        reasons = dict.fromkeys(e.readings for e in entries if isinstance(e.readings, str))
        notes = [paragraph(f"No innovations are shown: {reason}.", "note") for reason in reasons]
        # The script draws the curves in this element.
        area = '<div id="curves" class="curves"></div>' + "".join(notes)
        parts.append(section("figures", "Figures", area))
    figures = "".join(filters_figure(s.filters) for s in sources if s.filters is not None)
    figures += '<div id="curves" class="curves"></div>' if figures else ""
    if figures:
        parts.append(section("figures", "Errors of the filters", figures))
    losses = [outcome_figures(source.run, source.shown) for source in sources]
    if any(losses):
        columns = "".join(f"<div>{one}</div>" for one in losses)
        beside = ' class="views"' if len(losses) > 1 else ""
        parts.append(section("losses", "Losses", f"<div{beside}>{columns}</div>"))
    results = "".join(_result_tables(source) for source in sources)
    parts.append(section("verdicts", "Verdicts and averages", results))
    scenarios = ""
    for source in sources:
        label = text(f"scenario.toml of {source.label}")
        box = f'<pre tabindex="0" role="group" aria-label="{label}">'
        scenarios += f"<h3>{label}</h3>{box}{text(source.scenario_text)}</pre>"
    parts.append(section("scenario", "Scenario", scenarios))
    origin = _describe_origin(sources, command, rules)
    parts.append(section("origin", "Versions and command", origin))
    return "<main>" + "".join(parts) + "</main>"


def _explain_no_live_views(sources: list[ReportSource]) -> str:
    untraced_kinds = {"sweep": "sweep", "verdict": "verdict", "filters": "comparison of filters"}
    if sources[0].kind in untraced_kinds:
        reason = (
            f"A {untraced_kinds[sources[0].kind]} keeps no trace of single runs. To see one move: "
            "netkf run SCENARIO --trace full --out DIR, then netkf report DIR."
        )
    elif all(source.run is None for source in sources):
        reason = "No run was recorded, so there is nothing to animate: run again with --trace full."
    elif all(source.run is None or not len(source.run.times) for source in sources):
        reason = "The run has no sample, so there is nothing to animate."
    else:
        reason = f"Networks of more than {MAX_NODES:,} nodes are not animated."
    return section("live", "The network in motion", paragraph(reason, "note"))


def _result_tables(source: ReportSource) -> str:
    """Return the tables of a source as HTML: verdict, and sweep, filters or averages."""
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
            advice = (
                "There is no verdict yet. netkf check SCENARIO --out VERDICT tests the promises "
            )
            advice += "of the paper on many runs; netkf report DIR VERDICT shows both."
            parts.append(paragraph(advice, "note"))
    return "".join(parts)


def _describe_origin(sources: list[ReportSource], command: str, rules: list[str]) -> str:
    parts = [paragraph("This page was made by:"), _command_box(command)]
    for source in sources:
        parts.append(paragraph("The results can be computed again by:"))
        parts.append(_command_box(_source_command(source)))
        parts.append(tables.versions_table(source))
        if source.run is not None:
            run = source.run
            counts = [f"{run.count(kind):,} {kind}" for kind in KINDS if run.count(kind)]
            by_kind = f" ({', '.join(counts)})" if counts else ""
            parts.append(paragraph(f"Events of replica {run.replica}: {len(run.log):,}{by_kind}"))
    if rules:
        parts.append(bullets(f"Left out: {rule}." for rule in rules))
    elif any(source.run is not None for source in sources):
        note = "Nothing was left out: the page holds every sample and every message of these runs."
        parts.append(paragraph(note))
    return "".join(parts)


def _command_box(command: str) -> str:
    return f'<pre tabindex="0" role="group" aria-label="command">{text(command)}</pre>'


def _source_command(source: ReportSource) -> str:
    subcommands = {"sweep": "sweep", "verdict": "check", "filters": "compare-filters"}
    subcommand = subcommands.get(source.kind, "run")
    command = f"netkf {subcommand} {shlex.quote(source.label + '/scenario.toml')}"
    if source.kind == "run" and source.manifest.get("replica"):
        command += f" --replica {source.manifest['replica']}"
    if source.kind in ("ensemble", "filters"):
        command += f" --runs {source.manifest['runs']['wanted']}"
    if source.kind == "sweep":
        varied = source.manifest.get("vary", {})
        points = math.prod(len(values) for values in varied.values())
        command += f" --runs {source.manifest['runs']['wanted'] // max(1, points)}"
        for key, values in varied.items():
            command += f" --vary {shlex.quote(key + '=' + ','.join(map(toml_text, values)))}"
    if source.kind == "verdict" and source.verdict is not None:
        verdict = source.verdict
        command += f" --runs {verdict['runs']} --confidence {verdict['confidence']:g}"
    if source.filters is not None:
        options = map(_filter_option, (row.filter for row in source.filters.rows))
        command += f" --filters {shlex.quote(','.join(options))}"
    return command


def _filter_option(label: str) -> str:
    """Return what ``--filters`` takes for the label of a filter: its kind, then key=value."""
    kind, *settings = re.split(r" (?=\w+=)", label)
    table: dict[str, Any] = {"kind": kind}
    for key, _, value in (setting.partition("=") for setting in settings):
        try:
            table[key] = ast.literal_eval(value)
        except (SyntaxError, ValueError):  # a text, which has no quotes
            table[key] = value
    return toml_text(table) if settings else kind


@cache
def _asset(name: str) -> str:
    return (resources.files("netkf.report") / "assets" / name).read_text(encoding="utf-8")


def _series_css() -> str:
    numbers = range(len(SERIES))
    light, dark = (
        ";".join(f"--series-{k}: {getattr(SERIES[k], of)}" for k in numbers)
        for of in ("colour", "dark")
    )
    css = f":root {{ {light} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
    rule = ".series-{0} {{ stroke: var(--series-{0}); border-color: var(--series-{0}); }}\n"
    return css + "".join(map(rule.format, numbers))


@cache
def _script() -> str:
    """Return uPlot and the page's own files in the scope of one function."""
    # The licence of uPlot requires its text in every copy.
    licence = "/*! uPlot\n" + _asset("uPlot.LICENSE.txt").replace("*/", "") + "*/\n"
    scripts = "\n".join(_asset(f"{name}.js") for name in SCRIPTS)
    plots = _asset("language.js") + _asset("uPlot.iife.min.js")
    return f'{licence}{plots}\n(function () {{\n"use strict";\n{scripts}\n}})();\n'
