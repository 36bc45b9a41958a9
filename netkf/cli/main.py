"""The command line: thin, it calls experiments and prints."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import netkf
from netkf.cli.studies import add_commands
from netkf.core.errors import NetkfError, ScenarioError, quote

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

NOT_KEPT, BAD_USAGE, INTERRUPTED = 1, 2, 130
MOST_NODES = 12
RUN_PICTURE = "netkf.runs.plots", "run_picture"
ENSEMBLE_PICTURE = "netkf.ensembles.picture", "ensemble_picture"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status is 0 done, 1 a target is not reached, 2 bad usage
    or file or a failure that one line tells, 130 interrupted.
    """
    options = _parser().parse_args(arguments)
    try:
        status: int = options.command(options)
        sys.stdout.flush()
    except NetkfError as error:
        print(f"netkf: {error}", file=sys.stderr)
        return BAD_USAGE
    except KeyboardInterrupt as stop:
        print(f"netkf: interrupted; {stop}" if str(stop) else "netkf: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        print(f"netkf: cannot write: {error.strerror or error}{where}", file=sys.stderr)
        _abandon_output()
        return BAD_USAGE
    return status


def _abandon_output() -> None:
    """What could not be printed is not tried again when Python ends."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(BAD_USAGE)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="netkf",
        description="Simulate distributed Kalman filters on random "
        "networks and hold them against what theory promises.",
    )
    parser.add_argument("--version", action="version", version=f"netkf {netkf.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    run = _command(commands, "run", _run, "simulate a scenario and keep what happened")
    run.add_argument("--runs", type=_count, help="how many times, with other draws (default: 1)")
    run.add_argument("--replica", type=_replica, help="which run of an ensemble (default: 0)")
    run.add_argument("--seed", type=_seed, help="root seed instead of the scenario's")
    run.add_argument("--engine", default="auto", choices=["auto", "simpy", "processes", "compiled"])
    run.add_argument("--out", type=Path, help="directory for the run (default: runs/NAME-k)")
    _pool(run)
    run.add_argument(
        "--trace",
        choices=["full", "first", "none"],
        help="which runs leave tables of events and states (default: full for one run, else first)",
    )
    run.add_argument(
        "--resume", action="store_true", help="go on with the runs of --out that were stopped"
    )
    run.add_argument("--no-plot", action="store_true", help="no picture")
    check = _command(commands, "check", _check, "theory against simulation, a row a promise")
    check.add_argument("--runs", type=_count, default=500, help="how many (default: 500)")
    check.add_argument("--seed", type=_seed, help="root seed instead of the scenario's")
    check.add_argument(
        "--confidence",
        type=float,
        default=0.99,
        help="with which all intervals hold together (default: 0.99)",
    )
    _pool(check)
    check.add_argument("--json", action="store_true", help="one JSON document, nothing else")
    theory = _command(commands, "theory", _theory, "what is promised; no simulation")
    theory.add_argument("--json", action="store_true", help="one JSON document, nothing else")
    add_commands(commands, partial(_command, commands), _load, _count, _seed)
    return parser


def _command(
    commands: Any, name: str, command: Callable[[argparse.Namespace], int], words: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=words, description=words)
    parser.add_argument("scenario", type=Path, help="scenario file (TOML)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY.PATH=VALUE",
        help="change a key of the scenario; VALUE as in TOML",
    )
    parser.set_defaults(command=command)
    return parser


def _pool(parser: argparse.ArgumentParser) -> None:
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument("--workers", type=_count, help="processes (default: one a core)")
    workers.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT")


def _seed(text: str) -> int:
    if not text.isdecimal() or len(text) > 30:
        words = f"must be a non-negative integer of at most 30 digits, got {quote(text)}"
        raise argparse.ArgumentTypeError(words)
    return int(text)


def _replica(text: str) -> int:
    if not text.isdecimal() or len(text) > 12:
        words = f"must be an integer of at least 0, got {quote(text)}"
        raise argparse.ArgumentTypeError(words)
    return int(text)


def _count(text: str) -> int:
    if not text.isdecimal() or len(text) > 12 or int(text) < 1:
        words = f"must be an integer of at least 1, got {quote(text)}"
        raise argparse.ArgumentTypeError(words)
    return int(text)


def parse_changes(settings: Sequence[str]) -> dict[str, Any]:
    """``key.path=value`` texts as a mapping; values are TOML, and bare words are strings."""
    from netkf.scenario.values import split_setting, typed_value

    pairs = [split_setting("--set", setting) for setting in settings]
    return {key: typed_value("--set", key, text) for key, text in pairs}


def _load(options: argparse.Namespace) -> Scenario:
    from netkf.scenario.reading import load

    changes = parse_changes(options.set)
    if getattr(options, "seed", None) is not None:
        changes["seed"] = options.seed
    return load(options.scenario, changes)


def _notes(scenario: Scenario) -> None:
    for note in scenario.notes:
        print(f"note: {note}", file=sys.stderr)


def _run(options: argparse.Namespace) -> int:
    many = (options.runs or 1) > 1
    if many and options.replica is not None:
        remedy = "leave out --runs or --replica"
        raise ScenarioError("--replica", "is for a single run", options.replica, remedy)
    if many and options.workers != 1 and options.scheduler is None:
        from netkf.ensembles.process_start import start_early

        start_early()
    scenario = _load(options)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    if options.resume and options.out is None:
        remedy = "add --out DIR with the directory of the run that was stopped"
        raise ScenarioError("--resume", "needs the directory to go on in", None, remedy)
    return _run_many(scenario, options) if many else _run_once(scenario, options)


def _run_once(scenario: Scenario, options: argparse.Namespace) -> int:
    from netkf.ensembles.directory import clear_unfinished
    from netkf.runs.run import run_to_directory

    if options.scheduler is not None:
        raise ScenarioError("--scheduler", "is for several runs", options.scheduler, "add --runs R")
    replica = options.replica or 0
    if options.resume and not clear_unfinished(options.out, scenario, replica):
        print(f"nothing left to do in {options.out}")
        return 0
    meter = _Meter(scenario.horizon)
    picture = None if options.no_plot else partial(_picture, scenario, RUN_PICTURE)
    try:
        finished = run_to_directory(
            scenario, options.out, options.engine, options.trace or "full", meter, picture, replica
        )
    finally:
        meter.close()
    _told(scenario, finished)
    rate = finished.events / max(finished.seconds, 1e-9)
    took = f"{finished.seconds:.2f} s, {rate:,.0f} per second, engine {finished.engine}"
    print(f"events: {finished.events:,} in {took}")
    if finished.status != "complete":
        words = _divergence(finished)
        print(f"status: {words}")
        print(f"note: {words}", file=sys.stderr)
    print(f"written to {finished.directory}")
    return 0


def _run_many(scenario: Scenario, options: argparse.Namespace) -> int:
    from netkf.ensembles.directory import runs_to_directory

    meter = _Countdown()
    picture = None if options.no_plot else partial(_picture, scenario, ENSEMBLE_PICTURE)
    if picture is not None:  # loaded while workers work
        threading.Thread(target=partial(_drawing, ENSEMBLE_PICTURE), daemon=True).start()
    try:
        finished = runs_to_directory(
            scenario,
            options.runs,
            options.out,
            options.engine,
            options.trace or "first",
            workers=options.workers,
            scheduler=options.scheduler,
            resume=options.resume,
            progress=meter,
            finish=picture,
        )
    finally:
        meter.close()
    if finished is None:
        print(f"nothing left to do in {options.out}")
        return 0
    _told(scenario, finished)
    ensemble, seconds = finished.ensemble, max(finished.seconds, 1e-9)
    print(
        f"averages over {options.runs:,} runs, +- one standard error; {finished.simulated:,} "
        f"simulated in {seconds:.2f} s, {finished.simulated / seconds:,.1f} per second"
    )
    if ensemble.diverged:
        words = f"{ensemble.diverged:,} of {options.runs:,} runs diverged and ended early"
        print(f"status: diverged, {words}")
        print(f"note: {words}; averages over time are over what they had", file=sys.stderr)
    print(f"written to {finished.directory}")
    return 0


def _told(scenario: Scenario, finished: Any) -> None:
    """The table that ends a run, with what to know beforehand."""
    from netkf.runs.files import missing_modules
    from netkf.runs.tables import summary_table

    _notes(scenario)
    for note in missing_modules(scenario):
        print(f"note: {note}", file=sys.stderr)
    print(f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name)
    print()
    promised = finished.promised
    print(summary_table(finished.summary, promised.limit_words, promised.notes))


def _divergence(finished: Any) -> str:
    nodes = finished.samples.diverged
    listed = ", ".join(map(str, nodes[:MOST_NODES])) + (", ..." if len(nodes) > MOST_NODES else "")
    several = "s" if len(nodes) > 1 else ""
    blurred = finished.samples.rounding_from
    left_out = "" if blurred is None else f"; errors are averaged before {blurred:g} s"
    broken = f"estimate or covariance of node{several} {listed} is no longer finite"
    if finished.samples.ended_finite:
        broken = f"covariance of node{several} {listed} is no longer positive semidefinite"
    return (
        f"{finished.status}, the {broken} at {finished.samples.times[-1]:g} s and the run ended "
        f"there{left_out}"
    )


def _picture(scenario: Scenario, where: tuple[str, str], finished: Any) -> None:
    draw = _drawing(where)
    if draw is None:
        print("no picture: matplotlib is missing (pip install matplotlib)", file=sys.stderr)
        return
    draw(scenario, finished)


def _drawing(where: tuple[str, str]) -> Callable[[Scenario, Any], None] | None:
    """The function of a module that draws, or None without matplotlib."""
    try:
        module = importlib.import_module(where[0])
    except ImportError:
        return None
    draw: Callable[[Scenario, Any], None] = getattr(module, where[1])
    return draw


class _Meter:
    """Progress on a terminal, silence in a pipe."""

    def __init__(self, horizon: float) -> None:
        self._horizon, self._shown = horizon, -1
        self._live = sys.stderr.isatty()

    def __call__(self, time: float) -> None:
        percent = int(100.0 * time / self._horizon)
        if self._live and percent != self._shown:
            self._shown = percent
            print(
                f"\r{percent:3d} % of {self._horizon:g} simulated seconds",
                end="",
                file=sys.stderr,
                flush=True,
            )

    def close(self) -> None:
        if self._shown >= 0:
            print("\r\033[K", end="", file=sys.stderr, flush=True)


class _Countdown:
    """Runs done and the time left, on a terminal; silence in a pipe."""

    def __init__(self) -> None:
        self._live, self._shown = sys.stderr.isatty(), False
        self._began: tuple[float, int] | None = None

    def __call__(self, done: int, wanted: int) -> None:
        now = time.monotonic()
        if self._began is None:
            self._began = now, done
        if not self._live:
            return
        seconds, runs = now - self._began[0], done - self._began[1]
        left = f", about {seconds * (wanted - done) / runs:.0f} s left" if runs else ""
        self._shown = True
        print(f"\r\033[K{done:,} of {wanted:,} runs{left}", end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        if self._shown:
            print("\r\033[K", end="", file=sys.stderr, flush=True)


def _check(options: argparse.Namespace) -> int:
    from netkf.checks.check import check, verdict_json, verdict_text

    scenario = _load(options)
    meter = _Countdown()
    try:
        found = check(
            scenario,
            options.runs,
            confidence=options.confidence,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=meter,
        )
    finally:
        meter.close()
    _notes(scenario)
    if options.json:
        print(json.dumps(verdict_json(found), indent=2))
    else:
        print(verdict_text(found, scenario.claim))
    return 0 if found else NOT_KEPT


def _theory(options: argparse.Namespace) -> int:
    from netkf.runs.failures import told
    from netkf.runs.promises import promises, promises_text

    scenario = _load(options)
    try:
        found = promises(scenario)
    except Exception as error:
        reason = told(scenario, error)
        if reason is error:
            raise
        raise reason from error
    _notes(scenario)
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        print(promises_text(scenario, found))
    return 0
