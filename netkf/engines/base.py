"""The contract of engines, and the order of events at one instant.

1. Simultaneous events run by (time, rank, entity), never by accident of insertion.
2. All randomness comes from rng.streams, one generator for each purpose and entity.
3. A message is known by its directed link and its number on that link.
4. The horizon is half open, [0, T); a sample at T is taken after everything before T.
5. Nothing is sent at time 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from enum import IntEnum

import numpy as np

from netkf.engines.soundness import sound_mask
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import BatchSink, RunBatch
from netkf.trace.recorder import Recorder


class Rank(IntEnum):
    """The order of the kinds of events at one instant.

    The origin of coordinates moves first. Nodes go down and up. Sensors read, and nodes use all
    samples of the instant. Then clocks tick, and senders take a snapshot of their state; then
    delayed messages arrive; then every node with messages absorbs all of them at once. Probes see
    the result.
    """

    REBASE = 0
    LIFE = 1
    SENSE = 2
    UPDATE = 3
    TICK = 4
    DELIVER = 5
    ABSORB = 6
    PROBE = 7


MIN_GAP_SHARE, LONGER = 1e-9, 1.02
"""Lower bound of the first measurement interval of a gap, as a share of the gap, and the factor by
which the bound grows from one interval to the next. The larger P, the shorter the intervals; with
the bound even a diverging P divides a gap into about a thousand of them and not into a billion.
"""

Progress = Callable[[float], None]
"""A callback that an engine calls with the simulated time from time to time."""


def silent(time: float) -> None:
    """Ignore the progress of a run: a Progress that does nothing."""


class Engine(ABC):
    """The contract of an engine, which runs scenarios."""

    name: str

    @abstractmethod
    def refusal(self, scenario: Scenario) -> str | None:
        """Return why this engine cannot run the scenario, with the remedy; None if it can."""

    def announce(self, scenario: Scenario) -> None:  # noqa: B027 - there may be nothing to say
        """Tell the user on stderr if the first run needs some time to prepare, as to compile."""

    @abstractmethod
    def run(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> str:
        """Simulate up to the horizon with the random numbers of ``streams``, pass events and
        samples to ``recorder``, and return the status, "complete" or "diverged". ``progress`` is
        called with the simulated time in seconds from time to time.
        """

    def together(self, scenario: Scenario) -> int:
        """Return the number of runs, a power of two, that are best handed out together at least."""
        return 1

    def run_many(
        self, scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
    ) -> Iterator[RunBatch]:
        """Yield the runs of consecutive ``replicas`` in order, with random numbers from ``seed``,
        as many at a time as suits the engine; each run is to the last bit what ``run`` gives for
        its replica. With ``fingerprint``, the first batch has that of the events of its first run.
        """
        # Engines that have no batches run replicas one by one; only counts and samples are kept.
        for replica in replicas:
            sink = batch_sink(scenario, range(replica, replica + 1))
            recorded = fingerprint and replica == replicas.start
            recorder = Recorder([sink], counts_only=not recorded)
            # Streams depend on the seed and the replica alone: any division into calls gives the
            # same runs.
            sink.finish(recorder, self.run(scenario, Streams(seed, replica), recorder, silent))
            yield sink.batch()


def batch_sink(scenario: Scenario, replicas: range) -> BatchSink:
    """Return a sink that collects the samples of the runs ``replicas`` in one RunBatch."""
    # A pooled filter is sampled once, not once for each node.
    pooled = scenario.node_filter.timing.pooled and scenario.views is None
    filters = 1 if pooled else len(scenario.nodes)
    return BatchSink(replicas, scenario.times, (filters, scenario.plant.n, scenario.width))


def broken(
    scenario: Scenario,
    xhat: FloatArray,
    P: FloatArray,
    error: FloatArray,
    without: np.ndarray | None = None,
) -> list[int]:
    """Return the ids of the nodes whose estimates end a run as diverged, see ``sound_mask``: those
    of ``xhat`` (N, n), ``P`` (N, n, n) and, if the truth is known, ``error`` (N, n). ``without``:
    mask (N,) of nodes that have no covariance.
    """
    # False broadcasts: every node then has a covariance to be looked at.
    known_error = error if scenario.plant.truth_known else None
    intact = sound_mask(xhat, P, False if without is None else without, known_error)
    return [scenario.nodes[k] for k in np.flatnonzero(~intact)]
