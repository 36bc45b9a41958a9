"""``netkf import``: write a log as a scenario with its tables."""

from __future__ import annotations

import argparse


def _run(options: argparse.Namespace) -> int:
    from netkf.logs.importing import import_log

    files, notes = import_log(
        options.log,
        options.kind,
        options.out,
        like=options.like,
        unreported=options.unreported,
        hole=options.hole,
        trust=options.trust,
        columns=options.columns,
    )
    print(f"written: {files[0]} with {', '.join(path.name for path in files[1:])}")
    for note in notes:
        print(note if ": " in note[:14] else f"note: {note}")
    print(f"next: netkf run {files[0]}")
    return 0
