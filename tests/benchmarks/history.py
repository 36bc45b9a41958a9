"""The history of the table: each measured ratio with its commit, machine and versions.

``python -m tests.benchmarks --history`` adds what it measures to HISTORY, and
``python docs/figures/benchmarks.py`` draws it. Ratios only: times do not hold on other machines.
"""

import csv
import datetime
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from tests.conftest import ROOT

HISTORY = ROOT / "docs" / "figures" / "benchmarks.csv"


class Entry(NamedTuple):
    """A ratio that was measured; ``limit`` as in the table, such as "<= 3", or empty."""

    date: str
    commit: str
    machine: str
    versions: str
    row: str
    ratio: str
    limit: str


def describe_commit():
    """The commit of the working tree, with a + if files differ from it."""
    command = ["git", "describe", "--always", "--abbrev=8", "--dirty=+", "--exclude=*"]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def describe_machine(info=Path("/proc/cpuinfo")):
    """The model of the processor."""
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def add(pairs, path=HISTORY):
    """Add pairs of a row and what was measured to a file."""
    versions = [f"{name} {version(name)}" for name in ("numba", "numpy", "scipy", "simpy")]
    common = (
        datetime.date.today().isoformat(),
        describe_commit(),
        describe_machine(),
        " ".join([f"python {platform.python_version()}", *versions]),
    )
    is_new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(Entry._fields)
        for row, found in pairs:
            limit = "" if row.limit is None else f"{'<=' if row.slower else '>='} {row.limit:g}"
            writer.writerow(Entry(*common, row.name, f"{found.ratio:.3g}", limit))


def read(path=HISTORY):
    """All entries of a file, the oldest first."""
    with path.open(newline="", encoding="utf-8") as file:
        return [Entry(**line) for line in csv.DictReader(file)]
