"""Reading of the tables of scenarios; errors name the file and the line.

Every recorded table goes through here. Columns are separated by commas, semicolons or tabs, as the
line of their names shows; with semicolons and tabs numbers may have decimal commas. Lines that
begin with # are comments, wherever they stand; empty lines say nothing. A file may be compressed by
gzip. Columns of STAMPS hold times: numbers or ISO 8601, counted from ``[time] origin``.
"""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import math
import re
import zlib
from array import array
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError, suggest_nearest
from netkf.core.fields import MAX_BYTES, MAX_MAGNITUDE, SourceFile
from netkf.core.printable import MAX_NAME, NamedNode
from netkf.linalg.arrays import FloatArray

MAX_ID = 2**53  # larger integers are not exact as floating-point numbers
STAMPS = ("t", "from", "until")
"""The columns that hold times, in every table."""
NODES = ("node", "peer", "sender", "receiver", "to")
"""The columns that hold nodes, by id or by name, in every table."""
_ADDRESS = re.compile(r"[0-9]+[eE][0-9]+")
"""Hexadecimal addresses of motes that look like numbers, such as 12e4; large numbers that programs
write have a sign or a point, as 1e+05 has.
"""
_FOREIGN = {
    b"PK": "it is a zip file or a spreadsheet; save the table as CSV",
    b"\xff\xfe": "it is UTF-16 text; save it as UTF-8",
    b"\xfe\xff": "it is UTF-16 text; save it as UTF-8",
}
"""What files are that begin so, and what to do."""


class Columns(dict[str, FloatArray]):
    """The columns of a table by name, each (K,), for its K rows; stamps in simulated seconds.

    source, lines : the file, and the number (K,) of each row's line in it
    half_digits : (K,), half of the last digit of each stamp t in seconds; empty without such a
                  column
    file_rows : the number of all rows of the file, of which these may be a part
    """

    def __init__(self, source: SourceFile, lines: np.ndarray, half_digits: FloatArray) -> None:
        super().__init__()
        self.source, self.lines, self.half_digits = source, lines, half_digits
        self.file_rows = len(lines)

    def where(self, *rows: int) -> str:
        """Return the name of the file and the lines of ``rows`` (indices), as messages begin."""
        listed = " and ".join(str(self.lines[row]) for row in sorted(rows))
        return f"{self.source.name} line{'s' if len(rows) > 1 else ''} {listed}"

    def refuse_early(self, early: np.ndarray, rule: str) -> None:
        """Raise ScenarioError with the text ``rule`` and the line of the first of the rows that are
        too ``early`` (indices), if no origin is given: a longer log may begin anywhere.
        """
        if early.size and not self.source.stamps.origin:
            row = int(early[0])
            remedy = "set [time] origin to where the run begins in the log"
            raise ScenarioError("path", f"{self.where(row)}: {rule}", float(self["t"][row]), remedy)

    def of_node(self, node: int | None) -> Columns:
        """Return the rows of ``node`` (id), or all of a table without a column node.

        Raises ScenarioError if there are none, or for several nodes where ``node`` is None.
        """
        if "node" not in self:
            return self
        if node is None:
            rule = f"{self.source.name} has a column node, which belongs to blocks of nodes"
            remedy = "write [[plants]] with nodes, or remove the column"
            raise ScenarioError("path", rule, None, remedy)
        chosen = np.array(self.integers("node"), dtype=np.int64) == node
        if not chosen.any():
            rule = f"{self.source.name} has no row of node {node}"
            raise ScenarioError("path", rule, None, "add some, or take it from nodes")
        rows = Columns(self.source, self.lines[chosen], self.half_digits[chosen])
        rows.file_rows = self.file_rows
        rows.update((name, column[chosen]) for name, column in self.items())
        return rows

    def integers(self, name: str) -> list[int]:
        """Return the column ``name`` as K integers, ids or counts; raises ScenarioError, with the
        line, for a value that is not an integer from 0 to MAX_ID. Names of nodes are below 0 until
        the graph is known, see SourceFile.
        """
        column = self[name]
        low = -len(self.source.unknown)
        wrong = np.flatnonzero((column != np.round(column)) | (column < low) | (column > MAX_ID))
        if wrong.size:
            rule = f"{self.where(int(wrong[0]))}: {name} must hold integers from 0 to 2^53"
            raise ScenarioError("path", rule, float(column[wrong[0]]), "correct it")
        # Ids of nodes that have names are printed as these.
        named = {int(node): node for node in (self.source.node_ids or {}).values()}
        named |= {code: NamedNode(code, name) for name, code in self.source.unknown.items()}
        return [named.get(int(value), int(value)) for value in column]


def read_columns(
    source: SourceFile,
    required: tuple[str, ...],
    optional: tuple[str, ...] = (),
    gaps: Collection[str] = (),
    nodes: Collection[str] = NODES,
    words: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
    new_nodes: bool = False,
) -> Columns:
    """Return the named columns, optional ones only if they are there. Entries of columns in
    ``gaps`` may be empty or nan, and are nan then; those of columns in ``nodes`` may be names, and
    are ids then; those of a column in ``words`` are one of these, and its index then. Of a table of
    ``new_nodes`` names must not look like numbers, such as -1.

    Raises ScenarioError, with the file and the line, for a missing column, a row of another length
    than the header, or an entry that is not a finite number, or no stamp in a column of STAMPS.
    """
    numbers, lines, halves = array("d"), array("q"), array("d")
    with open_table(source) as sheet:
        _require_columns(source, sheet, required)
        names = [name for name in (*required, *optional) if name in sheet.header]
        for name in names:
            if sheet.header.count(name) > 1:
                rule = f"{source.name} must have one column {name}"
                raise ScenarioError("path", rule, sheet.header, "rename the others")
        entries = _Entries(source, sheet, new_nodes)
        places = [(sheet.header.index(n), n in nodes, n in STAMPS, n in gaps) for n in names]
        named = {sheet.header.index(name): words[name] for name in names if name in words}
        for line, row in sheet.rows:
            entries.begin(line, row)
            lines.append(line)
            for column, is_node, is_stamp, may_miss in places:
                if column in named:
                    numbers.append(entries.word(column, named[column]))
                elif is_node:
                    numbers.append(entries.node(column, may_miss))
                elif is_stamp:
                    numbers.append(entries.stamp(column))
                else:
                    numbers.append(entries.number(column, may_miss))
                if sheet.header[column] == "t":
                    halves.append(source.stamps.half_digit(row[column].replace(",", ".").strip()))
    columns = Columns(source, np.array(lines, dtype=np.int64), np.array(halves))
    table = np.array(numbers, dtype=np.float64).reshape(len(lines), len(names))
    columns.update(zip(names, np.ascontiguousarray(table.T), strict=True))
    return columns


def read_header(source: SourceFile) -> list[str]:
    """Return the names of the columns; raises ScenarioError if the file is not a table."""
    with open_table(source) as sheet:
        return sheet.header


class _Sheet(NamedTuple):
    """An open table: names of columns, rows with the numbers of their lines, the separator, and the
    comments above the names, by line.
    """

    header: list[str]
    rows: Iterator[tuple[int, list[str]]]
    separator: str
    comments: dict[int, str]


class _Entries:
    """The entries of one row after the other, as numbers."""

    def __init__(self, source: SourceFile, sheet: _Sheet, new_nodes: bool) -> None:
        self._source, self._header, self._separator = source, sheet.header, sheet.separator
        self._new_nodes = new_nodes
        self._line, self._row = 0, [""]
        # The first lines with a decimal comma and a decimal point: a table must not mix them.
        self._commas: dict[str, int] = {}

    def begin(self, line: int, row: list[str]) -> None:
        """Go to the ``row`` in this ``line``; raises ScenarioError if it is too long or short."""
        self._line, self._row = line, row
        if len(row) != len(self._header):
            rule = f"{self._source.name} line {line} must have {len(self._header)} entries"
            remedy = "correct the row"
            if len(row) > len(self._header) and self._separator == ",":
                remedy += "; with decimal commas separate columns by semicolons"
            raise ScenarioError("path", rule, row, remedy)

    def number(self, column: int, may_miss: bool) -> float:
        """Return the entry in the column with this index; nan if it is empty or nan and
        ``may_miss``. Raises ScenarioError if it is not a finite number of at most MAX_MAGNITUDE.
        """
        text = self._row[column].strip()
        if may_miss and text.lower() in ("", "nan"):
            return math.nan
        number = self._with_point(text)
        try:
            value = math.nan if "_" in text else float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            remedy = "write a decimal point, no commas" if "," in text else "correct the entry"
            remedy += ", or leave it empty if it is missing" if may_miss else ""
            raise self._refusal(column, "must be a finite number", remedy)
        return self._limited(column, value)

    def word(self, column: int, words: tuple[str, ...]) -> int:
        """Return the index in ``words`` of a column's entry; raises ScenarioError for others."""
        word = self._row[column].strip()
        if word not in words:
            remedy = f"{suggest_nearest(word, words)}correct the entry"
            raise self._refusal(column, f"must be {', '.join(words[:-1])} or {words[-1]}", remedy)
        return words.index(word)

    def node(self, column: int, may_miss: bool) -> float:
        """Return the id of the node in the column with this index, or the negative number that
        stands for its name until the graph is known; raises ScenarioError if it is neither.
        """
        name, source = self._row[column].strip(), self._source
        if source.node_ids and name in source.node_ids:
            return source.node_ids[name]
        if not name and not may_miss:
            raise self._refusal(column, "must be the id or the name of a node", "correct the entry")
        is_number = is_number_text(name) and not _ADDRESS.fullmatch(name)
        if is_number and source.node_ids is None and not self._new_nodes:
            # A node of a graph of networkx may be -1, or nan: then that is its name.
            is_number = 0.0 <= float(name.replace(",", ".")) < math.inf
        if not name or is_number:
            number = self.number(column, may_miss)
            if number < 0.0:
                raise self._refusal(column, "must be an integer from 0 to 2^53", "correct it")
            return number
        if source.node_ids is None and len(name) <= MAX_NAME and name.isprintable():
            return source.unknown.setdefault(name, -1 - len(source.unknown))
        remedy = f"{suggest_nearest(name, source.node_ids or ())}correct it, or the graph"
        remedy += "; landmarks have numbers" if self._header[column] == "to" else ""
        raise self._refusal(column, "must name a node of the graph", remedy)

    def stamp(self, column: int) -> float:
        """Return the time in the column with this index, in simulated seconds; raises ScenarioError
        if it is neither a number nor an ISO 8601 time.
        """
        stamp = self._with_point(self._row[column].strip())
        try:
            value = self._source.stamps.seconds(stamp)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            rule = "must be a finite number or an ISO 8601 time"
            raise self._refusal(column, rule, "correct the entry")
        return self._limited(column, value)

    def _with_point(self, text: str) -> str:
        if self._separator == "," or ":" in text:
            return text
        for sign in ",.":
            if sign in text:
                self._commas.setdefault(sign, self._line)
        if len(self._commas) == 2:
            rule = f"{self._source.name} must not mix decimal commas and points"
            lines = " and ".join(f"line {line} has {sign!r}" for sign, line in self._commas.items())
            raise ScenarioError("path", f"{rule}: {lines}", text, "write all numbers alike")
        return text.replace(",", ".") if text.count(",") == 1 else text

    def _limited(self, column: int, value: float) -> float:
        if abs(value) > MAX_MAGNITUDE:
            rule = f"must be at most {MAX_MAGNITUDE:g} in size"
            raise self._refusal(column, rule, "correct it, or choose other units")
        return value

    def _refusal(self, column: int, rule: str, remedy: str) -> ScenarioError:
        where = f"{self._source.name} line {self._line}: {self._header[column]}"
        return ScenarioError("path", f"{where} {rule}", self._row[column], remedy)


def _require_columns(source: SourceFile, sheet: _Sheet, required: tuple[str, ...]) -> None:
    header = sheet.header
    missing = [name for name in required if name not in header]
    if not missing:
        return
    rule = f"{source.name} must have the columns {', '.join(required)}"
    alike = [name for name in header if name.casefold() == missing[0].casefold()]
    named = [line for line, text in sheet.comments.items() if missing[0] in _split_text(text)]
    remedy = f"add the column {missing[0]}"
    if named:
        remedy = f"remove the # before the names of the columns in line {named[-1]}"
    elif alike:
        remedy = f"write {missing[0]} for {alike[0]}"
    elif len(header) == 1 and missing[0] in _split_text(header[0]):
        remedy = "separate the columns by commas, semicolons or tabs"
    elif all(map(is_number_text, header)):
        remedy = "write the names of the columns in the first line"
    raise ScenarioError("path", rule, header, remedy)


def _split_text(text: str) -> list[str]:
    for sign in "#,;|:":
        text = text.replace(sign, " ")
    return text.split()


def is_number_text(text: str) -> bool:
    """Return True for a number, with a decimal point or comma; 1_2 is none, but a name."""
    if "_" in text:
        return False
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


class _TooLargeError(Exception):
    """A table has more than MAX_BYTES."""


class _Bounded(io.RawIOBase):
    """The bytes of a file, at most MAX_BYTES: a small compressed file may hold very many."""

    def __init__(self, file: io.BufferedIOBase | io.BufferedReader) -> None:
        self._file, self._left = file, MAX_BYTES

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        data = self._file.read(len(buffer))
        self._left -= len(data)
        if self._left < 0:
            raise _TooLargeError
        buffer[: len(data)] = data
        return len(data)


class _Lines:
    """The lines of a file without comments; ``number`` is that of the last one, from 1 on, and
    ``comments`` are those so far above the first line that is none.
    """

    def __init__(self, file: io.TextIOWrapper) -> None:
        self._file, self.number = file, 0
        self.comments: dict[int, str] = {}

    def __iter__(self) -> Iterator[str]:
        """Yield the lines that are no comments."""
        is_first = True
        for line in self._file:
            self.number += 1
            if not line.lstrip().startswith("#"):
                is_first = is_first and not line.strip()
                yield line
            elif is_first:
                self.comments[self.number] = line


@contextmanager
def _unpacked(source: SourceFile, what: str, if_too_large: str) -> Iterator[_Bounded]:
    """Yield an open file, unpacked if it is compressed by gzip; raises ScenarioError if it cannot
    be read as ``what``, or has more than MAX_BYTES, with this remedy.
    """
    start = b""
    try:
        kept = None if source.content is None else io.BytesIO(source.content)
        with source.full.open("rb") if kept is None else io.BufferedReader(kept) as packed:
            start = packed.peek(2)[:2]  # pipes cannot go back
            yield _Bounded(gzip.GzipFile(fileobj=packed) if start == b"\x1f\x8b" else packed)
    except _TooLargeError:
        rule = f"{source.name} must have at most {MAX_BYTES >> 20} MiB"
        raise ScenarioError("path", rule, None, if_too_large) from None
    except (OSError, EOFError, zlib.error, UnicodeDecodeError, csv.Error) as error:
        encoding = "save it as UTF-8" if isinstance(error, UnicodeDecodeError) else ""
        remedy = _FOREIGN.get(start, encoding or "correct the file")
        raise ScenarioError(
            "path", f"{source.name} cannot be read{what}", str(error), remedy
        ) from None


def read_content(source: SourceFile) -> bytes:
    """Return the bytes of a file, unpacked if it is compressed by gzip; raises ScenarioError if it
    cannot be read or has more than MAX_BYTES.
    """
    with _unpacked(source, "", "leave out attributes") as file:
        return file.readall() or b""


@contextmanager
def open_table(source: SourceFile) -> Iterator[_Sheet]:
    """Yield the header and the rows, as texts, of an open table; ScenarioError if it is none."""
    remedy = "split readings among several [[sensors]] entries, or write fewer digits"
    with _unpacked(source, " as a UTF-8 table", remedy) as unpacked:
        buffered = io.BufferedReader(unpacked, 1 << 16)
        with io.TextIOWrapper(buffered, newline="", encoding="utf-8-sig") as file:
            lines = _Lines(file)
            texts = (line for line in lines if line.strip())
            names = next(texts, "")
            if names.lower().lstrip('"').startswith("sep="):  # a line that spreadsheets write
                names = next(texts, "")
            separator = next((s for s in ";\t" if s in names), ",")
            reader = csv.reader(itertools.chain([names], texts), delimiter=separator)
            header = [name.strip() for name in next(reader, [])]
            rows = ((lines.number, row) for row in reader if any(map(str.strip, row)))
            yield _Sheet(header, rows, separator, lines.comments)
