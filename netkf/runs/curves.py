"""Mean square errors over time, for figures that compare runs or filters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.trace.batch import RunBatch


class ErrorCurve(NamedTuple):
    """The mean square error of all nodes over time.

    label   : the filter or the run
    times   : (T,) seconds
    square  : (T,) mean over nodes and runs of |x - xhat|^2, nan where unknown
    se      : (T,) its standard error (of an ensemble without its runs an upper bound), None for a
              single run
    runs    : number of runs
    central : mean trace of P of the centralised filter by theory, nan if unknown
    bound   : (T,) mean over nodes of the bound on the mean trace of P, None where there is none
    unit    : unit of the states, squared that of ``square``
    """

    label: str
    times: FloatArray
    square: FloatArray
    se: FloatArray | None = None
    runs: int = 1
    central: float = np.nan
    bound: FloatArray | None = None
    unit: str = "units of the state"


def squares_over_time(batch: RunBatch, rows: np.ndarray) -> FloatArray:
    """Return squared errors (R, K) at samples ``rows``, mean of nodes, nan after divergence."""
    error = batch.error[:, rows]  # nan in components that a node does not estimate
    found = np.nansum(error * error, axis=3).mean(axis=2)
    ends = batch.lengths - batch.diverged
    return np.asarray(np.where(rows[None, :] < ends[:, None], found, np.nan))
