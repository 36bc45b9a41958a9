"""The contract of pools that run blocks, and that of pools outside this process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any, Self

from netkf.ensembles.blocks import Job, PackedScenario, pack_scenario
from netkf.scenario.scenario import Scenario

AHEAD = 1024
"""Largest number of blocks that are submitted and not yet completed."""

MAX_BLOCK = 64  # runs in a block: a killed command repeats at most so many for each worker
MAX_BLOCKS = 4096  # blocks in all: each is a file and a message to a worker
ROUNDS = 16  # blocks for each worker, so that all workers end at nearly the same time


class Pool(ABC):
    """Runs blocks of replicas.

    width : number of blocks that run at a time, as far as known
    ahead : number of blocks that may be submitted before the first is complete
    """

    width: int = 1
    ahead: int = AHEAD

    @abstractmethod
    def submit(self, job: Job) -> Future[Any]:
        """Submit a job, a block of replicas; return the future of its result.

        Pools that work in this process may run the block before they return.
        """

    def next_size(self, left: int, runs: int) -> int:
        """Return the number of runs of the next block, a power of two, when ``left`` of ``runs``
        are not yet submitted; asked before each block is made.
        """
        return block_size(runs, self.width)

    def wait(self, futures: Collection[Future[Any]]) -> Collection[Future[Any]]:
        """Wait until one of the futures of ``submit`` is done; return all that are."""
        return wait(futures, return_when=FIRST_COMPLETED).done

    def close(self, at_once: bool) -> None:  # noqa: B027 - most have nothing of their own
        """Release the workers; ``at_once`` without waiting for unfinished blocks."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(at_once=error is not None)


class RemotePool(Pool):
    """A pool outside this process, to which each scenario is sent pickled, packed once."""

    def __init__(self) -> None:
        # The last scenario and its packed form, to be reused for its other blocks.
        self._packed: tuple[object, PackedScenario] | None = None

    def submit(self, job: Job) -> Future[Any]:
        """Submit a block with the scenario pickled; blocks of one scenario share one pickle."""
        if isinstance(job.scenario, Scenario):
            if self._packed is None or self._packed[0] is not job.scenario:
                self._packed = job.scenario, self._pack(job.scenario)
            job = job._replace(scenario=self._packed[1])
        return self._send(job)

    def _pack(self, scenario: Scenario) -> PackedScenario:
        """Return the scenario in the form that is sent to workers; subclasses may add to it."""
        return pack_scenario(scenario)

    @abstractmethod
    def _send(self, job: Job) -> Future[Any]:
        """Submit a block whose scenario is packed (pickled) to the pool's workers."""


def block_size(runs: int, width: int) -> int:
    """Return the number of runs in a block, the unit of work that one worker does at a time, for
    ``runs`` runs on ``width`` workers: a power of two.

    Every worker gets about ROUNDS blocks, so that all end at nearly the same time, within the
    limits MAX_BLOCK and MAX_BLOCKS.
    """
    size = 1
    while size < MAX_BLOCK and 2 * size * width * ROUNDS <= runs:
        size *= 2
    while size * MAX_BLOCKS < runs:
        size *= 2
    return size
