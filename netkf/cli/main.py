"""The entry point of ``netkf``: the parser, and what each kind of error looks like to a user."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any

import netkf
from netkf.cli import check, compare, consistency, run, size, sweep, theory
from netkf.core.errors import NetkfError

BAD_USAGE, INTERRUPTED = 2, 130
COMMANDS = tuple(
    module.COMMAND for module in (run, check, theory, sweep, size, consistency, compare)
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status.

    0: done. 1: a promise is broken or a target is not reached. 2: bad usage, a bad file, or a
    failure: reported in one line, or with a traceback where nobody foresaw it. 130: interrupted.
    """
    if arguments is None:
        # Processes that Python starts for workers would import from the current folder before they
        # are told the path of this one; it may be that of a scenario of someone else.
        os.environ["PYTHONSAFEPATH"] = "1"
    options = make_parser().parse_args(arguments)
    try:
        status: int = options.run(options)
        # A full disk or a closed pipe must show here, where it can be reported in one line.
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
        path = f" ({error.filename})" if error.filename else ""
        print(f"netkf: cannot write: {error.strerror or error}{path}", file=sys.stderr)
        _discard_output()
        return BAD_USAGE
    except Exception as error:
        # Python's own exit status would be 1, which says that a promise is broken.
        traceback.print_exc()
        print(f"netkf: failed with {type(error).__name__}, see above", file=sys.stderr)
        return BAD_USAGE
    return status


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each command puts its function ``run`` into the namespace."""
    parser = _Parser(
        prog="netkf",
        description="Simulate distributed Kalman filters on random networks and compare them with "
        "the guarantees of their papers.",
    )
    parser.add_argument("--version", action="version", version=f"netkf {netkf.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    for command in COMMANDS:
        command.add_to(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage text."""

    def error(self, message: str) -> Any:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(BAD_USAGE)


def _discard_output() -> None:
    """Send the rest of stdout to the null device, else Python fails again when it exits."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
