"""Checks of the states of a filter and of the estimates computed from them."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.testing.watching import WatchedPart, collect_leaves, demand, differing_path

# Relative to the largest entry of P: thousands of times the rounding error.
SYMMETRY_TOLERANCE, EIGENVALUE_TOLERANCE = 1e-9, 1e-9


def check_estimate(
    watched: WatchedPart, state: Any, n: int, after: str
) -> tuple[FloatArray, FloatArray | None]:
    """Return ``estimate(state)``: xhat (n,), and P (n, n) or None.

    Raises AssertionError unless both have these shapes and are finite, and P is symmetric and
    positive semidefinite. ``after`` is the method that returned the state, for messages.
    """
    where = f"{watched.name}.estimate after {after}"
    pair = watched.call("estimate", state)
    demand(isinstance(pair, tuple) and len(pair) == 2, where, "must be (xhat, P)", pair)
    xhat = np.asarray(pair[0])
    _check_array(where, "xhat", xhat, (n,))
    if pair[1] is None:
        return xhat, None
    P = np.asarray(pair[1])
    _check_array(where, "P", P, (n, n))
    _check_covariance(where, P)
    return xhat, P


def _check_array(where: str, name: str, array: Any, shape: tuple[int, ...]) -> None:
    demand(array.shape == shape, where, f"{name} must have the shape {shape}", str(array.shape))
    demand(array.dtype == np.float64, where, f"{name} must be float64", str(array.dtype))
    remedy = "return None where the filter has no P" if name == "P" else ""
    demand(np.isfinite(array).all(), where, f"{name} must be finite", array, remedy)


def _check_covariance(where: str, P: FloatArray) -> None:
    size = max(float(np.abs(P).max()), np.finfo(float).tiny)
    asymmetry = float(np.abs(P - P.T).max())
    rule, got = "P must be symmetric", f"P - P' of up to {asymmetry:.3g}"
    demand(asymmetry <= SYMMETRY_TOLERANCE * size, where, rule, got, "return 0.5 * (P + P.T)")
    smallest = float(np.linalg.eigvalsh(P)[0])
    rule = "P must be positive semidefinite"
    got = f"least eigenvalue {smallest:.4g}"
    remedy = "look for a sign, or for weights that sum to more than 1"
    demand(smallest >= -EIGENVALUE_TOLERANCE * size, where, rule, got, remedy)


def check_state_pickles(watched: WatchedPart, state: Any) -> None:
    """Check that a node's ``state`` of a user's filter can be pickled, as for worker processes, and
    that the copy gives the same estimate.
    """
    where = f"{watched.name}.init"
    try:
        copy = pickle.loads(pickle.dumps(state))
    except Exception as error:
        raise AssertionError(
            f"{where}: states must be picklable; got {type(error).__name__}: {error}; make the "
            "state a NamedTuple of arrays at the top level of a module"
        ) from error
    one, other = (collect_leaves(watched.part.estimate(s)) for s in (state, copy))
    demand(differing_path(one, other) is None, where, "states must be equal after pickling")
