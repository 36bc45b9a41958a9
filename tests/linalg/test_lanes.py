"""Values of lanes in kernels against numpy, for one lane and for several."""

import math

import numpy as np
import pytest

from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    MANY,
    ONE,
    aligned,
    any_lane,
    by_run,
    gather,
    in_lanes,
    load,
    load_flags,
    magnitude,
    prefetch,
    root_of,
    scatter,
    select,
    spread,
    store,
    store_flags,
    turn,
    with_sign,
    with_spare,
)
from netkf.linalg.plain import is_plain

SIZES = pytest.mark.parametrize("lanes", [ONE, MANY], ids=["one", "many"])


@kernel
def compute(lanes, a, b, out):
    """Every operation once, a row of ``out`` each."""
    x, y = load(lanes, a, 0), load(lanes, b, 0)
    store(lanes, out, 0, x + y * 2.0 - 1)
    store(lanes, out, 1, x / y - (-x))
    store(lanes, out, 2, root_of(magnitude(x)))
    store(lanes, out, 3, with_sign(y, x))
    store(lanes, out, 4, select(x > y, x, 7.0))
    store(lanes, out, 5, select((x < y) | (x == y), spread(lanes, 1.0), 0.0))
    store(lanes, out, 6, select((x >= 0.0) & (y != 1.0), y, x))
    total = spread(lanes, 1.0)
    total += x
    total *= y
    total -= 3.0
    total /= 2.0
    store(lanes, out, 7, total)


@SIZES
def test_operations_are_those_of_numbers(lanes):
    random = np.random.default_rng(1)
    for _ in range(20):
        a, b = random.normal(size=(2, 1, len(lanes)))
        if random.random() < 0.3:
            b[:] = a
        out = aligned((8, len(lanes)))
        compute(lanes, a, b, out)
        x, y = a[0], b[0]
        expected = [
            x + y * 2.0 - 1,
            x / y - (-x),
            np.sqrt(np.abs(x)),
            np.copysign(y, x),
            np.where(x > y, x, 7.0),
            np.where(x <= y, 1.0, 0.0),
            np.where((x >= 0.0) & (y != 1.0), y, x),
            ((1.0 + x) * y - 3.0) / 2.0,
        ]
        np.testing.assert_array_equal(out, expected)


@kernel
def exceed(lanes, a, bound, flags):
    """Flag the entries above ``bound``; return True if there are any and they are read back."""
    above = load(lanes, a, 0) > bound
    store_flags(lanes, flags, 0, above)
    return any_lane(above) and any_lane(load_flags(lanes, flags, 0))


@SIZES
def test_flags_are_kept_as_bytes(lanes):
    values = np.arange(len(lanes), dtype=float)[None]
    flags = np.full((1, len(lanes)), 9, dtype=np.uint8)
    assert not exceed(lanes, values, float(len(lanes)), flags)
    assert not flags.any()
    assert exceed(lanes, values, len(lanes) - 1.5, flags)
    np.testing.assert_array_equal(flags[0], values[0] > len(lanes) - 1.5)


@SIZES
def test_comparisons_with_nan_are_false(lanes):
    flags = np.ones((1, len(lanes)), dtype=np.uint8)
    assert not exceed(lanes, np.full((1, len(lanes)), np.nan), 0.0, flags)


@kernel
def sum_and_first(lanes, a, out):
    """Values do not change when others that were equal do."""
    first = total = load(lanes, a, 0)
    total += 1.0
    total *= 2.0
    store(lanes, out, 0, total)
    store(lanes, out, 1, first)


@SIZES
def test_a_value_never_changes(lanes):
    a, out = np.arange(1.0, 1.0 + len(lanes))[None], aligned((2, len(lanes)))
    sum_and_first(lanes, a, out)
    np.testing.assert_array_equal(out, [2.0 * a[0] + 2.0, a[0]])
    np.testing.assert_array_equal(a[0], np.arange(1.0, 1.0 + len(lanes)))


def test_runs_are_laid_out_by_blocks():
    laid = in_lanes(np.arange(6.0).reshape(2, 3), 2)
    assert laid.shape == (2, 2, 3, LANES)
    assert laid.ctypes.data % 64 == 0
    laid[1, 0, 0, 2] = 50.0
    runs = by_run(laid, LANES + 3)
    assert runs.shape == (LANES + 3, 2, 3)
    assert runs[LANES + 2, 0, 0] == 50.0
    assert (runs[:, 1, 2] == 5.0).all()


@kernel
def move_rows(array, places, entries, lanes, rows, out, turned):
    """Gather rows into lanes, scatter them into ``out``, and turn ``rows``."""
    for first in range(0, entries, 8):
        gather(MANY, array, places, first, lanes)
    for first in range(0, entries, 8):
        scatter(MANY, lanes, first, out, places, entries - first)
    for first in range(0, rows.shape[1], 8):
        turn(MANY, rows, first, turned)


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 2), (7,), (3, 3), (4, 4), (5, 5)])
def test_rows_go_into_lanes_and_back(shape):
    random, entries = np.random.default_rng(3), math.prod(shape)
    array, out, lanes = with_spare((20, *shape)), with_spare((20, *shape)), with_spare((entries, 8))
    array[:], out[:] = random.normal(size=array.shape), 7.0
    places = random.permutation(20)[:8]
    places[3] = -1
    rows, turned = random.normal(size=(8, 16)), np.empty((16, 8))
    move_rows(array, places, entries, lanes, rows, out, turned)
    known = places[places >= 0]
    np.testing.assert_array_equal(lanes[:, places >= 0], array.reshape(20, -1)[known].T)
    expected = np.full(array.shape, 7.0)
    expected[known] = array[known]
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(turned, rows.T)


@kernel
def add_while_fetching(rows, out):
    """Sums of rows, each asked for while the one before is added up; the last asks for none."""
    for i in range(len(rows)):
        prefetch(rows, i + 1)
        out[i] = 0.0
        for j in range(rows.shape[1]):
            out[i] += rows[i, j]


def test_asking_for_memory_changes_nothing():
    rows, out = np.random.default_rng(6).normal(size=(40, 300)), np.empty(40)
    kept = rows.copy()
    add_while_fetching(rows, out)
    np.testing.assert_allclose(out, kept.sum(axis=1), rtol=1e-12)
    np.testing.assert_equal(rows, kept)


@pytest.mark.skipif(is_plain(), reason="looks at compiled code")
def test_memory_is_asked_for():
    rows, out = np.ones((2, 3)), np.empty(2)
    # The code of functions that were read from disk cannot be looked at.
    compiled = add_while_fetching._kernel_dispatcher
    compiled(rows, out)
    (code,) = compiled.inspect_llvm().values()
    assert "call void @llvm.prefetch" in code
