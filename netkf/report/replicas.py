"""The recorded runs of an ensemble beside each other: which is the worst, and how they spread."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.printable import shorten
from netkf.ensembles.stored import StoredEnsemble
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import to_json_value
from netkf.runs.parquet_files import column_names, read_numbers
from netkf.runs.tables import format_number

RANKS = ("worst", "median")
"""Runs that can be asked for by their errors."""
QUANTILES = (0.5, 0.05, 0.95)
MAX_VALUES = 60_000
"""Numbers of a page that show how runs spread; larger networks go without."""


class Replicas(NamedTuple):
    """R recorded runs of an ensemble, with ground truth.

    numbers : (R,) of the replicas, in the order of their errors, the smallest first
    errors  : (R,) RMS error of all nodes over the samples after time 0
    spread  : (T, N, 3) median and 5 % and 95 % quantiles over the runs of |x - xhat|
    """

    numbers: np.ndarray
    errors: FloatArray
    spread: FloatArray

    def describe(self, number: int) -> str:
        """Return a replica with its rank, if it has one, and its error."""
        place = self.index_of(number)
        if place is None:
            return f"replica {number}"
        ranks = "".join(f"{rank}, " for rank in RANKS if self.index_of_rank(rank) == place)
        return f"replica {number} ({ranks}RMS error {format_number(float(self.errors[place]))})"

    def index_of_rank(self, rank: str) -> int:
        """Return the place in ``numbers`` of a rank, ``worst`` or ``median``."""
        return len(self.numbers) - 1 if rank == "worst" else (len(self.numbers) - 1) // 2

    def index_of(self, number: int) -> int | None:
        """Return the place in ``numbers`` of a replica, None if it was not recorded."""
        return next(iter(np.flatnonzero(self.numbers == number).tolist()), None)


def read_replicas(stored: StoredEnsemble) -> Replicas | None:
    """Return the recorded runs of an ensemble; None unless errors of several were kept."""
    path = stored.directory / "states.parquet"
    if not stored.summary or not path.exists() or "sq_error" not in column_names(path):
        return None
    states = read_numbers(path, ["run", "t", "node", "sq_error"], allow_empty=True)
    after = states[states["t"] > 0.0].groupby("run")["sq_error"].mean().dropna()
    if len(after) < 2:
        return None
    after = after.sort_values(kind="stable")
    by_sample = states.groupby(["t", "node"])["sq_error"].quantile(np.array(QUANTILES))
    shape = len(stored.times), len(stored.nodes), len(QUANTILES)
    size = shape[0] * shape[1] * shape[2]
    roots = np.sqrt(by_sample.to_numpy()) if len(by_sample) == size else np.full(size, np.nan)
    numbers = after.index.to_numpy().astype(int)
    return Replicas(numbers, np.sqrt(after.to_numpy()), roots.reshape(shape))


def choose_replica(
    stored: StoredEnsemble, found: Replicas | None, replica: int | str | None
) -> int | None:
    """Return the number of the ``replica`` asked for; raises ScenarioError."""
    if not isinstance(replica, str):
        return replica
    if replica not in RANKS:
        rule = f"must be a number, {' or '.join(RANKS)}"
        raise ScenarioError("replica", rule, replica, "correct it")
    if found is None:
        where, rule = shorten(Path(stored.directory)), "has not kept the errors of several runs"
        raise ScenarioError(where, rule, None, "run it with --trace full")
    return int(found.numbers[found.index_of_rank(replica)])


def describe_replica(shown: int, runs: int, replicas: Replicas | None) -> str:
    """Return which run of an ensemble moves on a page, and how to see another one."""
    sentence = f"The run that moves below is replica {shown} of {runs:,}"
    if replicas is None:
        return f"{sentence}; its trace is what was kept (--trace full keeps all)"
    place = replicas.index_of(shown)
    if place is not None:
        sentence += f", RMS error {format_number(float(replicas.errors[place]))}, number "
        sentence += f"{place + 1} from the best"
    ends = [
        f"{rank} is {replicas.numbers[k]} ({format_number(float(replicas.errors[k]))})"
        for rank, k in ((rank, replicas.index_of_rank(rank)) for rank in RANKS)
    ]
    return (
        f"{sentence}. Of {len(replicas.numbers):,} recorded runs the {', the '.join(ends)}: choose "
        "them at Run, below; netkf report --replica begins with any other"
    )


def spread_curves(replicas: Replicas | None, nodes: tuple[int, ...]) -> dict[str, Any] | None:
    """Return median, 5 % and 95 % of the errors of each node over time, as JSON values."""
    if replicas is None or replicas.spread.size > MAX_VALUES:
        return None
    return {
        str(node): [to_json_value(curve.tolist()) for curve in found.T]
        for node, found in zip(nodes, np.moveaxis(replicas.spread, 1, 0), strict=True)
    }
