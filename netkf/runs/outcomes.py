"""What became of the messages and the nodes of one run: matrices of delivery and of shared fate,
losses over time, and when nodes were down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.lives import lifetimes
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.messages import DELIVERED, UNDER_WAY


class Downtime(NamedTuple):
    """A node (id) is down from ``begin`` to ``end`` (seconds, inf: to the end of the run), since it
    made an event of this ``kind``; "" if it was down from the beginning.
    """

    node: int
    begin: float
    end: float
    kind: str


def downtimes(scenario: Scenario, seed: int, replica: int) -> list[Downtime]:
    """Return when the nodes of a run are down, ordered by node and time."""
    found = []
    for node, life in sorted(lifetimes(scenario, Streams(seed, replica)).items()):
        begin, kind = (math.nan, "") if life.up else (0.0, "")
        for change in life.changes:
            if change.up:
                found.append(Downtime(node, begin, change.time, kind))
                begin = math.nan
            else:
                begin, kind = change.time, change.kind
        if not math.isnan(begin):
            found.append(Downtime(node, begin, math.inf, kind))
    return found


class Outcomes(NamedTuple):
    """The M messages of a run with an outcome: index of ``sender`` and ``receiver`` (M,), ``sent``
    (M,) in seconds, ``phase`` (M,), and ``heard`` (M,) bool.
    """

    sender: np.ndarray
    receiver: np.ndarray
    sent: FloatArray
    phase: np.ndarray
    heard: np.ndarray


def outcomes_of(messages: np.ndarray, nodes: Sequence[int]) -> Outcomes:
    """Return those of the MESSAGE rows (M,) that were heard, lost or late."""
    messages = messages[messages["outcome"] != UNDER_WAY]
    return Outcomes(
        sender=np.searchsorted(nodes, messages["sender"]),
        receiver=np.searchsorted(nodes, messages["receiver"]),
        sent=messages["sent"],
        phase=messages["phase"],
        heard=messages["outcome"] == DELIVERED,
    )


def delivery_matrix(outcomes: Outcomes, size: int) -> FloatArray:
    """Return the share heard of messages from i to j, (N, N), nan where none was sent."""
    code = outcomes.sender * size + outcomes.receiver
    sent, heard = (
        np.bincount(code, weights, size * size).reshape(size, size)
        for weights in (np.ones(len(code)), outcomes.heard)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(heard / sent)


def fate_matrix(outcomes: Outcomes, size: int) -> FloatArray:
    """Return the correlation of outcomes of hearers i and j of a broadcast, (N, N), about the means
    of links; nan on the diagonal and where unknown.
    """
    gap = outcomes.heard - delivery_matrix(outcomes, size)[outcomes.sender, outcomes.receiver]
    order = np.lexsort((outcomes.receiver, outcomes.phase, outcomes.sent, outcomes.sender))
    sender, sent, phase = (a[order] for a in (outcomes.sender, outcomes.sent, outcomes.phase))
    again = (np.diff(sender) == 0) & (np.diff(sent) == 0) & (np.diff(phase) == 0)
    # Messages that no other node could hear are most of a network of links, and say nothing here.
    shared = np.append(False, again) | np.append(again, False) if len(order) else again
    number = np.cumsum(np.append(0, ~again))[: len(order)]
    broadcast, row = np.unique(number[shared], return_inverse=True)
    gaps = np.zeros((len(broadcast), size))
    is_hearer = np.zeros_like(gaps)
    gaps[row, outcomes.receiver[order][shared]] = gap[order][shared]
    is_hearer[row, outcomes.receiver[order][shared]] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        # Sums over the broadcasts that both may hear.
        squares = (gaps**2).T @ is_hearer
        correlation = (gaps.T @ gaps) / np.sqrt(squares * squares.T)
    fates = np.where(is_hearer.T @ is_hearer > 0.0, correlation, math.nan)
    np.fill_diagonal(fates, math.nan)
    return fates


def loss_windows(
    outcomes: Outcomes, size: int, edges: FloatArray
) -> tuple[list[tuple[int, int]], FloatArray]:
    """Return the links (indices) that sent, and the share lost between ``edges`` (B + 1,) in
    seconds, (L, B), nan where nothing was sent.
    """
    codes, link = np.unique(outcomes.sender * size + outcomes.receiver, return_inverse=True)
    bins = np.clip(np.searchsorted(edges, outcomes.sent, side="right") - 1, 0, len(edges) - 2)
    cell, count = link * (len(edges) - 1) + bins, len(codes) * (len(edges) - 1)
    sent, lost = (np.bincount(cell, w, count) for w in (np.ones(len(cell)), ~outcomes.heard))
    links = [divmod(code, size) for code in codes.tolist()]
    with np.errstate(invalid="ignore"):
        return links, (lost / sent).reshape(len(codes), -1)
