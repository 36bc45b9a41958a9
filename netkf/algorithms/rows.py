"""Linear readings as rows, in plain Python: those of pairs of nodes, all together, their use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from netkf.algorithms.filter import PairReading
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray, block_diagonal, symmetric


class Rows(NamedTuple):
    """Readings ``z = H x + v``, cov(v) = R, of a state x (n,)."""

    z: FloatArray
    H: FloatArray
    R: FloatArray


def updated(x: FloatArray, P: FloatArray, seen: Rows) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return estimate (n,), covariance (n, n) and ``I - K H`` (n, n) of the Kalman filter after
    readings, from x (n,) and P (n, n).
    """
    H = seen.H
    K = np.linalg.solve(symmetric(H @ P @ H.T + seen.R), H @ P).T
    stays = np.eye(len(x)) - K @ H
    return x + K @ (seen.z - H @ x), symmetric(stays @ P @ stays.T + K @ seen.R @ K.T), stays


def pair_rows(
    pairs: Sequence[PairReading], x: FloatArray, others: Sequence[Place], x_other: FloatArray
) -> Iterator[Rows]:
    """Yield those ``pairs``, read by a node with the estimate x (n,), that are about blocks of
    ``others`` in the estimate x_other (n',) of another node, as readings of (x, x_other)
    linearised there.
    """
    places = {place.key: place for place in others}
    for pair in pairs:
        if (place := places.get(pair.other)) is not None:
            z, H, part = pair.H(x, x_other[place.entries])
            G = np.zeros((len(z), len(x_other)))
            G[:, place.entries] = part
            yield Rows(z, np.hstack([H, G]), pair.R)


def stacked(seen: Sequence[Rows], x: FloatArray) -> Rows:
    """Return all readings of a state like x (n,) as one."""
    z = np.concatenate([x[:0], *(z for z, _, _ in seen)])
    H = np.concatenate([np.zeros((0, len(x))), *(H for _, H, _ in seen)])
    return Rows(z, H, block_diagonal([R for _, _, R in seen]))
