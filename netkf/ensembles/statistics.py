"""One run reduced to a tally, and tallies of neighbours merged into one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from netkf.engines.base import Engine, silent
from netkf.ensembles.moments import Moments, merge_moments, single
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.runs.simulate import choose_engine, collect
from netkf.runs.summary import averaged_samples
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import MemorySink, Recorder
from netkf.trace.run import Run, errors

MESSAGES = ("sent", "delivered", "lost", "in_flight", "transmissions")


class Trace(NamedTuple):
    """Everything of one run: events as EVENT rows, samples as in ``netkf.Run``."""

    replica: int
    log: np.ndarray
    times: FloatArray
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


class Tally(NamedTuple):
    """Some runs, reduced.

    ``samples``: (T, N, 2 u + 1) upper triangles of P and of e e' with the error e, then NEES;
    size (T, 1, 1). ``averages``: (N + 1, 3) of every run: mean square error, mean trace of P and
    mean NEES over the samples after time 0, of the nodes and of all; size (1, 1). ``messages``:
    (5,) as MESSAGES, transmissions nan in slots, size (1,). ``totals`` are events, diverged runs.
    ``conserved``: of each sum its mean at the start and at the end, then the largest relative
    drift. ``rounding_from`` is the first sample of any run at which rounding blurs the errors, inf
    where none. ``fingerprint`` is that of replica 0. ``traces`` are those asked for, in order.
    """

    samples: Moments
    averages: Moments
    messages: Moments
    totals: np.ndarray
    conserved: dict[str, tuple[Moments, float]]
    rounding_from: float
    fingerprint: str
    traces: tuple[Trace, ...] = ()

    @property
    def runs(self) -> int:
        """How many runs are in it."""
        return int(self.averages.size[0, 0])


def merge(a: Tally, b: Tally) -> Tally:
    """The runs of ``a`` followed by those of ``b``."""
    conserved = {
        name: (merge_moments(a.conserved[name][0], b.conserved[name][0]), max(drifts, key=abs))
        for name, drifts in (
            (name, (a.conserved[name][1], b.conserved[name][1])) for name in a.conserved
        )
    }
    return Tally(
        merge_moments(a.samples, b.samples),
        merge_moments(a.averages, b.averages),
        merge_moments(a.messages, b.messages),
        a.totals + b.totals,
        conserved,
        min(a.rounding_from, b.rounding_from),
        a.fingerprint,
        a.traces + b.traces,
    )


class _Samples(MemorySink):
    """Keeps samples, and events where they are wanted."""

    def __init__(self, traced: bool) -> None:
        super().__init__()
        self._traced = traced

    def events(self, rows: np.ndarray) -> None:
        if self._traced:
            super().events(rows)


def reduced_run(
    scenario: Scenario, seed: int, replica: int, engine: str | Engine = "auto", traces: int = 0
) -> Tally:
    """Simulate one replica and reduce it; the first ``traces`` replicas keep everything too. Only
    theirs and replica 0's events have a fingerprint.
    """
    traced = replica < traces
    memory, chosen = _Samples(traced), choose_engine(engine, scenario)
    recorder = Recorder([memory], counted=not traced and replica > 0)
    status = chosen.run(scenario, Streams(seed, replica), recorder, silent)
    run = collect(scenario, memory, recorder, seed, replica, chosen.name, status)
    return _tally(run, recorder, scenario, traced)


def _tally(run: Run, recorder: Recorder, scenario: Scenario, traced: bool) -> Tally:
    """A sample at which a node's estimate or covariance is broken is left out."""
    diverged = run.status == "diverged"
    kept = len(run.times) - 1 if diverged else len(run.times)
    P, e = run.P[:kept], run.error[:kept]
    sq_error, nees = errors(e, P)
    trace = np.trace(P, axis1=2, axis2=3)
    blurred = run.rounding_from
    used = averaged_samples(run.times, blurred, diverged)
    averages = np.stack(
        [_mean(sq_error[used.errors]), _mean(trace[used.covariances]), _mean(nees[used.errors])],
        axis=1,
    )
    return Tally(
        single(*_padded(_columns(P, e, nees), len(scenario.times))),
        single(np.vstack([averages, averages.mean(axis=0)]), np.ones((1, 1))),
        single(count_messages(recorder.count, scenario.slotted), np.ones(1)),
        np.array([recorder.total, int(diverged)]),
        {
            name: (single(np.array(sums), np.ones(1)), (sums[1] - sums[0]) / sums[0])
            for name, sums in run.sums.items()
        },
        blurred,
        run.fingerprint,
        (Trace(run.replica, run.log, run.times, run.x, run.xhat, run.P, run.error),)
        if traced
        else (),
    )


@cache
def _upper(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(n)


def _columns(P: FloatArray, e: FloatArray, nees: FloatArray) -> FloatArray:
    i, j = _upper(e.shape[2])
    with np.errstate(over="ignore"):
        return np.concatenate([P[:, :, i, j], e[:, :, i] * e[:, :, j], nees[:, :, None]], axis=2)


def _padded(values: FloatArray, length: int) -> tuple[FloatArray, FloatArray]:
    """Zeros for samples that are missing at the end, and 1 or 0 (T, 1, 1) for those that exist."""
    whole = np.zeros((length, *values.shape[1:]))
    whole[: len(values)] = values
    return whole, (np.arange(length) < len(values)).astype(float)[:, None, None]


def count_messages(count: Callable[[str], int], slotted: bool) -> FloatArray:
    """(5,) as MESSAGES, from the number of events of each kind."""
    sent, delivered, lost = count("send"), count("deliver"), count("lost") + count("late")
    transmissions = math.nan if slotted else float(count("transmit") or sent)
    return np.array([sent, delivered, lost, sent - delivered - lost, transmissions])


def _mean(values: FloatArray) -> FloatArray:
    return values.mean(axis=0) if len(values) else np.full(values.shape[1:], np.nan)
