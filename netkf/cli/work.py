"""``netkf work``: simulate a part of a plan."""

from __future__ import annotations

import argparse

from netkf.cli.options import FAILED, print_notes
from netkf.cli.planned import work_on_study
from netkf.cli.progress import ProgressLine


def _run(options: argparse.Namespace) -> int:
    from netkf.ensembles.parts import Part, part_of_array
    from netkf.ensembles.plans import open_plan, work_on_plan
    from netkf.ensembles.pools import PoolOptions

    plan = open_plan(options.directory, options.trust)
    part = Part(*options.part) if options.part else part_of_array(plan.tasks)
    workers = None if options.scheduler else options.workers or 1
    pool = PoolOptions(workers=workers, scheduler=options.scheduler)
    if plan.arguments:
        return work_on_study(plan, part, pool, options)
    with ProgressLine() as line:
        update = line.make_count_update("runs")
        done = work_on_plan(plan, part, options.seconds, pool, update)
    print_notes(plan.scenario.notes)
    which = f"part {part.index}/{part.count}" if part.count > 1 else "all"
    if not done.simulated and not done.left:
        print(f"nothing left to do in {plan.directory} ({which})")
        return 0
    first, last = done.replicas[0], done.replicas[-1]
    left = f"; {done.left:,} are left: run it again" if done.left else ""
    print(f"{which}, runs {first:,} to {last:,}: {done.simulated:,} simulated{left}")
    return FAILED if done.left else 0
