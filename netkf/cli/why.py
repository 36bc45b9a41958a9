"""``netkf why``: explain the estimate of a node of a finished run at a sample time."""

from __future__ import annotations

import argparse
from pathlib import Path

from netkf.cli.options import print_json, print_notes
from netkf.core.errors import ScenarioError
from netkf.core.printable import shorten
from netkf.runs.files import lock_directory, write_json, write_text
from netkf.studies.why import why
from netkf.trace.run import Run


def _run(options: argparse.Namespace) -> int:
    if (options.node is None) != (options.at is None):
        remedy = "give both, or neither for the worst sample"
        raise ScenarioError("why", "takes --node and --at together", None, remedy)
    with lock_directory(options.out, must_be_empty=True):
        return _explain(options)


def _explain(options: argparse.Namespace) -> int:
    run: Run | Path = options.directory
    node, at, notes = options.node, options.at, []
    if node is None:
        run, node, at, note = _find_worst_sample(options)
        notes.append(note)
    explanation = why(
        run, node, at, replica=options.replica, below=options.below, most=options.most,
        replays=options.replays, trust=options.trust,
    )  # fmt: skip
    # Not before: a refusal is one line.
    print_notes(notes)
    try:
        if options.out is not None:
            write_text(options.out / "why.txt", f"{explanation}\n")
            write_json(options.out / "why.json", explanation.to_dict())
            write_text(options.out / "why.csv", explanation.table.to_csv(index=False))
    finally:
        if options.json:
            print_json(explanation.to_dict())
        else:
            print(explanation)
    return 0


def _find_worst_sample(options: argparse.Namespace) -> tuple[Run, int, float, str]:
    """Return run, node and time (s) of the worst sample after the start-up, and a note on it."""
    from netkf.report.directories import read_source  # for which a named sample need not wait

    source = read_source(options.directory, options.replica, options.trust)
    samples = source.worst
    if samples is None or source.run is None:
        rule = "has no samples of a run, of which the worst could be explained"
        remedy = "name a run, or an ensemble with --trace full"
        raise ScenarioError(shorten(options.directory), rule, None, remedy)
    worst = samples.explained
    quantity = "error" if worst.by_error else "trace of P"
    note = (
        f"node {worst.node} at {worst.time:.10g} s: the largest {quantity} of the worst node after "
        "the start-up; --node and --at choose another sample"
    )
    return source.run, worst.node, worst.time, note
