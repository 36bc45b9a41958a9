"""The entry point of ``netkf``: the parser, and the message and exit status of each kind of error.

The module imports little, so that handlers of signals are installed early: an interrupt during
imports would end in a traceback.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import partial

from netkf.cli import process
from netkf.core.errors import NetkfError
from netkf.core.printable import one_line, shorten

TYPE_CHECKING = False  # as in netkf/__init__.py
if TYPE_CHECKING:
    import argparse
    from typing import Any

BAD_USAGE = 2
"""Exit status of bad usage, bad files and failures."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    0: done. 1: a promise is broken or a target is not reached. 2: bad usage, a bad file, or a
    failure, reported in one line, with a traceback if the error was unexpected. 130: interrupted.

    Without ``arguments`` it runs the command line of this process, and ends the process.
    """
    if arguments is None:
        # Worker processes search the current folder for modules before they receive the path of
        # this process, and it may be the folder of a scenario from someone else.
        os.environ["PYTHONSAFEPATH"] = "1"
        # Figures are only written to files. A user's setting of a window system that is missing
        # here would make matplotlib raise ValueError.
        os.environ["MPLBACKEND"] = "agg"
        # Threads of OpenBLAS spin while they wait for the next product: on a busy machine commands
        # took up to four times the processor time. Those of a pool of workers have one each, too.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        process.run_as_process(partial(_run_command, sys.argv[1:]))
    with process.Interruption() as interruption:
        return _run_command(arguments, interruption)


def _run_command(arguments: Sequence[str], interruption: process.Interruption) -> int:
    """Run a command line and print its error; signals raise KeyboardInterrupt while armed."""
    with process.safe_streams():
        try:
            interruption.arm()
            status, message = _execute(arguments, interruption)
            interruption.disarm()
        except KeyboardInterrupt as interrupt:
            status, message = _report_interrupt(str(interrupt))
        if message:
            print(f"netkf: {one_line(message)}", file=sys.stderr)
    return status


def _execute(arguments: Sequence[str], interruption: process.Interruption) -> tuple[int, str]:
    """Return the exit status of a command and its message on standard error, "" without one."""
    try:
        parser = make_parser()
        options = parser.parse_args(arguments)
        options.arguments, options.parse = list(arguments), parser.parse_args
        status: int = options.run(options)
        # A full disk or a closed pipe raises its error here at the latest, where it can be reported
        # in one line.
        sys.stdout.flush()
    except process.OutputError as error:
        process.discard_output()
        return BAD_USAGE, f"cannot write: {_error_reason(error.__cause__)}"
    except Exception as error:
        message = _describe_error(error)
        # A library may turn an interrupt into an error of its own, or fail while the command ends.
        if interruption.received:
            return _report_interrupt(message or "")
        if message is None:
            import traceback

            traceback.print_exception(error)
            return BAD_USAGE, f"failed with {type(error).__name__}, see above"
        return BAD_USAGE, message
    return status, ""


def _report_interrupt(detail: str) -> tuple[int, str]:
    """Return the outcome of an interrupted command; ``detail`` says what was kept, if known."""
    return process.INTERRUPTED, f"interrupted; {detail}" if detail else "interrupted"


def _describe_error(error: Exception) -> str | None:
    """Return the line about an expected error; None for one that gets a traceback."""
    if isinstance(error, NetkfError):
        return str(error)
    if isinstance(error, OSError):
        path = f" ({shorten(error.filename, 1000)})" if error.filename else ""
        return f"{_error_reason(error)}{path}"
    if isinstance(error, MemoryError):
        return "the memory is too small; take fewer nodes, a shorter horizon or fewer probe times"
    return None


def _error_reason(error: BaseException | None) -> str:
    """Return the operating system's text for an error, else its class and message."""
    return getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line, with one subparser for each of COMMANDS."""
    import netkf
    from netkf.cli.commands import COMMANDS
    from netkf.cli.options import Parser, add_completion

    parser = Parser(
        prog="netkf",
        description="Simulate distributed Kalman filters on random networks and compare them with "
        "the guarantees of their papers.",
    )
    parser.add_argument("--version", action="version", version=f"netkf {netkf.__version__}")
    add_completion(parser)
    commands: Any = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for command in COMMANDS:
        command.add_to(commands)
    return parser
