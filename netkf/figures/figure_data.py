"""The data of figures: one run or many of a scenario, reduced to arrays over time and node."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from netkf.checks.innovations import Innovations, compute_innovations
from netkf.core.errors import ScenarioError
from netkf.core.printable import count_phrase
from netkf.ensembles.monte_carlo import Ensemble
from netkf.ensembles.summary import mean_bounds
from netkf.linalg.arrays import FloatArray
from netkf.runs.quantities import traffic
from netkf.runs.run import CompletedRun
from netkf.runs.summary import (
    NO_COVARIANCE,
    PromisedTraces,
    SummarySink,
    node_rows,
    promise_traces,
    select_averaged_samples,
    summarise,
)
from netkf.scenario.scenario import Scenario
from netkf.trace.messages import join_messages
from netkf.trace.nees import traces
from netkf.trace.run import Run

SIMULATE = "get it from netkf.simulate, netkf.monte_carlo or netkf.open; a verdict has verdict.png"
NO_TRUTH = "There is no ground truth in this run, so that its errors are unknown."


class UnavailableError(Exception):
    """A figure cannot be drawn from this result; the message is a sentence with the reason."""


@dataclass(frozen=True, eq=False)
class FigureData:
    """One run of a scenario, or the means over ``runs`` runs, at T sample times of N nodes.

    times                      : (T,) seconds
    sq_error, trace, nees      : (T, N) squared errors, traces of P, NEES, nan if unknown; of an
                                 ensemble their means over runs
    node_averages              : averages over time of each node, as in summary.json
    status                     : how the runs ended, as in manifest.json
    diverged                   : number of runs of an ensemble that diverged
    rounding_from              : time (s) from which on rounding blurs errors, else inf
    se_error, se_trace, se_nees: (T, N) standard errors of those means, None for a single run
    first_component            : (T, N) first component of the estimates, None for an ensemble
    delivered                  : messages delivered over each link, by its two nodes
    messages                   : counts of messages, as in summary.json
    run                        : the run with its events, None if it is not at hand
    """

    scenario: Scenario
    times: FloatArray
    sq_error: FloatArray
    trace: FloatArray
    nees: FloatArray
    node_averages: list[dict[str, Any]]
    promised: PromisedTraces
    seed: int
    status: str
    runs: int = 1
    diverged: int = 0
    rounding_from: float = np.inf
    se_error: FloatArray | None = None
    se_trace: FloatArray | None = None
    se_nees: FloatArray | None = None
    first_component: FloatArray | None = None
    delivered: dict[tuple[int, int], int] = field(default_factory=dict)
    messages: dict[str, Any] = field(default_factory=dict)
    run: Run | None = None

    @property
    def nees_unit(self) -> tuple[int, Any]:
        """The expected NEES, and its divisor: n and 1, or 1 and n (N,) if sizes differ."""
        sizes = self.scenario.sizes
        return (int(sizes[0]), 1.0) if np.ptp(sizes) == 0 else (1, sizes)

    @property
    def unit(self) -> str:
        """The unit of the states, for labels, in which a dollar sign is no formula."""
        return self.scenario.unit.replace("$", r"\$")

    @property
    def nodes(self) -> tuple[int, ...]:
        """The ids of the N nodes."""
        return self.scenario.nodes

    @property
    def shows_errors(self) -> bool:
        """True if there is ground truth, so that errors are known."""
        return self.scenario.plant.truth_known

    @cached_property
    def innovations(self) -> Innovations:
        """The innovations of the run, replayed once for all figures; raises NetkfError."""
        assert self.run is not None
        return compute_innovations(self.run)

    @cached_property
    def has_sensor(self) -> np.ndarray:
        """(N,) bool: True for nodes with a sensor."""
        return np.array([node in self.scenario.placed_sensors for node in self.nodes])

    @cached_property
    def averaged(self) -> np.ndarray:
        """Indices (K,) of the K samples that averages of errors are taken over."""
        diverged = self.status == "diverged" and self.runs == 1
        return select_averaged_samples(self.times, self.rounding_from, diverged).errors

    @property
    def log(self) -> np.ndarray:
        """The E events of the run as EVENT rows (E,); raises UnavailableError if there are none."""
        if self.run is None:
            raise UnavailableError(
                "Only single runs have events: draw one of them, netkf.open(DIR).replica(0)."
            )
        if not len(self.run.log):
            raise UnavailableError("There are no events: none occurred, or none were recorded.")
        return self.run.log

    @cached_property
    def joined(self) -> np.ndarray:
        """The MESSAGE rows (M,) of the run, once for all figures; raises UnavailableError."""
        return join_messages(self.log)

    def require_samples(self) -> None:
        """Raise UnavailableError unless there are samples."""
        if not len(self.times):
            raise UnavailableError("There are no samples: none was taken, or none were recorded.")

    def require_truth(self) -> None:
        """Raise UnavailableError without ground truth."""
        if not self.shows_errors:
            raise UnavailableError(NO_TRUTH)

    def require_covariance(self) -> None:
        """Raise UnavailableError unless the filter gives covariances."""
        if not np.isfinite(self.trace).any():
            raise UnavailableError(f"{NO_COVARIANCE[0].upper()}{NO_COVARIANCE[1:]}.")

    @property
    def count_text(self) -> str:
        """The number of runs and their seed as text, such as ``1 run, seed 3``."""
        if self.runs == 1:
            replica = f", replica {self.run.replica}" if self.run and self.run.replica else ""
            return f"1 run, seed {self.seed}{replica}"
        return f"{self.runs:,} runs, seed {self.seed}"

    def caption(self, *sentences: str, notes: str = "") -> list[str]:
        """Return the paragraphs of a caption: the runs, the ``sentences``, and ``notes`` on
        assumptions that are not met, on the "bound" on P, on "nees", or on "both".
        """
        n = len(self.nodes)
        origin = f"{self.scenario.name}: {count_phrase(n, 'node')}, {self.count_text}."
        rounding = ""
        if np.isfinite(self.rounding_from) and self.shows_errors:
            rounding = f"Rounding of a large state blurs errors from {self.rounding_from:g} s on."
        paragraph = " ".join(filter(None, (origin, self.ending, rounding, *sentences)))
        departures = [(note, "nees" if "NEES" in note else "bound") for note in self.promised.notes]
        return [paragraph, *(f"Note: {n}." for n, kind in departures if notes in (kind, "both"))]

    @property
    def ending(self) -> str:
        """Sentences on runs that ended early, empty if all ended as planned."""
        last = f"{self.times[-1]:g}" if len(self.times) else "0"
        horizon = f"{self.scenario.horizon:g} s"
        if self.runs > 1:
            sentences = []
            if self.diverged:
                sentences.append(
                    f"{self.diverged:,} of {self.runs:,} runs diverged and ended early."
                )
            if self.status in ("interrupted", "failed"):
                sentences.append(f"The ensemble was {self.status}: these are its finished runs.")
            return " ".join(sentences)
        if self.status == "diverged":
            return f"It diverged and ended at {last} s of {horizon}."
        if self.status in ("interrupted", "failed"):
            return f"It was {self.status}: the last sample is at {last} s of {horizon}."
        return ""

    def title(self, headline: str) -> str:
        """Return the ``headline`` of a figure, after a word if the run ended early."""
        prefixes = {"diverged": "Diverged: ", "interrupted": "Interrupted: ", "failed": "Failed: "}
        if self.status == "diverged" and self.runs > 1:
            return headline  # some runs diverged: the caption says how many
        return prefixes.get(self.status, "") + headline


def reduce_result(result: Any) -> FigureData:
    """Return the data to draw of a run or an ensemble; raises ScenarioError."""
    if not isinstance(result, (Run, Ensemble)):
        rule = "plot takes a run, an ensemble, a sweep, compared filters or fitted laws of losses"
        raise ScenarioError("", rule, type(result).__name__, SIMULATE)
    if result.scenario is None:
        raise ScenarioError("", "plot needs to know the scenario", result, SIMULATE)
    if isinstance(result, Run):
        return _reduce_run(result)
    return reduce_ensemble(result.scenario, result, promise_traces(result.scenario, result.times))


def _reduce_run(run: Run) -> FigureData:
    # The sink collects the samples as it does while a run is simulated.
    sink = SummarySink()
    sink.exact_errors = run.exact_errors
    sink.events(run.log)
    sink.states(run.times, run.x, run.xhat, run.P, run.error)
    stored_summary = getattr(run, "summary", None)
    if stored_summary is not None:
        # Stored errors have more digits than x - xhat of the stored states.
        sink.sq_error, sink.nees = list(run.sq_error), list(run.nees)
        sink.rounding_from = stored_summary.get("rounding_from")
    promised = promise_traces(run.scenario, run.times)
    messages = {
        "sent": run.count("send"),
        "delivered": run.count("deliver"),
        "lost": run.count("lost") + run.count("late"),
    }
    summary = stored_summary or summarise(
        run.scenario, sink, promised, messages, traffic(run.scenario, sink.transmissions)
    )
    return collect_figure_data(
        run.scenario, sink, promised, summary, seed=run.seed, status=run.status, run=run
    )


def reduce_completed_run(scenario: Scenario, completed: CompletedRun) -> FigureData:
    """Return the data to draw of a run that was just written, for its run.png."""
    status = "diverged" if completed.samples.diverged else completed.status
    parts = completed.samples, completed.promised, completed.summary
    return collect_figure_data(scenario, *parts, seed=scenario.seed, status=status)


def collect_figure_data(
    scenario: Scenario,
    sink: SummarySink,
    promised: PromisedTraces,
    summary: dict[str, Any],
    **attributes: Any,
) -> FigureData:
    """Return the data of one run from ``sink``, ``promised`` bounds and limits, and a summary."""
    shape = len(sink.times), len(scenario.nodes)
    error, trace, nees, first_component = (
        np.array(values, dtype=np.float64).reshape(shape)
        for values in (sink.sq_error, sink.trace, sink.nees, sink.first_component)
    )
    return FigureData(
        scenario=scenario,
        times=np.array(sink.times),
        sq_error=error,
        trace=trace,
        nees=nees,
        node_averages=summary["nodes"],
        promised=promised,
        rounding_from=np.inf if sink.rounding_from is None else sink.rounding_from,
        first_component=first_component,
        delivered=sink.delivered.counts(),
        messages=summary["messages"],
        **attributes,
    )


def reduce_ensemble(scenario: Scenario, ensemble: Ensemble, promised: PromisedTraces) -> FigureData:
    """Return the data of an ensemble: means over runs (T, N) with standard errors."""
    return FigureData(
        scenario=scenario,
        times=ensemble.times,
        sq_error=traces(ensemble.mean_error),
        trace=traces(ensemble.mean_P),
        nees=ensemble.mean_nees,
        node_averages=node_rows(
            scenario, ensemble.average, mean_bounds(scenario, promised), ensemble.se_average
        )[:-1],
        promised=promised,
        seed=ensemble.seed,
        # Only ensembles that were read from a directory have a status.
        status=getattr(ensemble, "status", "diverged" if ensemble.diverged else "complete"),
        runs=int(ensemble.runs.max(initial=0)),
        diverged=ensemble.diverged,
        rounding_from=ensemble.rounding_from,
        # The standard error of a trace is at most the sum of the standard errors of the diagonal.
        se_error=traces(ensemble.se_error),
        se_trace=traces(ensemble.se_P),
        se_nees=ensemble.se_nees,
        messages=dict(ensemble.messages),
    )
