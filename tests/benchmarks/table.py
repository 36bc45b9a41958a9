"""One table of ratios: how rows are measured and printed."""

import resource
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

BUDGET = 0.5
"""Seconds of processor time that one measurement of one side takes, if it may be divided."""


class Side(NamedTuple):
    """A call that does ``count`` pieces of work; ``most`` pieces at once, ``least`` at least."""

    work: Callable[[int], object]
    least: int = 1
    most: int = 1


class Row(NamedTuple):
    """netkf against another: ``sides()`` makes both. ``limit``: the ratio of time that netkf takes
    is at most so much (``slower``), or the other's is at least so much (otherwise); None: no limit.
    """

    name: str
    unit: str
    sides: Callable[[], tuple[Side, Side]]
    limit: float | None
    slower: bool


class Measured(NamedTuple):
    """Medians: seconds a piece of netkf's and the other's, and of the ratios of pairs."""

    mine: float
    theirs: float
    ratio: float

    def holds(self, row):
        return row.limit is None or (
            self.ratio <= row.limit if row.slower else self.ratio >= row.limit
        )


def cpu():
    """User time of the processes that have ended and processor time of this one, all threads."""
    return time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def seconds(work, count, repeats=1):
    """Processor time of ``work(count)``, all threads, the mean of so many calls."""
    began = cpu()
    for _ in range(repeats):
        work(count)
    return (cpu() - began) / repeats


def pieces(side):
    """How many pieces of work one call does, and how many calls make a measurement; what is
    compiled gets loaded by the way.
    """
    work, count, most = side
    work(count)
    while count < most:  # what a call costs whatever it does makes the first estimates too small
        each = seconds(work, count) / count
        wanted = min(most, int(BUDGET / max(each, 1e-9)))
        if wanted < 2 * count:
            break
        count = wanted
    # Some milliseconds alone would say more about what the other side left in the caches.
    return count, max(1, int(0.2 * BUDGET / max(seconds(work, count), 1e-9)))


def measured(row, runs):
    """Both in turn, ``runs`` times."""
    sides = row.sides()
    counts = [pieces(side) for side in sides]
    pairs = [
        [seconds(side.work, *count) / count[0] for side, count in zip(sides, counts, strict=True)]
        for _ in range(runs)
    ]
    ratios = [mine / theirs if row.slower else theirs / mine for mine, theirs in pairs]
    mine, theirs = (statistics.median(each) for each in zip(*pairs, strict=True))
    return Measured(mine, theirs, statistics.median(ratios))


def heading():
    line = f"{'':44s} {'':>6} {'netkf, us':>11} {'other, us':>11} {'ratio':>7} {'limit':>8}"
    print(line, flush=True)


def shown(row, found):
    """One line."""
    sign = "<=" if row.slower else ">="
    limit = "" if row.limit is None else f"{sign} {row.limit:g}"
    verdict = "" if found.holds(row) else "  MISSED"
    print(
        f"{row.name:44s} {row.unit:>6} {1e6 * found.mine:11,.4g} {1e6 * found.theirs:11,.4g}"
        f" {found.ratio:7.3g} {limit:>8}{verdict}",
        flush=True,
    )
