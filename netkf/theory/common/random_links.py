"""The law of deliveries: directed links with their weights, and the moments of one exchange.

A message on direction k moves the error of its receiver i towards that of its sender j by W_k,
``e_i + W_k (s_j - s_i)``, where s are estimates or predictions. With delta_k = 1 if it arrives an
exchange is ``D = sum_k delta_k E_i W_k (E_j - E_i)'``, with means and covariances of delta.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.clocks import LinkClock
from netkf.network.delays import delay_depends_on_message
from netkf.network.losses import (
    GilbertElliott,
    has_conditions,
    has_one_probability,
    identical_per_link,
)
from netkf.network.matchings import Broadcast, RecordedSlots
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import lacks_channel_law, no_channel_law

MAX_CHAINS = 10
"""Independent chains of bursty links whose joint states are enumerated."""


class Directions(NamedTuple):
    """K directed links and S joint states (modes) of their channels.

    sender, receiver : (K,) indices of nodes
    weight           : (K, n, n) the matrices W_k
    source           : (K,) index of the draw (and of the Gilbert-Elliott chain) that decides on
                       delivery; directions that fail together have the same source
    delivery         : (S, K) probability that a message arrives, by mode
    share            : probability that all hearers of a broadcast have one fate
    steps            : transition probabilities (to_bad, to_good) of each chain, which makes a step
                       at each activation; None if there is one mode only. Bit c of the index of a
                       mode is 1 if chain c is in its bad state
    """

    sender: IntArray
    receiver: IntArray
    weight: FloatArray
    source: IntArray
    delivery: FloatArray
    share: float
    steps: tuple[float, float] | None

    @property
    def modes(self) -> int:
        """S, the number of modes."""
        return len(self.delivery)

    @property
    def stationary(self) -> FloatArray:
        """The probabilities (S,) of the modes in the long run."""
        if self.steps is None:
            return np.ones(1)
        to_bad, to_good = self.steps
        bad = to_bad / (to_bad + to_good)
        probabilities = np.ones(1)
        for _ in range(int(np.log2(self.modes))):
            probabilities = np.concatenate([probabilities * (1.0 - bad), probabilities * bad])
        return probabilities

    def advance(self, X: FloatArray, chains: IntArray) -> FloatArray:
        """Return second moments (S, M, M) by mode after a step of the bursty ``chains``."""
        if self.steps is None:
            return X
        to_bad, to_good = self.steps
        transition = np.array([[1.0 - to_bad, to_bad], [to_good, 1.0 - to_good]])
        for chain in chains.tolist():
            # Modes as (higher chains, this one, lower chains).
            split = X.reshape(-1, 2, 1 << chain, *X.shape[1:])
            X = np.einsum("st,asbij->atbij", transition, split).reshape(X.shape)
        return X

    def stay(self, chains: IntArray) -> FloatArray:
        """Return the probability (S,), by mode, that a step of ``chains`` leaves the mode."""
        if self.steps is None:
            return np.ones(1)
        to_bad, to_good = self.steps
        modes, probability = np.arange(self.modes), np.ones(self.modes)
        for chain in chains.tolist():
            probability *= np.where(modes >> chain & 1, 1.0 - to_good, 1.0 - to_bad)
        return probability

    def mean(self, nodes: int, directions: IntArray) -> FloatArray:
        """Return E[D] (S, N n, N n), by mode, of one exchange over the given ``directions``."""
        n = self.weight.shape[-1]
        blocks = np.zeros((self.modes, nodes, nodes, n, n))
        terms = self.delivery[:, directions, None, None] * self.weight[directions]
        receiver, sender = self.receiver[directions], self.sender[directions]
        _add_blocks(blocks, receiver, sender, terms)
        _add_blocks(blocks, receiver, receiver, -terms)
        return _join_blocks(blocks)

    def products(
        self, first: IntArray, second: IntArray, factor: FloatArray, Z: FloatArray
    ) -> FloatArray:
        """Return ``sum_p c_p D_a Z D_b'`` over pairs of directions ``first``, ``second`` (P,), D_a
        the change by a message on a; ``factor`` (S, P) is c by mode, Z (S, N n, N n).
        """
        n = self.weight.shape[-1]
        S, N = len(Z), Z.shape[1] // n
        blocks = np.swapaxes(Z.reshape(S, N, n, N, n), 2, 3)
        i, j = self.receiver[first], self.sender[first]
        k, m = self.receiver[second], self.sender[second]
        # E[(e_j - e_i)(e_m - e_k)'] of the senders j, m and the receivers i, k of each pair.
        gap = blocks[:, j, m] - blocks[:, j, k] - blocks[:, i, m] + blocks[:, i, k]
        turned = np.swapaxes(self.weight[second], 1, 2)
        terms = factor[:, :, None, None] * (self.weight[first] @ gap @ turned)
        blocks_out = np.zeros_like(blocks)
        _add_blocks(blocks_out, i, k, terms)
        return _join_blocks(blocks_out)

    def joint(self, first: IntArray, second: IntArray) -> FloatArray:
        """Return the probability (S, P), by mode, that both of each pair of directions arrive."""
        p, q = self.delivery[:, first], self.delivery[:, second]
        # Directions of one source share one uniform draw, unless one of both senders has one fate
        # for all of its hearers, which then share a draw: both arrive if it is below min(p, q).
        same = np.where(
            self.source[first] == self.source[second],
            (1.0 - self.share) ** 2,
            np.where(self.sender[first] == self.sender[second], self.share, 0.0),
        )
        same = np.where(first == second, 1.0, same)
        return np.asarray(same * np.minimum(p, q) + (1.0 - same) * p * q)


def _add_blocks(blocks: FloatArray, rows: IntArray, columns: IntArray, terms: FloatArray) -> None:
    """Add P terms (S, P, n, n) to ``blocks`` at nodes that may repeat."""
    index: Any = (slice(None), rows, columns)
    np.add.at(blocks, index, terms)


def _join_blocks(blocks: FloatArray) -> FloatArray:
    """Return the matrices (S, N n, N n) that consist of ``blocks`` (S, N, N, n, n)."""
    S, N, _, n, _ = blocks.shape
    return np.asarray(np.swapaxes(blocks, 2, 3).reshape(S, N * n, N * n))


def directions_of(
    scenario: Scenario, weights: dict[tuple[int, int], FloatArray], wait: float
) -> Directions:
    """Return directed links in the order of ``weights``, with the law of losses; messages that take
    more than ``wait`` seconds are lost. Raises TheoryError without a known law.
    """
    loss, delay = scenario.network.channel.loss, _known_delay(scenario)
    chain = loss.chain
    links, index = list(weights), scenario.topology.index
    # One draw decides about both directions of a link that are activated and lost together.
    together = scenario.network.one_fate
    owners = [min(link, link[::-1]) if together else link for link in links]
    at = {owner: k for k, owner in enumerate(dict.fromkeys(owners))}
    source = np.array([at[owner] for owner in owners], dtype=np.int64)
    delivery = _deliveries(scenario, links, source, len(at))
    if delay > wait:
        delivery = np.zeros_like(delivery)
    return Directions(
        np.array([index[i] for i, _ in links], dtype=np.int64),
        np.array([index[j] for _, j in links], dtype=np.int64),
        np.stack(list(weights.values())),
        source,
        delivery,
        loss.fate_share if scenario.has_broadcasts else 0.0,
        None if chain is None or loss.independent else (chain.to_bad, chain.to_good),
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
    if loss.chain is None and not loss.independent:
        raise TheoryError("losses depend on earlier ones in a way that is not known here")
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


def both_or_none(scenario: Scenario) -> bool | None:
    """Return True if both messages of an exchange in a slot arrive or neither; None if unknown."""
    channel, horizon = scenario.network.channel, scenario.horizon
    directions = {link: scenario.transmission(link) for link in scenario.topology.directions}
    if scenario.messages_queue:
        return None
    are_sure = all(channel.mean_delivery(sent, horizon) == 1.0 for sent in directions.values())
    if are_sure and channel.delay.fixed is not None:
        return True
    of_senders = channel.draws_for_senders and scenario.has_broadcasts and not are_sure
    if of_senders or not channel.symmetric:
        return False
    if delay_depends_on_message(channel.delay) or not has_constant_losses(scenario):
        return None
    # They share their draws, but the probabilities of the two directions may differ.
    none, bad = np.zeros(2), np.array([False, True])
    laws = {
        link: channel.deliveries(sent._replace(number=none.astype(int), time=none, bad=bad))
        for link, sent in directions.items()
    }
    return all(np.array_equal(law, laws.get(link[::-1], law)) for link, law in laws.items())


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
    loss, directions = scenario.network.channel.loss, scenario.topology.directions
    for direction in directions if scenario.network.radio is not None else ():
        if len({sent.frames for _, sent in scenario.messages_of_slot(direction)}) > 1:
            return False
    if identical_per_link(loss) or isinstance(loss, GilbertElliott):
        return scenario.network.channel.channels is None
    if has_conditions(loss) or scenario.network.channel.channels is not None:
        return False
    return all(
        has_one_probability(loss, scenario.transmission(direction), scenario.horizon)
        for direction in directions
    )


def _deliveries(
    scenario: Scenario, links: list[tuple[int, int]], source: IntArray, chains: int
) -> FloatArray:
    """Return the delivery probabilities (S, K) of ``links`` by mode of the bursty channels."""
    loss = scenario.network.channel.loss

    def probabilities(bad: bool) -> FloatArray:
        """Return the probabilities (K,) if all channels are in their bad state, or good one."""
        sent = (scenario.transmission(link)._replace(bad=bad) for link in links)
        return np.array([float(loss.delivery_probability(one)) for one in sent])

    if loss.chain is None or loss.independent:
        return np.array([[delivery_of(scenario, link) for link in links]])
    if chains > MAX_CHAINS:
        raise TheoryError(
            f"bursts on {chains} links have 2^{chains} joint states; exact mean squares are "
            f"computed for at most {MAX_CHAINS} links with bursts"
        )
    modes = np.arange(1 << chains)
    return np.where(modes[:, None] >> source & 1, probabilities(True), probabilities(False))


def poisson_ticks(
    scenario: Scenario, links: list[tuple[int, int]]
) -> tuple[tuple[float, IntArray], ...]:
    """Return each clock's rate (1/s) and directions (K,); TheoryError unless Poisson."""
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    if clock.at == "readings" or not clock.memoryless:
        raise TheoryError("nodes do not transmit by Poisson clocks of their own")
    entities = clock.entities(scenario.topology)
    index = {direction: k for k, direction in enumerate(links)}
    ticks = []
    for entity in entities:
        if clock.at == "nodes":
            own = [k for link, k in index.items() if link[0] == entity[0]]
        else:
            ends = (entity[0], entity[1])
            directions = (ends, ends[::-1]) if clock.at == "links" else (ends,)
            own = [index[link] for link in directions if link in index]
        if own:
            ticks.append((float(clock.mean_rate(entity)), np.array(own, dtype=np.int64)))
    return tuple(ticks)
