"""The summary of a run: errors and covariances of each node next to the bounds of theory.

H(12) and H(13) are equations of paper H on the hybrid filter, see theory/README.md: the bound on
the mean of P over time, and its limit S for fast links.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy

from netkf.core.wings import WINGS
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import node_columns
from netkf.runs.failures import explain_failures
from netkf.runs.labels import covariance_notes
from netkf.runs.outcomes import PairCounter, Transmissions
from netkf.runs.quantities import NETWORK, quantity_rows, sample_names, sample_quantities
from netkf.scenario.scenario import Scenario
from netkf.trace.nees import blurred_from, errors, traces
from netkf.trace.recorder import Sink
from netkf.trace.schema import CODES

CONFIDENCE = 0.95
NORMAL_QUANTILE = 1.96
"""Standard deviations within which a normal variable lies with the probability CONFIDENCE."""


class SummarySink(Sink):
    """Reduces samples and events to the numbers that tables and pictures need.

    times           : T sample times in seconds
    sq_error, trace, nees, first_component : T arrays (N,) each: squared error, trace of P, NEES and
                      first component of the estimate
    delivered       : number of messages delivered over each link (i, j), i < j, both directions
    rounding_from   : time of the first sample whose errors are mostly rounding, because the state
                      is large (unstable plants over long horizons); None if there is none
    diverged        : nodes whose estimate or covariance was unusable at the last sample
    last            : x, xhat, P and error of the last two samples, arrays (2, ...)
    transmissions   : number of messages and transmissions of each node
    clipped         : number of numbers in messages that were clipped
    """

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.times: list[float] = []
        self.sq_error: list[FloatArray] = []
        self.trace: list[FloatArray] = []
        self.nees: list[FloatArray] = []
        self.first_component: list[FloatArray] = []
        self.delivered = PairCounter()
        self.rounding_from: float | None = None
        self.diverged: list[int] = []
        self.last: tuple[FloatArray, ...] = ()
        self.transmissions = Transmissions()
        self.clipped = 0

    def events(self, rows: np.ndarray) -> None:
        """Count the messages in a block ``rows`` (E,) of EVENT rows."""
        self.transmissions.add(rows)
        self.diverged += rows["node"][rows["kind"] == CODES["diverged"]].tolist()
        self.clipped += int(rows["message"][rows["kind"] == CODES["clip"]].sum())
        is_delivery = rows["kind"] == CODES["deliver"]
        node, peer = rows["node"][is_delivery], rows["peer"][is_delivery]
        self.delivered.add(np.minimum(node, peer), np.maximum(node, peer))

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Reduce a block of T samples of N nodes to values by node; P is not stored."""
        if not len(t):
            return
        sq_error, nees = errors(error, P)
        self.times += t.tolist()
        self.sq_error += list(sq_error)
        self.nees += list(nees)
        self.first_component += list(np.array(xhat[:, :, 0]))
        self.trace += list(traces(P))
        blocks = tuple(values[-2:].copy() for values in (x, xhat, P, error))
        pairs = zip(self.last or blocks, blocks, strict=True)
        self.last = tuple(np.concatenate(pair)[-2:] for pair in pairs)
        if self.rounding_from is None:
            one = x[None], P[None], error[None], np.array([len(t)])
            first = float(blurred_from(t, *one, self.exact_errors)[0])
            self.rounding_from = first if first < np.inf else None

    @property
    def has_covariance(self) -> bool:
        """True if the filter gives a covariance, or no sample was taken."""
        return not self.trace or any(np.isfinite(trace).any() for trace in self.trace)


NO_COVARIANCE = "the filter gives no covariance"


class SampleIndices(NamedTuple):
    """Indices of the samples to average errors and covariances over."""

    errors: np.ndarray
    covariances: np.ndarray


def select_averaged_samples(
    times: FloatArray, rounding_from: float, diverged: bool
) -> SampleIndices:
    """Return the samples of averages over time: those after time 0 (or all), without the last one
    of a run that ``diverged``.

    Errors from ``rounding_from`` on are left out because rounding dominates them, and covariances
    at the same times if the run diverged, because they grow without bound.
    """
    usable = times[: len(times) - 1] if diverged and len(times) > 1 else times
    after_start = usable > 0.0 if (usable > 0.0).any() else np.ones(len(usable), dtype=bool)
    exact = after_start & (usable < rounding_from)
    covariances = exact if diverged and exact.any() else after_start
    return SampleIndices(np.flatnonzero(exact), np.flatnonzero(covariances))


def chi_square_interval(freedom: Any, probability: float) -> tuple[FloatArray, FloatArray]:
    """Return the ends (M,) of intervals of chi-square variables over their ``freedom`` (M,), each
    with the given ``probability`` and equal tails.
    """
    tail = 0.5 * (1.0 - probability)
    low, high = (
        2.0 * scipy.special.gammaincinv(0.5 * freedom, q) / freedom for q in (tail, 1.0 - tail)
    )
    return np.asarray(low), np.asarray(high)


def nees_bounds(n: int, runs: int = 1, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the ends of the interval of the mean NEES of a sample over ``runs`` if P is exact."""
    low, high = chi_square_interval(runs * n, confidence)
    return n * float(low), n * float(high)


@dataclass(frozen=True, eq=False)
class PromisedTraces:
    """Traces of covariances that theory promises for a run.

    bound       : (T, N) traces of H(12) at the sample times; None if it does not apply
    limit       : trace of the limit S of H(13), nan if it does not exist
    central     : trace of the covariance of the centralised filter, nan if it does not exist
    reason      : why there is no bound, or empty
    limit_label : name of the limit in tables and pictures; empty if the hybrid paper, whose bound
                  and limit these are, is not about the filter
    notes       : sentences to print beside them
    """

    bound: FloatArray | None
    limit: float
    central: float
    reason: str
    limit_label: str = "limit S of Tanwani's H(13)"
    notes: tuple[str, ...] = ()

    @property
    def mean_bound(self) -> FloatArray | None:
        """The mean (T,) of the bound over nodes, None if it does not apply."""
        return None if self.bound is None else self.bound.mean(axis=1)


def promise_traces(scenario: Scenario, times: FloatArray) -> PromisedTraces:
    """Return the traces of theory at the samples; none of them without the theory wing."""
    with explain_failures(scenario):
        try:
            promised: PromisedTraces = WINGS.promise_traces(scenario, times)
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("netkf.theory"):
                raise
            reason = "not computed: netkf.theory is not installed"
            notes = covariance_notes(scenario)
            return PromisedTraces(None, np.nan, np.nan, reason, limit_label="", notes=notes)
    return promised


def summarise(
    scenario: Scenario,
    sink: SummarySink,
    promised: PromisedTraces,
    messages: dict[str, int],
    network: FloatArray | None = None,
) -> dict[str, Any]:
    """Return the summary of a run, as in summary.json: averages over time and quantities of nodes
    and of all, those of the ``network`` (N + 1, 6), and numbers of ``messages``.
    """
    rows = _average_rows(scenario, sink, promised)
    if network is not None:
        rows = [a | b for a, b in zip(rows, quantity_rows(NETWORK, network), strict=True)]
    *nodes, overall = rows
    sent = sink.transmissions.sent(scenario.nodes)
    transmissions = sink.transmissions.transmissions(scenario.nodes)
    for row, *counts in zip(nodes, sent, transmissions, strict=True):
        row["sent"], row["transmissions"] = counts
    overall["transmissions"] = sum(transmissions)
    return {
        "nodes": nodes,
        "overall": overall,
        "limit": promised.limit,
        "central": promised.central,
        "bound": promised.reason or "Tanwani's H(12), promised by H Theorem 2",
        "rounding_from": sink.rounding_from,
        "notes": [
            *summary_notes(scenario, sink.rounding_from, sink.has_covariance),
            *_clipping_notes(scenario, sink.clipped),
        ],
        "messages": {
            **messages,
            "transmissions": overall["transmissions"],
            "in_flight": messages["sent"] - messages["delivered"] - messages["lost"],
        },
    }


def _average_rows(
    scenario: Scenario, sink: SummarySink, promised: PromisedTraces
) -> list[dict[str, Any]]:
    """Return a row of averages over time for each node, and last that of all nodes together."""
    rounding_from = np.inf if sink.rounding_from is None else sink.rounding_from
    indices = select_averaged_samples(np.array(sink.times), rounding_from, bool(sink.diverged))
    mean_square = _mean_or_nan(sink.sq_error, indices.errors, scenario)
    trace = _mean_or_nan(sink.trace, indices.covariances, scenario)
    nees = _mean_or_nan(sink.nees, indices.errors, scenario)
    with np.errstate(all="ignore"):  # diverged runs
        bound = None
        if promised.bound is not None:
            bound = promised.bound[indices.covariances].mean(axis=0)
            bound = np.append(bound, bound.mean())
        nodes = np.column_stack([mean_square, trace, nees])
        rows = node_rows(scenario, np.vstack([nodes, nodes.mean(axis=0)]), bound)
    truth_known = scenario.plant.truth_known
    chosen = indices.errors if truth_known else indices.covariances
    squares = np.array(sink.sq_error if truth_known else sink.trace)
    squares = squares.reshape(-1, len(scenario.nodes))[chosen]
    quantities = quantity_rows(sample_names(scenario), sample_quantities(scenario, squares))
    rows = [a | b for a, b in zip(rows, quantities, strict=True)]
    if len(chosen):
        at = np.array(sink.times)[chosen][squares.argmax(axis=0)]
        for row, time in zip(rows, at.tolist(), strict=False):
            row["worst_at"] = time
        rows[-1]["worst_at"] = at[int(squares.max(axis=0).argmax())]
    return rows


def node_rows(
    scenario: Scenario, mean: FloatArray, bound: FloatArray | None, error: FloatArray | None = None
) -> list[dict[str, Any]]:
    """Return N + 1 rows of summary.json, of nodes and of all: ``mean`` (N + 1, 3) of square error,
    trace of P and NEES, standard errors ``error``, and the mean ``bound`` (N + 1,), if any.
    """
    with np.errstate(all="ignore"):  # ratios to a bound of 0
        rms = np.sqrt(mean[:, 0])
        columns = {"rms_error": rms, "mean_trace": mean[:, 1], "mean_nees": mean[:, 2]}
        if error is not None:
            columns["rms_error_se"] = np.where(rms == 0.0, 0.0, error[:, 0] / (2.0 * rms))
            columns |= {"mean_trace_se": error[:, 1], "mean_nees_se": error[:, 2]}
            # Roots do not say what they are of to the last bit.
            columns |= {"mean_sq_error": mean[:, 0], "mean_sq_error_se": error[:, 0]}
        if bound is not None:
            columns |= {"bound": bound, "ratio": mean[:, 1] / bound}
            columns |= {} if error is None else {"ratio_se": error[:, 1] / bound}
    empty = dict.fromkeys(("bound", "ratio") if error is None else ("bound", "ratio", "ratio_se"))
    rows = [
        {**empty, **dict(zip(columns, values, strict=True))}
        for values in zip(*(column.tolist() for column in columns.values()), strict=True)
    ]
    nodes = zip(scenario.nodes, rows[:-1], strict=True)
    return [*(node_columns(node) | row for node, row in nodes), rows[-1]]


def _mean_or_nan(values: list[FloatArray], indices: np.ndarray, scenario: Scenario) -> FloatArray:
    """Return the mean (N,) of those of T arrays ``values`` (N,) at ``indices``."""
    if not len(indices):
        return np.full(len(scenario.nodes), np.nan)
    with np.errstate(all="ignore"):
        return np.asarray(np.array(values)[indices].mean(axis=0))


def summary_notes(
    scenario: Scenario, rounding_from: float | None, has_covariance: bool
) -> list[str]:
    """Return notes on averages: rounding from a time (s) on, and whether the filter gives P."""
    notes = [] if has_covariance else [NO_COVARIANCE]
    if rounding_from is not None and scenario.plant.truth_known:
        notes.append(
            f"from {rounding_from:g} s on the state is so large that rounding blurs the errors: "
            "they and NEES are averaged over the samples before; shorten the horizon"
        )
    return notes


def _clipping_notes(scenario: Scenario, clipped: int) -> list[str]:
    if not clipped:
        return []
    limit = scenario.network.quantise.range if scenario.network.quantise is not None else math.nan
    numbers = "1 number was" if clipped == 1 else f"{clipped} numbers were"
    ends = f"-{limit:g} to {limit:g}"
    return [f"{numbers} with the dither beyond the range of messages, {ends}, and clipped"]
