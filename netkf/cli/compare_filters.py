"""``netkf compare-filters``: several filters on one truth and one network."""

from __future__ import annotations

import argparse

from netkf.cli import pictures
from netkf.cli.options import (
    load_scenario,
    pool_settings,
    print_json,
    print_notes,
    print_table_notes,
    print_title,
)
from netkf.cli.progress import ProgressLine


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
            **pool_settings(options),
            progress=line.make_count_update("filters"),
        )
    print_table_notes(scenario)
    print_notes([f"{row.filter}: {row.status}" for row in comparison.rows if not row.ran])
    try:
        if options.out is not None:
            written = write_comparison(scenario, comparison, options.out)
            if not options.no_plot:
                pictures.draw_picture(pictures.FILTERS, scenario, comparison, written)
    finally:
        if options.json:
            print_json(comparison.document())
        else:
            print_title(scenario)
            print(f"\n{format_filters(comparison)}")
    if options.out is not None and not options.json:
        print(f"written to {options.out}")
    return 0
