"""What the filters in slots do with the slots that were made: one compiled function for each.

All of them go through ``kind, number, first, after`` as exchanges.Slots has them and leave what a
sample shows in ``shown``. Payloads are what nodes had when the exchange began.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.diffusion import shares
from netkf.algorithms.kernels.intersection import intersected
from netkf.algorithms.kernels.square_root import predict_root
from netkf.algorithms.push_sum import MASS, corrected, corrected_root
from netkf.algorithms.slot import adapted, filtered
from netkf.engines.compiled.exchanges import REBASING, SAMPLING, SENSING
from netkf.engines.compiled.masses import Masses, exchange_masses
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import compilable
from netkf.linalg.small import applied


class Nodes(NamedTuple):
    """H filters: xhat (H, n), root (H, n, n); F and root of Q (n, n) that all of them believe; what
    they believe of their readings, rows p (H,) and R (H, p, p).
    """

    xhat: FloatArray
    root: FloatArray
    F: FloatArray
    root_Q: FloatArray
    rows: np.ndarray
    R: FloatArray


class Readings(NamedTuple):
    """Readings y (S, H, p) and H (S, H, p, n) of the slots here, and by how much the origin of the
    coordinates moves in a slot, ``offsets`` (S, n).
    """

    y: FloatArray
    H: FloatArray
    offsets: FloatArray


class Steps(NamedTuple):
    """What is done, and which messages reach whom: the arrays of exchanges.Slots."""

    kind: np.ndarray
    number: np.ndarray
    first: np.ndarray
    after: np.ndarray
    receiver: np.ndarray
    sender: np.ndarray
    weight: FloatArray


class Shown(NamedTuple):
    """What samples show: xhat (T, H, n), root (T, H, n, n) and, where there is mass, the weight and
    the number of each node (T, H, 2).
    """

    xhat: FloatArray
    root: FloatArray
    mass: FloatArray


@compilable
def show(nodes: Nodes, shown: Shown, k: int) -> None:
    """Take sample number ``k``."""
    shown.xhat[k] = nodes.xhat
    shown.root[k] = nodes.root


@compilable
def rebase(nodes: Nodes, offset: FloatArray) -> None:
    """Lower all estimates by ``offset`` (n,)."""
    for h in range(len(nodes.xhat)):
        for i in range(len(offset)):
            nodes.xhat[h, i] -= offset[i]


def local(nodes: Nodes, readings: Readings, steps: Steps, shown: Shown) -> None:
    """SlotLocal and, of one node, SlotCentral."""
    for k in range(len(steps.kind)):
        s = steps.number[k]
        if steps.kind[k] == SAMPLING:
            show(nodes, shown, s)
        elif steps.kind[k] == REBASING:
            rebase(nodes, readings.offsets[s])
        elif steps.kind[k] == SENSING:
            for h in range(len(nodes.xhat)):
                p = nodes.rows[h]
                nodes.xhat[h], nodes.root[h] = filtered(
                    nodes.xhat[h],
                    nodes.root[h],
                    nodes.F,
                    nodes.root_Q,
                    readings.y[s, h, :p],
                    readings.H[s, h, :p],
                    nodes.R[h, :p, :p].copy(),
                )


@compilable
def adapt(nodes: Nodes, readings: Readings, s: int) -> None:
    """Every node updates with its reading of slot number ``s`` and predicts."""
    for h in range(len(nodes.xhat)):
        p = nodes.rows[h]
        nodes.xhat[h], nodes.root[h] = adapted(
            nodes.xhat[h],
            nodes.root[h],
            nodes.F,
            nodes.root_Q,
            readings.y[s, h, :p],
            readings.H[s, h, :p],
            nodes.R[h, :p, :p].copy(),
        )


def gossip(nodes: Nodes, readings: Readings, steps: Steps, shown: Shown) -> None:
    """Gossip: what came takes the place of the own pair."""
    for k in range(len(steps.kind)):
        if steps.kind[k] == SAMPLING:
            show(nodes, shown, steps.number[k])
        elif steps.kind[k] == REBASING:
            rebase(nodes, readings.offsets[steps.number[k]])
        elif steps.kind[k] == SENSING:
            adapt(nodes, readings, steps.number[k])
        elif steps.after[k] > steps.first[k]:
            xhat, root = nodes.xhat.copy(), nodes.root.copy()
            for m in range(steps.first[k], steps.after[k]):
                nodes.xhat[steps.receiver[m]] = xhat[steps.sender[m]]
                nodes.root[steps.receiver[m]] = root[steps.sender[m]]


def intermittent(nodes: Nodes, readings: Readings, steps: Steps, shown: Shown) -> None:
    """Intermittent: every node updates with its own reading and with those that came."""
    n, slot = nodes.xhat.shape[1], 0
    for k in range(len(steps.kind)):
        if steps.kind[k] == SAMPLING:
            show(nodes, shown, steps.number[k])
            continue
        if steps.kind[k] == REBASING:
            rebase(nodes, readings.offsets[steps.number[k]])
            continue
        if steps.kind[k] == SENSING:
            slot = steps.number[k]
            continue
        m = steps.first[k]
        for h in range(len(nodes.xhat)):
            begin, total = m, nodes.rows[h]
            while m < steps.after[k] and steps.receiver[m] == h:
                total += nodes.rows[steps.sender[m]]
                m += 1
            y, H, R, row = np.zeros(total), np.zeros((total, n)), np.zeros((total, total)), 0
            for part in range(begin - 1, m):
                who = h if part < begin else steps.sender[part]
                p = nodes.rows[who]
                y[row : row + p] = readings.y[slot, who, :p]
                H[row : row + p] = readings.H[slot, who, :p]
                R[row : row + p, row : row + p] = nodes.R[who, :p, :p]
                row += p
            nodes.xhat[h], nodes.root[h] = adapted(
                nodes.xhat[h], nodes.root[h], nodes.F, nodes.root_Q, y, H, R
            )


def diffusion(
    nodes: Nodes,
    readings: Readings,
    steps: Steps,
    shown: Shown,
    own: FloatArray,
    keep_own: bool,
) -> None:
    """DiffusionFilter: adapt, then combine by covariance intersection."""
    n = nodes.xhat.shape[1]
    for k in range(len(steps.kind)):
        if steps.kind[k] == SAMPLING:
            show(nodes, shown, steps.number[k])
            continue
        if steps.kind[k] == REBASING:
            rebase(nodes, readings.offsets[steps.number[k]])
            continue
        if steps.kind[k] == SENSING:
            adapt(nodes, readings, steps.number[k])
            continue
        xhat, root = nodes.xhat.copy(), nodes.root.copy()
        m = steps.first[k]
        for h in range(len(xhat)):
            begin = m
            while m < steps.after[k] and steps.receiver[m] == h:
                m += 1
            alone, heard = shares(own[h], steps.weight[begin:m], keep_own)
            if alone == 1.0:
                continue
            count = m - begin + 1
            weights, means, roots = np.empty(count), np.empty((count, n)), np.empty((count, n, n))
            weights[0], weights[1:] = alone, heard
            for part in range(count):
                who = h if part == 0 else steps.sender[begin + part - 1]
                means[part], roots[part] = xhat[who], root[who]
            nodes.xhat[h], nodes.root[h] = intersected(weights, means, roots)


def push_sum(
    nodes: Nodes,
    readings: Readings,
    steps: Steps,
    shown: Shown,
    masses: Masses,
    rule: int,
    tolerance: float,
    limit: FloatArray,
    asymptotic: bool,
    delta: float,
) -> None:
    """PushSum; with ``asymptotic`` gains the root of the ``limit`` (n, n) is known, and ``masses``
    hold the number of nodes.
    """
    for k in range(len(steps.kind)):
        s = steps.number[k]
        if steps.kind[k] == SAMPLING:
            show(nodes, shown, s)
            shown.mass[s] = masses.mass[:, :2]
        elif steps.kind[k] == REBASING:
            rebase(nodes, readings.offsets[s])
        elif steps.kind[k] == SENSING:
            for h in range(len(nodes.xhat)):
                root = limit
                if not asymptotic:
                    ahead = predict_root(nodes.root[h], nodes.F, nodes.root_Q)
                    root = corrected_root(ahead, masses.information[h])
                p = nodes.rows[h]
                nodes.xhat[h] = corrected(
                    applied(nodes.F, nodes.xhat[h]),
                    root,
                    masses.number[h],
                    readings.y[s, h, :p],
                    readings.H[s, h, :p],
                    nodes.R[h, :p, :p].copy(),
                )
                nodes.root[h] = root
        elif s == MASS:
            if not asymptotic:
                first, after = steps.first[k], steps.after[k]
                exchange_masses(masses, rule, tolerance, steps.receiver, steps.sender, first, after)
        else:
            z = nodes.xhat.copy()
            m = steps.first[k]
            for h in range(len(z)):
                total = np.zeros(z.shape[1])
                while m < steps.after[k] and steps.receiver[m] == h:
                    total += z[steps.sender[m]] - z[h]
                    m += 1
                nodes.xhat[h] = z[h] + total / delta
