"""``netkf import``: a log as a folder with a scenario and its tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from decimal import localcontext
from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path, number
from netkf.core.stamps import EXACT
from netkf.logs.mercator import read_mercator
from netkf.logs.mrclam import read_mrclam
from netkf.logs.packet_tables import read_tables
from netkf.logs.packets import HOLE, PacketLog
from netkf.logs.recorded_network import Files, write_network
from netkf.logs.ulb import read_ulb
from netkf.runs.files import copy_file, lock_directory, write_text
from netkf.scenario.reading import load

DATA_SETS: Mapping[str, Callable[[Path], PacketLog]] = {"ulb": read_ulb, "mercator": read_mercator}
"""By kind of a packet log that is no table of any columns, the function that reads it."""
KINDS = ("csv", "ulb", "mercator", "mrclam")
UNREPORTED = ("unknown", "lost")


def import_log(
    log: str | Path,
    kind: str,
    out: str | Path,
    *,
    like: str | Path | None = None,
    unreported: str = "unknown",
    hole: float = HOLE,
    trust: bool = True,
    columns: Mapping[str, str] | None = None,
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write the ``log`` of a ``kind``, a file or a folder, as a scenario with its tables into the
    folder ``out``; nothing is overwritten. Return the paths, the scenario first, and notes.

    ``kind`` is "csv", "ulb" or "mercator" for packet logs, which become a recorded network, or
    "mrclam" for the UTIAS multi-robot data sets. Of packet logs: ``like`` is a scenario whose
    plant, sensors and filter are used, by default the scenario.toml in the folder of the log, if
    there is one; ``unreported`` says what becomes of transmissions that nobody reported, "unknown"
    or "lost"; a receiver that reports nothing has a hole in its log, so that its outcomes are
    unknown, after ``hole`` packets that it would usually have heard. ``columns`` says for "csv"
    what the tables call a column: {"t_ms": "stamp", "sender": "origin"}. With ``trust`` classes
    that the scenario names are imported, as by ``netkf.load``.

    Raises ScenarioError with file and line for a log that cannot be read, before anything is
    written, and WriteError.
    """
    folder, log = as_path("out", out), as_path("log", log)
    for key, value, known in (("kind", kind, KINDS), ("unreported", unreported, UNREPORTED)):
        if value not in known:
            rule = f"must be one of {', '.join(known)}"
            raise ScenarioError(key, rule, value, "choose one of them")
    hole = number(above=0.0)("hole", hole)
    if columns and kind != "csv":
        raise ScenarioError("columns", "are those of kind csv", kind, "leave them out")
    if kind == "mrclam" and (like, unreported, hole) != (None, "unknown", HOLE):
        keys = "like, unreported and hole"
        raise ScenarioError(keys, "are of packet logs", kind, "leave them out")
    if not log.exists():
        raise ScenarioError(str(log), "does not exist", None, "check the path")
    files: Files = {}
    if kind == "mrclam":
        texts, notes = read_mrclam(log)
        files |= texts
    else:
        base = as_path("like", like) if like is not None else log / "scenario.toml"
        name = re.sub(r"[^\w-]", "_", log.resolve().name.partition(".")[0]) or "log"
        scenario = load(base, trust=trust) if like is not None or base.is_file() else None
        with localcontext(EXACT):  # stamps have more digits than the caller's context may keep
            packets = read_tables(log, columns or {}) if kind == "csv" else DATA_SETS[kind](log)
            files, notes = write_network(packets, name, hole, unreported, scenario)
    paths = [folder / name for name in sorted(files, key="scenario.toml".__ne__)]
    write_folder(folder, files)
    return tuple(paths), notes


def write_folder(folder: Path, files: Files) -> None:
    """Write texts, and copy files, by name into a folder, one command at a time. Raises WriteError,
    and ScenarioError for what would be overwritten.
    """
    with lock_directory(folder):
        for name in sorted(files, key="scenario.toml".__ne__):
            if (folder / name).exists():
                rule = "is there already, and nothing is overwritten"
                remedy = "choose another folder or remove it"
                raise ScenarioError(str(folder / name), rule, None, remedy)
        for name, content in files.items():
            if isinstance(content, str):
                write_text(folder / name, content)
            else:
                copy_file(content, folder / name)
