"""Parquet tables of run directories, written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from netkf.linalg.arrays import FloatArray
from netkf.runs.documents import DamagedError, reading_file
from netkf.runs.files import publish, writing
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Sink
from netkf.trace.run import StateSamples, event_columns, state_table
from netkf.trace.schema import EVENT

ROWS = 1 << 17
MAX_READ_ROWS = 1 << 28
"""Rows of a table up to which it is read as a whole."""
EVENT_ENCODING = {
    "use_dictionary": ["run", "kind", "node", "peer", "phase", "age"],
    "column_encoding": dict.fromkeys(("seq", "message"), "DELTA_BINARY_PACKED"),
}
STATE_ENCODING = {"use_dictionary": ["run", "t", "node"]}
"""Dictionaries only where values repeat: half the size in half the time."""


def read_numbers(
    path: Path, columns: Sequence[str], run: int | None = None, missing: bool = False
) -> pd.DataFrame:
    """Return columns of numbers of a Parquet file, of one ``run`` if it is given; with ``missing``
    an empty cell of a float is nan.

    Raises DamagedError for any other file, for one with more than MAX_READ_ROWS rows, and for
    empty cells that are not allowed.
    """
    with _open_for_reading(path) as source, pq.ParquetFile(source) as file:
        names, types = file.schema_arrow.names, file.schema_arrow.types
        known = dict(zip(names, types, strict=True))
        wrong = [name for name in columns if names.count(name) != 1 or not _is_numeric(known[name])]
        if wrong:
            raise DamagedError(f"{path.name} has no column {wrong[0]} of numbers")
        table = _read(file, path.name, source, columns, run)
        empty = [name for name in columns if table[name].null_count]
        if not all(missing and pa.types.is_floating(known[name]) for name in empty):
            raise DamagedError(f"{path.name} has missing values")
        # Types that pandas has noted in the file are not netkf's: plain numbers only.
        return pd.DataFrame(table.to_pandas(ignore_metadata=True))


def read_texts(path: Path, column: str, run: int | None = None) -> pd.Series[str]:
    """Return a column of texts of a Parquet file, of one ``run`` if it is given; raises
    DamagedError for any other file.
    """
    with _open_for_reading(path) as source, pq.ParquetFile(source) as file:
        names = file.schema_arrow.names
        if names.count(column) != 1:
            raise DamagedError(f"{path.name} has no column {column}")
        found = _read(file, path.name, source, [column], run)[column]
        texts = found.cast(pa.string()).combine_chunks()
        if texts.null_count:
            raise DamagedError(f"{path.name} has missing values")
        return pd.Series(texts.dictionary_encode().to_pandas())


def read_flags(path: Path, column: str) -> np.ndarray:
    """Return a column of truth values of a Parquet file; raises DamagedError for any other file."""
    with _open_for_reading(path) as source, pq.ParquetFile(source) as file:
        known = dict(zip(file.schema_arrow.names, file.schema_arrow.types, strict=True))
        if not pa.types.is_boolean(known.get(column, pa.null())):
            raise DamagedError(f"{path.name} has no column {column} of truth values")
        found = _read(file, path.name, source, [column], None)[column]
        if found.null_count:
            raise DamagedError(f"{path.name} has missing values")
        return np.asarray(found.to_numpy(), dtype=bool)


@contextlib.contextmanager
def _open_for_reading(path: Path) -> Iterator[Any]:
    """Open a file for pyarrow; raises DamagedError for what goes wrong inside."""
    with reading_file(path, path.name), _open(path, "rb") as source:
        yield source


def _open(path: Path, mode: str) -> Any:
    """Return an open Arrow file."""
    # As bytes: pyarrow writes texts as UTF-8, which need not be the encoding of file names.
    return pa.OSFile(os.fsencode(path), mode)


def _read(file: Any, name: str, source: Any, columns: Sequence[str], run: int | None) -> Any:
    """Return an Arrow table with the columns, of those rows that are of ``run``."""
    if file.metadata.num_rows > MAX_READ_ROWS:
        raise DamagedError(f"{name} has more than {MAX_READ_ROWS:,} rows")
    if run is None:
        return file.read(columns=list(columns))
    # Row groups of other runs are not even read where their statistics say so.
    return pq.read_table(source, columns=list(columns), filters=[("run", "==", run)])


def column_names(path: Path) -> list[str]:
    """Return the names of the columns of a Parquet file; raises DamagedError."""
    with _open_for_reading(path) as source:
        return list(pq.read_schema(source).names)


def is_numeric_column(path: Path, name: str) -> bool:
    """Return True if a column of a Parquet file holds numbers; raises DamagedError."""
    with _open_for_reading(path) as source:
        return _is_numeric(pq.read_schema(source).field(name).type)


def _is_numeric(kind: Any) -> bool:
    """Return True for Arrow types of numbers."""
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


class ParquetSink(Sink):
    """Streams events and states to Parquet, one row group per block, so that memory is bounded."""

    thread_safe: ClassVar[bool] = True

    def __init__(self, directory: Path, scenario: Scenario, replica: int, events: bool) -> None:
        self._nodes, self._replica, self._first = scenario.nodes, replica, 0
        self._truth_known = scenario.plant.truth_known
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
        """Write the samples that have been gathered."""
        if self._states is None or not self._samples:
            return
        columns = zip(*self._samples, strict=True)
        times, x, xhat, P, error = (np.concatenate(column) for column in columns)
        self._samples.clear()
        self._rows = 0
        self._states.write(
            state_table(
                self._replica,
                self._nodes,
                StateSamples(times, x, xhat, P, error),
                self._truth_known,
            )
        )

    def close(self) -> None:
        """Finish the files and rename them from NAME.part."""
        with contextlib.ExitStack() as last_first:
            if self._states is not None:
                last_first.callback(self._states.close, None)
            if self._events is not None:
                last_first.callback(self._events.close, _no_events)
            # A full disk that fails here leaves the table that can be finished.
            last_first.callback(self._flush)


def _no_events() -> dict[str, Any]:
    """Return the columns of an empty table of events."""
    return event_columns(np.empty(0, dtype=EVENT), 0, 0)


class TraceTables:
    """Writes events.parquet and states.parquet of several runs, one run after the other; use it as
    a context manager.
    """

    def __init__(self, directory: Path, scenario: Scenario) -> None:
        self._nodes, self._truth_known = scenario.nodes, scenario.plant.truth_known
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
        states = state_table(replica, self._nodes, samples, self._truth_known)
        for gathered, columns in zip(
            self._gathered, (event_columns(log, replica, 0), states), strict=True
        ):
            gathered.append(pd.DataFrame(columns))
        self._rows += max(len(log), len(times) * len(self._nodes))
        if self._rows >= ROWS:
            self._flush()

    def _flush(self) -> None:
        """Write the tables that have been gathered."""
        for gathered, table in zip(self._gathered, (self._events, self._states), strict=True):
            if gathered:
                table.write(pd.concat(gathered, ignore_index=True))
                gathered.clear()
        self._rows = 0

    def __enter__(self) -> TraceTables:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Finish the files, or remove them after an exception."""
        try:
            if error is None:
                self._flush()
                self._events.close(None)
                self._states.close(None)
        finally:
            self._events.discard()
            self._states.discard()


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """Write columns as a Parquet file."""
    table = _Table(path)
    table.write(columns)
    table.close(None)


class _Table:
    """A Parquet file under construction; its schema is that of the first rows.

    The file has its name once it is whole and on the disk. If writing fails, nothing is left of it,
    and WriteError is raised.
    """

    def __init__(self, path: Path, encoding: dict[str, Any] | None = None) -> None:
        self._path, self._part = path, path.with_name(path.name + ".part")
        self._encoding = encoding or {}
        self._file: Any = None
        self._writer: Any = None
        self._closed = False

    def write(self, columns: dict[str, Any] | pd.DataFrame) -> None:
        """Append rows; the first ones create the file."""
        table = pa.Table.from_pandas(pd.DataFrame(columns), preserve_index=False)
        with self._or_nothing():
            if self._writer is None:
                schema, how = table.schema, self._encoding
                self._file = _open(self._part, "wb")
                self._writer = pq.ParquetWriter(self._file, schema, compression="zstd", **how)
            self._writer.write_table(table)

    def close(self, empty: Callable[[], dict[str, Any]] | None) -> None:
        """Finish the file; without rows, one with the columns of ``empty``, if there are such."""
        if self._closed:
            return
        if self._writer is None and empty is not None:
            self.write(empty())
        self._closed = True
        if self._writer is not None:
            with self._or_nothing():
                self._writer.close()
                self._file.close()
                publish(self._part, self._path)

    def discard(self) -> None:
        """Remove the unfinished file."""
        if self._closed:
            return
        self._closed = True
        for one in (self._writer, self._file):
            if one is not None:
                with contextlib.suppress(OSError, pa.ArrowException):
                    one.close()
        with contextlib.suppress(OSError):
            self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _or_nothing(self) -> Iterator[None]:
        """Discard the unfinished file if anything fails meanwhile."""
        try:
            with writing(self._path):
                yield
        except BaseException:
            self._closed = False
            self.discard()
            raise
