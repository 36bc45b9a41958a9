"""What a run that does not end leaves its user with."""

from __future__ import annotations

from pathlib import Path

from netkf.core.errors import EngineError, NetkfError
from netkf.scenario.plugins import blame
from netkf.scenario.scenario import Scenario


class InterruptedRunError(KeyboardInterrupt):
    """A run was stopped; ``directory`` holds what it had."""

    def __init__(self, directory: Path, remedy: str = "") -> None:
        self.directory = directory
        super().__init__(f"what was finished is kept in {directory}{remedy}")


def told(scenario: Scenario, error: BaseException, directory: Path | None = None) -> BaseException:
    """The exception that a command ends with: one that names the plugged-in class where there is
    one, else ``error`` itself; ``directory`` is that of a run whose manifest has the traceback.
    """
    if isinstance(error, KeyboardInterrupt) and directory is not None:
        return InterruptedRunError(directory)
    if not isinstance(error, Exception) or isinstance(error, (NetkfError, OSError)):
        return error
    words = blame(scenario, error)
    where = "" if directory is None else f"; the traceback is in {directory / 'manifest.json'}"
    return error if words is None else EngineError(f"{words}{where}")
