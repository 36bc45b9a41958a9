"""Comparison of a user's filter with the built-in class that it derives from."""

from __future__ import annotations

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np

from netkf.algorithms.filter import STEPS
from netkf.algorithms.registry import base_filter, built_in_class, own_attributes
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.testing.small_runs import run, setups
from netkf.testing.watching import WatchedPart, fail

TOLERANCE = 1e-6
"""Largest relative difference that another order of operations may cause."""
UNEQUAL = np.array([[0.5, 0.3, 0.2], [0.2, 0.5, 0.3], [0.3, 0.2, 0.5]])
"""Weights of three nodes whose rows and columns sum to 1, and are not the same."""


class EstimateDifference(NamedTuple):
    """A difference of estimates from those of the parent.

    relative : difference divided by the size of the quantity
    quantity : "xhat" or "P"
    where    : node and time, as text
    """

    relative: float
    quantity: str
    where: str


def check_parent(watched: WatchedPart, same_as_parent: bool | None) -> None:
    """Compare a filter that overrides something with its built-in parent, in slots and under
    clocks.

    Raises AssertionError if estimates differ by more than TOLERANCE; with ``same_as_parent`` None,
    a class that defines one of the methods STEPS gets a UserWarning instead.
    """
    part = watched.part
    parent_class = built_in_class(part)
    overrides = own_attributes(part)
    if same_as_parent is False or parent_class is None or not overrides:
        return
    child, parent = watched.unchecked(), WatchedPart(base_filter(part)).unchecked()
    worst = largest_difference(child, parent)
    # Weights that are equal, or of the same matrix by rows and columns, say nothing of the order.
    if isinstance(getattr(parent.part, "weights", None), str):
        child, parent = (_with_weights(one, UNEQUAL) for one in (child, parent))
        worst = max(filter(None, (worst, largest_difference(child, parent))), default=None)
    if worst is None or worst.relative <= TOLERANCE:
        return
    _forbid_transposed(watched.name, child, parent)
    size = f"{worst.quantity} differs by {worst.relative:.3g} of its size {worst.where}"
    rule = f"must have the numbers of {parent_class.__name__}, which it derives from"
    remedy = "say same_as_parent=False if it differs by design"
    text = f"{size}; its own: {', '.join(overrides)}"
    if same_as_parent is None and set(overrides) & set(STEPS):
        message = f"{watched.name}: {rule}, or say so; {text}; {remedy}"
        warnings.warn(message, UserWarning, stacklevel=4)
        return
    fail(f"{watched.name}.{overrides[0]}", rule, text, remedy)


def _with_weights(watched: WatchedPart, weights: FloatArray) -> WatchedPart:
    changed = dataclasses.replace(watched.part, weights=weights)
    return WatchedPart(changed).unchecked()


def _forbid_transposed(name: str, child: WatchedPart, parent: WatchedPart) -> None:
    weights = getattr(parent.part, "weights", None)
    if not isinstance(weights, np.ndarray) or np.array_equal(weights, weights.T):
        return
    try:
        difference = largest_difference(child, _with_weights(parent, weights.T))
    except ScenarioError:  # columns that do not sum to 1 are no weights
        return
    if difference is not None and difference.relative <= TOLERANCE:
        rule = "must give node i's weight for node l in entry [l, i]"
        remedy = "exchange rows and columns"
        fail(f"{name}.weights", rule, "the weights that node l gives to node i", remedy)


def largest_difference(child: WatchedPart, parent: WatchedPart) -> EstimateDifference | None:
    """Return the largest relative difference of two filters' estimates, or None."""
    found: list[EstimateDifference] = []
    # Where all nodes hear the same, weights of estimates show only if these differ at first.
    spread = 1.0 if isinstance(getattr(child.part, "weights", None), np.ndarray) else 0.0
    for system, kind in setups(child.part, parent.part):
        _, own = run(child, system, kind, spread=spread)
        try:
            _, other = run(parent, system, kind, spread=spread)
        except AssertionError:
            continue  # the parent requires more than the child, such as regular covariances
        if own.xhat.shape == other.xhat.shape:
            unit = "slot" if kind.slots else "round"
            found.append(_difference("xhat", own.xhat, other.xhat, unit))
            found.append(_difference("P", own.P, other.P, unit))
    return max(found, key=lambda one: one.relative, default=None)


def _difference(quantity: str, one: FloatArray, other: FloatArray, unit: str) -> EstimateDifference:
    """Return the largest difference of estimates (T, N, ...), 0 where they are nan."""
    rest = tuple(range(2, one.ndim))
    size = 1.0 + np.abs(one).max(axis=rest) + (np.abs(other).max(axis=rest) if one.ndim < 4 else 0)
    relative = np.nan_to_num(np.abs(one - other).max(axis=rest) / size)
    k, node = np.unravel_index(int(np.argmax(relative)), relative.shape)
    return EstimateDifference(
        float(relative[k, node]), quantity, f"at node {node} after {unit} {k}"
    )
