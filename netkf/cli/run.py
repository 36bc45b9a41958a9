"""``netkf run``: simulate a scenario once or many times and keep the results in a directory."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from netkf.cli import pictures
from netkf.cli.options import load_scenario, print_notes, print_title
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError

if TYPE_CHECKING:
    from netkf.runs.run import CompletedRun
    from netkf.scenario.scenario import Scenario

MIN_RATED_EVENTS = 10_000  # of fewer events a run takes as long as its preparations


def _run(options: argparse.Namespace) -> int:
    is_ensemble = (options.runs or 1) > 1
    if is_ensemble and options.replica is not None:
        remedy = "leave out --runs or --replica"
        raise ScenarioError("--replica", "is for a single run", options.replica, remedy)
    if is_ensemble and (options.workers or 1) > 1:
        # The server of worker processes imports netkf while this process reads the scenario.
        from netkf.ensembles.process_start import start_server

        start_server()
    scenario = load_scenario(options)
    if options.resume and options.out is None:
        remedy = "add --out DIR with the directory of the run that was stopped"
        raise ScenarioError("--resume", "needs the directory of the runs", None, remedy)
    from netkf.runs.files import lock_directory

    with lock_directory(options.out):
        return _run_ensemble(scenario, options) if is_ensemble else _run_once(scenario, options)


def _run_once(scenario: Scenario, options: argparse.Namespace) -> int:
    """Simulate one run into ``--out``; ``--resume`` keeps a finished one."""
    from netkf.runs.run import run_to_directory

    if options.scheduler is not None:
        raise ScenarioError("--scheduler", "is for several runs", options.scheduler, "add --runs R")
    replica = options.replica or 0
    if options.resume:
        from netkf.ensembles.resume import clear_unfinished_runs

        if not clear_unfinished_runs(options.out, scenario, replica, _print_note):
            print(f"nothing left to do in {options.out}")
            return 0
    draw = None if options.no_plot else partial(pictures.draw_picture, pictures.RUN, scenario)
    with ProgressLine() as line:
        how = options.engine, options.trace or "full", line.make_time_update(scenario.horizon)
        completed = run_to_directory(scenario, options.out, *how, draw, replica)
    print_summary(scenario, completed)
    duration = f"{completed.seconds:.2f} s"
    if completed.events >= MIN_RATED_EVENTS:
        duration += f", {completed.events / max(completed.seconds, 1e-9):,.0f} per second"
    print(f"events: {completed.events:,} in {duration}, engine {completed.engine}")
    if completed.status != "complete":
        message = _describe_divergence(completed, scenario.nodes)
        print(f"status: {message}")
        print_notes([message])
    print(f"written to {completed.directory}")
    return 0


def _run_ensemble(scenario: Scenario, options: argparse.Namespace) -> int:
    """Simulate several runs into ``--out``; ``--resume`` simulates those that are missing."""
    from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
    from netkf.ensembles.pools import PoolOptions

    pool = PoolOptions(workers=options.workers, scheduler=options.scheduler)
    settings = EnsembleOptions(options.engine, options.trace or "first", options.resume, pool)
    draw = None
    if not options.no_plot:
        draw = partial(pictures.draw_picture, pictures.ENSEMBLE, scenario)
        # Importing matplotlib takes a second, in which the workers already simulate.
        load = partial(pictures.load_drawing, pictures.ENSEMBLE)
        threading.Thread(target=load, daemon=True).start()
    with ProgressLine() as line:
        completed = runs_to_directory(
            scenario,
            options.runs,
            options.out,
            settings,
            progress=line.make_count_update("runs"),
            finish=draw,
            note=_print_note,
        )
    if completed is None:
        print(f"nothing left to do in {options.out}")
        return 0
    print_summary(scenario, completed)
    print_ensemble(completed, options.runs)
    return 0


def _print_note(note: str) -> None:
    print_notes([note])


def print_summary(scenario: Scenario, completed: Any) -> None:
    """Print the notes on a scenario and the table of its completed run or ensemble."""
    from netkf.runs.files import missing_modules
    from netkf.runs.tables import summary_table

    print_notes([*scenario.notes, *missing_modules(scenario)])
    print_title(scenario)
    print()
    promised = completed.promised
    label, unit, states = promised.limit_label, scenario.common_unit, scenario.states_note
    print(summary_table(completed.summary, label, promised.notes, unit, states))


def print_ensemble(completed: Any, runs: int) -> None:
    """Print how many runs an ensemble averages over, how it ended, and where it is."""
    ensemble = completed.ensemble
    # No rate: the time may count compiling, in this process or in workers.
    print(
        f"averages over {runs:,} runs, +- one standard error; {completed.simulated:,} "
        f"simulated in {completed.seconds:.2f} s"
    )
    if ensemble.diverged:
        message = f"{ensemble.diverged:,} of {runs:,} runs diverged and ended early"
        print(f"status: diverged, {message}")
        note = f"{message}; averages over time cover the samples before they ended"
        print(f"note: {note}", file=sys.stderr)
    print(f"written to {completed.directory}")


def _describe_divergence(completed: CompletedRun, nodes: Sequence[int]) -> str:
    from netkf.engines.soundness import describe_divergence

    samples = completed.samples
    problem = describe_divergence(nodes, *samples.last)
    averaging = ""
    if samples.rounding_from is not None:
        averaging = f"; errors are averaged before {samples.rounding_from:g} s"
    return (
        f"{completed.status}, {problem} at {samples.times[-1]:g} s and the run ended "
        f"there{averaging}"
    )
