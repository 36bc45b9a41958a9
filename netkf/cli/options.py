"""Options that several commands share, and how the command line reads and prints values.

Modules of this package import the rest of netkf inside functions, so that ``netkf --help`` and
usage errors do not wait for numpy and numba.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from netkf.core.errors import nearest, quote
from netkf.core.printable import one_line, shorten

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

FAILED = 1
"""Exit status of a command that ran and whose answer is no."""
ENGINES = ("auto", "simpy", "processes", "compiled")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage text, and exit status 2."""

    def error(self, message: str) -> Any:
        """Print the line and end with SystemExit."""
        print(f"{self.prog}: {shorten(message, 1000)}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise ArgumentError for a value that is no choice, with the nearest one that is."""
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            remedy = f"{nearest(value, known)}choose from {', '.join(known)}"
            raise argparse.ArgumentError(action, f"invalid choice: {quote(value)} ({remedy})")


@dataclass(frozen=True)
class Command:
    """A command of ``netkf``: its name and help, and the functions that declare its options and run
    it. ``run`` returns the exit status. ``takes_scenario`` adds the scenario file and ``--set``.
    """

    name: str
    help: str
    declare: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    takes_scenario: bool = True

    def add_to(self, commands: Any) -> None:
        """Add the parser of the command; the namespace gets its ``run`` function."""
        parser = commands.add_parser(self.name, help=self.help, description=self.help)
        if self.takes_scenario:
            _add_scenario(parser)
        self.declare(parser)
        parser.set_defaults(run=self.run)


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    """Add the scenario file and the options that change it."""
    parser.add_argument("scenario", type=Path, help="scenario file (TOML)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY.PATH=VALUE",
        help="override a key of the scenario; VALUE is written as in TOML",
    )
    add_trust(parser, "its folder")


def add_trust(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add ``--trust``; ``folder`` is where the modules may be besides the current folder."""
    parser.add_argument(
        "--trust",
        action="store_true",
        help=f"import classes that the scenario names from modules in {folder} or the current one",
    )


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add ``--seed``."""
    parser.add_argument("--seed", type=parse_seed, help="root seed (default: the scenario's)")


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add ``--engine``."""
    parser.add_argument(
        "--engine",
        default="auto",
        choices=ENGINES,
        help="auto takes the compiled engine if it can run the scenario, else SimPy",
    )


def add_pool(parser: argparse.ArgumentParser) -> None:
    """Add ``--workers`` and ``--scheduler``, of which one may be given."""
    pool = parser.add_mutually_exclusive_group()
    pool.add_argument(
        "--workers", type=parse_workers, help="number of processes (default: one per core)"
    )
    pool.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT")


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON document only")


def add_no_plot(parser: argparse.ArgumentParser) -> None:
    """Add ``--no-plot``."""
    parser.add_argument("--no-plot", action="store_true", help="do not draw a picture")


def add_vary(parser: argparse.ArgumentParser, metavar: str, text: str) -> None:
    """Add ``--vary``, which can be repeated."""
    parser.add_argument("--vary", action="append", required=True, metavar=metavar, help=text)


def parse_seed(text: str) -> int:
    """Return the integer of ``--seed``; raises ArgumentTypeError."""
    if not text.isdecimal() or len(text) > 30:
        rule = "must be a non-negative integer of at most 30 digits"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return int(text)


def parse_replica(text: str) -> int:
    """Return the integer of ``--replica``; raises ArgumentTypeError."""
    if not text.isdecimal() or len(text) > 12:
        rule = "must be an integer of at least 0"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return int(text)


MAX_RUNS = 100_000_000  # more are a slip
WORKERS_PER_CORE = 8  # beyond that processes only fill the memory


def parse_count(text: str) -> int:
    """Return the positive integer of ``--runs``; raises ArgumentTypeError."""
    return _parse_positive(text, MAX_RUNS)


def parse_workers(text: str) -> int:
    """Return the positive integer of ``--workers``; raises ArgumentTypeError."""
    # More processes than that only fill the memory.
    return _parse_positive(text, max(64, WORKERS_PER_CORE * (os.cpu_count() or 1)))


def _parse_positive(text: str, most: int) -> int:
    """Return an integer from 1 to ``most``; raises ArgumentTypeError."""
    if not text.isdecimal() or not 1 <= int(text[:20]) <= most:
        rule = f"must be an integer of at least 1 and at most {most:,}"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return int(text)


def parse_changes(settings: Sequence[str]) -> dict[str, Any]:
    """Return the values of ``key.path=value`` texts by key; unquoted words become strings.

    Raises ScenarioError for a text without ``=`` or a value that is not TOML.
    """
    from netkf.scenario.values import parse_value, split_setting

    pairs = [split_setting("--set", setting) for setting in settings]
    return {key: parse_value("--set", key, text) for key, text in pairs}


def load_scenario(
    options: argparse.Namespace, ignored: Mapping[str, Any] = MappingProxyType({})
) -> Scenario:
    """Return the scenario of the command line, with ``--set`` and ``--seed`` applied, and then the
    values of keys that the command ignores.
    """
    from netkf.scenario.reading import load

    changes = {**parse_changes(options.set), **ignored}
    if getattr(options, "seed", None) is not None:
        changes["seed"] = options.seed
    return load(options.scenario, changes, trust=options.trust)


def print_notes(notes: Sequence[str]) -> None:
    """Print notes to stderr, one per line."""
    for note in notes:
        print(f"note: {one_line(note)}", file=sys.stderr)


def print_title(scenario: Scenario) -> None:
    """Print the name of a scenario and its claim."""
    print(one_line(f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name))


def print_json(document: Any) -> None:
    """Print a document as JSON; numbers that are not finite become null."""
    from netkf.runs.files import to_json_value

    print(json.dumps(to_json_value(document), indent=2))
