"""JSON documents of run directories: sealed with a digest, and read without trust.

A seal finds damage and files that were edited or mixed up. It is no signature: who wants to deceive
can compute it too.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from netkf.runs.files import file_digest, finite, write_json

SEAL = "sha256"
"""Key of the digest of all other entries."""
ENDED = ("complete", "diverged")
"""Values of ``status`` in the manifest of a run that has come to its end."""
MAX_COUNT = 1 << 62
MAX_BYTES = 1 << 28
"""Largest document that is read: the summary of some 500,000 nodes."""


class DamagedError(ValueError):
    """A file is not what netkf wrote; the message says why, without the name of the file."""


def write_sealed(path: Path, document: dict[str, Any]) -> None:
    """Write a JSON document with its seal."""
    write_json(path, {**document, SEAL: _digest(finite(document))})


def check_seal(document: Mapping[str, Any]) -> None:
    """Raise DamagedError if a document has no seal or was changed since it was written."""
    if SEAL not in document:
        raise DamagedError("has no digest: another version of netkf wrote it")
    contents = {key: value for key, value in document.items() if key != SEAL}
    if document[SEAL] != _digest(contents):
        raise DamagedError("was changed since it was written")


def _digest(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a document, whatever the order of its keys."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


@contextlib.contextmanager
def reading_file(path: Path, name: str = "") -> Iterator[None]:
    """Raise DamagedError in place of what the body raises while it reads a file, whatever is in it,
    and for anything but a regular file. ``name`` begins the message.
    """
    where = f"{name} " if name else ""
    try:
        # Anything but a regular file, such as a pipe, may never end.
        if not path.is_file():
            raise DamagedError(f"{where}is {'no regular file' if path.exists() else 'missing'}")
        yield
    except DamagedError:
        raise
    except Exception as error:
        raise DamagedError(f"{where}cannot be read ({type(error).__name__})") from None


@contextlib.contextmanager
def damage_in(name: str) -> Iterator[None]:
    """Put the name of a file into a DamagedError about it."""
    try:
        yield
    except DamagedError as error:
        raise DamagedError(f"{name} {error}") from None


def read_document(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; raises DamagedError for everything else."""
    with reading_file(path):
        if path.stat().st_size > MAX_BYTES:
            raise DamagedError(f"is larger than {MAX_BYTES >> 20} MiB")
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    if not isinstance(document, dict):
        raise DamagedError("is no JSON object")
    return document


def _refuse_constant(name: str) -> Any:
    """Raise ValueError for NaN and infinities, which JSON does not have."""
    raise ValueError(name)


def file_digests(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of those of the named files that a directory has."""
    found = ((name, directory / name) for name in sorted(set(names)))
    return {name: file_digest(path) for name, path in found if path.is_file()}


def check_files(directory: Path, manifest: Mapping[str, Any], names: Iterable[str] = ()) -> None:
    """Raise DamagedError for a file that is not the one whose digest the manifest has.

    It looks at ``names`` if the manifest lists them, and by default at all that it lists.
    """
    digests = manifest.get("files", {})
    require(digests, {}, "files")
    for name in names or digests:
        known = digests.get(name)
        if known is None:
            continue
        path = directory / name
        try:
            same = path.is_file() and file_digest(path) == known
        except (OSError, ValueError) as error:
            raise DamagedError(f"{name} cannot be read ({type(error).__name__})") from None
        if not same:
            problem = "was changed since" if path.exists() else "is missing since"
            raise DamagedError(f"{name} {problem} the run ended")


NUMBER = "a number or null"
COUNT = "a count"
TEXT = "a text"
TEXTS = "a list of texts"


def require(value: Any, form: Any, where: str = "") -> None:
    """Raise DamagedError unless a JSON value, found at the key path ``where``, has a form: NUMBER,
    COUNT, TEXT, TEXTS, a list with the form of its items, or a dictionary with the forms of its
    keys, of which those that end in ``?`` may be missing; there may be other keys.
    """
    if isinstance(form, dict):
        _require_form(isinstance(value, dict), "a table", where)
        for key, inner in form.items():
            name = key.removesuffix("?")
            path = f"{where}.{name}" if where else name
            if name in value:
                require(value[name], inner, path)
            elif name == key:
                raise DamagedError(f"lacks {path}")
    elif isinstance(form, list):
        _require_form(isinstance(value, list), "a list", where)
        for item in value:
            require(item, form[0], where)
    else:
        _require_form(_FORMS[form](value), form, where)


def _require_form(kept: bool, form: str, where: str) -> None:
    """Raise DamagedError unless ``kept``."""
    if not kept:
        raise DamagedError(f"needs {form} at {where}" if where else f"is not {form}")


def _is_number(value: Any) -> bool:
    """Return True for finite numbers and null."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= MAX_COUNT
    return value is None or (isinstance(value, float) and math.isfinite(value))


def _is_count(value: Any) -> bool:
    """Return True for whole numbers from 0 up to MAX_COUNT."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_COUNT


_FORMS: dict[str, Callable[[Any], bool]] = {
    NUMBER: _is_number,
    COUNT: _is_count,
    TEXT: lambda value: isinstance(value, str),
    TEXTS: lambda value: isinstance(value, list) and all(isinstance(one, str) for one in value),
}
