"""Calls of addresses, the numba implementation of ``functions`` and ``addresses``."""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import lower_builtin, type_callable

from netkf.linalg.addresses import call_at, call_at_two, number_at
from netkf.linalg.functions import call_function
from netkf.linalg.struct_types import StructType

_numba: Any = numba
carray, _POINTER = _numba.carray, _numba.types.CPointer(types.float64)
SIGNATURE = types.void(_POINTER, _POINTER, types.float64, types.float64, _POINTER)


def taking_addresses(function: Any, shapes: tuple[Any, Any, Any], takes_period: bool) -> Any:
    """Return what the C function of a kernel is made of, see ``VectorFunction``."""
    of_x, of_u, of_out = shapes

    def call(x: Any, u: Any, t: Any, period: Any, out: Any) -> None:
        function(carray(x, of_x), carray(u, of_u), t, period, carray(out, of_out))

    def call_shortly(x: Any, u: Any, t: Any, _period: Any, out: Any) -> None:
        function(carray(x, of_x), carray(u, of_u), t, carray(out, of_out))

    return call if takes_period else call_shortly


@type_callable(call_function)
def _type_call(_: Any) -> Any:
    return lambda _address, _x, _u, _t, _period, _out: types.none


_emit: Any = lower_builtin
_KINDS = types.Integer, types.Array, types.Array, types.Number, types.Number, types.Array


@_emit(call_function, *_KINDS)  # type: ignore[untyped-decorator]
def _lower_call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the call of an address with the data of arrays."""
    double, data = ir.DoubleType(), ir.DoubleType().as_pointer()
    arguments = []
    for value, kind in zip(args[1:], sig.args[1:], strict=True):
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder, value)
            arguments.append(builder.bitcast(array.data, data))
        else:
            arguments.append(context.cast(builder, value, kind, types.float64))
    function = ir.FunctionType(ir.VoidType(), [data, data, double, double, data])
    builder.call(builder.inttoptr(args[0], function.as_pointer()), arguments)
    return context.get_dummy_value()


@type_callable(call_at)
def _type_call_at(_: Any) -> Any:
    return lambda _address, _record, _h, _run: types.none


@type_callable(call_at_two)
def _type_call_at_two(_: Any) -> Any:
    return lambda _address, _record, _h, _m, _run: types.none


@type_callable(number_at)
def _type_number_at(_: Any) -> Any:
    """Return the function that types a call: it returns a float."""
    return lambda _address, _record, _h, _run: types.float64


def _lower_call_at(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Emit the call of an address with addresses of structs and integers."""
    given, kinds = [], []
    for value, kind in zip(args[1:], sig.args[1:], strict=True):
        is_integer = isinstance(kind, types.Integer)
        given.append(context.cast(builder, value, kind, types.int64) if is_integer else value)
        kinds.append(given[-1].type)
    is_number = sig.return_type == types.float64
    returned = ir.DoubleType() if is_number else ir.VoidType()
    pointer = ir.FunctionType(returned, kinds).as_pointer()
    value = builder.call(builder.inttoptr(args[0], pointer), given)
    return value if is_number else context.get_dummy_value()


for _function, _count in ((call_at, 1), (number_at, 1), (call_at_two, 2)):
    _integers = (types.Integer,) * _count
    _emit(_function, types.Integer, StructType, *_integers, StructType)(_lower_call_at)
