"""The numba type of :class:`netkf.linalg.generic.Generic`: a call of the chosen kernel; and the
implementations of ``drop_lane`` and ``struct_like``.
"""

from __future__ import annotations

from typing import Any

from numba import typeof, types
from numba.core import cgutils
from numba.extending import (
    intrinsic,
    lower_builtin,
    models,
    overload,
    register_model,
    type_callable,
    typeof_impl,
)
from numba.np.arrayobj import populate_array

from netkf.linalg.generic import Generic, copy_arrays, copy_part, copy_row, drop_lane, struct_like
from netkf.linalg.struct_types import StructType, class_of, load_field, struct_from_memory


class GenericType(types.Callable, types.Opaque):
    """A function whose kernel is chosen by the type of the first argument of a call."""

    def __init__(self, function: Any) -> None:
        self._function = function
        super().__init__(f"generic({function.__module__}.{function.__qualname__})")

    def _kernel(self, args: Any) -> Any:
        """Return the numba type of the chosen kernel."""
        return typeof(self._function.kernel_of(class_of(args[0])))

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


@typeof_impl.register(Generic)
def function_type(value: Generic, _: Any) -> GenericType:
    """Return the numba type of a function whose name is in a kernel."""
    return GenericType(value)


@type_callable(drop_lane)
def _type_drop_lane(_: Any) -> Any:
    """Return the function that types a call: the array has one dimension less."""

    def typed(array: Any) -> Any:
        return types.Array(array.dtype, array.ndim - 1, "C")

    return typed


@lower_builtin(drop_lane, types.Array)
def _lower_drop_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the same array without its last axis, which has one entry."""
    given = context.make_array(sig.args[0])(context, builder, args[0])
    made = context.make_array(sig.return_type)(context, builder)
    shape = cgutils.unpack_tuple(builder, given.shape)[:-1]
    strides = cgutils.unpack_tuple(builder, given.strides)[:-1]
    populate_array(made, given.data, shape, strides, given.itemsize, None)
    return made._getvalue()


@overload(struct_like, inline="always")
def _overload_struct_like(struct, memory):  # noqa: ANN001, ANN202, ARG001
    return lambda struct, memory: struct_from_memory(memory, struct)


def _arrays_of(context: Any, builder: Any, struct: StructType, address: Any) -> Any:
    """Yield each array of a struct: its address, its length, and the bytes of an entry."""
    for name, _, kind in struct.fields:
        if isinstance(kind, types.Array):
            value = load_field(context, builder, struct, address, name)
            array = context.make_array(kind)(context, builder, value)
            first_stride = cgutils.unpack_tuple(builder, array.strides)[0]
            length = cgutils.unpack_tuple(builder, array.shape)[0]
            yield builder.bitcast(array.data, cgutils.voidptr_t), length, first_stride


@intrinsic
def _copy_part(_: Any, struct: StructType, k: Any, m: Any, place: Any, origin: Any, w: Any) -> Any:
    """Type and emit the copy of a component of entry m to one of entry k of all arrays."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        to, source, first, second, width = (
            context.cast(builder, arg, kind, types.intp)
            for arg, kind in zip(args[1:], sig.args[1:], strict=True)
        )
        for data, _, stride in _arrays_of(context, builder, sig.args[0], args[0]):
            size = builder.sdiv(stride, width)
            places = (
                builder.add(builder.mul(row, stride), builder.mul(part, size))
                for row, part in ((to, first), (source, second))
            )
            target, start = (builder.gep(data, [one]) for one in places)
            cgutils.raw_memcpy(builder, target, start, size, 1)
        return context.get_dummy_value()

    return types.none(struct, k, m, place, origin, w), emit


@overload(copy_row, inline="always")
def _overload_copy_row(struct, k, m):  # noqa: ANN001, ANN202, ARG001
    return lambda struct, k, m: _copy_part(struct, k, m, 0, 0, 1)


@overload(copy_part, inline="always")
def _overload_copy_part(struct, k, m, place, origin, width):  # noqa: ANN001, ANN202, ARG001
    return lambda struct, k, m, place, origin, width: _copy_part(  # noqa: PLW0108
        struct, k, m, place, origin, width
    )


@intrinsic
def _copy_arrays(_: Any, target: StructType, source: StructType) -> Any:
    """Type and emit the copy of all arrays."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        targets = _arrays_of(context, builder, sig.args[0], args[0])
        sources = _arrays_of(context, builder, sig.args[1], args[1])
        for (data, length, stride), (origin, _, _) in zip(targets, sources, strict=True):
            cgutils.raw_memcpy(builder, data, origin, builder.mul(length, stride), 1)
        return context.get_dummy_value()

    return types.none(target, source), emit


@overload(copy_arrays, inline="always")
def _overload_copy_arrays(target, source):  # noqa: ANN001, ANN202, ARG001
    return lambda target, source: _copy_arrays(target, source)  # noqa: PLW0108
