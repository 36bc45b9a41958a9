"""Ensembles of a study that any number of commands simulate through files.

The study is run again and again by ``netkf work`` and ``netkf merge``, on a pool with a plan: each
ensemble that it asks for has a folder of blocks, in the order in which it asks. As a study is
deterministic, all commands meet the same ensembles, up to the first that lacks results.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from netkf.ensembles.block_files import BlockFiles, RunIdentity, open_block
from netkf.ensembles.blocks import Job
from netkf.ensembles.merge_tree import Merge
from netkf.ensembles.parts import Worker
from netkf.ensembles.replicas import BlockStore, Form, Gap, MissingRunsError, Node, missing_ranges
from netkf.runs.documents import DamagedError
from netkf.runs.files import BLOCKS_FOLDER, scenario_digest
from netkf.scenario.scenario import Scenario

MAX_LEVELS = 40  # of the tree over replicas


class StudyBlocks(BlockFiles):
    """Results of the blocks of one ensemble of a study, run by run."""

    def __init__(self, folder: Path, merge: Merge, form: Form) -> None:
        super().__init__(folder, merge)
        self._form = form

    def pack(self, value: Any) -> dict[str, Any]:
        """Return the results of runs as arrays by name, with one row for each run."""
        return self._form.pack(value)

    def unpack(self, arrays: Any) -> Any:
        """Return the results of runs from their arrays."""
        return self._form.unpack({name: arrays[name] for name in arrays if name != "identity"})

    def require_fit(self, arrays: Any, stored: dict[str, Any]) -> int:
        """Return the number of runs whose results they are."""
        return len(next(iter(self._form.pack(self.unpack(arrays)).values())))

    def load(self, node: Node) -> Any:
        """Return the results of the runs of a node, which another worker may have merged into a
        larger file since it was found; raises EngineError if there are none.
        """
        start, size = node
        for length in (size << level for level in range(MAX_LEVELS)):
            outer = start // length * length, length
            with contextlib.suppress(DamagedError), open_block(self._path(outer)) as arrays:
                value, rows = self.unpack(arrays), slice(start - outer[0], start - outer[0] + size)
                is_list = isinstance(value, list)
                return value[rows] if is_list else type(value)(*(field[rows] for field in value))
        return super().load(node)


class PlannedStudy:
    """The ensembles of a study in the ``directory`` of its plan, of which a ``worker`` simulates a
    part, and whose results it gets if it ``returns`` them; ``installations`` made them.
    """

    def __init__(self, directory: Path, worker: Worker, returns: bool = True) -> None:
        self._directory, self._returns = directory, returns
        self.worker, self._count = worker, 0
        self.installations: list[dict[str, Any]] = []

    @contextlib.contextmanager
    def store(self, job: Job, merge: Merge, form: Form) -> Iterator[BlockStore]:
        """Yield the store of the next ensemble; raises MissingRunsError if results are missing."""
        assert isinstance(job.scenario, Scenario)
        self._count += 1
        digest = scenario_digest(job.scenario)
        identity = RunIdentity(digest, job.seed, job.stop, "none", "", job.first)
        blocks = StudyBlocks(self._directory / BLOCKS_FOLDER / f"{self._count:04d}", merge, form)
        with self.worker.store(blocks, identity, self._returns) as store:
            yield store
        self.installations += [i for i in blocks.installations if i not in self.installations]
        missing = list(missing_ranges(blocks.nodes, range(job.stop)))
        if missing or not self._returns:
            raise MissingRunsError([Gap(self._count, job.stop, missing)])
