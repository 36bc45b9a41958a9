"""Texts that are safe to print in a terminal, and shortened texts."""

from __future__ import annotations

from collections.abc import Sequence

MAX_NAME = 200
"""Longest name of a node, in characters."""
MAX_RUNS = 100_000_000
"""Most runs or draws: larger numbers are typing errors."""


class NamedNode(int):
    """The id of a node that the graph's file names: an integer that is printed as the ``name``."""

    name: str

    def __new__(cls, node: int, name: str) -> NamedNode:
        """Return the id ``node`` with its name."""
        named = super().__new__(cls, node)
        named.name = name
        return named

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        return repr(self.name)

    def __format__(self, spec: str) -> str:
        """Return the name, or the id by a format of numbers."""
        return format(int(self), spec) if spec else self.name

    def __reduce__(self) -> tuple[type[NamedNode], tuple[int, str]]:
        return NamedNode, (int(self), self.name)


def printable(text: str, keep: str = "\n\t") -> str:
    """Return a text with control and format characters escaped as in ``repr``, except ``keep``.

    Nothing in it can move the cursor, change colors or the direction of writing: escaped are C0 and
    C1 controls (which begin ANSI sequences), bidirectional and invisible format characters, line
    and paragraph separators, and surrogates.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def one_line(text: object) -> str:
    """Return a text as :func:`printable` does, with line breaks and tabs escaped too."""
    return printable(str(text), keep="")


def list_some(values: Sequence[object], most: int) -> str:
    """Return ``values`` as a list, "1, 2, ..." where there are more than ``most``."""
    return ", ".join(map(str, values[:most])) + (", ..." if len(values) > most else "")


def count_phrase(count: int, what: str) -> str:
    """Return a count with its noun, in the plural unless it is 1."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def shorten(text: object, max_length: int = 200) -> str:
    """Return a text as one line of at most ``max_length`` characters, see :func:`cut_middle`."""
    return cut_middle(one_line(text), max_length)


def cut_middle(text: str, max_length: int) -> str:
    """Return a text of at most ``max_length`` characters: " ... " replaces the middle if needed."""
    half = (max_length - 5) // 2
    return text if len(text) <= max_length else f"{text[:half]} ... {text[-half:]}"
