"""Innovations of a run: readings minus their predictions by the nodes, and their autocorrelations.

Traces do not contain readings. A replay in the SimPy engine, with the same events and states as the
run, passes every reading to the filter again, inside a filter that records it.

Over ``[a, b]`` of length g a node with ``dy = H x ds + dv``, cov(dv) = R ds, reads y = int dy. From
its estimate at a it predicts ``H z``, where z is the integral of the predicted state over the
interval. The innovation ``y - H z`` has the covariance ``S = H Z H' + R g``, where Z is the
covariance of the integral of the prediction error e: de = A e ds + dw with cov(e(a)) = P(a).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo, Reading, interval_rule, may_be_silent
from netkf.algorithms.traits import Analysis, Needs, Timing, Weights
from netkf.core.errors import NetkfError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.plants.transitions import Transitions
from netkf.runs.readings import values_read
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run, first_difference

LOG_2PI = math.log(2.0 * math.pi)
MAX_EVENTS = 400_000
"""Largest number of events of a run that is replayed: that takes about half a minute."""
MAX_LAG = 20
"""Largest lag of autocorrelations, in readings."""
MIN_READINGS = 30
"""Smallest number of readings of a node for which autocorrelations are computed."""


class Innovations(NamedTuple):
    """Innovations v (p,) of M readings in order of time, with covariances S.

    A sample y has v = y - H xhat and S = H P H' + R, with the estimate just before it; increments
    over an interval have the v and S of checks.increments, with the estimate at its beginning.

    times      : (M,) seconds; of increments, the end of the interval
    nodes      : (M,) node that read it, -1 for a pooled filter, which reads all sensors
    rows       : (M,) length p of v
    nis        : (M,) v' S^-1 v, nan without a covariance
    whitened   : M arrays (p,), L^-1 v with S = L L'
    values     : M arrays (p,), v
    deviations : M arrays (p,), square roots of the diagonal of S
    log_density : (M,) log density of v, normal with covariance S
    increments : number of readings that are increments
    components : M arrays (p,), which of all values that sensors of the node give they are, from 0,
                 or None where that is unknown
    """

    times: FloatArray
    nodes: np.ndarray
    rows: np.ndarray
    nis: FloatArray
    whitened: list[FloatArray]
    values: list[FloatArray]
    deviations: list[FloatArray]
    log_density: FloatArray
    increments: int = 0
    components: Sequence[np.ndarray | None] = ()


class Recorded(NamedTuple):
    """The innovation ``value`` (p,) of a reading, nan without a finite P, the Cholesky factor
    ``root`` (p, p) of its covariance, and ``H`` (p, n) of a sample.
    """

    time: float
    node: int
    value: FloatArray
    root: FloatArray
    of_increments: bool
    H: FloatArray | None = None

    @property
    def whitened(self) -> FloatArray:
        """The innovation (p,) in units of its covariance."""
        return np.asarray(np.linalg.solve(self.root, self.value))


class TimedState(NamedTuple):
    """The state of a filter, ``inner``, with what an innovation needs besides.

    info  : of the node of the state
    time  : present time of the state, seconds
    start : estimate (n,) and P (n, n), or None, before the last prediction
    """

    inner: Any
    info: NodeInfo
    time: float
    start: tuple[FloatArray, FloatArray | None]

    @property
    def root(self) -> FloatArray:
        """The root of P that the filter has, on which its sigma points lie."""
        root: FloatArray = self.inner.root
        return root


class ExpectedIncrements:
    """Predictions of increments under one ``model`` with A, Q, H and R, over any interval."""

    def __init__(self, model: Any) -> None:
        """Take A and Q (n, n), H (p, n) and R (p, p) of ``model``."""
        zero, eye = np.zeros_like(model.A), np.eye(len(model.A))
        self._H, self._R = model.H, model.R
        # The joint equation of (x, z): dx = A x ds + dw and dz = x ds.
        A = np.block([[model.A, zero], [eye, zero]])
        self._transitions = Transitions(A, np.concatenate([square_root(model.Q), zero]))

    def innovation(
        self, xhat: FloatArray, P: FloatArray, y: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return y - H E[z] (p,) of increments over ``gap`` s and the Cholesky factor of its
        covariance, after the estimate ``xhat`` (n,), ``P`` (n, n).
        """
        n, H = len(xhat), self._H
        F, W = self._transitions.law(gap)
        # J is the integral of exp(A s) over the gap, so that E[z] = J xhat.
        J = F[n:, :n]
        S = H @ (J @ P @ J.T + W[n:, n:]) @ H.T + self._R * gap
        return y - H @ J @ xhat, np.linalg.cholesky(S)


@dataclass(frozen=True, eq=False)
class RecordingFilter(Filter):
    """The filter ``inner``, which appends to ``recorded``; ``expected`` is by id of its models."""

    inner: Filter
    recorded: list[Recorded]
    expected: dict[int, ExpectedIncrements]

    @property
    def timing(self) -> Timing:
        """The filter's own, of the states that are inside."""
        rule, silent = interval_rule(self.inner), may_be_silent(self.inner)
        return replace(self.inner.timing, interval=lambda state: rule(state.inner), decides=silent)

    @property
    def needs(self) -> Needs:
        """The filter's own."""
        return self.inner.needs

    @property
    def link_weights(self) -> Weights:
        """The filter's own."""
        return self.inner.link_weights

    @property
    def analysis(self) -> Analysis:
        """The filter's own, of the states that are inside."""
        given = self.inner.analysis
        return replace(
            given,
            wrapped=self.inner,
            conserved=lambda state: given.conserved(state.inner),
            stopped=lambda state: given.stopped(state.inner),
        )

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> TimedState:
        """Return the state at time 0 with the estimate ``mean`` (n,), ``cov`` (n, n)."""
        return TimedState(self.inner.init(model, mean, cov, node), node, 0.0, (mean, None))

    def predict(self, state: TimedState, gap: float) -> TimedState:
        """Return the state predicted over ``gap`` seconds, with the estimate before it."""
        inner, start = self.inner.predict(state.inner, gap), self.inner.estimate(state.inner)
        return TimedState(inner, state.info, state.time + gap, start)

    def update(self, state: TimedState, reading: Any) -> TimedState:
        """Update as the filter does; append the innovation first."""
        sampled = isinstance(reading, Reading)
        innovation = (self._of_sample if sampled else self._of_increments)(state, reading)
        if innovation is not None:
            time = reading.time if sampled else state.time
            node = -1 if self.timing.pooled else state.info.node
            value, root, *H = innovation
            self.recorded.append(Recorded(time, node, value, root, not sampled, *H))
        return state._replace(inner=self.inner.update(state.inner, reading))

    def _of_sample(self, state: TimedState, reading: Any) -> tuple[FloatArray, ...] | None:
        xhat, P = self.inner.estimate(state.inner)
        # How errors of other blocks correlate is not known.
        rows = slice(None) if self.timing.pooled else state.info.is_own(reading.H)
        y, H, R = reading.y[rows], reading.H[rows], reading.R[rows][:, rows]
        if not len(y):
            return None
        if P is None or not np.isfinite(P).all():
            return np.full(len(y), np.nan), np.eye(len(y)), H
        return y - H @ xhat, np.linalg.cholesky(H @ P @ H.T + R), H

    def _of_increments(self, state: TimedState, reading: Any) -> tuple[FloatArray, ...] | None:
        (xhat, P), model = state.start, state.inner.model
        if P is None or not np.isfinite(P).all():
            return None
        if id(model) not in self.expected:
            self.expected[id(model)] = ExpectedIncrements(model)
        # The first half of the moments is the integral of dy.
        y = reading.moments[: len(reading.moments) // 2]
        return self.expected[id(model)].innovation(xhat, P, y, reading.gap)

    def emit(self, state: TimedState, exchange: Any) -> tuple[TimedState, Any]:
        """Return the state and the payload of its message, as the filter does."""
        inner, payload = self.inner.emit(state.inner, exchange)
        return state._replace(inner=inner), payload

    def absorb(self, state: TimedState, messages: Sequence[Any], exchange: Any) -> TimedState:
        """Return the state after ``messages``, as the filter does."""
        return state._replace(inner=self.inner.absorb(state.inner, messages, exchange))

    def estimate(self, state: TimedState) -> tuple[FloatArray, FloatArray | None]:
        """Return xhat (n,) and P (n, n) or None, as the filter does."""
        return self.inner.estimate(state.inner)

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state or a payload with the estimate moved by ``offset`` (n,)."""
        if not isinstance(state, TimedState):
            return self.inner.shift(state, offset)
        return state._replace(inner=self.inner.shift(state.inner, offset))


def compute_innovations(run: Run, max_events: int = MAX_EVENTS) -> Innovations:
    """Return the innovations of a run by a replay. Raises NetkfError without readings or
    covariances, above ``max_events``, and for a replay with other events.
    """
    scenario: Scenario = run.scenario
    if len(run.log) > max_events:
        raise NetkfError(
            f"a run of more than {max_events:,} events is not replayed, and this one has "
            f"{len(run.log):,}; use a shorter horizon"
        )
    recorder = RecordingFilter(scenario.filter.algorithm, [], {})
    filtering = dataclasses.replace(scenario.filter, algorithm=recorder)
    replay = simulate(with_filter(scenario, filtering), run.seed, run.replica, "simpy")
    # Without a trace there are no events to compare.
    if len(run.log) and first_difference(run, replay) is not None:
        raise NetkfError("a replay makes other events than the run: it is of another version")
    # In slots the last readings come after the last state sample, when events are not recorded.
    recorded = [r for r in recorder.recorded if r.of_increments or r.time < scenario.horizon]
    recorded.sort(key=lambda one: one.time)
    which = cache(lambda node: _rows_read(scenario, node))
    rows = [which(one.node) for one in recorded]
    # Of values read alike only the instants tell which they are.
    alike = any(len(set(which(node))) < len(which(node)) for node in {one.node for one in recorded})
    told = values_read(scenario, run.seed, run.replica) if alike else {}
    times: Any = np.array([one.time for one in recorded])
    times = scenario.slot_plant.slots_of(times) if scenario.slotted else times
    keys = [(one.node, time) for one, time in zip(recorded, times.tolist(), strict=True)]
    components = [
        _components(one, of_node, told.get(key, []))
        for one, of_node, key in zip(recorded, rows, keys, strict=True)
    ]
    return tabulate(recorded)._replace(components=components)


def _rows_read(scenario: Scenario, node: int) -> list[tuple[float, ...]]:
    """Return the rows of H of all that a ``node`` (-1: all) reads; none where they vary."""
    sensors = scenario.sensors_of(node)
    if any(
        not s.linear or (s.varying if s.record is None else s.record.regressors) for s in sensors
    ):
        return []
    view = slice(None) if node < 0 else scenario.view(scenario.nodes.index(node))
    return [tuple(row[view]) for s in sensors for row in s.matrix_of(scenario.plant.n)]


def _components(one: Recorded, rows: list[tuple[float, ...]], told: list[int]) -> np.ndarray | None:
    found = [] if one.H is None else list(map(tuple, one.H))
    if not found or not set(found) <= set(rows):
        return None
    if [rows[k] for k in told] == found:
        return np.array(told)
    return np.arange(len(rows)) if found == rows else np.array(list(map(rows.index, found)))


def tabulate(recorded: Sequence[Recorded]) -> Innovations:
    """Return innovations as a table; raises NetkfError if none is finite."""
    whitened = [one.whitened for one in recorded]
    nis = np.array([float(one @ one) for one in whitened])
    if not np.isfinite(nis).any():
        raise NetkfError(
            "there are no readings, or the filter gives no covariance to judge them by"
        )
    return Innovations(
        times=np.array([one.time for one in recorded]),
        nodes=np.array([one.node for one in recorded], dtype=np.int64),
        rows=np.array([len(one) for one in whitened]),
        nis=nis,
        whitened=whitened,
        values=[one.value for one in recorded],
        deviations=[np.sqrt((one.root**2).sum(axis=1)) for one in recorded],
        log_density=-0.5 * (nis + [LOG_2PI * len(one) for one in whitened])
        - [float(np.log(np.diag(one.root)).sum()) for one in recorded],
        increments=sum(one.of_increments for one in recorded),
    )


def with_filter(scenario: Scenario, filtering: Any) -> Scenario:
    """Return a copy of a scenario with another [filter], in the same folder and topology."""
    copy = dataclasses.replace(scenario, filter=filtering)
    # These are no fields, so that replace() does not copy them.
    for name in ("_folder", "_trust", "topology"):
        if name in scenario.__dict__:
            copy.__dict__[name] = scenario.__dict__[name]
    return copy


def innovation_series(recorded: Innovations) -> dict[int, FloatArray]:
    """Return first components (M,) of whitened innovations by node with MIN_READINGS or more."""
    first_components = np.array([values[0] for values in recorded.whitened])
    series = {}
    for node in np.unique(recorded.nodes).tolist():
        values = first_components[(recorded.nodes == node) & np.isfinite(first_components)]
        if len(values) >= MIN_READINGS:
            series[node] = values
    return series


def autocorrelation(values: FloatArray, lags: int) -> FloatArray:
    """Return autocorrelations (lags,) from lag 1 on, relative to lag 0, of mean-free ``values``."""
    total = float(values @ values)
    return np.array([values[k:] @ values[:-k] for k in range(1, lags + 1)]) / max(total, 1e-300)


def autocorrelations(recorded: Innovations) -> tuple[dict[int, FloatArray], dict[int, int]]:
    """Return the autocorrelations (L,) of innovations by node, and the number of readings."""
    series = innovation_series(recorded)
    counts = {node: len(values) for node, values in series.items()}
    lags = min([MAX_LAG, *(count - 2 for count in counts.values())])
    return {node: autocorrelation(values, lags) for node, values in series.items()}, counts
