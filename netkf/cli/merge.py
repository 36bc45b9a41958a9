"""``netkf merge``: turn the results of all workers of a plan into one ensemble or study."""

from __future__ import annotations

import argparse
from functools import partial

from netkf.cli import pictures
from netkf.cli.options import FAILED, print_notes
from netkf.cli.planned import describe_ranges, merge_study
from netkf.cli.run import print_ensemble, print_summary


def _run(options: argparse.Namespace) -> int:
    """Merge what workers left; return the exit status, 1 if results are missing."""
    from netkf.ensembles.plans import merge_plan, open_plan
    from netkf.runs.directory_lock import lock_directory

    plan = open_plan(options.directory, options.trust)
    if plan.arguments:
        return merge_study(plan, options)
    if plan.is_merged:
        print(f"nothing left to do in {plan.directory}")
        return 0
    draw = None
    if not options.no_plot:
        draw = partial(pictures.draw_picture, pictures.ENSEMBLE, plan.scenario)
    with lock_directory(options.directory):
        merged = merge_plan(plan, options.mixed, finish=draw, note=lambda text: print_notes([text]))
    runs = plan.identity.runs
    if isinstance(merged, list):
        _print_missing(plan.directory, merged, runs)
        return FAILED
    print_summary(plan.scenario, merged)
    print_ensemble(merged, runs)
    return 0


def _print_missing(directory: object, missing: list[range], runs: int) -> None:
    """Print which of the runs have no result, and what to do."""
    count = sum(map(len, missing))
    print(f"{count:,} of {runs:,} runs have no result: {describe_ranges(missing)}")
    print(f"go on with netkf work {directory}")
