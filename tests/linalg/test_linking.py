"""Inner functions are linked into the outermost one; nothing of numba stays changed."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary

from netkf.linalg import linking
from netkf.linalg.compiling import kernel
from netkf.linalg.linking import linked_once


def outer_function():
    @numba.njit
    def inner(x):
        return 2.0 * x.sum()

    @numba.njit
    def outer(x):
        return inner(x) + np.sqrt(x[0])

    return outer


@pytest.mark.parametrize("known", [True, False])
def test_a_function_gives_what_it_gives_otherwise(monkeypatch, known):
    """Also with a numba that has other names."""
    if not known:
        monkeypatch.setattr(linking, "_patches", lambda: numba.core.no_such_name)
    patched = linking._patches() if known else []
    before = [owner.__dict__[name] for owner, name, _ in patched]
    optimised, x = [], np.array([4.0, 1.0])
    plain = CPUCodeLibrary._optimize_final_module
    monkeypatch.setattr(
        CPUCodeLibrary,
        "_optimize_final_module",
        lambda library: (optimised.append(library.name), plain(library))[1],
    )
    outer = outer_function()
    with linked_once():
        assert outer(x) == 12.0
    assert (len([name for name in optimised if "inner" in name]) == 0) == known
    monkeypatch.undo()
    assert [owner.__dict__[name] for owner, name, _ in patched] == before
    assert outer_function()(x) == 12.0


def test_what_numba_itself_defines_serves_later_functions_too():
    """Whatever called it first, and in whichever thread."""
    x = np.array([4.0, 1.0])
    with linked_once():
        assert numba.njit(lambda x: np.prod(x) + np.cumsum(x)[-1])(x) == 9.0
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(in_one_piece, x).result() == 10.0
    assert numba.njit(lambda x: 3.0 + np.prod(x) + np.cumsum(x)[-1])(x) == 12.0


def in_one_piece(x):
    with linked_once():
        return numba.njit(lambda x: 1.0 + np.prod(x) + np.cumsum(x)[-1])(x)


def test_calls_that_take_no_known_type_are_refused_as_ever():
    """What is remembered of calls is what was found, and not what was refused."""

    @numba.njit
    def refused(x):
        return x + "a"

    for _ in range(2):
        with linked_once(), pytest.raises(numba.TypingError):
            refused(np.ones(2))


@kernel
def near_the_end(a, k):
    return a[-1, -3, 2] + 100 * a[-2, 1, -1] + 10000 * a[k][1][-1]


def test_places_that_are_written_as_negative_numbers_count_from_the_end():
    """Those that are computed never do: kernels do not ask them."""
    a = np.arange(24).reshape(2, 3, 4)
    assert near_the_end(a, 1) == a[-1, -3, 2] + 100 * a[-2, 1, -1] + 10000 * a[1][1][-1]


CHECKED = """
import numpy as np
from netkf.linalg.compiling import kernel
@kernel(inlined=True)
def inner(a, k):
    return a[k]
@kernel
def outer(a, k):
    return inner(a, k)
for place in (-1, 3):
    try:
        outer(np.zeros(3), place)
    except IndexError:
        print("refused")
"""


def test_kernels_look_at_bounds_where_numba_is_told_to(tmp_path):
    given = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    script = tmp_path / "checked.py"
    script.write_text(CHECKED)
    command, env = [sys.executable, str(script)], os.environ | given
    found = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["refused"] * 2
