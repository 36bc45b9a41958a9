"""Inner functions are linked into the outermost one; nothing of numba stays changed."""

import numba
import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary

from netkf.linalg import linking
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
