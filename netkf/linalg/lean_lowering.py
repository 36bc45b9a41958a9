"""Lowering of reads and writes of entries of C-contiguous arrays to little LLVM IR.

numba emits 40 lines of IR for ``a[i, j]``, most of which LLVM removes again. The few emitted here
compute the same address. All other operations are left to ``value_lowering``.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import IRLegalization
from numba.np.arrayobj import load_item, store_item

from netkf.linalg.value_lowering import (
    DATA,
    I64,
    ITEMS,
    ITEMSIZE,
    MEMINFO,
    ONE,
    PARENT,
    SHAPE,
    STRIDES,
    ZERO,
    ValueLower,
    ValueLowering,
)

ENTRIES = (types.Float, types.Integer, types.Boolean, types.Record)
"""Types of entries that are read here."""
NUMBERS = (types.Float, types.Integer)
"""Types of entries that are written here."""


def entry_pointer(builder: Any, kind: Any, array: Any, indices: Any) -> Any:
    """Emit the address of an entry of a C-contiguous array of numba type ``kind``; ``indices`` are
    one nonnegative integer for each axis.
    """
    assert kind.layout == "C", f"{kind} is not contiguous"
    # A sum of products (and not Horner's scheme): LLVM hoists the terms of outer loops.
    offset, step = indices[-1], ONE
    for axis in range(kind.ndim - 1, 0, -1):
        length = builder.extract_value(array, [SHAPE, axis])
        step = length if step is ONE else builder.mul(step, length)
        offset = builder.add(builder.mul(indices[axis - 1], step), offset)
    return builder.gep(builder.extract_value(array, DATA), [offset], inbounds=True)


def array_without_owner(builder: Any, kind: Any, data: Any, shape: Any, itemsize: int) -> Any:
    """Emit a C-contiguous array structure of LLVM type ``kind`` without owner, and hence without
    reference counting: from the address ``data``, the lengths ``shape`` and ``itemsize`` bytes per
    entry.
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


def is_nonnegative(index: Any) -> bool:
    """Return True unless an index is a negative constant, which counts from the end of its axis.

    Computed indices must not be negative in kernels: testing each takes a tenth of the time of the
    event loop. With NUMBA_BOUNDSCHECK=1, and a NUMBA_CACHE_DIR of its own, kernels test them and
    raise IndexError.
    """
    return not isinstance(index, ir.Constant) or index.constant >= 0


class KernelLower(ValueLower):
    """ValueLower with short code for entries and rows of C-contiguous arrays."""

    def _store_count(self, count: Any, difference: Any, step: Any) -> None:
        """Store the number of steps of a range at the address ``count``, from ``difference`` = stop
        - start and a constant ``step``, LLVM values; it may be negative, which means none.
        """
        if step.constant == 1:
            self.builder.store(difference, count)
        else:
            super()._store_count(count, difference, step)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Return the LLVM value of ``value[index]``, of numba type ``resty``: an entry, or a row
        (the first index only) as a view.
        """
        kind, indices = self.typeof(value.name), self._indices(value, index)
        if indices is None or not isinstance(kind.dtype, ENTRIES):
            return super().lower_getitem(resty, expr, value, index, signature)
        array = self.loadvar(value.name)
        if len(indices) < kind.ndim:
            return self._row(resty, kind, array, indices[0])
        pointer = entry_pointer(self.builder, kind, array, indices)
        entry = load_item(self.context, self.builder, kind, pointer)
        return self.context.cast(self.builder, entry, kind.dtype, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        """Emit LLVM IR for ``target[index] = value``: a short form for a number, numba's own for
        all else. The arguments are variables of numba's IR.
        """
        kind, value_type = self.typeof(target_var.name), self.typeof(value_var.name)
        indices = self._indices(target_var, index_var)
        has_indices = indices is not None and isinstance(kind.dtype, NUMBERS)
        if not (has_indices and len(indices) == kind.ndim and isinstance(value_type, NUMBERS)):
            return super().lower_setitem(target_var, index_var, value_var, signature)
        array, value = self.loadvar(target_var.name), self.loadvar(value_var.name)
        number = self.context.cast(self.builder, value, value_type, kind.dtype)
        pointer = entry_pointer(self.builder, kind, array, indices)
        return store_item(self.context, self.builder, kind, number, pointer)

    def _indices(self, array: Any, index: Any) -> Any:
        """Return the nonnegative integer indices, LLVM values, of an entry (one for each axis) or
        of a row (one); None for slices, other layouts and all else that numba's own code handles.
        """
        kind: Any = self.typeof(array.name)
        index_type: Any = self.typeof(index.name)
        if not isinstance(kind, types.Array) or kind.layout != "C":
            return None
        kinds: Any = index_type if isinstance(index_type, types.BaseTuple) else (index_type,)
        if not all(isinstance(integer_type, types.Integer) for integer_type in kinds):
            return None
        # With reference counting the view of a row would need an owner.
        if len(kinds) != kind.ndim and (len(kinds) > 1 or self.context.enable_nrt):
            return None
        value, owner, indices = self.loadvar(index.name), self.loadvar(array.name), []
        for axis, integer_type in enumerate(kinds):
            part = self.builder.extract_value(value, axis) if kinds is index_type else value
            position = self.context.cast(self.builder, part, integer_type, types.intp)
            indices.append(
                self._wrapped(position, owner, axis) if integer_type.signed else position
            )
        return indices

    def _wrapped(self, index: Any, array: Any, axis: int) -> Any:
        """Return ``index`` (an LLVM integer), plus the length of its ``axis`` of ``array`` if it is
        negative, as Python does.

        An index that is known to be nonnegative is returned without the test that numba emits.
        """
        builder = self.builder
        if is_nonnegative(index):
            return index
        length = builder.extract_value(array, [SHAPE, axis])
        is_negative = builder.icmp_signed("<", index, ZERO)
        return builder.select(is_negative, builder.add(index, length), index)

    def _row(self, resty: Any, kind: Any, array: Any, index: Any) -> Any:
        """Return the view ``array[index]``, of numba type ``resty``, of an array of numba type
        ``kind`` with more axes, without an owner: only its address and shape are computed.
        """
        builder, axes = self.builder, range(1, kind.ndim)
        shape = [builder.extract_value(array, [SHAPE, axis]) for axis in axes]
        items = shape[0]
        for length in shape[1:]:
            items = builder.mul(items, length)
        data = builder.gep(builder.extract_value(array, DATA), [builder.mul(index, items)])
        itemsize = self.context.get_abi_sizeof(self.context.get_data_type(kind.dtype))
        layout = self.context.get_value_type(resty)
        return array_without_owner(builder, layout, data, shape, itemsize)


@register_pass(mutates_CFG=True, analysis_only=False)
class KernelLowering(ValueLowering):
    """numba's lowering pass with KernelLower."""

    _name = "kernel_lowering"
    lowering_class: Any = KernelLower


class CompactLower(KernelLower):
    """KernelLower for kernels that are called seldom: LLVM optimises them for size, that is without
    unrolling or vectorising loops, which would take longer than all calls of such a kernel.
    """

    def pre_lower(self) -> None:
        """Mark the function with LLVM's attribute optsize."""
        super().pre_lower()
        self.function.attributes.add("optsize")


@register_pass(mutates_CFG=True, analysis_only=False)
class CompactLowering(KernelLowering):
    """numba's lowering pass with CompactLower."""

    _name = "compact_lowering"
    lowering_class = CompactLower


@register_pass(mutates_CFG=False, analysis_only=True)
class KernelLegalization(IRLegalization):
    """numba's pass that inserts ``del`` statements after the last use of each variable, skipped for
    kernels without reference counting, where they have no effect but take time.
    """

    _name = "kernel_legalization"

    def run_pass(self, state: Any) -> bool:
        """Run numba's pass if references are counted; return True if it changed anything."""
        return bool(state.flags.nrt and super().run_pass(state))
