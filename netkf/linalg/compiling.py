"""Kernels: numerical functions written as loops, compiled by numba when first called.

:func:`kernel` is the only decorator. Python and other kernels call a kernel alike. Its code is kept
on disk, so that the next process starts at once; numba itself is imported with the first call.
"""

from __future__ import annotations

import atexit
import dis
import gc
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, cached_property, update_wrapper
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar, cast, overload

from netkf.linalg.code_files import CodeFiles, make_own_folder
from netkf.linalg.compile_once import SharedCache
from netkf.linalg.linking import give_up, linked_once
from netkf.linalg.plain import is_plain, plain_kernel

ROOT = Path(__file__).parents[1]
"""The folder of netkf."""

ROOMS = (
    "linalg", "rng", "core", "network", "algorithms", "plants", "trace", "engines", "ensembles",
    "theory/numerics",
)  # fmt: skip
"""Folders of netkf whose functions and constants can become part of compiled code."""

MAX_CACHED_STATES = 4
"""Number of states of the sources for which compiled code is kept on disk."""

UNROLLED, UNROLLED_BY_NUMBA = 1000, 300
"""Largest number of instructions of an unrolled loop (LLVM's unroll-threshold): in kernels, so that
nested loops over up to four states are unrolled completely, and in other functions.
"""

Function = TypeVar("Function", bound=Callable[..., Any])
# Kernels are not called from C: the wrapper would be a seventh of the compiled code.
PRIVATE_OPTIONS = ("no_cfunc_wrapper", "_nrt")
_OPTIONS: Any = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_has_frozen = [False]
"""Whether there were objects that others had frozen (gc.freeze)."""
_announcing = [False]
"""Whether the next kernel that is compiled is announced."""
_compile_times: list[float] = []
_folders_of_process: set[Path] = set()


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(
    *, allocates: bool = False, inlined: bool = False, fused: bool = False
) -> Callable[[Function], Function]: ...


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    allocates: bool = False,
    inlined: bool = False,
    fused: bool = False,
) -> Any:
    """Mark a numerical function, written as loops over arrays, that is always run compiled.

    It may call kernels, and runs without the interpreter's lock.

    allocates : it creates arrays; otherwise it works in place
    inlined   : its code becomes part of each kernel that calls it, which pays off for functions of
                up to a few hundred flops
    fused     : a product and a sum may become one instruction (FMA), which rounds once
    """
    # ``@kernel(...)`` with arguments is called without the function.
    if function is None:
        return lambda loops: _make_kernel(loops, allocates, inlined, fused)
    return _make_kernel(function, allocates, inlined, fused)


@cache
def require_numba() -> Any:
    """Return the module numba, with the types that kernels use registered."""
    # Imported by the first call of a kernel: importing netkf must not import numba.
    _configure_numba()
    import numba

    from netkf.linalg import (  # noqa: F401 - register types
        function_types,
        generic_types,
        lane_types,
        local_types,
        struct_types,
        word_types,
    )

    typeof: Any = numba.typeof

    def type_of(value: Kernel, _: Any) -> Any:
        return typeof(value._kernel_dispatcher)

    numba.extending.typeof_impl.register(Kernel)(type_of)
    return numba


@cache
def _unknown_options() -> set[str]:
    """Return those of numba's private options that this numba does not have: they save time."""
    try:
        from numba.core.cpu import CPUTargetOptions
    except ImportError:
        return set(PRIVATE_OPTIONS)
    return {name for name in PRIVATE_OPTIONS if not hasattr(CPUTargetOptions, name)}


def _if_numba_can(step: Callable[..., None], *args: Any) -> None:
    """Take a step that saves time and needs private names of numba, which may lack one."""
    with suppress(Exception):
        step(*args)


@cache
def _configure_numba() -> None:
    """Import numba without the settings in the current folder, which may be anyone's."""
    is_new, yaml = "numba" not in sys.modules, sys.modules.get("yaml")
    if is_new:
        sys.modules["yaml"] = None  # type: ignore[assignment] # numba reads only settings with it
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            config: Any = import_module("numba.core.config")
    finally:
        if is_new:
            sys.modules.pop("yaml")
            sys.modules.update({"yaml": yaml} if yaml is not None else {})
    # It is looked for again whenever something is compiled.
    config._config_fname = ""


class Kernel:
    """A numerical function written as loops. Python and other kernels call it alike."""

    def __init__(self, loops: Callable[..., Any], options: dict[str, Any]) -> None:
        """Wrap the Python function ``loops``; ``options`` are those of numba's njit."""
        self.loops, self._options = loops, options
        self._entries: list[Any] = []
        update_wrapper(self, loops)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the compiled function; the first call compiles it or loads it from disk."""
        return self._python_dispatcher(*args, **kwargs)

    def __reduce__(self) -> str:
        """Return the name of the kernel in its module: pickle stores that, and not the code."""
        return self.loops.__qualname__

    @cached_property
    def _kernel_dispatcher(self) -> Any:
        """The numba dispatcher for calls by other kernels; not cached on disk by itself."""
        dispatcher = self._new_dispatcher()
        _if_numba_can(_widen_arguments, dispatcher)
        return dispatcher

    @cached_property
    def _python_dispatcher(self) -> Callable[..., Any]:
        """The numba dispatcher for calls by Python; cached on disk with all its callees."""
        dispatcher = self._new_dispatcher()
        _if_numba_can(_compile_well, dispatcher, "_compile_for_args", self.loops)
        return cast(Callable[..., Any], dispatcher)

    def compile_entry(self, arguments: tuple[Any, ...], returns_number: bool) -> int:
        """Return the address of a C function for ``arguments`` of these types, which returns a
        float or nothing (``addresses``); compile it, or load it from disk. Raises TypeError for a
        user's function that raises: C has no exceptions, and a run would go on with what is there;
        and for one that prints, which needs the interpreter's lock: a run may wait for it forever.
        """
        require_quiet(self.loops, set())
        numba = require_numba()
        returned = numba.types.float64 if returns_number else numba.types.void
        kinds = tuple(map(numba.typeof, arguments))
        options = {k: v for k, v in self._known_options().items() if k != "no_cfunc_wrapper"}
        entry = compile_c_function(self.loops, returned(*kinds), options)
        self._entries.append(entry)
        return int(entry.address)

    def _new_dispatcher(self) -> Any:
        return require_numba().njit(**self._known_options())(self.loops)

    def _known_options(self) -> dict[str, Any]:
        return {name: self._options[name] for name in self._options.keys() - _unknown_options()}


def compile_c_function(
    loops: Callable[..., Any], signature: Any, options: Mapping[str, Any]
) -> Any:
    """Return the C function of a Python function, compiled or loaded from disk."""
    try:
        from numba.core.ccallback import CFunc

        entry: Any = CFunc(loops, (signature.args, signature.return_type), {}, dict(options))
        _if_numba_can(_compile_well, entry, "compile", loops)
        entry.compile()
    except (ImportError, AttributeError, TypeError):  # a private name of numba is missing
        entry = require_numba().cfunc(signature, **options)(loops)
    return entry


def require_quiet(loops: Callable[..., Any], seen: set[Any]) -> None:
    """Raise TypeError if a user's function, or a kernel that it calls, raises or prints."""
    code, names = loops.__code__, loops.__globals__
    if loops in seen or str(names.get("__name__")).partition(".")[0] == "netkf":
        return
    seen.add(loops)
    for step in dis.get_instructions(code):
        raises = step.opname == "RAISE_VARARGS"
        if raises or (step.opname == "LOAD_GLOBAL" and step.argval == "print"):
            lines = (line for begin, end, line in code.co_lines() if begin <= step.offset < end)
            where = f"{code.co_filename}, line {next(lines, code.co_firstlineno)}"
            what = "raise" if raises else "print"
            remedy = (
                "write nan, which ends the run" if raises else "set NUMBA_DISABLE_JIT=1 for that"
            )
            raise TypeError(f"a kernel must not {what} ({where}): {remedy}")
    for callee in map(names.get, code.co_names):
        if isinstance(callee, Kernel):
            require_quiet(callee.loops, seen)


def _make_kernel(
    loops: Callable[..., Any], allocates: bool, inlined: bool, fused: bool
) -> Callable[..., Any]:
    """Return the Kernel of a function, with numba's options for the arguments of :func:`kernel`."""
    if is_plain():
        return plain_kernel(loops)
    # "_nrt": without numba's runtime there is no reference counting, and no allocation.
    options = {**_OPTIONS, "_nrt": allocates}
    if inlined:
        options["forceinline"] = True
    if fused:
        options["fastmath"] = {"contract"}
    return Kernel(loops, options)


def _widen_arguments(function: Any) -> None:
    """Widen literals and integers in calls of kernels, so that they share one compiled version."""
    from numba.core import types

    kinds, template_for = cast(Any, types), function.get_call_template

    def widen(kind: Any) -> Any:
        general = kinds.unliteral(kind)
        # Fields of records may be int8 or int32.
        return kinds.int64 if isinstance(general, kinds.Integer) and general.signed else general

    def template_of_widened(args: Any, kws: Any) -> Any:
        named = {name: widen(kind) for name, kind in kws.items()}
        return template_for(tuple(widen(kind) for kind in args), named)

    function.get_call_template = template_of_widened


def _compile_well(function: Any, method: str, loops: Callable[..., Any]) -> None:
    """Keep compiled code on disk, and let ``method`` use LLVM's level 2 and link once."""
    # Level 3 takes a quarter longer and gains nothing here.
    from llvmlite.binding import set_option

    config: Any = import_module("numba.core.config")
    compile_for, level = getattr(function, method), type(config.OPT)
    # Not numba's own cache, which executes what it finds, and whose files are known by the file of
    # the function alone, while callees may change. Of several processes one compiles.
    files = CodeFiles(loops, _cache_folder(config.CACHE_DIR))
    shared = function._cache = SharedCache(files, loops.__name__, _say_that_it_compiles)

    def compile_linked(*args: Any, **kwargs: Any) -> Any:
        try:
            with linked_once():
                return compile_for(*args, **kwargs)
        except Exception:
            # The lock that the failed attempt holds would block this one. Where numba's own way
            # works, the other is of no use with this numba; else it is an error of the function.
            shared.release()
            made = compile_for(*args, **kwargs)
            give_up()
            return made

    def compile_with_settings(*args: Any, **kwargs: Any) -> Any:
        """Numba calls it for a kernel that has no code for the types of its arguments yet."""
        before, collects, started = config.OPT, gc.isenabled(), time.perf_counter()
        # Visiting what the compiler makes is a tenth of its time.
        gc.disable()
        config.OPT = level(2)
        set_option("netkf", f"-unroll-threshold={UNROLLED}")
        try:
            return compile_linked(*args, **kwargs)
        finally:
            config.OPT = before
            if collects:
                _count_as_old()
                gc.enable()
            # LLVM options cannot be unset: this is the value that numba's own level implies.
            set_option("netkf", f"-unroll-threshold={UNROLLED_BY_NUMBA}")
            # Other processes wait at the lock for this code.
            shared.release()
            _compile_times.append(time.perf_counter() - started)

    setattr(function, method, compile_with_settings)


def _count_as_old() -> None:
    """Leave all objects to the next full collection: visiting the new ones now takes as long."""
    # Who has frozen objects wants them to stay so, and these with them. Counting takes long.
    _has_frozen[0] = _has_frozen[0] or gc.get_freeze_count() > 0
    gc.freeze()
    if not _has_frozen[0]:
        gc.unfreeze()


def seconds_spent() -> float:
    """Return the seconds this process has spent on compiling, or loading code from disk."""
    return sum(_compile_times)


def announce() -> None:
    """Print a note to stderr before the next kernel whose code is not on disk yet is compiled: it,
    and those that follow, take seconds.
    """
    _announcing[0] = True


def _say_that_it_compiles() -> None:
    if _announcing[0]:
        folder = _cache_folder(os.environ.get("NUMBA_CACHE_DIR", ""))
        when = "once for each kind of filter"
        if not _folders_of_process.isdisjoint((folder, folder.parent)):
            when = "in each process: NUMBA_CACHE_DIR names no folder that only you can write"
        print(f"netkf: compiling (up to half a minute), {when} ...", file=sys.stderr, flush=True)
    _announcing[0] = False


def source_digest(*rooms: str) -> str:
    """Return 16 hexadecimal digits of the SHA-256 of netkf's modules: of those in the folders
    ``rooms`` (paths relative to netkf), or of all if none is given.
    """
    digest = hashlib.sha256()
    files = [file for room in rooms or ("",) for file in (ROOT / room).rglob("*.py")]
    for file in sorted(files):
        digest.update(f"{file.relative_to(ROOT).as_posix()}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


@cache
def _cache_folder(chosen: str) -> Path:
    """Return the folder of compiled code: one for each state of the sources."""
    # A kernel may contain constants and kernels of any of ROOMS; any change of their sources gives
    # a new folder, so that compiled code is never out of date.
    folder = _first_writable(chosen, ROOT) / f"netkf-{source_digest(*ROOMS)}"
    if not folder.exists():
        _remove_old_folders(folder.parent)
    return folder if _is_own_folder(folder) else _folder_of_process()


def _first_writable(chosen: str, root: Path) -> Path:
    """Return the first folder that only this user can write, ``chosen`` if it is not empty."""
    # ``chosen`` is NUMBA_CACHE_DIR. An installation may be read-only.
    places = [Path(chosen)] if chosen else [root / "__pycache__", *_user_folders()]
    # Never numba's own default folder, whose code may be out of date.
    return next((place for place in places if _is_own_folder(place)), None) or _folder_of_process()


def _user_folders() -> list[Path]:
    """Return netkf's cache folder of this user, if there is one."""
    given, home = os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~")
    if os.path.isabs(given):
        return [Path(given) / "netkf"]
    # A relative path, also the "~" of a user without a home, is in the current folder, whose files
    # may be anyone's; an empty HOME gives "/".
    return [] if home == os.sep else [Path(home) / ".cache" / "netkf"]


def _is_own_folder(folder: Path) -> bool:
    """Return True if the folder exists, or can be made, and only this user can write it."""
    try:
        return make_own_folder(folder)
    except (OSError, ValueError):  # ValueError: a name that no folder can have
        return False


def _folder_of_process() -> Path:
    """Return a temporary folder that is removed in the end, or an impossible one."""
    # Cached code is executed: a fixed name in a shared folder could be another user's.
    try:
        folder = Path(tempfile.mkdtemp(prefix="netkf-"))
    except OSError:  # all is read-only
        folder = Path(os.devnull, "netkf")
    _folders_of_process.add(folder)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _remove_old_folders(folder: Path) -> None:
    """Remove all but the newest states: with the next there are MAX_CACHED_STATES."""
    # Others' folders may have similar names.
    folders = [path for path in folder.glob("netkf-*") if _holds_code_only(path)]
    # A few are kept, so that switching between branches does not compile anew.
    with suppress(OSError):  # another process may do the same
        for old in sorted(folders, key=lambda path: path.stat().st_mtime)[: -MAX_CACHED_STATES + 1]:
            shutil.rmtree(old, ignore_errors=True)


def _holds_code_only(folder: Path) -> bool:
    """Return True if a folder is one of compiled code by its name and by what it holds."""
    if not re.fullmatch("netkf-[0-9a-f]{16}", folder.name) or folder.is_symlink():
        return False
    return all(
        path.is_dir() or path.suffix in (".nbi", ".nbc", ".lock") or ".tmp." in path.name
        for path in folder.rglob("*")
    )
