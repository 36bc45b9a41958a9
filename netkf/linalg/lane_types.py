"""The numba types of the SIMD values of :mod:`netkf.linalg.lanes`: vectors of LLVM.

Imported before the first kernel is compiled. A value of one lane is a float, and its flags a bool.
numba calls the functions here with the numba types of a call (``sig``) and its LLVM values
(``args``), to emit LLVM instructions.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from netkf.linalg import lanes as names
from netkf.linalg.array_layout import DATA, I64, SHAPE, STRIDES, entry_pointer

DOUBLE, BYTE, BIT, I32 = ir.DoubleType(), ir.IntType(8), ir.IntType(1), ir.IntType(32)
ANY = (types.VarArg(types.Any),)


class _Vector(types.Type):
    """A numba type of ``count`` lanes."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"{type(self).__name__}({count})")


class LaneValue(_Vector):
    """The numba type of a vector of ``count`` float64."""


class LaneFlags(_Vector):
    """The numba type of a vector of ``count`` truth values."""


def _vector_model(element: Any) -> Any:
    """Return the data model of a vector of LLVM with entries of type ``element``."""

    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, kind: _Vector) -> None:
            super().__init__(manager, kind, ir.VectorType(element, kind.count))

    return Model


register_model(LaneValue)(_vector_model(DOUBLE))
register_model(LaneFlags)(_vector_model(BIT))


def value_type(count: int) -> Any:
    """Return the numba type of a value of ``count`` lanes."""
    return types.float64 if count == 1 else LaneValue(count)


def flags_type(count: int) -> Any:
    """Return the numba type of the flags of ``count`` lanes."""
    return types.boolean if count == 1 else LaneFlags(count)


def _count(kind: Any) -> int:
    """Return the number of lanes of a type of values or flags; 1 for plain numbers."""
    return kind.count if isinstance(kind, _Vector) else 1


def _are_values(kinds: Any) -> bool:
    """Return True for types of values, of which plain numbers are those of one lane."""
    numbers = LaneValue | types.Float | types.Integer | types.Boolean
    return all(isinstance(kind, numbers) for kind in kinds)


def _implement(
    function: Any, result: Any, *signatures: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator of what emits calls of ``function``, which returns a ``result``."""

    class Typing(AbstractTemplate):
        def generic(self, args: Any, _kws: Any) -> Any:
            kind = result if isinstance(result, types.Type) else result(*args)
            return None if kind is None else signature(kind, *args)

    infer_global(function)(Typing)

    def register(emit: Callable[..., Any]) -> Callable[..., Any]:
        for kinds in signatures or (ANY,):
            lower_builtin(function, *kinds)(emit)
        return emit

    return register


def _value_of_lanes(lanes: Any, *_: Any) -> Any:
    """Return the type of a value of as many lanes as the first argument, a tuple, has entries."""
    return value_type(len(lanes))


def _broadcast(context: Any, builder: Any, value: Any, kind: Any, count: int) -> Any:
    """Emit a value of ``count`` lanes from one that has these lanes already, or a plain number."""
    if isinstance(kind, LaneValue):
        return value
    number = context.cast(builder, value, kind, types.float64)
    return number if count == 1 else _splat(builder, number, count)


def _widen_all(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    """Emit all arguments as values of as many lanes as the widest has."""
    count = max(map(_count, sig.args))
    return [
        _broadcast(context, builder, value, kind, count)
        for value, kind in zip(args, sig.args, strict=True)
    ]


def _splat(builder: Any, number: Any, count: int) -> Any:
    """Emit a vector of ``count`` copies of a number."""
    vector = ir.VectorType(number.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, I32(0))
    zeros = ir.Constant(ir.VectorType(I32, count), [0] * count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def _call(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    """Emit a call of an intrinsic function of LLVM."""
    kind = ir.FunctionType(result, [value.type for value in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)


# Memory


def _pointer(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    """Emit the address of an entry of an array; indices that are not given are 0."""
    indices = [
        context.cast(builder, value, kind, types.intp)
        for value, kind in zip(values[1:], kinds[1:], strict=True)
    ]
    indices += [I64(0)] * (kinds[0].ndim - len(indices))
    return entry_pointer(builder, kinds[0], values[0], indices)


def _as_vector(builder: Any, pointer: Any, element: Any, count: int) -> Any:
    """Return ``pointer`` cast to that of a vector of ``count`` values of type ``element``."""
    kind = element if count == 1 else ir.VectorType(element, count)
    return builder.bitcast(pointer, kind.as_pointer())


@_implement(names.load, _value_of_lanes)
def _load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer = _pointer(context, builder, sig.args[1:], args[1:])
    return builder.load(_as_vector(builder, pointer, DOUBLE, len(sig.args[0])), align=8)


@_implement(names.store, types.none)
def _store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    count = len(sig.args[0])
    pointer = _pointer(context, builder, sig.args[1:-1], args[1:-1])
    value = _broadcast(context, builder, args[-1], sig.args[-1], count)
    builder.store(value, _as_vector(builder, pointer, DOUBLE, count), align=8)
    return context.get_dummy_value()


@_implement(names.load_flags, lambda lanes, *_: flags_type(len(lanes)))
def _load_flags(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer = _pointer(context, builder, sig.args[1:], args[1:])
    flags = builder.load(_as_vector(builder, pointer, BYTE, len(sig.args[0])), align=1)
    return builder.icmp_unsigned("!=", flags, ir.Constant(flags.type, None))


@_implement(names.store_flags, types.none)
def _store_flags(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    count = len(sig.args[0])
    pointer = _pointer(context, builder, sig.args[1:-1], args[1:-1])
    flags = builder.zext(args[-1], BYTE if count == 1 else ir.VectorType(BYTE, count))
    builder.store(flags, _as_vector(builder, pointer, BYTE, count), align=1)
    return context.get_dummy_value()


@_implement(names.prefetch, types.none)
def _prefetch(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer = builder.bitcast(_pointer(context, builder, sig.args, args), cgutils.voidptr_t)
    # LLVM's arguments: to be read (0), kept in all caches (3), data (1).
    _call(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, I32(0), I32(3), I32(1)])
    return context.get_dummy_value()


# Transpositions


class _Matrix:
    """An array as a matrix: rows are the first axis, columns all others, which are contiguous."""

    def __init__(self, builder: Any, kind: Any, value: Any) -> None:
        self._data = builder.extract_value(value, DATA)
        self._builder, self._columns = builder, I64(1)
        if kind.layout != "C":
            # A slice of the columns of a C array: rows are one stride of the first axis apart.
            self._columns = builder.sdiv(builder.extract_value(value, [STRIDES, 0]), I64(8))
            return
        for axis in range(1, kind.ndim):
            self._columns = builder.mul(self._columns, builder.extract_value(value, [SHAPE, axis]))

    def place(self, row: Any, column: Any, count: int) -> Any:
        """Emit the vector's address of ``count`` neighbours in ``row`` from ``column`` on."""
        offset = self._builder.add(self._builder.mul(row, self._columns), column)
        return _as_vector(self._builder, self._builder.gep(self._data, [offset]), DOUBLE, count)

    def lines(self, begin: Any, count: int) -> list[Any]:
        """Emit vectors' addresses of ``count`` rows of as many entries from ``begin`` on."""
        rows = [self._builder.add(begin, I64(k)) for k in range(count)]
        places = [self._builder.gep(self._data, [self._builder.mul(r, I64(count))]) for r in rows]
        return [_as_vector(self._builder, place, DOUBLE, count) for place in places]


def _transpose(builder: Any, sources: list[Any], targets: list[Any]) -> None:
    """Emit the transposition of L rows at addresses, L a power of 2, to addresses."""
    rows = _transposed(builder, [builder.load(source, align=8) for source in sources])
    for value, target in zip(rows, targets, strict=True):
        builder.store(value, target, align=8)


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    half = len(rows) // 2
    while half > 0:
        for k in range(len(rows)):
            if not k & half:
                rows[k], rows[k + half] = _exchange_blocks(builder, rows[k], rows[k + half], half)
        half //= 2
    return rows


def _exchange_blocks(builder: Any, a: Any, b: Any, half: int) -> tuple[Any, Any]:
    """Emit rows ``half`` apart with their off-diagonal blocks exchanged."""
    count = a.type.count
    # Masks of LLVM's shufflevector: entry q < count is a[q], entry count + q is b[q].
    upper = [q if not q & half else count + q - half for q in range(count)]
    lower = [q + half if not q & half else count + q for q in range(count)]
    masks = (ir.Constant(ir.VectorType(I32, count), places) for places in (upper, lower))
    first, second = (builder.shuffle_vector(a, b, mask) for mask in masks)
    return first, second


def _entries_of(builder: Any, kind: Any, array: Any, count: int) -> list[Any]:
    """Emit the loads of the first ``count`` entries of an array of int64."""
    return [builder.load(entry_pointer(builder, kind, array, [I64(k)])) for k in range(count)]


@_implement(names.turn, types.none)
def _turn(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    count = len(sig.args[0])
    rows, out = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 3))
    begin = context.cast(builder, args[2], sig.args[2], types.intp)
    sources = [rows.place(I64(k), begin, count) for k in range(count)]
    _transpose(builder, sources, out.lines(begin, count))
    return context.get_dummy_value()


@_implement(names.gather, types.none)
def _gather(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    count = len(sig.args[0])
    array, out = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 4))
    begin, sources = context.cast(builder, args[3], sig.args[3], types.intp), []
    for index in _entries_of(builder, sig.args[2], args[2], count):
        # Row 0, only to load from valid memory, where the index is negative.
        row = builder.select(builder.icmp_signed("<", index, I64(0)), I64(0), index)
        sources.append(array.place(row, begin, count))
    _transpose(builder, sources, out.lines(begin, count))
    return context.get_dummy_value()


@_implement(names.scatter, types.none)
def _scatter(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    count = len(sig.args[0])
    rows, array = (_Matrix(builder, sig.args[k], args[k]) for k in (1, 3))
    begin = context.cast(builder, args[2], sig.args[2], types.intp)
    used = context.cast(builder, args[5], sig.args[5], types.intp)
    # After the transposition a vector has the entries of one lane, of which ``used`` are written.
    values = _transposed(builder, [builder.load(row, align=8) for row in rows.lines(begin, count)])
    indices = _entries_of(builder, sig.args[4], args[4], count)

    def write(width: int, first: Any) -> None:
        for value, index in zip(values, indices, strict=True):
            with builder.if_then(builder.icmp_signed(">=", index, I64(0))):
                address = builder.bitcast(array.place(index, first, count), _vector(width))
                builder.store(_part(builder, value, 0, width), address, align=8)

    is_whole = builder.icmp_signed(">=", used, I64(count))
    with builder.if_else(is_whole) as (whole, part):
        with whole:
            write(count, begin)
        with part:
            # Powers of two, and not a masked store, which some processors do in ten times the time.
            width = count // 2
            while width > 0:
                is_set = builder.icmp_signed("!=", builder.and_(used, I64(width)), I64(0))
                with builder.if_then(is_set):
                    write(width, begin)
                begin = builder.add(begin, builder.and_(used, I64(width)))
                halves = [[_part(builder, v, k, width) for k in (width, 0)] for v in values]
                values[:] = [builder.select(is_set, *pair) for pair in halves]
                width //= 2
    return context.get_dummy_value()


def _vector(count: int) -> Any:
    """Return the type of the address of ``count`` floats."""
    return ir.VectorType(DOUBLE, count).as_pointer()


def _part(builder: Any, value: Any, first: int, count: int) -> Any:
    """Emit ``count`` entries of a vector from number ``first`` on."""
    places = ir.Constant(ir.VectorType(I32, count), list(range(first, first + count)))
    return builder.shuffle_vector(value, value, places)


# Choices


@_implement(names.spread, _value_of_lanes)
def _spread(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _broadcast(context, builder, args[1], sig.args[1], _count(sig.return_type))


def _selected(flags: Any, *values: Any) -> Any:
    """Return the type of a choice between two values."""
    if isinstance(flags, LaneFlags | types.Boolean):
        return value_type(max(map(_count, (flags, *values))))
    return None


@_implement(names.select, _selected)
def _select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    count = _count(sig.return_type)
    pair = [_broadcast(context, builder, args[k], sig.args[k], count) for k in (1, 2)]
    return builder.select(args[0], *pair)


@_implement(names.any_lane, types.boolean)
def _any_lane(_context: Any, builder: Any, sig: Any, args: Any) -> Any:
    # The flags as one integer.
    bits = builder.bitcast(args[0], ir.IntType(_count(sig.args[0])))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


# Arithmetic

PAIRS = ((LaneValue, LaneValue), (LaneValue, types.Number), (types.Number, LaneValue))


def _value_of_pair(*kinds: Any) -> Any:
    """Return the type of an operation of two values, of which one at most is a plain number."""
    count = max(map(_count, kinds))
    return value_type(count) if len(kinds) == 2 and count > 1 and _are_values(kinds) else None


def _flags_of_pair(*kinds: Any) -> Any:
    kind = _value_of_pair(*kinds)
    return None if kind is None else flags_type(kind.count)


def _same_kind(*kinds: Any) -> Any:
    return kinds[0] if isinstance(kinds[0], _Vector) and len(set(kinds)) == 1 else None


def _arithmetic(operation: Any, name: str, result: Any, *signatures: Any) -> None:
    """Register an operator that is a method of LLVM's builder."""

    @_implement(operation, result, *signatures)
    def _operate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        alike = args if result is _same_kind else _widen_all(context, builder, sig, args)
        return getattr(builder, name)(*alike)


def _comparison(operation: Any, sign: str) -> None:
    """Register a comparison, of LLVM's ``sign``."""

    @_implement(operation, _flags_of_pair, *PAIRS)
    def _compare(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        # As in C: comparisons with nan are false, but != is true.
        compare = builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered
        return compare(sign, *_widen_all(context, builder, sig, args))


for _name, _method in (("add", "fadd"), ("sub", "fsub"), ("mul", "fmul"), ("truediv", "fdiv")):
    _arithmetic(getattr(operator, _name), _method, _value_of_pair, *PAIRS)
    _arithmetic(getattr(operator, f"i{_name}"), _method, _value_of_pair, *PAIRS)
_arithmetic(operator.neg, "fneg", _same_kind, (LaneValue,))
_arithmetic(operator.and_, "and_", _same_kind, (LaneFlags, LaneFlags))
_arithmetic(operator.or_, "or_", _same_kind, (LaneFlags, LaneFlags))
SIGNS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
for _name, _sign in SIGNS.items():
    _comparison(getattr(operator, _name), _sign)


def _widest(*kinds: Any) -> Any:
    return value_type(max(map(_count, kinds))) if _are_values(kinds) else None


def _instruction(function: Any, name: str) -> None:
    """Register a function that is an intrinsic of LLVM for vectors and floats alike."""

    @_implement(function, _widest)
    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values, count = _widen_all(context, builder, sig, args), _count(sig.return_type)
        # Intrinsics are named by their type: llvm.sqrt.f64 or, for eight lanes, llvm.sqrt.v8f64.
        full = f"llvm.{name}.{'f64' if count == 1 else f'v{count}f64'}"
        return _call(builder, full, values[0].type, values)


_instruction(names.root_of, "sqrt")
_instruction(names.magnitude, "fabs")
_instruction(names.with_sign, "copysign")
