"""Kernels by address: called from kernels and from Python, they are the kernels."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from netkf.linalg.addresses import (
    address_of,
    any_struct,
    call_at,
    call_at_two,
    call_kernel,
    number_at,
    reads_only,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size, Struct, sized


class Tank(Struct):
    level: FloatArray


class Flow(Struct):
    rate: float
    size: Size
    calls: int


@kernel
def fill(tank, h, flow):
    for _ in range(len(flow.size)):
        tank.level[h] += flow.rate
    flow.calls += 1


@kernel
def pour(tank, h, m, flow):
    tank.level[m] += tank.level[h]
    tank.level[h] = 0.0


@kernel
def height(tank, h, flow):
    return tank.level[h] / flow.rate


@kernel
def work(addresses, tank, flow):
    call_at(addresses[0], tank, 1, flow)
    call_at_two(addresses[1], tank, 1, 2, flow)
    return number_at(addresses[2], tank, 2, flow) + len(flow.size)


def flow_of(n):
    cls = Flow.of_size(n) if isinstance(sized(n), tuple) else Flow
    return cls(rate=0.5, size=sized(n), calls=0)


def addresses_of(tank, flow):
    return np.array(
        [
            address_of(fill, tank, flow),
            address_of(pour, tank, flow, 2),
            address_of(height, tank, flow, number=True),
        ]
    )


# A size of 3 is part of the type, one of 7 is not: the loop is compiled for structs of any size.
@pytest.mark.parametrize("n", [7, 3, 2])
def test_kernels_and_python_call_them(n):
    tank, flow = Tank(level=np.zeros(3)), flow_of(n)
    assert work(addresses_of(tank, flow), any_struct(tank), flow.general) == n + n
    assert tank.level.tolist() == [0.0, 0.0, 0.5 * n]
    call_kernel(fill, tank, 0, run=flow)
    call_kernel(pour, tank, 0, 1, run=flow)
    assert tank.level.tolist() == [0.0, 0.5 * n, 0.5 * n]
    assert call_kernel(height, tank, 1, run=flow, number=True) == n
    assert flow.calls == 2
    # Python's later changes are seen.
    tank.level = np.array([1.0, 2.0, 3.0, 4.0])
    flow.rate = 2.0
    assert call_kernel(height, tank, 3, run=flow, number=True) == 2.0


def test_one_loop_serves_records_of_all_kinds():
    class Other(Struct):
        spare: int
        level: FloatArray

    tank, other, flow = Tank(level=np.zeros(3)), Other(spare=0, level=np.zeros(3)), flow_of(2)
    for record in (tank, other):
        work(addresses_of(record, flow), any_struct(record), flow.general)
        assert record.level.tolist() == [0.0, 0.0, 1.0]
    assert address_of(fill, tank, flow) != address_of(fill, other, flow)
    assert address_of(fill, tank, flow) == address_of(fill, Tank(level=np.zeros(1)), flow)


def test_what_reads_the_first_fields_is_compiled_once_for_all_records():
    class More(Struct):
        level: FloatArray
        spare: FloatArray

    class Elsewhere(Struct):
        spare: FloatArray
        level: FloatArray

    @kernel
    def drain(tank, h, flow):
        tank.level[h] -= flow.rate

    reads_only(Tank, drain)
    flow, x = flow_of(2), np.zeros
    tanks = Tank(level=x(3)), More(level=x(3), spare=x(1)), Elsewhere(spare=x(1), level=x(3))
    for tank in tanks:
        call_kernel(drain, tank, 1, run=flow)
        assert tank.level.tolist() == [0.0, -0.5, 0.0]
    first, second, third = (address_of(drain, tank, flow) for tank in tanks)
    assert first == second != third


SCRIPT = """
import json
import numpy as np
from tests.linalg.test_addresses import *
{change}
tank, flow = Tank(level=np.zeros(3)), flow_of(3)
first = work(addresses_of(tank, flow), any_struct(tank), flow.general)
call_kernel(fill, tank, 0, run=flow)
print(json.dumps([first, *tank.level.tolist()]))
"""
WITHOUT = """
import numba.experimental.function_type
from numba.core import ccallback
hidden = ccallback.CFunc
del ccallback.CFunc
def compiled(function):
    function.compile()
    return function
numba.cfunc = lambda sig, **options: lambda loops: compiled(
    hidden(loops, (sig.args, sig.return_type), {}, options)
)
"""


@pytest.mark.parametrize(("change", "variables"), [(WITHOUT, {}), ("", {"NUMBA_DISABLE_JIT": "1"})])
def test_nothing_private_is_needed(change, variables, tmp_path):
    """Neither numba's class of C functions where it is, besides ``numba.cfunc``, nor numba."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), **variables}
    command = [sys.executable, "-c", SCRIPT.format(change=change)]
    made = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    assert json.loads(made.stdout) == [6.0, 1.5, 0.0, 1.5]
