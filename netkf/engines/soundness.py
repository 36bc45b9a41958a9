"""The test of states, estimates and covariances that ends a run as diverged, and its reasons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from netkf.core.printable import list_some
from netkf.linalg.arrays import FloatArray

BoolArray = NDArray[np.bool_]


def stack_estimates(
    pairs: Sequence[tuple[FloatArray, FloatArray | None]],
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Stack the results (xhat (n,), P (n, n) or None) of N filters: xhat (N, n), P (N, n, n), nan
    for a filter without covariance, and a mask (N,) of these filters.
    """
    xhat = np.array([mean for mean, _ in pairs])
    without = np.array([cov is None for _, cov in pairs])
    none = np.full((xhat.shape[1],) * 2, np.nan)
    return xhat, np.array([none if cov is None else cov for _, cov in pairs]), without


INDEFINITE = 1e-9
"""The tolerated negative eigenvalue, as a share of the largest; rounding errors are far smaller."""


def sound_mask(
    xhat: FloatArray,
    P: FloatArray,
    without: BoolArray | bool = False,
    error: FloatArray | None = None,
    of_roots: bool = False,
) -> BoolArray:
    """Return a mask (...) of sound pairs of ``xhat`` (..., n) and ``P`` (..., n, n).

    Both must be finite, and the covariance positive semidefinite; a filter ``without`` covariance
    (mask (...), or False for none) needs only a finite estimate. Estimates are in the plant's
    coordinates, so that they are finite only if the true state is. If the truth is known, squares
    of the ``error`` (..., n) must be finite too. A run continues while all pairs are sound.
    """
    finite = np.isfinite(xhat).all(axis=-1)
    if error is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            finite &= np.isfinite((error * error).sum(axis=-1))
    whole = np.asarray(np.isfinite(P).all(axis=(-1, -2)))
    semidefinite = of_roots or _semidefinite(np.where(whole[..., None, None], P, 0.0))
    return np.asarray(finite & ((whole & semidefinite) | np.asarray(without)))


def _semidefinite(P: FloatArray) -> BoolArray:
    # A Cholesky factor of P plus a little is much cheaper than its eigenvalues, and nearly always
    # exists.
    size = np.abs(np.diagonal(P, axis1=-2, axis2=-1)).max(axis=-1, initial=0.0)
    little = (0.5 * INDEFINITE * size + np.finfo(float).tiny)[..., None, None]
    try:
        np.linalg.cholesky(P + little * np.eye(P.shape[-1]))
    except np.linalg.LinAlgError:
        values = np.linalg.eigvalsh(P)
        return np.asarray(values[..., 0] >= -INDEFINITE * np.abs(values).max(axis=-1))
    return np.ones(P.shape[:-2], dtype=bool)


MAX_NAMED = 10
"""Nodes that a sentence names at most."""
LARGEST = "1.8e308, the largest number there is,"
LARGE, SMALL = 1e100, 1e-290
"""Sizes beyond which an estimate that is not a number is so by overflow or by underflow."""


def describe_divergence(
    nodes: Sequence[int], x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
) -> str:
    """Return what ended a run as diverged, as the subject and verb of a sentence: what passed the
    largest number, is not a number, or not positive semidefinite, at which ``nodes`` (N,).

    The others are the samples of the run, or its last one or two: true states ``x`` (T, n), nan if
    unknown, ``xhat`` (T, N, n), ``P`` (T, N, n, n), nan where a filter gives none, and ``error`` =
    x - xhat (T, N, n), possibly more precise.
    """
    known = not np.isnan(error).all()
    without = np.isnan(P[0]).all(axis=(-1, -2))
    sound = sound_mask(xhat[-1], P[-1], without, error[-1] if known else None)
    reasons: dict[str, list[int]] = {}
    truth_ends = known and not np.isfinite(x[-1]).all()
    if truth_ends:
        reasons[f"the true state passed {LARGEST}"] = []
    for k in np.flatnonzero(~sound).tolist():
        reason = _describe_break(xhat[:, k], P[:, k], without[k])
        # Estimates cannot follow a state beyond the largest number.
        if not truth_ends or "covariance" in reason:
            reasons.setdefault(reason, []).append(nodes[k])
    return " and ".join(_fill_in(reason, found) for reason, found in reasons.items())


def _describe_break(xhat: FloatArray, P: FloatArray, without: bool) -> str:
    """Return why the last estimate of a node ends a run, with {} in place of the node."""
    values = {"estimate": xhat} if without else {"covariance": P, "estimate": xhat}
    for name, samples in values.items():
        if np.isinf(samples[-1]).any():
            return f"the {name} of {{}} passed {LARGEST}"
    for name, samples in values.items():
        if np.isnan(samples[-1]).any():
            before = {name: abs(v[-2]).max() for name, v in values.items() if len(v) > 1}
            if max(before.values(), default=0.0) > LARGE:
                return f"the {name} of {{}} is not a number, after numbers beyond {LARGE:g},"
            if before.get("covariance", 1.0) < SMALL:
                return f"the {name} of {{}} is not a number, after a covariance below {SMALL:g},"
            return f"the {name} of {{}} is not a number (infinity - infinity, or 0 / 0)"
    if not without and not sound_mask(xhat[-1], P[-1]):
        return "the covariance of {} is no longer positive semidefinite"
    return f"the squared error of {{}} passed {LARGEST}"


def _fill_in(reason: str, nodes: Sequence[int]) -> str:
    return reason.format(f"node{'s' if len(nodes) > 1 else ''} {list_some(nodes, MAX_NAMED)}")
