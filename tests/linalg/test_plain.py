"""Kernels as plain Python compute what compiled ones compute."""

import math
import os
import subprocess
import sys
from math import exp
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest

from netkf.linalg import structs
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import plain_functions
from netkf.linalg.plain import is_plain, plain_kernel
from netkf.linalg.vector_functions import VectorFunction
from netkf.linalg.words import high_word

HERE = Path(__file__).parent
COMPILED = pytest.mark.skipif(is_plain(), reason="compares plain kernels with compiled ones")
ODD = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1e200, -1e200, 1000.0, math.inf, -math.inf, math.nan]


def both(function):
    """The same function as a compiled kernel and as a plain one."""
    copy = FunctionType(function.__code__, dict(function.__globals__), function.__name__)
    return kernel(function), plain_kernel(copy)


def quotients(x, y):
    return x / y, (x - x) / y, x * x / (y * y), math.inf / y, 1.0 / (x + y)


def functions(x, y):
    root, power, logarithm = math.sqrt(x), exp(x), math.log(y)
    return root, power, logarithm, math.log1p(x), math.copysign(x, y), math.tanh(x), np.sqrt(y)


def words(x, y):
    product = np.uint64(x) * np.uint64(y) + np.uint64(x)
    return (
        product,
        product >> np.uint64(3),
        high_word(product, np.uint64(y)),
        product < np.uint64(x),
    )


@COMPILED
@pytest.mark.parametrize("function", [quotients, functions])
def test_plain_numbers_are_those_of_ieee_754(function):
    compiled, plain = both(function)
    for x in ODD:
        for y in ODD:
            expected = compiled(x, y)
            got = plain(x, y)
            np.testing.assert_allclose(got, expected, rtol=1e-15, atol=0.0)
            assert [math.copysign(1.0, a) for a in got if a == 0.0] == [
                math.copysign(1.0, b) for b in expected if b == 0.0
            ]
            assert {type(number) for number in got} == {float}


@COMPILED
def test_plain_words_wrap_around():
    compiled, plain = both(words)
    for pair in [(2**63 + 12345, 2**62 + 99), (1, 2), (2**64 - 1, 2**64 - 1)]:
        pair_of_words = [np.uint64(word) for word in pair]
        assert plain(*pair_of_words) == compiled(*pair_of_words)
    assert plain(np.uint64(3), np.uint64(5)) == (18, 2, 0, False)


def test_a_plain_kernel_leaves_the_rest_of_its_module_alone():
    _, plain = both(functions)
    assert plain(-1.0, 1.0)[0] != plain(-1.0, 1.0)[0]
    with pytest.raises(ValueError, match=r"math domain|nonnegative"):
        math.sqrt(-1.0)
    with pytest.warns(RuntimeWarning, match="divide by zero"):
        np.float64(1.0) / np.float64(0.0)
    with pytest.raises(OverflowError):
        exp(1000.0)


def test_errors_of_plain_kernels_come_through_and_leave_nothing():
    plain = plain_kernel(lambda x: x[3] / 0.0)
    for _ in range(2):
        with pytest.raises(IndexError):
            plain(np.ones(3))
    assert plain(np.ones(4)) == math.inf


def test_a_struct_is_found_by_its_memory():
    class Pair(structs.Struct):
        a: np.ndarray
        b: float

    class Both(structs.Struct):
        size: structs.Size
        pair: Pair
        points: np.ndarray

    pair = Pair(a=np.array([1.0, 2.0]), b=2.0)
    assert structs.struct_at(pair.memory, Pair) is pair
    points = np.zeros((2, 1), dtype=[("mark", np.int64)])
    both = Both.of_size(3)(size=(0, 0, 0), pair=pair, points=points)
    # The words say it all.
    copy = structs.struct_at(both.memory.copy(), type(both))
    assert copy is not both
    copy.pair.a[1] += 1.0
    copy.points[1, 0].mark = 7
    assert (pair.a.tolist(), points["mark"].tolist()) == ([1.0, 3.0], [[0], [7]])
    assert (copy.pair.b, len(copy.size), copy.points.shape) == (2.0, 3, (2, 1))


@COMPILED
def test_lanes_structs_and_small_matrices_pass_their_tests_as_plain_python():
    files = [HERE / f"test_{name}.py" for name in ("lanes", "structs", "local", "small", "series")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *map(str, files)]
    told = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, check=False, env=told, capture_output=True, cwd=HERE.parents[1])
    assert done.returncode == 0, done.stdout.decode()
    assert b" passed" in done.stdout


def test_plain_functions_take_the_first_numbers_of_arrays(monkeypatch):
    """As compiled ones do at an address: tables have room for the rows of all sensors."""
    monkeypatch.setattr("netkf.linalg.vector_functions.is_plain", lambda: True)
    double = VectorFunction(lambda x, u, t: 2.0 * x, ((2,), (0,), (2,)), is_kernel=False)
    out = np.zeros(4)
    plain_functions[double.address](np.arange(3.0), np.zeros(0), 0.0, 0.0, out)
    assert out.tolist() == [0.0, 2.0, 0.0, 0.0]
