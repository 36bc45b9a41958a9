"""Innovations of a run: what each reading was against what the node expected, and tests of them.

Traces keep no readings. A replay in the SimPy engine, whose events and states are those of the run,
hands every reading to the filter again, and this time it is noted.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from netkf.algorithms.filter import Filter, Reading
from netkf.core.errors import NetkfError
from netkf.linalg.arrays import FloatArray
from netkf.runs.increments import WhitenedInnovation, record_increments
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run, first_difference
from netkf.trace.schema import CODES

MAX_EVENTS = 400_000
"""Events of a run up to which it is replayed: half a minute."""
MAX_LAG = 20
MIN_READINGS = 30
"""Readings of a node from which on its autocorrelations say something."""


class Innovations(NamedTuple):
    """Innovations v = y - H xhat of M readings in their order, with S = H P H' + R.

    times (M,); nodes (M,); ``rows`` (M,): the length p of v; nis (M,): v' S^-1 v; ``whitened``: a
    list of M arrays (p,), the roots of S^-1 times v; ``increments``: how many of the readings are
    increments of an interval between two events of a node, whose v is what they are beyond those
    expected from the estimate at its beginning.
    """

    times: FloatArray
    nodes: np.ndarray
    rows: np.ndarray
    nis: FloatArray
    whitened: list[FloatArray]
    increments: int = 0


def innovations(run: Run, most: int = MAX_EVENTS) -> Innovations:
    """Return the innovations of the samples and increments of a run, by a replay.

    Raises NetkfError with a sentence if there are none: the filter has its own form of readings or
    gives no covariance, the run has more than ``most`` events, or a replay makes other events, as
    another version may.
    """
    scenario: Scenario = run.scenario
    if not isinstance(scenario.filter.algorithm, Filter):
        raise NetkfError("filters of the deprecated contracts do not say how they use readings")
    if len(run.log) > most:
        raise NetkfError(f"a run of more than {most:,} events is not replayed")
    algorithm: Filter = scenario.filter.algorithm
    noted: list[tuple[Reading, FloatArray, FloatArray | None]] = []
    intervals: list[WhitenedInnovation] = []
    if not scenario.slotted and scenario.increment_sensors:
        algorithm = record_increments(algorithm, intervals)
    filtering = dataclasses.replace(
        scenario.filter, algorithm=_record_innovations(algorithm, noted)
    )
    again = simulate(with_filter(scenario, filtering), run.seed, run.replica, "simpy")
    if len(run.log) and first_difference(run, again) is not None:
        raise NetkfError("a replay makes other events than the run: it is of another version")
    return _collect(again, noted, intervals)


def with_filter(scenario: Scenario, filtering: Any) -> Scenario:
    """Return a scenario with another filter that keeps its topology and folder."""
    found = dataclasses.replace(scenario, filter=filtering)
    for name in ("_folder", "_trust", "topology"):
        if name in scenario.__dict__:
            found.__dict__[name] = scenario.__dict__[name]
    return found


def _record_innovations(algorithm: Filter, noted: list[Any]) -> Filter:
    """Return the filter with an ``update`` that notes each sample and the estimate before it."""
    base: Any = type(algorithm)

    def update(self: Any, state: Any, reading: Any) -> Any:
        """Note the sample with the estimate before it, then update."""
        if isinstance(reading, Reading):
            noted.append((reading, *self.estimate(state)))
        return base.update(self, state, reading)

    def shift(self: Any, state: Any, offset: FloatArray) -> Any:
        """Shift as the filter does."""
        return base.shift(self, state, offset)

    # A class that defines ``update`` must define ``shift`` too, or it would lose its moving frame.
    own = {"update": update, "shift": shift, "__module__": base.__module__}
    made: Any = object.__new__(type(base.__name__, (base,), own))
    made.__dict__.update(algorithm.__dict__)
    return made  # type: ignore[no-any-return]


def _collect(run: Run, noted: list[Any], intervals: list[WhitenedInnovation]) -> Innovations:
    """Return the innovations of the recorded readings and intervals, in the order of time."""
    nodes, kept = _match_nodes(run, [one for one in noted if len(one[0].y)])
    whitened = [_whiten(*one) for one in kept] + [one.whitened for one in intervals]
    nis = np.array([float(v @ v) for v in whitened])
    if not np.isfinite(nis).any():
        raise NetkfError(
            "there are no readings, or the filter gives no covariance to judge them by"
        )
    times = np.array([*(reading.time for reading, *_ in kept), *(one.end for one in intervals)])
    nodes = np.concatenate([nodes, np.array([one.node for one in intervals], dtype=np.int64)])
    order = np.argsort(times, kind="stable")
    rows = np.array([len(values) for values in whitened])
    ordered = [whitened[k] for k in order.tolist()]
    return Innovations(times[order], nodes[order], rows[order], nis[order], ordered, len(intervals))


def _match_nodes(run: Run, noted: list[Any]) -> tuple[np.ndarray, list[Any]]:
    """Return the node of each recorded reading, -1 where a pooled filter reads for all."""
    senses = run.log[run.log["kind"] == CODES["sense"]][["t", "node"]]
    # A node with several sensors uses them together, and may have an event for each.
    first = np.ones(len(senses), dtype=bool)
    first[1:] = senses[1:] != senses[:-1]
    senses = senses[first]
    times = np.array([reading.time for reading, *_ in noted])
    # In slots the last readings come after the last sample, when events are no longer recorded.
    if len(senses) <= len(noted) and np.array_equal(senses["t"], times[: len(senses)]):
        return senses["node"], noted[: len(senses)]
    return np.full(len(noted), -1), noted


def _whiten(reading: Reading, xhat: FloatArray, P: FloatArray | None) -> FloatArray:
    """Return the innovation (p,) times the inverse root of its covariance, nan without one."""
    if P is None or not np.isfinite(P).all():
        return np.full(len(reading.y), np.nan)
    S = reading.H @ P @ reading.H.T + reading.R
    v = reading.y - reading.H @ xhat
    return np.asarray(np.linalg.solve(np.linalg.cholesky(S), v))


def chi_square_means(freedom: FloatArray, probability: float) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the intervals that hold chi-square over its degrees of ``freedom`` (M,)
    with a probability, each end missed with half of the rest.
    """
    tail = 0.5 * (1.0 - probability)
    ends = (2.0 * gammaincinv(0.5 * freedom, q) / freedom for q in (tail, 1.0 - tail))
    low, high = (np.asarray(end) for end in ends)
    return low, high


def innovation_series(found: Innovations) -> dict[int, FloatArray]:
    """Return the first whitened component of the innovations of each node that has MIN_READINGS."""
    first = np.array([values[0] for values in found.whitened])
    series = {}
    for node in np.unique(found.nodes).tolist():
        values = first[(found.nodes == node) & np.isfinite(first)]
        if len(values) >= MIN_READINGS:
            series[node] = values
    return series


def autocorrelation(values: FloatArray, lags: int) -> FloatArray:
    """Return the autocorrelation at lags 1 .. ``lags`` of a series (M,) of mean 0 by model."""
    total = float(values @ values)
    return np.array([values[k:] @ values[:-k] for k in range(1, lags + 1)]) / max(total, 1e-300)


def autocorrelations(found: Innovations) -> tuple[dict[int, FloatArray], dict[int, int]]:
    """Return the autocorrelations of the innovations of each node that has MIN_READINGS, at lags 1
    .. MAX_LAG, and how many readings each has.
    """
    series = innovation_series(found)
    counts = {node: len(values) for node, values in series.items()}
    lags = min([MAX_LAG, *(count - 2 for count in counts.values())])
    return {node: autocorrelation(values, lags) for node, values in series.items()}, counts
