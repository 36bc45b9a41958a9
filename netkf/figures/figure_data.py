"""What figures draw: one run or many of a scenario, reduced to arrays over time and node."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.ensembles.monte_carlo import Ensemble
from netkf.linalg.arrays import FloatArray
from netkf.runs.innovations import Innovations, compute_innovations
from netkf.runs.run import CompletedRun
from netkf.runs.summary import (
    NO_COVARIANCE,
    PromisedTraces,
    SummarySink,
    promise_traces,
    select_averaged_samples,
    summarise,
)
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

SIMULATE = "get it from netkf.simulate, netkf.monte_carlo or netkf.open"
NO_TRUTH = "There is no ground truth in this run, so that its errors are unknown."
LEVEL = 1.96
"""Standard errors on both sides of a mean that make an interval of 95%."""


class UnavailableError(Exception):
    """A figure cannot be drawn of this run; the message is a sentence that says why."""


@dataclass(frozen=True, eq=False)
class Subject:
    """One run, or the means of ``runs`` runs, of a scenario.

    times (T,); sq_error, trace, nees (T, N): squared errors, traces of P, NEES, nan if unknown, in
    an ensemble their means over the runs with standard errors ``se_error``, ``se_trace``,
    ``se_nees``; ``first`` (T, N): first component of the estimates, without meaning in an ensemble;
    ``rows``: averages over time of the nodes, as in summary.json; ``ended``: what stopped it early.
    """

    scenario: Scenario
    times: FloatArray
    sq_error: FloatArray
    trace: FloatArray
    nees: FloatArray
    rows: list[dict[str, Any]]
    promised: PromisedTraces
    seed: int
    status: str
    runs: int = 1
    diverged: int = 0
    rounding_from: float = np.inf
    se_error: FloatArray | None = None
    se_trace: FloatArray | None = None
    se_nees: FloatArray | None = None
    first: FloatArray | None = None
    delivered: dict[tuple[int, int], int] = field(default_factory=dict)
    messages: dict[str, Any] = field(default_factory=dict)
    run: Run | None = None

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node ids."""
        return self.scenario.nodes

    @property
    def shows_errors(self) -> bool:
        """True if errors are known."""
        return self.scenario.plant.truth_known

    @cached_property
    def innovations(self) -> Innovations:
        """The innovations of the run, which is replayed once for all figures.

        Raises NetkfError where they cannot be computed.
        """
        assert self.run is not None
        return compute_innovations(self.run)

    @cached_property
    def sensing(self) -> np.ndarray:
        """(N,) bool: nodes with a sensor."""
        return np.array([node in self.scenario.placed_sensors for node in self.nodes])

    @cached_property
    def used(self) -> np.ndarray:
        """Indices of the samples that averages of errors are taken over."""
        diverged = self.status == "diverged" and self.runs == 1
        return select_averaged_samples(self.times, self.rounding_from, diverged).errors

    @property
    def log(self) -> np.ndarray:
        """Events as EVENT rows; raises UnavailableError if they were not kept."""
        if self.run is None:
            raise UnavailableError(
                "Events are those of single runs: draw one of them, netkf.open(DIR).replica(0)."
            )
        if not len(self.run.log):
            raise UnavailableError("There are no events: none happened, or none were kept.")
        return self.run.log

    def require_samples(self) -> None:
        """Raise UnavailableError unless there are samples."""
        if not len(self.times):
            raise UnavailableError("There are no samples: none was taken, or none were kept.")

    def require_truth(self) -> None:
        """Raise UnavailableError unless errors are known."""
        if not self.shows_errors:
            raise UnavailableError(NO_TRUTH)

    def require_covariance(self) -> None:
        """Raise UnavailableError unless the filter gives covariances."""
        if not np.isfinite(self.trace).any():
            raise UnavailableError(f"{NO_COVARIANCE[0].upper()}{NO_COVARIANCE[1:]}.")

    @property
    def count_text(self) -> str:
        """The number of runs and their seed in words."""
        if self.runs == 1:
            replica = f", replica {self.run.replica}" if self.run and self.run.replica else ""
            return f"1 run, seed {self.seed}{replica}"
        return f"{self.runs:,} runs, seed {self.seed}"

    def caption(self, *sentences: str, notes: str = "") -> list[str]:
        """Return the caption: the scenario, the runs, how they ended, more ``sentences``, and what
        differs from the papers where the figure shows the "bound", "nees", or "both".
        """
        n = len(self.nodes)
        about = f"{self.scenario.name}: {n} node{'s' if n > 1 else ''}, {self.count_text}."
        left_out = ""
        if np.isfinite(self.rounding_from) and self.shows_errors:
            left_out = f"Rounding of a large state blurs errors from {self.rounding_from:g} s on."
        whole = " ".join(filter(None, (about, self.ending, left_out, *sentences)))
        return [whole, *self._departures(notes)]

    @property
    def ending(self) -> str:
        """How the runs ended, if that was early; else empty."""
        last = f"{self.times[-1]:g}" if len(self.times) else "0"
        horizon = f"{self.scenario.horizon:g} s"
        if self.runs > 1:
            note = f"{self.diverged:,} of {self.runs:,} runs diverged and ended early."
            stopped = f"The ensemble was {self.status}: these are the runs that were kept."
            early = self.status in ("interrupted", "failed")
            return " ".join([note] * bool(self.diverged) + [stopped] * early)
        if self.status == "diverged":
            return f"It diverged and ended at {last} s of {horizon}."
        if self.status in ("interrupted", "failed"):
            return f"It was {self.status}: the last sample is at {last} s of {horizon}."
        return ""

    def _departures(self, about: str) -> list[str]:
        """Return sentences on how a run differs from the assumptions of its paper."""
        notes = [(note, "nees" if "NEES" in note else "bound") for note in self.promised.notes]
        return [f"Note: {note}." for note, kind in notes if about in (kind, "both")]

    def claim(self, statement: str) -> str:
        """Return a title that says first if the run did not end as planned."""
        broken = {"diverged": "Diverged: ", "interrupted": "Interrupted: ", "failed": "Failed: "}
        if self.status == "diverged" and self.runs > 1:
            return statement  # the caption says how many
        return broken.get(self.status, "") + statement


def subject_of(result: Any) -> Subject:
    """Return the data to draw of a ``netkf.Run`` or a ``netkf.Ensemble``.

    Raises ScenarioError for anything else, and if the scenario is not known.
    """
    if not isinstance(result, (Run, Ensemble)):
        raise ScenarioError("", "plot takes a run, an ensemble or a sweep", result, SIMULATE)
    if result.scenario is None:
        raise ScenarioError("", "plot needs to know the scenario", result, SIMULATE)
    return _of_run(result) if isinstance(result, Run) else _of_ensemble(result)


def _of_run(run: Run) -> Subject:
    """Return the subject of a run."""
    sink = SummarySink()
    sink.exact_errors = run.exact_errors
    sink.events(run.log)
    sink.states(run.times, run.x, run.xhat, run.P, run.error)
    stored = getattr(run, "summary", None)
    if stored is not None:  # what was written has more digits than x - xhat
        sink.sq_error, sink.nees = list(run.sq_error), list(run.nees)
        sink.rounding_from = stored.get("rounding_from")
    promised = promise_traces(run.scenario, run.times)
    sent = run.count("send")
    messages = {"sent": sent, "delivered": run.count("deliver")}
    messages["lost"] = run.count("lost") + run.count("late")
    summary = stored or summarise(run.scenario, sink, promised, messages)
    return subject_of_samples(
        run.scenario, sink, promised, summary, seed=run.seed, status=run.status, run=run
    )


def subject_of_completed(scenario: Scenario, completed: CompletedRun) -> Subject:
    """Return the data to draw of a run that was written to a directory just now."""
    status = "diverged" if completed.samples.diverged else completed.status
    return subject_of_samples(
        scenario,
        completed.samples,
        completed.promised,
        completed.summary,
        seed=scenario.seed,
        status=status,
    )


def subject_of_samples(
    scenario: Scenario,
    sink: SummarySink,
    promised: PromisedTraces,
    summary: dict[str, Any],
    **others: Any,
) -> Subject:
    """Return the data to draw of the samples of one run and its summary."""
    shape = len(sink.times), len(scenario.nodes)
    error, trace, nees, first = (
        np.array(values, dtype=np.float64).reshape(shape)
        for values in (sink.sq_error, sink.trace, sink.nees, sink.first_component)
    )
    return Subject(
        scenario,
        np.array(sink.times),
        error,
        trace,
        nees,
        summary["nodes"],
        promised,
        rounding_from=np.inf if sink.rounding_from is None else sink.rounding_from,
        first=first,
        delivered=sink.delivered,
        messages=summary["messages"],
        **others,
    )


def _of_ensemble(ensemble: Ensemble) -> Subject:
    """Return the subject of an ensemble."""
    scenario = ensemble.scenario
    assert scenario is not None
    promised = promise_traces(scenario, ensemble.times)
    return subject_of_ensemble(scenario, ensemble, promised)


def subject_of_ensemble(
    scenario: Scenario, ensemble: Ensemble, promised: PromisedTraces
) -> Subject:
    """Return the data to draw of an ensemble."""
    diverged = "diverged" if ensemble.diverged else "complete"
    return Subject(
        scenario,
        ensemble.times,
        np.trace(ensemble.mean_error, axis1=2, axis2=3),
        np.trace(ensemble.mean_P, axis1=2, axis2=3),
        ensemble.mean_nees,
        _rows(scenario, ensemble, promised),
        promised,
        ensemble.seed,
        getattr(ensemble, "status", diverged),
        runs=int(ensemble.runs.max(initial=0)),
        diverged=ensemble.diverged,
        rounding_from=ensemble.rounding_from,
        # The standard error of a trace is at most the sum of those of its terms.
        se_error=np.trace(ensemble.se_error, axis1=2, axis2=3),
        se_trace=np.trace(ensemble.se_P, axis1=2, axis2=3),
        se_nees=ensemble.se_nees,
        messages=dict(ensemble.messages),
    )


def _rows(scenario: Scenario, ensemble: Ensemble, promised: PromisedTraces) -> list[dict[str, Any]]:
    """Return the averages of the nodes over time, with standard errors."""
    after = ensemble.times > 0.0
    bound = None if promised.bound is None else promised.bound[after].mean(axis=0)
    rows = []
    for k, node in enumerate(scenario.nodes):
        square, trace, nees = ensemble.average[k].tolist()
        row: dict[str, Any] = {"node": node, "rms_error": float(np.sqrt(square))}
        row |= {"mean_trace": trace, "mean_nees": nees}
        row["mean_trace_se"] = float(ensemble.se_average[k, 1])
        row["mean_nees_se"] = float(ensemble.se_average[k, 2])
        row["bound"] = None if bound is None else float(bound[k])
        row["ratio"] = None if bound is None else trace / float(bound[k])
        row["ratio_se"] = None if bound is None else row["mean_trace_se"] / float(bound[k])
        rows.append(row)
    return rows
