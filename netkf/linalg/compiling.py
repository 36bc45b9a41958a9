"""Kernels: numerical functions written as loops, compiled by numba when first called.

:func:`kernel` is the only decorator. Python and other kernels call a kernel alike. Its code is kept
on disk, so that the next process starts at once; numba itself is imported with the first call.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any, TypeVar, cast, overload

from netkf.linalg.compile_once import SharedCache
from netkf.linalg.linking import linked_once
from netkf.linalg.shortcuts import kernel_compiler, without_collection

ROOT = Path(__file__).parents[1]
"""The folder of netkf."""

ROOMS = (
    "linalg",
    "rng",
    "core",
    "algorithms",
    "plants",
    "trace",
    "engines",
    "ensembles",
    "theory/numerics",
)
"""Whose code and numbers compiled functions may hold."""

MAX_CACHED_STATES = 4
"""Of the sources, whose compiled code is kept."""

UNROLLED, UNROLLED_BY_NUMBA = 1000, 300
"""Instructions that a loop of known length may have when it is unrolled: in kernels, so that loops
over up to four states vanish however many are inside each other, and elsewhere.
"""

Function = TypeVar("Function", bound=Callable[..., Any])
# Nobody calls a kernel from C: the wrapper would be a seventh of what is compiled.
_OPTIONS: Any = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_said: set[Callable[..., Any]] = set()
_spent: list[float] = []


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(
    *,
    allocates: bool = False,
    inlined: bool = False,
    fused: bool = False,
    compact: bool = False,
) -> Callable[[Function], Function]: ...


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    allocates: bool = False,
    inlined: bool = False,
    fused: bool = False,
    compact: bool = False,
) -> Any:
    """Mark a numerical function, written as loops over arrays, that is always run compiled.

    It may call kernels, works in place and makes no arrays, or is marked
    ``@kernel(allocates=True)``. It runs without the interpreter's lock. ``inlined``: its code
    becomes part of each kernel that calls it, which pays for steps of a few hundred flops.
    ``fused``: a product and a sum may be one instruction, which rounds once. ``compact``: it is
    called seldom, and its loops stay as they are written, which halves the time to compile it.
    """
    # ``@kernel(...)`` with arguments comes without the function.
    if function is None:
        return lambda loops: _registered(loops, allocates, inlined, fused, compact)
    return _registered(function, allocates, inlined, fused, compact)


def _numba() -> Any:
    """Return numba, which knows all that kernels use."""
    # Imported with the first call: importing netkf must not import numba.
    import numba

    from netkf.linalg import (  # noqa: F401 - register types
        lane_types,
        local_types,
        struct_types,
        word_types,
    )

    return numba


class Kernel:
    """A numerical function written as loops. Python and other kernels call it alike."""

    def __init__(
        self, loops: Callable[..., Any], options: dict[str, Any], compact: bool = False
    ) -> None:
        self._loops, self._options, self._compact = loops, options, compact
        update_wrapper(self, loops)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the compiled function; the first call compiles it or loads it from disk."""
        return self._called_from_python(*args, **kwargs)

    def __reduce__(self) -> str:
        return self._loops.__qualname__

    @property
    def _compiler(self) -> Any:
        # Inlined kernels are small and run most often. Numba's own lowering tells LLVM more than
        # the lean one, which makes them up to 1.6 times faster.
        return kernel_compiler(not self._options.get("forceinline", False), self._compact)

    @property
    def _numba_type_(self) -> Any:
        """Numba asks a name that compiled code uses for this attribute."""
        return self._called_from_kernels._numba_type_

    @cached_property
    def _called_from_kernels(self) -> Any:
        """The function as other kernels call it: never cached on disk by itself."""
        made = _numba().njit(pipeline_class=self._compiler, **self._options)(self._loops)
        _for_any_number(made)
        return made

    @cached_property
    def _called_from_python(self) -> Callable[..., Any]:
        """The function as Python calls it: with everything it calls, cached on disk."""
        numba = _numba()
        config = numba.config
        before = config.CACHE_DIR
        # numba looks at the file of the function alone, and what it calls may have changed.
        config.CACHE_DIR = str(_folder(before))
        try:
            made: Any = numba.njit(cache=True, pipeline_class=self._compiler, **self._options)(
                self._loops
            )
        finally:
            config.CACHE_DIR = before
        # Of processes that start side by side one compiles, and the others wait for it.
        made._cache = SharedCache(made._cache, self._loops.__name__)
        # numba's level is global: it is set while this function compiles.
        _moderately_optimised(made, config)
        return cast(Callable[..., Any], made)


def _registered(
    loops: Callable[..., Any], allocates: bool, inlined: bool, fused: bool, compact: bool
) -> Callable[..., Any]:
    options = {**_OPTIONS, "_nrt": allocates}
    if inlined:
        options["forceinline"] = True
    if fused:
        options["fastmath"] = {"contract"}
    return Kernel(loops, options, compact)


def _for_any_number(function: Any) -> None:
    """Compile a function once for the types of its arguments, whatever constants it is given, and
    however many bits integers have.
    """
    from numba.core import types

    kinds, template_for = cast(Any, types), function.get_call_template

    def widened(kind: Any) -> Any:
        kind = kinds.unliteral(kind)
        # Fields of records may be narrow.
        return kinds.int64 if isinstance(kind, kinds.Integer) and kind.signed else kind

    def for_types(args: Any, kws: Any) -> Any:
        named = {name: widened(kind) for name, kind in kws.items()}
        return template_for(tuple(widened(kind) for kind in args), named)

    function.get_call_template = for_types


def _moderately_optimised(made: Any, config: Any) -> None:
    """Let LLVM work at its level 2: level 3 takes a quarter longer and gains nothing here. But
    loops whose length it knows are unrolled up to a larger size than at any level.
    """
    from llvmlite.binding import set_option
    from numba.core.errors import NumbaError as numba_error  # noqa: N813

    compile_for = made._compile_for_args

    def moderately(*args: Any, **kwargs: Any) -> Any:
        before, began = config.OPT, time.perf_counter()
        config.OPT = type(before)(2)
        set_option("netkf", f"-unroll-threshold={UNROLLED}")
        try:
            # One link step for the function and all that it calls, see linking.
            try:
                with linked_once(), without_collection():
                    return compile_for(*args, **kwargs)
            except numba_error:
                # Once more as numba does it, to be told where in the function the error is.
                made._cache.release()
                return compile_for(*args, **kwargs)
        finally:
            config.OPT = before
            # LLVM cannot be told to forget it: this is what it takes for numba's own level.
            set_option("netkf", f"-unroll-threshold={UNROLLED_BY_NUMBA}")
            made._cache.release()
            _spent.append(time.perf_counter() - began)

    made._compile_for_args = moderately


def seconds_spent() -> float:
    """On compiling, or loading what is kept, in this process so far."""
    return sum(_spent)


def announce(function: Callable[..., Any]) -> None:
    """Say that a function will be compiled first, where its code is not kept on disk."""
    # Once per function and process.
    if function in _said:
        return
    _said.add(function)
    folder = _folder(os.environ.get("NUMBA_CACHE_DIR", ""))
    if not any(folder.rglob(f"*.{function.__name__}-*.nbi")):
        words = "netkf: compiling, once after an installation (5 to 15 s) ..."
        print(words, file=sys.stderr, flush=True)


def source_digest(*rooms: str) -> str:
    """Return 16 hexadecimal digits of the digest of netkf's modules, or of those of ``rooms``."""
    digest = hashlib.sha256()
    files = [file for room in rooms or ("",) for file in (ROOT / room).rglob("*.py")]
    for file in sorted(files):
        digest.update(f"{file.relative_to(ROOT).as_posix()}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


@cache
def _folder(chosen: str) -> Path:
    """Return the folder of compiled code: one for each state of the sources."""
    # A kernel may hold constants and kernels of any of these rooms, and a change of any byte makes
    # a new folder: compiled code is never out of date.
    name = f"netkf-{source_digest(*ROOMS)}"
    kept = _cache_folder_for(chosen, ROOT)
    if not (kept / name).exists():
        _make_room(kept)
    return kept / name


def _cache_folder_for(chosen: str, root: Path) -> Path:
    """Return the first folder of these that can be written: numba's if it was set, else one beside
    the sources and that of the user's cache; then one of this process alone.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    # The user's choice, NUMBA_CACHE_DIR. An installation may be read-only.
    places = [Path(chosen)] if chosen else [root / "__pycache__", home / "netkf"]
    # numba would look for a folder of its own, where code may be out of date.
    return next((place for place in places if _is_writable(place)), None) or _folder_of_process()


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return os.access(folder, os.R_OK | os.W_OK | os.X_OK)
    except (OSError, ValueError):  # ValueError: a name that no folder can have
        return False


def _folder_of_process() -> Path:
    """Return a new folder, which is removed when the process ends."""
    # Kept code is executed when it is read: a folder with a fixed name could be another user's.
    made = Path(tempfile.mkdtemp(prefix="netkf-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def _make_room(folder: Path) -> None:
    """Remove what was compiled from sources that are long gone."""
    found = [path for path in folder.glob("netkf-*") if path.is_dir()]
    # The newest states stay: switching between a few branches does not compile anew.
    for old in sorted(found, key=lambda path: path.stat().st_mtime)[: -MAX_CACHED_STATES + 1]:
        shutil.rmtree(old, ignore_errors=True)
