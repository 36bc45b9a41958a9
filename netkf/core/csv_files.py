"""Reading of the CSV files of scenarios; errors name the file and the line."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import MAX_MAGNITUDE, SourceFile
from netkf.linalg.arrays import FloatArray

MAX_BYTES = 256 << 20  # of a file; it limits the memory that reading takes
MAX_ID = 2**53  # larger integers are not exact as floating-point numbers


def read_columns(
    source: SourceFile, required: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, FloatArray]:
    """Return the named columns, each (rows,), by name; optional ones only if they are there.

    Raises ScenarioError, with the file and the line, for a missing column, a row of another length
    than the header, or an entry that is not a finite number.
    """
    numbers = array("d")
    with _open_table(source) as (header, rows):
        _require_columns(source, header, required)
        names = [name for name in (*required, *optional) if name in header]
        indices = [header.index(name) for name in names]
        for line, row in rows:
            numbers.extend(parse_finite_numbers(source, line, header, row, indices))
    columns = np.array(numbers, dtype=np.float64).reshape(-1, len(names)).T
    return dict(zip(names, columns, strict=True))


def read_header(source: SourceFile) -> list[str]:
    """Return the names of the columns; raises ScenarioError if the file is not a table."""
    with _open_table(source) as (header, _):
        return header


def read_rows(
    source: SourceFile, required: tuple[str, ...]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of the columns, and (line number, entries) of every row that is not empty.

    Raises ScenarioError if the file is not a table or lacks a required column.
    """
    with _open_table(source) as (header, rows):
        _require_columns(source, header, required)
        return header, list(rows)


def _require_columns(source: SourceFile, header: list[str], required: tuple[str, ...]) -> None:
    """Raise ScenarioError if the header lacks a required column."""
    missing = [name for name in required if name not in header]
    if missing:
        rule = f"{source.name} must have the columns {', '.join(required)}"
        raise ScenarioError("path", rule, header, f"add the column {missing[0]}")


@contextmanager
def _open_table(
    source: SourceFile,
) -> Iterator[tuple[list[str], Iterator[tuple[int, list[str]]]]]:
    """Open a CSV file for a block; give the names of its columns and an iterator of its rows.

    The iterator gives (line number, entries) of rows that are not empty. Raises ScenarioError if
    the file, also while it is iterated, cannot be read as a table.
    """
    try:
        size = source.full.stat().st_size
        if size > MAX_BYTES:
            rule = f"{source.name} must have at most {MAX_BYTES >> 20} MiB"
            raise ScenarioError("path", rule, f"{size:,} bytes", "leave out rows")
        with source.full.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            yield header, ((reader.line_num, row) for row in reader if row)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        rule = f"{source.name} cannot be read as a UTF-8 table of comma-separated values"
        raise ScenarioError("path", rule, str(error), "correct the file") from None


def parse_finite_numbers(
    source: SourceFile, line: int, header: list[str], entries: list[str], indices: list[int]
) -> list[float]:
    """Return the ``entries`` (texts) of a row in the columns with these ``indices`` as numbers, one
    for each index; ``header`` has the names of all columns.

    Raises ScenarioError if one is not a finite number of at most MAX_MAGNITUDE, or if the row is
    not as long as the header. ``line`` is the row's line number in the file.
    """
    where = f"{source.name} line {line}"
    if len(entries) != len(header):
        raise ScenarioError(
            "path", f"{where} must have {len(header)} entries", entries, "correct the row"
        )
    numbers = []
    for column in indices:
        try:
            value = float(entries[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ScenarioError(
                "path",
                f"{where}: {header[column]} must be a finite number",
                entries[column],
                "correct the row, or leave it out",
            )
        if abs(value) > MAX_MAGNITUDE:
            rule = f"{where}: {header[column]} must be at most {MAX_MAGNITUDE:g} in size"
            raise ScenarioError(
                "path", rule, entries[column], "correct the row, or choose other units"
            )
        numbers.append(value)
    return numbers


def parse_integers(source: SourceFile, name: str, column: FloatArray) -> list[int]:
    """Return the values of the column ``name`` (K,) of a table, ids or counts, as K integers.

    Raises ScenarioError if a value is not an integer from 0 to MAX_ID.
    """
    invalid = (column != np.round(column)) | (column < 0) | (column > MAX_ID)
    if invalid.any():
        raise ScenarioError(
            "path",
            f"{source.name}: {name} must hold integers from 0 to 2^53",
            float(column[invalid][0]),
            "correct the row",
        )
    return [int(value) for value in column]
