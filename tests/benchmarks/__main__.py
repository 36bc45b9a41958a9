"""Every target of speed in one table: ``python -m tests.benchmarks [--only NAME] [--history]``.

netkf, one process and no trace, through ``netkf.monte_carlo``, against hand-written numba kernels
of the same job (``by_hand``), batched numpy, filterpy, Stone Soup and simdkalman (``peers``), and
pieces of netkf against scipy, numpy and bare SimPy. Processor time, medians of ``--runs``
measurements made in turn, after everything is compiled. A ratio says how many times the time of
the other netkf takes where the limit is an upper one (<=), and how many times faster netkf is where
it is a lower one (>=). Ratios hold from machine to machine, times do not.
"""

import argparse
import importlib.util

from tests.benchmarks import history
from tests.benchmarks.rows import ROWS
from tests.benchmarks.table import heading, measured, shown

PACKAGES = {"filterpy": "filterpy", "Stone Soup": "stonesoup", "simdkalman": "simdkalman"}


def missing(row):
    """The package that a row needs and that is not installed, or None."""
    for words, package in PACKAGES.items():
        if words in row.name and importlib.util.find_spec(package) is None:
            return package
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", help="rows whose name contains this")
    parser.add_argument("--runs", type=int, default=5, help="measurements of each (default 5)")
    parser.add_argument("--history", action="store_true", help="keep the ratios, see history.py")
    options = parser.parse_args()
    rows = [row for row in ROWS if options.only is None or options.only in row.name]
    if not rows:
        parser.error(f"no row is named so; there are {', '.join(row.name for row in ROWS)}")
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
    print(f"{len(missed)} of {len(rows)} missed" if missed else "no limit missed")


if __name__ == "__main__":
    main()
