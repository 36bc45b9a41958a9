"""The contract of pools that run blocks, and that of pools outside this process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any, Self

from netkf.ensembles.blocks import BlockResult, Job, PackedScenario, pack_scenario
from netkf.scenario.scenario import Scenario

AHEAD = 2
"""Blocks for each worker that are submitted and not yet completed, if it is not in this process."""
GROWTH = 16
"""Blocks become at most so many times larger at a time."""
MAX_BLOCK = 1 << 16
"""Largest number of runs in a block."""
LOOK_SECONDS = 1.0
"""Interval at which futures, and a scheduler's connection, are looked at."""
MIN_SECONDS = 0.05
"""CPU time of the last blocks, which become smaller so that all workers end at the same time."""


class Pool(ABC):
    """Runs blocks of replicas.

    width : number of blocks that run at a time, as far as known
    quick : seconds of CPU time up to which blocks are made larger
    ahead : number of blocks that may be submitted before the first is complete
    plan  : the PlannedStudy in a plan whose ensembles are simulated, if any
    """

    plan: Any = None
    width: int = 1
    quick: float = 5.0
    _size: int = 1
    _rate: float = 0.0  # CPU seconds of a run of the last block
    _scenario: object = None  # the last one

    @property
    def ahead(self) -> int:
        """Number of blocks that may be submitted before the first is complete."""
        return AHEAD * self.width

    @abstractmethod
    def submit(self, job: Job) -> Future[BlockResult]:
        """Submit a job, a block of replicas; return the future of its result.

        Pools that work in this process may run the block before they return.
        """

    def begin(self, scenario: object) -> None:
        """Prepare for blocks of a scenario: begin with small ones, unless it is the last one."""
        if scenario is not self._scenario:
            self._scenario, self._size, self._rate = scenario, 1, 0.0

    def next_size(self, left: int) -> int:
        """Return the number of runs of the next block, a power of two, when ``left`` runs are not
        yet submitted; asked before each block is made.

        The last blocks are small, so that all workers end at nearly the same time, but none so
        small that sending its result takes longer than its work.
        """
        fair = max(1, left // (2 * self.width))
        if self._rate > 0.0:
            fair = max(fair, int(MIN_SECONDS / self._rate))
        return min(self._size, 1 << (fair.bit_length() - 1))

    def note_duration(self, job: Job, seconds: float) -> None:
        """Choose larger blocks if ``job``, of full size, took few ``seconds`` of CPU time."""
        # The caller may have made the block larger than asked, as a full set of SIMD lanes.
        runs = len(job.replicas)
        self._rate = seconds / runs
        if seconds < self.quick and runs >= self._size:
            growth = self.quick / max(seconds, self.quick / GROWTH)
            self._size = min(job.size << (int(growth).bit_length() - 1), MAX_BLOCK)
            self._size = max(self._size, 2 * job.size)

    def wait(self, futures: Collection[Future[BlockResult]]) -> Collection[Future[BlockResult]]:
        """Wait until one of the futures of ``submit`` is done; return all that are."""
        while not (done := [future for future in futures if future.done()]):
            # An executor that is shut down cancels futures without a word to those who wait.
            wait(futures, LOOK_SECONDS, FIRST_COMPLETED)
        return done

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

    def submit(self, job: Job) -> Future[BlockResult]:
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
    def _send(self, job: Job) -> Future[BlockResult]:
        """Submit a block whose scenario is packed (pickled) to the pool's workers."""
