"""Files and folders of run directories; each file is written completely or not at all."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import math
import os
import platform
import stat
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.contracts import is_netkf_class
from netkf.core.errors import ScenarioError, WriteError
from netkf.core.fields import Component, SourceFile, as_path, walk
from netkf.plants.dynamics import CustomDynamics
from netkf.scenario.plugins import (
    find_module_files,
    find_unimportable_class,
    imported_source,
    module_sources,
)
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import as_table, is_writable, resolve_defaults, to_toml
from netkf.trace.run import Run


@contextlib.contextmanager
def writing_file(path: Path) -> Iterator[None]:
    """Turn OSErrors of the body into a WriteError about ``path``; raises it before for a path
    without a name or with NUL, a device, a pipe, a socket or a link.
    """
    if "\0" in str(path):
        raise WriteError(OSError(errno.EINVAL, ""), path)
    if not path.name:
        raise WriteError(OSError(errno.EISDIR, ""), path)
    require_own(path)
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(error, path) from error


_FOREIGN_KINDS = {
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFLNK: "a link",
}


def require_own(path: Path) -> None:
    """Raise WriteError for a device, pipe, socket or link, which a renamed file would replace."""
    try:
        kind = _FOREIGN_KINDS.get(stat.S_IFMT(os.lstat(path).st_mode))
    except (OSError, ValueError):  # there is none, or there can be none
        return
    if kind is not None:
        raise WriteError(OSError(f"it is {kind}, not a file of its own; choose another"), path)


def publish(temporary: Path, path: Path) -> None:
    """Flush a ``temporary`` file to disk and rename it to ``path``; raises OSError."""
    with temporary.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)
    with contextlib.suppress(OSError):  # not every system can open a directory
        directory = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


def this_process() -> str:
    """Return a ``writer`` of ``write_atomically`` for files that several commands may write at once
    because none has locked their directory: the last one wins.
    """
    return f"{platform.node()}-{os.getpid()}."


@contextlib.contextmanager
def write_atomically(path: Path, writer: str = "") -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` after the body, or is removed if that raises; a
    ``writer`` is the name of one of several processes. Raises WriteError.
    """
    temporary = path.parent / f"{path.name}.{writer}part"
    # Before the block that removes it: what is not a file here is nobody's temporary file.
    require_own(temporary)
    try:
        with writing_file(path):
            yield temporary
            publish(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError, ValueError):
            temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str, writer: str = "") -> None:
    """Write a text file atomically, in UTF-8; raises WriteError."""
    with write_atomically(path, writer) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically; numbers that are not finite become null. Raises WriteError."""
    write_text(path, json.dumps(to_json_value(value), indent=2) + "\n")


def to_json_value(value: Any) -> Any:
    """Return a value for JSON: Python numbers, lists, and None for floats that are not finite."""
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json_value(item) for item in value]
    if isinstance(value, np.ndarray):
        return to_json_value(value.tolist())
    return value.item() if isinstance(value, np.generic) else value


def create_output_directory(requested: Path | None, name: str, option: str = "--out") -> Path:
    """Return a directory for results: ``requested``, if empty (ScenarioError), or runs/NAME-k."""
    if requested is None:
        safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in name)[:100].strip(".")
        paths = (Path("runs") / f"{safe or 'run'}-{k}" for k in range(1, 1_000_000))
        # Creating it decides whether a name is free: another command may try it at the same time.
        return next(path for path in paths if make_directory(path, must_be_new=True))
    make_directory(requested, option=option)
    if any(requested.iterdir()):
        rule = "must be a new or empty directory"
        raise ScenarioError(option, rule, str(requested), "choose another, or remove it first")
    return requested


def make_directory(path: Path, must_be_new: bool = False, option: str = "--out") -> bool:
    """Create a directory unless it exists, and return True; False if it ``must_be_new`` and exists.
    Raises ScenarioError if it cannot be created or read.
    """
    try:
        path.mkdir(parents=True, exist_ok=not must_be_new)
        next(path.iterdir(), None)
    except FileExistsError as error:
        if must_be_new:
            return False
        reason = error.strerror
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
    else:
        return True
    raise ScenarioError(option, f"cannot be made ({reason})", str(path), "choose another")


def require_run(run: object) -> Scenario:
    """Return the scenario of a run; raises ScenarioError for what is no run, or has none."""
    scenario = run.scenario if isinstance(run, Run) else None
    if not isinstance(scenario, Scenario):
        remedy = "take what netkf.simulate or netkf.open returns"
        raise ScenarioError("run", "must be a run with its scenario", None, remedy)
    return scenario


def require_trace(run: object) -> Scenario:
    """Return the scenario of a run; raises ScenarioError for one whose trace was not kept."""
    scenario = require_run(run)
    if isinstance(run, Run) and not len(run.times):
        rule, remedy = "has no events and samples", "run it again with --trace full"
        raise ScenarioError("run", rule, None, remedy)
    return scenario


def output_file(out: str | Path, name: str) -> Path:
    """Return the file to write, ``out`` or in that folder ``name``, which must be new."""
    path = as_path("out", out)
    path = path / name if path.is_dir() else path
    require_own(path)
    if path.exists():
        raise ScenarioError(str(path), "exists already", None, "choose another name, or remove it")
    make_directory(path.parent)
    return path


BLOCKS_FOLDER = "blocks"
"""Folder, in the directory of an unfinished ensemble, of its checkpoints by block of runs."""
RUN_FILES = (
    *("scenario.toml", "manifest.json", "events.parquet", "states.parquet"),
    *("ensemble.parquet", "summary.json", "run.png"),
)
"""Names of the files that netkf writes to a run directory."""


def run_file_names(scenario: Scenario) -> list[str]:
    """Return the names of all files that a run of this scenario may write to its directory."""
    return [*RUN_FILES, *copied_file_names(scenario)]


def copied_file_names(scenario: Scenario) -> list[str]:
    """Return the names of the Python modules and CSV files that :func:`write_scenario` copies."""
    modules = [file.name for file in find_module_files(scenario).values() if file is not None]
    return [*modules, *(source.name for source in source_files(scenario))]


def other_files(directory: Path, names: Collection[str]) -> list[str]:
    """Return files and folders in a directory beside ``names`` and their temporary files."""
    allowed = {*names, *(f"{name}.part" for name in names)}
    allowed |= {str(folder) for name in names for folder in Path(name).parents}
    present = (path.relative_to(directory) for path in directory.rglob("*"))
    found = (path.as_posix() for path in present if path.parts[0] not in names)
    return sorted(set(found) - allowed)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_files(directory: Path, names: Iterable[str]) -> None:
    """Remove files of these ``names``, their temporary files, and folders left empty."""
    for name in names:
        for file in (directory / name, directory / f"{name}.part"):
            file.unlink(missing_ok=True)
        for folder in Path(name).parents[:-1]:
            with contextlib.suppress(OSError):  # not empty, or removed already
                (directory / folder).rmdir()


def check_sources(scenario: Scenario) -> None:
    """Raise ScenarioError if a class is defined where scenario.toml cannot import it from, or if a
    file that the scenario names has the name of one that netkf writes.
    """
    name = find_unimportable_class(scenario, in_script=False)
    if name is not None:
        rule = f"cannot name the class {name} of this script, notebook or function"
        remedy = "put it into a module (a .py file beside the scenario) and import it from there"
        raise ScenarioError("scenario.toml", rule, None, remedy)
    for part in walk(scenario):
        if isinstance(part, CustomDynamics) and not part.is_default:
            rule = f"cannot name an object of {part.name} that was made with arguments"
            remedy = "give them as defaults, or derive a class that has them"
            raise ScenarioError("scenario.toml", rule, None, remedy)
        if isinstance(part, Component) and not is_netkf_class(type(part)):
            _check_settings(part)
    for source in source_files(scenario):
        if source.name in RUN_FILES:
            rule = "is a name that run directories use themselves"
            raise ScenarioError("path", rule, source.name, "rename the file")


def _check_settings(part: Component) -> None:
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        left_out = value is None and field.default is None
        if field.init and not left_out and not is_writable(value):
            rule = f"cannot hold {type(part).__name__}.{field.name}"
            remedy = "let it be a number, a text, an array, or lists and tables of these"
            raise ScenarioError("scenario.toml", rule, value, remedy)


def write_scenario(
    directory: Path, scenario: Scenario, seed: int | None = None, resolve: bool = True
) -> None:
    """Write scenario.toml, with all defaults if ``resolve``, its files and modules (WriteError)."""
    for source in source_files(scenario):
        copy_file(source, directory / source.name)
    for module in find_module_files(scenario).values():
        if module is not None:
            write_bytes(directory / module.name, imported_source(module))
    table = resolve_defaults(scenario) if resolve else as_table(scenario)
    table["seed"] = scenario.seed if seed is None else seed
    write_text(directory / "scenario.toml", to_toml(table))


def copy_file(source: Path | SourceFile, target: Path) -> None:
    """Copy the file ``source`` to ``target`` atomically, one of a scenario as it was read."""
    write_bytes(target, source.read_bytes())


def write_bytes(target: Path, content: bytes) -> None:
    """Write a file atomically, unless it has this ``content``; raises WriteError."""
    if target.is_file() and target.read_bytes() == content:
        return
    with writing_file(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(target) as temporary:
        temporary.write_bytes(content)


def scenario_digest(scenario: Scenario, **changed: Any) -> str:
    """Return the SHA-256 of a scenario with all defaults, or ``changed`` keys, and its files."""
    digest = hashlib.sha256(to_toml(resolve_defaults(scenario) | changed).encode())
    contents = {source.name: source.read_bytes() for source in source_files(scenario)}
    contents |= module_sources(scenario)
    for name, content in sorted(contents.items()):
        digest.update(name.encode() + b"\0" + hashlib.sha256(content).digest())
    return digest.hexdigest()


def missing_modules(scenario: Scenario) -> list[str]:
    """Return a sentence about each module of a run that cannot be copied to its directory."""
    return [
        f"the run directory needs the Python module {name}, which was not copied into it: it is no "
        "single file beside the scenario"
        for name, file in find_module_files(scenario).items()
        if file is None
    ]


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
        name = hashlib.sha256(str(directory.resolve()).casefold().encode()).hexdigest()[:32]
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
