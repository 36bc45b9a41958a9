"""Text that a terminal shows as it is: nothing in it moves the cursor or changes direction."""

from __future__ import annotations


def printable(text: str, keep: str = "\n\t") -> str:
    """Return a text whose control and format characters are escaped, those in ``keep`` excepted.

    Escaped are C0 and C1 controls, so also ANSI sequences, bidirectional and invisible format
    characters, line and paragraph separators, and surrogates: what ``repr`` escapes.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else _escape(c) for c in text)


def one_line(text: object) -> str:
    """Return a text as one line, whatever it contains: line breaks are escaped too."""
    return printable(str(text), keep="")


def shorten(text: object, longest: int = 200) -> str:
    """Return a text as one line, without its middle if it is long."""
    return cut_middle(one_line(text), longest)


def cut_middle(text: str, longest: int) -> str:
    """Return a text of at most ``longest`` characters, without its middle if it is longer."""
    half = (longest - 5) // 2
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"


def _escape(character: str) -> str:
    """Return the escape sequence of a character."""
    return character.encode("unicode_escape").decode("ascii")
