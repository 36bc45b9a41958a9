"""How results show themselves: in a line at a prompt, with their table in a notebook."""

from __future__ import annotations

import html
from typing import Any

from netkf.core.printable import one_line

MAX_ROWS = 60
"""Rows of a table that a notebook shows; of longer ones the ends."""


class NotebookTable:
    """Base class of results: ``repr`` is a line, a notebook shows that line and ``table``, and
    completion offers public names only.
    """

    def _notebook_table(self) -> Any:
        """Return the pandas table that a notebook shows."""
        return getattr(self, "table", None)

    def _repr_html_(self) -> str:
        """Return the HTML that notebooks display."""
        line = f"<p><code>{html.escape(one_line(repr(self)))}</code></p>"
        table = self._notebook_table()
        # Texts in tables may come from files; pandas escapes them.
        rows = (
            "" if table is None else table.to_html(max_rows=MAX_ROWS, float_format="{:.4g}".format)
        )
        return f"<div>{line}{rows}</div>"

    def __dir__(self) -> list[str]:
        return sorted(name for name in super().__dir__() if not name.startswith("_"))
