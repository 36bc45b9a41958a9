"""The command line: thin, it calls experiments and prints."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import threading
import tomllib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import netkf
from netkf.core.errors import NetkfError, ScenarioError, quote

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

BAD_USAGE, INTERRUPTED = 2, 130
LONGEST_WORD = 1000
MOST_NODES = 12


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status is 0 done, 2 bad usage or file or a failure that one
    line tells, 130 interrupted.
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
    run = _command(commands, "run", _run, "simulate a scenario once and keep what happened")
    run.add_argument("--seed", type=_seed, help="root seed instead of the scenario's")
    run.add_argument("--engine", default="auto", choices=["auto", "processes", "compiled"])
    run.add_argument("--out", type=Path, help="directory for the run (default: runs/NAME-k)")
    run.add_argument(
        "--trace",
        default="full",
        choices=["full", "first", "none"],
        help="which runs leave tables of events and states",
    )
    run.add_argument("--no-plot", action="store_true", help="no picture")
    theory = _command(commands, "theory", _theory, "what is promised; no simulation")
    theory.add_argument("--json", action="store_true", help="one JSON document, nothing else")
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


def _seed(text: str) -> int:
    if not text.isdecimal() or len(text) > 30:
        words = f"must be a non-negative integer of at most 30 digits, got {quote(text)}"
        raise argparse.ArgumentTypeError(words)
    return int(text)


def parse_changes(settings: Sequence[str]) -> dict[str, Any]:
    """``key.path=value`` texts as a mapping; values are TOML, and bare words are strings."""
    changes: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        key, text = key.strip(), text.strip()
        if not equals or not key or not text:
            remedy = "write it that way"
            if equals and key:
                remedy = f"give a value; an empty text is written {key}='\"\"'"
            raise ScenarioError("--set", "must be KEY.PATH=VALUE", setting, remedy)
        try:
            value = tomllib.loads(f"value = {text}")
            if list(value) != ["value"]:
                raise ValueError
            changes[key] = value["value"]
        except (ValueError, RecursionError):
            if text[0] in "[{\"'" or not text.isprintable() or len(text) > LONGEST_WORD:
                raise ScenarioError(
                    "--set",
                    f"value of {key} is not valid TOML",
                    text,
                    "mend it; quote the argument for your shell",
                ) from None
            changes[key] = text
    return changes


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
    from netkf.experiments.files import missing_modules
    from netkf.experiments.run import run_to_directory
    from netkf.experiments.tables import summary_table

    scenario = _load(options)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    meter = _Meter(scenario.horizon)
    picture = None if options.no_plot else partial(_picture, scenario)
    try:
        finished = run_to_directory(
            scenario, options.out, options.engine, options.trace, meter, picture
        )
    finally:
        meter.close()
    _notes(scenario)
    for note in missing_modules(scenario):
        print(f"note: {note}", file=sys.stderr)
    print(f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name)
    print()
    promised = finished.promised
    print(summary_table(finished.summary, promised.limit_words, promised.notes))
    rate = finished.events / max(finished.seconds, 1e-9)
    took = f"{finished.seconds:.2f} s, {rate:,.0f} per second, engine {finished.engine}"
    print(f"events: {finished.events:,} in {took}")
    if finished.status != "complete":
        words = _divergence(finished)
        print(f"status: {words}")
        print(f"note: {words}", file=sys.stderr)
    print(f"written to {finished.directory}")
    return 0


def _divergence(finished: Any) -> str:
    nodes = finished.samples.diverged
    listed = ", ".join(map(str, nodes[:MOST_NODES])) + (", ..." if len(nodes) > MOST_NODES else "")
    several = "s" if len(nodes) > 1 else ""
    blurred = finished.samples.rounding_from
    left_out = "" if blurred is None else f"; averages are over the samples before {blurred:g} s"
    return (
        f"{finished.status}, the estimate or covariance of node{several} {listed} is no longer "
        f"finite at {finished.samples.times[-1]:g} s and the run ended there{left_out}"
    )


def _picture(scenario: Scenario, finished: Any) -> None:
    try:
        from netkf.experiments.plots import run_picture
    except ImportError:
        print("no picture: matplotlib is missing (pip install matplotlib)", file=sys.stderr)
        return
    run_picture(scenario, finished)


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


def _theory(options: argparse.Namespace) -> int:
    from netkf.experiments.failures import told
    from netkf.experiments.promises import promises, promises_text

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
