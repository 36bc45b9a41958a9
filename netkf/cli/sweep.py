"""``netkf sweep``: simulate every point of a grid of parameters."""

from __future__ import annotations

import argparse
from functools import partial
from typing import TYPE_CHECKING

from netkf.cli import pictures
from netkf.cli.options import load_scenario, print_json, print_table_notes, print_title
from netkf.cli.progress import ProgressLine
from netkf.core.printable import count_phrase

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario
    from netkf.studies.sweep import CompletedSweep


def _run(options: argparse.Namespace) -> int:
    from netkf.ensembles.pools import PoolOptions
    from netkf.runs.directory_lock import lock_directory
    from netkf.studies.parameter_grid import parse_grid
    from netkf.studies.sweep import plan_sweep, sweep_to_directory

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


def _print_sweep(
    scenario: Scenario, completed: CompletedSweep, options: argparse.Namespace
) -> None:
    from netkf.studies.tables import format_sweep

    print_table_notes(scenario)
    if options.json:
        rows = completed.table.to_dict("records")
        print_json({"directory": str(completed.directory), "rows": rows})
        return
    runs = options.runs
    print_title(scenario)
    print(f"\n{format_sweep(completed.table, completed.keys)}\n")
    points = len(completed.table)
    line = f"{count_phrase(points, 'point')} of {count_phrase(runs, 'run')}"
    line += f" in {completed.seconds:.2f} s"
    line += "" if "seed" in completed.keys else ", all with the same random draws"
    print(line + ("; +- one standard error" if runs > 1 else ""))
