"""The mass of push-sum, which depends on the messages that arrive and on no reading.

Where nodes stop, the messages and rows of later slots depend on it, so that it is carried twice, by
one compiled function: slot after slot while the slots are made, and again with the estimates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.stopping import PAPER, RULES, stops
from netkf.algorithms.push_sum import PushSum, kept, share, understood
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import compilable, demanded
from netkf.linalg.small import fill, fill_square
from netkf.scenario.scenario import Scenario


class Masses(NamedTuple):
    """H nodes: mass (H, 2 + n n) and nominal degree (H,); the information (H, n, n) and number (H,)
    that they take the network to have, whether these are ``frozen`` (H,), and the information of a
    node by itself, ``own`` (H, n, n).
    """

    mass: FloatArray
    degree: np.ndarray
    information: FloatArray
    number: FloatArray
    frozen: np.ndarray
    own: FloatArray


def first_masses(scenario: Scenario) -> tuple[Masses, FloatArray | None]:
    """The masses before slot 0, and the root (n, n) of P_inf where the gains are the limits."""
    algorithm = scenario.filter.algorithm
    assert isinstance(algorithm, PushSum)
    states = [
        algorithm.init(model, *scenario.start(info.node), info)
        for info, model in zip(scenario.node_infos, scenario.slot_models, strict=True)
    ]
    masses = Masses(
        mass=np.stack([state.mass for state in states]),
        degree=np.array([state.degree for state in states], dtype=np.int64),
        information=np.stack([state.network.information for state in states]),
        number=np.array([state.network.number for state in states], dtype=np.float64),
        frozen=np.zeros(len(states), dtype=np.bool_),
        own=np.stack([model.information for model in scenario.slot_models]),
    )
    return masses, states[0].network.root


@compilable
def exchange_masses(
    masses: Masses,
    rule: int,
    tolerance: float,
    receiver: np.ndarray,
    sender: np.ndarray,
    first: int,
    after: int,
) -> None:
    """One exchange, P steps 2.1 to 2.3, of messages ``first`` to ``after``; receivers ascend."""
    before, m = masses.mass.copy(), first
    for h in range(len(before)):
        begin, total = m, np.zeros(before.shape[1])
        while m < after and receiver[m] == h:
            total += share(before[sender[m]], masses.degree[sender[m]])
            m += 1
        if masses.frozen[h] and rule == PAPER:
            continue
        received, degree = m - begin, masses.degree[h]
        fill(masses.mass[h], kept(before[h], received, degree) + total)
        if masses.frozen[h]:
            continue
        found, number = understood(masses.mass[h], masses.own[h])
        masses.frozen[h] = stops(
            rule,
            tolerance,
            masses.mass[h],
            before[h],
            received == degree,
            found,
            number,
            masses.information[h],
            masses.number[h],
        )
        fill_square(masses.information[h], found)
        masses.number[h] = number


class Stopping:
    """Who stops when, for the slots that are made."""

    def __init__(self, scenario: Scenario) -> None:
        algorithm = scenario.filter.algorithm
        assert isinstance(algorithm, PushSum)
        self._masses, _ = first_masses(scenario)
        self._rule, self._tolerance = RULES.index(algorithm.stop), algorithm.tolerance
        self.silences = self._rule == PAPER
        self._exchange = demanded(exchange_masses)

    def exchange(self, messages: list[tuple[int, int, float]]) -> list[int]:
        """One exchange of the mass, of messages (receiver, sender, weight); the places of the nodes
        that stop with it.
        """
        before = self._masses.frozen.copy()
        if self.silences and before.all():
            return []
        ends = np.array([message[:2] for message in messages], dtype=np.int64).reshape(-1, 2)
        receiver, sender = np.ascontiguousarray(ends.T)
        rule = self._rule, self._tolerance
        self._exchange(self._masses, *rule, receiver, sender, 0, len(messages))
        return np.flatnonzero(self._masses.frozen & ~before).tolist()


def stopping(scenario: Scenario) -> Stopping | None:
    """None where nobody ever stops."""
    algorithm = scenario.filter.algorithm
    if not isinstance(algorithm, PushSum) or algorithm.asymptotic or algorithm.stop == "never":
        return None
    return Stopping(scenario)
