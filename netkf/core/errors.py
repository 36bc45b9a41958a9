"""The exceptions that netkf raises on purpose, and the texts in them."""

from __future__ import annotations

import os
from collections.abc import Iterable

from netkf.core.printable import cut_middle, shorten


class NetkfError(Exception):
    """Base class of every error that netkf raises on purpose."""


class TheoryError(NetkfError, ValueError):
    """The conditions of a theorem fail; the message names the condition."""


class EngineError(NetkfError, RuntimeError):
    """An engine cannot run a scenario; the message names the cause and the remedy."""


class WriteError(NetkfError, OSError):
    """A file cannot be written; ``str(error)`` is one line with the reason and the path."""

    def __init__(self, cause: OSError, path: object) -> None:
        # With three arguments OSError would choose a subclass by the number.
        known = os.strerror(cause.errno) if cause.errno else str(cause)
        super().__init__(cause.errno, known)
        self.filename = str(path)

    def __str__(self) -> str:
        return f"cannot write: {self.strerror} ({shorten(self.filename, 1000)})"


class ScenarioError(NetkfError, ValueError):
    """A mistake in a scenario: its key, the broken rule, the value and the remedy.

    ``str(error)`` is one line, ``file: key: rule; got value; remedy``.
    """

    def __init__(
        self, key: str, rule: str, value: object = None, remedy: str = "", file: str = ""
    ) -> None:
        self.key, self.rule, self.value, self.remedy, self.file = key, rule, value, remedy, file
        super().__init__(key, rule, value, remedy, file)

    def under(self, prefix: str) -> ScenarioError:
        """Return this error with ``prefix``, the table that holds the key, before the key."""
        joint = "" if not self.key or self.key.startswith("[") else "."
        return ScenarioError(
            f"{prefix}{joint}{self.key}", self.rule, self.value, self.remedy, self.file
        )

    def in_file(self, file: str) -> ScenarioError:
        """Return this error with the name of its file, unless it has one."""
        return ScenarioError(self.key, self.rule, self.value, self.remedy, self.file or file)

    def __str__(self) -> str:
        got = "" if self.value is None else f"; got {quote(self.value)}"
        # Rules and remedies name keys and classes, which may be of any length.
        rule, remedy = shorten(self.rule, 1000), shorten(self.remedy, 700)
        where = ": ".join(filter(None, (shorten(self.file, 1000), shorten(self.key, 120))))
        message = f"{rule}{got}; {remedy}" if remedy else f"{rule}{got}"
        return f"{where}: {message}" if where else message


MAX_WORD = 100
"""Characters of a word that is compared with the known ones."""


def nearest(word: object, known: Iterable[str]) -> str:
    """Return ``did you mean "..."?`` and a space if a known word is close, else an empty text."""
    import difflib

    if len(str(word)) > MAX_WORD:
        return ""
    found = difflib.get_close_matches(str(word), list(known), n=1)
    return f'did you mean "{found[0]}"? ' if found else ""


def quote(value: object, longest: int = 80) -> str:
    """Return ``repr(value)`` on one line, shortened in the middle if it is long."""
    tolist = getattr(value, "tolist", None)
    try:
        text = " ".join(repr(tolist() if callable(tolist) else value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, tables within tables
        text = f"a large {type(value).__name__}"
    return cut_middle(text, longest)
