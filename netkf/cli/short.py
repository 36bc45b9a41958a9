"""Commands that print, or write, what one function returns."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

from netkf.cli.options import (
    FAILED,
    load_scenario,
    pool_settings,
    print_json,
    print_notes,
    print_table_notes,
)


def run_compare(options: argparse.Namespace) -> int:
    """``netkf compare``: print finished runs side by side."""
    from netkf.studies.compare import compare
    from netkf.studies.tables import format_comparison

    comparison = compare(options.directories, options.confidence)
    if options.json:
        print_json(comparison.document())
    else:
        print(format_comparison(comparison))
    return 0


def run_report(options: argparse.Namespace) -> int:
    """``netkf report``: one self-contained HTML page of finished runs."""
    from netkf.report.page import write_report

    path = write_report(options.directories, options.out, options.replica, options.trust)
    print(f"written to {path}")
    return 0


def run_new(options: argparse.Namespace) -> int:
    """``netkf new``: write a commented scenario and tests of it, as a first draft."""
    from netkf.runs.template import write_template

    scenario, tests = write_template(options.name, options.folder)
    print(f"written: {scenario} and {tests}")
    installation = "" if find_spec("pytest") else "pip install pytest; "
    run, test = shlex.join(["netkf", "run", str(scenario)]), shlex.join(["pytest", str(tests)])
    print(f"next: {run}; {installation}{test}")
    return 0


def run_schema(options: argparse.Namespace) -> int:
    """``netkf schema``: print the JSON Schema of scenario files, for editors."""
    if options.markdown:
        from netkf.scenario.schema import schema_page

        print(schema_page(), end="")
    else:
        from netkf.scenario.schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
    return 0


def run_theory(options: argparse.Namespace) -> int:
    """``netkf theory``: assumptions, bounds and limits of a scenario, without a simulation."""
    from netkf.runs.failures import explain_failures
    from netkf.theory.promises import compute_promises, promises_text

    scenario = load_scenario(options)
    with explain_failures(scenario):
        promises = compute_promises(scenario)
    print_notes(scenario.notes)
    if options.json:
        print_json(promises)
    else:
        print(promises_text(scenario, promises))
    return 0


def run_import(options: argparse.Namespace) -> int:
    """``netkf import``: write a log as a scenario with its tables."""
    from netkf.logs.importing import import_log

    files, notes = import_log(
        options.log, options.kind, options.out, like=options.like, unreported=options.unreported,
        hole=options.hole, trust=options.trust, columns=options.columns,
    )  # fmt: skip
    print(f"written: {files[0]} with {', '.join(path.name for path in files[1:])}")
    for note in notes:
        print(note if ": " in note[:14] else f"note: {note}")
    print(f"next: netkf run {shlex.quote(str(files[0]))}")
    return 0


def run_innovations(options: argparse.Namespace) -> int:
    """``netkf innovations``: test if a run fits its model, node by node, without a true state."""
    from netkf.runs.simulate import simulate
    from netkf.studies.innovation_tests import format_innovations, innovations

    scenario = load_scenario(options)
    run = simulate(scenario, replica=options.replica or 0, engine=options.engine)
    result = innovations(run, options.confidence)
    print_table_notes(scenario)
    broken = [str(row.node) for row in result.rows if row.verdict.startswith("BROKEN")]
    text = format_innovations(result, options.all)
    return _print_rows(options, result, text, "the model does not explain node", broken)


def run_consistency(options: argparse.Namespace) -> int:
    """``netkf consistency``: compare the NEES and NIS of a filter with their expected values."""
    from netkf.studies.consistency import consistency
    from netkf.studies.tables import format_consistency

    scenario = load_scenario(options)
    result = consistency(
        scenario, options.runs, confidence=options.confidence, **pool_settings(options)
    )
    print_table_notes(scenario)
    broken = [row.label for row in result.rows if row.verdict.startswith("BROKEN")]
    text = format_consistency(result, full=options.all)
    return _print_rows(options, result, text, "errors are inconsistent with P at node", broken)


def _print_rows(
    options: argparse.Namespace, result: Any, text: str, problem: str, broken: Iterable[str]
) -> int:
    """Print rows by node, as JSON or as ``text``, and the ``problem`` of ``broken`` nodes."""
    if options.json:
        print_json({**vars(result), "rows": [vars(row) for row in result.rows]})
    else:
        print(f"{result.scenario}\n\n{text}")
    if not result:
        print(f"netkf: {problem} {', '.join(broken)}", file=sys.stderr)
    return 0 if result else FAILED
