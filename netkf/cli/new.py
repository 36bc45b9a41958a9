"""``netkf new``: write a commented scenario and tests of it, as a first draft."""

from __future__ import annotations

import argparse
from importlib.util import find_spec


def _run(options: argparse.Namespace) -> int:
    from netkf.runs.template import write_template

    scenario, tests = write_template(options.name, options.folder)
    print(f"written: {scenario} and {tests}")
    installation = "" if find_spec("pytest") else "pip install pytest; "
    print(f"next: netkf run {scenario}; {installation}pytest {tests}")
    return 0
