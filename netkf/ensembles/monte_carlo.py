"""``netkf.monte_carlo``: an ensemble of runs, reduced as they come."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.fields import require_runs
from netkf.core.notebook import NotebookTable
from netkf.core.printable import count_phrase
from netkf.core.wings import WINGS
from netkf.ensembles.pools import PoolOptions
from netkf.ensembles.replicas import Progress, replicate_blocks
from netkf.ensembles.statistics import MESSAGES, RunStatistics, block_statistics, merge
from netkf.linalg.arrays import FloatArray, from_upper
from netkf.runs.failures import explain_failures
from netkf.runs.simulate import choose_engine, require_scenario
from netkf.scenario.scenario import Scenario
from netkf.trace.run import plot_by_name
from netkf.trace.schema import ensemble_columns

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class Ensemble(NotebookTable):
    """Means over many runs of one scenario, with standard errors; e = x - xhat is the error.

    times         : (T,) sample times in seconds
    nodes         : (N,) ids
    runs          : (T,) number of runs that have each sample; runs that diverge end early
    mean_P, mean_error, mean_nees : (T, N, n, n), (T, N, n, n), (T, N) means over runs of P, e e'
                    and NEES; P and NEES are nan if the filter gives no covariance
    se_P, se_error, se_nees : standard errors of these, entry by entry, nan for a single run
    average, se_average : (N + 1, 3) mean square error, mean trace of P and mean NEES over the
                    samples after time 0, of each node and, last, of all nodes; standard errors
    messages      : numbers of messages sent, delivered, lost and in flight at the end, and of
                    transmissions except in slots, in all runs
    diverged, events : number of runs that diverged, and of events in all runs
    fingerprint   : digest of the events of replica 0
    rounding_from : time in seconds from which rounding of the state blurs the errors, else inf:
                    from then on errors and NEES are nan, and left out of averages
    scenario      : the scenario that was simulated
    """

    times: FloatArray
    nodes: tuple[int, ...]
    runs: np.ndarray
    mean_P: FloatArray
    se_P: FloatArray
    mean_error: FloatArray
    se_error: FloatArray
    mean_nees: FloatArray
    se_nees: FloatArray
    average: FloatArray
    se_average: FloatArray
    messages: dict[str, int]
    diverged: int
    events: int
    seed: int
    engine: str
    fingerprint: str
    truth_known: bool = True
    rounding_from: float = np.inf
    scenario: Scenario | None = None

    def __repr__(self) -> str:
        runs = count_phrase(int(self.runs.max()), "run")
        return (
            f"<netkf.Ensemble: {runs}, {self.diverged:,} diverged, "
            f"{len(self.times)} samples, {len(self.nodes)} nodes, {self.mean_P.shape[-1]} states, "
            f"seed {self.seed}>"
        )

    def plot(self, figure: str = "error") -> Any:
        """Return a figure of the ensemble as a matplotlib Figure, as ``netkf plot`` draws it:
        overview, error, quantiles, ratios, network, nees, stability or law; those of single runs
        say so. Raises ScenarioError for another name or without matplotlib.
        """
        return plot_by_name(self, figure)

    def to_xarray(self) -> Any:
        """Return the ensemble as an ``xarray.Dataset``: mean_P, se_P, mean_error and se_error
        [time, node, state, other_state], mean_nees and se_nees [time, node], runs [time],
        averages over time [node] and of all nodes, and ``scenario``, its TOML text.
        Raises ScenarioError without xarray.
        """
        return WINGS.to_xarray(self)

    def _notebook_table(self) -> pd.DataFrame:
        import pandas as pd

        mean, error = self.average, self.se_average
        columns = {
            "RMS error": np.sqrt(mean[:, 0]),
            "mean trace P": mean[:, 1],
            "its standard error": error[:, 1],
            "NEES": mean[:, 2],
        }
        return pd.DataFrame(columns, index=pd.Index([*map(str, self.nodes), "all"], name="node"))

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per time and node, with the columns trace.schema.ensemble_columns."""
        import pandas as pd

        return pd.DataFrame(ensemble_table(self))


@np.errstate(under="ignore")
def monte_carlo(
    scenario: Scenario,
    runs: int,
    seed: int | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    engine: str = "auto",
    progress: Progress | None = None,
) -> Ensemble:
    """Simulate replicas 0 .. runs - 1 and return their means and standard errors.

    Replica 0 is the run of ``netkf.simulate(scenario, seed)``. The result is the same to the last
    bit for any number of ``workers`` (processes; by default this one, and as many as there are
    cores once that saves time), for any ``executor`` of concurrent.futures and for any Dask
    ``scheduler`` ("tcp://HOST:PORT"). ``progress(done, wanted)`` is called as runs complete.

    Raises ScenarioError for wrong arguments, and EngineError if the engine cannot run the scenario,
    a plugged-in class fails, or workers die again and again.
    """
    require_scenario(scenario, "monte_carlo", ", runs")
    chosen = choose_engine(engine, scenario)
    seed, count = scenario.seed if seed is None else seed, require_runs(runs)
    task, asked = partial(block_statistics, engine=chosen), (scenario, count, seed)
    pool = PoolOptions(workers, executor, scheduler)
    with explain_failures(scenario):
        together = chosen.together(scenario)
    merged = replicate_blocks(task, merge, *asked, pool=pool, progress=progress, together=together)
    return ensemble_of(scenario, merged, seed, chosen.name)


def ensemble_of(scenario: Scenario, statistics: RunStatistics, seed: int, engine: str) -> Ensemble:
    """Return the ensemble that the ``statistics`` of all runs of this ``seed`` describe."""
    # Columns of the samples: for each node the upper triangles of P and e e', and NEES.
    samples, shape = statistics.samples, (len(scenario.times), len(scenario.nodes), -1)
    means = np.where(samples.size[:, None] > 0.0, samples.mean, np.nan)
    n = scenario.width
    mean_P, mean_error, mean_nees = _unpack_samples(means.reshape(shape), n)
    se_P, se_error, se_nees = _unpack_samples(samples.standard_error().reshape(shape), n)
    for k, view in enumerate(scenario.views or ()):
        for matrices in (mean_P, mean_error, se_P, se_error):
            matrices[:, k, len(view) :] = matrices[:, k, :, len(view) :] = np.nan
    for errors in (mean_error, mean_nees, se_error, se_nees):
        errors[scenario.times >= statistics.rounding_from] = np.nan
    # Numbers of messages in all runs, from their means over runs.
    totals = (statistics.messages.mean[0] * statistics.messages.size).tolist()
    counts = dict(zip(MESSAGES, totals, strict=True))
    return Ensemble(
        times=scenario.times.copy(),
        nodes=scenario.nodes,
        runs=samples.size.astype(np.int64),
        mean_P=mean_P,
        se_P=se_P,
        mean_error=mean_error,
        se_error=se_error,
        mean_nees=mean_nees,
        se_nees=se_nees,
        average=statistics.averages.mean.reshape(-1, 3),
        se_average=statistics.averages.standard_error().reshape(-1, 3),
        messages={name: round(count) for name, count in counts.items() if np.isfinite(count)},
        diverged=int(statistics.totals[1]),
        events=int(statistics.totals[0]),
        seed=seed,
        engine=engine,
        fingerprint=statistics.fingerprint,
        truth_known=scenario.plant.truth_known,
        rounding_from=statistics.rounding_from,
        scenario=scenario,
    )


def _unpack_samples(values: FloatArray, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return means of P and of e e' (T, N, n, n) and of NEES (T, N) from ``values``."""
    P, error = np.split(values[..., :-1], 2, axis=-1)
    # Copied: of errors some are set to nan later.
    return from_upper(P, n), from_upper(error, n), values[..., -1].copy()


def ensemble_table(ensemble: Ensemble) -> dict[str, np.ndarray]:
    """Return the columns (T N,) of ensemble.parquet by name; without truth those of P alone."""
    n, rows = ensemble.mean_P.shape[-1], len(ensemble.times) * len(ensemble.nodes)
    i, j = np.triu_indices(n)

    def upper(values: FloatArray) -> list[FloatArray]:
        return list(values[:, :, i, j].reshape(rows, -1).T)

    columns = [
        np.repeat(ensemble.times, len(ensemble.nodes)),
        np.tile(np.array(ensemble.nodes, dtype=np.int64), len(ensemble.times)),
        np.repeat(ensemble.runs, len(ensemble.nodes)),
        *upper(ensemble.mean_P),
        *upper(ensemble.se_P),
        *upper(ensemble.mean_error),
        *upper(ensemble.se_error),
        ensemble.mean_nees.reshape(rows),
        ensemble.se_nees.reshape(rows),
    ]
    names = ensemble_columns(n)
    # Without ground truth: time, node, runs, and means and standard errors of P.
    column_count = len(names) if ensemble.truth_known else 3 + 2 * len(i)
    return dict(zip(names[:column_count], columns[:column_count], strict=True))
