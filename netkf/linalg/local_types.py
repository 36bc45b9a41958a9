"""How numba compiles :mod:`netkf.linalg.local`: an array on the stack, of a constant shape.

Typed as functions of their own, and not as overloads: the array belongs to the kernel that calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable

from netkf.linalg.local import local_matrix, local_vector
from netkf.linalg.structs import WORD

I64 = ir.IntType(64)


def _register(function: Callable[..., Any], dimensions: int) -> None:
    @type_callable(function)
    def _typer(_: Any) -> Callable[..., Any]:
        def typed(size: Any, scratch: Any) -> Any:
            if isinstance(size, types.BaseTuple):
                return types.Array(types.float64, dimensions, "C")
            return scratch

        return typed

    @lower_builtin(function, types.BaseTuple, types.Array)
    def _on_stack(context: Any, builder: Any, sig: Any, _args: Any) -> Any:
        n, kind = len(sig.args[0]), sig.return_type
        array = context.make_array(kind)(context, builder)
        data = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), n**dimensions))
        array.data = builder.bitcast(data, array.data.type)
        array.nitems, array.itemsize = ir.Constant(I64, n**dimensions), ir.Constant(I64, WORD)
        strides = [ir.Constant(I64, WORD * n**k) for k in reversed(range(dimensions))]
        array.shape = cgutils.pack_array(builder, [ir.Constant(I64, n)] * dimensions, I64)
        array.strides = cgutils.pack_array(builder, strides, I64)
        # No owner: numba counts no references.
        array.meminfo = ir.Constant(array.meminfo.type, None)
        array.parent = ir.Constant(array.parent.type, None)
        return array._getvalue()

    @lower_builtin(function, types.Array, types.Array)
    def _in_memory(_context: Any, _builder: Any, _sig: Any, args: Any) -> Any:
        return args[1]


_register(local_matrix, 2)
_register(local_vector, 1)
