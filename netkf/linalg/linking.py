"""One piece of machine code for a compiled function and all that it calls.

numba compiles each function to machine code of its own, with all that it calls linked in, although
a function that is called by another compiled one alone is only ever linked into that. Of many small
functions each is optimised over and over again so, which takes several times as long as the rest.
Here, while the outermost function is compiled, those that it calls stay as they are until they are
linked into it, each once. This relies on names of numba that are not public (see pyproject.toml for
its versions, and tests/linalg/test_linking.py).
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from netkf.linalg.shortcuts import shortcuts


class _Depth(threading.local):
    """How deep a thread is in compiling, loading and finalizing."""

    def __init__(self) -> None:
        self.compile = self.load = self.finalize = 0


_DEPTH = _Depth()
_INNER: set[str] = set()
"""Names of functions that are linked into others."""
_BARE: weakref.WeakSet[Any] = weakref.WeakSet()
"""Their libraries, which do not contain what they call."""
_WHOLE: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()
"""Modules of such libraries with all that they call."""
_ONE_AT_A_TIME = threading.RLock()
"""numba's methods are replaced for the whole process, so threads compile one after the other."""


@contextmanager
def linked_once() -> Iterator[None]:
    """Inside, only the outermost function that is compiled gets machine code. With a numba that has
    other names everything is compiled as numba does it.
    """
    with _ONE_AT_A_TIME, _replaced():
        yield


@contextmanager
def _replaced() -> Iterator[None]:
    try:
        patches = [*_patches(), *shortcuts()]
        # All originals are looked up before the first is replaced: a numba without one of them is
        # left as it is.
        before = [(owner, name, owner.__dict__[name]) for owner, name, _ in patches]
    except (AttributeError, ImportError, KeyError):
        patches, before = [], []
    for owner, name, patch in patches:
        setattr(owner, name, patch)
    try:
        yield
    finally:
        for owner, name, original in before:
            setattr(owner, name, original)


def _patches() -> list[tuple[Any, str, Callable[..., Any]]]:
    """Return the replacements of numba's methods: class, name, method."""
    from numba.core.codegen import CPUCodeLibrary
    from numba.core.cpu import CPUContext
    from numba.core.dispatcher import Dispatcher

    library: Any = CPUCodeLibrary
    return [
        # Depths tell the outermost function from those compiled on its way.
        (Dispatcher, "compile", _count_depth("compile", Dispatcher.compile)),
        (library, "finalize", _count_depth("finalize", _linked_flat(library.finalize))),
        (
            CPUContext,
            "get_executable",
            _only_outermost("compile", _count_depth("load", CPUContext.get_executable), _stub),
        ),
        *(
            (CPUContext, name, _only_outermost("compile", getattr(CPUContext, name), _nothing))
            for name in ("create_cpython_wrapper", "create_cfunc_wrapper")
        ),
        (
            library,
            "_optimize_final_module",
            _only_outermost("finalize", _private(library._optimize_final_module), _nothing),
        ),
        # An inner library keeps its functions as they are, and their names for _private().
        (
            library,
            "_finalize_final_module",
            _only_outermost("finalize", library._finalize_final_module, _keep_as_it_is),
        ),
    ]


def _count_depth(what: str, original: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``original`` with a count of its nested calls in the attribute ``what`` of _DEPTH."""

    def counted(*args: Any, **kwargs: Any) -> Any:
        # Threads have depths of their own; numba's compiler itself is locked.
        setattr(_DEPTH, what, getattr(_DEPTH, what) + 1)
        try:
            return original(*args, **kwargs)
        finally:
            setattr(_DEPTH, what, getattr(_DEPTH, what) - 1)

    return counted


def _only_outermost(
    what: str, original: Callable[..., Any], inner: Callable[..., Any]
) -> Callable[..., Any]:
    def choose(*args: Any, **kwargs: Any) -> Any:
        return (inner if _is_linked(what) else original)(*args, **kwargs)

    return choose


def _is_linked(what: str) -> bool:
    """Return True if what is compiled or finalized now is linked into something else."""
    # What is linked is finalized too, while its caller is lowered or finalized. What was kept on
    # disk is loaded without being finalized again.
    depth: int = getattr(_DEPTH, what)
    return depth > 1 or (what == "finalize" and depth > _DEPTH.load)


def _stub(_: Any, library: Any, fndesc: Any, env: Any) -> Any:
    """Stands for a function that is linked in, and never called from Python (it would raise)."""
    from numba import _dynfunc  # type: ignore[attr-defined]

    # Any function that raises will do, because nobody calls the stub.
    raising = ctypes.cast(ctypes.pythonapi.PyErr_NoMemory, ctypes.c_void_p).value
    module, name = fndesc.lookup_module(), fndesc.qualname.split(".")[-1]
    return _dynfunc.make_function(module, name, "linked in", raising, env, (library,))


def _nothing(*_: Any, **__: Any) -> None:
    """Leave out wrappers for Python and optimisation of a function that is linked in."""


def _private(optimize: Callable[..., Any]) -> Callable[..., Any]:
    """Nobody else calls what was linked in, so its unused arguments and copies may go."""

    def optimize_all(library: Any) -> Any:
        for function in library._final_module.functions:
            if function.name in _INNER and not function.is_declaration:
                # "internal": LLVM may drop the function after inlining it, and need not keep its
                # signature.
                function.linkage = "internal"
            # Machine code would call an address that nobody knows.
            if function.name in _INNER and function.is_declaration:
                raise AssertionError(f"numba has not linked {function.name}")
        return optimize(library)

    return optimize_all


class _Part:
    """A library without what it calls, as numba links it."""

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Any:
        return getattr(self._library, name)

    def _get_module_for_linking(self) -> Any:
        # The method of the class: that of a bare library returns all that it calls, too.
        return type(self._library)._get_module_for_linking(self._library)


def _linked_flat(finalize: Callable[..., Any]) -> Callable[..., Any]:
    """Link all that is called, however deep, into the outermost library, and nothing into others.

    numba copies what a function calls into it, and then both into its caller, and so on.
    """

    def finalize_flat(library: Any) -> Any:
        called = library._linking_libraries
        library._linking_libraries = [] if _is_linked("finalize") else _all_called(library)
        try:
            return finalize(library)
        finally:
            library._linking_libraries = called

    return finalize_flat


def _all_called(library: Any) -> list[_Part]:
    """Return the libraries that a library calls, and those which they call, each once.

    Callers come before what they call: LLVM links a function only where it is called already.
    """
    done: list[_Part] = []
    found: set[Any] = set()

    def visit(caller: Any) -> None:
        for called in reversed(list(caller._linking_libraries)):
            if called not in found:
                found.add(called)
                # Others have all that they call inside them.
                if called in _BARE:
                    visit(called)
                done.append(_Part(called))

    visit(library)
    return done[::-1]


def _with_all_called(library: Any) -> Any:
    """Return the module of a bare library and all that it calls, for numba as it is."""
    if library not in _WHOLE:
        module = _Part(library)._get_module_for_linking().clone()
        for called in _all_called(library):
            module.link_in(called._get_module_for_linking(), preserve=True)
        _WHOLE[library] = module
    return _WHOLE[library]


def _keep_as_it_is(library: Any) -> None:
    """Finalize a library as numba does, without machine code."""
    defined = library._final_module.functions
    _INNER.update(f.name for f in defined if not f.is_declaration)
    _BARE.add(library)
    # Functions of numba itself may be called by others later, which link them in as numba does.
    library._get_module_for_linking = partial(_with_all_called, library)
    # What ``finalize`` does without optimising and generating code: the outermost library will do
    # both. What is called is not linked yet, so that it is not verified either.
    library._finalize_dynamic_globals()
    library._finalized = True
