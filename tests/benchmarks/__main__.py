"""Every target of speed in one table: ``python -m tests.benchmarks [--only NAME] [--history]``.

netkf, one process and no trace, through ``netkf.monte_carlo``, against hand-written numba kernels
of the same job (``by_hand``), batched numpy, filterpy, Stone Soup and simdkalman (``peers``), and
pieces of netkf against scipy, numpy and bare SimPy; commands (``--only command``) against
``python -c "import numpy, pandas"``. Processor time, medians of ``--runs``
measurements made in turn, after everything is compiled. A ratio says how many times the time of
the other netkf takes where the limit is an upper one (<=), and how many times faster netkf is where
it is a lower one (>=). Ratios hold from machine to machine, times do not.
"""

import argparse
import importlib.util
import tempfile
from pathlib import Path

from netkf.ensembles.directory import EnsembleOptions
from netkf.ensembles.parts import Part
from netkf.ensembles.plans import open_plan, plan_ensemble, work_on_plan
from tests.benchmarks import cases, history
from tests.benchmarks.commands import COMMANDS
from tests.benchmarks.rows import ROWS
from tests.benchmarks.table import heading, measured, shown

PACKAGES = {"filterpy": "filterpy", "Stone Soup": "stonesoup", "simdkalman": "simdkalman"}


def missing(row):
    """The package that a row needs and that is not installed, or None."""
    for words, package in PACKAGES.items():
        if words in row.name and importlib.util.find_spec(package) is None:
            return package
    return None


LAB_RUNS, MAX_BYTES = 64, 100_000


def show_bytes():
    """Bytes a run of what one job on a plan of the lab leaves without traces; True if it is few."""
    with tempfile.TemporaryDirectory() as folder:
        plan = Path(folder) / "plan"
        plan_ensemble(cases.load("intel_lab"), LAB_RUNS, plan, EnsembleOptions(trace="none"))
        work_on_plan(open_plan(plan), Part(0, 1))
        found = sum(file.stat().st_size for file in (plan / "blocks").iterdir()) / LAB_RUNS
    verdict = "" if found <= MAX_BYTES else "  MISSED"
    print(
        f"{'bytes of a run: job of 64 runs, lab':44s} {'byte':>6} {found:11,.0f} {'':19} ", end=""
    )
    print(f"{f'<= {MAX_BYTES}':>8}{verdict}")
    return found <= MAX_BYTES


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", help="rows whose name contains this")
    parser.add_argument("--runs", type=int, default=5, help="measurements of each (default 5)")
    parser.add_argument("--history", action="store_true", help="keep the ratios, see history.py")
    options = parser.parse_args()
    known = [*ROWS, *COMMANDS]
    rows = [row for row in known if options.only is None or options.only in row.name]
    if not rows:
        parser.error(f"no row is named so; there are {', '.join(row.name for row in known)}")
    missed, pairs = [], []
    heading()
    for row in rows:
        package = missing(row)
        if package is not None:
            print(f"{row.name}: left out, {package} is not installed")
            continue
        found = measured(row, options.runs)
        shown(row, found)
        pairs.append((row, found))
        missed += [row.name] if not found.holds(row) else []
    if options.history:
        history.add(pairs)
    if options.only is None and not show_bytes():
        missed.append("bytes of a run")
    print(f"{len(missed)} of {len(rows)} missed" if missed else "no limit missed")


if __name__ == "__main__":
    main()
