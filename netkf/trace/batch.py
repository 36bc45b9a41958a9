"""Many runs of one scenario as stacked arrays, without their events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.trace.recorder import MemorySink, Recorder
from netkf.trace.schema import CODES

COMPLETE, DIVERGED = "complete", "diverged"


@dataclass(frozen=True, eq=False)
class RunBatch:
    """Samples and event counts of R consecutive replicas of one scenario.

    ``replicas`` are their R numbers and ``times`` (T,) the sample times in seconds. ``x`` (R, T, n)
    is the true state, nan where it is unknown; ``xhat`` and ``error = x - xhat`` (R, T, F, n) and
    ``P`` (R, T, F, n, n) belong to F filters: one for each node, or a single one for all nodes
    where the filter is pooled. P is nan where the filter gives no covariance. Run r has
    ``lengths[r]`` samples: a run that diverges ends early, its last sample is the broken one, and
    its rows from ``lengths[r]`` on are unspecified.

    ``counts`` (R, len(KINDS)) are events by kind and ``status`` (R,) holds complete or diverged.
    ``sums`` gives for each conserved sum its values (R, 2) at the start and at the last sample.
    With ``exact_errors``, errors keep their digits however large the state is.

    ``error`` is what the engine computes in the coordinates of its estimates; ``x - xhat`` of
    large states has fewer digits.
    """

    replicas: range
    times: FloatArray
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray
    lengths: np.ndarray
    counts: np.ndarray
    status: np.ndarray
    sums: Mapping[str, FloatArray] = field(default_factory=dict)
    exact_errors: bool = False

    def __len__(self) -> int:
        """Number of runs."""
        return len(self.replicas)

    @property
    def diverged(self) -> np.ndarray:
        """(R,) bool: runs that ended with a broken estimate or covariance."""
        return np.asarray(self.status == DIVERGED)

    def count(self, kind: str) -> np.ndarray:
        """(R,) number of events of a kind in each run."""
        return np.asarray(self.counts[:, CODES[kind]])


def batch_of_one(
    replica: int,
    times: FloatArray,
    shape: tuple[int, int],
    memory: MemorySink,
    recorder: Recorder,
    status: str,
) -> RunBatch:
    """The batch of a single run that was recorded; ``times`` (T,) are the sample times of a run
    that completes, and ``shape`` = (F, n) is the number of filters and of states.
    """
    count, n = shape
    shapes = (n,), (count, n), (count, n, n), (count, n)
    whole = [np.full((1, len(times), *shape), np.nan) for shape in shapes]
    first = 0
    for t, *arrays in memory.samples:
        for array, given, wanted in zip(whole, arrays, shapes, strict=True):
            # A pooled filter is recorded once for every node.
            array[0, first : first + len(t)] = given[:, :count] if len(wanted) > 1 else given
        first += len(t)
    x, xhat, P, error = whole
    return RunBatch(
        replicas=range(replica, replica + 1),
        times=times,
        x=x,
        xhat=xhat,
        P=P,
        error=error,
        lengths=np.array([first]),
        counts=recorder.counts[None],
        status=np.array([status]),
        sums={name: np.array([pair]) for name, pair in recorder.sums.items()},
        exact_errors=recorder.exact_errors,
    )
