"""The numba types of the SIMD values of :mod:`netkf.linalg.lanes`: vectors of LLVM.

Imported before the first kernel is compiled. A value of one lane is a float, and its flags a bool.
Each function of ``lanes`` has a typing (:func:`_register_type`), which returns the type of its
result, and a lowering ``lower_...``, which emits its LLVM instructions.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import models, register_model

from netkf.linalg import lanes as names
from netkf.linalg.array_layout import DATA, I64, SHAPE, STRIDES, entry_pointer

DOUBLE, BYTE, BIT, I32 = ir.DoubleType(), ir.IntType(8), ir.IntType(1), ir.IntType(32)


class LaneValue(types.Type):
    """The numba type of a vector of ``count`` float64."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"LaneValue({count})")


class LaneFlags(types.Type):
    """The numba type of a vector of ``count`` truth values."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"LaneFlags({count})")


@register_model(LaneValue)
class ValueModel(models.PrimitiveModel):
    """A vector of doubles."""

    def __init__(self, manager: Any, kind: LaneValue) -> None:
        """Make an LLVM vector the representation of the numba type ``kind``. numba calls it with
        its ``manager`` of all such data models.
        """
        super().__init__(manager, kind, ir.VectorType(DOUBLE, kind.count))


@register_model(LaneFlags)
class FlagsModel(models.PrimitiveModel):
    """A vector of bits."""

    def __init__(self, manager: Any, kind: LaneFlags) -> None:
        """Make an LLVM vector the representation of the numba type ``kind``. numba calls it with
        its ``manager`` of all such data models.
        """
        super().__init__(manager, kind, ir.VectorType(BIT, kind.count))


def value_type(count: int) -> Any:
    """Return the numba type of a value of ``count`` lanes."""
    return types.float64 if count == 1 else LaneValue(count)


def flags_type(count: int) -> Any:
    """Return the numba type of the flags of ``count`` lanes."""
    return types.boolean if count == 1 else LaneFlags(count)


def _count(kind: Any) -> int:
    """Return the number of lanes of a type of values or flags; 1 for plain numbers."""
    return kind.count if isinstance(kind, LaneValue | LaneFlags) else 1


def _is_number(kind: Any) -> bool:
    """Return True for plain numbers, which count as one lane."""
    return isinstance(kind, types.Float | types.Integer | types.Boolean)


def _broadcast(context: Any, builder: Any, value: Any, kind: Any, count: int) -> Any:
    """Emit LLVM instructions for a value of ``count`` lanes from ``value``, of numba type ``kind``:
    it may have these lanes already, or be a plain number.
    """
    if isinstance(kind, LaneValue):
        return value
    number = context.cast(builder, value, kind, types.float64)
    return number if count == 1 else _splat(builder, number, count)


def _splat(builder: Any, number: Any, count: int) -> Any:
    """Emit LLVM instructions for a vector of ``count`` copies of a number."""
    vector = ir.VectorType(number.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, I32(0))
    zeros = ir.Constant(ir.VectorType(I32, count), [0] * count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def _register_type(function: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that registers ``result(*args)``, which returns the type of the call from
    the types of its arguments (None if they do not fit), as the typing of ``function``.
    """

    def register(result: Callable[..., Any]) -> Callable[..., Any]:
        """Register ``result`` and return it unchanged."""

        @infer_global(function)
        class Typing(AbstractTemplate):
            def generic(self, args: Any, _kws: Any) -> Any:
                """Return the signature of a call, None if the types do not fit, as numba asks."""
                result_type = result(*args)
                return None if result_type is None else signature(result_type, *args)

        return result

    return register


# Memory


def _pointer(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    """Emit the address of an entry: ``values`` are an array and indices, of numba types ``kinds``.

    Indices that are not given are 0, such as that of the lanes, the last axis.
    """
    indices = [
        context.cast(builder, value, kind, types.intp)
        for value, kind in zip(values[1:], kinds[1:], strict=True)
    ]
    indices += [ir.Constant(I64, 0)] * (kinds[0].ndim - len(indices))
    return entry_pointer(builder, kinds[0], values[0], indices)


def _as_vector(builder: Any, pointer: Any, element: Any, count: int) -> Any:
    """Return ``pointer`` cast to that of a vector of ``count`` values of type ``element``."""
    kind = element if count == 1 else ir.VectorType(element, count)
    return builder.bitcast(pointer, kind.as_pointer())


@_register_type(names.load)
def _load(lanes: Any, _array: Any, *_place: Any) -> Any:
    """Return the type of a call of ``load`` in kernels: a value of L lanes."""
    return value_type(len(lanes))


@lower_builtin(names.load, types.VarArg(types.Any))
def lower_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector load of all lanes. numba calls it for ``load(lanes, array, *place)``: ``sig``
    has the types of the call, ``args`` its LLVM values.
    """
    pointer = _pointer(context, builder, sig.args[1:], args[1:])
    return builder.load(_as_vector(builder, pointer, DOUBLE, len(sig.args[0])), align=8)


@_register_type(names.store)
def _store(_lanes: Any, _array: Any, *_place: Any) -> Any:
    """Return the type of a call of ``store`` in kernels: none."""
    return types.none


@lower_builtin(names.store, types.VarArg(types.Any))
def lower_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector store of all lanes. numba calls it for
    ``store(lanes, array, *place, value)``: ``sig`` has the types of the call, ``args`` its LLVM
    values.
    """
    count = len(sig.args[0])
    pointer = _pointer(context, builder, sig.args[1:-1], args[1:-1])
    value = _broadcast(context, builder, args[-1], sig.args[-1], count)
    builder.store(value, _as_vector(builder, pointer, DOUBLE, count), align=8)
    return context.get_dummy_value()


@_register_type(names.turn)
def _turn(_lanes: Any, _rows: Any, _column: Any, _out: Any) -> Any:
    """Return the type of a call of ``turn`` in kernels: none."""
    return types.none


@_register_type(names.gather)
def _gather(_lanes: Any, _array: Any, _places: Any, _first: Any, _out: Any) -> Any:
    """Return the type of a call of ``gather`` in kernels: none."""
    return types.none


@_register_type(names.scatter)
def _scatter(*_: Any) -> Any:
    """Return the type of a call of ``scatter`` in kernels: none."""
    return types.none


@lower_builtin(names.turn, types.BaseTuple, types.Array, types.Integer, types.Array)
def lower_turn(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the transposition of the L x L entries of ``rows`` (L, W) from ``column`` on into the L
    rows of ``out`` (W, L) from number ``column`` on.

    numba calls it for ``turn(lanes, rows, column, out)``: ``sig`` has the types of the call,
    ``args`` its LLVM values.
    """
    count = len(sig.args[0])
    rows, out = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 3))
    begin = context.cast(builder, args[2], sig.args[2], types.intp)
    vectors = [
        builder.load(rows.place(ir.Constant(I64, k), begin, count), align=8) for k in range(count)
    ]
    for k, value in enumerate(_transposed(builder, vectors)):
        builder.store(value, out.line(builder.add(begin, ir.Constant(I64, k)), count), align=8)
    return context.get_dummy_value()


@lower_builtin(names.gather, types.BaseTuple, types.Array, types.Array, types.Integer, types.Array)
def lower_gather(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a gather of rows into lanes: for each lane q, one vector load of the L entries of row
    ``places[q]`` of ``array`` (K, W) from column ``first`` on; then the transposition of the L
    vectors, which is stored in the L rows of ``out`` (W, L) from number ``first`` on. Where
    ``places[q]`` is negative, row 0 is read, only to load from valid memory.

    numba calls it for ``gather(lanes, array, places, first, out)``: ``sig`` has the types of the
    call, ``args`` its LLVM values.
    """
    # ``lanes`` is a tuple of L zeros: its type tells L.
    count = len(sig.args[0])
    array, out = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 4))
    begin, zero = context.cast(builder, args[3], sig.args[3], types.intp), ir.Constant(I64, 0)
    vectors = []
    for k in range(count):
        index = _entry_of(builder, sig, args, 2, k)
        row_index = builder.select(builder.icmp_signed("<", index, zero), zero, index)
        vectors.append(builder.load(array.place(row_index, begin, count), align=8))
    for k, value in enumerate(_transposed(builder, vectors)):
        row = builder.add(begin, ir.Constant(I64, k))
        builder.store(value, out.line(row, count), align=8)
    # numba wants an LLVM value also for a function that returns nothing.
    return context.get_dummy_value()


@lower_builtin(
    names.scatter,
    *(types.BaseTuple, types.Array, types.Integer, types.Array, types.Array, types.Integer),
)
def lower_scatter(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a transposition and one masked store per lane: lane q of the ``count`` rows of ``rows``
    (W, L) from number ``first`` on is stored in row ``places[q]`` of ``array`` (K, W), in the
    columns from ``first`` on; nothing is stored where ``places[q]`` is negative.

    numba calls it for ``scatter(lanes, rows, first, array, places, count)``: ``sig`` has the types
    of the call, ``args`` its LLVM values.
    """
    count = len(sig.args[0])
    rows, array = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 3))
    begin, zero = context.cast(builder, args[2], sig.args[2], types.intp), ir.Constant(I64, 0)
    # After the transposition a vector has the entries of one lane; only the first args[5] are used.
    used_entries = _splat(builder, context.cast(builder, args[5], sig.args[5], types.intp), count)
    is_used = builder.icmp_signed(
        "<", ir.Constant(ir.VectorType(I64, count), list(range(count))), used_entries
    )
    lines = [rows.line(builder.add(begin, ir.Constant(I64, k)), count) for k in range(count)]
    vectors = [builder.load(line, align=8) for line in lines]
    vector = vectors[0].type
    flags = ir.VectorType(BIT, count)
    kinds = ir.FunctionType(ir.VoidType(), [vector, vector.as_pointer(), I32, flags])
    name = f"llvm.masked.store.v{count}f64.p0v{count}f64"
    masked = cgutils.get_or_insert_function(builder.module, kinds, name)
    for k, value in enumerate(_transposed(builder, vectors)):
        index = _entry_of(builder, sig, args, 4, k)
        is_present = _splat(builder, builder.icmp_signed(">=", index, zero), count)
        pointer = array.place(index, begin, count)
        builder.call(masked, [value, pointer, I32(8), builder.and_(is_used, is_present)])
    return context.get_dummy_value()


def _entry_of(builder: Any, sig: Any, args: Any, argument: int, k: int) -> Any:
    """Emit the load of entry ``k`` of argument number ``argument`` of a call, an array of int64;
    ``sig`` has the types of the call, ``args`` its LLVM values.
    """
    return builder.load(
        entry_pointer(builder, sig.args[argument], args[argument], [ir.Constant(I64, k)])
    )


class _Matrix:
    """An array as a matrix: rows are the first axis, columns all others, which are contiguous."""

    def __init__(self, builder: Any, kind: Any, value: Any) -> None:
        """Take an LLVM array ``value`` of numba type ``kind``; its number of columns is the product
        of all axes but the first.
        """
        shape = [builder.extract_value(value, [SHAPE, axis]) for axis in range(kind.ndim)]
        self._data = builder.extract_value(value, DATA)
        self._builder, self._columns = builder, ir.Constant(I64, 1)
        if kind.layout != "C":
            # A slice of the columns of a C array: rows are one stride of the first axis apart.
            step = builder.extract_value(value, [STRIDES, 0])
            self._columns = builder.sdiv(step, ir.Constant(I64, 8))
            return
        for size in shape[1:]:
            self._columns = builder.mul(self._columns, size)

    def place(self, row: Any, column: Any, count: int) -> Any:
        """Emit the address, as that of a vector, of ``count`` neighbouring entries in ``row`` from
        ``column`` on; both are LLVM integers.
        """
        offset = self._builder.add(self._builder.mul(row, self._columns), column)
        return _as_vector(self._builder, self._builder.gep(self._data, [offset]), DOUBLE, count)

    def line(self, row: Any, count: int) -> Any:
        """Emit the address, as that of a vector, of ``row`` (an LLVM integer) of an array whose
        rows have ``count`` entries.
        """
        offset = self._builder.mul(row, ir.Constant(I64, count))
        return _as_vector(self._builder, self._builder.gep(self._data, [offset]), DOUBLE, count)


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Emit the transposition of L x L entries, L a power of 2, from a list of row vectors.

    Off-diagonal blocks of half the size are exchanged, then those of a quarter, down to entries.
    """
    rows, half = list(rows), len(rows) // 2
    while half > 0:
        for k in range(len(rows)):
            if not k & half:
                rows[k], rows[k + half] = _exchange_blocks(builder, rows[k], rows[k + half], half)
        half //= 2
    return rows


def _exchange_blocks(builder: Any, a: Any, b: Any, half: int) -> tuple[Any, Any]:
    """Emit the rows ``a`` and ``b`` of a matrix, vectors whose indices are ``half`` apart, with
    their off-diagonal blocks exchanged.
    """
    count = a.type.count
    # Masks of LLVM's shufflevector: entry q < count is a[q], entry count + q is b[q].
    upper = [q if not q & half else count + q - half for q in range(count)]
    lower = [q + half if not q & half else count + q for q in range(count)]
    masks = (ir.Constant(ir.VectorType(I32, count), places) for places in (upper, lower))
    first, second = (builder.shuffle_vector(a, b, mask) for mask in masks)
    return first, second


@_register_type(names.prefetch)
def _prefetch(_array: Any, *_place: Any) -> Any:
    """Return the type of a call of ``prefetch`` in kernels: none."""
    return types.none


@lower_builtin(names.prefetch, types.VarArg(types.Any))
def lower_prefetch(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a prefetch of the cache line at the given indices of an array. numba calls it for
    ``prefetch(array, *place)``: ``sig`` has the types of the call, ``args`` its LLVM values.
    """
    pointer = builder.bitcast(_pointer(context, builder, sig.args, args), cgutils.voidptr_t)
    kinds = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, I32, I32, I32])
    prefetch = cgutils.get_or_insert_function(builder.module, kinds, "llvm.prefetch.p0")
    # LLVM's arguments: to be read (0), kept in all caches (3), data (1).
    builder.call(prefetch, [pointer, I32(0), I32(3), I32(1)])
    return context.get_dummy_value()


@_register_type(names.spread)
def _spread_type(lanes: Any, _number: Any) -> Any:
    """Return the type of a call of ``spread`` in kernels: a value of L lanes."""
    return value_type(len(lanes))


@lower_builtin(names.spread, types.BaseTuple, types.Any)
def lower_spread(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a number in all lanes. numba calls it for ``spread(lanes, number)``: ``sig`` has the
    types of the call, ``args`` its LLVM values.
    """
    return _broadcast(context, builder, args[1], sig.args[1], _count(sig.return_type))


@_register_type(names.load_flags)
def _load_flags(lanes: Any, _array: Any, *_place: Any) -> Any:
    """Return the type of a call of ``load_flags`` in kernels: flags of L lanes."""
    return flags_type(len(lanes))


@lower_builtin(names.load_flags, types.VarArg(types.Any))
def lower_load_flags(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector load of bytes, compared with 0. numba calls it for
    ``load_flags(lanes, array, *place)``: ``sig`` has the types of the call, ``args`` its LLVM
    values.
    """
    pointer = _pointer(context, builder, sig.args[1:], args[1:])
    flags = builder.load(_as_vector(builder, pointer, BYTE, len(sig.args[0])), align=1)
    return builder.icmp_unsigned("!=", flags, ir.Constant(flags.type, None))


@_register_type(names.store_flags)
def _store_flags(_lanes: Any, _array: Any, *_place: Any) -> Any:
    """Return the type of a call of ``store_flags`` in kernels: none."""
    return types.none


@lower_builtin(names.store_flags, types.VarArg(types.Any))
def lower_store_flags(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector store of all flags as bytes. numba calls it for
    ``store_flags(lanes, array, *place, flags)``: ``sig`` has the types of the call, ``args`` its
    LLVM values.
    """
    count = len(sig.args[0])
    pointer = _pointer(context, builder, sig.args[1:-1], args[1:-1])
    kind = BYTE if count == 1 else ir.VectorType(BYTE, count)
    flags = builder.zext(args[-1], kind)
    builder.store(flags, _as_vector(builder, pointer, BYTE, count), align=1)
    return context.get_dummy_value()


# Choices


@_register_type(names.select)
def _select(flags: Any, chosen: Any, other: Any) -> Any:
    """Return the type of a call of ``select`` in kernels: a value of as many lanes
    as the widest argument; None if the first are no flags.
    """
    are_flags = isinstance(flags, LaneFlags | types.Boolean)
    count = max(_count(flags), _count(chosen), _count(other))
    return value_type(count) if are_flags else None


@lower_builtin(names.select, types.Any, types.Any, types.Any)
def lower_select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a selection per lane, without a branch. numba calls it for
    ``select(flags, chosen, other)``: ``sig`` has the types of the call, ``args`` its LLVM values.
    """
    count = _count(sig.return_type)
    pair = [_broadcast(context, builder, args[k], sig.args[k], count) for k in (1, 2)]
    return builder.select(args[0], *pair)


@_register_type(names.any_lane)
def _any_lane(_flags: Any) -> Any:
    """Return the type of a call of ``any_lane`` in kernels: a bool."""
    return types.boolean


@lower_builtin(names.any_lane, types.Any)
def lower_any_lane(_context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the flags as one integer, compared with 0. numba calls it for ``any_lane(flags)``:
    ``sig`` has the types of the call, ``args`` its LLVM values.
    """
    bits = builder.bitcast(args[0], ir.IntType(_count(sig.args[0])))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


for _operation in (operator.and_, operator.or_):

    @_register_type(_operation)
    def _combine_flags(a: Any, b: Any) -> Any:
        """Return the type of ``a & b`` or ``a | b``: that of both flags, None for other types."""
        return a if isinstance(a, LaneFlags) and a == b else None


@lower_builtin(operator.and_, LaneFlags, LaneFlags)
def lower_and(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """Emit ``a & b`` of two flags of L lanes, the LLVM values in ``args``, as numba asks."""
    return builder.and_(*args)


@lower_builtin(operator.or_, LaneFlags, LaneFlags)
def lower_or(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """Emit ``a | b`` of two flags of L lanes, the LLVM values in ``args``, as numba asks."""
    return builder.or_(*args)


# Arithmetic


def _pair_count(a: Any, b: Any) -> int:
    """Return the lanes of an operation of two values, one of which may be a plain number; 0 if
    neither is a LaneValue.
    """
    if not (isinstance(a, LaneValue) or isinstance(b, LaneValue)):
        return 0
    if not all(isinstance(kind, LaneValue) or _is_number(kind) for kind in (a, b)):
        return 0
    return max(_count(a), _count(b))


def _arithmetic(operation: Any, name: str) -> None:
    """Register with numba how an operator ``operation`` of two values of L lanes is typed and
    compiled; ``name`` is the method of the LLVM builder, such as fadd.
    """

    @_register_type(operation)
    def result(*args: Any) -> Any:
        """Return the numba type of the result from the types of the operands: a value of as many
        lanes as the operands.
        """
        count = _pair_count(*args) if len(args) == 2 else 0
        return value_type(count) if count else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the operation, with plain numbers copied to all lanes first. numba gives the types
        of the call in ``sig`` and its LLVM values in ``args``.
        """
        count = _count(sig.return_type)
        pair = [
            _broadcast(context, builder, v, k, count) for v, k in zip(args, sig.args, strict=True)
        ]
        return getattr(builder, name)(*pair)

    for kinds in ((LaneValue, LaneValue), (LaneValue, types.Number), (types.Number, LaneValue)):
        lower_builtin(operation, *kinds)(lower)


def _comparison(operation: Any, sign: str) -> None:
    """Register with numba how a comparison ``operation`` of two values of L lanes is typed and
    compiled; ``sign`` is LLVM's, such as ``<``.
    """

    @_register_type(operation)
    def result(*args: Any) -> Any:
        """Return the numba type of the result from the types of the operands: flags of as many
        lanes as the operands.
        """
        count = _pair_count(*args) if len(args) == 2 else 0
        return flags_type(count) if count else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the comparison, with plain numbers copied to all lanes first. numba gives the types
        of the call in ``sig`` and its LLVM values in ``args``.
        """
        count = _count(sig.return_type)
        pair = [
            _broadcast(context, builder, v, k, count) for v, k in zip(args, sig.args, strict=True)
        ]
        # As in C: comparisons with nan are false, but != is true.
        compare = builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered
        return compare(sign, *pair)

    for kinds in ((LaneValue, LaneValue), (LaneValue, types.Number), (types.Number, LaneValue)):
        lower_builtin(operation, *kinds)(lower)


for _operations, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _operation in _operations:
        _arithmetic(_operation, _name)
for _operation, _name in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _comparison(_operation, _name)


@_register_type(operator.neg)
def _negative(value: Any) -> Any:
    """Return the type of ``-value``: that of the value of L lanes, None for other types."""
    return value if isinstance(value, LaneValue) else None


@lower_builtin(operator.neg, LaneValue)
def lower_negative(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """Emit ``-value`` of L lanes, the LLVM value in ``args``, as numba asks."""
    return builder.fneg(args[0])


# Functions: instructions of LLVM for vectors and floats alike


def _instruction(function: Any, name: str, arguments: int) -> None:
    """Register with numba that ``function`` is compiled to the LLVM intrinsic ``llvm.name`` of that
    many ``arguments``.
    """

    @_register_type(function)
    def result(*args: Any) -> Any:
        """Return the numba type of the result from the types of the arguments: a value of as many
        lanes as the widest argument.
        """
        are_values = all(isinstance(kind, LaneValue) or _is_number(kind) for kind in args)
        return value_type(max(map(_count, args))) if are_values else None

    @lower_builtin(function, *[types.Any] * arguments)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit a call of the intrinsic, with plain numbers copied to all lanes first. numba gives
        the types of the call in ``sig`` and its LLVM values in ``args``.
        """
        count = _count(sig.return_type)
        values = [
            _broadcast(context, builder, v, k, count) for v, k in zip(args, sig.args, strict=True)
        ]
        value_kind = values[0].type
        # Intrinsics are named by their type: llvm.sqrt.f64 or, for eight lanes, llvm.sqrt.v8f64.
        full = f"llvm.{name}.{'f64' if count == 1 else f'v{count}f64'}"
        kinds = ir.FunctionType(value_kind, [value_kind] * arguments)
        instruction = cgutils.get_or_insert_function(builder.module, kinds, full)
        return builder.call(instruction, values)


_instruction(names.root_of, "sqrt", 1)
_instruction(names.magnitude, "fabs", 1)
_instruction(names.with_sign, "copysign", 2)
