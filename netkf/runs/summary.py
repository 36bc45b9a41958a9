"""The summary of a run: errors and covariances per node beside the bounds of theory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.labels import limit_label, mismatch_note, nees_note
from netkf.runs.transmissions import Transmissions
from netkf.scenario.scenario import Scenario
from netkf.theory import central_covariance, covariance_bound, limit_covariance
from netkf.theory.hybrid.coupled import reason_without_bound
from netkf.theory.hybrid.steady import has_steady_state
from netkf.trace.nees import errors
from netkf.trace.recorder import Sink
from netkf.trace.run import carried_size, rounding_from
from netkf.trace.schema import CODES

CONFIDENCE = 0.95
MAX_BOUND_BYTES, SERIES_TERMS = 1.5 * 2**30, 30
MAX_STEADY_ENTRIES = 100_000
"""Entries of the covariances of all nodes up to which a run looks for the steady state."""


class SummarySink(Sink):
    """Reduces samples to the numbers that tables and pictures need.

    times            : T sample times in seconds
    sq_error, trace, nees, first : for each of them (N,) squared error, trace of P, NEES and first
                       component of the estimate
    delivered        : messages delivered over each link, both directions together
    rounding_from    : time of the first sample whose errors rounding blurs because the state is too
                       large (unstable plants over long horizons); None without one
    diverged         : nodes whose estimate or covariance was not usable at the last sample
    """

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.times: list[float] = []
        self.sq_error: list[FloatArray] = []
        self.trace: list[FloatArray] = []
        self.nees: list[FloatArray] = []
        self.first: list[FloatArray] = []
        self.delivered: dict[tuple[int, int], int] = {}
        self.rounding_from: float | None = None
        self.diverged: list[int] = []
        self.transmissions = Transmissions()

    def events(self, rows: np.ndarray) -> None:
        """Count the messages of a block of EVENT rows."""
        self.transmissions.add(rows)
        self.diverged += rows["node"][rows["kind"] == CODES["diverged"]].tolist()
        arrived = rows[rows["kind"] == CODES["deliver"]]
        ends = np.sort(np.column_stack([arrived["node"], arrived["peer"]]), axis=1)
        pairs, counts = np.unique(ends, axis=0, return_counts=True)
        for (i, j), count in zip(pairs.tolist(), counts.tolist(), strict=True):
            self.delivered[i, j] = self.delivered.get((i, j), 0) + count

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Reduce a block of samples; P (T, N, n, n) is not kept."""
        if not len(t):
            return
        sq_error, nees = errors(error, P)
        self.times += t.tolist()
        self.sq_error += list(sq_error)
        self.nees += list(nees)
        self.first += list(np.array(xhat[:, :, 0]))
        self.trace += list(np.trace(P, axis1=2, axis2=3))
        if self.rounding_from is None:
            first = rounding_from(t, carried_size(x, error, self.exact_errors), P, error)
            self.rounding_from = first if first < np.inf else None

    @property
    def covariance_given(self) -> bool:
        """True if the filter gives a covariance, or no sample was taken."""
        return not self.trace or any(np.isfinite(trace).any() for trace in self.trace)

    @property
    def ended_finite(self) -> bool:
        """True if errors and covariances were finite at the last sample."""
        return bool(np.isfinite([self.sq_error[-1], self.trace[-1]]).all())


NO_COVARIANCE = "the filter gives no covariance"


class SampleIndices(NamedTuple):
    """Indices of the samples to average errors and covariances over."""

    errors: np.ndarray
    covariances: np.ndarray


def averaged_samples(times: FloatArray, rounding_from: float, diverged: bool) -> SampleIndices:
    """Return which of the samples at ``times`` (T,) are averaged.

    These are the samples after time 0 (all of them if there is none later), without the last sample
    of a run that ``diverged``. Errors that rounding blurs are left out, and so are the covariances
    at the same times if the run diverged, since they outgrow all bounds.
    """
    kept = times[: len(times) - 1] if diverged and len(times) > 1 else times
    after = kept > 0.0 if (kept > 0.0).any() else np.ones(len(kept), dtype=bool)
    clear = after & (kept < rounding_from)
    covariances = clear if diverged and clear.any() else after
    return SampleIndices(np.flatnonzero(clear), np.flatnonzero(covariances))


def nees_bounds(n: int, runs: int = 1) -> tuple[float, float]:
    """Return the interval that holds the mean NEES of one sample over ``runs`` runs with
    probability CONFIDENCE if P is exact: the sum is chi-square with ``runs n`` degrees of freedom.
    """
    ends = 0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)
    low, high = (2.0 * float(gammaincinv(0.5 * runs * n, end)) / runs for end in ends)
    return low, high


@dataclass(frozen=True, eq=False)
class PromisedTraces:
    """Traces that theory promises for a run.

    bound       : (T, N) traces of H(12) at the sample times; None if it does not apply
    limit       : trace of the limit S of H(13), nan if it does not exist
    central     : trace of the covariance of the centralised filter, nan if it does not exist
    reason      : why there is no bound, or empty
    limit_label : name of the limit in tables and pictures
    notes       : sentences to print beside them
    """

    bound: FloatArray | None
    limit: float
    central: float
    reason: str
    limit_label: str = "limit S of H(13)"
    notes: tuple[str, ...] = ()


def promise_traces(scenario: Scenario, times: FloatArray) -> PromisedTraces:
    """Return the bounds and limits of a scenario at the sample ``times`` (T,) of a run."""
    bound, reason = None, ""
    try:
        if len(times):
            _require_small_bound(scenario, len(times))
            bound = np.trace(covariance_bound(scenario, times), axis1=2, axis2=3)
    except TheoryError as error:
        reason = str(error)
    notes = (_steady_note(scenario), mismatch_note(scenario), nees_note(scenario))
    return PromisedTraces(
        bound,
        _trace_or_nan(limit_covariance, scenario),
        _trace_or_nan(central_covariance, scenario),
        reason or reason_without_bound(scenario) or "",
        limit_label(scenario),
        tuple(filter(None, notes)),
    )


def _require_small_bound(scenario: Scenario, samples: int) -> None:
    """Raise TheoryError if H(12) at all samples would take more memory than a large run itself."""
    if reason_without_bound(scenario):
        return
    n = scenario.plant.n
    entries = (samples * (1.5 * n * n + n) + SERIES_TERMS * n * (n + 1)) * len(scenario.nodes)
    if 8.0 * entries > MAX_BOUND_BYTES:
        raise TheoryError(
            f"not computed: H(12) of {len(scenario.nodes):,} nodes at {samples:,} samples takes "
            f"{8.0 * entries / 2**30:.1f} GiB; sample less often (probe), or call "
            "netkf.theory.covariance_bound"
        )


def _steady_note(scenario: Scenario) -> str:
    """Return a note if the bound on P has no steady state, or none that is known."""
    if scenario.slotted or reason_without_bound(scenario):
        return ""
    if len(scenario.nodes) * scenario.plant.n**2 > MAX_STEADY_ENTRIES:
        size = MAX_STEADY_ENTRIES // scenario.plant.n**2
        return (
            f"whether the bound has a steady state is not looked into beyond {size:,} nodes; see "
            "netkf theory"
        )
    try:
        if has_steady_state(scenario):
            return ""
    except TheoryError as error:
        return f"steady state of the bound: {error}"
    if not scenario.filter.algorithm.talks:
        return "at some nodes P has no steady state, it grows without end; see netkf theory"
    return "the bound has no steady state, it grows without end; see netkf theory"


def _trace_or_nan(function: Any, scenario: Scenario) -> float:
    """Return the trace of a promised matrix, nan if it is not promised."""
    try:
        return float(np.trace(function(scenario)))
    except TheoryError:
        return float("nan")


def summarise(
    scenario: Scenario, sink: SummarySink, promised: PromisedTraces, messages: dict[str, int]
) -> dict[str, Any]:
    """Return the summary of a run, as in summary.json.

    It has, per node and overall, the RMS error and the mean trace of P over time, the mean bound
    and their ratio, the mean NEES over the samples after time 0, and the messages sent and
    transmissions of each node; then the totals of messages. Errors and NEES leave out the samples
    that rounding blurs. Numbers are nan if there is no sample or no covariance.
    """
    nodes, overall = _average_rows(scenario, sink, promised)
    counts = sink.transmissions
    for row in nodes:
        row |= {"sent": counts.sent[row["node"]], "transmissions": counts.of(row["node"])}
    return {
        "nodes": nodes,
        "overall": overall,
        "limit": promised.limit,
        "central": promised.central,
        "bound": promised.reason or "H(12), promised by H Theorem 2",
        "rounding_from": sink.rounding_from,
        "notes": summary_notes(scenario, sink.rounding_from, sink.covariance_given),
        "messages": {
            **messages,
            "transmissions": counts.total,
            "in_flight": messages["sent"] - messages["delivered"] - messages["lost"],
        },
    }


def _average_rows(
    scenario: Scenario, sink: SummarySink, promised: PromisedTraces
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a row of averages over time for each node, and one for all nodes together."""
    blurred = np.inf if sink.rounding_from is None else sink.rounding_from
    used = averaged_samples(np.array(sink.times), blurred, bool(sink.diverged))
    square = _mean_or_nan(sink.sq_error, used.errors, scenario)
    trace = _mean_or_nan(sink.trace, used.covariances, scenario)
    nees = _mean_or_nan(sink.nees, used.errors, scenario)
    columns = [square, trace, nees]
    with np.errstate(all="ignore"):  # ratios to a bound of 0, and diverged runs
        if promised.bound is not None:
            columns.append(promised.bound[used.covariances].mean(axis=0))
        averages = _averages(*columns)
        means = _averages(*(np.array([column.mean()]) for column in columns))
    rows = zip(*averages.values(), strict=True)
    nodes = [
        {"node": node, **dict(zip(averages, row, strict=True))}
        for node, row in zip(scenario.nodes, rows, strict=True)
    ]
    return nodes, {name: value for name, (value,) in means.items()}


def _mean_or_nan(values: list[FloatArray], indices: np.ndarray, scenario: Scenario) -> FloatArray:
    """Return the mean (N,) of the samples at ``indices`` of T arrays (N,), nan without any."""
    if not len(indices):
        return np.full(len(scenario.nodes), np.nan)
    with np.errstate(all="ignore"):
        return np.asarray(np.array(values)[indices].mean(axis=0))


def summary_notes(
    scenario: Scenario, rounding_from: float | None, covariance_given: bool
) -> list[str]:
    """Return notes on the averages of a run or of an ensemble, one sentence each."""
    notes = [] if covariance_given else [NO_COVARIANCE]
    if rounding_from is not None and scenario.plant.truth_known:
        notes.append(
            f"from {rounding_from:g} s on the state is so large that rounding blurs the errors: "
            "they and NEES are averaged over the samples before; shorten the horizon"
        )
    return notes


def conserved_sums(sums: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """Return the sums over all nodes that exchanges should conserve: the exact value, the total at
    the last sample and its relative deviation.
    """
    return {
        name: {"exact": exact, "total": total, "drift": (total - exact) / exact}
        for name, (exact, total) in sums.items()
    }


def _averages(
    mean_square: FloatArray, trace: FloatArray, nees: FloatArray, bound: FloatArray | None = None
) -> dict[str, list[Any]]:
    """Return the averages of summary.json, a list of N numbers each; None without a bound."""
    none = [None] * len(trace)
    return {
        "rms_error": np.sqrt(mean_square).tolist(),
        "mean_trace": trace.tolist(),
        "bound": none if bound is None else bound.tolist(),
        "ratio": none if bound is None else (trace / bound).tolist(),
        "mean_nees": nees.tolist(),
    }
