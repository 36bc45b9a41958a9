"""Private names of numba make netkf faster; where they are missing it gives the same results."""

import json
import os
import subprocess
import sys
from types import FunctionType

import numba
import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary

import netkf
from netkf.linalg import linking
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import MANY
from tests.conftest import ROOT, SCENARIOS
from tests.linalg import test_compiling, test_lanes, test_structs

HIDE = {
    # What numba itself calls it still finds, in a base class.
    "linking": """
from numba.core.codegen import CodeLibrary, CPUCodeLibrary
for name in ("finalize", "_optimize_final_module", "_finalize_final_module"):
    method = vars(CPUCodeLibrary)[name]
    setattr(CodeLibrary, name, method)
    delattr(CPUCodeLibrary, name)
""",
    "options": """
from numba.core.cpu import CPUTargetOptions
from numba.core.options import DefaultOptions
del DefaultOptions._nrt, DefaultOptions.no_cfunc_wrapper
""",
    "cache": """
from numba.core.compiler import CompileResult
del CompileResult._reduce, CompileResult._rebuild
""",
}


def results():
    """Kernels that call kernels, read structs, draw and compute in lanes, and make arrays."""
    walk, out, rows = test_structs.make(), np.zeros((8, 8)), np.arange(1.0, 17.0).reshape(2, 1, 8)
    moved = test_structs.walk_on(walk, 1, 2) + test_structs.walk_on_at(walk.memory, 1, 0)
    test_lanes.compute(MANY, rows[0], rows[1], out)
    found = [moved, walk.position.sum(), walk.points["mark"].sum(), out.sum()]
    sums = test_compiling.sum_of_powers(np.ones(3)), test_compiling.copies(np.ones(3)).sum()
    return [*map(float, [*found, *sums])]


def results_of_scenarios():
    """A slot filter and a clocked one, short, by the compiled engine."""
    made = []
    for name, horizon in (("gossip_ring", 8.0), ("threshold", 2.0)):
        scenario = netkf.load(SCENARIOS / f"{name}.toml").replace({"horizon": horizon})
        run = netkf.simulate(scenario, engine="compiled")
        made += [int(run.fingerprint[:12], 16), float(np.abs(run.xhat).sum()), float(run.P.sum())]
    return made


def results_without(names, function, folder):
    code = "".join(HIDE[name] for name in names)
    code += f"import json; from tests.linalg.test_private_names import {function.__name__} as get\n"
    told = {**os.environ, "NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code + "print(json.dumps(get()))"]
    done = subprocess.run(command, check=False, env=told, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("names", [*([name] for name in HIDE), list(HIDE)], ids="-".join)
@pytest.mark.slow
def test_a_name_that_is_missing_costs_time_and_nothing_else(names, tmp_path):
    got = results_without(names, results, tmp_path)
    np.testing.assert_allclose(got, results(), rtol=1e-12)
    kept = list(tmp_path.rglob("*.nbc"))
    assert bool(kept) == ("cache" not in names)


@pytest.mark.slow
def test_scenarios_run_with_all_of_them_missing(tmp_path):
    got = results_without(list(HIDE), results_of_scenarios, tmp_path)
    np.testing.assert_allclose(got, results_of_scenarios(), rtol=1e-10)


def test_steps_of_numba_that_changed_are_left_alone_from_then_on(monkeypatch, tmp_path):
    """As where a method that is called within others takes another argument."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(linking, "_given_up", [])
    calls = []

    def changed(library):
        calls.append(library)
        raise TypeError("finalize() needs an argument more")

    monkeypatch.setattr(linking, "_finalize_without_code", changed)
    plain = CPUCodeLibrary._finalize_final_module
    for _ in range(2):
        again = FunctionType(sum_of_cubes.__code__, globals(), "sum_of_cubes")
        assert kernel(again)(np.array([1.0, 2.0])) == 9.0
        assert CPUCodeLibrary._finalize_final_module is plain
    assert len(calls) == 1
    assert linking._given_up


def sum_of_cubes(x):
    total = 0.0
    for i in range(len(x)):
        total += cube(x[i])
    return total


@kernel
def cube(x):
    return x * x * x


def test_an_error_of_a_kernel_is_no_fault_of_numba(monkeypatch):
    monkeypatch.setattr(linking, "_given_up", [])
    with pytest.raises(numba.TypingError, match="test_private_names"):
        kernel(FunctionType(wrong.__code__, globals(), "wrong"))(1.0)
    assert not linking._given_up


def wrong(x):
    return x + "word"
