"""Files of run directories, written whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.plugins import module_files
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import resolved, to_toml
from netkf.trace.recorder import Sink
from netkf.trace.run import StateSamples, event_columns, state_table
from netkf.trace.schema import EVENT

ROWS = 1 << 17
EVENT_ENCODING = {
    "use_dictionary": ["run", "kind", "node", "peer", "phase", "age"],
    "column_encoding": dict.fromkeys(("seq", "message"), "DELTA_BINARY_PACKED"),
}
STATE_ENCODING = {"use_dictionary": ["run", "t", "node"]}
"""Dictionaries only where values repeat: half the size in half the time."""


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that replaces ``path`` at the end of the body.

    A reader never sees half a file; if the body raises, the temporary file is removed.
    """
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with write_atomically(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file; numbers that are not finite become null."""
    write_text(path, json_text(value) + "\n")


def json_text(value: Any, margin: str = "\n") -> str:
    """Return ``json.dumps(finite(value), indent=2)`` for a value whose lines begin with ``margin``.

    The standard library indents in plain Python, a call for each number. Here each dictionary and
    list without others in it, such as the row of a node, is one call of its compiled encoder.
    """
    if not isinstance(value, (dict, list, tuple)) or not value:
        return json.dumps(finite(value))
    inner = margin + "  "
    parts = value.values() if isinstance(value, dict) else value
    if not any(isinstance(part, (dict, list, tuple)) for part in parts):
        text = json.JSONEncoder(separators=("," + inner, ": ")).encode(finite(value))
        return text[0] + inner + text[1:-1] + margin + text[-1]
    if isinstance(value, dict):
        named = (f"{json.dumps(str(key))}: {json_text(item, inner)}" for key, item in value.items())
        return "{" + inner + ("," + inner).join(named) + margin + "}"
    return "[" + inner + ("," + inner).join(json_text(item, inner) for item in value) + margin + "]"


def finite(value: Any) -> Any:
    """Return a plain JSON value: numpy numbers become Python ones, and None if not finite."""
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def new_directory(wanted: Path | None, name: str) -> Path:
    """Create and return the directory of a run: ``wanted``, or the first free runs/NAME-k.

    Raises ScenarioError if ``wanted`` cannot be created or is not empty.
    """
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


OWN_FILES = (
    "scenario.toml",
    "manifest.json",
    "events.parquet",
    "states.parquet",
    "ensemble.parquet",
    "summary.json",
    "run.png",
)
"""Files of a run directory that netkf writes."""


def remove_own(directory: Path, scenario: Scenario) -> None:
    """Remove the files that a run of this scenario left in its directory, and no others."""
    modules = [file.name for file in module_files(scenario).values() if file is not None]
    names = [*OWN_FILES, *modules, *(source.name for source in source_files(scenario))]
    for name in names:
        for file in (directory / name, directory / f"{name}.part"):
            file.unlink(missing_ok=True)
        for folder in Path(name).parents[:-1]:
            with contextlib.suppress(OSError):  # there may be more in it, or it may be gone
                (directory / folder).rmdir()


def check_sources(scenario: Scenario) -> None:
    """Raise ScenarioError for a file of the scenario with the name of a file of run directories."""
    for source in source_files(scenario):
        if source.name in OWN_FILES:
            words = "is a name that run directories use themselves"
            raise ScenarioError("path", words, source.name, "rename the file")


def write_scenario(directory: Path, scenario: Scenario, seed: int | None = None) -> None:
    """Write scenario.toml with all defaults filled in, and copy the files and modules it names.

    ``seed`` replaces the root seed of the scenario. The copy reproduces the run.
    """
    for source in source_files(scenario):
        target = directory / source.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source.full, target)
    for module in module_files(scenario).values():
        if module is not None:
            shutil.copyfile(module, directory / module.name)
    table = resolved(scenario)
    table["seed"] = scenario.seed if seed is None else seed
    write_text(directory / "scenario.toml", to_toml(table))


def scenario_digest(scenario: Scenario) -> str:
    """Return the SHA-256 of a resolved scenario and of the files and modules that it names."""
    digest = hashlib.sha256(to_toml(resolved(scenario)).encode())
    files = {source.name: source.full for source in source_files(scenario)}
    files |= {f"{name}.py": file for name, file in module_files(scenario).items() if file}
    for name, file in sorted(files.items()):
        digest.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def missing_modules(scenario: Scenario) -> list[str]:
    """Return a sentence about each module that a run needs and its directory does not hold."""
    return [
        f"the run directory needs the Python module {name}, which was not copied into it: it is no "
        "single file beside the scenario"
        for name, file in module_files(scenario).items()
        if file is None
    ]


class ParquetSink(Sink):
    """Streams events and states to Parquet, one row group per block, so that memory is bounded."""

    thread_safe: ClassVar[bool] = True

    def __init__(self, directory: Path, scenario: Scenario, replica: int, events: bool) -> None:
        self._nodes, self._replica, self._first = scenario.nodes, replica, 0
        self._shown = scenario.plant.truth_known
        self._events = _Table(directory / "events.parquet", EVENT_ENCODING) if events else None
        self._states = _Table(directory / "states.parquet", STATE_ENCODING) if events else None
        self._samples: list[tuple[FloatArray, ...]] = []
        self._rows = 0

    def events(self, rows: np.ndarray) -> None:
        """Write a block of EVENT rows as a row group."""
        if self._events is not None:
            self._events.write(event_columns(rows, self._replica, self._first))
            self._first += len(rows)

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Collect samples until they fill a row group."""
        if self._states is not None:
            self._samples.append((t, x, xhat, P, error))
            self._rows += len(t) * len(self._nodes)
            if self._rows >= ROWS:
                self._flush()

    def _flush(self) -> None:
        if self._states is None or not self._samples:
            return
        columns = zip(*self._samples, strict=True)
        times, x, xhat, P, error = (np.concatenate(column) for column in columns)
        self._samples.clear()
        self._rows = 0
        self._states.write(
            state_table(
                self._replica, self._nodes, StateSamples(times, x, xhat, P, error), self._shown
            )
        )

    def close(self) -> None:
        """Finish the files and rename them from NAME.part."""
        self._flush()
        for table, empty in (
            (self._events, lambda: event_columns(np.empty(0, dtype=EVENT), 0, 0)),
            (self._states, None),
        ):
            if table is not None:
                table.close(empty)


class TraceTables:
    """Writes events.parquet and states.parquet of several runs, one run after the other."""

    def __init__(self, directory: Path, scenario: Scenario) -> None:
        self._nodes, self._shown = scenario.nodes, scenario.plant.truth_known
        self._events = _Table(directory / "events.parquet", EVENT_ENCODING)
        self._states = _Table(directory / "states.parquet", STATE_ENCODING)
        self._gathered: tuple[list[pd.DataFrame], list[pd.DataFrame]] = ([], [])
        self._rows = 0

    def add(
        self,
        replica: int,
        log: np.ndarray,
        times: FloatArray,
        x: FloatArray,
        xhat: FloatArray,
        P: FloatArray,
        error: FloatArray,
    ) -> None:
        """Append one run: its EVENT rows, and its samples with the shapes of ``netkf.Run``."""
        samples = StateSamples(times, x, xhat, P, error)
        states = state_table(replica, self._nodes, samples, self._shown)
        for gathered, columns in zip(
            self._gathered, (event_columns(log, replica, 0), states), strict=True
        ):
            gathered.append(pd.DataFrame(columns))
        self._rows += max(len(log), len(times) * len(self._nodes))
        if self._rows >= ROWS:
            self._flush()

    def _flush(self) -> None:
        for gathered, table in zip(self._gathered, (self._events, self._states), strict=True):
            if gathered:
                table.write(pd.concat(gathered, ignore_index=True))
                gathered.clear()
        self._rows = 0

    def close(self) -> None:
        """Finish the files and rename them from NAME.part."""
        self._flush()
        self._events.close(None)
        self._states.close(None)


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """Write columns as a Parquet file."""
    table = _Table(path)
    table.write(columns)
    table.close(None)


class _Table:
    """A Parquet file under construction; its schema is that of the first rows."""

    def __init__(self, path: Path, encoding: dict[str, Any] | None = None) -> None:
        self._path, self._part = path, path.with_name(path.name + ".part")
        self._encoding = encoding or {}
        self._writer: Any = None
        self._closed = self._failed = False

    def write(self, columns: dict[str, Any] | pd.DataFrame) -> None:
        table = pa.Table.from_pandas(pd.DataFrame(columns), preserve_index=False)
        if self._writer is None:
            schema, how = table.schema, self._encoding
            self._writer = pq.ParquetWriter(self._part, schema, compression="zstd", **how)
        self._failed = True  # stays so if writing raises: half a row group is no file
        self._writer.write_table(table)
        self._failed = False

    def close(self, empty: Callable[[], dict[str, Any]] | None) -> None:
        if self._closed:
            return
        self._closed = True
        if self._writer is None and empty is not None:
            self.write(empty())
        if self._writer is None:
            return
        if self._failed:
            with contextlib.suppress(OSError, pa.ArrowException):
                self._writer.close()
            return
        self._writer.close()
        os.replace(self._part, self._path)
