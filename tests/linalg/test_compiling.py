"""Kernels: called alike from Python and from kernels, compiled once for given types."""

import pickle
import re
import stat

import llvmlite.binding
import numba
import numpy as np
import pytest

from netkf.linalg import compiling
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import sized


@kernel
def power(base, exponent, scale=1.0):
    """Return scale * base^exponent for whole exponents."""
    result = scale
    for _ in range(exponent):
        result *= base
    return result


@kernel
def sum_of_powers(values):
    """Return the sum of squares and of half the cubes."""
    total = 0.0
    for i in range(len(values)):
        total += power(values[i], 2) + power(values[i], 3, scale=0.5)
    return total


@kernel(allocates=True)
def copies(values):
    """Return the values twice."""
    made = np.empty(2 * len(values))
    for i in range(len(made)):
        made[i] = values[i % len(values)]
    return made


def test_python_and_kernels_call_a_kernel_alike():
    values = np.array([1.0, 2.0, -3.0])
    assert power(2.0, 3) == 8.0
    assert power(2.0, exponent=2, scale=0.5) == 2.0
    assert sum_of_powers(values) == pytest.approx((values**2 + 0.5 * values**3).sum(), rel=1e-15)
    assert list(copies(values)) == [*values, *values]


def test_a_kernel_is_compiled_once_for_all_constants(monkeypatch, tmp_path):
    # What is loaded from the disk has no signatures here.
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel(sum_of_powers.loops)(np.ones(2))
    signatures = power._kernel_dispatcher.signatures
    # One without ``scale`` and one with it: the constants 2 and 3 are no types.
    assert len(signatures) == 2
    assert len({args[:2] for args in signatures}) == 1


def cholesky(size, matrix):
    """Make a matrix its lower triangular root."""
    n = len(size)
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
        matrix[j, j] = np.sqrt(matrix[j, j])
        for i in range(j + 1, n):
            matrix[i, j] /= matrix[j, j]


def test_loops_over_few_states_are_unrolled_and_numba_works_on_as_before(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    given, set_option = [], llvmlite.binding.set_option
    monkeypatch.setattr(
        llvmlite.binding, "set_option", lambda *told: given.append(told) or set_option(*told)
    )
    matrix = np.eye(4) + 1.0
    expected, root = np.linalg.cholesky(matrix), kernel(cholesky)
    root(sized(4), matrix)
    np.testing.assert_allclose(np.tril(matrix), expected, rtol=1e-14)
    (made,) = root._python_dispatcher.overloads.values()
    # The function is the first one, before its wrapper for Python.
    code = made.library.get_llvm_str().split("\n}")[0]
    # A root for each state, and no loop is left.
    assert len(re.findall(r"call double @(?:llvm\.)?sqrt", code)) == 4
    assert " phi " not in code
    # At numba's own level 3 LLVM unrolls up to 300 instructions.
    assert given[-1] == ("netkf", "-unroll-threshold=300")


def test_kernels_are_found_by_name():
    assert pickle.loads(pickle.dumps(power)) is power
    assert power.__name__ == "power"
    assert power.__doc__.startswith("Return scale")


def test_compiled_code_is_kept_where_it_can_be_written_or_by_the_process_alone(
    tmp_path, monkeypatch
):
    file = tmp_path / "file"
    file.touch()
    find = compiling._first_writable
    assert find(str(tmp_path / "mine"), tmp_path) == tmp_path / "mine"
    assert find("", tmp_path) == tmp_path / "__pycache__"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert find("", file) == tmp_path / "cache" / "netkf"
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    for chosen in (str(file), str(file / "in"), "a\0b", ""):
        own = find(chosen, file)
        assert stat.S_IMODE(own.stat().st_mode) == 0o700
        assert not any(own.iterdir())
