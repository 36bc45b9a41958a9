"""The exceptions that netkf raises on purpose, and helpers for their texts."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from netkf.core.printable import cut_middle, shorten


class NetkfError(Exception):
    """Base class of every error that netkf raises on purpose."""


class TheoryError(NetkfError, ValueError):
    """The conditions of a theorem fail; the message names the condition."""

    def __init__(self, message: str) -> None:
        """Take the message as one line, whatever values it quotes."""
        super().__init__(" ".join(message.split()))


class EngineError(NetkfError, RuntimeError):
    """An engine cannot run a scenario; the message names the cause and the remedy."""


class WriteError(NetkfError, OSError):
    """A file cannot be written; ``str(error)`` is one line with the reason and the path."""

    def __init__(self, cause: OSError, path: object) -> None:
        """Take the reason from the error ``cause`` of the system, and the ``path`` of the file."""
        reason = os.strerror(cause.errno) if cause.errno else str(cause)
        # The path is not passed on: with three arguments OSError would choose a subclass.
        super().__init__(cause.errno, reason)
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
        """Store the ``key`` at fault, the ``rule`` that it breaks, its ``value``, the ``remedy``
        and the name of the ``file``, "" if there is none.
        """
        self.key, self.rule, self.value, self.remedy, self.file = key, rule, value, remedy, file
        super().__init__(key, rule, value, remedy, file)

    def under(self, prefix: str) -> ScenarioError:
        """Return this error with ``prefix``, the table that holds the key, before the key.

        The code that reads the table calls it: a rule that raises knows only the key inside it.
        """
        separator = "" if not self.key or self.key.startswith("[") else "."
        key = f"{prefix}{separator}{self.key}"
        return ScenarioError(key, self.rule, self.value, self.remedy, self.file)

    def in_file(self, file: str) -> ScenarioError:
        """Return this error with the name of its file, unless it has one."""
        return ScenarioError(self.key, self.rule, self.value, self.remedy, self.file or file)

    def __str__(self) -> str:
        """Return one line, ``file: key: rule; got value; remedy``, each part shortened."""
        # All texts are limited: they may contain names of keys, classes and files of any length.
        file, key = shorten(self.file, 1000), shorten(self.key, 120)
        rule, remedy = shorten(self.rule, 1000), shorten(self.remedy, 700)
        got = "" if self.value is None else f"; got {quote(self.value)}"
        message = f"{rule}{got}; {remedy}" if remedy else f"{rule}{got}"
        return ": ".join(text for text in (file, key, message) if text)


@contextmanager
def errors_under(prefix: str) -> Iterator[None]:
    """Put ``prefix``, the table that a block of code checks, before keys of ScenarioErrors."""
    try:
        yield
    except ScenarioError as error:
        raise error.under(prefix) from None


MAX_WORD = 100
"""Longest word, in characters, for which a similar one is looked for."""


def suggest_nearest(word: object, candidates: Iterable[str]) -> str:
    """Return ``did you mean "..."? `` with the candidate nearest to ``word``; "" if none."""
    # Imported here: only a wrong word needs it.
    import difflib

    if len(str(word)) > MAX_WORD:
        return ""
    matches = difflib.get_close_matches(str(word), list(candidates), n=1)
    return f'did you mean "{matches[0]}"? ' if matches else ""


def quote(value: object, max_length: int = 80) -> str:
    """Return ``repr(value)`` on one line, arrays as lists, shortened in the middle to
    ``max_length`` characters if it is longer.
    """
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        value = type(value)(getattr(one, "tolist", lambda one=one: one)() for one in value)
    tolist = getattr(value, "tolist", None)
    try:
        text = " ".join(repr(tolist() if callable(tolist) else value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, deeply nested tables
        text = f"a large {type(value).__name__}"
    return cut_middle(text, max_length)
