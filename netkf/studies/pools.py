"""One pool of workers for many scenarios, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

from netkf.ensembles.blocks import Job
from netkf.ensembles.pools import Here, Pool, make_pool
from netkf.scenario.scenario import Scenario


class _Kept(Pool):
    """A pool that stays open when a part of the work ends."""

    def __init__(self, pool: Pool) -> None:
        self._pool, self.width, self.ahead = pool, pool.width, pool.ahead

    def submit(self, job: Job) -> Future[Any]:
        """As the pool does it."""
        return self._pool.submit(job)

    def renew(self) -> bool:
        """As the pool does it."""
        return self._pool.renew()


@contextmanager
def shared_pool(
    scenario: Scenario,
    runs: int,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Where to do the work, as keywords for ``replicate``, for several scenarios of ``runs`` runs
    each.
    """
    pool = make_pool(scenario, runs, workers, executor, scheduler)
    if isinstance(pool, Here):
        yield {"workers": 1}
        return
    done = False
    try:
        yield {"pool": _Kept(pool)}
        done = True
    finally:
        pool.close(at_once=not done)
