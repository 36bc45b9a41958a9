"""``netkf compare-filters``: several filters on one truth and one network."""

from __future__ import annotations

import argparse
from pathlib import Path

from netkf.cli import pictures
from netkf.cli.options import (
    Command,
    add_confidence,
    add_options,
    load_scenario,
    parse_count,
    print_json,
    print_table_notes,
    print_title,
)
from netkf.cli.progress import ProgressLine


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--filters",
        required=True,
        metavar="F1,F2,...",
        help='kinds of filters, or tables such as {kind="hcmci",steps=3}; the first is compared '
        "with each of the others",
    )
    parser.add_argument(
        "--runs", type=parse_count, default=100, help="runs of each filter (default: 100)"
    )
    add_confidence(parser, 0.95, "that all marks are right")
    parser.add_argument("--out", type=Path, help="directory for tables and a picture")
    add_options(parser, "no-plot", "seed", "engine", "pool", "json")


def _run(options: argparse.Namespace) -> int:
    from netkf.runs.directory_lock import lock_directory

    with lock_directory(options.out, must_be_empty=True):
        return _compare(options)


def _compare(options: argparse.Namespace) -> int:
    from netkf.scenario.values import parse_values
    from netkf.studies.compare_filters import compare_filters, write_comparison
    from netkf.studies.tables import format_filters

    filters = parse_values("--filters", "filters", options.filters)
    scenario = load_scenario(options)
    with ProgressLine() as line:
        comparison = compare_filters(
            scenario,
            filters,
            options.runs,
            confidence=options.confidence,
            engine=options.engine,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=line.make_count_update("filters"),
        )
    print_table_notes(scenario)
    try:
        if options.out is not None:
            written = write_comparison(scenario, comparison, options.out)
            if not options.no_plot:
                pictures.draw_picture(pictures.FILTERS, scenario, written)
    finally:
        if options.json:
            print_json(comparison.document())
        else:
            print_title(scenario)
            print(f"\n{format_filters(comparison)}")
    if options.out is not None and not options.json:
        print(f"written to {options.out}")
    return 0


COMMAND = Command(
    "compare-filters",
    "compare filters on one truth and one network, with intervals of their differences",
    _declare,
    _run,
)
