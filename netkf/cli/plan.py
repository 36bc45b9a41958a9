"""``netkf plan``: write the directory of an ensemble for workers, and the script of an array."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from netkf.cli.options import MARGIN, load_scenario, print_notes
from netkf.core.printable import count_phrase

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

ARRAY = """\
#!/bin/bash
#SBATCH --job-name={name}
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --time={hours:02d}:{minutes:02d}:00
#SBATCH --signal=TERM@60
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output={log}

# Each job takes the runs of its part that have no result yet. A job that is killed or requeued
# goes on where it was, and a part that is finished is left alone.
# Change {tasks} too for an array of all runs with another number of jobs.
srun {work} --part "$SLURM_ARRAY_TASK_ID/{tasks}"
status=$?
# 1: the time was up before the part was finished.
if [ $status -eq 1 ]; then scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"; fi
exit $status

# When all are done: {merge}
# It lists the jobs whose runs are missing; sbatch --array=3,7-9 submits those of a list again.
"""
TASKS = 64


def _run(options: argparse.Namespace) -> int:
    from netkf.ensembles.directory import EnsembleOptions
    from netkf.ensembles.plans import plan_ensemble
    from netkf.runs.directory_lock import lock_directory

    scenario = load_scenario(options)
    tasks = min(options.tasks or TASKS, options.runs)
    with lock_directory(options.out):
        settings = EnsembleOptions(options.engine, options.trace)
        directory = plan_ensemble(scenario, options.runs, options.out, settings, tasks)
    print_plan(directory, scenario, count_phrase(options.runs, "run"), tasks, options)
    return 0


def print_plan(
    directory: Path, scenario: Scenario, what: str, tasks: int, options: argparse.Namespace
) -> None:
    """Print what a plan holds and how to go on, and with ``--slurm`` the script of an array."""
    print_notes(scenario.notes)
    # With a script on standard output, what a person reads goes beside it.
    out = sys.stderr if options.slurm else sys.stdout
    print(f"{what} for {count_phrase(tasks, 'job')}, none of them simulated", file=out)
    quoted = shlex.quote(str(directory)) + (" --trust" if options.trust else "")
    print(f"each: netkf work {quoted}; in the end: netkf merge {quoted}", file=out)
    print(f"written to {directory}", file=out)
    if options.slurm:
        print(_array(directory.resolve(), scenario.name, tasks, options), end="")


def _array(directory: Path, name: str, tasks: int, options: argparse.Namespace) -> str:
    """Return the submission script of an array of ``tasks`` SLURM jobs on a plan."""
    trust = ["--trust"] if options.trust else []
    minutes = round((options.time or 3600) / 60)
    limit = f"{minutes - MARGIN}m"
    return ARRAY.format(
        name="".join(c if c.isalnum() or c in "-_." else "-" for c in f"netkf-{name}")[:100],
        last=tasks - 1,
        tasks=tasks,
        hours=minutes // 60,
        minutes=minutes % 60,
        log=shlex.quote(str(directory.parent / f"{directory.name}-%A_%a.log")),
        work=shlex.join(["netkf", "work", str(directory), "--for", limit, *trust]),
        merge=shlex.join(["netkf", "merge", str(directory), *trust]),
    )
