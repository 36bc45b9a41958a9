"""What a run comes to: errors and covariances per node against what theory promises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.labels import limit_words, mismatch_words, nees_words
from netkf.runs.transmissions import Transmissions
from netkf.scenario.scenario import Scenario
from netkf.theory import central_covariance, covariance_bound, limit_covariance
from netkf.theory.hybrid.coupled import not_promised
from netkf.theory.hybrid.steady import has_steady_state
from netkf.trace.recorder import Sink
from netkf.trace.run import carried, errors, rounding_from
from netkf.trace.schema import CODES

CONFIDENCE = 0.95


class SummarySink(Sink):
    """Keeps per sample and node what tables and pictures need: squared error, trace of P, NEES, the
    ``first`` component of the estimate; and how many messages each node sent and each link
    delivered. ``rounding_from`` is the first sample at which the state is so large that rounding
    blurs the errors (unstable plants over long horizons, where errors are subtracted), ``diverged``
    are the nodes whose estimate or covariance was broken at the last one.
    """

    anywhere: ClassVar[bool] = True

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
        """Deliveries of each link are counted, both directions together."""
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
        """Reduced at once."""
        if not len(t):
            return
        sq_error, nees = errors(error, P)
        self.times += t.tolist()
        self.sq_error += list(sq_error)
        self.nees += list(nees)
        self.first += list(np.array(xhat[:, :, 0]))
        self.trace += list(np.trace(P, axis1=2, axis2=3))
        if self.rounding_from is None:
            first = rounding_from(t, carried(x, error, self.exact_errors), P, error)
            self.rounding_from = first if first < np.inf else None

    @property
    def covariance_given(self) -> bool:
        """Whether the filters give a covariance."""
        return not self.trace or any(np.isfinite(trace).any() for trace in self.trace)

    @property
    def ended_finite(self) -> bool:
        """Whether errors and covariances were finite at the last sample."""
        return bool(np.isfinite([self.sq_error[-1], self.trace[-1]]).all())


NO_COVARIANCE = "the filter gives no covariance"


class Used(NamedTuple):
    """Places of the samples that averages of errors and of covariances are over."""

    errors: np.ndarray
    covariances: np.ndarray


def averaged_samples(times: FloatArray, rounding_from: float, diverged: bool) -> Used:
    """Those after time 0, or all where none is; without the last one of a run that ``diverged``;
    of errors, and of covariances that outgrow all bounds, without those that rounding blurs.
    """
    kept = times[: len(times) - 1] if diverged and len(times) > 1 else times
    after = kept > 0.0 if (kept > 0.0).any() else np.ones(len(kept), dtype=bool)
    clear = after & (kept < rounding_from)
    covariances = clear if diverged and clear.any() else after
    return Used(np.flatnonzero(clear), np.flatnonzero(covariances))


def nees_bounds(n: int, runs: int = 1) -> tuple[float, float]:
    """Between which the mean NEES of one sample over the runs lies with CONFIDENCE where P is
    exact, since their sum is chi-square with ``runs n`` degrees of freedom.
    """
    ends = 0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)
    low, high = (2.0 * float(gammaincinv(0.5 * runs * n, end)) / runs for end in ends)
    return low, high


@dataclass(frozen=True, eq=False)
class Promise:
    """What H(12) and (13) say at the sample times; ``words`` says why where they say nothing.

    bound (T, N): trace of H(12); limit, central: traces of S and of the centralised covariance,
    nan where they do not exist; limit_words names the limit, notes are what to know about both.
    """

    bound: FloatArray | None
    limit: float
    central: float
    words: str
    limit_words: str = "limit S of H(13)"
    notes: tuple[str, ...] = ()


def promise(scenario: Scenario, times: FloatArray) -> Promise:
    """Computed for the sample times of a run."""
    bound, words = None, ""
    try:
        if len(times):
            bound = np.trace(covariance_bound(scenario, times), axis1=2, axis2=3)
    except TheoryError as error:
        words = str(error)
    return Promise(
        bound,
        _trace(limit_covariance, scenario),
        _trace(central_covariance, scenario),
        words or not_promised(scenario) or "",
        limit_words(scenario),
        tuple(
            filter(None, (word(scenario) for word in (_steady_note, mismatch_words, nees_words)))
        ),
    )


def _steady_note(scenario: Scenario) -> str:
    if scenario.slotted or not_promised(scenario) or has_steady_state(scenario):
        return ""
    if not scenario.filter.algorithm.talks:
        return "at some nodes P has no steady state, it grows without end; see netkf theory"
    return "the bound has no steady state, it grows without end; see netkf theory"


def _trace(function: Any, scenario: Scenario) -> float:
    try:
        return float(np.trace(function(scenario)))
    except TheoryError:
        return float("nan")


def summarise(
    scenario: Scenario, sink: SummarySink, promised: Promise, messages: dict[str, int]
) -> dict[str, Any]:
    """Per node and overall: time-averaged RMS error, mean trace of P, bound and their ratio, mean
    NEES over the samples after time 0 (errors and NEES without those that rounding blurs), messages
    that each node sent, and how often it transmitted; messages sent, delivered, lost and still on
    their way. Nan where there is no sample or no covariance.
    """
    blurred = np.inf if sink.rounding_from is None else sink.rounding_from
    used = averaged_samples(np.array(sink.times), blurred, bool(sink.diverged))
    places = (used.errors, used.covariances, used.errors)
    with np.errstate(all="ignore"):
        mean_square, trace, nees = (
            np.array(values)[kept].mean(axis=0)
            if len(kept)
            else np.full(len(scenario.nodes), np.nan)
            for kept, values in zip(places, (sink.sq_error, sink.trace, sink.nees), strict=True)
        )
        bound = None if promised.bound is None else promised.bound[used.covariances].mean(axis=0)
        nodes = [
            _row(node, mean_square[k], trace[k], None if bound is None else bound[k], nees[k])
            for k, node in enumerate(scenario.nodes)
        ]
        overall = _row(
            -1,
            mean_square.mean(),
            trace.mean(),
            None if bound is None else bound.mean(),
            nees.mean(),
        )
    del overall["node"]
    counts = sink.transmissions
    for row in nodes:
        row |= {"sent": counts.sent[row["node"]], "transmissions": counts.of(row["node"])}
    return {
        "nodes": nodes,
        "overall": overall,
        "limit": promised.limit,
        "central": promised.central,
        "bound": promised.words or "H(12), promised by H Theorem 2",
        "rounding_from": sink.rounding_from,
        "notes": notes_of(scenario, sink.rounding_from, sink.covariance_given),
        "messages": {
            **messages,
            "transmissions": counts.total,
            "in_flight": messages["sent"] - messages["delivered"] - messages["lost"],
        },
    }


def notes_of(scenario: Scenario, rounding_from: float | None, covariance_given: bool) -> list[str]:
    """What to know about the averages of a run or of an ensemble, a line each."""
    notes = [] if covariance_given else [NO_COVARIANCE]
    if rounding_from is not None and scenario.plant.shown:
        notes.append(
            f"from {rounding_from:g} s on the state is so large that rounding blurs the errors: "
            "they and NEES are averaged over the samples before; shorten the horizon"
        )
    return notes


def conserved(sums: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """What exchanges should conserve, summed over all nodes: exact, at the last sample, and how far
    that is off, relative to the exact value.
    """
    return {
        name: {"exact": exact, "total": total, "drift": (total - exact) / exact}
        for name, (exact, total) in sums.items()
    }


def _row(node: int, mean_square: Any, trace: Any, bound: Any, nees: Any) -> dict[str, Any]:
    return {
        "node": node,
        "rms_error": float(np.sqrt(mean_square)),
        "mean_trace": float(trace),
        "bound": None if bound is None else float(bound),
        "ratio": None if bound is None else float(trace / bound),
        "mean_nees": float(nees),
    }
