"""``netkf import``: a log as a folder with a scenario and its tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.logs.mrclam import read_mrclam
from netkf.runs.files import make_directory, write_text

KINDS: Mapping[str, Callable[[Path], tuple[dict[str, str], tuple[str, ...]]]] = {
    "mrclam": read_mrclam
}
"""By kind, the function from a log to the texts of files by name, scenario.toml among them, and
notes.
"""


def import_log(
    log: str | Path, kind: str, out: str | Path
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write the ``log`` of a ``kind``, a file or a folder, as a scenario with its tables into the
    folder ``out``; nothing is overwritten. Return the paths, the scenario first, and notes.

    ``kind`` is "mrclam", the UTIAS multi-robot data sets. Raises ScenarioError with file and line
    for a log that cannot be read, before anything is written, and WriteError.
    """
    folder = as_path("out", out)
    if kind not in KINDS:
        rule, remedy = f"must be one of {', '.join(KINDS)}", "choose one of them"
        raise ScenarioError("kind", rule, kind, remedy)
    texts, notes = KINDS[kind](as_path("log", log))
    paths = [folder / name for name in sorted(texts, key="scenario.toml".__ne__)]
    for path in paths:
        if path.exists():
            rule = "is there already, and nothing is overwritten"
            raise ScenarioError(str(path), rule, None, "choose another folder or remove it")
    make_directory(folder)
    for path in paths:
        write_text(path, texts[path.name])
    return tuple(paths), notes
