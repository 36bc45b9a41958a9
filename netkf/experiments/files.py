"""Run directories: written beside and renamed, so that a reader never sees half a file."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from netkf.core.arrays import FloatArray
from netkf.core.errors import ScenarioError
from netkf.scenario.reading import source_files
from netkf.scenario.scenario import Scenario
from netkf.scenario.writing import resolved, to_toml
from netkf.trace.recorder import Sink
from netkf.trace.run import event_columns, state_table
from netkf.trace.schema import EVENT

ROWS = 1 << 17


def write_text(path: Path, text: str) -> None:
    """A whole text file at once."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)


def write_json(path: Path, value: Any) -> None:
    """A JSON file whose numbers are all finite (others become null)."""
    write_text(path, json.dumps(finite(value), indent=2) + "\n")


def finite(value: Any) -> Any:
    """The same value with None for numbers that JSON does not know."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def new_directory(wanted: Path | None, name: str) -> Path:
    """Make the directory of a run: ``wanted``, new or empty, or the first free runs/NAME-k."""
    if wanted is None:
        safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in name)[:100].strip(".")
        tries = (Path("runs") / f"{safe or 'run'}-{k}" for k in range(1, 1_000_000))
        wanted = next(path for path in tries if not path.exists())
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        taken = any(wanted.iterdir())
    except (OSError, ValueError) as error:
        words = f"cannot be made ({getattr(error, 'strerror', None) or error})"
        raise ScenarioError("--out", words, str(wanted), "choose another") from None
    if taken:
        raise ScenarioError(
            "--out",
            "must be a new or empty directory",
            str(wanted),
            "choose another, or remove it first",
        )
    return wanted


OWN = (
    "scenario.toml",
    "manifest.json",
    "events.parquet",
    "states.parquet",
    "ensemble.parquet",
    "summary.json",
    "run.png",
)
"""What a run directory holds."""


def check_sources(scenario: Scenario) -> None:
    """Raise ScenarioError for a file whose copy would stand in the way of the run's own."""
    for source in source_files(scenario):
        if source.name in OWN:
            words = "is a name that run directories use themselves"
            raise ScenarioError("path", words, source.name, "rename the file")


def write_scenario(directory: Path, scenario: Scenario) -> None:
    """The scenario as resolved, with the files it names beside it; it gives the same run again."""
    for source in source_files(scenario):
        target = directory / source.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source.full, target)
    write_text(directory / "scenario.toml", to_toml(resolved(scenario)))


class ParquetSink(Sink):
    """Streams events and states to Parquet, one row group a block, so that memory stays bounded."""

    def __init__(self, directory: Path, scenario: Scenario, replica: int, events: bool) -> None:
        self._nodes, self._replica, self._first = scenario.nodes, replica, 0
        self._shown = scenario.plant.shown
        self._events = _Table(directory / "events.parquet") if events else None
        self._states = _Table(directory / "states.parquet") if events else None
        self._samples: list[tuple[float, FloatArray, FloatArray, FloatArray]] = []

    def events(self, rows: np.ndarray) -> None:
        """A row group."""
        if self._events is not None:
            self._events.write(event_columns(rows, self._replica, self._first))
            self._first += len(rows)

    def states(self, t: float, x: FloatArray, xhat: FloatArray, P: FloatArray) -> None:
        """Gathered into row groups."""
        if self._states is not None:
            self._samples.append((t, x, xhat, P))
            if len(self._samples) * len(self._nodes) >= ROWS:
                self._flush()

    def _flush(self) -> None:
        if self._states is None or not self._samples:
            return
        times, x, xhat, P = (np.array([s[k] for s in self._samples]) for k in range(4))
        self._samples.clear()
        self._states.write(state_table(self._replica, times, self._nodes, x, xhat, P, self._shown))

    def close(self) -> None:
        """Finish the files and give them their names."""
        self._flush()
        for table, empty in (
            (self._events, lambda: event_columns(np.empty(0, dtype=EVENT), 0, 0)),
            (self._states, None),
        ):
            if table is not None:
                table.close(empty)


class _Table:
    def __init__(self, path: Path) -> None:
        self._path, self._part = path, path.with_name(path.name + ".part")
        self._writer: Any = None

    def write(self, columns: dict[str, Any]) -> None:
        table = pa.Table.from_pandas(pd.DataFrame(columns), preserve_index=False)
        if self._writer is None:
            self._writer = pq.ParquetWriter(self._part, table.schema, compression="zstd")
        self._writer.write_table(table)

    def close(self, empty: Callable[[], dict[str, Any]] | None) -> None:
        if self._writer is None and empty is not None:
            self.write(empty())
        if self._writer is not None:
            self._writer.close()
            os.replace(self._part, self._path)
