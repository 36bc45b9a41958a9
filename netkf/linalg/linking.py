"""Machine code only for the outermost function of a compilation, with all callees linked in.

numba links all callees of a function into it, optimises the result and generates machine code; it
does so for every function, also for one that only other compiled functions call. A small function
is thereby optimised again in each of its direct and indirect callers, which takes most of the time.
Here inner functions stay unoptimised LLVM modules while the outermost function is compiled, and are
linked into it once. This replaces private methods of numba (see pyproject.toml for its versions,
and tests/linalg/test_linking.py).
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


class _Depth(threading.local):
    """Depths of nested calls, per thread, of numba's compile, get_executable and finalize."""

    def __init__(self) -> None:
        self.compile = self.load = self.finalize = 0


_DEPTH = _Depth()
_given_up: list[bool] = []
"""Not empty once numba could not compile so what it could compile in its own way."""
_INNER_NAMES: set[str] = set()
"""LLVM names of the functions of inner libraries."""
_UNLINKED: weakref.WeakSet[Any] = weakref.WeakSet()
"""Inner libraries, which do not contain their callees."""
_LINKED_MODULES: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()
"""Modules of inner libraries with all their callees linked in, made on demand."""
_COMPILE_LOCK = threading.RLock()
"""Held while numba's methods are replaced, since that affects all threads of the process."""


@contextmanager
def linked_once() -> Iterator[None]:
    """Within this context only the outermost compiled function gets machine code.

    If this version of numba lacks one of the replaced names, it compiles in its own way.
    """
    with _COMPILE_LOCK, _patched_numba():
        yield


def give_up() -> None:
    """Let numba compile in its own way from now on: it is not as it was when this was written."""
    _given_up.append(True)


@contextmanager
def _patched_numba() -> Iterator[None]:
    """Replace what ``_patches`` lists within this context, or nothing where a name is missing."""
    try:
        patches = [] if _given_up else _patches()
        # All originals are looked up before the first is replaced.
        originals = [(owner, name, owner.__dict__[name]) for owner, name, _ in patches]
    except (AttributeError, ImportError, KeyError):
        patches, originals = [], []
    for owner, name, patch in patches:
        setattr(owner, name, patch)
    try:
        yield
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


def _patches() -> list[tuple[Any, str, Callable[..., Any]]]:
    from numba.core import ccallback
    from numba.core.codegen import CPUCodeLibrary
    from numba.core.cpu import CPUContext
    from numba.core.dispatcher import Dispatcher
    from numba.np import arrayobj

    library: Any = CPUCodeLibrary
    c_function: Any = ccallback.CFunc
    return [
        # Depths tell the outermost function from the inner ones compiled on the way.
        (Dispatcher, "compile", _count_depth("compile", Dispatcher.compile)),
        (c_function, "_compile_uncached", _with_code(c_function._compile_uncached)),
        (library, "finalize", _count_depth("finalize", _link_once(library.finalize))),
        (
            CPUContext,
            "get_executable",
            _only_outermost("compile", _count_depth("load", CPUContext.get_executable), _stub),
        ),
        *(
            (CPUContext, name, _only_outermost("compile", getattr(CPUContext, name), _skip))
            for name in ("create_cpython_wrapper", "create_cfunc_wrapper")
        ),
        (
            library,
            "_optimize_final_module",
            _only_outermost("finalize", _internalise(library._optimize_final_module), _skip),
        ),
        (arrayobj, "fix_integer_index", _without_sign_test(arrayobj.fix_integer_index)),
        # An inner library keeps its unoptimised functions, and their names for _internalise().
        (
            library,
            "_finalize_final_module",
            _only_outermost("finalize", library._finalize_final_module, _finalize_without_code),
        ),
    ]


def _without_sign_test(fix: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``fix``, which corrects an index, without its test of the sign."""
    from llvmlite import ir
    from numba import types

    def fix_index(context: Any, builder: Any, index_type: Any, index: Any, size: Any) -> Any:
        # Testing what kernels compute would take a tenth of the time of the event loop.
        if isinstance(_inserted_value(index), ir.Constant):
            return fix(context, builder, index_type, index, size)
        return context.cast(builder, index, index_type, types.intp)

    return fix_index


def _inserted_value(entry: Any) -> Any:
    """Return what was put into the tuple that an LLVM value is an ``entry`` of, else ``entry``."""
    if type(entry).__name__ != "ExtractValue":
        return entry
    tuple_so_far = entry.aggregate
    while type(tuple_so_far).__name__ == "InsertValue":
        if list(tuple_so_far.indices) == list(entry.indices):
            return tuple_so_far.value
        tuple_so_far = tuple_so_far.aggregate
    return entry


def _count_depth(stage: str, original: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``original`` with a count of its nested calls in the attribute ``stage`` of _DEPTH."""

    def count_and_call(*args: Any, **kwargs: Any) -> Any:
        setattr(_DEPTH, stage, getattr(_DEPTH, stage) + 1)
        try:
            return original(*args, **kwargs)
        finally:
            setattr(_DEPTH, stage, getattr(_DEPTH, stage) - 1)

    return count_and_call


def _with_code(compile_uncached: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap the compilation of a C function, which is an outermost one, so that it has its code."""

    def compile_and_finalize(function: Any) -> Any:
        result = _count_depth("compile", compile_uncached)(function)
        _count_depth("load", result.library._ensure_finalized)()
        return result

    return compile_and_finalize


def _only_outermost(
    stage: str, original: Callable[..., Any], inner: Callable[..., Any]
) -> Callable[..., Any]:
    """Return ``original`` for the outermost compiled function and ``inner`` for those it calls."""

    def choose(*args: Any, **kwargs: Any) -> Any:
        return (inner if _is_linked(stage) else original)(*args, **kwargs)

    return choose


def _is_linked(stage: str) -> bool:
    """Return True if the function that is now in ``stage`` is one that another one calls."""
    # The outermost library is finalized inside get_executable; a finalize outside of it, or nested
    # in another one, is that of a callee. Code loaded from disk is not finalized again.
    depth: int = getattr(_DEPTH, stage)
    return depth > 1 or (stage == "finalize" and depth > _DEPTH.load)


def _stub(_: Any, library: Any, fndesc: Any, env: Any) -> Any:
    """Return the Python object of an inner function, which Python never calls (it would raise)."""
    from numba import _dynfunc  # type: ignore[attr-defined]

    # numba needs some address: that of a C function that raises.
    raising = ctypes.cast(ctypes.pythonapi.PyErr_NoMemory, ctypes.c_void_p).value
    module, name = fndesc.lookup_module(), fndesc.qualname.split(".")[-1]
    return _dynfunc.make_function(module, name, "linked in", raising, env, (library,))


def _skip(*_: Any, **__: Any) -> None:
    """Do nothing: an inner function needs neither wrappers for Python nor optimisation."""


def _internalise(optimize: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap ``optimize``: LLVM may drop linked inner functions, or change their signature."""

    def optimize_all(library: Any) -> Any:
        for function in library._final_module.functions:
            if function.name in _INNER_NAMES and not function.is_declaration:
                function.linkage = "internal"
            # An unlinked inner function has no machine code: calling it would crash.
            if function.name in _INNER_NAMES and function.is_declaration:
                raise AssertionError(f"numba has not linked {function.name}")
        return optimize(library)

    return optimize_all


class _OwnCode:
    """A library as numba links it, reduced to its own functions without its callees.

    It stands for ``library`` in lists of callees; only ``_get_module_for_linking`` differs.
    """

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Any:
        """Return the attribute ``name`` of the wrapped library: all that is not defined here."""
        return getattr(self._library, name)

    def _get_module_for_linking(self) -> Any:
        # The method of the class: an inner library overrides it to include its callees.
        return type(self._library)._get_module_for_linking(self._library)


def _link_once(finalize: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap ``finalize``: the outermost library links all callees, inner ones none."""

    def finalize_flat(library: Any) -> Any:
        # numba links at each level, so that inner functions would be copied many times.
        direct_callees = library._linking_libraries
        library._linking_libraries = [] if _is_linked("finalize") else _all_called(library)
        try:
            return finalize(library)
        finally:
            library._linking_libraries = direct_callees

    return finalize_flat


def _all_called(library: Any) -> list[_OwnCode]:
    """Return all direct and indirect callees, each once, callers first as LLVM needs them."""
    ordered: list[_OwnCode] = []
    visited: set[Any] = set()

    def visit(caller: Any) -> None:
        for callee in reversed(list(caller._linking_libraries)):
            if callee not in visited:
                visited.add(callee)
                # Libraries that numba finalized contain their callees.
                if callee in _UNLINKED:
                    visit(callee)
                ordered.append(_OwnCode(callee))

    visit(library)
    return ordered[::-1]


def _with_all_called(library: Any) -> Any:
    """Return the module of an inner library with all its callees, for numba's own linking."""
    if library not in _LINKED_MODULES:
        module = _OwnCode(library)._get_module_for_linking().clone()
        for callee in _all_called(library):
            module.link_in(callee._get_module_for_linking(), preserve=True)
        _LINKED_MODULES[library] = module
    return _LINKED_MODULES[library]


def _finalize_without_code(library: Any) -> None:
    """Finalize an inner library, without optimising it or making machine code."""
    _INNER_NAMES.update(f.name for f in library._final_module.functions if not f.is_declaration)
    _UNLINKED.add(library)
    # Later callers that numba finalizes in its own way expect all callees in the module.
    library._get_module_for_linking = partial(_with_all_called, library)
    # The remaining steps of ``finalize``; verification would fail while callees are not linked.
    library._finalize_dynamic_globals()
    library._finalized = True
