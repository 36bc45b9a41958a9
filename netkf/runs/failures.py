"""Exceptions of runs that do not end: which class of the user failed, and what was kept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from netkf.core.errors import EngineError, NetkfError
from netkf.scenario.plugins import blame
from netkf.scenario.scenario import Scenario


class InterruptedRunError(KeyboardInterrupt):
    """A run was stopped; ``directory`` holds the results until then."""

    def __init__(self, directory: Path, remedy: str = "") -> None:
        self.directory = directory
        super().__init__(f"what was finished is kept in {directory}{remedy}")


def explain_failure(
    scenario: Scenario, error: BaseException, directory: Path | None = None
) -> BaseException:
    """Return the exception to end with after ``error``: one that names the user's class in which it
    was raised, or ``error`` itself if no such class is involved.

    ``directory`` is that of a run whose manifest has the traceback.
    """
    if isinstance(error, KeyboardInterrupt) and directory is not None:
        return InterruptedRunError(directory)
    # Errors of netkf name their cause already, and a full disk is no fault of a user's class.
    if not isinstance(error, Exception) or isinstance(error, (NetkfError, OSError)):
        return error
    message = blame(scenario, error)
    where = "" if directory is None else f"; the traceback is in {directory / 'manifest.json'}"
    return error if message is None else EngineError(f"{message}{where}")


@contextmanager
def explain_failures(scenario: Scenario) -> Iterator[None]:
    """Replace exceptions of the body by those of :func:`explain_failure`."""
    try:
        yield
    except Exception as error:
        explained = explain_failure(scenario, error)
        if explained is error:
            raise
        raise explained from error
