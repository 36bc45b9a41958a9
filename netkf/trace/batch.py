"""Many runs of one scenario as stacked arrays, without their events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.trace.recorder import Fingerprint, Recorder, Sink
from netkf.trace.schema import CODES, KINDS

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
    With ``exact_errors``, errors keep their digits however large the state is. ``fingerprint`` is
    that of the events of the first run, empty if they were only counted.

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
    fingerprint: str = ""

    def __len__(self) -> int:
        """Number of runs."""
        return len(self.replicas)

    @property
    def diverged(self) -> np.ndarray:
        """(R,) bool: runs that ended with a broken estimate or covariance."""
        return np.asarray(self.status == DIVERGED)

    def count(self, kind: str) -> np.ndarray:
        """Return the number (R,) of events of a kind in each run."""
        return np.asarray(self.counts[:, CODES[kind]])


class BatchSink(Sink):
    """Collects the samples of recorded runs into a batch; ``finish`` ends each run.

    ``times`` (T,) are the sample times of a run that completes, ``shape`` = (F, n, n') the number
    of filters, of states, and the largest number of those that one filter estimates.
    """

    thread_safe: ClassVar[bool] = True

    def __init__(self, replicas: range, times: FloatArray, shape: tuple[int, int, int]) -> None:
        (filters, n, width), count = shape, (len(replicas), len(times))
        self._filters = filters
        self._batch = RunBatch(
            replicas=replicas,
            times=times,
            x=np.full((*count, n), np.nan),
            xhat=np.full((*count, filters, width), np.nan),
            P=np.full((*count, filters, width, width), np.nan),
            error=np.full((*count, filters, width), np.nan),
            lengths=np.zeros(len(replicas), dtype=np.int64),
            counts=np.zeros((len(replicas), len(KINDS)), dtype=np.int64),
            status=np.empty(0),
        )
        self._status: list[str] = []
        self._sums: list[dict[str, tuple[float, float]]] = []
        self._hash, self._fingerprint = Fingerprint(), ""

    def events(self, rows: np.ndarray) -> None:
        """Add the EVENT ``rows`` (K,) of the first run to its fingerprint; others are counted."""
        if not self._status:
            self._hash.events(rows)

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Append K samples to those of the present run."""
        run, batch = len(self._status), self._batch
        first, last = batch.lengths[run], batch.lengths[run] + len(t)
        batch.x[run, first:last] = x
        # A pooled filter is recorded once for every node.
        batch.xhat[run, first:last] = xhat[:, : self._filters]
        batch.P[run, first:last] = P[:, : self._filters]
        batch.error[run, first:last] = error[:, : self._filters]
        batch.lengths[run] = last

    def finish(self, recorder: Recorder, status: str) -> None:
        """End the present run, with the counts and sums of its recorder and its ``status``
        ("complete" or "diverged"); later samples belong to the next replica (number of a run).
        """
        # A batch has the fingerprint of its first run only.
        if not self._status and not recorder.counts_only:
            self._fingerprint = str(self._hash)
        self._batch.counts[len(self._status)] = recorder.counts
        self._status.append(status)
        self._sums.append(recorder.sums)

    def batch(self) -> RunBatch:
        """Return the samples and counts of all runs, once each of them is finished."""
        return replace(
            self._batch,
            status=np.array(self._status),
            sums={name: np.array([sums[name] for sums in self._sums]) for name in self._sums[0]},
            exact_errors=self.exact_errors,
            fingerprint=self._fingerprint,
        )
