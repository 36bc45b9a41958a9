"""Finished blocks on disk, ``blocks/000003.npz`` of a run directory, from which runs are resumed.

A block is used only if its last line is the digest of all bytes before it, and the identity inside
(run, number, installation) is that of the run.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from netkf.core.errors import EngineError
from netkf.ensembles.moments import Moments
from netkf.ensembles.statistics import MESSAGES, RunStatistics, Trace
from netkf.runs.documents import DamagedError, reading_file
from netkf.runs.files import BLOCKS_FOLDER, write_atomically, writing_file
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
MAX_BLOCK = 1 << 32  # a number of runs beyond that is damage


@dataclass(frozen=True)
class RunIdentity:
    """The values that blocks must share to be merged.

    scenario : digest of the resolved scenario with its files
    seed, runs : seed and number of runs
    trace, engine : options of the command
    installation : digest of the versions of all packages and of netkf's own files, and of the
                   processor's features
    block : number of runs in a block
    """

    scenario: str
    seed: int
    runs: int
    trace: str
    engine: str
    installation: str
    block: int

    def of(self, number: int) -> dict[str, Any]:
        """Return the identity of block ``number`` of these runs."""
        return {**asdict(self), "number": number}

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-self.runs // self.block)


class BlockCheckpoints:
    """Statistics of the finished blocks, one file each, written atomically."""

    def __init__(self, directory: Path, scenario: Scenario) -> None:
        self._folder, self._scenario = directory / BLOCKS_FOLDER, scenario
        self._numbers: set[int] = set()

    def stored_block_size(self) -> int | None:
        """Return the number of runs in a block (consecutive replicas whose results are one file),
        from the first readable file; None without one. A resumed command must go on with blocks of
        this size, or it could not use the stored ones.
        """
        for file in self._block_paths():
            with contextlib.suppress(DamagedError), _open_block(file) as arrays:
                size = _read_texts(arrays)["identity"]["block"]
                if is_block_size(size):
                    return int(size)
        return None

    def find(self, identity: RunIdentity) -> tuple[list[int], list[str]]:
        """Return the numbers of the stored blocks (consecutive replicas) of the runs with this
        ``identity``, in order, and lines for the user about removed ones.

        Files that are unreadable or belong to other runs are removed.
        """
        bad: list[tuple[str, str]] = []
        for file in self._block_paths():
            try:
                number = int(file.stem[:12])
                if file != self._block_path(number) or number >= identity.blocks:
                    raise DamagedError("has a number that no block has")
                self._check(file, identity.of(number))
            except DamagedError as error:
                bad.append((file.name, str(error)))
                with contextlib.suppress(OSError):
                    file.unlink()
            else:
                self._numbers.add(number)
        return sorted(self._numbers), _describe(bad)

    def readable(self, scenario_digest: str, seed: int) -> list[RunStatistics]:
        """Return the statistics of all blocks of runs of a scenario (by its digest) and ``seed``
        that can be read, in order, whatever installation made them; nothing is removed.

        They serve to show the results of an interrupted ensemble, not to resume it.
        """
        statistics = []
        identity = {"scenario": scenario_digest, "seed": seed}
        for file in self._block_paths():
            with contextlib.suppress(DamagedError):
                self._check(file, identity)
                with _open_block(file) as arrays:
                    statistics.append(_restore_statistics(arrays))
        return statistics

    def save(self, number: int, statistics: RunStatistics, identity: RunIdentity) -> None:
        """Write the file of block ``number``, with the ``statistics`` of its runs and the traces
        (events and samples of single runs) in them; raises WriteError.

        ``identity`` is that of the scenario, seed and installation, by which a resumed run knows
        its blocks.
        """
        with writing_file(self._folder):
            self._folder.mkdir(exist_ok=True)
        # In memory first: on a full disk some versions of numpy leave their file open.
        block = io.BytesIO()
        arrays = _as_arrays(statistics, identity.of(number))
        np.savez(block, **arrays)
        block.write(MARK + _digest(block, block.tell()))
        with write_atomically(self._block_path(number)) as part:
            part.write_bytes(block.getvalue())
        self._numbers.add(number)

    def load(self, number: int) -> RunStatistics:
        """Return block ``number`` without its traces; raises EngineError if it was damaged
        meanwhile.
        """
        with self._expect_block(number), _open_block(self._block_path(number)) as arrays:
            return _restore_statistics(arrays)

    def traces(self) -> Iterator[Trace]:
        """Yield the traces (events and samples of a run) that the blocks of this run have, in the
        order of replicas; raises EngineError if a block was damaged since it was found or saved.
        """
        for number in sorted(self._numbers):
            file = self._block_path(number)
            with self._expect_block(number), _open_block(file, verified=False) as arrays:
                for k in range(_read_texts(arrays)["traces"]):
                    yield self._restore_trace(arrays, k)

    def remove(self) -> None:
        """Delete all blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _block_paths(self) -> list[Path]:
        files = self._folder.glob("*.npz") if self._folder.is_dir() else ()
        return sorted(file for file in files if file.stem.isdecimal())

    def _block_path(self, number: int) -> Path:
        """Return the path of block ``number``."""
        return self._folder / f"{number:06d}.npz"

    def _check(self, file: Path, identity: dict[str, Any]) -> None:
        """Raise DamagedError unless a block's file is intact."""
        with _open_block(file, verified=False) as arrays:
            stored = _read_texts(arrays).get("identity")
            for key, value in identity.items():
                if not isinstance(stored, dict) or stored.get(key) != value:
                    raise DamagedError(f"is of another {key}")
            statistics = _restore_statistics(arrays)
            if not self._has_form(statistics):
                raise DamagedError("does not fit the scenario")
            if not self._has_numbers(statistics):
                raise DamagedError("lacks numbers that every run has")

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
    def _expect_block(self, number: int) -> Iterator[None]:
        """Turn a DamagedError about block ``number`` into an EngineError, and remove it."""
        try:
            yield
        except DamagedError as error:
            with contextlib.suppress(OSError):
                self._block_path(number).unlink()
            message, remedy = f"{self._block_path(number)} {error}", "go on with --resume"
            raise EngineError(f"{message}; {remedy}, which does it again") from None


def is_block_size(value: object) -> bool:
    """Return True for a power of two, as numbers of runs in a block are."""
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return is_integer and 0 < value <= MAX_BLOCK and value & (value - 1) == 0  # type: ignore[operator]


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
