"""What numba does while it compiles and kernels do not need, left out.

numba is written in Python, and most of its time goes to the steps before LLVM. Here: no garbage
collection, the types of a call found once, no timers, a light first optimisation, and a pipeline
without the passes for closures, array expressions and annotations, which kernels do not have. The
pipeline is a public extension of numba; the others are replaced methods, see ``linking``.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from typing import Any

Patch = tuple[Any, str, Callable[..., Any]]

NOT_NEEDED = (
    *("WithLifting", "InlineClosureLikes", "RewriteDynamicRaises", "MakeFunctionToJitFunction"),
    *("InlineInlinables", "FindLiterallyCalls", "LiteralUnroll", "NopythonRewrites"),
    *("LiteralPropagationSubPipelinePass", "AnnotateTypes", "DumpParforDiagnostics"),
)
"""Passes of numba for what kernels do not contain."""


MANY = 10_000
"""Objects that are worth to be passed over by the collector, see without_collection."""


@contextmanager
def without_collection() -> Iterator[None]:
    """Inside, no garbage is collected: the compiler makes many objects, hardly any of which become
    garbage, and each collection looks at all of them. It costs some 100 MB of memory meanwhile.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            # All objects become old ones, unlooked at: the next collection would visit each. What
            # is only loaded makes few, and to count the frozen ones takes long where there are any.
            if gc.get_count()[0] > MANY and not gc.get_freeze_count():
                gc.freeze()
                gc.unfreeze()
            gc.enable()


@cache
def kernel_compiler(lean: bool, compact: bool = False) -> Any:
    """Return numba's compiler without the passes that are not needed; with short code for entries
    of arrays if ``lean``, which LLVM keeps small if it is ``compact`` too.
    """
    from numba.core import config
    from numba.core.compiler import CompilerBase, DefaultPassBuilder

    from netkf.linalg.lean_lowering import CompactLowering, KernelLegalization, KernelLowering
    from netkf.linalg.value_lowering import ValueLowering

    builder: Any = DefaultPassBuilder
    lowering: Any = ValueLowering
    # Bounds are checked by numba's own code.
    if lean and not getattr(config, "BOUNDSCHECK", None):
        lowering = CompactLowering if compact else KernelLowering
    own: dict[str, Any] = {"IRLegalization": KernelLegalization, "NativeLowering": lowering}

    class KernelCompiler(CompilerBase):
        """Compiles kernels."""

        def define_pipelines(self) -> list[Any]:
            pipeline = builder.define_nopython_pipeline(self.state)
            steps = [step for step in pipeline.passes if step[0].__name__ not in NOT_NEEDED]
            pipeline.passes = [(own.get(step.__name__, step), said) for step, said in steps]
            pipeline.finalize()
            return [pipeline]

    return KernelCompiler


def shortcuts() -> list[Patch]:
    """Return replacements of numba's methods: owner, name, method."""
    from numba.core import base, event, imputils, ir, lowering, typeinfer
    from numba.core.base import BaseContext
    from numba.core.codegen import CPUCodeLibrary
    from numba.core.compiler_machinery import PassManager
    from numba.core.postproc import PostProcessor
    from numba.core.types.functions import BaseFunction
    from numba.np import arrayobj

    from netkf.linalg.value_lowering import call_without_errors

    return [
        (PassManager, "_runPass", _run_pass),
        (PostProcessor, "run", _without_liveness(PostProcessor.run)),
        (BaseContext, "refresh", _if_anything_is_new(BaseContext.refresh)),
        (base, "_has_loc", cache(base._has_loc)),
        (base, "user_function", call_without_errors(imputils.user_function)),
        (BaseContext, "get_abi_sizeof", _cache_sizes(BaseContext.get_abi_sizeof)),
        (BaseFunction, "get_call_type", _found_once(BaseFunction.get_call_type)),
        (event, "install_timer", _no_timer),
        (event, "start_event", _if_anyone_listens(event.start_event)),
        (event, "end_event", _if_anyone_listens(event.end_event)),
        (ir.Inst, "_rec_list_vars", _variables_of()),
        (lowering, "new_error_context", _no_context),
        (typeinfer, "new_error_context", _no_context),
        (arrayobj, "fix_integer_index", _in_order(arrayobj.fix_integer_index)),
        (CPUCodeLibrary, "_optimize_functions", _keep_in_registers),
    ]


def _found_once(find: Callable[..., Any]) -> Callable[..., Any]:
    """Remember the signatures of calls of functions that numba knows: it tries all of their
    definitions, which are dozens for an operator, at each call.
    """
    known: dict[Any, Any] = {}

    def found(function: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return find(function, context, args, kws)
        # Definitions may be added, but are never taken away.
        call = function, context, tuple(args), len(function.templates)
        if call not in known:
            known[call] = find(function, context, args, kws)
        return known[call]

    return found


def _run_pass(manager: Any, _: int, step: Any, state: Any) -> None:
    """Run a compiler pass, without numba's event notifications and measurements of time."""
    step.analysis = manager._analysis
    for part in (step.run_initialization, step.run_pass, step.run_finalizer):
        part(state)


def _if_anything_is_new(refresh: Callable[..., Any]) -> Callable[..., Any]:
    """Look for new definitions only if there are some: numba imports thirty modules each time."""
    known: dict[int, int] = {}

    def size_of(context: Any) -> int:
        registries = [*context._registries, *context.typing_context._registries]
        lists = ("functions", "getattrs", "setattrs", "casts", "constants", "attributes", "globals")
        return sum(len(getattr(each, name, ())) for each in registries for name in lists)

    def refresh_if_new(context: Any) -> None:
        # Contexts of single functions share what they know.
        key = id(context._registries)
        if known.get(key) != size_of(context):
            refresh(context)
            known[key] = size_of(context)

    return refresh_if_new


def _without_liveness(run: Callable[..., Any]) -> Callable[..., Any]:
    """Leave out which variables are alive where blocks begin, which numba finds after each of six
    passes: generators and functions of Python objects need it, and kernels are neither.
    """
    from numba.core import postproc, transforms

    lifetime: Any = postproc.VariableLifetime
    in_order: Any = transforms.canonicalize_cfg

    def run_lightly(self: Any, emit_dels: bool = False, **how: Any) -> None:
        function = self.func_ir
        if function.is_generator:
            run(self, emit_dels, **how)
            return
        function.blocks = in_order(function.blocks)
        function.variable_lifetime = lifetime(function.blocks)
        function.generator_info = None
        if emit_dels:
            self._insert_var_dels(**how)

    return run_lightly


def _cache_sizes(size_of: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``size_of`` with a cache by type: numba has LLVM parse a module for each call."""
    known: dict[tuple[Any, str], int] = {}

    def size(context: Any, kind: Any) -> int:
        key = context, str(kind)
        if key not in known:
            known[key] = size_of(context, kind)
        return known[key]

    return size


def _in_order(wrapped: Callable[..., Any]) -> Callable[..., Any]:
    """Ask of no place that is computed if it is negative, see ``lean_lowering.is_in_order``."""
    from numba import types

    from netkf.linalg.lean_lowering import is_in_order

    def place_of(context: Any, builder: Any, kind: Any, place: Any, size: Any) -> Any:
        if is_in_order(place):
            return context.cast(builder, place, kind, types.intp)
        return wrapped(context, builder, kind, place, size)

    return place_of


def _no_timer(*_: Any) -> AbstractContextManager[None]:
    """Each function that is being compiled would time each call of LLVM for its statistics."""
    return nullcontext()


def _if_anyone_listens(tell: Callable[..., Any]) -> Callable[..., Any]:
    """Tell of no event if nobody listens: each call of LLVM is two."""
    from numba.core import event

    listeners: Any = event._registered

    def told(*args: Any, **kwargs: Any) -> None:
        if any(listeners.values()):
            tell(*args, **kwargs)

    return told


class _NoContext:
    """Adds nothing to an error: ``compiling`` asks numba for the whole message if there is one."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass


_NO_CONTEXT = _NoContext()


def _no_context(*_: Any, **__: Any) -> _NoContext:
    """Errors would be told where they happen, for each instruction."""
    return _NO_CONTEXT


def _variables_of() -> Callable[..., Any]:
    """Return a search for the variables of an instruction, which classifies each type only once.

    Numba's own asks ``isinstance`` of every part again.
    """
    from numba.core import ir

    leaf, variable, instruction, entries, values = range(5)
    known: dict[type, int] = {}

    def role_of(part: Any) -> int:
        """Return how variables are found in a part of this type."""
        if isinstance(part, ir.Var):
            return variable
        if isinstance(part, ir.Inst):
            return instruction
        if isinstance(part, list | tuple):
            return entries
        return values if isinstance(part, dict) else leaf

    def collect(part: Any, found: list[Any]) -> None:
        """Append the variables of a part to ``found``."""
        role = known.get(type(part))
        if role is None:
            role = known[type(part)] = role_of(part)
        if role == variable:
            found.append(part)
        elif role == instruction:
            found += part.list_vars()
        elif role != leaf:
            for each in part if role == entries else part.values():
                collect(each, found)

    def variables(_: Any, part: Any) -> list[Any]:
        """Return the variables of a part, as ``ir.Inst._rec_list_vars`` does."""
        found: list[Any] = []
        collect(part, found)
        return found

    return variables


def _keep_in_registers(library: Any, module: Any) -> None:
    """Take variables out of memory: all else that numba does with single functions is done again
    when they are linked.
    """
    from llvmlite.binding import create_new_function_pass_manager

    module.data_layout = library._codegen._data_layout
    builder = library._codegen._pass_builder()
    passes: Any = create_new_function_pass_manager()
    passes.add_simplify_cfg_pass()
    passes.add_sroa_pass()
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)
