"""``netkf merge``: turn the results of all workers of a plan into one ensemble or study."""

from __future__ import annotations

import argparse
from functools import partial

from netkf.cli import pictures
from netkf.cli.options import FAILED, print_notes
from netkf.cli.planned import merge_study, print_missing
from netkf.cli.run import print_ensemble, print_summary


def _run(options: argparse.Namespace) -> int:
    from netkf.ensembles.plans import merge_plan, open_plan
    from netkf.ensembles.replicas import Gap
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
    with lock_directory(options.directory, option="DIR"):
        merged = merge_plan(plan, options.mixed, finish=draw, note=lambda text: print_notes([text]))
    runs = plan.identity.runs
    if isinstance(merged, list):
        print_missing(plan, [Gap(1, runs, merged)])
        return FAILED
    print_summary(plan.scenario, merged)
    print_ensemble(merged, runs)
    return 0
