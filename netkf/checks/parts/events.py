"""Counts of the messages and pairs in the events of one run."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from netkf.checks.parts.ticks import count_by_window
from netkf.network.matchings import Matching
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES


class LossCounts(NamedTuple):
    """Counts of the messages of one run over D directions (directed links), from which it is
    tested how often, and how independently, messages are lost.

    sent, lost : (W, D) messages in each of W equal windows of the run
    followed   : (D,) losses after which another message was sent
    repeated   : (D,) pairs of consecutive messages that were both lost
    both       : (D,) messages lost together with the message of the same number in the opposite
                 direction
    """

    sent: np.ndarray
    lost: np.ndarray
    followed: np.ndarray
    repeated: np.ndarray
    both: np.ndarray


class PairCounts(NamedTuple):
    """Counts of the matchings of one run over L links.

    paired   : (L,) slots in which the link was in the matching
    repeated : (L,) slots in which it was in the matchings of this slot and of the one before
    slots    : () number of slots with a matching
    """

    paired: np.ndarray
    repeated: np.ndarray
    slots: np.ndarray


@lru_cache(maxsize=8)
def direction_indices(scenario: Scenario) -> dict[tuple[int, int], int]:
    """Return the index of each direction (sender, receiver) in the topology."""
    return {direction: k for k, direction in enumerate(scenario.topology.directions)}


def count_losses(scenario: Scenario, run: Run) -> LossCounts | None:
    """Return the counts (W, D) of sent and lost messages of a run, in W windows (equal parts) of it
    and for each of D directions (directed links), and counts of losses that follow or accompany
    each other; None without links.
    """
    indices, log = direction_indices(scenario), run.log
    sends, losses = (log[log["kind"] == CODES[kind]] for kind in ("send", "lost"))
    if not indices:
        return None
    size = len(indices)
    lost_at = in_direction(losses["node"], losses["peer"], indices)
    sent_at = in_direction(sends["node"], sends["peer"], indices)
    sent = count_by_window(scenario, sends["t"], sent_at, size)
    lost = count_by_window(scenario, losses["t"], lost_at, size)
    number = losses["message"]
    # One integer for each message: the message before it in its direction has that integer less 1,
    # and the gap after the last of each direction keeps directions apart.
    width = int(sends["message"].max(initial=0)) + 2
    keys = lost_at * width + number
    after_loss = np.isin(keys - 1, keys) & (number > 0)
    opposite = reversed_directions(scenario)[lost_at]
    both_lost = np.isin(opposite * width + number, keys) & (opposite >= 0)
    followed = number + 1 < sent.sum(axis=0)[lost_at]
    return LossCounts(
        sent,
        lost,
        followed=np.bincount(lost_at[followed], minlength=size),
        repeated=np.bincount(lost_at[after_loss], minlength=size),
        both=np.bincount(lost_at[both_lost], minlength=size),
    )


def in_direction(
    senders: np.ndarray, receivers: np.ndarray, indices: dict[tuple[int, int], int]
) -> np.ndarray:
    """Return the index (K,) of the direction of each of K messages from ``senders`` to
    ``receivers`` (K,), node ids; ``indices`` is by (sender, receiver).
    """
    ids = zip(senders.tolist(), receivers.tolist(), strict=True)
    return np.array([indices[direction] for direction in ids], dtype=np.int64)


@lru_cache(maxsize=8)
def shares_draws(scenario: Scenario) -> np.ndarray:
    """Return (D,) bool: True for the second of two opposite directions that share all draws.

    Statistics count such pairs once, by the first direction.
    """
    clock = scenario.network.activation
    at_once = getattr(clock, "at", "links") == "links"
    shared = at_once and scenario.network.channel.symmetric
    senders = np.array([[i, j] for i, j in direction_indices(scenario)])
    second = (senders[:, 0] > senders[:, 1]) & (reversed_directions(scenario) >= 0)
    return np.asarray(second & shared)


@lru_cache(maxsize=8)
def reversed_directions(scenario: Scenario) -> np.ndarray:
    """Return the index (D,) of the opposite of each direction, -1 without one."""
    indices = direction_indices(scenario)
    return np.array([indices.get((j, i), -1) for i, j in indices], dtype=np.int64)


def count_pairs(scenario: Scenario, run: Run) -> PairCounts | None:
    """Return for each of L links the number (L,) of slots of a run in which it was in the matching
    (the pairs of nodes that exchange in a slot), and in which it was in two matchings in a row;
    None without drawn matchings.
    """
    if not isinstance(scenario.network.activation, Matching):
        return None
    links = {link: k for k, link in enumerate(scenario.topology.links)}
    rows = run.log[run.log["kind"] == CODES["tick"]]
    slots = scenario.slot_plant.slots_of(rows["t"])
    ids = zip(rows["node"].tolist(), rows["peer"].tolist(), strict=True)
    link_of_row = np.array([links[min(e), max(e)] for e in ids], dtype=np.int64)
    count = np.bincount(link_of_row, minlength=len(links))
    # One integer for each link and slot: the same link one slot before has that less len(links).
    keys = slots * len(links) + link_of_row
    repeated = np.isin(keys - len(links), keys)
    first = scenario.node_filter.first_slot  # filters may exchange nothing in slot 0
    total = int(np.ceil(scenario.horizon / scenario.slot_plant.period - 1e-9)) - first
    return PairCounts(
        count, np.bincount(link_of_row[repeated], minlength=len(links)), np.array(float(total))
    )
