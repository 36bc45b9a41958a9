"""HTML of texts and tables, all of which are escaped here alone, and columns of numbers as text."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from netkf.core.printable import printable


def text(value: object) -> str:
    """Return a value as escaped HTML text, with control and bidirectional characters visible."""
    return escape(printable(str(value)), quote=True)


def paragraph(value: object, css_class: str = "") -> str:
    """Return a paragraph that holds a text."""
    attribute = f' class="{css_class}"' if css_class else ""
    return f"<p{attribute}>{text(value)}</p>"


def bullets(values: Iterable[object], css_class: str = "") -> str:
    """Return a list with a text in each item; an empty string without items."""
    items = "".join(f"<li>{text(value)}</li>" for value in values)
    attribute = f' class="{css_class}"' if css_class else ""
    return f"<ul{attribute}>{items}</ul>" if items else ""


def table_box(
    caption: str,
    header: Sequence[object],
    rows: Iterable[Sequence[object]],
    css_class: str = "numbers",
) -> str:
    """Return a table that scrolls by itself; the first cell of a row is its title."""
    head = "".join(f'<th scope="col">{text(cell)}</th>' for cell in header)
    lines = []
    for row_title, *cells in rows:
        columns = "".join(f"<td>{text(cell)}</td>" for cell in cells)
        lines.append(f'<tr><th scope="row">{text(row_title)}</th>{columns}</tr>')
    body = "".join(lines)
    return (
        f'<div class="scroll" role="group" tabindex="0" aria-label="{text(caption)}">'
        f'<table class="{css_class}"><caption>{text(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def section(element_id: str, title: str, body: str) -> str:
    """Return a section with the heading ``title``; ``body`` is HTML."""
    return (
        f'<section id="{element_id}" aria-labelledby="{element_id}-title">'
        f'<h2 id="{element_id}-title">{text(title)}</h2>{body}</section>'
    )


def script_json(value: Any) -> str:
    """Return JSON that a script element can hold; raises ValueError for numbers not finite."""
    document = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        document = document.replace(character, f"\\u{ord(character):04x}")
    return document


def content_hash(source: str) -> str:
    """Return the SHA-256 source expression of an inline script or style."""
    digest = hashlib.sha256(source.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


TYPES = {"f8": "<f8", "u4": "<u4", "u2": "<u2", "u1": "u1", "i2": "<i2"}
"""NumPy types of columns by the names that a page uses."""


class Packer:
    """Collects columns of numbers and returns them as one text, without loss.

    The bytes of a column are transposed, all first bytes before all second bytes: neighbouring
    numbers share their leading bytes, which gzip compresses better side by side.
    """

    def __init__(self) -> None:
        self._columns: list[bytes] = []

    def add(self, values: Any, dtype: str) -> dict[str, Any]:
        """Append an array of a type of TYPES; return its index, type and shape for the page."""
        column = np.ascontiguousarray(values, dtype=TYPES[dtype])
        # The first byte of all numbers, then the second, and so on: these compress better.
        octets = np.frombuffer(column.tobytes(), dtype=np.uint8)
        self._columns.append(octets.reshape(column.size, column.itemsize).T.tobytes())
        return {"part": len(self._columns) - 1, "type": dtype, "shape": list(column.shape)}

    def text(self) -> tuple[str, list[int]]:
        """Return all columns as base64 text, and the number of uncompressed bytes of each one."""
        compressed = gzip.compress(b"".join(self._columns), compresslevel=9, mtime=0)
        return base64.b64encode(compressed).decode("ascii"), list(map(len, self._columns))
