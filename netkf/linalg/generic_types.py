"""The numba type of :class:`netkf.linalg.generic.Generic`: a call of the chosen kernel; and the
implementations of ``drop_lane`` and ``struct_like``.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model
from numba.np.arrayobj import populate_array

from netkf.linalg.generic import drop_lane, struct_like
from netkf.linalg.struct_types import StructType, class_of


class GenericType(types.Callable, types.Opaque):  # type: ignore[misc]
    """A function whose kernel is chosen by the type of the first argument of a call."""

    def __init__(self, function: Any) -> None:
        self._function = function
        super().__init__(f"generic({function.__module__}.{function.__qualname__})")

    def _kernel(self, args: Any) -> Any:
        """Return the numba type of the chosen kernel."""
        return self._function.kernel_of(class_of(args[0]))._numba_type_

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call, as numba asks."""
        return self._kernel(args).get_call_type(context, args, kws)

    def get_call_signatures(self) -> Any:
        """Return no signatures for error messages: they depend on the kernel."""
        return (), True

    def get_impl_key(self, sig: Any) -> Any:
        """Return the key by which numba finds the compiled kernel."""
        return self._kernel(sig.args).get_impl_key(sig)


register_model(GenericType)(models.OpaqueModel)


@intrinsic
def _drop_lane(_: Any, array: Any) -> Any:
    """Type and emit an array without its last axis, which has one entry."""
    fewer = types.Array(array.dtype, array.ndim - 1, "C")

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        given = context.make_array(sig.args[0])(context, builder, args[0])
        made = context.make_array(fewer)(context, builder)
        shape = cgutils.unpack_tuple(builder, given.shape)[:-1]
        strides = cgutils.unpack_tuple(builder, given.strides)[:-1]
        populate_array(made, given.data, shape, strides, given.itemsize, None)
        return made._getvalue()

    return fewer(array), emit


@overload(drop_lane, inline="always")
def _overload_drop_lane(array):  # noqa: ANN001, ANN202, ARG001
    return lambda array: _drop_lane(array)  # noqa: PLW0108 - of the same parameter names


@intrinsic
def _struct_like(_: Any, struct: StructType, memory: Any) -> Any:
    """Type and emit the struct, of the type of ``struct``, at the first word of ``memory``."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array = context.make_array(sig.args[1])(context, builder, args[1])
        return builder.bitcast(array.data, cgutils.voidptr_t)

    return struct(struct, memory), emit


@overload(struct_like, inline="always")
def _overload_struct_like(struct, memory):  # noqa: ANN001, ANN202, ARG001
    return lambda struct, memory: _struct_like(struct, memory)  # noqa: PLW0108
