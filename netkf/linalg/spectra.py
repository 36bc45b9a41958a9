"""Eigenvalues of small real matrices, and decisions about them that rounding does not make.

Whether a plant grows is the sign of a number that is often zero on paper: rotations, chains of
integrators, random walks. Its computed sign is that of a rounding error, and differs between
machines. So here an eigenvalue is on the border of stability if a change of the matrix by no more
than its rounding moves it there. The least change that makes z an eigenvalue of A has the size of
the least singular value of A - z I: the points z at which it is below a tolerance are the
pseudospectrum of A (Trefethen and Embree 2005, Spectra and Pseudospectra, chapter 2).

That holds for multiple eigenvalues too, which rounding moves much farther than simple ones: those
of a double integrator in other coordinates by 1e-8.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netkf.linalg.arrays import FloatArray, square_root

ComplexArray = NDArray[np.complex128]

ROUNDING = 32.0 * float(np.finfo(float).eps)
"""Rounding of a matrix (n, n), and of its eigenvalues as changes of the matrix, as a share of n
times its norm."""
BORDER = 1e-9
"""A spectral radius that is closer to 1 is 1, as large matrices have it to that only."""
LARGEST_POWER = 1000
"""Largest power of 2, up or down, by which balancing multiplies a component of the state."""
HIDDEN = 1e-9
"""A mode is hidden if it changes no output by more than this share of its size."""
MAX_CLUSTERED, MAX_TESTED, MAX_MULTIPLE = 32, 8, 8
"""Largest number of states for which multiple eigenvalues are looked for, number of eigenvalues of
larger matrices that are compared with a border, and largest multiplicity that is told."""


class Border(NamedTuple):
    """The border between modes that decay and modes that grow.

    A mode grows if the ``measure`` of its eigenvalue is above ``limit``; ``nearest`` is the point
    of the border that is nearest to an eigenvalue.
    """

    measure: Callable[[complex], float]
    limit: float
    nearest: Callable[[complex], complex]


RATE = Border(lambda value: value.real, 0.0, lambda value: complex(0.0, value.imag))
"""The border of ``dx = A x dt``: the imaginary axis."""
FACTOR = Border(abs, 1.0, lambda value: value / abs(value) if value else 1.0 + 0.0j)
"""The border of ``x[k+1] = F x[k]``: the unit circle."""


def eigenvalues(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues (n,) of ``A`` (n, n), a multiple one as often as it counts.

    Those that only rounding tells apart are replaced by their mean, which is accurate where they
    are not, and those that only rounding tells from 0 by 0.
    """
    return np.fromiter(_eigenvalues_to_see(A), dtype=np.complex128)


def growth_rate(A: FloatArray) -> float:
    """Return the rate, per unit of time, at which ``dx = A x dt``, A (n, n), grows in the long run:
    the largest real part of an eigenvalue, 0 if only rounding tells it from 0.
    """
    return _largest(A, RATE)


def growth_factor(F: FloatArray) -> float:
    """Return the factor by which ``x[k+1] = F x[k]``, F (n, n), grows in a step in the long run:
    the spectral radius, 1 if only rounding tells it from 1.
    """
    return _largest(F, FACTOR)


def contracts(radius: float) -> bool:
    """Return True if a spectral ``radius`` is below 1 by more than rounding: what it multiplies
    dies out. At 1, which is that of plants without damping, nothing does.
    """
    return radius < 1.0 - BORDER


def hidden_mode(A: FloatArray, C: FloatArray, border: Border | None = None) -> complex | None:
    """Return an eigenvalue of ``A`` (n, n) whose mode the outputs ``C x``, C (p, n), do not show,
    or None (test of Popov, Belevitch and Hautus). With a ``border``, RATE or FACTOR, modes that
    decay are skipped.

    Neither units of states that A couples nor those of all outputs together matter.
    """
    # States that drive no output, also by way of others: all their modes are hidden.
    silent = ~_reachable(A)[(C != 0.0).any(axis=0)].any(axis=0)
    hidden = next(_eigenvalues_to_see(A[np.ix_(silent, silent)], border), None)
    if hidden is None:
        balanced, scale = balance(A)
        # In the given units too: where A is nearly triangular, as [[1e-12, 1], [0, 1]] is, balanced
        # ones make the entries vanish that couple its blocks.
        hidden = next(
            (
                value
                for value in dict.fromkeys(_eigenvalues_to_see(A, border))
                if _hides(balanced, C * scale, value) and _hides(A, C, value)
            ),
            None,
        )
    return hidden if hidden is None or hidden.imag else hidden.real + 0.0  # -0.0 is 0


def _hides(A: FloatArray, C: FloatArray, value: complex) -> bool:
    """Return True if A - value I and C have a common null vector, but for HIDDEN."""
    size = float(np.linalg.norm(A, 2)) or 1.0
    largest = float(np.abs(C).max(initial=0.0)) or 1.0
    pencil = np.concatenate([A - value * np.eye(len(A)), C / largest * size])
    return bool(np.linalg.svd(pencil, compute_uv=False)[-1] < HIDDEN * size)


def outputs_of(information: FloatArray) -> FloatArray:
    """Return rows C (n, n) with ``C' C = information``, a semidefinite matrix (n, n) such as
    ``H' R^-1 H``: they show the same modes, and sensors of very different precision count alike.
    """
    root = square_root(information)
    size = np.abs(root).max(initial=0.0)
    # Roots of eigenvalues that are rounding of 0.
    root[:, np.abs(root).max(axis=0, initial=0.0) <= math.sqrt(ROUNDING * len(root)) * size] = 0.0
    return np.asarray(root.T)


def _largest(A: FloatArray, border: Border) -> float:
    """Return the largest measure of an eigenvalue, the limit for those at the ``border``."""
    largest = -math.inf if len(A) else 0.0
    for block in _irreducible_blocks(A):
        values = sorted(_block_eigenvalues(block).tolist(), key=border.measure, reverse=True)
        # The first that is not on the border decides, and those of large matrices cost time.
        for value in values if len(A) <= MAX_CLUSTERED else values[:MAX_TESTED]:
            if border.measure(value) <= largest:
                break
            on_border = _joined(block, value, border.nearest(value))
            largest = max(largest, border.limit if on_border else border.measure(value))
    return largest


def _eigenvalues_to_see(A: FloatArray, border: Border | None = None) -> Iterator[complex]:
    """Yield the eigenvalues of A (n, n), with a border those whose modes do not decay."""
    for block in _irreducible_blocks(A):
        for value in _block_eigenvalues(block).tolist():
            if (
                border is None
                or border.measure(value) > border.limit
                or _joined(block, value, border.nearest(value))
            ):
                yield value


def balanced_norm(A: FloatArray) -> float:
    """Return the largest 1-norm of the balanced diagonal blocks of A (n, n): with at most n more
    terms than a number of this size, the power series of exp(A) is as accurate in each entry.
    """
    return max((float(np.abs(b).sum(axis=0).max()) for b in _irreducible_blocks(A)), default=0.0)


def _irreducible_blocks(A: FloatArray) -> Iterator[FloatArray]:
    """Yield the balanced diagonal blocks of A (n, n) in block triangular form."""
    reaches = _reachable(A)
    first = np.argmax(reaches & reaches.T, axis=1) if len(A) else np.zeros(0, dtype=int)
    for k in np.unique(first):
        group = np.flatnonzero(first == k)
        yield balance(A[np.ix_(group, group)])[0]


def _reachable(A: FloatArray) -> np.ndarray:
    """Return a mask (n, n): whether a path of entries of A other than 0 leads from i to j."""
    reaches, before = (A != 0.0) | np.eye(len(A), dtype=bool), 0
    while (count := np.count_nonzero(reaches)) > before:
        # Products of numbers are far quicker than those of truth values, and exact here.
        reaches = reaches.astype(np.float32) @ reaches.astype(np.float32) > 0.0
        before = int(count)
    return np.asarray(reaches)


def _block_eigenvalues(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues (n,) of A (n, n), balanced and not block triangular."""
    if len(A) == 1:
        return np.asarray(A[0], dtype=np.complex128)
    values = np.linalg.eigvals(A).astype(complex)
    if len(A) > MAX_CLUSTERED:
        return values
    group = np.arange(len(values))
    for i in range(len(values)):
        for j in range(i):
            if group[i] != group[j] and _joined(A, values[i], values[j]):
                group[group == group[i]] = group[j]
    for k in np.unique(group):
        mean = complex(values[group == k].mean())
        values[group == k] = 0.0 if _joined(A, mean, 0.0) else mean
    return values


def _joined(A: FloatArray, value: complex, other: complex) -> bool:
    """Return True if rounding of A (n, n) may move the eigenvalue ``value`` to ``other``."""
    n, size = len(A), float(np.linalg.norm(A))
    tolerance = ROUNDING * n * size
    # No change of that size moves an eigenvalue farther (Elsner 1985).
    reach = 2.0 * size * (ROUNDING * n) ** (1.0 / min(n, MAX_MULTIPLE))
    if abs(value - other) > reach:
        return False
    for share in (0.5, 1.0, 0.75, 0.25):
        shifted = A - (value + share * (other - value)) * np.eye(n)
        # The other end may be an eigenvalue as inaccurate as this one.
        if np.linalg.svd(shifted, compute_uv=False)[-1] > tolerance:
            return False
    return True


def balance(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``D^-1 A D`` of A (n, n), whose rows and columns have about the same norms, and D (n,)
    of powers of 2 (James, Langou and Lowery 2014, On matrix balancing and eigenvector computation,
    algorithm 3). LAPACK's gebal finds the same; importing scipy's for it takes half as long as
    importing numpy and pandas.
    """
    balanced, scale, changed = np.array(A, dtype=np.float64), np.ones(len(A)), True
    while changed:
        changed = False
        for i in range(len(A)):
            column = math.hypot(*balanced[:, i].tolist())
            row = math.hypot(*balanced[i].tolist())
            if not (0.0 < column < math.inf and 0.0 < row < math.inf):
                continue
            # The power of 2 that brings both norms closest to each other, but for a scale beyond
            # the range of numbers, to which one small entry on the diagonal can lead.
            power = min(max(round(0.5 * (math.log2(row) - math.log2(column))), -500), 500)
            done = math.log2(scale[i])
            factor = 2.0 ** min(max(power, -LARGEST_POWER - done), LARGEST_POWER - done)
            if column * factor + row / factor < 0.95 * (column + row):
                changed = True
                scale[i] *= factor
                balanced[:, i] *= factor
                balanced[i] /= factor
    return balanced, scale
