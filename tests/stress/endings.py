"""How commands end, and what they leave: what every stress series asks of them."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

STATUSES = (0, 1, 2, 130)
COMPILING = "netkf: compiling, once"
LONGEST = 3000
"""Characters of a line on standard error."""


def error_lines(printed: str) -> list[str]:
    """Return the lines of standard error that are no notes."""
    return [line for line in printed.splitlines() if not line.startswith(("note: ", COMPILING))]


def complaints(
    status: object, err: str, out: str = "", allowed: Collection[int] = STATUSES
) -> list[str]:
    """Return what is wrong with how a command ended: another status, more or less than one line
    where it was refused or stopped, a traceback, control characters, endless lines.
    """
    wrong, lines = [], error_lines(err)
    if status not in allowed:
        wrong.append(f"status {status}, printed {err[-400:]!r}")
    # The answer no of `size` and `consistency` is a line too.
    expected = {0: (0,), 1: (0, 1)}.get(status if isinstance(status, int) else 2, (1,))
    if len(lines) not in expected or not all(line.startswith("netkf") for line in lines):
        wrong.append(f"printed {err[-400:]!r}")
    if "Traceback" in err:
        wrong.append("traceback")
    if not all(c.isprintable() or c in "\n\t" for c in out + err):
        wrong.append("control characters")
    if max(map(len, err.splitlines()), default=0) > LONGEST:
        wrong.append(f"a line of more than {LONGEST} characters")
    return wrong


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files of a directory."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def unfinished(folder: Path) -> list[str]:
    """Return a complaint about unfinished files of a directory, if there are any."""
    parts = [str(path.relative_to(folder)) for path in folder.rglob("*.part")]
    return [f"left {parts}"] if parts else []
