"""``netkf compare``: print finished runs side by side."""

from __future__ import annotations

import argparse

from netkf.cli.options import print_json


def _run(options: argparse.Namespace) -> int:
    from netkf.studies.compare import compare
    from netkf.studies.tables import format_comparison

    comparison = compare(options.directories, options.confidence)
    if options.json:
        print_json(comparison.document())
    else:
        print(format_comparison(comparison))
    return 0
