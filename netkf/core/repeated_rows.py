"""Rows of tables that repeat or contradict each other, and counts of the rows that a run uses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Generic, NamedTuple, TypeVar

from netkf.core.csv_files import Columns
from netkf.core.errors import ScenarioError

Key = TypeVar("Key", bound=Hashable)
Subject = TypeVar("Subject", bound=Hashable)
Value = TypeVar("Value")


class RowUse(NamedTuple):
    """Numbers of ``rows`` of the file ``path``, of those that are ``used``, and of those that are
    ``merged``, because they repeat a used row; the others are unused.
    """

    path: str
    rows: int
    used: int
    merged: int

    @property
    def unused(self) -> int:
        """Number of rows that are neither used nor merged."""
        return self.rows - self.used - self.merged


class KeyedTable(NamedTuple, Generic[Subject, Value, Key]):
    """A table that was read: what it says of each subject, its columns, the key of each row."""

    of: dict[Subject, Value]
    columns: Columns
    keys: list[Key]


def count_rows(path: str, keys: Iterable[Key], is_used: Callable[[Key], bool]) -> RowUse:
    """Return the use of the rows of the file ``path``: of the rows with equal ``keys`` one is used,
    if ``is_used(key)``, and the others are merged with it.
    """
    counts = Counter(keys)
    used = [count for key, count in counts.items() if is_used(key)]
    return RowUse(path, counts.total(), len(used), sum(used) - len(used))


def add_uses(uses: Sequence[RowUse]) -> RowUse:
    """Return the use of one file by several, each of whom has rows of its own."""
    rows, used, merged = (sum(counts) for counts in zip(*(use[1:] for use in uses), strict=True))
    return RowUse(uses[0].path, rows, used, merged)


def first_rows(
    table: Columns,
    keys: Iterable[Key],
    values: Sequence[object] | None = None,
    rule: str = "",
    remedy: str = "correct one of the two rows",
) -> dict[Key, int]:
    """Return the index of the first row of each key, in the order of rows; ``keys`` say of each row
    what it is about, such as a node and a time.

    Raises ScenarioError with the text ``rule`` and both line numbers if two rows with one key have
    different ``values``; without values rows with one key are equal.
    """
    first: dict[Key, int] = {}
    for row, key in enumerate(keys):
        earlier = first.setdefault(key, row)
        if values is not None and values[earlier] != values[row]:
            pair = [_printable(values[earlier]), _printable(values[row])]
            raise ScenarioError("path", f"{table.where(earlier, row)}: {rule}", pair, remedy)
    return first


def _printable(value: object) -> object:
    if isinstance(value, (tuple, list)):
        return [_printable(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
