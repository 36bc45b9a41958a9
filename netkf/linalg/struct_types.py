"""The numba types of :class:`netkf.linalg.structs.Struct`: an address with loads and stores.

Imported before the first kernel is compiled. Uses public names of ``numba.extending``, and the
layout of numba's array structure (tests/linalg/test_structs.py).
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_constant
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    lower_setattr_generic,
    models,
    overload,
    register_model,
    typeof_impl,
    unbox,
)
from numba.np.numpy_support import from_dtype

from netkf.linalg.array_layout import DATA, I64, array_without_owner
from netkf.linalg.structs import WORD, NumbaType, Struct, StructClass, struct_at


class StructType(types.Type):
    """A derived class of Struct: the offset in bytes and the numba type of each field."""

    def __init__(self, name: str, fields: tuple[tuple[str, int, Any], ...]) -> None:
        self.fields = fields
        # numba hashes a type, by its name, at every call: short text hashes faster than a tree.
        layout = hashlib.sha256(str(fields).encode()).hexdigest()[:16]
        super().__init__(f"{name}.{layout}")

    def field(self, name: str) -> tuple[int, Any]:
        """Return offset in bytes and numba type of a field."""
        return next(
            (offset, field_type)
            for field_name, offset, field_type in self.fields
            if field_name == name
        )


register_model(StructType)(models.OpaqueModel)
# One numba type per class: another instance would make numba compile every kernel again.
_struct_types: dict[type[Struct], StructType] = {}
_classes: dict[str, type[Struct]] = {}


@typeof_impl.register(Struct)
def type_of(value: Struct, _: Any) -> StructType:
    """Return the numba type of a struct."""
    return struct_type(type(value))


def struct_type(cls: type[Struct]) -> StructType:
    """Return the numba type of a derived class that has instances."""
    if cls not in _struct_types:
        fields = tuple(
            (name, WORD * cls.struct_offsets[name], _field_type(cls.struct_kinds[name]))
            for name in cls.struct_fields
        )
        made = _struct_types[cls] = StructType(cls.__name__, fields)
        _classes[made.name] = cls
    return _struct_types[cls]


NumbaType.find = staticmethod(struct_type)


def class_of(kind: StructType) -> type[Struct]:
    """Return the class of a numba type of a struct."""
    return _classes[kind.name]


def _field_type(kind: Any) -> Any:
    """Return the numba type of a field from its entry in ``struct_kinds``."""
    if isinstance(kind, tuple):
        # "C": strides follow from the shape, so that only the shape is stored.
        return types.Array(from_dtype(kind[0]), kind[1], "C")
    if isinstance(kind, int):
        # A ``sized`` field: its length is part of the type, and it has no words.
        return types.UniTuple(types.int64, kind)
    if issubclass(kind, Struct):
        return struct_type(kind)
    return from_dtype(np.dtype(kind))


@unbox(StructType)
def unbox_struct(_: StructType, value: Any, c: Any) -> Any:
    """Emit the conversion of a struct of Python, ``value``, to its address for compiled code, read
    from the attribute at each call.
    """
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_voidptr(number)
    c.pyapi.decref(number)
    return NativeValue(address, is_error=c.pyapi.c_api_error())


@infer_getattr
class Fields(AttributeTemplate):
    """The template by which numba types the expression ``struct.name`` in kernels."""

    key = StructType

    def generic_resolve(self, struct: StructType, name: str) -> Any:
        """Return the numba type of field ``name`` of a struct, None if there is no such field."""
        return next((kind for key, _, kind in struct.fields if key == name), None)


def _field_pointer(builder: Any, address: Any, offset: int, llvm_type: Any) -> Any:
    """Emit the address of a field, ``offset`` bytes after ``address``."""
    pointer = builder.gep(address, [ir.Constant(I64, offset)])
    return builder.bitcast(pointer, ir.PointerType(llvm_type))


@lower_getattr_generic(StructType)
def load_field(context: Any, builder: Any, struct: StructType, address: Any, name: str) -> Any:
    """Emit LLVM IR for ``struct.name``, a struct of numba type ``struct`` at ``address``: load a
    number or an address, or build an array without an owner.
    """
    offset, kind = struct.field(name)
    # The values of a sized tuple are never read, only its length.
    if isinstance(kind, types.BaseTuple):
        return context.get_constant_null(kind)
    # Numbers are loaded; a struct inside a struct is the address that is stored.
    if not isinstance(kind, types.Array):
        return builder.load(_field_pointer(builder, address, offset, context.get_value_type(kind)))
    array = context.get_value_type(kind)
    itemsize = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    data = builder.load(_field_pointer(builder, address, offset, array.elements[DATA]))
    first = _field_pointer(builder, address, offset + WORD, I64)
    shape = [builder.load(builder.gep(first, [ir.Constant(I64, k)])) for k in range(kind.ndim)]
    # No owner, hence no reference counting: the Struct of Python keeps the array alive.
    return array_without_owner(builder, array, data, shape, itemsize)


@lower_setattr_generic(StructType)
def store_field(context: Any, builder: Any, sig: Any, args: Any, name: str) -> None:
    """Emit LLVM IR for ``struct.name = number``, with the numba types ``sig`` and LLVM values
    ``args`` of the struct and the number; arrays can be assigned in Python only.
    """
    struct, (address, value) = sig.args[0], args
    offset, kind = struct.field(name)
    # numba may have typed the value as another number: convert it to the field's type.
    number = context.cast(builder, value, sig.args[1], kind)
    builder.store(number, _field_pointer(builder, address, offset, number.type))


class ClassType(types.Type):
    """The numba type of a derived class itself, which kernels pass to ``struct_at``."""

    def __init__(self, struct: StructType) -> None:
        self.struct = struct
        super().__init__(f"class({struct.name})")


register_model(ClassType)(models.OpaqueModel)


@typeof_impl.register(StructClass)
def type_of_class(value: type[Struct], _: Any) -> ClassType:
    """Return the numba type of the class itself, if it has instances."""
    return ClassType(struct_type(value))


@lower_constant(ClassType)
def lower_class_constant(context: Any, *_: Any) -> Any:
    """Emit a dummy: a class has no value in compiled code."""
    return context.get_dummy_value()


@intrinsic
def struct_from_memory(_: Any, memory: Any, kind: Any) -> Any:
    """Type and emit the struct at ``memory`` of the class ``kind``, or of the struct ``kind``."""
    struct = kind.struct if isinstance(kind, ClassType) else kind

    def take_address(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array = context.make_array(sig.args[0])(context, builder, args[0])
        return builder.bitcast(array.data, cgutils.voidptr_t)

    return struct(memory, kind), take_address


@overload(struct_at, inline="always")
def _struct_at(memory, cls):  # noqa: ANN001, ANN202, ARG001
    """Return the implementation of ``struct_at`` that numba compiles into a kernel in its place."""
    return lambda memory, cls: struct_from_memory(memory, cls)  # noqa: PLW0108 - of the same parameter names
