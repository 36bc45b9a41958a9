"""JSON documents of run directories: written with a digest, and validated when they are read.

The digest, called the seal, reveals damaged files and files that were edited or mixed up. It is not
a signature: anyone can compute it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from netkf.runs.files import file_digest, to_json_value, write_json

SEAL = "sha256"
"""Key of the SHA-256 of all other entries of a document."""
FINAL_STATUSES = ("complete", "diverged")
"""Values of ``status`` in the manifest of a run that was neither interrupted nor failed."""
MAX_COUNT = 1 << 62
"""Largest absolute value of an integer that is accepted: int64 with a spare bit."""
MAX_BYTES = 1 << 28
"""Size of the largest document that is read: about the summary of 500,000 nodes."""


class DamagedError(ValueError):
    """A file is not as netkf wrote it; the message says why, often without the name of the file."""


def write_sealed(path: Path, document: dict[str, Any]) -> None:
    """Write a JSON document with its seal."""
    write_json(path, {**document, SEAL: _digest(to_json_value(document))})


def check_seal(document: Mapping[str, Any]) -> None:
    """Raise DamagedError if a document has no seal or was changed since it was written."""
    if SEAL not in document:
        raise DamagedError("has no digest: another version of netkf wrote it")
    contents = {key: value for key, value in document.items() if key != SEAL}
    if document[SEAL] != _digest(contents):
        raise DamagedError("was changed since it was written")


def _digest(document: Mapping[str, Any]) -> str:
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


@contextlib.contextmanager
def reading_file(path: Path, name: str = "") -> Iterator[None]:
    """Turn exceptions of a body that reads ``path`` into a DamagedError, which names ``name``;
    raises it before unless that is a regular file.
    """
    prefix = f"{name} " if name else ""
    try:
        # Reading anything but a regular file, such as a pipe, may never end.
        if not path.is_file():
            raise DamagedError(f"{prefix}is {'no regular file' if path.exists() else 'missing'}")
        yield
    except DamagedError:
        raise
    except Exception as error:
        raise DamagedError(f"{prefix}cannot be read ({type(error).__name__})") from None


@contextlib.contextmanager
def add_file_name(name: str) -> Iterator[None]:
    """Prefix the message of a DamagedError that the body raises with the ``name`` of the file."""
    try:
        yield
    except DamagedError as error:
        raise DamagedError(f"{name} {error}") from None


def read_document(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; raises DamagedError if the file holds anything else."""
    with reading_file(path):
        if path.stat().st_size > MAX_BYTES:
            raise DamagedError(f"is larger than {MAX_BYTES >> 20} MiB")
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    if not isinstance(document, dict):
        raise DamagedError("is no JSON object")
    return document


def _refuse_constant(name: str) -> Any:
    """Raise ValueError: ``name`` is NaN or an infinity, which Python reads but JSON excludes."""
    raise ValueError(name)


def file_digests(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256, by name, of each of the named files that exists in a directory."""
    paths = {name: directory / name for name in sorted(set(names))}
    return {name: file_digest(path) for name, path in paths.items() if path.is_file()}


def check_files(directory: Path, manifest: Mapping[str, Any], names: Iterable[str] = ()) -> None:
    """Raise DamagedError unless those of ``names`` that a ``manifest`` lists have its digests."""
    digests = manifest.get("files", {})
    require_form(digests, {}, "files")
    for name in names or digests:
        digest = digests.get(name)
        if digest is None:
            continue
        path = directory / name
        try:
            is_unchanged = path.is_file() and file_digest(path) == digest
        except (OSError, ValueError) as error:
            raise DamagedError(f"{name} cannot be read ({type(error).__name__})") from None
        if not is_unchanged:
            problem = "was changed since" if path.exists() else "is missing since"
            raise DamagedError(f"{name} {problem} the run ended")


NUMBER = "a number or null"
COUNT = "a count"
TEXT = "a text"
TEXTS = "a list of texts"


def require_form(value: Any, form: Any, key_path: str = "") -> None:
    """Raise DamagedError at ``key_path`` unless a JSON value has a ``form``: NUMBER, COUNT, TEXT,
    TEXTS, a list [form of items], or {key: form of value}; keys with ``?`` are optional, others
    allowed.
    """
    named = "a table" if isinstance(form, dict) else "a list" if isinstance(form, list) else form
    if not (_FORMS[form](value) if named is form else isinstance(value, type(form))):
        raise DamagedError(f"needs {named} at {key_path}" if key_path else f"is not {named}")
    if isinstance(form, dict):
        for key, inner_form in form.items():
            name = key.removesuffix("?")
            inner_path = f"{key_path}.{name}" if key_path else name
            if name in value:
                require_form(value[name], inner_form, inner_path)
            elif name == key:
                raise DamagedError(f"lacks {inner_path}")
    elif isinstance(form, list):
        # A list in a form has one item, the form of all items.
        for item in value:
            require_form(item, form[0], key_path)


def _is_number(value: Any) -> bool:
    """Return True for finite numbers, integers up to MAX_COUNT, and None (JSON null)."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= MAX_COUNT
    return value is None or (isinstance(value, float) and math.isfinite(value))


_FORMS: dict[str, Callable[[Any], bool]] = {
    NUMBER: _is_number,
    COUNT: lambda value: (
        isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_COUNT
    ),
    TEXT: lambda value: isinstance(value, str),
    TEXTS: lambda value: isinstance(value, list) and all(isinstance(item, str) for item in value),
}
