"""The history of the table: what is added is read back, and all rows are in it."""

from tests.benchmarks.history import HISTORY, Entry, add, read
from tests.benchmarks.rows import ROWS
from tests.benchmarks.table import Measured


def test_ratios_are_added_without_times(tmp_path):
    path = tmp_path / "history.csv"
    add([(ROWS[0], Measured(168.8e-6, 62.7e-6, 2.692))], path)
    add([(ROWS[-1], Measured(2.0, 1.0, 2.0))], path)
    first, last = read(path)
    assert (first.row, first.ratio, first.limit) == (ROWS[0].name, "2.69", "<= 3")
    assert last.row == ROWS[-1].name
    assert first.commit
    assert "numba" in first.versions
    assert len(path.read_text().splitlines()) == 3


def test_the_kept_history_has_all_rows_of_the_table():
    entries = read()
    assert {row.name for row in ROWS} <= {entry.row for entry in entries}
    assert [entry.date for entry in entries] == sorted(entry.date for entry in entries)
    assert all(float(entry.ratio) > 0.0 for entry in entries)
    assert HISTORY.read_text().startswith(",".join(Entry._fields))
