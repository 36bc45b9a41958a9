"""``netkf plan``, ``work`` and ``merge``, and ``--plan`` of the commands of studies.

All of them run a study itself, on a pool whose results are files: ``ensembles.planned_study``.
"""

from __future__ import annotations

import argparse
import contextlib
import filecmp
import io
import shlex
import sys
import time
from bisect import bisect_right
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from netkf.cli import pictures
from netkf.cli.options import FAILED, MARGIN, load_scenario, print_notes
from netkf.cli.progress import ProgressLine
from netkf.cli.run import print_ensemble, print_summary
from netkf.core.errors import ScenarioError
from netkf.core.printable import count_phrase
from netkf.ensembles.directory import EnsembleOptions
from netkf.ensembles.parts import Part, Worker, part_of_array
from netkf.ensembles.planned_study import PlannedStudy
from netkf.ensembles.plans import (
    Plan,
    merge_plan,
    open_plan,
    plan_ensemble,
    require_equal_installations,
    work_on_plan,
    write_study,
)
from netkf.ensembles.pools import PoolOptions, make_pool
from netkf.ensembles.replicas import Gap, MissingRunsError, missing_ranges
from netkf.runs.documents import FINAL_STATUSES, DamagedError, read_document
from netkf.runs.failures import InterruptedRunError
from netkf.runs.files import copy_file, lock_directory
from netkf.scenario.scenario import Scenario
from netkf.scenario.writing import resolve_defaults, to_toml

Run = Callable[[argparse.Namespace], int]
SHOWN = 20  # ranges of missing runs that are listed
WAIT_SECONDS = 2.0
"""Pause between two looks for the results of other jobs in a round."""
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


def run_plan(options: argparse.Namespace) -> int:
    """``netkf plan``: write the directory of an ensemble for workers, and a script of an array."""
    with ProgressLine():
        scenario = load_scenario(options)
        tasks = min(options.tasks or TASKS, options.runs)
        with lock_directory(options.out):
            settings = EnsembleOptions(options.engine, options.trace or "first")
            directory = plan_ensemble(scenario, options.runs, options.out, settings, tasks)
        _print_plan(directory, scenario, count_phrase(options.runs, "run"), tasks, options)
    return 0


def _print_plan(
    directory: Path, scenario: Scenario, what: str, tasks: int, options: argparse.Namespace
) -> None:
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
    return ARRAY.format(
        name="".join(c if c.isalnum() or c in "-_." else "-" for c in f"netkf-{name}")[:100],
        last=tasks - 1,
        tasks=tasks,
        hours=minutes // 60,
        minutes=minutes % 60,
        log=shlex.quote(str(directory.parent / f"{directory.name}-%A_%a.log")),
        work=shlex.join(["netkf", "work", str(directory), "--for", f"{minutes - MARGIN}m", *trust]),
        merge=shlex.join(["netkf", "merge", str(directory), *trust]),
    )


def run_work(options: argparse.Namespace) -> int:
    """``netkf work``: simulate a part of a plan."""
    plan = open_plan(options.directory, options.trust)
    part = Part(*options.part) if options.part else part_of_array(plan.tasks)
    workers = None if options.scheduler else options.workers or 1
    pool = PoolOptions(workers=workers, scheduler=options.scheduler)
    if plan.arguments:
        return work_on_study(plan, part, pool, options)
    with ProgressLine() as line:
        done = work_on_plan(plan, part, options.seconds, pool, line.make_count_update("runs"))
    print_notes(plan.scenario.notes)
    which = f"part {part.index}/{part.count}" if part.count > 1 else "all"
    if not done.simulated and not done.left:
        print(f"nothing left to do in {plan.directory} ({which})")
        return 0
    first, last = done.replicas[0], done.replicas[-1]
    left = f"; {done.left:,} are left: run it again" if done.left else ""
    print(f"{which}, runs {first:,} to {last:,}: {done.simulated:,} simulated{left}")
    return FAILED if done.left else 0


def run_merge(options: argparse.Namespace) -> int:
    """``netkf merge``: turn the results of all workers of a plan into one ensemble or study."""
    with ProgressLine():
        plan = open_plan(options.directory, options.trust)
        return (merge_study if plan.arguments else _merge_ensemble)(plan, options)


def _merge_ensemble(plan: Plan, options: argparse.Namespace) -> int:
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
        _print_missing(plan, [Gap(1, runs, merged)])
        return FAILED
    print_summary(plan.scenario, merged)
    print_ensemble(merged, runs)
    return 0


def plan_study(run: Run, options: argparse.Namespace) -> int:
    """Write the plan of the study that ``run`` does with these options; return the exit status."""
    for name in ("workers", "scheduler", "resume"):
        if getattr(options, name, None):
            remedy = "leave it out; netkf work has --workers"
            rule = "does not go with --plan, which runs nothing"
            raise ScenarioError(f"--{name}", rule, getattr(options, name), remedy)
    out = getattr(options, "out", None)
    if out is not None and options.plan.resolve().is_relative_to(out.resolve()):
        rule, remedy = "must lie outside of the directory of the results", "choose another"
        raise ScenarioError("--plan", rule, str(options.plan), remedy)
    with lock_directory(out, must_be_empty=True):
        pass  # that of the results
    with lock_directory(options.plan, must_be_empty=True, option="--plan"):
        gaps = _missing_runs(run, options, PlannedStudy(options.plan, Worker(None), returns=False))
        runs = [gap.runs for gap in gaps]
        tasks = min(options.tasks or TASKS, max(runs, default=1))
        write_study(options.plan, options.loaded, options.arguments, sum(runs), tasks)
    what = count_phrase(sum(runs), "run")
    if len(runs) > 1:
        what += f" of {len(runs):,} ensembles"
    if has_rounds(options):
        what += " in the first round"
    _print_plan(options.plan, options.loaded, what, tasks, options)
    return 0


def has_rounds(options: argparse.Namespace) -> bool:
    """Return True if results of the study's runs decide which runs are next."""
    return hasattr(options, "target") or bool(getattr(options, "until", None))


def work_on_study(plan: Plan, part: Part, pool: PoolOptions, options: argparse.Namespace) -> int:
    """Simulate a part of the runs of each ensemble; return the exit status, 1 if some are left.
    With rounds other jobs are waited for as long as ``--for`` allows.
    """
    study_options = _study_options(plan, options)
    rounds, study_options.works = has_rounds(study_options), True
    with ProgressLine() as line:
        worker = Worker(part, options.seconds, line.make_count_update("runs"))
        while True:
            study = PlannedStudy(plan.directory, worker, returns=rounds)
            try:
                gaps = _missing_runs(study_options.run, study_options, study, pool)
            except KeyboardInterrupt:
                remedy = f"; go on with {plan.work_command}"
                raise InterruptedRunError(plan.directory, remedy) from None
            waits = bool(rounds and gaps and not worker.left and options.seconds is not None)
            if not waits or time.monotonic() + WAIT_SECONDS > worker.deadline:
                break
            time.sleep(WAIT_SECONDS)
    which = f"part {part.index}/{part.count}" if part.count > 1 else "all"
    if worker.left:
        rest = f"; {worker.left:,} are left: run it again"
    elif rounds and gaps:
        rest = "; the next round needs the runs of other parts: run it again then"
    else:
        rest = "; nothing is left to do" + (" in this part" if part.count > 1 else "")
    print(f"{which} of {plan.directory}: {count_phrase(worker.simulated, 'run')} simulated{rest}")
    return FAILED if worker.left or (rounds and gaps) else 0


def merge_study(plan: Plan, options: argparse.Namespace) -> int:
    """Finish the study as its command would; return its exit status, 1 if runs are missing."""
    study_options = _study_options(plan, options)
    rounds = has_rounds(study_options)
    study = PlannedStudy(plan.directory, Worker(None), returns=rounds)
    gaps = _missing_runs(study_options.run, study_options, study)
    print_notes(study.worker.notes)
    if any(gap.missing for gap in gaps):
        _print_missing(plan, gaps, rounds)
        return FAILED
    if len(require_equal_installations(study.installations, plan.directory, options.mixed)) > 1:
        print_notes(["results are of machines of different kinds: last digits may be others"])
    status = _merge_again(study_options, plan)
    if status is not None:
        return status
    study = PlannedStudy(plan.directory, Worker(None))
    return _run_on(study_options.run, study_options, study)


def _merge_again(options: argparse.Namespace, plan: Plan) -> int | None:
    """Add what results of an earlier merge lack; return the exit status, None if there are none."""
    numbered = Path("runs").glob("*-sweep-*") if plan.arguments[0] == "sweep" else ()
    out, same = getattr(options, "out", None), to_toml(resolve_defaults(plan.scenario)).encode()
    files = [folder / "scenario.toml" for folder in ([out] if out else sorted(numbered))]
    folders = [file.parent for file in files if file.is_file() and file.read_bytes() == same]
    if not folders:
        return None
    text, notes = io.StringIO(), io.StringIO()
    with TemporaryDirectory() as temporary:
        new = Path(temporary) / "out"
        anew = argparse.Namespace(**{**vars(options), "out": new})
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(notes):
            status = _run_on(anew.run, anew, PlannedStudy(plan.directory, Worker(None)))
        found = [(folder, _left_out(folder, new)) for folder in folders]
        folder, missing = next((pair for pair in found if pair[1] is not None), (new, None))
        if missing is None:
            return None
        with lock_directory(folder):
            for name in missing:
                copy_file(new / name, folder / name)
    print(notes.getvalue(), end="", file=sys.stderr)
    done = f"nothing left to do in {folder}" if not missing else f"written to {folder}"
    print(text.getvalue().replace(f"written to {new}", done).replace(str(new), str(folder)), end="")
    return status


def _left_out(folder: Path, new: Path) -> list[str] | None:
    """Return the files that a ``folder`` of the results ``new`` lacks; None if it has others."""
    names = [str(file.relative_to(new)) for file in new.rglob("*") if file.is_file()]
    same, other, missing = filecmp.cmpfiles(new, folder, names, shallow=False)
    with contextlib.suppress(DamagedError):
        if other == ["manifest.json"]:
            unfinished = read_document(folder / other[0]).get("status") not in FINAL_STATUSES
            other, missing = ([], missing + other) if unfinished else (other, missing)
    missing.sort(key=lambda name: name in ("manifest.json", "verdict.json"))  # last: complete
    return missing if "scenario.toml" in same and not other else None


def _study_options(plan: Plan, given: argparse.Namespace) -> argparse.Namespace:
    """Return the options of the command that wrote a plan, for its copy of the scenario."""
    options: argparse.Namespace = given.parse(plan.arguments)
    if getattr(options, "plan", None) is None:
        rule = "holds a plan of no study"
        raise ScenarioError("DIR", rule, str(plan.directory), "write the plan again")
    options.copy, options.trust = plan.directory / "scenario.toml", given.trust
    options.plan = options.tasks = options.slurm = options.time = None
    if getattr(given, "no_plot", False) and hasattr(options, "no_plot"):
        options.no_plot = True
    return options


def _missing_runs(
    run: Run, options: argparse.Namespace, study: PlannedStudy, pool: PoolOptions | None = None
) -> list[Gap]:
    """Run a study silently; return the ensembles with missing runs, none if it came to its end."""
    out = getattr(options, "out", None)
    with TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        if hasattr(options, "out"):
            options.out = Path(folder) / "out"
        # The notes of the study are printed once, by merge; a worker shows its progress.
        notes = io.StringIO() if study.worker.part is None else sys.stderr
        try:
            with contextlib.redirect_stderr(notes):
                _run_on(run, options, study, pool)
        except MissingRunsError as error:
            return error.gaps
        finally:
            options.out = out
    return []


def _run_on(
    run: Run, options: argparse.Namespace, study: PlannedStudy, given: PoolOptions | None = None
) -> int:
    given = given or PoolOptions(1)
    with make_pool(given.workers or 1, given) as pool:
        pool.plan = study
        options.executor, options.workers, options.scheduler = pool, None, None
        return run(options)


def _print_missing(plan: Plan, gaps: list[Gap], rounds: bool = False) -> None:
    short = [gap for gap in gaps if gap.missing]
    missing = sum(len(runs) for gap in short for runs in gap.missing)
    total = sum(gap.runs for gap in gaps)
    where = []
    for gap in short[:SHOWN]:
        ranges = ", ".join(map(_describe_range, gap.missing[:SHOWN]))
        further = len(gap.missing) - SHOWN
        ranges += f" and {further} further ranges" if further > 0 else ""
        where.append((f"ensemble {gap.number}: " if len(gaps) > 1 else "") + ranges)
    more = f"; and {len(short) - SHOWN} further ensembles" if len(short) > SHOWN else ""
    of = count_phrase(total, "run") + (f" of round {short[0].number}" if rounds else "")
    print(f"{missing:,} of {of} have no result: {'; '.join(where)}{more}")
    again = ""
    if plan.tasks > 1:
        done = [(part, 1) for part in set(range(plan.tasks)) - _missing_parts(short, plan.tasks)]
        array = ",".join(map(_describe_range, missing_ranges(done, range(plan.tasks))))
        again = f", or submit these of its {plan.tasks:,} jobs again: --array={array}"
    print(f"go on with {plan.work_command}{again}")


def _missing_parts(gaps: list[Gap], tasks: int) -> set[int]:
    """Return the numbers of those of ``tasks`` parts that have missing runs."""
    parts: set[int] = set()
    starts = {gap.runs: [Part(k, tasks).of(gap.runs).start for k in range(tasks)] for gap in gaps}
    for gap in gaps:
        for runs in gap.missing:
            first, last = (bisect_right(starts[gap.runs], run) for run in (runs[0], runs[-1]))
            parts.update(range(first - 1, last))
    return parts


def _describe_range(numbers: range) -> str:
    return f"{numbers[0]}" if len(numbers) == 1 else f"{numbers[0]}-{numbers[-1]}"
