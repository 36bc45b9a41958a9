"""A finished run in memory: arrays first, pandas tables on request."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError, errors_under, quote
from netkf.core.extras import require
from netkf.core.fields import one_of, text
from netkf.core.notebook import NotebookTable
from netkf.core.wings import WINGS
from netkf.linalg.arrays import FloatArray
from netkf.trace.nees import BLUR, ROUNDING, blurred_from, errors, traces
from netkf.trace.schema import CODES, EVENT_COLUMNS, KINDS, state_columns

if TYPE_CHECKING:
    from collections.abc import Callable

    import pandas as pd

CERTAIN = 1e-14
"""Variances below this share of the largest one are rounding errors."""


@dataclass(frozen=True, eq=False, repr=False)
class Run(NotebookTable):
    """The samples and events of one run.

    times (T,), nodes (N,), x (T, n), xhat (T, N, n), P (T, N, n, n), nan where the filter gives no
    covariance, error (T, N, n), where nodes that estimate some blocks of the state have these
    (``scenario.views``), nan beyond them, and n is the largest number of their states.
    ``log`` holds the events as a structured array (trace.schema.EVENT). ``error`` is x - xhat; with
    ``exact_errors`` it has digits even where x and xhat are so large that their difference has lost
    them, else digits are lost from
    ``rounding_from`` on. ``status`` is complete, interrupted or diverged. ``sums`` holds the sums
    over all nodes that exchanges should conserve: at the start and at the last sample. Unless
    ``truth_known``, x is nan and tables have no columns of errors. ``stats`` holds the counts that
    the engine keeps of its own work. ``scenario`` is the ``netkf.Scenario`` that was simulated,
    None if it is unknown.
    """

    times: FloatArray
    nodes: tuple[int, ...]
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray
    log: np.ndarray
    seed: int
    replica: int
    engine: str
    status: str
    sums: dict[str, tuple[float, float]] = field(default_factory=dict)
    truth_known: bool = True
    exact_errors: bool = False
    stats: dict[str, int] = field(default_factory=dict)
    scenario: Any = None

    def __repr__(self) -> str:
        """Return one line: status, samples, nodes, states, events, seed and replica."""
        span = f"{self.times[0]:g} .. {self.times[-1]:g} s" if len(self.times) else "nothing"
        return (
            f"<netkf.Run: {self.status}, {len(self.times)} samples of {span}, {len(self.nodes)} "
            f"nodes, {self.x.shape[-1]} states, {len(self.log):,} events, seed {self.seed}, "
            f"replica {self.replica}>"
        )

    @cached_property
    def events(self) -> pd.DataFrame:
        """The table of events, with columns trace.schema.EVENT_COLUMNS."""
        import pandas as pd

        return pd.DataFrame(event_columns(self.log, self.replica, 0))

    @cached_property
    def states(self) -> pd.DataFrame:
        """The table of state samples, with columns trace.schema.state_columns."""
        import pandas as pd

        samples = StateSamples(self.times, self.x, self.xhat, self.P, self.error)
        views = None if self.scenario is None else self.scenario.views
        return pd.DataFrame(state_table(self.replica, self.nodes, samples, self.truth_known, views))

    @cached_property
    def sq_error(self) -> FloatArray:
        """The squared errors (T, N) of the samples, nan without known truth."""
        return errors(self.error, self.P)[0]

    @cached_property
    def nees(self) -> FloatArray:
        """The NEES (T, N) of the samples, nan where P is singular or the truth is unknown."""
        return errors(self.error, self.P)[1]

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of ``log``."""
        return hashlib.sha256(self.log.tobytes()).hexdigest()

    @cached_property
    def rounding(self) -> FloatArray:
        """The magnitude (T,) of the rounding error of ``error``: that of the numbers that the run
        computes with.
        """
        sizes = np.abs(self.error).max(axis=1) if self.exact_errors else np.abs(self.x)
        return np.asarray(ROUNDING * sizes.max(axis=1))

    @cached_property
    def rounding_from(self) -> float:
        """The first sample time in seconds at which the rounding error of ``error`` is not small
        against its standard deviation, inf if there is none.
        """
        one = self.x[None], self.P[None], self.error[None], np.array([len(self.times)])
        return float(blurred_from(self.times, *one, self.exact_errors)[0])

    def plot(self, figure: str = "error") -> Any:
        """Return a figure of the run as a matplotlib Figure, the one of ``netkf plot --figure``:
        overview, error, quantiles, ratios, network, plane, nees, nis, whiteness, age, links,
        stability, law, delivery, matrix, fate or losses. Raises ScenarioError for another name or
        without matplotlib.
        """
        return plot_by_name(self, figure)

    def to_xarray(self) -> Any:
        """Return the run as an ``xarray.Dataset`` with the dimensions time, node, state and event.

        x [time, state], xhat and error [time, node, state], P [time, node, state, other_state],
        sq_error and nees [time, node]; the columns of ``events`` as event_t, event_kind (codes
        with CF flag_meanings) and so on [event]; ``scenario`` is its TOML text; node has names
        and coordinates where nodes do. With ``[[plants]]`` entries of x have block and owner;
        where nodes estimate some of them x is [time, entry], and view [node, state] says which.
        Raises ScenarioError without xarray.
        """
        return WINGS.to_xarray(self)

    def to_stonesoup(self, start: Any = None) -> Any:
        """Return the run as objects of Stone Soup: ``truths``, ``detections`` and ``tracks``, each
        a set, from which its metrics can be computed.

        A ground truth path for each block of the state, one without ``[[plants]]``; a detection
        for each reading after time 0, with its measurement model; a track for each node and each
        block that it estimates, with ``metadata`` node, block and owner. ``start`` is the datetime
        of time 0, by default 2000-01-01; times are rounded to microseconds. Readings are those of
        the run, which is simulated again for them if they are drawn.
        Raises ScenarioError without Stone Soup, and for sample times nearer than a microsecond.
        """
        return WINGS.to_stonesoup(self, start)

    def _notebook_table(self) -> pd.DataFrame:
        import pandas as pd

        after = self.times > 0.0
        columns = {
            "RMS error": np.sqrt(self.sq_error[after].mean(axis=0)) if after.any() else np.nan,
            "mean trace P": traces(self.P[after]).mean(axis=0) if after.any() else np.nan,
        }
        return pd.DataFrame(columns, index=pd.Index(self.nodes, name="node"))

    def block(self, name: str, node: int | str, by: int | str | None = None) -> BlockSamples:
        """Return the samples of one block of ``[[plants]]``, the one called ``name`` that ``node``
        (id or name) owns or that all share, as the node ``by`` estimates it, by default ``node``.

        Raises ScenarioError for a block or a node that does not exist.
        """
        if self.scenario is None:
            rule, remedy = "is unknown for this run", "take a run that netkf.simulate returns"
            raise ScenarioError("scenario", rule, None, remedy)
        wanted = {"node": node, "by": node if by is None else by}
        ids = {key: self.scenario.topology.find(str(one)) for key, one in wanted.items()}
        for key, one in wanted.items():
            if ids[key] is None:
                raise ScenarioError(
                    key, "must be a node of the run", one, "give another id or name"
                )
        with errors_under("name"):
            place = self.scenario.layout.require(text("", name), ids["node"])
        k, first = self.nodes.index(ids["by"]), place.first
        if self.scenario.views is not None:
            found = np.flatnonzero(self.scenario.views[k] == first)
            if not found.size:
                rule, remedy = f"must estimate block {name!r}", "name one that does, as the owner"
                raise ScenarioError("by", rule, by, remedy)
            first = int(found[0])
        own = slice(first, first + place.n)
        return BlockSamples(
            times=self.times,
            x=self.x[:, place.entries],
            xhat=self.xhat[:, k, own],
            P=self.P[:, k, own, own],
            error=self.error[:, k, own],
        )

    def count(self, kind: str) -> int:
        """Return the number of events of a kind; raises ScenarioError for another word."""
        return int((self.log["kind"] == CODES[one_of(*KINDS)("kind", kind)]).sum())


class BlockSamples(NamedTuple):
    """T samples of one block of n states as one node estimates it: ``times`` (T,) in seconds, x,
    xhat and error = x - xhat (T, n), P (T, n, n).
    """

    times: FloatArray
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


def plot_by_name(result: Any, figure: str) -> Any:
    """Return a result's figure; raises ScenarioError for another name or without matplotlib."""
    require("matplotlib", "plot", "plot")
    return WINGS.draw(result, text("figure", figure))


def _categorical(codes: np.ndarray) -> Any:
    """Return the kinds of events with ``codes`` (K,) int8."""
    import pandas as pd

    return pd.Categorical.from_codes(codes, categories=pd.Index(KINDS))


def event_columns(
    rows: np.ndarray, replica: int, first: int, kinds: Callable[[np.ndarray], Any] = _categorical
) -> dict[str, Any]:
    """Return K EVENT ``rows`` as named columns (K,), those of EVENT_COLUMNS; ``replica`` is the
    number of the run and ``first`` the sequence number of the first row. ``kinds`` makes the column
    of kinds of their codes (K,) int8, places in KINDS.
    """
    kind = kinds(rows["kind"].astype(np.int8))
    run = np.full(len(rows), replica, dtype=np.int64)
    columns = {"run": run, "seq": np.arange(first, first + len(rows)), "kind": kind}
    return {name: columns[name] if name in columns else rows[name] for name in EVENT_COLUMNS}


def blurred_samples(run: Run, matrices: FloatArray) -> np.ndarray:
    """Return a mask (T, N) of the samples that tests of consistency leave out, since rounding blurs
    them: the rounding error exceeds 1 / BLUR of the standard deviation in some direction.

    ``matrices`` (T, N, n, n) are the covariances of the errors. Directions without uncertainty
    (variances below the share CERTAIN of the largest one) and matrices of nan do not count.
    """
    if not run.rounding.any():
        return np.zeros(matrices.shape[:2], dtype=bool)
    finite = np.asarray(np.isfinite(matrices).all(axis=(2, 3)))
    variances = np.linalg.eigvalsh(np.where(finite[..., None, None], matrices, 0.0))
    uncertain = variances > CERTAIN * variances[..., -1:]
    # The least variance that is not 0 up to rounding.
    smallest = np.where(uncertain, variances, np.inf).min(axis=-1)
    return np.asarray((BLUR * run.rounding[:, None]) ** 2 > smallest)


class StateSamples(NamedTuple):
    """T samples of N filters at ``times`` (T,) in seconds: x (T, n), xhat and error = x - xhat
    (T, N, n), P (T, N, n, n).
    """

    times: FloatArray
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


def state_table(
    replica: int,
    nodes: tuple[int, ...],
    samples: StateSamples,
    truth_known: bool = True,
    views: tuple[np.ndarray, ...] | None = None,
) -> dict[str, Any]:
    """Return T samples of N ``nodes`` (ids) as named columns (T N,), those of
    trace.schema.state_columns, with a row for each time and node; ``replica`` is the number of the
    run. They are the table of states that is stored and that ``Run.states`` returns.

    Without known truth there are no columns of errors. ``views`` are the entries of the state that
    each node estimates, if not all: the columns are those of the node with most, nan in others.
    """
    times, x, xhat, P, error = samples
    count, n = len(nodes), xhat.shape[2]
    rows = len(times) * count
    upper = np.triu_indices(n)
    sq_error, nees = errors(error, P)
    values = [
        np.full(rows, replica, dtype=np.int64),
        np.repeat(times, count),
        np.tile(np.array(nodes, dtype=np.int64), len(times)),
        *states_of_nodes(x, count, n, views).reshape(rows, n).T,
        *xhat.reshape(rows, n).T,
        *P[:, :, upper[0], upper[1]].reshape(rows, -1).T,
        sq_error.reshape(rows),
        nees.reshape(rows),
    ]
    table = dict(zip(state_columns(n), values, strict=True))
    if not truth_known:
        del table["sq_error"], table["nees"]
    return table


def states_of_nodes(
    x: FloatArray, count: int, n: int, views: tuple[np.ndarray, ...] | None
) -> FloatArray:
    """Return the true states (T, N, n) that each of N = ``count`` nodes estimates, from those x
    (T, m) of the plant: all, or the entries ``views``, nan in others.
    """
    if views is None:
        return np.repeat(x[:, None], count, axis=1)
    seen = np.full((len(x), count, n), np.nan)
    for k, view in enumerate(views):
        seen[:, k, : len(view)] = x[:, view]
    return seen


def first_difference(a: Run | pd.DataFrame, b: Run | pd.DataFrame) -> str | None:
    """Return one line about the first event in which two runs differ; None if all are equal.

    Takes runs or event tables; nan equals nan.
    """
    for argument in (a, b):
        if not isinstance(argument, Run) and not hasattr(argument, "iloc"):
            message = f"first_difference takes runs or their event tables, got {quote(argument)}"
            raise TypeError(message)
    one, other = (t.events if isinstance(t, Run) else t for t in (a, b))
    names = [name for name in EVENT_COLUMNS if name not in ("run", "seq")]
    row = _first_different_row(one, other, names)
    if row == len(one) == len(other):
        return None
    descriptions = [
        " ".join(f"{k}={v}" for k, v in t[names].iloc[row].dropna().items() if v != -1)
        if row < len(t)
        else "no event"
        for t in (one, other)
    ]
    return f"event {row}: {descriptions[0]} | {descriptions[1]}"


def _first_different_row(one: pd.DataFrame, other: pd.DataFrame, names: list[str]) -> int:
    """Return the first row in which the columns ``names`` differ; nan equals nan."""
    shorter = min(len(one), len(other))
    differs = np.zeros(shorter, dtype=bool)
    for name in names:
        left, right = (np.asarray(t[name].to_numpy()[:shorter]) for t in (one, other))
        unequal = left != right
        if left.dtype.kind == "f":
            unequal &= ~(np.isnan(left) & np.isnan(right))
        differs |= unequal.astype(bool)
    return int(np.argmax(differs)) if differs.any() else shorter
