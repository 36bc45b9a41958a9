"""Loops and entries of arrays in kernels are those of Python."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

import netkf
from netkf.linalg.compiling import kernel
from netkf.linalg.shortcuts import kernel_compiler

PAIR = np.dtype([("number", np.int64), ("value", np.float64)])


@kernel
def visited(start, stop, step, out):
    count = 0
    if step == 1:
        for i in range(start, stop):
            out[count] = i
            count += 1
    else:
        for i in range(start, stop, step):
            out[count] = i
            count += 1
    return count


@kernel
def visited_up_to(stop, out):
    count = 0
    for i in range(stop):
        for j in range(i):
            out[count] = 10 * i + j
            count += 1
            if j == 2:
                break
    return count


@pytest.mark.parametrize("step", [1, 2, -1, -3])
@pytest.mark.parametrize("stop", [-4, 0, 1, 9])
@pytest.mark.parametrize("start", [0, 3, 9])
def test_ranges_are_those_of_python(start, stop, step):
    out = np.zeros(40, dtype=np.int64)
    count = visited(start, stop, step, out)
    assert out[:count].tolist() == list(range(start, stop, step))


@pytest.mark.parametrize("stop", [-1, 0, 1, 2, 6])
def test_loops_inside_loops_begin_again(stop):
    out = np.zeros(40, dtype=np.int64)
    count = visited_up_to(stop, out)
    expected = [10 * i + j for i in range(stop) for j in range(min(i, 3))]
    assert out[:count].tolist() == expected


@kernel
def entry(a, i, j, k):
    return a[i, j, k]


@kernel
def entry_of_row(a, i, j, k):
    return a[i][j, k] + a[i][j][k]


@kernel
def put(a, i, j, k, value):
    a[i, j, k] = value
    row = a[i]
    row[j, k] += row.shape[0] * 100.0 + row.shape[1] * 10.0 + len(a)


@pytest.mark.parametrize("dtype", [np.float64, np.int64, np.uint8, np.uint64, np.int32])
def test_entries_are_those_of_numpy(dtype):
    a = np.arange(24).astype(dtype).reshape(2, 3, 4)
    for place in np.ndindex(2, 3, 4):
        assert entry(a, *map(int, place)) == a[place]
        assert entry_of_row(a, *map(int, place)) == 2 * int(a[place])
        assert entry(a, *map(np.uint64, place)) == a[place]
        assert entry(a, *map(np.int32, place)) == a[place]


@kernel
def near_the_end(a):
    return a[-1, -3, 2] + 100 * a[-2, 1, -1] + 10000 * a[-1][1][-1]


@pytest.mark.skipif("NUMBA_BOUNDSCHECK" in os.environ, reason="literals in tuples are refused then")
def test_places_that_are_written_as_negative_numbers_count_from_the_end():
    """Those that are computed never do: kernels do not ask them."""
    a = np.arange(24).reshape(2, 3, 4)
    assert near_the_end(a) == a[-1, -3, 2] + 100 * a[-2, 1, -1] + 10000 * a[-1][1][-1]


def indices(function):
    """What a function writes between brackets, apart from slices."""
    for part in ast.walk(function):
        if isinstance(part, ast.Subscript):
            yield from part.slice.elts if isinstance(part.slice, ast.Tuple) else [part.slice]


def test_no_kernel_of_the_package_counts_from_the_end():
    """Those that are inlined cannot."""
    found = []
    for file in Path(netkf.__file__).parent.rglob("*.py"):
        for part in ast.walk(ast.parse(file.read_text())):
            marks = map(ast.unparse, getattr(part, "decorator_list", []))
            if isinstance(part, ast.FunctionDef) and any(m.startswith("kernel") for m in marks):
                signed = [i for i in indices(part) if isinstance(i, ast.UnaryOp)]
                found += [f"{file.name}: {part.name}[{ast.unparse(i)}]" for i in signed]
    assert not found


CHECKED = """
import numpy as np
from netkf.linalg.compiling import kernel
@kernel(inlined=True)
def inner(a, k):
    return a[k]
@kernel
def outer(a, k):
    return inner(a, k)
@kernel
def entry(a, k):
    return a[k]
for function in (outer, entry):
    for place in (-1, 3):
        try:
            function(np.zeros(3), place)
        except IndexError:
            print("refused")
"""


def test_kernels_look_at_bounds_where_numba_is_told_to(tmp_path):
    given = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    script = tmp_path / "checked.py"
    script.write_text(CHECKED)
    command, env = [sys.executable, str(script)], os.environ | given
    found = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["refused"] * 4


@pytest.mark.parametrize("value", [7, 7.0, True])
def test_entries_are_written_where_numpy_writes_them(value):
    a, expected = np.zeros((2, 3, 4)), np.zeros((2, 3, 4))
    put(a, 1, 2, 2, value)
    expected[1, 2, 2] = value + 342.0
    np.testing.assert_array_equal(a, expected)


@kernel
def exchange(records, i, flags):
    record = records[i]
    other = records[(i + 2) % 3]
    record.value, other.value = other.value, record.value
    record.number += records[i].number
    flags[i] = record.number > 4
    return flags[i]


def test_records_and_flags_are_written_in_place():
    records, flags = np.zeros(3, dtype=PAIR), np.zeros(3, dtype=np.bool_)
    records["number"], records["value"] = [1, 2, 3], [0.5, 1.5, 2.5]
    assert not exchange(records, 1, flags)
    assert exchange(records, 2, flags)
    assert exchange(records, 0, np.zeros(3, dtype=np.bool_)) is False
    assert records["number"].tolist() == [2, 4, 6]
    assert records["value"].tolist() == [0.5, 2.5, 1.5]


@kernel
def of_every_other(a):
    total = 0.0
    for i in range(len(a)):
        total += a[i]
    return total


def test_arrays_that_are_not_contiguous_go_to_numba():
    a = np.arange(10.0)
    assert of_every_other(a[::2]) == 20.0
    assert of_every_other(a[::-1]) == 45.0


def test_compact_kernels_compute_the_same_and_are_marked():
    def sums(x, out):
        for i in range(len(x)):
            total = 0.0
            for j in range(len(x)):
                total += x[i] * x[j]
            out[i] = total

    x, found = np.arange(1.0, 30.0), []
    for compact in (False, True):
        made = numba.njit(pipeline_class=kernel_compiler(True, compact), _nrt=False)(sums)
        found.append(np.empty_like(x))
        made(x, found[-1])
        (code,) = made.inspect_llvm().values()
        assert ("optsize" in code) == compact
    assert (found[0] == found[1]).all()
    np.testing.assert_allclose(found[0], x * x.sum(), rtol=1e-15)
