"""``netkf check``: compare simulations with the guarantees of the filter's paper."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from netkf.cli import pictures
from netkf.cli.options import (
    FAILED,
    Command,
    add_json,
    add_no_plot,
    add_pool,
    add_seed,
    load_scenario,
    parse_count,
    print_json,
    print_notes,
)
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError

if TYPE_CHECKING:
    from netkf.checks.check import Verdict
    from netkf.scenario.scenario import Scenario


def _declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``netkf check``."""
    parser.add_argument(
        "--runs", type=parse_count, default=500, help="number of runs (default: 500)"
    )
    parser.add_argument(
        "--until",
        choices=["decided"],
        help="begin with --runs and add runs until every row is decided",
    )
    parser.add_argument(
        "--most", type=parse_count, help="runs after which --until ends (default: 20000)"
    )
    add_seed(parser)
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.99,
        help="probability with which all intervals hold together (default: 0.99)",
    )
    parser.add_argument("--out", type=Path, help="directory for the verdict, its table and picture")
    parser.add_argument(
        "--resume", action="store_true", help="add runs to the verdict in --out, up to --runs"
    )
    add_pool(parser)
    add_json(parser)
    add_no_plot(parser)


def _run(options: argparse.Namespace) -> int:
    """Return the exit status: 1 if a promise is broken."""
    from netkf.runs.directory_lock import lock_directory

    # Promises are checked at times of their own, so that the file's may not fit the horizon.
    scenario = load_scenario(options, {"probe": [0.0]})
    with lock_directory(options.out):
        return _check(scenario, options)


def _check(scenario: Scenario, options: argparse.Namespace) -> int:
    """Check the promises, print the verdict and save it if asked; return the exit status."""
    from netkf.checks.points import sampling_note
    from netkf.checks.report import verdict_json, verdict_text

    earlier = _read_earlier(scenario, options)
    # A command that was stopped after it had written its verdict is given again.
    done = earlier is not None and options.until is None and earlier.runs == options.runs
    verdict = earlier if earlier is not None and done else _run_check(scenario, options, earlier)
    text = verdict_text(verdict, scenario.claim, _replay_command(options))
    print_notes((*scenario.notes, *filter(None, [sampling_note(scenario)])))
    try:
        if options.out is not None:
            _save(scenario, verdict, "" if done else text, options)
    finally:  # a verdict whose files cannot be written is an answer too
        if options.json:
            print_json(verdict_json(verdict))
        else:
            print(text)
    if options.out is not None and not options.json:
        print(f"nothing left to do in {options.out}" if done else f"written to {options.out}")
    return 0 if verdict else FAILED


def _run_check(scenario: Scenario, options: argparse.Namespace, earlier: Verdict | None) -> Verdict:
    """Return the verdict on --runs runs, those of an ``earlier`` one included."""
    from netkf.checks.check import check
    from netkf.checks.looks import MAX_LOOKED_RUNS

    with _explain_interrupt(options, earlier), ProgressLine() as line:
        return check(
            scenario,
            options.runs,
            confidence=options.confidence,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=line.counter("runs"),
            until=options.until,
            most=options.most or MAX_LOOKED_RUNS,
            earlier=earlier,
        )


@contextlib.contextmanager
def _explain_interrupt(options: argparse.Namespace, earlier: Verdict | None) -> Iterator[None]:
    """Say in the interrupt of the body that runs are kept with their verdict only."""
    try:
        yield
    except KeyboardInterrupt:
        if options.out is None:
            raise
        kept = f"{options.out} has the verdict on {earlier.runs:,} runs" if earlier else ""
        message = f"new runs are kept with their verdict only; {kept or 'nothing was written'}"
        raise KeyboardInterrupt(message) from None


def _read_earlier(scenario: Scenario, options: argparse.Namespace) -> Verdict | None:
    """Make the directory of the verdict, or return the earlier verdict in it."""
    if options.out is None:
        if options.resume:
            remedy = "add --out DIR with the directory of the verdict"
            raise ScenarioError("--resume", "needs a verdict to add runs to", None, remedy)
        return None
    from netkf.checks.storage import clear_unfinished, load_verdict
    from netkf.runs.files import create_output_directory

    if options.resume and not clear_unfinished(options.out, scenario):
        return load_verdict(options.out, scenario, scenario.seed)
    create_output_directory(options.out, scenario.name)
    return None


def _save(scenario: Scenario, verdict: Verdict, text: str, options: argparse.Namespace) -> None:
    """Write the files of a verdict unless ``text`` is empty, and its picture if it is missing."""
    from netkf.checks.storage import PICTURE, save_verdict

    if text:
        save_verdict(options.out, scenario, verdict, text)
    picture = options.out / PICTURE
    if not options.no_plot and not picture.exists():
        pictures.draw_picture(pictures.VERDICT, picture, verdict, scenario.claim)


def _replay_command(options: argparse.Namespace) -> str:
    """Return the command that runs a replica of this check, without the number of the replica."""
    command = ["netkf", "run", str(options.scenario)]
    for change in options.set:
        command += ["--set", change]
    if options.seed is not None:
        command += ["--seed", str(options.seed)]
    if options.trust:
        command.append("--trust")
    return shlex.join([*command, "--replica"])


COMMAND = Command("check", "compare simulations with theory, one row per promise", _declare, _run)
