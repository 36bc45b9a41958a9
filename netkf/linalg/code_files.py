"""Compiled code on disk: a data file for each signature of a function, and an index of digests.

What is in a file of compiled code is executed: to unpickle it suffices, and a flipped bit in
machine code ends the process. So nothing of a file is used before its SHA-256 is that of the index,
whose own digest also covers what the code was made from and with. Whoever can write such a file can
write its digest too: hence only folders and files are used that nobody else can write.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import pickle
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numpy as np

MARK = b"netkf code 1\n"
"""First bytes of an index, before its digest."""
VALUES = (bool, int, float, complex, str, bytes, tuple, np.ndarray, np.generic)
"""Types of what compiled code has instead of a name, with its value at that time."""


class CodeFiles:
    """The compiled code of one function in a folder, as the cache of a numba dispatcher.

    Whatever is missing, damaged, unreadable, or another's is no code: numba compiles, and
    :meth:`save_overload` replaces it. That nothing can be written is no error either.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        """Keep the code of a Python ``function`` in ``folder``, which is made when code is saved;
        one without a source file is not kept.
        """
        code = function.__code__
        source = Path(inspect.getfile(function))
        name = function.__qualname__.replace("<", "").replace(">", "")
        version = f"py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, 'abiflags', '')}"
        self._base = f"{source.stem}.{name}-{code.co_firstlineno}.{version}"
        # Functions of the same name in modules of the same name.
        path = os.path.abspath(source)
        self._folder = folder / f"{source.parent.name}_{_digest(path.encode()).hex()[:16]}"
        self._function = function
        self._made_from = _describe(function, path, folder.name)

    @property
    def cache_path(self) -> str:
        """The folder of the files."""
        return str(self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compile result of a signature, or None."""
        try:
            return self._load(sig, target_context)
        except Exception:  # a module that it names may have changed, or a private name of numba
            return None

    def _load(self, sig: Any, target_context: Any) -> Any:
        from numba.core.compiler import CompileResult
        from numba.core.runtime import nrt

        compile_result: Any = CompileResult
        # All that machine code refers to. ``refresh`` would import what only compiling needs, such
        # as linear algebra of numba and scipy: half of all that a short run imports.
        nrt.rtsys.initialize(target_context)
        key = self._key(sig, target_context.codegen())
        expected = self._read_index().get(key)
        data = _read_own(self._data_path(key)) if expected else None
        if data is None or _digest(data).hex() != expected:
            return None
        return compile_result._rebuild(target_context, *pickle.loads(data))

    def save_overload(self, sig: Any, result: Any) -> None:
        """Save the compile result of a signature, unless it refers to addresses of this process,
        the files cannot be written, or this numba lacks a private name.
        """
        with suppress(Exception):
            self._save(sig, result)

    def _save(self, sig: Any, result: Any) -> None:
        from numba.core import serialize

        bound = result.library.has_dynamic_globals or any(not x.can_cache for x in result.lifted)
        if bound or not self._made_from:
            return
        key = self._key(sig, result.codegen)
        dumps: Any = serialize.dumps
        data = dumps(result._reduce())
        index = json.dumps({**self._read_index(), key: _digest(data).hex()}).encode()
        make_own_folder(self._folder)
        # The data first: an index that names what is not there yet, or was there before, is known
        # by the digest.
        _replace(self._data_path(key), data)
        _replace(self._index_path, MARK + self._seal(index) + index)

    def flush(self) -> None:
        """Forget all signatures."""
        with suppress(OSError):
            self._index_path.unlink(missing_ok=True)

    @property
    def _index_path(self) -> Path:
        return self._folder / f"{self._base}.nbi"

    def _data_path(self, key: str) -> Path:
        return self._folder / f"{self._base}.{key[:16]}.nbc"

    def _key(self, sig: Any, codegen: Any) -> str:
        """Return the digest of a signature, the processor, and the function with its constants."""
        from numba.core import serialize

        dumps: Any = serialize.dumps
        # The function itself: its file may have been edited since it was imported.
        made_of = dumps([_steps(self._function.__code__), *_constants(self._function)])
        texts = [part.encode() for part in [str(sig), *map(str, codegen.magic_tuple())]]
        return _digest(*texts, made_of).hex()

    def _seal(self, index: bytes) -> bytes:
        """Return the digest of an index together with what the code was made from."""
        return _digest(self._made_from, self._index_path.name.encode(), index)

    def _read_index(self) -> dict[str, str]:
        """Return the SHA-256 of the data of each key; {} without an intact index."""
        stored = _read_own(self._index_path) if self._made_from else None
        start = len(MARK) + hashlib.sha256().digest_size
        if stored is None or stored[:start] != MARK + self._seal(stored[start:]):
            return {}
        index: dict[str, str] = json.loads(stored[start:])
        return index


def _describe(function: Callable[..., Any], path: str, state: str) -> bytes:
    """Return what code depends on beside its signature; b"" without a file."""
    import llvmlite
    import numba

    try:
        source = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError:
        return b""
    names = [path, function.__qualname__, function.__code__.co_firstlineno]
    versions = [numba.__version__, llvmlite.__version__, sys.version]
    return json.dumps([state, source, *names, *versions]).encode()


def _constants(function: Callable[..., Any], seen: tuple[Any, ...] = ()) -> list[Any]:
    """Return what a function takes from those around it; of kernels what they are made of."""
    values: list[Any] = [cell.cell_contents for cell in function.__closure__ or ()]
    # Values and kernels of any module, for users': their files are no part of the state of netkf's
    # sources.
    if not function.__module__.startswith("netkf."):
        names = _names_in(function.__code__)
        values += _named(names, function.__globals__, set())
    return [_describe_value(value, (*seen, function)) for value in values]


def _steps(code: CodeType) -> bytes:
    """Return a digest of what a function does, without the lines where it says so."""
    constants = [_steps(x) if isinstance(x, CodeType) else repr(x).encode() for x in code.co_consts]
    return _digest(code.co_code, repr(code.co_names).encode(), *constants)


def _names_in(code: CodeType) -> list[str]:
    """Return the names in a function's code, also of functions in it, sorted."""
    inner = (part for part in code.co_consts if isinstance(part, CodeType))
    return sorted({*code.co_names, *(name for part in inner for name in _names_in(part))})


def _named(names: Sequence[str], scope: Mapping[str, Any], seen: set[int]) -> list[Any]:
    """Return what of ``names`` is a value or a kernel in a ``scope``, or in modules and classes in
    it.
    """
    found: list[Any] = []
    for value in (scope[name] for name in names if name in scope):
        if isinstance(value, (ModuleType, type)) and id(value) not in seen:
            found += _named(names, vars(value), seen | {id(value)})
        elif isinstance(value, VALUES) or _function_of(value) is not None:
            found.append(value)
    return found


def _function_of(value: Any) -> Any:
    """Return the Python function of a kernel, or of another function that numba compiles."""
    return getattr(value, "loops", getattr(value, "py_func", None))


def _describe_value(value: Any, seen: tuple[Any, ...]) -> Any:
    """Return what code depends on that contains a value, or calls a kernel."""
    if isinstance(value, tuple):
        return [_describe_value(part, seen) for part in value]
    loops = _function_of(value)
    if loops is None:
        return value
    described: list[Any] = [loops.__module__, loops.__qualname__, _steps(loops.__code__)]
    if not loops.__module__.startswith("netkf."):
        described.append(_digest(Path(inspect.getfile(loops)).read_bytes()))
    # Kernels may call themselves and each other.
    return described if loops in seen else [*described, *_constants(loops, seen)]


def _digest(*parts: bytes) -> bytes:
    """Return the SHA-256 of parts, of which none can pass for a part of the next."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(f"{len(part)} ".encode() + part)
    return digest.digest()


def _read_own(path: Path) -> bytes | None:
    """Return the contents of a file that nobody else can write; None if there is none."""
    # Neither a link is followed nor a pipe waited for.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0))
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode) or not _is_own(status):
                return None
            return file.read()
    except OSError:
        return None


def _replace(path: Path, content: bytes) -> None:
    """Write a file at once, readable by this user only, in place of whatever is there."""
    descriptor, name = tempfile.mkstemp(prefix=f"{path.name}.tmp.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise


def make_own_folder(folder: Path) -> bool:
    """Make a folder unless it exists, and return True if it is absolute and can be read and
    written, and only by this user; raises OSError if it cannot be made.
    """
    if not folder.is_absolute():
        return False
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    real = Path(os.path.realpath(folder))
    # Others cannot rename or replace a folder in one of theirs that is sticky, such as /tmp.
    above = [path.stat().st_mode for path in real.parents]
    is_shared = any(mode & stat.S_IWOTH and not mode & stat.S_ISVTX for mode in above)
    accessible = os.access(real, os.R_OK | os.W_OK | os.X_OK)
    return accessible and _is_own(real.stat()) and (os.name == "nt" or not is_shared)


def _is_own(status: os.stat_result) -> bool:
    """Return True if a file or folder belongs to this user and no other user can write it."""
    if sys.platform == "win32":  # no such owners: the profile of the user is closed to others
        return True
    if status.st_uid != os.geteuid() or status.st_mode & stat.S_IWOTH:
        return False
    return not status.st_mode & stat.S_IWGRP or _is_private(status.st_gid)


def _is_private(group: int) -> bool:
    """Return True if a group is that of this user alone, as many systems have one for each."""
    if sys.platform == "win32":
        return False
    import grp
    import pwd

    try:
        user, entry = pwd.getpwuid(os.geteuid()).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return entry.gr_name == user and set(entry.gr_mem) <= {user}
