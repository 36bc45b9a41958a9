"""``netkf sweep``, ``size`` and ``compare-filters``: studies of many ensembles."""

from __future__ import annotations

import argparse
import sys
from functools import partial

from netkf.cli import pictures
from netkf.cli.options import (
    FAILED,
    load_scenario,
    pool_settings,
    print_json,
    print_notes,
    print_table_notes,
    print_title,
)
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError
from netkf.core.printable import count_phrase
from netkf.ensembles.pools import PoolOptions
from netkf.runs.files import lock_directory
from netkf.scenario.scenario import Scenario
from netkf.scenario.values import parse_values
from netkf.studies.compare_filters import compare_filters, write_comparison
from netkf.studies.parameter_grid import parse_grid, parse_interval
from netkf.studies.search import size
from netkf.studies.sweep import CompletedSweep, plan_sweep, sweep_to_directory
from netkf.studies.tables import format_answer, format_filters, format_sizing, format_sweep


def run_sweep(options: argparse.Namespace) -> int:
    """``netkf sweep``: simulate every point of a grid of parameters."""
    fixed = [setting.partition("=")[0].strip() for setting in options.set]
    fixed += ["seed"] if options.seed is not None else []
    grid, scenario = parse_grid(options.vary, fixed), load_scenario(options)
    draw = partial(pictures.draw_picture, pictures.SWEEP, scenario)
    completed: list[CompletedSweep] = []
    try:
        with lock_directory(options.out), ProgressLine() as line:
            sweep_to_directory(
                plan_sweep(scenario, grid, options.runs, engine=options.engine),
                options.out,
                PoolOptions(options.workers, options.executor, options.scheduler),
                progress=line.make_count_update("points"),
                finish=None if options.no_plot else draw,
                take=completed.append,  # called before files are written, which may fail
            )
    finally:
        # Without a completed sweep the list is empty.
        for completed_sweep in completed:
            _print_sweep(scenario, completed_sweep, options)
    if not options.json:
        print(f"written to {completed[0].directory}")
    return 0


def _print_sweep(scenario: Scenario, sweep: CompletedSweep, options: argparse.Namespace) -> None:
    print_table_notes(scenario)
    if options.json:
        rows = sweep.table.to_dict("records")
        print_json({"directory": str(sweep.directory), "rows": rows})
        return
    runs = options.runs
    print_title(scenario)
    print(f"\n{format_sweep(sweep.table, sweep.keys)}\n")
    line = f"{count_phrase(len(sweep.table), 'point')} of {count_phrase(runs, 'run')}"
    line += f" in {sweep.seconds:.2f} s"
    line += "" if "seed" in sweep.keys else ", all with the same random draws"
    print(line + ("; +- one standard error" if runs > 1 else ""))


def run_size(options: argparse.Namespace) -> int:
    """``netkf size``: find the smallest (or largest) value of a key that meets a target."""
    if len(options.vary) > 1:
        remedy = "size searches one key; sweep varies several"
        raise ScenarioError("--vary", "is given more than once", options.vary, remedy)
    key, low, high = parse_interval(options.vary[0])
    scenario = load_scenario(options)
    with ProgressLine() as line:
        sizing = size(
            scenario,
            key,
            low,
            high,
            options.target,
            options.by,
            options.runs,
            options.confidence,
            **pool_settings(options),
            progress=line.replace,
        )
    print_table_notes(scenario)
    if options.json:
        probes = [probe._asdict() for probe in sorted(sizing.probes)]
        target = sizing.target._asdict()
        print_json(
            {**vars(sizing), "target": target, "probes": probes, "answer": format_answer(sizing)}
        )
    else:
        print(format_sizing(sizing))
    # Each worker of a plan finds the same answer, which merge prints.
    if not sizing and not getattr(options, "works", False):
        print(f"netkf: {format_answer(sizing)}", file=sys.stderr)
    return 0 if sizing else FAILED


def run_compare_filters(options: argparse.Namespace) -> int:
    """``netkf compare-filters``: several filters on one truth and one network."""
    with lock_directory(options.out, must_be_empty=True):
        return _compare_filters(options)


def _compare_filters(options: argparse.Namespace) -> int:
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
