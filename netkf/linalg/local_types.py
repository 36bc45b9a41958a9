"""The numba implementation of :mod:`netkf.linalg.local`: arrays of constant shape on the stack.

They are emitted inline (``lower_builtin``), not as overloads, whose stack ends on return.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable

from netkf.linalg.array_layout import DATA, I64, array_without_owner
from netkf.linalg.lanes import ALIGNMENT
from netkf.linalg.local import (
    local_lanes_matrix,
    local_lanes_pair,
    local_lanes_vector,
    local_matrix,
    local_vector,
)
from netkf.linalg.structs import WORD


def _register(function: Callable[..., Any], dimensions: int, lanes: bool, wider: int = 0) -> None:
    """Register a function of arrays with ``dimensions`` of n, and L with ``lanes``."""

    @type_callable(function)
    def _typer(_: Any) -> Callable[..., Any]:
        def typed(size: Any, *others: Any) -> Any:
            if isinstance(size, types.BaseTuple):
                return types.Array(types.float64, dimensions + lanes, "C")
            return others[-1]

        def with_lanes(size: Any, lanes: Any, scratch: Any) -> Any:
            return typed(size, lanes, scratch)

        def without(size: Any, scratch: Any) -> Any:
            return typed(size, scratch)

        return with_lanes if lanes else without

    lane_types = (types.BaseTuple,) if lanes else ()

    @lower_builtin(function, types.BaseTuple, *lane_types, types.Array)
    def _on_stack(context: Any, builder: Any, sig: Any, _args: Any) -> Any:
        """Emit an array of constant shape in the stack frame of the calling function."""
        n, array_type = len(sig.args[0]), sig.return_type
        shape = [n] * (dimensions - 1) + [n + wider]
        shape += [len(lane_tuple) for lane_tuple in sig.args[1:-1]]
        array = context.get_value_type(array_type)
        memory = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), math.prod(shape)))
        # Lines of the cache, for values of several lanes.
        memory.align = ALIGNMENT if lanes else WORD
        data = builder.bitcast(memory, array.elements[DATA])
        lengths = [ir.Constant(I64, length) for length in shape]
        return array_without_owner(builder, array, data, lengths, WORD)

    @lower_builtin(function, types.Array, *lane_types, types.Array)
    def _in_memory(_context: Any, _builder: Any, _sig: Any, args: Any) -> Any:
        return args[-1]


_register(local_matrix, 2, False)
_register(local_vector, 1, False)
_register(local_lanes_matrix, 2, True)
_register(local_lanes_pair, 2, True, wider=1)
_register(local_lanes_vector, 1, True)
