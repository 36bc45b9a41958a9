"""Files of run directories, written whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError, WriteError
from netkf.scenario.plugins import module_files, unnamed_class
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import resolve_defaults, to_toml


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise a WriteError about ``path`` in place of the body's OSErrors, and for a NUL in it."""
    if "\0" in str(path):
        raise WriteError(OSError(errno.EINVAL, ""), path)
    if not path.name:
        raise WriteError(OSError(errno.EISDIR, ""), path)
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(error, path) from error


def publish(part: Path, path: Path) -> None:
    """Give a finished file its name, once its contents are on the disk; raises OSError.

    After a loss of power there is the whole file under that name, or none.
    """
    with part.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, path)
    with contextlib.suppress(OSError):  # not every system can open a directory
        directory = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that replaces ``path`` at the end of the body.

    A reader never sees half a file; if the body raises, the temporary file is removed. Raises
    WriteError where the body or the system fails to write.
    """
    part = path.parent / f"{path.name}.part"
    try:
        with writing(path):
            yield part
            publish(part, path)
    except BaseException:
        with contextlib.suppress(OSError, ValueError):
            part.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with write_atomically(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file; numbers that are not finite become null."""
    write_text(path, json_text(value) + "\n")


def json_text(value: Any, margin: str = "\n") -> str:
    """Return ``json.dumps(finite(value), indent=2)`` for a value whose lines begin with ``margin``.

    The standard library indents in plain Python, a call for each number. Here each dictionary and
    list without others in it, such as the row of a node, is one call of its compiled encoder.
    """
    if not isinstance(value, (dict, list, tuple)) or not value:
        return json.dumps(finite(value))
    inner = margin + "  "
    parts = value.values() if isinstance(value, dict) else value
    if not any(isinstance(part, (dict, list, tuple)) for part in parts):
        text = json.JSONEncoder(separators=("," + inner, ": ")).encode(finite(value))
        return text[0] + inner + text[1:-1] + margin + text[-1]
    if isinstance(value, dict):
        named = (f"{json.dumps(str(key))}: {json_text(item, inner)}" for key, item in value.items())
        return "{" + inner + ("," + inner).join(named) + margin + "}"
    return "[" + inner + ("," + inner).join(json_text(item, inner) for item in value) + margin + "]"


def finite(value: Any) -> Any:
    """Return a plain JSON value: numpy numbers become Python ones, and None if not finite."""
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def new_directory(wanted: Path | None, name: str) -> Path:
    """Create and return the directory of a run: ``wanted``, or the first free runs/NAME-k.

    Raises ScenarioError if ``wanted`` cannot be created or is not empty.
    """
    if wanted is None:
        safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in name)[:100].strip(".")
        tries = (Path("runs") / f"{safe or 'run'}-{k}" for k in range(1, 1_000_000))
        # Another command that starts now may choose the same name.
        return next(path for path in tries if make_directory(path, anew=True))
    make_directory(wanted)
    if any(wanted.iterdir()):
        raise ScenarioError(
            "--out",
            "must be a new or empty directory",
            str(wanted),
            "choose another, or remove it first",
        )
    return wanted


def make_directory(path: Path, anew: bool = False) -> bool:
    """Make a directory if there is none, and check that it can be read.

    Return True, or False if ``anew`` and the directory exists already. Raises ScenarioError if it
    cannot be made or read.
    """
    try:
        path.mkdir(parents=True, exist_ok=not anew)
        next(path.iterdir(), None)
    except FileExistsError as error:
        if anew:
            return False
        reason = error.strerror
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
    else:
        return True
    raise ScenarioError("--out", f"cannot be made ({reason})", str(path), "choose another")


BLOCKS = "blocks"
"""Folder of the blocks of an unfinished ensemble."""
OWN_FILES = (
    "scenario.toml",
    "manifest.json",
    "events.parquet",
    "states.parquet",
    "ensemble.parquet",
    "summary.json",
    "run.png",
)
"""Files of a run directory that netkf writes."""


def own_names(scenario: Scenario) -> list[str]:
    """Return the names of all files that a run of this scenario may leave in its directory."""
    return [*OWN_FILES, *copied_names(scenario)]


def copied_names(scenario: Scenario) -> list[str]:
    """Return the names of the modules and tables that :func:`write_scenario` copies."""
    modules = [file.name for file in module_files(scenario).values() if file is not None]
    return [*modules, *(source.name for source in source_files(scenario))]


def only_own(directory: Path, names: Collection[str]) -> bool:
    """Return True if a directory holds nothing but files of these names, their unfinished versions
    and blocks of an ensemble.
    """
    known = {*names, *(f"{name}.part" for name in names)}
    folders = {str(folder) for name in names for folder in Path(name).parents} | {BLOCKS}
    found = (path.relative_to(directory).as_posix() for path in directory.rglob("*"))
    return all(name in known or name in folders or name.startswith(f"{BLOCKS}/") for name in found)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_own(directory: Path, names: Iterable[str]) -> None:
    """Remove files of these names and their unfinished versions from a directory, and no others."""
    for name in names:
        for file in (directory / name, directory / f"{name}.part"):
            file.unlink(missing_ok=True)
        for folder in Path(name).parents[:-1]:
            with contextlib.suppress(OSError):  # there may be more in it, or it may be gone
                (directory / folder).rmdir()


def check_sources(scenario: Scenario) -> None:
    """Raise ScenarioError for a file of the scenario with the name of a file of run directories,
    and for a class that scenario.toml cannot name.
    """
    unnamed = unnamed_class(scenario, in_script=False)
    if unnamed is not None:
        rule = f"cannot name the class {unnamed} of this script, notebook or function"
        remedy = "put it into a module (a .py file beside the scenario) and import it from there"
        raise ScenarioError("scenario.toml", rule, None, remedy)
    for source in source_files(scenario):
        if source.name in OWN_FILES:
            rule = "is a name that run directories use themselves"
            raise ScenarioError("path", rule, source.name, "rename the file")


def write_scenario(directory: Path, scenario: Scenario, seed: int | None = None) -> None:
    """Write scenario.toml with all defaults filled in, and copy the files and modules it names.

    ``seed`` replaces the root seed of the scenario. The copy reproduces the run.
    """
    for source in source_files(scenario):
        _copy(source.full, directory / source.name)
    for module in module_files(scenario).values():
        if module is not None:
            _copy(module, directory / module.name)
    table = resolve_defaults(scenario)
    table["seed"] = scenario.seed if seed is None else seed
    write_text(directory / "scenario.toml", to_toml(table))


def _copy(source: Path, target: Path) -> None:
    """Copy a file, unless the copy is there: a scenario may be that of the directory itself."""
    if target.is_file() and target.read_bytes() == source.read_bytes():
        return
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(target) as part:
        shutil.copyfile(source, part)


def scenario_digest(scenario: Scenario) -> str:
    """Return the SHA-256 of a resolved scenario and of the files and modules that it names."""
    digest = hashlib.sha256(to_toml(resolve_defaults(scenario)).encode())
    files = {source.name: source.full for source in source_files(scenario)}
    files |= {f"{name}.py": file for name, file in module_files(scenario).items() if file}
    for name, file in sorted(files.items()):
        digest.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def missing_modules(scenario: Scenario) -> list[str]:
    """Return a sentence about each module that a run needs and its directory does not hold."""
    return [
        f"the run directory needs the Python module {name}, which was not copied into it: it is no "
        "single file beside the scenario"
        for name, file in module_files(scenario).items()
        if file is None
    ]
