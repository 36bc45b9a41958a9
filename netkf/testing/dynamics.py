"""Checks of f and its Jacobian, of plants that need not be linear."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.vector_functions import VectorFunction
from netkf.plants.dynamics import CustomDynamics
from netkf.rng.streams import Streams
from netkf.testing.watching import demand, demand_close, guard_user_code

STATES, DERIVATIVE_STEP, DERIVATIVE_TOLERANCE = 20, 1e-3, 1e-5
"""States at which f is checked, and the step and relative error of its numerical derivatives."""


def check_dynamics(part: Any, name: str) -> None:
    """Check that f depends on x, u and t alone and has its Jacobian; raises AssertionError."""
    random = Streams(0, 0).generator("dynamics")
    n, f = part.n, part.f
    if isinstance(f, CustomDynamics):
        name = f.name.rpartition(":")[2]
    spread = 1.0 + np.sqrt(np.diag(part.start_cov))
    for k in range(STATES):
        x = part.start_mean + spread * random.standard_normal(n)
        t = k * getattr(part, "period", 0.1)
        u = np.zeros(part.m) if part.input is None else part.input.at(t)
        with guard_user_code(name):
            _check_at(part, name, x, u + 0.1 * random.standard_normal(part.m), t)
    if isinstance(f, CustomDynamics) and hasattr(f.part, "kernels") and hasattr(f.part, "f"):
        x = part.start_mean + spread
        value, J = (function(x, u, 0.0, 0.0) for function in part.functions)
        demand_close(value, f.part.f(x, u, 0.0), f"{name}.kernels", "must compute f", "")
        demand_close(J, f.part.jacobian(x, u, 0.0), f"{name}.kernels", "must compute jacobian", "")


def _call(function: VectorFunction, others: tuple[Any, ...], x: FloatArray) -> FloatArray:
    return function(x, *others)


def _check_at(part: Any, name: str, x: FloatArray, u: FloatArray, t: float) -> None:
    period = getattr(part, "period", 0.0)
    f, jacobian = (partial(_call, function, (u, t, period)) for function in part.functions)
    value, J = f(x), jacobian(x)
    f(x + 1.0)
    for of, before, method in ((f, value, "f"), (jacobian, J, "jacobian")):
        remedy = "let it depend on x, u and t alone; noise is added by netkf"
        rule = "must be the same for equal x, u and t"
        demand(np.array_equal(of(x), before), f"{name}.{method}", rule, remedy=remedy)
        demand(np.isfinite(before).all(), f"{name}.{method}", "must be finite", before)
    # Differences over two steps, of which the error is of the fourth power of the step.
    steps = [size * DERIVATIVE_STEP * np.eye(len(x)) for size in (1.0, 2.0)]
    near, far = (np.stack([f(x + d) - f(x - d) for d in step], axis=1) for step in steps)
    error = np.abs((8.0 * near - far) / (12.0 * DERIVATIVE_STEP) - J)
    i, j = np.unravel_index(int(error.argmax()), error.shape)
    demand(
        float(error.max()) <= DERIVATIVE_TOLERANCE * (1.0 + float(np.abs(J).max())),
        f"{name}.jacobian",
        "must be the derivatives of f",
        f"entry [{i}, {j}] off by {error.max():.2g} at x = {np.round(x, 3).tolist()}",
        "compare it with differences of f",
    )
