"""Parts of the runs of an ensemble, and the worker that simulates one."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from netkf.core.interrupts import writing_at_last
from netkf.ensembles.block_files import BlockFiles, RunIdentity
from netkf.ensembles.replicas import BlockStore, Node, Progress, missing_ranges

PIECES = 8
"""Parts begin at multiples of a power of two of about so many to a part: fewer files in the end."""


@dataclass(frozen=True)
class Part:
    """Part ``index`` of ``count``, counted modulo ``count``: parts may begin at 0 or at 1."""

    index: int
    count: int

    def of(self, runs: int) -> range:
        """Return the replicas of this part of ``runs`` runs; it may be empty."""
        unit = 1 << (max(1, runs // (PIECES * self.count)).bit_length() - 1)

        def bound(index: int) -> int:
            return runs if index == self.count else index * runs // self.count // unit * unit

        index = self.index % self.count
        return range(bound(index), bound(index + 1))


@dataclass(frozen=True)
class ArrayVariables:
    """Environment variables of a batch system's arrays of jobs; empty where it has none."""

    index: str
    first: str = ""
    last: str = ""
    step: str = ""
    count: str = ""


ARRAYS = (
    ArrayVariables(*(f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "MIN", "MAX", "STEP", "COUNT"))),
    ArrayVariables("PBS_ARRAY_INDEX"),
    ArrayVariables("SGE_TASK_ID", "SGE_TASK_FIRST", "SGE_TASK_LAST", "SGE_TASK_STEPSIZE"),
    ArrayVariables("LSB_JOBINDEX", last="LSB_JOBINDEX_END", step="LSB_JOBINDEX_STEP"),
)


def part_of_array(tasks: int, environment: Mapping[str, str] = os.environ) -> Part:
    """Return the part of this job of an array by the variables of SLURM, PBS, Grid Engine or LSF;
    without such variables the whole.

    Where the system does not tell the number of jobs, or its indices have gaps or begin after 1, as
    when some jobs are submitted again, the array is that of ``tasks`` jobs for which the plan is.
    """

    def read(name: str, default: int) -> int:
        text = environment.get(name, "")
        return int(text) if text.isdecimal() else default

    for names in ARRAYS:
        index = read(names.index, -1)
        # Grid Engine writes "undefined" and LSF 0 for a job that is in no array.
        if index < 0 or (index == 0 and names.index == "LSB_JOBINDEX"):
            continue
        first, step = read(names.first, 1), max(1, read(names.step, 1))
        regular = (read(names.last, -1) - first) // step + 1
        count = read(names.count, regular)
        if count < 1 or count != regular or (first > 1 and first + step * (count - 1) <= tasks):
            return Part(index, tasks)
        # Job 4 of 1 to 4 has the same part if it is submitted again, alone.
        return Part((index - first) // step + first, count)
    return Part(0, 1)


class Worker:
    """Simulates the runs of a ``part`` of ensembles that have no result yet, for so many
    ``seconds`` at most; of part None nothing.

    ``simulated`` and ``left`` are numbers of its runs; ``progress`` is called with the number of
    runs done and wanted; ``notes`` are lines for the user about files that are not used.
    """

    def __init__(
        self, part: Part | None, seconds: float | None = None, progress: Progress | None = None
    ) -> None:
        self.part, self._progress = part, progress
        self.simulated = self._wanted = 0
        self.notes: list[str] = []
        self.deadline = float("inf") if seconds is None else time.monotonic() + seconds
        self._slowest, self._begun = 0.0, time.monotonic()

    @property
    def left(self) -> int:
        """Number of runs of its part that have no result."""
        return self._wanted - self.simulated

    @contextlib.contextmanager
    def store(
        self,
        blocks: BlockFiles,
        identity: RunIdentity,
        returns: bool = False,
        is_over: Callable[[], bool] = lambda: False,
    ) -> Iterator[BlockStore]:
        """Yield the store of an ensemble with stored ``blocks``, and write the new ones in the end,
        whatever happens, unless the work ``is_over``.

        Only with ``returns`` results of stored blocks are read, and those of all are merged.
        """
        replicas = range(0) if self.part is None else self.part.of(identity.runs)
        is_whole = returns or self.part is None
        known, notes = blocks.find(identity, True, within=None if is_whole else replicas)
        self.notes += notes
        self._wanted += sum(map(len, missing_ranges(known, replicas)))
        self._begun = time.monotonic()

        def add(node: Node, value: Any, cpu_seconds: float) -> Any:
            value = blocks.add(node, value, identity, cpu_seconds)
            self.simulated += identity.runs_of(node)
            now = time.monotonic()
            self._slowest, self._begun = max(self._slowest, now - self._begun), now
            if self._progress is not None:
                self._progress(self.simulated, self._wanted)
            return value if returns else None

        try:
            with writing_at_last(partial(blocks.write, identity)):
                yield BlockStore(
                    # Without results nothing stands for each of them, and is merged.
                    {n: partial(blocks.load, n) if returns else lambda: None for n in known},
                    add,
                    identity.max_block,
                    replicas,
                    # The next block may take as long as the slowest.
                    lambda: time.monotonic() + self._slowest > self.deadline or is_over(),
                    None if returns else lambda _a, _b: None,
                )
        finally:
            if not is_over():
                blocks.write(identity)
