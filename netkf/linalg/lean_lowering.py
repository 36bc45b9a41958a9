"""Short code for what kernels do most: reading and writing entries of C-contiguous arrays.

numba writes 40 lines of LLVM's language for ``a[i, j]``, most of which LLVM removes again. The
lines that are written here compute the same. Whatever is not met here goes to ``value_lowering``.
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
NUMBERS = (types.Float, types.Integer)


def entry_pointer(builder: Any, kind: Any, array: Any, places: Any) -> Any:
    """Return the address of an entry of a C-contiguous array, from as many ``places`` as it has
    axes, which are not negative.
    """
    assert kind.layout == "C", f"{kind} is not contiguous"
    # A sum of products, of which LLVM takes those of outer loops out of inner ones.
    at, step = places[-1], ONE
    for axis in range(kind.ndim - 1, 0, -1):
        length = builder.extract_value(array, [SHAPE, axis])
        step = length if step is ONE else builder.mul(step, length)
        at = builder.add(builder.mul(places[axis - 1], step), at)
    return builder.gep(builder.extract_value(array, DATA), [at], inbounds=True)


def array_without_owner(builder: Any, kind: Any, data: Any, shape: Any, itemsize: int) -> Any:
    """Return a C-contiguous array, whose references nobody counts, of LLVM's type ``kind``."""
    strides = [ir.Constant(I64, itemsize)]
    # Row-major strides, from the last axis to the first.
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    items = shape[0]
    for length in shape[1:]:
        items = builder.mul(items, length)
    parts: list[tuple[Any, Any]] = [
        (ITEMS, items),
        (ITEMSIZE, ir.Constant(I64, itemsize)),
        (DATA, data),
    ]
    parts += [(field, ir.Constant(kind.elements[field], None)) for field in (MEMINFO, PARENT)]
    parts += [((SHAPE, axis), length) for axis, length in enumerate(shape)]
    parts += [((STRIDES, axis), stride) for axis, stride in enumerate(strides)]
    made = ir.Constant(kind, ir.Undefined)
    for field, value in parts:
        made = builder.insert_value(made, value, field)
    return made


def is_in_order(place: Any) -> bool:
    """Return True if a place counts from the start of an axis: places that are computed always do.

    To ask each of them takes a tenth of the time of the event loop. With NUMBA_BOUNDSCHECK=1, and a
    NUMBA_CACHE_DIR of its own, kernels ask, and raise IndexError.
    """
    return not isinstance(place, ir.Constant) or place.constant >= 0


class KernelLower(ValueLower):
    """Writes the code of kernels."""

    def _store_count(self, count: Any, difference: Any, step: Any) -> None:
        """Store the number of steps, or something negative if there is none."""
        if step.constant == 1:
            self.builder.store(difference, count)
        else:
            super()._store_count(count, difference, step)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Return ``value[index]``."""
        kind, places = self.typeof(value.name), self._indices(value, index)
        if places is None or not isinstance(kind.dtype, ENTRIES):
            return super().lower_getitem(resty, expr, value, index, signature)
        array = self.loadvar(value.name)
        if len(places) < kind.ndim:
            return self._row(resty, kind, array, places[0])
        pointer = entry_pointer(self.builder, kind, array, places)
        found = load_item(self.context, self.builder, kind, pointer)
        return self.context.cast(self.builder, found, kind.dtype, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        """Write ``target[index] = value``."""
        kind, given = self.typeof(target_var.name), self.typeof(value_var.name)
        places = self._indices(target_var, index_var)
        known = places is not None and isinstance(kind.dtype, NUMBERS)
        if not (known and len(places) == kind.ndim and isinstance(given, NUMBERS)):
            return super().lower_setitem(target_var, index_var, value_var, signature)
        array, value = self.loadvar(target_var.name), self.loadvar(value_var.name)
        number = self.context.cast(self.builder, value, given, kind.dtype)
        pointer = entry_pointer(self.builder, kind, array, places)
        return store_item(self.context, self.builder, kind, number, pointer)

    def _indices(self, array: Any, index: Any) -> Any:
        """Indices as integers that are not negative: one for each axis, or the first one alone.
        None where they are something else.
        """
        kind: Any = self.typeof(array.name)
        given: Any = self.typeof(index.name)
        if not isinstance(kind, types.Array) or kind.layout != "C":
            return None
        kinds: Any = given if isinstance(given, types.BaseTuple) else (given,)
        if not all(isinstance(each, types.Integer) for each in kinds):
            return None
        # A row of an array that somebody owns would have to be counted.
        if len(kinds) != kind.ndim and (len(kinds) > 1 or self.context.enable_nrt):
            return None
        value, owner, places = self.loadvar(index.name), self.loadvar(array.name), []
        for axis, each in enumerate(kinds):
            part = self.builder.extract_value(value, axis) if kinds is given else value
            place = self.context.cast(self.builder, part, each, types.intp)
            places.append(self._wrapped(place, owner, axis) if each.signed else place)
        return places

    def _wrapped(self, place: Any, array: Any, axis: int) -> Any:
        """Return a place; written as negative numbers, as in Python, they count from the end."""
        builder = self.builder
        if is_in_order(place):
            return place
        length = builder.extract_value(array, [SHAPE, axis])
        below = builder.icmp_signed("<", place, ZERO)
        return builder.select(below, builder.add(place, length), place)

    def _row(self, resty: Any, kind: Any, array: Any, place: Any) -> Any:
        """Return ``array[place]`` of an array that has more axes, and no owner."""
        builder, axes = self.builder, range(1, kind.ndim)
        shape = [builder.extract_value(array, [SHAPE, axis]) for axis in axes]
        items = shape[0]
        for length in shape[1:]:
            items = builder.mul(items, length)
        data = builder.gep(builder.extract_value(array, DATA), [builder.mul(place, items)])
        itemsize = self.context.get_abi_sizeof(self.context.get_data_type(kind.dtype))
        layout = self.context.get_value_type(resty)
        return array_without_owner(builder, layout, data, shape, itemsize)


@register_pass(mutates_CFG=True, analysis_only=False)
class KernelLowering(ValueLowering):
    """The last step of numba's pipeline, with KernelLower."""

    _name = "kernel_lowering"
    lowering_class: Any = KernelLower


class CompactLower(KernelLower):
    """Writes the code of kernels that are called seldom: LLVM neither unrolls their loops nor turns
    them into loops over vectors, which takes longer than all calls of such a kernel.
    """

    def pre_lower(self) -> None:
        """Mark the function."""
        super().pre_lower()
        self.function.attributes.add("optsize")


@register_pass(mutates_CFG=True, analysis_only=False)
class CompactLowering(KernelLowering):
    """The same with CompactLower."""

    _name = "compact_lowering"
    lowering_class = CompactLower


@register_pass(mutates_CFG=False, analysis_only=True)
class KernelLegalization(IRLegalization):
    """Says after which instruction a variable is no longer used only where references are counted:
    elsewhere nothing would happen there, and LLVM would have to find that out.
    """

    _name = "kernel_legalization"

    def run_pass(self, state: Any) -> bool:
        """Add what is missing to numba's language."""
        return bool(state.flags.nrt and super().run_pass(state))
