"""``netkf schema``: print the JSON Schema of scenario files, for editors."""

from __future__ import annotations

import argparse
import json

from netkf.cli.options import Command


def _declare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--markdown", action="store_true", help="print a reference of all keys instead"
    )


def _run(options: argparse.Namespace) -> int:
    """Print the JSON Schema, or the reference of keys in Markdown; return the exit status."""
    if options.markdown:
        from netkf.scenario.schema_page import schema_page

        print(schema_page(), end="")
    else:
        from netkf.scenario.schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
    return 0


COMMAND = Command(
    "schema",
    "print the JSON Schema of scenario files, for editors",
    _declare,
    _run,
    takes_scenario=False,
)
