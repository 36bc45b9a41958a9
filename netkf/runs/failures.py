"""Exceptions for interrupted and failed runs, with the directory of their partial results."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from netkf.core.errors import EngineError, NetkfError
from netkf.scenario.plugins import explain_user_error, explained
from netkf.scenario.scenario import Scenario


class InterruptedRunError(KeyboardInterrupt):
    """A run was interrupted; ``directory`` holds its partial results.

    ``remedy`` ends the message, such as how to resume.
    """

    def __init__(self, directory: Path, remedy: str = "") -> None:
        self.directory = directory
        super().__init__(f"what was finished is kept in {directory}{remedy}")


def explain_failure(
    scenario: Scenario, error: BaseException, directory: Path | None = None
) -> BaseException:
    """Return the exception to raise in place of ``error``: an EngineError that names the user's
    class in which it was raised, an InterruptedRunError for Ctrl-C in ``directory``, or itself.
    """
    if isinstance(error, KeyboardInterrupt) and directory is not None:
        return InterruptedRunError(directory)
    # Errors of netkf name their cause already.
    if not isinstance(error, Exception) or isinstance(error, NetkfError):
        return error
    message = explain_user_error(scenario, error)
    where = "" if directory is None else f"; the traceback is in {directory / 'manifest.json'}"
    return error if message is None else EngineError(f"{message}{where}")


def explain_failures(scenario: Scenario) -> AbstractContextManager[None]:
    """Turn exceptions of a user's class in the body into an EngineError that names it."""
    return explained(scenario, EngineError)
