"""Options that several commands share, and functions that parse and print values.

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

from netkf.core.errors import quote, suggest_nearest
from netkf.core.printable import one_line, shorten

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

FAILED = 1
"""Exit status of a command that ran without an error and whose answer is negative."""
ENGINES = ("auto", "simpy", "processes", "compiled")


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line, without the usage text, and exits with 2."""

    def error(self, message: str) -> Any:
        """Print an error in one line on standard error, and raise SystemExit."""
        print(f"{self.prog}: {shorten(message, 1000)}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise ArgumentError if a value is not one of the choices, suggesting the nearest one."""
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            remedy = f"{suggest_nearest(value, choices)}choose from {', '.join(choices)}"
            raise argparse.ArgumentError(action, f"invalid choice: {quote(value)} ({remedy})")


@dataclass(frozen=True)
class Command:
    """A command of ``netkf``.

    name, help     : as the command line shows them
    declare        : adds the options of the command to a parser
    run            : runs the command with the parsed options and returns the exit status
    takes_scenario : adds the scenario file, ``--set`` and ``--trust`` to the options
    """

    name: str
    help: str
    declare: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    takes_scenario: bool = True

    def add_to(self, commands: Any) -> None:
        """Add the parser of the command to ``commands``; namespaces have its function ``run``."""
        parser = commands.add_parser(self.name, help=self.help, description=self.help)
        if self.takes_scenario:
            _add_scenario(parser)
        self.declare(parser)
        parser.set_defaults(run=self.run)


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    """Add the scenario file, ``--set`` and ``--trust``."""
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
    """Add ``--trust``; ``folder`` names the folder from which modules are imported."""
    parser.add_argument(
        "--trust",
        action="store_true",
        help=f"import classes that the scenario names, also from {folder} or the current one",
    )


def add_options(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add the options ``--NAME`` of SHARED; "pool" stands for ``--workers`` and ``--scheduler``,
    which exclude each other.
    """
    for name in names:
        if name != "pool":
            parser.add_argument(f"--{name}", **SHARED[name])
            continue
        pool = parser.add_mutually_exclusive_group()
        text = "number of processes (default: one per core)"
        pool.add_argument("--workers", type=parse_workers, help=text)
        pool.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT")


def add_confidence(parser: argparse.ArgumentParser, default: float, what: str) -> None:
    """Add ``--confidence``, the probability ``what``, such as "that all marks are right"."""
    text = f"probability {what} (default: {default})"
    parser.add_argument("--confidence", type=float, default=default, help=text)


def add_vary(parser: argparse.ArgumentParser, metavar: str, text: str) -> None:
    """Add ``--vary``, which can be repeated, with the help ``text``."""
    parser.add_argument("--vary", action="append", required=True, metavar=metavar, help=text)


def parse_seed(text: str) -> int:
    """Return the value of ``--seed``; raises ArgumentTypeError for any text but digits."""
    if not text.isdecimal() or len(text) > 30:
        rule = "must be a non-negative integer of at most 30 digits"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return int(text)


def parse_replica(text: str) -> int:
    """Return the value of ``--replica``; raises ArgumentTypeError."""
    if not text.isdecimal() or len(text) > 12:
        rule = "must be an integer of at least 0"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return int(text)


MAX_RUNS = 100_000_000  # larger numbers are typing errors
WORKERS_PER_CORE = 8  # more processes only fill the memory


def parse_count(text: str) -> int:
    """Return a number of runs or replays; raises ArgumentTypeError unless it is 1 .. MAX_RUNS."""
    return _parse_positive(text, MAX_RUNS)


def parse_workers(text: str) -> int:
    """Return the value of ``--workers``; raises ArgumentTypeError."""
    return _parse_positive(text, max(64, WORKERS_PER_CORE * (os.cpu_count() or 1)))


def _parse_positive(text: str, largest: int) -> int:
    """Return an integer from 1 to ``largest``; raises ArgumentTypeError."""
    # Twenty digits suffice to compare: Python refuses to convert texts of thousands.
    if not text.isdecimal() or not 1 <= int(text[:20]) <= largest:
        rule = f"must be an integer of at least 1 and at most {largest:,}"
        raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")
    return int(text)


SHARED: dict[str, dict[str, Any]] = {
    "seed": {"type": parse_seed, "help": "root seed (default: the scenario's)"},
    "engine": {
        "default": "auto",
        "choices": ENGINES,
        "help": "auto takes the compiled engine if it can run the scenario, else SimPy",
    },
    "json": {"action": "store_true", "help": "print one JSON document only"},
    "all": {"action": "store_true", "help": "show all rows with all that they say"},
    "no-plot": {"action": "store_true", "help": "do not draw a picture"},
}
"""Options of several commands, as arguments of ``add_argument``."""


def parse_changes(settings: Sequence[str]) -> dict[str, Any]:
    """Return the values of texts ``key.path=value`` by key; raises ScenarioError."""
    from netkf.scenario.values import parse_value, split_setting

    pairs = [split_setting("--set", setting) for setting in settings]
    return {key: parse_value("--set", key, text) for key, text in pairs}


def load_scenario(
    options: argparse.Namespace, ignored: Mapping[str, Any] = MappingProxyType({})
) -> Scenario:
    """Return the scenario of the command line with ``--set`` and ``--seed`` applied.

    ``ignored`` has values, by key, for keys that the command does not use: they replace those of
    the file, which may be invalid together with other options. Raises ScenarioError.
    """
    from netkf.scenario.reading import load

    changes = {**parse_changes(options.set), **ignored}
    if getattr(options, "seed", None) is not None:
        changes["seed"] = options.seed
    return load(options.scenario, changes, trust=options.trust)


def print_notes(notes: Sequence[str]) -> None:
    """Print notes on standard error, one per line."""
    for note in notes:
        print(f"note: {one_line(note)}", file=sys.stderr)


def print_table_notes(scenario: Scenario) -> None:
    """Print notes on the rows of the scenario's tables that its runs merge or do not use."""
    from netkf.scenario.usage import repeat_notes, unused_notes

    print_notes((*repeat_notes(scenario), *unused_notes(scenario)))


def print_title(scenario: Scenario) -> None:
    """Print the name of a scenario and its claim on one line."""
    print(one_line(f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name))


def print_json(document: Any) -> None:
    """Print a document as JSON; numbers that are not finite become null."""
    from netkf.runs.files import to_json_value

    print(json.dumps(to_json_value(document), indent=2))
