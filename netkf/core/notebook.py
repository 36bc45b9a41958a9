"""Display of results: one line at a prompt, that line and a table in a notebook."""

from __future__ import annotations

from typing import Any

from netkf.core.printable import one_line

MAX_ROWS = 60
"""Rows of a table that a notebook shows; of longer tables it shows the beginning and the end."""


class NotebookTable:
    """Base class of results: a notebook shows ``repr`` and ``table``.

    Completion at a prompt offers public names only.
    """

    def _notebook_table(self) -> Any:
        """Return the pandas DataFrame that a notebook shows; None to show no table."""
        return getattr(self, "table", None)

    def _repr_html_(self) -> str:
        import html

        line = f"<p><code>{html.escape(one_line(repr(self)))}</code></p>"
        table, rows = self._notebook_table(), ""
        if table is not None:
            # Texts in tables may come from files; to_html escapes them.
            rows = table.to_html(max_rows=MAX_ROWS, float_format="{:.4g}".format)
        return f"<div>{line}{rows}</div>"

    def __dir__(self) -> list[str]:
        """Return the public names, which completion at a prompt offers."""
        return sorted(name for name in super().__dir__() if not name.startswith("_"))
