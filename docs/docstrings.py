"""Docstrings as reStructuredText: prose, lists of fields, and code only where it is code.

A docstring of netkf is plain text with code between backticks. A paragraph whose lines give names
and, aligned in a column, what they are, is a list of fields::

    times  (T,) in seconds
    gains  (n, p), one for all nodes, or a list
           with one per node
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

CODE = re.compile(r"(``.+?``|`.+?`)", re.DOTALL)
MARKUP = re.compile(r"([\\*|_])")
NAMES = r"[A-Za-z_]\w*(?:, [A-Za-z_]\w*)*"
WIDE = re.compile(rf"^({NAMES})(?:\s+: | {{2,}})(\S.*)$")
NARROW = re.compile(rf"^({NAMES}) (\S.*)$")
CODE_FOLLOWS = "::"


def restructured(lines: Sequence[str]) -> list[str]:
    """Return the lines of a docstring as reStructuredText."""
    found: list[str] = []
    code = False  # a paragraph that ends with two colons is followed by code
    for paragraph in _paragraphs(lines):
        indented = all(line.startswith(" ") for line in paragraph)
        if code and indented:
            found += [*paragraph, ""]
            continue
        code = paragraph[-1].endswith(CODE_FOLLOWS)
        fields = list(_fields(paragraph))
        if fields:
            for names, text in fields:
                marked = ", ".join(f"``{name}``" for name in names.split(", "))
                found.append(f"- {marked}: {_escaped(text)}")
        else:
            found += _escaped("\n".join(_items(paragraph))).split("\n")
        found.append("")
    return found


def _paragraphs(lines: Sequence[str]) -> Iterator[list[str]]:
    paragraph: list[str] = []
    for line in [*lines, ""]:
        if line.strip():
            paragraph.append(line.rstrip())
        elif paragraph:
            yield paragraph
            paragraph = []


def _fields(paragraph: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield names and text of each field if the paragraph is a list of fields, else nothing."""
    indents = [len(line) - len(line.lstrip()) for line in paragraph]
    column = min((indent for indent in indents if indent), default=0)
    heads = [line for line, indent in zip(paragraph, indents, strict=True) if not indent]
    # One space is enough where further lines show the column of the text.
    if not heads or not all(WIDE.match(line) or (column and _at(line, column)) for line in heads):
        return
    names, text = "", []
    for line, indent in zip(paragraph, indents, strict=True):
        if indent:
            text.append(line.strip())
            continue
        if names:
            yield names, " ".join(text)
        match = WIDE.match(line) or NARROW.match(line)
        assert match is not None
        names, text = match[1], [match[2]]
    yield names, " ".join(text)


def _at(line: str, column: int) -> bool:
    """Return True if names are followed by text that begins in this column."""
    return bool(re.match(rf"^{NAMES} +$", line[:column])) and line[column : column + 1] != " "


def _items(paragraph: Sequence[str]) -> list[str]:
    """Return prose without the indentation of continued lines, and lists as they are."""
    if any(line.lstrip().startswith("- ") for line in paragraph):
        return list(paragraph)
    return [line.strip() for line in paragraph]


def _escaped(text: str) -> str:
    """Return text in which matrices and norms are not read as markup."""
    parts = CODE.split(text)
    return "".join(
        f"``{part.strip('`')}``" if k % 2 else MARKUP.sub(r"\\\1", part)
        for k, part in enumerate(parts)
    )
