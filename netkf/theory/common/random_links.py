"""The law of deliveries: directed links with their weights, and the moments of one exchange.

A message on direction k moves the error of its receiver i towards that of its sender j by W_k,
``e_i + W_k (s_j - s_i)``, where s are estimates or predictions. With delta_k = 1 if it arrives an
exchange is ``D = sum_k delta_k E_i W_k (E_j - E_i)'``, and only means and covariances of delta
enter second moments.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.clocks import LinkClock
from netkf.network.losses import (
    GilbertElliott,
    has_conditions,
    has_one_probability,
    identical_per_link,
)
from netkf.network.matchings import Broadcast, RecordedSlots
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import lacks_channel_law, no_channel_law


class Directions(NamedTuple):
    """K directed links.

    sender, receiver : (K,) indices of nodes
    weight           : (K, n, n) the matrices W_k
    source           : (K,) index of the draw that decides on delivery, the same for directions that
                       fail together
    delivery         : (K,) probability that a message arrives
    share            : probability that all hearers of a broadcast have one fate
    """

    sender: IntArray
    receiver: IntArray
    weight: FloatArray
    source: IntArray
    delivery: FloatArray
    share: float

    def mean(self, nodes: int, directions: IntArray) -> FloatArray:
        """Return E[D] (N n, N n) of one exchange over the given ``directions``."""
        n = self.weight.shape[-1]
        blocks = np.zeros((nodes, nodes, n, n))
        terms = self.delivery[directions, None, None] * self.weight[directions]
        receiver, sender = self.receiver[directions], self.sender[directions]
        np.add.at(blocks, (receiver, sender), terms)
        np.add.at(blocks, (receiver, receiver), -terms)
        return _join_blocks(blocks)

    def products(
        self, first: IntArray, second: IntArray, factor: FloatArray, Z: FloatArray
    ) -> FloatArray:
        """Return ``sum_p c_p D_a Z D_b'`` over pairs of directions ``first``, ``second`` (P,), D_a
        the change by a message on a; ``factor`` (P,) is c, Z (N n, N n).
        """
        n = self.weight.shape[-1]
        N = len(Z) // n
        blocks = np.swapaxes(Z.reshape(N, n, N, n), 1, 2)
        i, j = self.receiver[first], self.sender[first]
        k, m = self.receiver[second], self.sender[second]
        # E[(e_j - e_i)(e_m - e_k)'] of the senders j, m and the receivers i, k of each pair.
        gap = blocks[j, m] - blocks[j, k] - blocks[i, m] + blocks[i, k]
        turned = np.swapaxes(self.weight[second], 1, 2)
        total = np.zeros_like(blocks)
        np.add.at(total, (i, k), factor[:, None, None] * (self.weight[first] @ gap @ turned))
        return _join_blocks(total)

    def joint(self, first: IntArray, second: IntArray) -> FloatArray:
        """Return the probability (P,) that both of each pair of directions arrive."""
        p, q = self.delivery[first], self.delivery[second]
        # Directions of one source share one uniform draw, unless one of both senders has one fate
        # for all of its hearers, which then share a draw: both arrive if it is below min(p, q).
        same = np.where(
            self.source[first] == self.source[second],
            (1.0 - self.share) ** 2,
            np.where(self.sender[first] == self.sender[second], self.share, 0.0),
        )
        same = np.where(first == second, 1.0, same)
        return np.asarray(same * np.minimum(p, q) + (1.0 - same) * p * q)


def _join_blocks(blocks: FloatArray) -> FloatArray:
    """Return the matrix (N n, N n) that consists of ``blocks`` (N, N, n, n)."""
    N, _, n, _ = blocks.shape
    return np.asarray(np.swapaxes(blocks, 1, 2).reshape(N * n, N * n))


def directions_of(
    scenario: Scenario, weights: dict[tuple[int, int], FloatArray], wait: float
) -> Directions:
    """Return directed links in the order of ``weights``, with the law of losses; messages that take
    more than ``wait`` seconds are lost. Raises TheoryError without a known law.
    """
    delay, links, index = _known_delay(scenario), list(weights), scenario.topology.index
    # One draw decides about both directions of a link that are activated and lost together.
    together = scenario.network.one_fate
    owners = [min(link, link[::-1]) if together else link for link in links]
    at = {owner: k for k, owner in enumerate(dict.fromkeys(owners))}
    delivery = np.array([delivery_of(scenario, link) for link in links])
    return Directions(
        np.array([index[i] for i, _ in links], dtype=np.int64),
        np.array([index[j] for _, j in links], dtype=np.int64),
        np.stack(list(weights.values())),
        np.array([at[owner] for owner in owners], dtype=np.int64),
        delivery if delay <= wait else np.zeros_like(delivery),
        scenario.network.channel.loss.fate_share if scenario.has_broadcasts else 0.0,
    )


def broadcast_directions(
    scenario: Scenario, weights: dict[tuple[int, int], FloatArray]
) -> Directions | None:
    """Return the directed links of broadcasts, None without; TheoryError for recorded ones."""
    if not isinstance(scenario.network.activation, Broadcast):
        raise TheoryError("the exchanges are recorded: one outcome, not a law")
    return directions_of(scenario, weights, scenario.phase_length) if weights else None


def _known_delay(scenario: Scenario) -> float:
    """Return the delay (s) of all messages; raises TheoryError without a known law."""
    loss, delay = scenario.network.channel.loss, scenario.network.channel.delay.fixed
    if lacks_channel_law(scenario) or has_recorded_broadcasts(scenario):
        raise TheoryError(no_channel_law(scenario))
    if delay is None:
        raise TheoryError("exact mean squares are known for no delay or a fixed one, not a random")
    if not has_constant_losses(scenario):
        raise TheoryError("messages of one link are lost with different probabilities")
    if not loss.independent:
        raise TheoryError("losses depend on earlier ones; exact mean squares need independent ones")
    if loss.state_of != "link":
        raise TheoryError("the links of a sender share their bursts, which is not known here")
    return delay


def nothing_is_lost(scenario: Scenario) -> bool:
    """Return True if no message of a scenario in slots is lost, by its losses and its records."""
    return not has_recorded_broadcasts(scenario) and all(
        scenario.mean_delivery(link) == 1.0 for link in scenario.topology.directions
    )


def has_recorded_broadcasts(scenario: Scenario) -> bool:
    """Return True if a table lists the links that are up in each step of a broadcast."""
    activation = scenario.network.activation
    return isinstance(activation, RecordedSlots) and not activation.matching


def all_messages_arrive(scenario: Scenario) -> bool:
    """Return True if every message of a scenario in slots arrives in its exchange."""
    delay = scenario.network.channel.delay.fixed
    return delay is not None and delay <= scenario.phase_length and nothing_is_lost(scenario)


def delivery_of(scenario: Scenario, direction: tuple[int, int]) -> float:
    """Return the probability that a message of a link arrives; raises TheoryError if unknown."""
    mean = scenario.mean_delivery(direction)
    if math.isnan(mean):
        raise TheoryError("the losses state no probability before a run")
    if not has_constant_losses(scenario):
        raise TheoryError("messages of one link are lost with different probabilities")
    return mean


def arrival_of(scenario: Scenario, direction: tuple[int, int]) -> float:
    """Return the probability that a message of a slot arrives in its exchange; TheoryError."""
    delay = scenario.network.channel.delay.fixed
    if delay is None:
        raise TheoryError("random delays make some messages late")
    return delivery_of(scenario, direction) if delay <= scenario.phase_length else 0.0


@lru_cache(maxsize=8)
def has_constant_losses(scenario: Scenario) -> bool:
    """Return True if all messages of a link arrive with one probability; a class is asked."""
    loss = scenario.network.channel.loss
    if identical_per_link(loss) or isinstance(loss, GilbertElliott):
        return scenario.network.channel.channels is None
    if has_conditions(loss) or scenario.network.channel.channels is not None:
        return False
    return all(
        has_one_probability(loss, scenario.transmission(direction), scenario.horizon)
        for direction in scenario.topology.directions
    )


def poisson_ticks(
    scenario: Scenario, links: list[tuple[int, int]]
) -> tuple[tuple[float, IntArray], ...]:
    """Return for each clock its rate (1/s) and the directions (K,) that transmit; TheoryError
    unless Poisson.
    """
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    if clock.at == "readings" or not clock.memoryless:
        raise TheoryError("nodes do not transmit by Poisson clocks of their own")
    entities = clock.entities(scenario.topology)
    index = {direction: k for k, direction in enumerate(links)}
    ticks = []
    for entity in entities:
        if clock.at == "nodes":
            tick_directions = [k for link, k in index.items() if link[0] == entity[0]]
        else:
            ends = (entity[0], entity[1])
            directions = (ends, ends[::-1]) if clock.at == "links" else (ends,)
            tick_directions = [index[link] for link in directions if link in index]
        if tick_directions:
            ticks.append(
                (float(clock.mean_rate(entity)), np.array(tick_directions, dtype=np.int64))
            )
    return tuple(ticks)
