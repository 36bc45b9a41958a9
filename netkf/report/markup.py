"""HTML of texts and tables. All texts are escaped here, and nowhere else."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

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
