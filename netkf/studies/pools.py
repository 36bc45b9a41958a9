"""One pool of workers for many scenarios, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

from netkf.ensembles.blocks import Job
from netkf.ensembles.pools import Pool, make_pool


class _Kept(Pool):
    """A pool that stays open when a part of the work ends."""

    def __init__(self, pool: Pool) -> None:
        self._pool, self.width = pool, pool.width

    @property
    def ahead(self) -> int:  # type: ignore[override]
        """As many as the pool takes now."""
        return self._pool.ahead

    def submit(self, job: Job) -> Future[Any]:
        """As the pool does it."""
        return self._pool.submit(job)

    def next_size(self, left: int, runs: int) -> int:
        """As the pool chooses."""
        return self._pool.next_size(left, runs)

    def renew(self) -> bool:
        """As the pool does it."""
        return self._pool.renew()


@contextmanager
def shared_pool(
    runs: int,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Where to do the work, as keywords for ``replicate``, for several scenarios of ``runs`` runs
    each.
    """
    pool = make_pool(runs, workers, executor, scheduler, open_ended=True)
    done = False
    try:
        yield {"pool": _Kept(pool)}
        done = True
    finally:
        pool.close(at_once=not done)
