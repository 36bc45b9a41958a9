"""What netkf raises when it is asked for something it cannot do."""

from __future__ import annotations

from collections.abc import Iterable


class NetkfError(Exception):
    """Root of every error that netkf raises on purpose."""


class TheoryError(NetkfError, ValueError):
    """A theorem was asked for where its conditions fail; the message names the condition."""


class EngineError(NetkfError, RuntimeError):
    """An engine was asked for what it cannot run; the message names it and the remedy."""


class ScenarioError(NetkfError, ValueError):
    """One mistake in a scenario: where it is, the rule, the value got and what to do.

    ``str(error)`` is one line, ``file: key: rule; got value; remedy``.
    """

    def __init__(
        self, key: str, rule: str, value: object = None, remedy: str = "", file: str = ""
    ) -> None:
        self.key, self.rule, self.value, self.remedy, self.file = key, rule, value, remedy, file
        super().__init__(key, rule, value, remedy, file)

    def under(self, prefix: str) -> ScenarioError:
        """The same mistake seen from the table ``prefix`` that holds the key."""
        joint = "" if not self.key or self.key.startswith("[") else "."
        return ScenarioError(
            f"{prefix}{joint}{self.key}", self.rule, self.value, self.remedy, self.file
        )

    def in_file(self, file: str) -> ScenarioError:
        """The same mistake with the name of the file it stands in."""
        return ScenarioError(self.key, self.rule, self.value, self.remedy, self.file or file)

    def __str__(self) -> str:
        got = "" if self.value is None else f"; got {quote(self.value)}"
        remedy = f"; {self.remedy}" if self.remedy else ""
        key = _printable(self.key)
        where = ": ".join(part for part in (self.file, key) if part)
        return f"{where}: {self.rule}{got}{remedy}" if where else f"{self.rule}{got}{remedy}"


def _printable(key: str, longest: int = 120) -> str:
    shown = key if key.isprintable() else key.encode("unicode_escape").decode()
    return shown if len(shown) <= longest else f"{shown[: longest // 2]} ... {shown[-20:]}"


def nearest(word: object, known: Iterable[str]) -> str:
    """``did you mean "..."?`` and a blank where one of the known words is close, else nothing."""
    import difflib

    found = difflib.get_close_matches(str(word), list(known), n=1)
    return f'did you mean "{found[0]}"? ' if found else ""


def quote(value: object, longest: int = 80) -> str:
    """``repr`` on one line, shortened in the middle when it is long."""
    tolist = getattr(value, "tolist", None)
    text = " ".join(repr(tolist() if callable(tolist) else value).split())
    half = (longest - 5) // 2
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"
