"""Finished blocks on disk, ``blocks/000003.npz`` of a run directory: a kill loses little."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from netkf.ensembles.moments import Moments
from netkf.ensembles.statistics import RunStatistics, Trace
from netkf.runs.files import write_atomically

PARTS = ("samples", "averages", "messages")


class BlockCheckpoints:
    """Statistics of the blocks that are done, a file each. Files are written beside and renamed:
    each is there whole or not at all.
    """

    def __init__(self, directory: Path) -> None:
        self._folder = directory / "blocks"

    def numbers(self) -> list[int]:
        """Those that are there, in order."""
        files = self._folder.glob("*.npz") if self._folder.is_dir() else ()
        return sorted(int(file.stem) for file in files if zipfile.is_zipfile(file))

    def save(self, number: int, statistics: RunStatistics) -> None:
        """Write a block with the traces that its runs left."""
        self._folder.mkdir(exist_ok=True)
        with write_atomically(self._file(number)) as part, part.open("wb") as opened:
            np.savez(opened, **_as_arrays(statistics))

    def load(self, number: int) -> RunStatistics:
        """Return a block without its traces."""
        with np.load(self._file(number)) as arrays:
            return _statistics(arrays)

    def traces(self) -> Iterator[Trace]:
        """Yield the traces of all blocks in the order of replicas."""
        for number in self.numbers():
            with np.load(self._file(number)) as arrays:
                for k in range(_words(arrays)["traces"]):
                    fields = [arrays[f"trace_{k}_{name}"] for name in Trace._fields]
                    yield Trace(int(fields[0]), *fields[1:])

    def remove(self) -> None:
        """Delete all blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:06d}.npz"


def _as_arrays(statistics: RunStatistics) -> dict[str, Any]:
    arrays: dict[str, Any] = {"totals": statistics.totals}
    moments = {name: getattr(statistics, name) for name in PARTS}
    moments |= {f"conserved_{name}": found for name, (found, _) in statistics.conserved.items()}
    for name, found in moments.items():
        arrays |= {f"{name}_{field}": getattr(found, field) for field in Moments._fields}
    for k, trace in enumerate(statistics.traces):
        arrays |= {f"trace_{k}_{field}": getattr(trace, field) for field in Trace._fields}
    words = {
        "conserved": {name: drift for name, (_, drift) in statistics.conserved.items()},
        "rounding_from": statistics.rounding_from,
        "fingerprint": statistics.fingerprint,
        "traces": len(statistics.traces),
    }
    return {**arrays, "words": np.array(json.dumps(words))}


def _words(arrays: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(str(arrays["words"]))
    return found


def _statistics(arrays: Any) -> RunStatistics:
    def moments(name: str) -> Moments:
        return Moments(*(arrays[f"{name}_{field}"] for field in Moments._fields))

    words = _words(arrays)
    return RunStatistics(
        moments("samples"),
        moments("averages"),
        moments("messages"),
        arrays["totals"],
        {name: (moments(f"conserved_{name}"), d) for name, d in words["conserved"].items()},
        words["rounding_from"],
        words["fingerprint"],
    )
