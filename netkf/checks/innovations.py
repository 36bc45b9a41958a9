"""Innovations of a run: readings minus their predictions by the nodes, and their autocorrelations.

Traces do not contain readings. A replay in the SimPy engine, with the same events and states as the
run, passes every reading to the filter again, and the filter records it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter, Reading
from netkf.checks.increments import WhitenedInnovation, record_increments
from netkf.core.errors import NetkfError
from netkf.linalg.arrays import FloatArray
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run, first_difference
from netkf.trace.schema import CODES

MAX_EVENTS = 400_000
"""Largest number of events of a run that is replayed: that takes about half a minute."""
MAX_LAG = 20
"""Largest lag of autocorrelations, in readings."""
MIN_READINGS = 30
"""Smallest number of readings of a node for which autocorrelations are computed."""


class RecordedSample(NamedTuple):
    """A sample, with the estimate (n,) and P (n, n), or None, of its node just before it."""

    reading: Reading
    xhat: FloatArray
    P: FloatArray | None


class Innovations(NamedTuple):
    """Innovations v (p,) of M readings in order of time, with covariances S.

    A sample y has v = y - H xhat and S = H P H' + R, with the estimate just before it; increments
    over an interval have the v and S of checks.increments, with the estimate at its beginning.

    times      : (M,) seconds; of increments, the end of the interval
    nodes      : (M,) node that read it, -1 for a pooled filter, which reads all sensors
    rows       : (M,) length p of v
    nis        : (M,) v' S^-1 v, nan without a covariance
    whitened   : M arrays (p,), L^-1 v with S = L L'
    increments : number of readings that are increments
    """

    times: FloatArray
    nodes: np.ndarray
    rows: np.ndarray
    nis: FloatArray
    whitened: list[FloatArray]
    increments: int = 0


def compute_innovations(run: Run, max_events: int = MAX_EVENTS) -> Innovations:
    """Return the innovations of the samples and increments of a run, which is replayed for them.

    Raises NetkfError with the reason if there are none: the filter gives no covariance, there are
    no readings, the run has more than ``max_events``
    events, or the events of the replay differ, as they may if another version made the run.
    """
    scenario: Scenario = run.scenario
    if len(run.log) > max_events:
        raise NetkfError(f"a run of more than {max_events:,} events is not replayed")
    algorithm: Filter = scenario.filter.algorithm
    samples: list[RecordedSample] = []
    intervals: list[WhitenedInnovation] = []
    if not scenario.slotted and scenario.increment_sensors:
        algorithm = record_increments(algorithm, intervals)
    filtering = dataclasses.replace(scenario.filter, algorithm=_record_samples(algorithm, samples))
    replay = simulate(with_filter(scenario, filtering), run.seed, run.replica, "simpy")
    # Without a trace there are no events to compare.
    if len(run.log) and first_difference(run, replay) is not None:
        raise NetkfError("a replay makes other events than the run: it is of another version")
    return _collect_innovations(replay, samples, intervals)


def with_filter(scenario: Scenario, filtering: Any) -> Scenario:
    """Return a copy of a scenario with the [filter] ``filtering``, in the same folder and with the
    same topology, which need not be drawn again.
    """
    copy = dataclasses.replace(scenario, filter=filtering)
    # These are no fields, so that replace() does not copy them.
    for name in ("_folder", "_trust", "topology"):
        if name in scenario.__dict__:
            copy.__dict__[name] = scenario.__dict__[name]
    return copy


def _record_samples(algorithm: Filter, samples: list[RecordedSample]) -> Filter:
    """Return the filter ``algorithm`` that also appends what it is updated with to ``samples``."""
    base: Any = type(algorithm)

    def update(self: Any, state: Any, reading: Any) -> Any:
        """Append the sample with the estimate before it, then update as the filter does."""
        if isinstance(reading, Reading):
            samples.append(RecordedSample(reading, *self.estimate(state)))
        return base.update(self, state, reading)

    def shift(self: Any, state: Any, offset: FloatArray) -> Any:
        """Move the ``state`` by ``offset`` (n,) as the filter does."""
        return base.shift(self, state, offset)

    # Engines do not move the origin of the states for a class that defines ``update`` without
    # ``shift`` (``commutes``); then the replay would round differently from the run.
    methods = {"update": update, "shift": shift, "__module__": base.__module__}
    # Copied instead of constructed: its parameters have been checked already.
    recording: Any = object.__new__(type(base.__name__, (base,), methods))
    recording.__dict__.update(algorithm.__dict__)
    return recording  # type: ignore[no-any-return]


def _collect_innovations(
    run: Run, samples: list[RecordedSample], intervals: list[WhitenedInnovation]
) -> Innovations:
    """Return the innovations of a replay in order of time; raises NetkfError."""
    nodes, samples = _match_nodes(run, [sample for sample in samples if len(sample.reading.y)])
    whitened = [_whiten(sample) for sample in samples]
    whitened += [interval.whitened for interval in intervals]
    nis = np.array([float(v @ v) for v in whitened])
    if not np.isfinite(nis).any():
        raise NetkfError(
            "there are no readings, or the filter gives no covariance to judge them by"
        )
    ends = [interval.end for interval in intervals]
    times = np.array([sample.reading.time for sample in samples] + ends)
    interval_nodes = np.array([interval.node for interval in intervals], dtype=np.int64)
    nodes = np.concatenate([nodes, interval_nodes])
    order = np.argsort(times, kind="stable")
    rows = np.array([len(values) for values in whitened])
    ordered = [whitened[k] for k in order.tolist()]
    return Innovations(
        times=times[order],
        nodes=nodes[order],
        rows=rows[order],
        nis=nis[order],
        whitened=ordered,
        increments=len(intervals),
    )


def _match_nodes(
    run: Run, samples: list[RecordedSample]
) -> tuple[np.ndarray, list[RecordedSample]]:
    """Return the node of each sample (M,), by its ``sense`` event; -1 if a pooled filter reads."""
    senses = run.log[run.log["kind"] == CODES["sense"]][["t", "node"]]
    # A node with several sensors uses them together, and may have an event for each.
    first = np.ones(len(senses), dtype=bool)
    first[1:] = senses[1:] != senses[:-1]
    senses = senses[first]
    times = np.array([sample.reading.time for sample in samples])
    # In slots the last readings come after the last state sample, when events are not recorded.
    if len(senses) <= len(samples) and np.array_equal(senses["t"], times[: len(senses)]):
        return senses["node"], samples[: len(senses)]
    return np.full(len(samples), -1), samples


def _whiten(sample: RecordedSample) -> FloatArray:
    """Return the innovation (p,) in units of its covariance; nan without a finite P."""
    reading, xhat, P = sample
    if P is None or not np.isfinite(P).all():
        return np.full(len(reading.y), np.nan)
    S = reading.H @ P @ reading.H.T + reading.R
    v = reading.y - reading.H @ xhat
    return np.asarray(np.linalg.solve(np.linalg.cholesky(S), v))


def innovation_series(recorded: Innovations) -> dict[int, FloatArray]:
    """Return, by node with at least MIN_READINGS readings, the first components (M,) of the
    whitened innovations of its M readings: white noise if P is exact.
    """
    first_components = np.array([values[0] for values in recorded.whitened])
    series = {}
    for node in np.unique(recorded.nodes).tolist():
        values = first_components[(recorded.nodes == node) & np.isfinite(first_components)]
        if len(values) >= MIN_READINGS:
            series[node] = values
    return series


def autocorrelation(values: FloatArray, lags: int) -> FloatArray:
    """Return the autocorrelations (lags,) at lags 1 .. ``lags`` of a series ``values`` (M,) with
    expectation 0, relative to lag 0.
    """
    total = float(values @ values)
    return np.array([values[k:] @ values[:-k] for k in range(1, lags + 1)]) / max(total, 1e-300)


def autocorrelations(recorded: Innovations) -> tuple[dict[int, FloatArray], dict[int, int]]:
    """Return, by node with at least MIN_READINGS readings, the autocorrelations (L,) of its
    innovations at lags 1 .. L, and the number of its readings.

    The L lags are the same for all nodes: MAX_LAG, or fewer if a node has few readings. One lag is
    one reading of the node.
    """
    series = innovation_series(recorded)
    counts = {node: len(values) for node, values in series.items()}
    lags = min([MAX_LAG, *(count - 2 for count in counts.values())])
    return {node: autocorrelation(values, lags) for node, values in series.items()}, counts
