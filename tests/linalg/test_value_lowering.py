"""Kernels in few lines of LLVM's language compute what Python does, and fail where it does."""

import numba
import numpy as np
import pytest
from llvmlite import ir

from netkf.linalg.compiling import kernel
from netkf.linalg.linking import linked_once
from netkf.linalg.shortcuts import kernel_compiler
from netkf.linalg.value_lowering import ValueBuilder, inserted_value, remove_unread


def branches(x, n, out):
    """Variables of all sorts: of one block and of several, before, in and after loops."""
    first = x[0]
    scale = 2.0 if first > 0.0 else 3.0
    total, row = 0.0, x[1:]
    for i in range(n):
        if i % 2:
            half = 0.5 * i
            total += half * scale
        elif i > 6:
            total -= first
            continue
        last = total
        while last > 1.0:
            last *= 0.5
        out[i] = last + (row[i] if i < len(row) else first)
    if n > 3:
        only = total * scale
        out[0] += only
        return only + first
    return first


def steps(start, stop, out):
    """Steps that are written as numbers."""
    count = 0
    for i in range(start, stop, 3):
        out[count] = i
        count += 1
    for i in range(start, stop, 8):
        for j in range(i, stop, -2):
            out[count] = j
            count += 1
    return count


def compilers():
    return [kernel_compiler(lean, compact) for lean, compact in ((0, 0), (1, 0), (1, 1))]


@pytest.mark.parametrize("compiler", compilers())
@pytest.mark.parametrize("n", [0, 1, 4, 9])
@pytest.mark.parametrize("first", [-1.5, 0.75])
def test_variables_are_those_of_python(compiler, n, first):
    x = np.array([first, 0.5, 4.0, -2.0, 8.0])
    out, expected = np.zeros(9), np.zeros(9)
    with linked_once():
        made = numba.njit(pipeline_class=compiler, _nrt=False)(branches)
        assert made(x, n, out) == branches(x, n, expected)
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("compiler", compilers())
def test_ranges_with_steps_are_those_of_python(compiler):
    made = numba.njit(pipeline_class=compiler, _nrt=False)(steps)
    for start in range(-3, 12):
        for stop in (-4, 0, 5, 8, 9):
            out, expected = np.zeros((2, 60), dtype=np.int64)
            assert made(start, stop, out) == steps(start, stop, expected)
            np.testing.assert_array_equal(out, expected)


@kernel
def refuses(x: float) -> float:
    if x < 0.0:
        raise ValueError("a root of a negative number")
    return np.sqrt(x)


@kernel
def adds(x: float) -> float:
    return x + 1.0


@kernel
def calls_both(x: float, out: np.ndarray) -> float:
    out[0] = adds(x)
    out[1] = refuses(x)
    return adds(out[1])


@kernel
def calls_twice(x: float, out: np.ndarray) -> None:
    out[2] = calls_both(x, out)


def test_errors_of_inner_kernels_are_raised():
    """Only functions that never fail are not asked."""
    out = np.zeros(3)
    calls_twice(4.0, out)
    assert out.tolist() == [5.0, 2.0, 3.0]
    out = np.zeros(3)
    with pytest.raises(ValueError, match="a root of a negative number"):
        calls_twice(-4.0, out)
    assert out.tolist() == [-3.0, 0.0, 0.0]


def test_functions_that_never_fail_are_not_asked():
    """The caller of one has no way out but its own."""
    text = []

    def keep(library, module):
        text.append(str(module))

    def inner(x):
        return 2.0 * x

    with linked_once():
        code = numba.core.codegen.CPUCodeLibrary
        before, code.add_ir_module = code.add_ir_module, lambda *a: keep(*a) or before(*a)
        try:
            called = numba.njit(pipeline_class=kernel_compiler(True), _nrt=False)(inner)
            made = numba.njit(pipeline_class=kernel_compiler(True), _nrt=False)(
                lambda x: called(x) + 1.0
            )
            assert made(1.5) == 4.0
        finally:
            code.add_ir_module = before
    caller = next(one for one in text if "call i32" in one and "lambda" in one)
    body = caller[caller.index("define") : caller.index("\n}")]
    assert body.count("ret i32") == 1
    assert "icmp" not in body


def function_of(kind):
    function = ir.Function(ir.Module(), kind, "function")
    return function, ValueBuilder(function.append_basic_block("entry"))


def test_entries_are_taken_from_where_they_were_inserted():
    word, part = ir.IntType(64), ir.ArrayType(ir.IntType(64), 2)
    whole = ir.LiteralStructType([word, part])
    function, builder = function_of(ir.FunctionType(ir.VoidType(), [word, word, whole]))
    one, two, given = function.args
    made = builder.insert_value(builder.insert_value(given, one, [1, 0]), two, 0)
    assert builder.extract_value(made, 0) is two
    assert builder.extract_value(made, (1, 0)) is one
    # A part that was only partly inserted, and one that was not.
    partly = builder.extract_value(made, 1)
    assert (partly.opname, list(partly.indices)) == ("extractvalue", [1])
    assert inserted_value(made, [1, 1]) == (given, [1, 1])
    pair = builder.insert_value(ir.Constant(part, ir.Undefined), two, 1)
    assert builder.extract_value(builder.insert_value(given, pair, 1), [1, 1]) is two


def test_what_nobody_reads_goes_and_what_others_see_stays():
    word = ir.IntType(64)
    function, builder = function_of(ir.FunctionType(word, [word, word.as_pointer()]))
    number, place = function.args
    variable, unread = builder.alloca(word), builder.alloca(word)
    builder.store(number, variable)
    builder.store(builder.add(number, number), unread)
    builder.mul(builder.load(unread), number)
    builder.store(number, place)
    builder.ret(builder.load(variable))
    remove_unread(function)
    left = [each.opname for each in function.blocks[0].instructions]
    assert left == ["alloca", "store", "add", "store", "load", "ret"]
