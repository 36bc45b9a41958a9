"""Parquet tables of run directories; each file is written completely or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from netkf.linalg.arrays import FloatArray
from netkf.runs.documents import DamagedError, reading_file
from netkf.runs.files import publish, writing_file
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Sink
from netkf.trace.run import StateSamples, event_columns, state_table
from netkf.trace.schema import EVENT, KINDS

if TYPE_CHECKING:
    import pandas as pd

ROW_GROUP_ROWS = 1 << 17
"""Rows that are collected before they are written as one row group."""
MAX_READ_ROWS = 1 << 28
"""Largest number of rows of a table that is read into memory."""
EVENT_ENCODING = {
    "use_dictionary": ["run", "kind", "node", "peer", "phase", "age"],
    "column_encoding": dict.fromkeys(("seq", "message"), "DELTA_BINARY_PACKED"),
}
STATE_ENCODING = {"use_dictionary": ["run", "t", "node"]}
"""Options of pyarrow: dictionaries only where values repeat take half the size and time."""


def read_numbers(
    path: Path, columns: Sequence[str], run: int | None = None, allow_empty: bool = False
) -> pd.DataFrame:
    """Return numeric columns of a Parquet file, of one ``run`` or all, with ``allow_empty`` nan for
    empty cells. Raises DamagedError, also above MAX_READ_ROWS rows.
    """
    import pandas as pd

    with _reading_columns(path, columns, run, _is_numeric, " of numbers") as table:
        for name in columns:
            is_allowed = allow_empty and pa.types.is_floating(table[name].type)
            if table[name].null_count and not is_allowed:
                raise DamagedError(f"{path.name} has missing values")
        # Without pandas metadata, which may ask for other types than plain numbers.
        return pd.DataFrame(table.to_pandas(ignore_metadata=True))


def read_texts(path: Path, column: str, run: int | None = None) -> pd.Series[str]:
    """Return a text column, of one ``run`` or all, as a categorical series; raises DamagedError."""
    import pandas as pd

    with _reading_columns(path, [column], run) as table:
        texts = table[column].cast(pa.string()).combine_chunks()
        if texts.null_count:
            raise DamagedError(f"{path.name} has missing values")
        return pd.Series(texts.dictionary_encode().to_pandas())


def read_flags(path: Path, column: str) -> np.ndarray:
    """Return a column of booleans (rows,); raises DamagedError, also for empty cells."""
    with _reading_columns(path, [column], None, pa.types.is_boolean, " of truth values") as table:
        if table[column].null_count:
            raise DamagedError(f"{path.name} has missing values")
        return np.asarray(table[column].to_numpy(), dtype=bool)


@contextlib.contextmanager
def _open_for_reading(path: Path) -> Iterator[Any]:
    """Yield an Arrow file to read; turn every exception of the body into a DamagedError."""
    with reading_file(path, path.name), _open_arrow_file(path, "rb") as source:
        yield source


def _open_arrow_file(path: Path, mode: str) -> Any:
    # The path as bytes: pyarrow encodes a text as UTF-8, which may not be how the system does.
    return pa.OSFile(os.fsencode(path), mode)


@contextlib.contextmanager
def _reading_columns(
    path: Path,
    columns: Sequence[str],
    run: int | None,
    fits: Callable[[Any], bool] = lambda _: True,
    kind: str = "",
) -> Iterator[Any]:
    """Yield a table of ``columns`` whose types ``fits`` takes, of one ``run`` or of all."""
    with _open_for_reading(path) as source, pq.ParquetFile(source) as file:
        names = file.schema_arrow.names
        for name in columns:
            if names.count(name) != 1 or not fits(file.schema_arrow.field(name).type):
                raise DamagedError(f"{path.name} has no column {name}{kind}")
        if file.metadata.num_rows > MAX_READ_ROWS:
            raise DamagedError(f"{path.name} has more than {MAX_READ_ROWS:,} rows")
        # A filter skips row groups whose statistics exclude the run.
        filters = {} if run is None else {"filters": [("run", "==", run)]}
        read = file.read if run is None else partial(pq.read_table, source)
        yield read(columns=list(columns), **filters)


def column_names(path: Path) -> list[str]:
    """Return the names of the columns of a Parquet file; raises DamagedError if it is not one."""
    with _open_for_reading(path) as source:
        return list(pq.read_schema(source).names)


def is_numeric_column(path: Path, name: str) -> bool:
    """Return True if a column of a Parquet file holds numbers; raises DamagedError."""
    with _open_for_reading(path) as source:
        return _is_numeric(pq.read_schema(source).field(name).type)


def _is_numeric(kind: Any) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


class ParquetSink(Sink):
    """Writes events.parquet and states.parquet of one run, or of several, one after the other.

    Rows are written when they fill a row group, so that memory is bounded. As a context manager it
    removes the unfinished files after an exception.
    """

    thread_safe: ClassVar[bool] = True

    def __init__(self, directory: Path, scenario: Scenario, replica: int = 0) -> None:
        """Prepare both files in ``directory``; the first run has the number ``replica``."""
        self._nodes, self._replica, self._event_count = scenario.nodes, replica, 0
        self._truth_known = scenario.plant.truth_known
        self._views = scenario.views
        self._events = _Table(directory / "events.parquet", EVENT_ENCODING)
        self._states = _Table(directory / "states.parquet", STATE_ENCODING)
        self._samples: list[tuple[FloatArray, ...]] = []
        self._rows = 0

    def add(self, replica: int, log: np.ndarray, samples: StateSamples) -> None:
        """Append a whole run, number ``replica``: the EVENT rows ``log`` (E,) and its samples."""
        self._collect_samples()
        self._replica, self._event_count = replica, 0
        self.events(log)
        self.states(*samples)

    def events(self, rows: np.ndarray) -> None:
        """Take the next EVENT ``rows`` (E,) of the run."""
        # A row group at a time: in large networks a slot has millions of rows.
        for first in range(0, max(1, len(rows)), ROW_GROUP_ROWS):
            part = rows[first : first + ROW_GROUP_ROWS]
            self._events.collect(event_columns(part, self._replica, self._event_count, _kinds))
            self._event_count += len(part)

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Take T samples of N nodes of the run."""
        self._samples.append((t, x, xhat, P, error))
        self._rows += len(t) * len(self._nodes)
        if self._rows >= ROW_GROUP_ROWS:
            self._collect_samples()

    def _collect_samples(self) -> None:
        if self._samples:
            samples = StateSamples(*map(np.concatenate, zip(*self._samples, strict=True)))
            self._samples.clear()
            self._rows = 0
            table = state_table(self._replica, self._nodes, samples, self._truth_known, self._views)
            self._states.collect(table)

    def _flush(self) -> None:
        self._collect_samples()
        self._events.flush()
        self._states.flush()

    def close(self) -> None:
        """Finish the files and rename them from NAME.part; raises WriteError."""
        # All callbacks run, the last one first: if the disk is full when the last samples are
        # written, the table of events is finished nevertheless.
        with contextlib.ExitStack() as callbacks:
            callbacks.callback(self._states.close)
            callbacks.callback(self._events.close)
            callbacks.callback(self._flush)
            self.events(np.empty(0, dtype=EVENT))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            if error is None:
                self.close()
        finally:
            self._events.discard()
            self._states.discard()


def _arrow(values: Any) -> Any:
    """Return a column as an Arrow array, nan is null; ``pyarrow.array`` would import pandas."""
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iuf":
        return pa.array(values, from_pandas=True)
    valid = None
    if values.dtype.kind == "f" and (missing := np.isnan(values)).any():
        valid = pa.py_buffer(np.packbits(~missing, bitorder="little"))
    buffers = [valid, pa.py_buffer(np.ascontiguousarray(values))]
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), buffers)


def _kinds(codes: np.ndarray) -> Any:
    """Return the kinds of events with ``codes`` (K,) int8 as an Arrow array of categories."""
    texts = [name.encode() for name in KINDS]
    ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(texts))]
    names = pa.Array.from_buffers(pa.string(), len(texts), buffers)
    return pa.DictionaryArray.from_arrays(_arrow(codes), names)


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """Write columns {name: values (rows,)} as a Parquet file; raises WriteError."""
    table = _Table(path)
    table.collect(columns)
    table.close()


class _Table:
    """A Parquet file that is being written: NAME.part until it is complete."""

    def __init__(self, path: Path, encoding: dict[str, Any] | None = None) -> None:
        self._path, self._temporary = path, path.with_name(path.name + ".part")
        self._encoding = encoding or {}
        self._pending: list[Any] = []
        self._file: Any = None
        self._writer: Any = None
        self._closed = False

    def collect(self, columns: dict[str, Any]) -> None:
        """Append rows, which are written once they fill a row group; the first give the schema."""
        self._pending.append(pa.table({name: _arrow(column) for name, column in columns.items()}))
        if sum(map(len, self._pending)) >= ROW_GROUP_ROWS:
            self.flush()

    def flush(self) -> None:
        """Write the collected rows as a row group; the first ones give the schema."""
        if not self._pending:
            return
        table = pa.concat_tables(self._pending).unify_dictionaries()
        self._pending.clear()
        with self._discard_on_failure():
            if self._writer is None:
                self._file = _open_arrow_file(self._temporary, "wb")
                self._writer = pq.ParquetWriter(
                    self._file, table.schema, compression="zstd", **self._encoding
                )
            self._writer.write_table(table)

    def close(self) -> None:
        """Write what is left, and finish the file; without rows, not even none, there is none."""
        if self._closed:
            return
        self.flush()
        self._closed = True
        if self._writer is not None:
            with self._discard_on_failure():
                self._writer.close()
                self._file.close()
                publish(self._temporary, self._path)

    def discard(self) -> None:
        """Close and remove the unfinished file; does nothing after ``close``."""
        if self._closed:
            return
        self._closed = True
        for file in (self._writer, self._file):
            if file is not None:
                with contextlib.suppress(OSError, pa.ArrowException):
                    file.close()
        with contextlib.suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _discard_on_failure(self) -> Iterator[None]:
        """Remove the unfinished file if the body raises; OSErrors of it become WriteErrors."""
        try:
            with writing_file(self._path):
                yield
        except BaseException:
            self._closed = False  # discard() does nothing to a closed file
            self.discard()
            raise
