"""Checks of functions and their Jacobians, of plants and sensors that need not be linear."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.plants.dynamics import CustomDynamics
from netkf.rng.streams import Streams
from netkf.testing.watching import demand, demand_close, guard_user_code

STATES, DERIVATIVE_STEP, DERIVATIVE_TOLERANCE = 20, 1e-3, 1e-5
"""States at which f is checked, and the step and relative error of its numerical derivatives."""


def check_dynamics(part: Any, name: str) -> None:
    """Check that f depends on x, u and t alone and has its Jacobian; raises AssertionError."""
    random = Streams(0, 0).generator("dynamics")
    f, period = part.f, getattr(part, "period", 0.0)
    if isinstance(f, CustomDynamics):
        name = f.name.rpartition(":")[2]
    spread = 1.0 + np.sqrt(np.diag(part.start_cov))
    for k in range(STATES):
        x = part.start_mean + spread * random.standard_normal(part.n)
        t = k * (period or 0.1)
        u = np.zeros(part.m) if part.input is None else part.input.at(t)
        u = u + 0.1 * random.standard_normal(part.m)
        with guard_user_code(name):
            own, slope = (lambda x, of=of: of(x, u, t, period) for of in part.functions)  # noqa: B023
            check_derivatives((name, "f", "x, u and t"), own, slope, x)
    if isinstance(f, CustomDynamics) and hasattr(f.part, "kernels") and hasattr(f.part, "f"):
        x = part.start_mean + spread
        value, J = (function(x, u, 0.0, 0.0) for function in part.functions)
        expected = np.asarray(f.part.f(x, u, 0.0))
        demand_close(value[None], expected[None], f"{name}.kernels", "must compute f")
        demand_close(J, f.part.jacobian(x, u, 0.0), f"{name}.kernels", "must compute jacobian")


def check_derivatives(
    names: tuple[str, str, str],
    function: Callable[[FloatArray], Any],
    jacobian: Callable[[FloatArray], Any],
    x: FloatArray,
    difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract,
) -> None:
    """Check that a ``function`` and its ``jacobian`` at ``x`` (n,) are finite, the same once more
    after other calls, and that one is the derivative of the other. ``names`` are those of the
    class, of the function and of what it depends on; ``difference`` subtracts two values.
    """
    name, of, arguments = names
    value, J = np.asarray(function(x.copy())), np.asarray(jacobian(x.copy()))
    function(x + 1.0)
    for again, before, method in ((function, value, of), (jacobian, J, "jacobian")):
        remedy = f"let it depend on {arguments} alone; noise is added by netkf"
        rule = f"must be the same for equal {arguments}"
        demand(np.isfinite(before).all(), f"{name}.{method}", "must be finite", before)
        demand(np.array_equal(again(x.copy()), before), f"{name}.{method}", rule, remedy=remedy)
    rule = f"must be {len(value)} x {len(x)}"
    demand(J.shape == (len(value), len(x)), f"{name}.jacobian", rule, str(J.shape))
    # Differences over two steps, of which the error is of the fourth power of the step.
    near, far = (
        np.stack([difference(*(np.asarray(function(x + s)) for s in (d, -d))) for d in steps], 1)
        for steps in (DERIVATIVE_STEP * size * np.eye(len(x)) for size in (1.0, 2.0))
    )
    error = np.abs((8.0 * near - far) / (12.0 * DERIVATIVE_STEP) - J)
    # Each value has a unit of its own; 0.01 of it allows for rounding where all derivatives are 0.
    sizes = np.abs(J).max(axis=1) + 1e-2 * np.abs(value) + np.finfo(float).tiny
    relative = error / sizes[:, None]
    i, j = np.unravel_index(int(relative.argmax()), error.shape)
    demand(
        float(relative.max()) <= DERIVATIVE_TOLERANCE,
        f"{name}.jacobian",
        f"must be the derivatives of {of}",
        f"entry [{i}, {j}] off by {error[i, j]:.2g} at x = {np.round(x, 3).tolist()}",
        f"compare it with differences of {of}",
    )
