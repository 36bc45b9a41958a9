"""The layout of arrays in compiled code, and the few instructions that netkf emits for them.

Fields of numba's array structure are numbered as tests/linalg/test_structs.py finds them.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir

I64 = ir.IntType(64)
MEMINFO, PARENT, ITEMS, ITEMSIZE, DATA, SHAPE, STRIDES = range(7)


def entry_pointer(builder: Any, kind: Any, array: Any, indices: Any) -> Any:
    """Emit the address of a C-contiguous array's entry at ``indices``, one for each axis."""
    assert kind.layout == "C", f"{kind} is not contiguous"
    # A sum of products (and not Horner's scheme): LLVM hoists the terms of outer loops.
    offset, step = indices[-1], ir.Constant(I64, 1)
    for axis in range(kind.ndim - 1, 0, -1):
        step = builder.mul(step, builder.extract_value(array, [SHAPE, axis]))
        offset = builder.add(builder.mul(indices[axis - 1], step), offset)
    return builder.gep(builder.extract_value(array, DATA), [offset], inbounds=True)


def array_without_owner(builder: Any, kind: Any, data: Any, shape: Any, itemsize: int) -> Any:
    """Emit a C-contiguous array structure of LLVM type ``kind`` without owner, and hence without
    reference counting: of address ``data``, lengths ``shape`` and ``itemsize`` bytes per entry.
    """
    strides = [ir.Constant(I64, itemsize)]
    # Row-major strides, from the last axis to the first.
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    items = shape[0]
    for length in shape[1:]:
        items = builder.mul(items, length)
    fields: list[tuple[Any, Any]] = [
        (ITEMS, items),
        (ITEMSIZE, ir.Constant(I64, itemsize)),
        (DATA, data),
    ]
    fields += [(field, ir.Constant(kind.elements[field], None)) for field in (MEMINFO, PARENT)]
    fields += [((SHAPE, axis), length) for axis, length in enumerate(shape)]
    fields += [((STRIDES, axis), stride) for axis, stride in enumerate(strides)]
    array = ir.Constant(kind, ir.Undefined)
    for field, value in fields:
        array = builder.insert_value(array, value, field)
    return array
