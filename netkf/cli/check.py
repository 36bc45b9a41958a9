"""``netkf check``: compare simulations with the guarantees of the filter's paper."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from collections.abc import Iterator

from netkf.checks.check import MAX_LOOKED_RUNS, USUAL_RUNS, Verdict, check, usual_runs
from netkf.checks.report import verdict_json, verdict_text
from netkf.checks.samples import sampling_note
from netkf.checks.storage import PICTURE, clear_unfinished, load_verdict, save_verdict
from netkf.cli import pictures
from netkf.cli.options import FAILED, load_scenario, pool_settings, print_json, print_notes
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError
from netkf.runs.files import create_output_directory, lock_directory
from netkf.scenario.scenario import Scenario
from netkf.scenario.usage import unused_notes


def _run(options: argparse.Namespace) -> int:
    scenario = load_scenario(options)
    if options.runs is None:
        options.runs = usual_runs(scenario)
        if options.runs < USUAL_RUNS:
            print_notes([f"{options.runs} runs, of {len(scenario.nodes):,} nodes; see --runs"])
    with lock_directory(options.out):
        return _check(scenario, options)


def _check(scenario: Scenario, options: argparse.Namespace) -> int:
    # The verdict in --out to which --resume adds runs.
    earlier = _open_verdict_directory(scenario, options)
    # The same command may have been given before, and stopped after it wrote its verdict.
    is_complete = earlier is not None and options.until is None and earlier.runs == options.runs
    if earlier is not None and is_complete:
        verdict = earlier
    else:
        with _explain_interrupt(options, earlier), ProgressLine() as line:
            settings = {**pool_settings(options), "progress": line.make_count_update("runs")}
            settings |= {name: getattr(options, name) for name in ("confidence", "until")}
            settings |= {"most": options.most or MAX_LOOKED_RUNS, "earlier": earlier}
            verdict = check(scenario, options.runs, **settings)
    command = _replay_command(options)
    text = verdict_text(verdict, scenario.claim, command)
    # Samples are taken at other times than those of ``probe``, at which states are recorded.
    unused = unused_notes(scenario, without_states=True)
    print_notes((*scenario.notes, *unused, *filter(None, [sampling_note(scenario)])))
    try:
        if options.out is not None:
            _write_verdict(scenario, verdict, "" if is_complete else text, options)
    finally:
        if options.json:
            print_json(verdict_json(verdict))
        else:
            print(
                text if options.all else verdict_text(verdict, scenario.claim, command, full=False)
            )
    if options.out is not None and not options.json:
        result = "nothing left to do in" if is_complete else "written to"
        print(f"{result} {options.out}")
    return 0 if verdict else FAILED


@contextlib.contextmanager
def _explain_interrupt(options: argparse.Namespace, earlier: Verdict | None) -> Iterator[None]:
    """Add to a KeyboardInterrupt what is in the directory of ``--out``."""
    try:
        yield
    except KeyboardInterrupt:
        if options.out is None:
            raise
        content = "nothing was written"
        if earlier:
            content = f"{options.out} has the verdict on {earlier.runs:,} runs"
        raise KeyboardInterrupt(f"new runs are kept with their verdict only; {content}") from None


def _open_verdict_directory(scenario: Scenario, options: argparse.Namespace) -> Verdict | None:
    """Make the directory of ``--out``, or return the earlier verdict in it with ``--resume``."""
    if options.out is None:
        if options.resume:
            remedy = "add --out DIR with the directory of the verdict"
            raise ScenarioError("--resume", "needs a verdict to add runs to", None, remedy)
        return None
    if options.resume and not clear_unfinished(options.out, scenario):
        return load_verdict(options.out, scenario, scenario.seed)
    create_output_directory(options.out, scenario.name)
    return None


def _write_verdict(
    scenario: Scenario, verdict: Verdict, text: str, options: argparse.Namespace
) -> None:
    """Write ``text`` (unless empty) and the other files of a verdict, and its missing picture."""
    if text:
        save_verdict(options.out, scenario, verdict, text)
    picture = options.out / PICTURE
    if not options.no_plot and not picture.exists():
        pictures.draw_picture(pictures.VERDICT, picture, verdict, scenario.claim)


def _replay_command(options: argparse.Namespace) -> str:
    command = ["netkf", "run", str(options.scenario)]
    for change in options.set:
        command += ["--set", change]
    if options.seed is not None:
        command += ["--seed", str(options.seed)]
    if options.trust:
        command.append("--trust")
    return shlex.join([*command, "--replica"])
