"""HTML of texts and tables: whatever comes from files is escaped here, and nowhere else."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from netkf.core.printable import printable


def text(value: object) -> str:
    """Return a text as HTML; control and bidirectional characters are made visible."""
    return escape(printable(str(value)), quote=True)


def paragraph(value: object, css: str = "") -> str:
    """Return a paragraph with a text."""
    kind = f' class="{css}"' if css else ""
    return f"<p{kind}>{text(value)}</p>"


def bullets(values: Iterable[object], css: str = "") -> str:
    """Return a list with a text in each item; empty without items."""
    items = "".join(f"<li>{text(value)}</li>" for value in values)
    kind = f' class="{css}"' if css else ""
    return f"<ul{kind}>{items}</ul>" if items else ""


def table_box(
    caption: str, header: Sequence[object], rows: Iterable[Sequence[object]], css: str = "numbers"
) -> str:
    """Return a table in a box that scrolls by itself, so that the page never does sideways. The
    first cell of a row is its header.
    """
    head = "".join(f'<th scope="col">{text(cell)}</th>' for cell in header)
    lines = []
    for first, *others in rows:
        cells = "".join(f"<td>{text(cell)}</td>" for cell in others)
        lines.append(f'<tr><th scope="row">{text(first)}</th>{cells}</tr>')
    body = "".join(lines)
    return (
        f'<div class="scroll" role="group" tabindex="0" aria-label="{text(caption)}">'
        f'<table class="{css}"><caption>{text(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def section(identity: str, title: str, body: str) -> str:
    """Return a section with a heading."""
    return (
        f'<section id="{identity}" aria-labelledby="{identity}-title">'
        f'<h2 id="{identity}-title">{text(title)}</h2>{body}</section>'
    )


def script_json(value: Any) -> str:
    """Return JSON that a script element can hold: nothing in it ends the element or begins a
    comment.
    """
    found = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        found = found.replace(character, f"\\u{ord(character):04x}")
    return found


def content_hash(source: str) -> str:
    """Return the hash of an inline script or style, as a content security policy names it."""
    digest = hashlib.sha256(source.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
