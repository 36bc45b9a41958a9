"""Statistics of finished blocks on disk, from which runs are resumed and merged, with the traces of
single runs; in the folder ``blocks`` of a run directory.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from netkf.ensembles.block_files import (
    TRACED,
    BlockFiles,
    RunIdentity,
    node_of,
    open_block,
    outermost,
)
from netkf.ensembles.moments import Moments
from netkf.ensembles.replicas import Node
from netkf.ensembles.statistics import MESSAGES, PARTS, RunStatistics, Trace, merge
from netkf.runs.documents import DamagedError
from netkf.runs.files import BLOCKS_FOLDER
from netkf.runs.quantities import ensemble_names
from netkf.scenario.scenario import Scenario
from netkf.trace.schema import EVENT


class BlockCheckpoints(BlockFiles):
    """Statistics of the finished blocks of a directory of runs."""

    def __init__(self, directory: Path, scenario: Scenario) -> None:
        super().__init__(directory / BLOCKS_FOLDER, merge)
        self._scenario = scenario

    def add(
        self, node: Node, value: RunStatistics, identity: RunIdentity, seconds: float
    ) -> RunStatistics:
        """Take the statistics of a block; return them without traces, which fill the memory."""
        super().add(node, value, identity, seconds)
        return value._replace(traces=())

    def load(self, node: Node) -> RunStatistics:
        """Return a node's block, without traces; raises EngineError if it was damaged meanwhile."""
        with self._expect_block(node), open_block(self._path(node)) as arrays:
            return _restore_statistics(arrays)

    def pack(self, value: RunStatistics) -> dict[str, Any]:
        """Return the statistics of a block as arrays by name."""
        arrays: dict[str, Any] = {"totals": value.totals}
        moments = {name: getattr(value, name) for name in PARTS}
        moments |= {f"conserved_{name}": one for name, (one, _) in value.conserved.items()}
        for name, quantity in moments.items():
            arrays |= {f"{name}_{field}": getattr(quantity, field) for field in Moments._fields}
        for k, trace in enumerate(value.traces):
            arrays |= {f"trace_{k}_{field}": getattr(trace, field) for field in Trace._fields}
        texts = {
            "conserved": {name: drift for name, (_, drift) in value.conserved.items()},
            "rounding_from": value.rounding_from,
            "fingerprint": value.fingerprint,
            "traces": len(value.traces),
        }
        return {**arrays, "words": np.array(json.dumps(texts))}

    def unpack(self, arrays: Any) -> RunStatistics:
        """Return the statistics of a block with their traces."""
        count = int(_read_texts(arrays)["traces"])
        traces = tuple(self._restore_trace(arrays, k) for k in range(count))
        return _restore_statistics(arrays)._replace(traces=traces)

    def require_fit(self, arrays: Any, stored: dict[str, Any]) -> int:
        """Return the number of runs; raises DamagedError unless form and numbers are right."""
        value = _restore_statistics(arrays)
        if not self._has_form(value):
            raise DamagedError("does not fit the scenario")
        if not self._has_numbers(value):
            raise DamagedError("lacks numbers that every run has")
        start, size, runs = (int(stored[key]) for key in ("start", "size", "runs"))
        kept = len(range(start, min(start + size, runs, TRACED[stored["trace"]])))
        if _read_texts(arrays)["traces"] != kept:
            raise DamagedError("lacks events of its runs")
        return value.runs

    def readable(self, scenario_digest: str, seed: int) -> list[RunStatistics]:
        """Return the statistics of all blocks of runs of a scenario (by its digest) and ``seed``
        that can be read, in order, whatever installation made them; nothing is removed.

        They serve to show the results of an interrupted ensemble, not to resume it.
        """
        found, statistics = [], []
        identity = {"scenario": scenario_digest, "seed": seed}
        for file in self.paths():
            with contextlib.suppress(DamagedError):
                start, size = node = node_of(file)
                self.check(file, {**identity, "start": start, "size": size})
                found.append(node)
        for node in outermost(found):
            with contextlib.suppress(DamagedError), open_block(self._path(node)) as arrays:
                statistics.append(_restore_statistics(arrays))
        return statistics

    def traces(self) -> Iterator[Trace]:
        """Yield the traces (events and samples of a run) that the blocks of this run have, in the
        order of replicas, also those not written; raises EngineError if a block is damaged.
        """
        pending = {(k << level, 1 << level): found for level, k, found in self._pending.nodes()}
        for node in sorted({*self._nodes, *pending}):
            if node in pending:
                yield from pending[node].traces
                continue
            file = self._path(node)
            with self._expect_block(node), open_block(file, verified=False) as arrays:
                for k in range(_read_texts(arrays)["traces"]):
                    yield self._restore_trace(arrays, k)

    def _has_form(self, statistics: RunStatistics) -> bool:
        """Return True if the arrays of ``statistics`` have the shapes and types they should."""
        count, n = len(self._scenario.nodes), self._scenario.width
        # Columns and rows of moments; those that are not listed have one row.
        columns = {"samples": count * (n * (n + 1) + 1), "averages": 3 * (count + 1)}
        rows = {"samples": len(self._scenario.times)}
        moments = [(getattr(statistics, name), name) for name in PARTS]
        moments += [(sums, "conserved") for sums, _ in statistics.conserved.values()]
        columns |= {"messages": len(MESSAGES), "conserved": 2}
        columns["quantities"] = len(ensemble_names(self._scenario)) * (count + 1)
        totals = statistics.totals.shape == (2,) and statistics.totals.dtype == np.int64
        return totals and all(
            quantity.mean.shape == quantity.M2.shape == (rows.get(name, 1), columns[name])
            and quantity.size.shape == (rows.get(name, 1),)
            and all(values.dtype == np.float64 for values in quantity)
            for quantity, name in moments
        )

    def _has_numbers(self, statistics: RunStatistics) -> bool:
        """Return True if ``statistics`` of the right form have no nan or impossible count."""
        n, u = self._scenario.width, self._scenario.width * (self._scenario.width + 1) // 2
        moments = [getattr(statistics, name) for name in PARTS]
        moments += [sums for sums, _ in statistics.conserved.values()]
        counts = [statistics.totals, *(quantity.size for quantity in moments)]
        # Of each node: P, squares of errors, and NEES, which a singular P leaves nan.
        columns = np.arange(statistics.samples.mean.shape[1]) % (n * (n + 1) + 1)
        exact = self._scenario.plant.truth_known and self._scenario.unknown_samples is None
        exact = exact and math.isinf(statistics.rounding_from)
        samples = columns < (2 * u if exact and not statistics.totals[1] else u)
        averages = np.arange(statistics.averages.mean.shape[1]) % 3 == 1  # traces of P
        # In slots transmissions are not counted.
        messages = np.arange(len(MESSAGES)) < len(MESSAGES) - self._scenario.slotted
        return (
            not math.isnan(statistics.rounding_from)
            and all((count >= 0).all() for count in counts)
            and all((quantity.size <= statistics.runs).all() for quantity in moments)
            and not any(
                np.isnan(values[quantity.size > 0][:, which]).any()
                for quantity, which in zip(moments, (samples, averages, messages), strict=False)
                for values in (quantity.mean, quantity.M2)
            )
        )

    def _restore_trace(self, arrays: Any, k: int) -> Trace:
        trace: Any = Trace(*(arrays[f"trace_{k}_{name}"] for name in Trace._fields))
        T, N, n = len(trace.times), len(self._scenario.nodes), self._scenario.width
        # replica, log, times, x, xhat, P, error
        states = (T, self._scenario.plant.n)
        shapes = [(), (len(trace.log),), (T,), states, (T, N, n), (T, N, n, n), (T, N, n)]
        types = [np.dtype(np.int64), EVENT, *[np.dtype(np.float64)] * 5]
        if [(field.dtype, field.shape) for field in trace] != list(zip(types, shapes, strict=True)):
            raise DamagedError("does not fit the scenario")
        return Trace(int(trace.replica), *trace[1:])


def _read_texts(arrays: Any) -> dict[str, Any]:
    texts: dict[str, Any] = json.loads(str(arrays["words"]))
    return texts


def _restore_statistics(arrays: Any) -> RunStatistics:
    def moments(name: str) -> Moments:
        return Moments(*(arrays[f"{name}_{field}"] for field in Moments._fields))

    texts = _read_texts(arrays)
    return RunStatistics(
        **{name: moments(name) for name in PARTS},
        totals=arrays["totals"],
        conserved={
            name: (moments(f"conserved_{name}"), float(d)) for name, d in texts["conserved"].items()
        },
        rounding_from=float(texts["rounding_from"]),
        fingerprint=str(texts["fingerprint"]),
        traces=(),
    )
