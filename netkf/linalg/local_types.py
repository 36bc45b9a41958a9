"""How numba compiles :mod:`netkf.linalg.local`: an array on the stack, of a constant shape.

Typed as functions of their own, and not as overloads: the array belongs to the kernel that calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable

from netkf.linalg.lanes import ALIGNMENT
from netkf.linalg.local import (
    local_lanes_matrix,
    local_lanes_vector,
    local_matrix,
    local_vector,
)
from netkf.linalg.structs import WORD

I64 = ir.IntType(64)


def _register(function: Callable[..., Any], dimensions: int, lanes: bool) -> None:
    """Tell numba about one of them: n appears ``dimensions`` times in the shape."""

    @type_callable(function)
    def _typer(_: Any) -> Callable[..., Any]:
        def typed(size: Any, *rest: Any) -> Any:
            if isinstance(size, types.BaseTuple):
                return types.Array(types.float64, dimensions + lanes, "C")
            return rest[-1]

        def with_lanes(size: Any, lanes: Any, scratch: Any) -> Any:
            return typed(size, lanes, scratch)

        def without(size: Any, scratch: Any) -> Any:
            return typed(size, scratch)

        return with_lanes if lanes else without

    between = (types.BaseTuple,) if lanes else ()

    @lower_builtin(function, types.BaseTuple, *between, types.Array)
    def _on_stack(context: Any, builder: Any, sig: Any, _args: Any) -> Any:
        n, kind = len(sig.args[0]), sig.return_type
        shape = [n] * dimensions + [len(part) for part in sig.args[1:-1]]
        array = context.make_array(kind)(context, builder)
        items = math.prod(shape)
        data = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), items))
        # Lines of the cache, for values of several lanes.
        data.align = ALIGNMENT if lanes else WORD
        array.data = builder.bitcast(data, array.data.type)
        array.nitems, array.itemsize = ir.Constant(I64, items), ir.Constant(I64, WORD)
        strides = [WORD * math.prod(shape[k + 1 :]) for k in range(len(shape))]
        array.shape = cgutils.pack_array(builder, [ir.Constant(I64, k) for k in shape], I64)
        array.strides = cgutils.pack_array(builder, [ir.Constant(I64, k) for k in strides], I64)
        # No owner: numba counts no references.
        array.meminfo = ir.Constant(array.meminfo.type, None)
        array.parent = ir.Constant(array.parent.type, None)
        return array._getvalue()

    @lower_builtin(function, types.Array, *between, types.Array)
    def _in_memory(_context: Any, _builder: Any, _sig: Any, args: Any) -> Any:
        return args[-1]


_register(local_matrix, 2, False)
_register(local_vector, 1, False)
_register(local_lanes_matrix, 2, True)
_register(local_lanes_vector, 1, True)
