"""One pool of workers for many scenarios, one after the other."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from netkf.ensembles.blocks import Job
from netkf.ensembles.pools import Pool, PoolOptions, make_pool


class _OpenPool(Pool):
    """A pool that stays open when the work on one scenario ends."""

    def __init__(self, pool: Pool) -> None:
        self._pool, self.width = pool, pool.width

    @property
    def ahead(self) -> int:  # type: ignore[override]
        """Number of jobs that the pool takes at a time."""
        return self._pool.ahead

    def submit(self, job: Job) -> Future[Any]:
        """Submit a job to the pool."""
        return self._pool.submit(job)

    def next_size(self, left: int, runs: int) -> int:
        """Return the number of runs of the next block when ``left`` of ``runs`` remain."""
        return self._pool.next_size(left, runs)

    def wait(self, futures: Collection[Future[Any]]) -> Collection[Future[Any]]:
        """Wait until one of the futures is done; return all that are."""
        return self._pool.wait(futures)


@contextmanager
def shared_pool(runs: int, options: PoolOptions) -> Iterator[Pool]:
    """Yield one pool of workers for several scenarios of ``runs`` runs each."""
    pool = make_pool(runs, options, open_ended=True)
    done = False
    try:
        # replicate_blocks() closes the pool that it is given; _OpenPool.close() does nothing.
        yield _OpenPool(pool)
        done = True
    finally:
        pool.close(at_once=not done)
