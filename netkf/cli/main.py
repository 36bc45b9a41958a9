"""The entry point of ``netkf``: the parser, and what each kind of error looks like to a user.

Imports little before signals are handled: an interrupt has to find a handler from the start.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import partial

from netkf.cli.process import (
    INTERRUPTED,
    Interruption,
    OutputError,
    discard_output,
    run_as_process,
    safe_streams,
)
from netkf.core.errors import NetkfError
from netkf.core.printable import one_line, shorten

TYPE_CHECKING = False  # as in netkf/__init__.py
if TYPE_CHECKING:
    import argparse
    from typing import Any

BAD_USAGE = 2
COMMANDS = (
    *("run", "check", "theory", "sweep", "size", "consistency", "compare", "compare_filters"),
    *("plot", "report", "why", "schema", "new"),
)
"""Modules of this package, each with a COMMAND."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status.

    0: done. 1: a promise is broken or a target is not reached. 2: bad usage, a bad file, or a
    failure: reported in one line, or with a traceback where nobody foresaw it. 130: interrupted.

    Without ``arguments`` it runs the command line of this process, and ends the process.
    """
    if arguments is None:
        # Processes that Python starts for workers would import from the current folder before they
        # are told the path of this one; it may be that of a scenario of someone else.
        os.environ["PYTHONSAFEPATH"] = "1"
        # Figures go to files; for the name of a window that it lacks matplotlib raises ValueError.
        os.environ["MPLBACKEND"] = "agg"
        run_as_process(partial(_run_command, sys.argv[1:]))
    with Interruption() as interruption:
        return _run_command(arguments, interruption)


class _Ending:
    """The exit status of a command and its line on standard error, if any."""

    def __init__(self, status: int, line: str = "") -> None:
        self.status, self.line = status, line


def _run_command(arguments: Sequence[str], interruption: Interruption) -> int:
    """Run a command, print its line on standard error, and return the exit status."""
    with safe_streams():
        try:
            interruption.arm()
            ending = _attempt(arguments, interruption)
            interruption.disarm()
        except KeyboardInterrupt as stop:
            ending = _interrupted(str(stop))
        if ending.line:
            print(f"netkf: {one_line(ending.line)}", file=sys.stderr)
    return ending.status


def _attempt(arguments: Sequence[str], interruption: Interruption) -> _Ending:
    """Run a command; raises KeyboardInterrupt, and SystemExit for bad usage."""
    try:
        options = make_parser().parse_args(arguments)
        status: int = options.run(options)
        # A full disk or a closed pipe must show here, where it can be reported in one line.
        sys.stdout.flush()
    except OutputError as error:
        discard_output()
        return _Ending(BAD_USAGE, f"cannot write: {_reason(error.__cause__)}")
    except Exception as error:
        line = _explain(error)
        if interruption.received:  # while it ended, or because a library met the interrupt
            return _interrupted(line or "")
        if line is None:
            return _Ending(BAD_USAGE, _print_traceback(error))
        return _Ending(BAD_USAGE, line)
    return _Ending(status)


def _interrupted(what: str) -> _Ending:
    """Return the ending of a command that was interrupted."""
    return _Ending(INTERRUPTED, f"interrupted; {what}" if what else "interrupted")


def _explain(error: Exception) -> str | None:
    """Return the line about an error, None if nobody foresaw it."""
    if isinstance(error, NetkfError):
        return str(error)
    if isinstance(error, OSError):
        path = f" ({shorten(error.filename, 1000)})" if error.filename else ""
        return f"{_reason(error)}{path}"
    if isinstance(error, MemoryError):
        return "the memory is too small; take fewer nodes, a shorter horizon or fewer probe times"
    return None


def _reason(error: BaseException | None) -> str:
    """Return the reason of an error on one line."""
    return getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"


def _print_traceback(error: Exception) -> str:
    """Print the traceback of an unexpected error; return the line that ends the command."""
    import traceback

    traceback.print_exception(error)
    # Python's own exit status would be 1, which says that a promise is broken.
    return f"failed with {type(error).__name__}, see above"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each command puts its function ``run`` into the namespace."""
    from importlib import import_module

    import netkf
    from netkf.cli.completion import add_completion
    from netkf.cli.options import Parser

    parser = Parser(
        prog="netkf",
        description="Simulate distributed Kalman filters on random networks and compare them with "
        "the guarantees of their papers.",
    )
    parser.add_argument("--version", action="version", version=f"netkf {netkf.__version__}")
    add_completion(parser)
    commands: Any = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for name in COMMANDS:
        import_module(f"netkf.cli.{name}").COMMAND.add_to(commands)
    return parser
