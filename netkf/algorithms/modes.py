"""Modes of a plant: coordinates in which numbers that are carried through time keep their digits.

Information about a state is predicted by the inverse transition, under which that about a decaying
mode grows without bound, until it swallows the digits of all others. Two ways out of it need the
invariant subspaces of A (or F), found here from ordered real Schur forms, without eigenvectors:
a defective or nearly defective matrix has none that are of use.

``ModeFrame`` are coordinates of belief propagation: decaying modes are referred to their value at
time 0, and growing ones to the present. ``rate_groups`` are the parts of the state that decay at
one rate, which push-sum lets fade each by its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray, cached_by_entries
from netkf.linalg.spectra import balance

MAX_PROJECTOR = 1e5
"""Largest norm of the projector on a part of the modes along the others; those that are nearer to
each other, as the two of a constant velocity that rounding has moved apart, stay in one part.
"""
ROUNDING = 1e-9
"""Rates up to this (in slots; under clocks relative to ``flow_size``) count as 0."""
SAME_RATE = 1e-6
"""Rates that differ by less, relative to ``flow_size``, are one."""


class ModeSplit(NamedTuple):
    """Coordinates ``basis`` (n, n) in which the first ``first`` modes, those with the larger rates,
    and all others are apart: ``inverse A basis = modal`` (n, n) is block diagonal.
    """

    basis: FloatArray
    inverse: FloatArray
    modal: FloatArray
    first: int


def slot_rates(F: FloatArray) -> FloatArray:
    """Return the growth log |lambda| per slot (n,) of F's modes, also finite if F is singular."""
    tiny = np.finfo(float).tiny
    return np.asarray(np.log(np.maximum(np.abs(np.linalg.eigvals(F)), tiny)))


def flow_rates(A: FloatArray) -> FloatArray:
    """Return the growth rates (n,) of the modes of A (n, n), in 1/s."""
    return np.asarray(np.linalg.eigvals(A).real)


def flow_size(A: FloatArray) -> float:
    """Return the largest entry of A (n, n) in units of states in which it is balanced, in 1/s."""
    return float(np.abs(balance(A)[0]).max(initial=0.0))


def split_modes(A: FloatArray, level: float, slotted: bool) -> ModeSplit | None:
    """Return coordinates of the modes of A (n, n) whose rates are above ``level``, and of the
    others; None if both are too close to each other (``MAX_PROJECTOR``). Rates are those of
    ``slot_rates`` if ``slotted``, else of ``flow_rates``.
    """
    n = len(A)
    # Units of states, in powers of 2, do not decide what is close.
    balanced, scaling = balance(A)
    factor, shift = (np.exp(level), 0.0) if slotted else (1.0, level)
    moved = (balanced - shift * np.eye(n)) / factor
    S, Q, k = scipy.linalg.schur(moved, sort="ouc" if slotted else "rhp")
    basis, inverse, modal = Q.copy(), Q.T.copy(), factor * S + shift * np.eye(n)
    modal[:k, k:] = 0.0
    if 0 < k < n:
        # S = [S1, S12; 0, S2] is block diagonal in [I, X; 0, I] with S1 X - X S2 = -S12.
        X = scipy.linalg.solve_sylvester(S[:k, :k], -S[k:, k:], -S[:k, k:])
        if not np.linalg.norm(X, 2) <= MAX_PROJECTOR:
            return None
        basis[:, k:] += Q[:, :k] @ X
        inverse[:k] -= X @ Q.T[k:]
    return ModeSplit(scaling[:, None] * basis, inverse / scaling, modal, int(k))


def _levels(rates: FloatArray) -> Iterator[float]:
    """Yield the rates halfway between neighbouring ``rates``, from the largest on."""
    ordered = np.unique(rates)[::-1]
    yield from (0.5 * (ordered[1:] + ordered[:-1])).tolist()


@dataclass(frozen=True, eq=False)
class ModeFrame:
    """Coordinates of a state without noise: ``x = W(t) e``, ``W(t) = basis diag(I, D(t))`` with the
    transition D(t) of the modes that do not grow. The entries of e that belong to these are
    constant, and the first ``growing`` ones grow.

    So information about e is never pulled back through what decays, a singular F included.

    basis, inverse : (n, n)
    growing        : number of the modes that grow
    back           : slots: transition (n, n) of information about e to the next slot; clocks: its
                     generator in 1/s
    forward        : likewise of W, from the right
    excess         : the largest rate of a mode on the wrong side, where modes are too close to each
                     other; else 0 or rounding
    """

    basis: FloatArray
    inverse: FloatArray
    growing: int
    back: FloatArray
    forward: FloatArray
    excess: float


@cached_by_entries(8)
def _shared_frame(A: FloatArray, slotted: bool) -> ModeFrame:
    """Return the frame of a plant with ``A`` (n, n), or F if it is ``slotted``."""
    n, rates = len(A), slot_rates(A) if slotted else flow_rates(A)
    tolerance = ROUNDING * (1.0 if slotted else flow_size(A))
    # Modes on the wrong side lose digits as fast as their rates: no such mode is best. All modes on
    # one side need no other coordinates, and are tried first among equals.
    levels = [np.inf, -np.inf, *_levels(rates)]
    excesses = [
        max(rates[rates <= level].max(initial=0.0), -rates[rates > level].min(initial=0.0))
        for level in levels
    ]
    order = np.argsort(np.where(np.array(excesses) <= tolerance, 0.0, excesses), kind="stable")
    for choice in order.tolist():
        level = levels[choice]
        split = (
            ModeSplit(np.eye(n), np.eye(n), A, 0 if level > 0.0 else n)
            if np.isinf(level)
            else split_modes(A, level, slotted)
        )
        # That of all modes on one side always exists.
        if split is not None:
            break
    assert split is not None
    basis, inverse, modal, k = split
    back, forward = (np.eye(n), np.eye(n)) if slotted else (np.zeros((n, n)), np.zeros((n, n)))
    back[:k, :k] = np.linalg.inv(modal[:k, :k]) if slotted else -modal[:k, :k]
    forward[k:, k:] = modal[k:, k:]
    return ModeFrame(basis, inverse, k, back, forward, float(excesses[choice]))


def slot_frame(F: FloatArray) -> ModeFrame:
    """Return the frame of a plant in slots with F (n, n); plants with the same share it."""
    return _shared_frame(F, True)


def flow_frame(A: FloatArray) -> ModeFrame:
    """Return the frame of a plant under clocks with A (n, n) in 1/s."""
    return _shared_frame(A, False)


def still_frame(n: int) -> ModeFrame:
    """Return the frame in which the coordinates are the n states of the present themselves."""
    eye = np.eye(n)
    return ModeFrame(eye, eye, n, eye, eye, 0.0)


class RateGroups(NamedTuple):
    """Parts of the state of a plant dx = A x dt, G groups of modes that decay at one rate each.

    rates      : (G,), in 1/s, 0 for all modes that do not decay
    projectors : (G, n, n), on each part along the others; their sum is I
    kept       : (n, n), A with each part's own decay taken out: A plus the sum of all
                 ``rates projectors``
    """

    rates: FloatArray
    projectors: FloatArray
    kept: FloatArray


@cached_by_entries(8)
def rate_groups(A: FloatArray) -> RateGroups:
    """Return the groups of modes of a plant with A (n, n) in 1/s, by their rates of decay."""
    n, rates, size = len(A), flow_rates(A), flow_size(A)
    ordered = np.sort(rates)[::-1]
    # A group's rate is that of its fastest mode, which must not grow; all that do not decay, or not
    # by more than rounding, are one group.
    found, parts, above = [], [], np.zeros((n, n))
    for faster, slower in zip(ordered[1:], ordered[:-1], strict=True):
        if faster >= -ROUNDING * size or slower - faster <= SAME_RATE * size:
            continue
        split = split_modes(A, 0.5 * (faster + slower), False)
        if split is not None:
            projector = split.basis[:, : split.first] @ split.inverse[: split.first]
            found.append(slower)
            parts.append(projector - above)
            above = projector
    found.append(ordered[-1])
    parts.append(np.eye(n) - above)
    decays = np.maximum(-np.array(found), 0.0)
    decays[decays <= ROUNDING * size] = 0.0
    projectors = np.array(parts)
    return RateGroups(decays, projectors, A + np.einsum("g,gij->ij", decays, projectors))
