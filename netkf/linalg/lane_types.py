"""How numba sees the values of :mod:`netkf.linalg.lanes`: vectors of LLVM.

Imported before the first kernel is compiled. A value of one lane is a float, and its flags a bool.
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
from netkf.linalg.lean_lowering import entry_pointer
from netkf.linalg.value_lowering import DATA, I64, SHAPE, STRIDES

DOUBLE, BYTE, BIT, I32 = ir.DoubleType(), ir.IntType(8), ir.IntType(1), ir.IntType(32)


class LaneValue(types.Type):
    """``count`` float64 side by side."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"LaneValue({count})")


class LaneFlags(types.Type):
    """A truth value for each of ``count`` lanes."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"LaneFlags({count})")


@register_model(LaneValue)
class ValueModel(models.PrimitiveModel):
    """A vector of doubles."""

    def __init__(self, manager: Any, kind: LaneValue) -> None:
        super().__init__(manager, kind, ir.VectorType(DOUBLE, kind.count))


@register_model(LaneFlags)
class FlagsModel(models.PrimitiveModel):
    """A vector of bits."""

    def __init__(self, manager: Any, kind: LaneFlags) -> None:
        super().__init__(manager, kind, ir.VectorType(BIT, kind.count))


def value_type(count: int) -> Any:
    """The numba type of a value."""
    return types.float64 if count == 1 else LaneValue(count)


def flags_type(count: int) -> Any:
    """The numba type of flags."""
    return types.boolean if count == 1 else LaneFlags(count)


def _count(kind: Any) -> int:
    """Lanes of a value or of flags."""
    return kind.count if isinstance(kind, LaneValue | LaneFlags) else 1


def _is_number(kind: Any) -> bool:
    return isinstance(kind, types.Float | types.Integer | types.Boolean)


def _spread(context: Any, builder: Any, value: Any, kind: Any, count: int) -> Any:
    """A value of ``count`` lanes from one or from a number."""
    if isinstance(kind, LaneValue):
        return value
    number = context.cast(builder, value, kind, types.float64)
    return number if count == 1 else _splat(builder, number, count)


def _splat(builder: Any, number: Any, count: int) -> Any:
    vector = ir.VectorType(number.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, I32(0))
    zeros = ir.Constant(ir.VectorType(I32, count), [0] * count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def _typed(function: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register ``result(*args)``, the type of a call or None, as the typing of a function."""

    def register(result: Callable[..., Any]) -> Callable[..., Any]:
        @infer_global(function)
        class Typing(AbstractTemplate):
            def generic(self, args: Any, _kws: Any) -> Any:
                found = result(*args)
                return None if found is None else signature(found, *args)

        return result

    return register


# Memory


def _pointer(context: Any, builder: Any, sig: Any, args: Any, last: int) -> Any:
    """Address of the first lane: args are lanes, the array, and its indices up to ``last``."""
    kind = sig.args[1]
    places = [
        context.cast(builder, value, number, types.intp)
        for value, number in zip(args[2:last], sig.args[2:last], strict=True)
    ]
    # The last axis is that of the lanes, unless places name an entry.
    if len(places) < kind.ndim:
        places.append(context.get_constant(types.intp, 0))
    return entry_pointer(builder, kind, args[1], places)


def _as_vector(builder: Any, pointer: Any, element: Any, count: int) -> Any:
    """Return ``pointer`` cast to that of a vector of ``count`` values of type ``element``."""
    kind = element if count == 1 else ir.VectorType(element, count)
    return builder.bitcast(pointer, kind.as_pointer())


@_typed(names.load)
def _load(lanes: Any, _array: Any, *_place: Any) -> Any:
    return value_type(len(lanes))


@lower_builtin(names.load, types.VarArg(types.Any))
def lower_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector load of all lanes."""
    pointer = _pointer(context, builder, sig, args, len(args))
    return builder.load(_as_vector(builder, pointer, DOUBLE, len(sig.args[0])), align=8)


@_typed(names.store)
def _store(_lanes: Any, _array: Any, *_place: Any) -> Any:
    return types.none


@lower_builtin(names.store, types.VarArg(types.Any))
def lower_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector store of all lanes."""
    count = len(sig.args[0])
    pointer = _pointer(context, builder, sig, args, len(args) - 1)
    value = _spread(context, builder, args[-1], sig.args[-1], count)
    builder.store(value, _as_vector(builder, pointer, DOUBLE, count), align=8)
    return context.get_dummy_value()


@_typed(names.turn)
def _turn(_lanes: Any, _rows: Any, _column: Any, _out: Any) -> Any:
    return types.none


@_typed(names.gather)
def _gather(_lanes: Any, _array: Any, _places: Any, _first: Any, _out: Any) -> Any:
    return types.none


@_typed(names.scatter)
def _scatter(*_: Any) -> Any:
    return types.none


@lower_builtin(names.turn, types.BaseTuple, types.Array, types.Integer, types.Array)
def lower_turn(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a transposition of L x L entries by shuffles."""
    count = len(sig.args[0])
    rows, out = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 3))
    begin = context.cast(builder, args[2], sig.args[2], types.intp)
    found = [
        builder.load(rows.place(ir.Constant(I64, k), begin, count), align=8) for k in range(count)
    ]
    for k, value in enumerate(_turned(builder, found)):
        builder.store(value, out.line(builder.add(begin, ir.Constant(I64, k)), count), align=8)
    return context.get_dummy_value()


@lower_builtin(names.gather, types.BaseTuple, types.Array, types.Array, types.Integer, types.Array)
def lower_gather(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one load per lane from the row that its place names, and the transposition of these."""
    count = len(sig.args[0])
    array, out = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 4))
    begin, zero = context.cast(builder, args[3], sig.args[3], types.intp), ir.Constant(I64, 0)
    found = []
    for k in range(count):
        place = _entry_of(builder, sig, args, 2, k)
        known = builder.select(builder.icmp_signed("<", place, zero), zero, place)
        found.append(builder.load(array.place(known, begin, count), align=8))
    for k, value in enumerate(_turned(builder, found)):
        row = builder.add(begin, ir.Constant(I64, k))
        builder.store(value, out.line(row, count), align=8)
    return context.get_dummy_value()


@lower_builtin(
    names.scatter,
    *(types.BaseTuple, types.Array, types.Integer, types.Array, types.Array, types.Integer),
)
def lower_scatter(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit a transposition and one store per lane into the row that its place names."""
    count = len(sig.args[0])
    rows, array = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 3))
    begin, zero = context.cast(builder, args[2], sig.args[2], types.intp), ir.Constant(I64, 0)
    most = _splat(builder, context.cast(builder, args[5], sig.args[5], types.intp), count)
    wanted = builder.icmp_signed(
        "<", ir.Constant(ir.VectorType(I64, count), list(range(count))), most
    )
    lines = [rows.line(builder.add(begin, ir.Constant(I64, k)), count) for k in range(count)]
    found = [builder.load(line, align=8) for line in lines]
    vector = found[0].type
    flags = ir.VectorType(BIT, count)
    kinds = ir.FunctionType(ir.VoidType(), [vector, vector.as_pointer(), I32, flags])
    name = f"llvm.masked.store.v{count}f64.p0v{count}f64"
    masked = cgutils.get_or_insert_function(builder.module, kinds, name)
    for k, value in enumerate(_turned(builder, found)):
        place = _entry_of(builder, sig, args, 4, k)
        there = _splat(builder, builder.icmp_signed(">=", place, zero), count)
        where = array.place(place, begin, count)
        builder.call(masked, [value, where, I32(8), builder.and_(wanted, there)])
    return context.get_dummy_value()


def _entry_of(builder: Any, sig: Any, args: Any, which: int, k: int) -> Any:
    """Entry k of an argument, an array of int64."""
    return builder.load(entry_pointer(builder, sig.args[which], args[which], [ir.Constant(I64, k)]))


class _Matrix:
    """An array as a matrix, of the first axis and all others together, which are contiguous."""

    def __init__(self, builder: Any, kind: Any, value: Any) -> None:
        shape = [builder.extract_value(value, [SHAPE, axis]) for axis in range(kind.ndim)]
        self._data = builder.extract_value(value, DATA)
        self._builder, self._columns = builder, ir.Constant(I64, 1)
        if kind.layout != "C":
            # A part of each row of an array: as far apart as these rows.
            step = builder.extract_value(value, [STRIDES, 0])
            self._columns = builder.sdiv(step, ir.Constant(I64, 8))
            return
        for size in shape[1:]:
            self._columns = builder.mul(self._columns, size)

    def place(self, row: Any, column: Any, count: int) -> Any:
        """Address of ``count`` neighbours in a row."""
        offset = self._builder.add(self._builder.mul(row, self._columns), column)
        return _as_vector(self._builder, self._builder.gep(self._data, [offset]), DOUBLE, count)

    def line(self, row: Any, count: int) -> Any:
        """Address of the row, if rows have ``count`` entries."""
        offset = self._builder.mul(row, ir.Constant(I64, count))
        return _as_vector(self._builder, self._builder.gep(self._data, [offset]), DOUBLE, count)


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """The transposed matrix: blocks of half the size change places, then half of that."""
    rows, half = list(rows), len(rows) // 2
    while half > 0:
        for k in range(len(rows)):
            if not k & half:
                rows[k], rows[k + half] = _exchanged(builder, rows[k], rows[k + half], half)
        half //= 2
    return rows


def _exchanged(builder: Any, a: Any, b: Any, half: int) -> tuple[Any, Any]:
    """Rows ``a`` and ``b``, ``half`` apart, with the blocks off the diagonal exchanged."""
    count = a.type.count
    upper = [q if not q & half else count + q - half for q in range(count)]
    lower = [q + half if not q & half else count + q for q in range(count)]
    masks = (ir.Constant(ir.VectorType(I32, count), places) for places in (upper, lower))
    first, second = (builder.shuffle_vector(a, b, mask) for mask in masks)
    return first, second


@_typed(names.prefetch)
def _prefetch(_array: Any, *_place: Any) -> Any:
    return types.none


@lower_builtin(names.prefetch, types.VarArg(types.Any))
def lower_prefetch(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the instruction that asks for a line of memory."""
    kind = sig.args[0]
    places = [
        context.cast(builder, value, number, types.intp)
        for value, number in zip(args[1:], sig.args[1:], strict=True)
    ]
    places += [ir.Constant(I64, 0)] * (kind.ndim - len(places))
    pointer = builder.bitcast(entry_pointer(builder, kind, args[0], places), cgutils.voidptr_t)
    kinds = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, I32, I32, I32])
    asked = cgutils.get_or_insert_function(builder.module, kinds, "llvm.prefetch.p0")
    # LLVM's arguments: to be read (0), kept in all caches (3), data (1).
    builder.call(asked, [pointer, I32(0), I32(3), I32(1)])
    return context.get_dummy_value()


@_typed(names.spread)
def _spread_type(lanes: Any, _number: Any) -> Any:
    return value_type(len(lanes))


@lower_builtin(names.spread, types.BaseTuple, types.Any)
def lower_spread(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """A number in all lanes."""
    return _spread(context, builder, args[1], sig.args[1], _count(sig.return_type))


@_typed(names.load_flags)
def _load_flags(lanes: Any, _array: Any, *_place: Any) -> Any:
    return flags_type(len(lanes))


@lower_builtin(names.load_flags, types.VarArg(types.Any))
def lower_load_flags(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """One load of all bytes, each compared with 0."""
    pointer = _pointer(context, builder, sig, args, len(args))
    found = builder.load(_as_vector(builder, pointer, BYTE, len(sig.args[0])), align=1)
    return builder.icmp_unsigned("!=", found, ir.Constant(found.type, None))


@_typed(names.store_flags)
def _store_flags(_lanes: Any, _array: Any, *_place: Any) -> Any:
    return types.none


@lower_builtin(names.store_flags, types.VarArg(types.Any))
def lower_store_flags(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit one vector store of all flags as bytes."""
    count = len(sig.args[0])
    pointer = _pointer(context, builder, sig, args, len(args) - 1)
    kind = BYTE if count == 1 else ir.VectorType(BYTE, count)
    found = builder.zext(args[-1], kind)
    builder.store(found, _as_vector(builder, pointer, BYTE, count), align=1)
    return context.get_dummy_value()


# Choices


@_typed(names.select)
def _select(flags: Any, chosen: Any, other: Any) -> Any:
    known = isinstance(flags, LaneFlags | types.Boolean)
    count = max(_count(flags), _count(chosen), _count(other))
    return value_type(count) if known else None


@lower_builtin(names.select, types.Any, types.Any, types.Any)
def lower_select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """A selection without a branch."""
    count = _count(sig.return_type)
    pair = [_spread(context, builder, args[k], sig.args[k], count) for k in (1, 2)]
    return builder.select(args[0], *pair)


@_typed(names.any_lane)
def _any_lane(_flags: Any) -> Any:
    return types.boolean


@lower_builtin(names.any_lane, types.Any)
def lower_any_lane(_context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """The bits as one integer, compared with 0."""
    bits = builder.bitcast(args[0], ir.IntType(_count(sig.args[0])))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


for _operation in (operator.and_, operator.or_):

    @_typed(_operation)
    def _combine_flags(a: Any, b: Any) -> Any:
        return a if isinstance(a, LaneFlags) and a == b else None


@lower_builtin(operator.and_, LaneFlags, LaneFlags)
def lower_and(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """Both flags."""
    return builder.and_(*args)


@lower_builtin(operator.or_, LaneFlags, LaneFlags)
def lower_or(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """One of the flags at least."""
    return builder.or_(*args)


# Arithmetic


def _pair_count(a: Any, b: Any) -> int:
    """Lanes of an operation of two values, one of which may be a number; 0: not one of ours."""
    if not (isinstance(a, LaneValue) or isinstance(b, LaneValue)):
        return 0
    if not all(isinstance(kind, LaneValue) or _is_number(kind) for kind in (a, b)):
        return 0
    return max(_count(a), _count(b))


def _arithmetic(operation: Any, name: str) -> None:
    """Register an operator of two values; ``name`` is the builder's method, such as fadd."""

    @_typed(operation)
    def result(*args: Any) -> Any:
        count = _pair_count(*args) if len(args) == 2 else 0
        return value_type(count) if count else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the operation, with plain numbers copied to all lanes first."""
        count = _count(sig.return_type)
        pair = [_spread(context, builder, v, k, count) for v, k in zip(args, sig.args, strict=True)]
        return getattr(builder, name)(*pair)

    for kinds in ((LaneValue, LaneValue), (LaneValue, types.Number), (types.Number, LaneValue)):
        lower_builtin(operation, *kinds)(lower)


def _comparison(operation: Any, sign: str) -> None:
    """Register a comparison of two values; ``sign`` is LLVM's, such as ``<``."""

    @_typed(operation)
    def result(*args: Any) -> Any:
        count = _pair_count(*args) if len(args) == 2 else 0
        return flags_type(count) if count else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the comparison, with plain numbers copied to all lanes first."""
        count = _count(sig.return_type)
        pair = [_spread(context, builder, v, k, count) for v, k in zip(args, sig.args, strict=True)]
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


@_typed(operator.neg)
def _negative(value: Any) -> Any:
    return value if isinstance(value, LaneValue) else None


@lower_builtin(operator.neg, LaneValue)
def lower_negative(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """Flip the signs."""
    return builder.fneg(args[0])


# Functions: instructions of LLVM for vectors and floats alike


def _instruction(function: Any, name: str, arguments: int) -> None:
    @_typed(function)
    def result(*args: Any) -> Any:
        known = all(isinstance(kind, LaneValue) or _is_number(kind) for kind in args)
        return value_type(max(map(_count, args))) if known else None

    @lower_builtin(function, *[types.Any] * arguments)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        count = _count(sig.return_type)
        found = [
            _spread(context, builder, v, k, count) for v, k in zip(args, sig.args, strict=True)
        ]
        kind = found[0].type
        full = f"llvm.{name}.{'f64' if count == 1 else f'v{count}f64'}"
        kinds = ir.FunctionType(kind, [kind] * arguments)
        instruction = cgutils.get_or_insert_function(builder.module, kinds, full)
        return builder.call(instruction, found)


_instruction(names.root_of, "sqrt", 1)
_instruction(names.magnitude, "fabs", 1)
_instruction(names.with_sign, "copysign", 2)
