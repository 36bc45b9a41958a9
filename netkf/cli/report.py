"""``netkf report``: one self-contained HTML page of finished runs."""

from __future__ import annotations

import argparse


def _run(options: argparse.Namespace) -> int:
    from netkf.report.page import write_report

    path = write_report(options.directories, options.out, options.replica, options.trust)
    print(f"written to {path}")
    return 0
