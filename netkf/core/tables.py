"""Small CSV tables that scenarios name: read whole, checked column by column."""

from __future__ import annotations

import csv
import math

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile


def read_columns(
    source: SourceFile, required: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, FloatArray]:
    """The named columns as float arrays of equal length.

    Raises ScenarioError, with the file and the line, for a missing column, a row of another
    length, or an entry that is not a finite number.
    """
    with source.full.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in required if name not in header]
        if missing:
            raise ScenarioError(
                "path",
                f"{source.name} must have the columns {', '.join(required)}",
                header,
                f"add the column {missing[0]}",
            )
        names = [name for name in (*required, *optional) if name in header]
        places = [header.index(name) for name in names]
        rows = [_numbers(source, reader.line_num, header, r, places) for r in reader if r]
    columns = np.array(rows, dtype=np.float64).reshape(len(rows), len(names)).T
    return dict(zip(names, columns, strict=True))


def _numbers(
    source: SourceFile, line: int, header: list[str], entries: list[str], places: list[int]
) -> list[float]:
    where = f"{source.name} line {line}"
    if len(entries) != len(header):
        raise ScenarioError(
            "path", f"{where} must have {len(header)} entries", entries, "mend the row"
        )
    numbers = []
    for place in places:
        try:
            value = float(entries[place])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ScenarioError(
                "path",
                f"{where}: {header[place]} must be a finite number",
                entries[place],
                "mend the row",
            )
        numbers.append(value)
    return numbers


def whole(source: SourceFile, name: str, column: FloatArray) -> list[int]:
    """A column of node ids or counts as Python integers; raises ScenarioError for fractions."""
    wrong = np.flatnonzero(column != np.round(column))
    if wrong.size:
        raise ScenarioError(
            "path",
            f"{source.name}: {name} must hold integers",
            float(column[wrong[0]]),
            "mend the row",
        )
    return [int(value) for value in column]
