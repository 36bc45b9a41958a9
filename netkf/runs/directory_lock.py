"""One command at a time writes into a directory."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.runs.files import make_directory, new_directory


@contextlib.contextmanager
def only_writer(directory: Path | None, empty: bool = False) -> Iterator[None]:
    """Make a directory and lock it for the body; the operating system unlocks it if this process
    dies. It is removed again if it was made here and is empty at the end. Nothing for None.

    Raises ScenarioError if another command has locked it, if it cannot be made, or if it has to be
    ``empty`` and is not. A note says so where a file system has no locks.
    """
    if directory is None:
        yield
        return
    # os.path instead of Path.exists, which raises for names that no file can have.
    made = not os.path.exists(directory)
    make_directory(directory)
    try:
        with _locked(directory):
            if empty:
                new_directory(directory, "")
            yield
    finally:
        if made:
            with contextlib.suppress(OSError):  # it has files now
                directory.rmdir()


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Hold the lock of a directory; go on with a note if its file system knows no locks."""
    opened = None
    try:
        opened = _open(directory)
    except OSError as error:
        _print_note(directory, error)
    else:
        _lock_or_refuse(opened, directory)
    try:
        yield
    finally:
        if opened is not None:
            with contextlib.suppress(OSError):
                os.close(opened)


def _lock_or_refuse(opened: int, directory: Path) -> None:
    """Take the lock; raises ScenarioError if another process holds it."""
    try:
        _lock(opened)
    except (BlockingIOError, PermissionError):  # the latter on Windows
        os.close(opened)
        rule = "is in use: another netkf command writes there"
        remedy = "wait for its end, or choose another"
        raise ScenarioError("--out", rule, str(directory), remedy) from None
    except OSError as error:
        _print_note(directory, error)


def _print_note(directory: Path, error: OSError) -> None:
    """Say on standard error that the directory is not locked."""
    note = f"note: {directory} cannot be locked ({error.strerror}): one command at a time on it"
    print(note, file=sys.stderr)


if sys.platform == "win32":
    import msvcrt

    def _open(directory: Path) -> int:
        """Open a file that stands for the directory, which Windows does not open."""
        name = sha256(str(directory.resolve()).casefold().encode()).hexdigest()[:32]
        return os.open(Path(tempfile.gettempdir()) / f"netkf-{name}.lock", os.O_RDWR | os.O_CREAT)

    def _lock(opened: int) -> None:
        """Take the lock without waiting; raises OSError."""
        msvcrt.locking(opened, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _open(directory: Path) -> int:
        """Open the directory itself, so that no file of a lock is left."""
        return os.open(directory, os.O_RDONLY)

    def _lock(opened: int) -> None:
        """Take the lock without waiting; raises OSError."""
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
