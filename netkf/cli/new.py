"""``netkf new``: write a commented scenario and tests of it, as a first draft."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from netkf.cli.options import Command


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="NAME.toml and test_NAME.py are written")
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="folder of the files (default: the current one)"
    )


def _run(options: argparse.Namespace) -> int:
    """Write a scenario and its tests, and print how to run them; return the exit status."""
    from netkf.runs.template import write_template

    scenario, tests = write_template(options.name, options.folder)
    print(f"written: {scenario} and {tests}")
    installation = "" if find_spec("pytest") else "pip install pytest; "
    print(f"next: netkf run {scenario}; {installation}pytest {tests}")
    return 0


COMMAND = Command(
    "new", "write a commented scenario and its tests", _declare, _run, takes_scenario=False
)
