"""What every engine promises, and the order of things that happen at one instant.

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

from netkf.engines.soundness import sound
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import BatchSink, RunBatch
from netkf.trace.recorder import Recorder


class Rank(IntEnum):
    """Order of kinds of happening at one instant.

    The origin of coordinates moves first; sensors read, and nodes use all samples of the instant;
    then clocks tick, and senders snapshot what they send; then delayed messages arrive; then every
    node with mail absorbs all of it at once; probes see the result.
    """

    REBASE = 0
    SENSE = 1
    UPDATE = 2
    TICK = 3
    DELIVER = 4
    ABSORB = 5
    PROBE = 6


SHORTEST_SHARE, LONGER = 1e-9, 1.02
"""The least part of a gap whose readings are used at once, however short the stretch, and by what
it grows from one stretch to the next: a covariance beyond all bounds, which no reading shrinks as
it should, takes a thousand of them and not a billion.
"""

Progress = Callable[[float], None]
"""Called with the simulated time now and then."""


def silent(time: float) -> None:
    """No progress."""


class Engine(ABC):
    """Runs scenarios."""

    name: str

    @abstractmethod
    def refusal(self, scenario: Scenario) -> str | None:
        """Why this engine cannot run the scenario, with the remedy; None where it can."""

    def announce(self, scenario: Scenario) -> None:  # noqa: B027 - there may be nothing to say
        """Say on stderr what will take a while before the first run."""

    @abstractmethod
    def run(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> str:
        """Simulate up to the horizon; returns the status, complete or diverged."""

    def run_many(self, scenario: Scenario, seed: int, replicas: range) -> Iterator[RunBatch]:
        """Yield the runs of consecutive ``replicas`` in order, as many at a time as suits the
        engine; each run is to the last bit what ``run`` gives for its replica.
        """
        for replica in replicas:
            sink = batch_sink(scenario, range(replica, replica + 1))
            recorder = Recorder([sink], counts_only=True)
            status = self.run(scenario, Streams(seed, replica), recorder, silent)
            sink.finish(recorder, status)
            yield sink.batch()


def batch_sink(scenario: Scenario, replicas: range) -> BatchSink:
    """A sink for the samples of some recorded runs of a scenario."""
    filters = 1 if scenario.hosted.pooled else len(scenario.nodes)
    return BatchSink(replicas, scenario.times, (filters, scenario.plant.n))


def broken(
    scenario: Scenario, xhat: FloatArray, P: FloatArray, without: np.ndarray | None = None
) -> list[int]:
    """The nodes whose estimate or covariance, (N, n) and (N, n, n), is not ``sound``; those
    ``without`` (N,) a covariance have none to be looked at. They end a run as diverged.
    """
    intact = sound(xhat, P, False if without is None else without)
    return [scenario.nodes[k] for k in np.flatnonzero(~intact)]
