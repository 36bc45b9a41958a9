"""A lock on a directory, so that only one command at a time writes into it."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.runs.files import create_output_directory, make_directory


@contextlib.contextmanager
def lock_directory(
    directory: Path | None, must_be_empty: bool = False, option: str = "--out"
) -> Iterator[None]:
    """Create a directory, which an ``option`` names, and hold its lock, which dies with the
    process, during the body; nothing for None. Notes where locks are not supported; removes a new
    directory that stays empty.

    Raises ScenarioError if another command holds the lock, if it cannot be created, or if it
    ``must_be_empty`` and is not.
    """
    if directory is None:
        yield
        return
    # os.path instead of Path.exists, which raises for names that no file can have.
    is_new = not os.path.exists(directory)
    make_directory(directory, option=option)
    try:
        with _hold_lock(directory, option):
            if must_be_empty:
                create_output_directory(directory, "", option)
            yield
    finally:
        if is_new:
            with contextlib.suppress(OSError):  # not empty any more
                directory.rmdir()


@contextlib.contextmanager
def _hold_lock(directory: Path, option: str) -> Iterator[None]:
    descriptor = None
    try:
        descriptor = _open_lock_file(directory)
    except OSError as error:
        _print_note(directory, error)
    else:
        _lock_or_refuse(descriptor, directory, option)
    try:
        yield
    finally:
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _lock_or_refuse(descriptor: int, directory: Path, option: str) -> None:
    """Lock the open file ``descriptor`` that stands for ``directory``, without waiting."""
    try:
        _lock_file(descriptor)
    except (BlockingIOError, PermissionError):  # the latter on Windows
        os.close(descriptor)
        rule = "is in use: another netkf command writes there"
        remedy = "wait for its end, or choose another"
        raise ScenarioError(option, rule, str(directory), remedy) from None
    except OSError as error:
        _print_note(directory, error)


def _print_note(directory: Path, error: OSError) -> None:
    note = f"note: {directory} cannot be locked ({error.strerror}): one command at a time on it"
    print(note, file=sys.stderr)


if sys.platform == "win32":
    import msvcrt

    def _open_lock_file(directory: Path) -> int:
        name = sha256(str(directory.resolve()).casefold().encode()).hexdigest()[:32]
        return os.open(Path(tempfile.gettempdir()) / f"netkf-{name}.lock", os.O_RDWR | os.O_CREAT)

    def _lock_file(descriptor: int) -> None:
        """Take the lock without waiting; raises OSError if that fails."""
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _open_lock_file(directory: Path) -> int:
        """Open the directory itself and return its descriptor: no lock file is left behind."""
        return os.open(directory, os.O_RDONLY)

    def _lock_file(descriptor: int) -> None:
        """Take the lock without waiting; raises OSError if that fails."""
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
