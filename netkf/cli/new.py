"""``netkf new``: write a commented scenario and its tests to begin with."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from netkf.cli.options import Command


def _declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``netkf new``."""
    parser.add_argument("name", metavar="NAME", help="NAME.toml and test_NAME.py are written")
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="where (default: the current folder)"
    )


def _run(options: argparse.Namespace) -> int:
    """Write a scenario and its tests; return the exit status."""
    from netkf.runs.template import write_template

    scenario, tests = write_template(options.name, options.folder)
    print(f"written: {scenario} and {tests}")
    first = "" if find_spec("pytest") else "pip install pytest; "
    print(f"next: netkf run {scenario}; {first}pytest {tests}")
    return 0


COMMAND = Command(
    "new", "write a commented scenario and its tests", _declare, _run, takes_scenario=False
)
