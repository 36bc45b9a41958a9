"""The parser of the command line, and functions of several commands that parse and print values.

It imports the rest of netkf inside functions: ``netkf --help`` does not wait for numpy, numba.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from netkf.core.errors import ScenarioError, quote, suggest_nearest
from netkf.core.printable import one_line, shorten

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

FAILED = 1
"""Exit status of a command that ran without an error and whose answer is negative."""
MARGIN = 2
"""Minutes of a job of an array that are left for its start, and for the end of its last block."""


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line, without the usage text, and exits with 2."""

    def error(self, message: str) -> Any:
        """Print an error in one line on standard error, and raise SystemExit."""
        print(f"{self.prog}: {shorten(message, 1000)}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown arguments where the command is known."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise ArgumentError if a value is not one of the choices, suggesting the nearest one."""
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            remedy = f"{suggest_nearest(value, choices)}choose from {', '.join(choices)}"
            raise argparse.ArgumentError(action, f"invalid choice: {quote(value)} ({remedy})")


def parse_changes(settings: Sequence[str]) -> dict[str, Any]:
    """Return the values of texts ``key.path=value`` by key; raises ScenarioError."""
    from netkf.scenario.tables import replaces_key
    from netkf.scenario.values import parse_value, split_setting

    pairs = [split_setting("--set", setting) for setting in settings]
    # What counts is the last value of a key, and a table replaces what its keys had before.
    both = combinations([key for key, _ in pairs], 2)
    lost = {early: late for early, late in both if replaces_key(late, early)}
    print_notes([f"--set {late} replaces {early}, set before it" for early, late in lost.items()])
    return {key: parse_value("--set", key, text) for key, text in pairs}


def load_scenario(
    options: argparse.Namespace, ignored: Mapping[str, Any] = MappingProxyType({})
) -> Scenario:
    """Return the scenario of the command line with ``--set`` and ``--seed``; ``ignored`` values
    replace those of keys that the command does not use. It is read once. Raises ScenarioError.
    """
    copy: Path | None = getattr(options, "copy", None)
    if copy is None and hasattr(options, "loaded"):
        known: Scenario = options.loaded
        return known
    path = options.scenario if copy is None else copy
    try:
        os.stat(path)  # before the imports of a scenario, which take longer
    except OSError as error:
        rule = f"cannot be read ({error.strerror})"
        raise ScenarioError("", rule, None, "check the path", str(path)) from None
    except ValueError:  # a name that no file can have
        pass
    from netkf.scenario.reading import load

    if copy is not None:  # that of a plan, with all changes
        return load(copy, trust=options.trust)
    seed = getattr(options, "seed", None)
    settings = options.set if seed is None else [*options.set, f"seed={seed}"]
    loaded = load(options.scenario, {**parse_changes(settings), **ignored}, trust=options.trust)
    options.loaded = loaded
    return loaded


def pool_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the keywords of a study that say where and by which engine runs are simulated."""
    names = ("engine", "workers", "executor", "scheduler")
    return {name: getattr(options, name) for name in names if hasattr(options, name)}


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


SHELLS = ("bash", "zsh")


class PrintCompletion(argparse.Action):
    """Action of an option that prints the completion script of a shell and exits."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Print the completion script of a shell and exit; with status 2 without shtab."""
        try:
            import shtab
        except ImportError:
            parser.error("--print-completion needs shtab: pip install 'netkf[completion]'")
        for action in _iterate_actions(parser):
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
        print(shtab.complete(parser, shell=values))
        parser.exit()


def _iterate_actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command_parser in action.choices.values():
                yield from _iterate_actions(command_parser)


def add_completion(parser: argparse.ArgumentParser) -> None:
    """Add ``--print-completion``."""
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        choices=SHELLS,
        help="print a completion script for this shell",
    )
