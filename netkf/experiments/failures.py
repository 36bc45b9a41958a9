"""What becomes of a run that does not end: who is to blame, and what the user is told."""

from __future__ import annotations

import traceback
from pathlib import Path

from netkf.core.errors import EngineError, NetkfError
from netkf.core.fields import Part
from netkf.scenario.reading import plugged_in
from netkf.scenario.scenario import Scenario


class InterruptedRunError(KeyboardInterrupt):
    """A run was stopped; ``directory`` holds what it had."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        super().__init__(f"what was finished is kept in {directory}")


def told(scenario: Scenario, error: BaseException, directory: Path) -> BaseException:
    """The exception that a run ends with: one that names the plugged-in class where there is one,
    else ``error`` itself.
    """
    if isinstance(error, KeyboardInterrupt):
        return InterruptedRunError(directory)
    parts = plugged_in(scenario)
    if not isinstance(error, Exception) or isinstance(error, (NetkfError, OSError)) or not parts:
        return error
    part, method = _innermost(parts, error)
    where = f" in {method}" if method else ""
    return EngineError(
        f"{type(part).__module__}:{type(part).__qualname__} failed{where}: {in_words(error)}; "
        f"the traceback is in {directory / 'manifest.json'}"
    )


def in_words(error: BaseException) -> str:
    """The exception on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300].rstrip(": ")


def _innermost(parts: list[Part], error: Exception) -> tuple[Part, str]:
    """The plugged-in part in whose method it happened, or the first one."""
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        mine = next((part for part in parts if frame.f_locals.get("self") is part), None)
        if mine is not None:
            return mine, frame.f_code.co_name
    return parts[0], ""
