"""``netkf schema``: print the JSON Schema of scenario files, for editors."""

from __future__ import annotations

import argparse
import json


def _run(options: argparse.Namespace) -> int:
    if options.markdown:
        from netkf.scenario.schema_page import schema_page

        print(schema_page(), end="")
    else:
        from netkf.scenario.schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
    return 0
