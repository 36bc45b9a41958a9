"""Finished blocks on disk, from which runs are resumed and merged: ``blocks/000000064-16.npz`` of a
run directory has the runs 64 to 79.

Each is a node of the binary tree over replicas. A block is used only if its last line is the digest
of all bytes before it, and the identity inside (run, replicas, installation) is that of the run.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import platform
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from netkf.core.errors import EngineError
from netkf.ensembles.merge_tree import MergeTree
from netkf.ensembles.moments import Moments
from netkf.ensembles.pool import MAX_BLOCK
from netkf.ensembles.replicas import Node
from netkf.ensembles.statistics import MESSAGES, RunStatistics, Trace, merge
from netkf.runs.documents import MAX_COUNT, DamagedError, reading_file
from netkf.runs.files import BLOCKS_FOLDER, write_atomically, writing_file
from netkf.runs.provenance import machine, versions
from netkf.runs.quantities import ensemble_names
from netkf.scenario.scenario import Scenario
from netkf.trace.schema import EVENT

PARTS = (
    "samples",
    "averages",
    "messages",
    "quantities",
)  # attributes of RunStatistics that are Moments
MARK = b"\nsha256 "  # begins the last line of a block's file
SEAL_BYTES = len(MARK) + 64  # length of that line, with the SHA-256 in hexadecimal
CHUNK = 1 << 20  # bytes hashed at once
MAX_TRACED_BLOCK = 8
"""Largest number of runs in a block where all runs leave a trace: their events are in memory."""
TRACED = {"full": MAX_COUNT, "first": 1, "none": 0}
"""Number of the first runs that leave a trace, by the option ``trace``."""
FIRST_WRITE, WRITE_SHARE = 10.0, 0.2
"""Results are merged in memory and written after so many seconds, and then whenever a further share
of the time until then has passed: a command that is killed loses no more.
"""


@dataclass(frozen=True)
class RunIdentity:
    """The values that blocks must share to be merged.

    scenario : digest of the resolved scenario with its files
    seed, runs : seed and number of runs
    trace, engine : options of the command
    """

    scenario: str
    seed: int
    runs: int
    trace: str
    engine: str

    @property
    def traces(self) -> int:
        """Number of replicas that leave a trace."""
        return min(self.runs, TRACED[self.trace])

    @property
    def max_block(self) -> int:
        """Largest number of replicas in a block."""
        return MAX_TRACED_BLOCK if self.trace == "full" else MAX_BLOCK

    def runs_of(self, node: Node) -> int:
        """Return the number of runs of a node, which may reach beyond the last one."""
        return min(sum(node), self.runs) - node[0]

    def of(self, node: Node) -> dict[str, Any]:
        """Return the identity of the block of a node, if its runs are simulated here."""
        names = {"start": node[0], "size": node[1]}
        return {**asdict(self), **names, "versions": versions(), "machine": machine()}


class BlockCheckpoints:
    """Statistics of the finished blocks, one file each, written atomically."""

    def __init__(self, directory: Path, scenario: Scenario) -> None:
        self._folder, self._scenario = directory / BLOCKS_FOLDER, scenario
        self._nodes: set[Node] = set()
        self._pending = MergeTree(merge)
        self._begun = self._written = 0.0  # times of the first result and of the last writing
        self.installations: list[dict[str, Any]] = []  # of the nodes that were found

    def find(
        self,
        identity: RunIdentity,
        any_installation: bool = False,
        within: range | None = None,
    ) -> tuple[list[Node], list[str]]:
        """Return the largest nodes (replicas start, ..., ``size`` of them) that are stored of the
        runs with this ``identity``, in order, and lines for the user about files that are
        unreadable or belong to other runs, which are removed.

        With ``any_installation`` blocks may come from other versions and machines, and no file is
        removed: workers may be at work there. Only those with replicas ``within`` a range are read.
        """
        bad: list[tuple[str, str]] = []
        found: dict[Node, dict[str, Any]] = {}
        expected: dict[str, Any] = {}
        if not any_installation:
            expected |= {"versions": versions(), "machine": machine()}
        for file in self._block_paths():
            try:
                node = _node_of(file)
                if within is not None and not (node[0] < within.stop and sum(node) > within.start):
                    continue
                expected |= {**asdict(identity), "start": node[0], "size": node[1]}
                stored = self._check(file, expected)
                found[node] = {key: stored.get(key) for key in ("versions", "machine")}
            except DamagedError as error:
                if any_installation and not file.exists():
                    continue  # its writer has replaced it
                bad.append((file.name, str(error)))
                if not any_installation:
                    with contextlib.suppress(OSError):
                        file.unlink()
        for node in _outermost(found):
            self._nodes.add(node)
            if found[node] not in self.installations:
                self.installations.append(found[node])
        return sorted(self._nodes), _describe(bad)

    def readable(self, scenario_digest: str, seed: int) -> list[RunStatistics]:
        """Return the statistics of all blocks of runs of a scenario (by its digest) and ``seed``
        that can be read, in order, whatever installation made them; nothing is removed.

        They serve to show the results of an interrupted ensemble, not to resume it.
        """
        found, statistics = [], []
        identity = {"scenario": scenario_digest, "seed": seed}
        for file in self._block_paths():
            with contextlib.suppress(DamagedError):
                start, size = node = _node_of(file)
                self._check(file, {**identity, "start": start, "size": size})
                found.append(node)
        for node in _outermost(found):
            with contextlib.suppress(DamagedError), _open_block(self._block_path(node)) as arrays:
                statistics.append(_restore_statistics(arrays))
        return statistics

    def add(self, node: Node, statistics: RunStatistics, identity: RunIdentity) -> RunStatistics:
        """Take the ``statistics`` of a block, to be merged with those of its neighbours and written
        now or later; return them without traces, which fill the memory.
        """
        start, size = node
        self._pending.add(start // size, statistics, size.bit_length() - 1)
        now = time.monotonic()
        if not self._begun:
            self._begun = self._written = now
        # Traces fill the memory; other results wait to be merged, as a file takes as much for many
        # runs as for one.
        patience = max(FIRST_WRITE, WRITE_SHARE * (self._written - self._begun))
        if identity.trace == "full" or now - self._written >= patience:
            self.write(identity)
        return statistics._replace(traces=())

    def write(self, identity: RunIdentity) -> None:
        """Write the results that ``add`` took and that are not written yet; raises WriteError."""
        for level, k, statistics in self._pending.nodes():
            self.save((k << level, 1 << level), statistics, identity)
        self._pending = MergeTree(merge)
        self._written = time.monotonic()

    def save(self, node: Node, statistics: RunStatistics, identity: RunIdentity) -> None:
        """Write the file of the block of a node, with the ``statistics`` of its runs and the traces
        (events and samples of single runs) in them; raises WriteError.

        ``identity`` is that of the scenario and its runs, by which a resumed run knows its blocks.
        """
        with writing_file(self._folder):
            self._folder.mkdir(exist_ok=True)
        # In memory first: on a full disk some versions of numpy leave their file open.
        block = io.BytesIO()
        arrays = _as_arrays(statistics, identity.of(node))
        np.savez(block, **arrays)
        block.write(MARK + _digest(block, block.tell()))
        # Another worker may write the same block: the one who renames last wins, with the same.
        writer = f"{platform.node()}-{os.getpid()}."
        with write_atomically(self._block_path(node), writer) as part:
            part.write_bytes(block.getvalue())
        self._nodes.add(node)

    def load(self, node: Node) -> RunStatistics:
        """Return the block of a node without its traces; raises EngineError if it was damaged
        meanwhile.
        """
        with self._expect_block(node), _open_block(self._block_path(node)) as arrays:
            return _restore_statistics(arrays)

    def traces(self) -> Iterator[Trace]:
        """Yield the traces (events and samples of a run) that the blocks of this run have, in the
        order of replicas, those not written yet included; raises EngineError if a block was damaged
        since it was found or saved.
        """
        pending = {(k << level, 1 << level): found for level, k, found in self._pending.nodes()}
        for node in sorted({*self._nodes, *pending}):
            if node in pending:
                yield from pending[node].traces
                continue
            file = self._block_path(node)
            with self._expect_block(node), _open_block(file, verified=False) as arrays:
                for k in range(_read_texts(arrays)["traces"]):
                    yield self._restore_trace(arrays, k)

    def remove(self) -> None:
        """Delete all blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _block_paths(self) -> list[Path]:
        files = self._folder.glob("*.npz") if self._folder.is_dir() else ()
        return sorted(files)

    def _block_path(self, node: Node) -> Path:
        """Return the path of the block of a node."""
        return self._folder / _name_of(node)

    def _check(self, file: Path, identity: dict[str, Any]) -> dict[str, Any]:
        """Return the stored identity of a block; raises DamagedError unless its file is intact."""
        with _open_block(file, verified=False) as arrays:
            stored = _read_texts(arrays).get("identity")
            if not isinstance(stored, dict):
                raise DamagedError("does not say of which runs it is")
            for key, value in identity.items():
                if stored.get(key) != value:
                    name = "installation" if key in ("versions", "machine") else key
                    raise DamagedError(f"is of another {name}")
            statistics = _restore_statistics(arrays)
            if not self._has_form(statistics):
                raise DamagedError("does not fit the scenario")
            if not self._has_numbers(statistics):
                raise DamagedError("lacks numbers that every run has")
            start, size, runs = (int(stored[key]) for key in ("start", "size", "runs"))
            if statistics.runs != min(size, runs - start):
                raise DamagedError("has another number of runs than it says")
            kept = len(range(start, min(start + size, runs, TRACED[stored["trace"]])))
            if _read_texts(arrays)["traces"] != kept:
                raise DamagedError("lacks events of its runs")
            return stored

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
        used = zip(moments, (samples, averages, messages), strict=False)
        return (
            not math.isnan(statistics.rounding_from)
            and all((count >= 0).all() for count in counts)
            and all((quantity.size <= statistics.runs).all() for quantity in moments)
            and not any(
                np.isnan(values[quantity.size > 0][:, which]).any()
                for quantity, which in used
                for values in (quantity.mean, quantity.M2)
            )
        )

    def _restore_trace(self, arrays: Any, k: int) -> Trace:
        """Return the k-th trace of a block from its stored ``arrays``."""
        trace: Any = Trace(*(arrays[f"trace_{k}_{name}"] for name in Trace._fields))
        T, N, n = len(trace.times), len(self._scenario.nodes), self._scenario.width
        # replica, log, times, x, xhat, P, error
        states = (T, self._scenario.plant.n)
        shapes = [(), (len(trace.log),), (T,), states, (T, N, n), (T, N, n, n), (T, N, n)]
        types = [np.dtype(np.int64), EVENT, *[np.dtype(np.float64)] * 5]
        if [(field.dtype, field.shape) for field in trace] != list(zip(types, shapes, strict=True)):
            raise DamagedError("does not fit the scenario")
        return Trace(int(trace.replica), *trace[1:])

    @contextlib.contextmanager
    def _expect_block(self, node: Node) -> Iterator[None]:
        """Turn a DamagedError about the block of a node into an EngineError, and remove it."""
        try:
            yield
        except DamagedError as error:
            with contextlib.suppress(OSError):
                self._block_path(node).unlink()
            message, remedy = f"{self._block_path(node)} {error}", "go on with --resume"
            raise EngineError(f"{message}; {remedy}, which does it again") from None


def _name_of(node: Node) -> str:
    return f"{node[0]:09d}-{node[1]}.npz"


def _node_of(file: Path) -> Node:
    """Return the node whose name a block's file has; raises DamagedError if there is none."""
    start, _, size = file.stem.partition("-")
    if start.isdecimal() and size.isdecimal() and len(start) < 16 and len(size) < 16:
        node = int(start), int(size)
        is_node = node[1] > 0 and node[1] & (node[1] - 1) == 0 and node[0] % node[1] == 0
        if is_node and file.name == _name_of(node):
            return node
    raise DamagedError("has a name that no block has")


def _outermost(nodes: Iterable[Node]) -> Iterator[Node]:
    """Yield the nodes that are in no other one, in order: nodes that overlap contain each other."""
    end = 0
    for node in sorted(nodes, key=lambda node: (node[0], -node[1])):
        if node[0] >= end:
            yield node
            end = sum(node)


def _describe(bad: list[tuple[str, str]]) -> list[str]:
    """Return a line for the user about ``bad`` files of blocks, whose runs are simulated again."""
    if not bad:
        return []
    listed = ", ".join(f"{name} {reason}" for name, reason in bad[:3])
    more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
    return [f"kept blocks that are not those of this run are done again: {listed}{more}"]


def _verify(file: Path) -> None:
    """Raise DamagedError unless the file ends with the digest of all bytes before it."""
    with reading_file(file), file.open("rb") as opened:
        length = max(0, opened.seek(0, os.SEEK_END) - SEAL_BYTES)
        opened.seek(length)
        seal = opened.read()
        if seal != MARK + _digest(opened, length):
            raise DamagedError("was changed since it was written")


def _digest(file: BinaryIO, length: int) -> bytes:
    """Return the SHA-256 of the first ``length`` bytes, in hexadecimal; leaves the file at them."""
    digest, remaining = hashlib.sha256(), length
    file.seek(0)
    while remaining > 0 and (chunk := file.read(min(CHUNK, remaining))):
        digest.update(chunk)
        remaining -= len(chunk)
    file.seek(length)
    return digest.hexdigest().encode()


@contextlib.contextmanager
def _open_block(file: Path, verified: bool = True) -> Iterator[Any]:
    """Yield the arrays, by name, of a block's npz file."""
    try:
        if not verified:
            _verify(file)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays
    except (DamagedError, EngineError, KeyboardInterrupt, GeneratorExit):
        raise  # not about the file's bytes, or explained already
    except Exception as error:  # of zipfile, zlib, numpy and json, whatever the bytes are
        raise DamagedError(f"cannot be read ({type(error).__name__})") from None


def _as_arrays(statistics: RunStatistics, identity: dict[str, Any]) -> dict[str, Any]:
    """Return the statistics of a block and its ``identity`` as arrays by name, for one npz file."""
    arrays: dict[str, Any] = {"totals": statistics.totals}
    moments = {name: getattr(statistics, name) for name in PARTS}
    moments |= {
        f"conserved_{name}": quantity for name, (quantity, _) in statistics.conserved.items()
    }
    for name, quantity in moments.items():
        arrays |= {f"{name}_{field}": getattr(quantity, field) for field in Moments._fields}
    for k, trace in enumerate(statistics.traces):
        arrays |= {f"trace_{k}_{field}": getattr(trace, field) for field in Trace._fields}
    texts = {
        "identity": identity,
        "conserved": {name: drift for name, (_, drift) in statistics.conserved.items()},
        "rounding_from": statistics.rounding_from,
        "fingerprint": statistics.fingerprint,
        "traces": len(statistics.traces),
    }
    return {**arrays, "words": np.array(json.dumps(texts))}


def _read_texts(arrays: Any) -> dict[str, Any]:
    texts: dict[str, Any] = json.loads(str(arrays["words"]))
    return texts


def _restore_statistics(arrays: Any) -> RunStatistics:
    """Return the statistics of a block, without its traces, from the arrays of its file."""

    def moments(name: str) -> Moments:
        return Moments(*(arrays[f"{name}_{field}"] for field in Moments._fields))

    texts = _read_texts(arrays)
    return RunStatistics(
        samples=moments("samples"),
        averages=moments("averages"),
        messages=moments("messages"),
        quantities=moments("quantities"),
        totals=arrays["totals"],
        conserved={
            name: (moments(f"conserved_{name}"), float(d)) for name, d in texts["conserved"].items()
        },
        rounding_from=float(texts["rounding_from"]),
        fingerprint=str(texts["fingerprint"]),
    )
