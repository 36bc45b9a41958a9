"""The base class of trials: a few connected nodes that run the filter that is checked."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Message, NetworkInfo, NodeInfo, Reading
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.testing.estimates import check_estimate, check_state_pickles
from netkf.testing.systems import System
from netkf.testing.watching import WatchedPart, demand

CONSERVATION_TOLERANCE = 1e-9  # relative change of a sum that an exchange should conserve
MAX_DELAY = 1.0  # seconds; longest delay of a message, as nodes are told


class CheckedEstimate(NamedTuple):
    """An estimate of a node that passed its checks.

    node, after : the node, and the method that was called before
    xhat, P     : (n,) less the shift of the truth, and (n, n) or None
    size        : largest absolute entry of the estimate with the shift
    """

    node: int
    after: str
    xhat: FloatArray
    P: FloatArray | None
    size: float


class Trial(ABC):
    """One run of a complete network of 2 or 3 nodes, of which node 1 has no sensor.

    With ``shift`` (n,) the truth is shifted by it during the run, and states and messages in flight
    with it. The truth is 0 otherwise: readings are noise plus the effect of the shift.
    """

    def __init__(
        self, watched: WatchedPart, system: System, shift: FloatArray | None = None
    ) -> None:
        """Start the user's filter, ``watched.part``, at each of 2 or 3 connected nodes."""
        self.watched, self.part, self.system = watched, watched.part, system
        self.random = Streams(0).generator("testing")
        self.estimates: list[CheckedEstimate] = []
        self.ends: list[dict[int, CheckedEstimate]] = []
        """The estimates by node at the end of each slot, or of each round in continuous time."""
        self._last: dict[int, CheckedEstimate] = {}
        self._shift = shift
        self.offset = np.zeros(len(system.M))
        """The present shift of the truth (n,)."""
        self.nodes, self.weights = _make_network(self.part)
        # Filters must also work at nodes without a sensor: node 1 is one.
        models = [self.model(has_sensor=node != 1) for node in self.nodes]
        self.states = [self._start(node, models) for node in self.nodes]
        self.models = models
        check_state_pickles(watched, self.states[0])

    @abstractmethod
    def model(self, has_sensor: bool) -> Any:
        """Return the model of the plant and of its sensor that the filter of a node is given;
        without rows of readings unless the node ``has_sensor``.
        """

    @abstractmethod
    def run(self) -> None:
        """Let time pass, and call the filters of all nodes with readings, messages and the shift
        of the truth; a trial is run once.
        """

    def _start(self, node: int, models: Sequence[Any]) -> Any:
        degree = len(self.nodes) - 1
        own_weight = max(0.0, 1.0 - float(self.weights[:, node].sum()))
        information = np.stack([model.information for model in models])
        neighbours = tuple(tuple(j for j in self.nodes if j != i) for i in self.nodes)
        info = NodeInfo(
            node=node,
            degree=degree,
            receivers=degree,
            nodes=degree + 1,
            own_weight=own_weight,
            information=information.sum(axis=0),
            max_delay=MAX_DELAY,
            place=node,
            senders=neighbours[node],
            network=NetworkInfo(information, neighbours),
            rows=max(1, *(len(model.H) for model in models)),
            sampled=self.matrices(node != 1),
        )
        mean = self.system.mean + node * self.system.spread
        state = self.watched.call("init", models[node], mean, self.system.cov, info)
        self.record_estimate(node, state, "init")
        return state

    def record_estimate(self, node: int, state: Any, after: str) -> None:
        """Check and record the estimate of a node from the state that method ``after`` returned."""
        xhat, P = check_estimate(self.watched, state, len(self.system.M), after)
        size = float(np.abs(xhat).max())
        self._last[node] = CheckedEstimate(node, after, xhat - self.offset, P, size)
        self.estimates.append(self._last[node])

    def record_end(self) -> None:
        """Record the present estimates as those at the end of a slot or round."""
        self.ends.append(dict(self._last))

    def step(self, node: int, method: str, *arguments: Any, records: bool = True) -> None:
        """Call a method of the filter that returns the next state of a node, and record its
        estimate unless not ``records``.
        """
        self.states[node] = self.watched.call(method, self.states[node], *arguments)
        if records:
            self.record_estimate(node, self.states[node], method)

    def emit(self, node: int, exchange: Exchange) -> Any:
        """Call ``emit`` of the filter at a node for this ``exchange`` of messages; return the
        payload of its message, or None if it sends nothing.
        """
        pair = self.watched.call("emit", self.states[node], exchange)
        is_pair = type(pair) is tuple and len(pair) == 2
        where = f"{self.watched.name}.emit"
        demand(is_pair, where, "must return (state, payload); payload None sends nothing")
        self.states[node], payload = pair
        self.record_estimate(node, self.states[node], "emit")
        return payload

    def absorb(self, node: int, messages: Sequence[Message], exchange: Exchange) -> None:
        """Call ``absorb`` for a node with all messages of one instant, and check ``stopped``."""
        self.step(node, "absorb", messages, exchange)
        stopped = self.watched.call("analysis.stopped", self.states[node])
        is_flag = stopped is True or stopped is False
        demand(is_flag, f"{self.watched.name}.analysis.stopped", "must be True or False", stopped)

    def sample(self, node: int, time: float) -> Reading:
        """Return a reading of the sensors of a node at ``time`` (seconds): unit noise plus H times
        the shift of the truth.
        """
        H, R = self.matrices(node != 1)
        return Reading(self.random.normal(size=len(H)) + H @ self.offset, H, R, time)

    def matrices(self, has_sensor: bool) -> tuple[FloatArray, FloatArray]:
        """Return H (p, n) and R (p, p) of a node, with p = 0 unless it ``has_sensor``."""
        system = self.system
        return (system.H, system.R) if has_sensor else (system.H[:0], system.R[:0, :0])

    def shift_truth(self) -> None:
        """Shift the truth and the states of all nodes, if this trial has a shift."""
        if self._shift is None:
            return
        self.offset = self._shift.copy()
        for node in self.nodes:
            self.step(node, "shift", self.offset)

    def conserved_sums(self) -> dict[str, float]:
        """Return the sums over all nodes of the quantities that ``conserved`` returns, by name."""
        where = f"{self.watched.name}.analysis.conserved"
        by_node = [self.watched.call("analysis.conserved", state) for state in self.states]
        names = by_node[0].keys() if isinstance(by_node[0], dict) else None
        same_names = all(isinstance(terms, dict) and terms.keys() == names for terms in by_node)
        demand(same_names, where, "must name the same quantities at every node", by_node[0])
        return {
            name: math.fsum(np.concatenate([np.atleast_1d(terms[name]) for terms in by_node]))
            for name in by_node[0]
        }

    def check_conserved(self, before: dict[str, float], lost: str) -> None:
        """Check that the conserved sums are still those ``before`` an exchange.

        ``lost``, "all" or "none", says in the message which messages of the exchange were lost.
        """
        after = self.conserved_sums()
        for name, total in before.items():
            demand(
                abs(after[name] - total) <= CONSERVATION_TOLERANCE * max(abs(total), 1.0),
                f"{self.watched.name}.analysis.conserved",
                f"the sum of {name} over all nodes must survive an exchange with {lost} lost",
                f"{total:.6g} before and {after[name]:.6g} after",
                "let absorb give to one node what it takes from another",
            )


def _make_network(part: Any) -> tuple[range, FloatArray]:
    given = part.link_weights
    weights = given.matrix
    if weights is None:
        count = 3 if given.largest_degree >= 2.0 else 2
        weights = np.full((count, count), given.of(count - 1, count - 1))
    return range(len(weights)), np.asarray(weights) * (1.0 - np.eye(len(weights)))
