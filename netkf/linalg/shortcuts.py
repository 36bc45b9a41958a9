"""Replacements of parts of numba that take compile time and that kernels do not need.

numba is written in Python, and most of its compile time is spent before LLVM. Saved here are
garbage collections, repeated look-ups of the types of a call, timers and events, most of the first
optimisation by LLVM, and the passes for closures, array expressions and annotations. The pipeline
of passes is a public extension point of numba; the rest replaces private methods, see ``linking``.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from typing import Any

Patch = tuple[Any, str, Callable[..., Any]]
"""A replacement in numba: (class or module, name of its function, new function)."""

NOT_NEEDED = (
    *("WithLifting", "InlineClosureLikes", "RewriteDynamicRaises", "MakeFunctionToJitFunction"),
    *("InlineInlinables", "FindLiterallyCalls", "LiteralUnroll", "NopythonRewrites"),
    *("LiteralPropagationSubPipelinePass", "AnnotateTypes", "DumpParforDiagnostics"),
)
"""Passes of numba for language features that kernels do not use."""
MIN_FROZEN = 10_000
"""Number of new objects above which without_collection() makes all objects old ones."""


@contextmanager
def without_collection() -> Iterator[None]:
    """Disable the garbage collector within this context.

    The compiler allocates many objects that live long, and each collection would visit all of them.
    It costs some 100 MB of memory meanwhile.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            # freeze() and unfreeze() move all objects to the oldest generation without visiting
            # them, so that the next collection of young objects does not either. A mere load from
            # disk makes too few; and unfreeze() must not undo a freeze of the program.
            if gc.get_count()[0] > MIN_FROZEN and not gc.get_freeze_count():
                gc.freeze()
                gc.unfreeze()
            gc.enable()


@cache
def kernel_compiler(lean: bool, compact: bool = False) -> Any:
    """Return numba's compiler class without the passes NOT_NEEDED, and with ValueLowering.

    ``lean``: with KernelLowering, which emits less IR for entries of arrays. ``compact``: with
    CompactLowering, for which LLVM does not unroll loops either.
    """
    from numba.core import config
    from numba.core.compiler import CompilerBase, DefaultPassBuilder

    from netkf.linalg.lean_lowering import CompactLowering, KernelLegalization, KernelLowering
    from netkf.linalg.value_lowering import ValueLowering

    builder: Any = DefaultPassBuilder
    lowering: Any = ValueLowering
    # With NUMBA_BOUNDSCHECK numba's own code for entries is needed, which checks indices.
    if lean and not getattr(config, "BOUNDSCHECK", None):
        lowering = CompactLowering if compact else KernelLowering
    replacements: dict[str, Any] = {
        "IRLegalization": KernelLegalization,
        "NativeLowering": lowering,
    }

    class KernelCompiler(CompilerBase):
        """numba's compiler with another pipeline."""

        def define_pipelines(self) -> list[Any]:
            """Return numba's pipeline with passes removed and replaced."""
            pipeline = builder.define_nopython_pipeline(self.state)
            steps = [step for step in pipeline.passes if step[0].__name__ not in NOT_NEEDED]
            pipeline.passes = [
                (replacements.get(step.__name__, step), description) for step, description in steps
            ]
            pipeline.finalize()
            return [pipeline]

    return KernelCompiler


def shortcuts() -> list[Patch]:
    """Return the replacements of numba's methods: (class or module, name, new function)."""
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
        (BaseContext, "refresh", _refresh_if_changed(BaseContext.refresh)),
        (base, "_has_loc", cache(base._has_loc)),
        (base, "user_function", call_without_errors(imputils.user_function)),
        (BaseContext, "get_abi_sizeof", _cache_sizes(BaseContext.get_abi_sizeof)),
        (BaseFunction, "get_call_type", _cache_call_types(BaseFunction.get_call_type)),
        (event, "install_timer", _no_timer),
        (event, "start_event", _only_with_listeners(event.start_event)),
        (event, "end_event", _only_with_listeners(event.end_event)),
        (ir.Inst, "_rec_list_vars", _variable_collector()),
        (lowering, "new_error_context", _no_context),
        (typeinfer, "new_error_context", _no_context),
        (arrayobj, "fix_integer_index", _skip_sign_test(arrayobj.fix_integer_index)),
        (CPUCodeLibrary, "_optimize_functions", _promote_variables),
    ]


def _cache_call_types(find: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``find``, which finds the signature of a call, with a cache by function and argument
    types.

    numba resolves it anew for each call, by trying all definitions of the function (dozens for an
    operator).
    """
    signatures: dict[Any, Any] = {}

    def cached_signature(function: Any, context: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call; calls with keyword arguments are not cached."""
        if kws:
            return find(function, context, args, kws)
        # Definitions are only ever added: their number is part of the key.
        call = function, context, tuple(args), len(function.templates)
        if call not in signatures:
            signatures[call] = find(function, context, args, kws)
        return signatures[call]

    return cached_signature


def _run_pass(manager: Any, _: int, step: Any, state: Any) -> None:
    """Run the compiler pass ``step`` on the ``state`` of one function, without numba's event
    notifications and measurements of time.
    """
    step.analysis = manager._analysis
    for part in (step.run_initialization, step.run_pass, step.run_finalizer):
        part(state)


def _refresh_if_changed(refresh: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of ``refresh`` that refreshes numba's tables of definitions only if some
    were added: each refresh imports thirty modules.
    """
    known_sizes: dict[int, int] = {}

    def size_of(context: Any) -> int:
        """Return the number of definitions in the registries that a context reads."""
        registries = [*context._registries, *context.typing_context._registries]
        lists = ("functions", "getattrs", "setattrs", "casts", "constants", "attributes", "globals")
        return sum(len(getattr(registry, name, ())) for registry in registries for name in lists)

    def refresh_if_new(context: Any) -> None:
        """Refresh a context if its registries have grown since the last refresh."""
        # numba makes a context for each function, and they share these registries.
        key = id(context._registries)
        if known_sizes.get(key) != size_of(context):
            refresh(context)
            known_sizes[key] = size_of(context)

    return refresh_if_new


def _without_liveness(run: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of ``PostProcessor.run`` that skips the analysis of live variables at
    the start of blocks, which numba repeats after each of six passes; only generators and object
    mode need it.
    """
    from numba.core import postproc, transforms

    VariableLifetime: Any = postproc.VariableLifetime
    canonicalize: Any = transforms.canonicalize_cfg

    def run_without_liveness(self: Any, emit_dels: bool = False, **options: Any) -> None:
        """Post-process the IR of one function, ``self.func_ir``, without the analysis of its live
        variables; a generator as numba does. ``emit_dels``: insert ``del`` statements, as numba
        asks for.
        """
        function = self.func_ir
        if function.is_generator:
            run(self, emit_dels, **options)
            return
        function.blocks = canonicalize(function.blocks)
        function.variable_lifetime = VariableLifetime(function.blocks)
        function.generator_info = None
        if emit_dels:
            self._insert_var_dels(**options)

    return run_without_liveness


def _cache_sizes(size_of: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``size_of`` with a cache by type: numba lets LLVM parse a module for each call."""
    sizes: dict[tuple[Any, str], int] = {}

    def size(context: Any, llvm_type: Any) -> int:
        """Return the size of an LLVM type in bytes."""
        key = context, str(llvm_type)
        if key not in sizes:
            sizes[key] = size_of(context, llvm_type)
        return sizes[key]

    return size


def _skip_sign_test(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of ``fix_integer_index`` without the test for a negative index where
    none is needed, see ``lean_lowering.is_nonnegative``.
    """
    from numba import types

    from netkf.linalg.lean_lowering import is_nonnegative

    def fix_index(context: Any, builder: Any, index_type: Any, index: Any, size: Any) -> Any:
        """Emit the index as an integer of the machine's word, from the start of the axis."""
        if is_nonnegative(index):
            return context.cast(builder, index, index_type, types.intp)
        return original(context, builder, index_type, index, size)

    return fix_index


def _no_timer(*_: Any) -> AbstractContextManager[None]:
    """Return a context that does nothing instead of numba's timer of each call of LLVM."""
    return nullcontext()


def _only_with_listeners(notify: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of ``notify`` that does nothing if there is no listener: numba notifies
    twice for each call of LLVM.
    """
    from numba.core import event

    listeners: Any = event._registered

    def notify_listeners(*args: Any, **kwargs: Any) -> None:
        """Notify as numba does if any kind of event has a listener."""
        if any(listeners.values()):
            notify(*args, **kwargs)

    return notify_listeners


class _NoContext:
    """A context that adds nothing to an error.

    After an error ``compiling`` compiles once more without these replacements, for numba's message.
    """

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass


_NO_CONTEXT = _NoContext()


def _no_context(*_: Any, **__: Any) -> _NoContext:
    """Return a context that does nothing instead of numba's, which adds the position in the source
    to errors and is entered for each instruction.
    """
    return _NO_CONTEXT


def _variable_collector() -> Callable[..., Any]:
    """Return a replacement of ``ir.Inst._rec_list_vars``, which lists the variables of a statement.

    It classifies each type once, where numba repeats ``isinstance`` for every part.
    """
    from numba.core import ir

    # A leaf holds no variables; ``entries`` and ``values`` are those of a sequence and of a dict.
    leaf, variable, instruction, entries, values = range(5)
    roles: dict[type, int] = {}

    def role_of(part: Any) -> int:
        """Return the role of a part of a statement: how variables are listed in it."""
        if isinstance(part, ir.Var):
            return variable
        if isinstance(part, ir.Inst):
            return instruction
        if isinstance(part, list | tuple):
            return entries
        return values if isinstance(part, dict) else leaf

    def collect(part: Any, collected: list[Any]) -> None:
        """Append the variables of a part to ``collected``."""
        role = roles.get(type(part))
        if role is None:
            role = roles[type(part)] = role_of(part)
        if role == variable:
            collected.append(part)
        elif role == instruction:
            collected += part.list_vars()
        elif role != leaf:
            for member in part if role == entries else part.values():
                collect(member, collected)

    def variables(_: Any, part: Any) -> list[Any]:
        """Return the variables of a part, as ``ir.Inst._rec_list_vars`` does."""
        collected: list[Any] = []
        collect(part, collected)
        return collected

    return variables


def _promote_variables(library: Any, module: Any) -> None:
    """Promote stack variables of each function to registers (simplify-cfg and SROA only).

    It replaces numba's optimisation of single functions, which is repeated after linking anyway.
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
