"""The base class of trials: connected nodes that all run the filter that is checked."""

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
from netkf.testing.watching import Watched, demand

CONSERVED = 1e-9  # relative change of a sum that an exchange should conserve
MAX_DELAY = 1.0  # seconds; no message of a trial takes longer


class CheckedEstimate(NamedTuple):
    """An estimate of a node after something happened; ``xhat`` and ``size`` (its largest entry)
    before it was moved back by what the truth was shifted.
    """

    node: int
    after: str
    xhat: FloatArray
    P: FloatArray | None
    size: float


class Trial(ABC):
    """One run of nodes that hear each other, the second of them blind. With ``shift`` (n,) the
    truth moves by so much in the middle of the run, with all states and messages under way.
    """

    def __init__(self, watched: Watched, system: System, shift: FloatArray | None = None) -> None:
        self.watched, self.part, self.system = watched, watched.part, system
        self.random = Streams(0).generator("testing")
        self.estimates: list[CheckedEstimate] = []
        self.ends: list[dict[int, CheckedEstimate]] = []
        """The estimate of each node at the end of each slot, or of each round under clocks."""
        self._last: dict[int, CheckedEstimate] = {}
        self._shift = shift
        self.offset = np.zeros(len(system.M))
        """The present shift of the truth (n,)."""
        self.nodes, self.weights = _make_network(self.part)
        models = [self.model(sees=node != 1) for node in self.nodes]
        self.states = [self._start(node, models) for node in self.nodes]
        self.models = models
        check_state_pickles(watched, self.states[0])

    @abstractmethod
    def model(self, sees: bool) -> Any:
        """Return the model of a node; without sensors unless it ``sees``."""

    @abstractmethod
    def run(self) -> None:
        """Let everything happen that may happen."""

    def _start(self, node: int, models: Sequence[Any]) -> Any:
        """Return the checked state of a node at time 0."""
        others = len(self.nodes) - 1
        own = max(0.0, 1.0 - float(self.weights[:, node].sum()))
        parts = np.stack([model.information for model in models])
        heard = tuple(tuple(j for j in self.nodes if j != i) for i in self.nodes)
        info = NodeInfo(
            node, others, others, others + 1, own, parts.sum(axis=0), MAX_DELAY, node,
            NetworkInfo(parts, heard),
        )  # fmt: skip
        state = self.watched.call("init", models[node], self.system.mean, self.system.cov, info)
        self.show(node, state, "init")
        return state

    def show(self, node: int, state: Any, after: str) -> None:
        """Check the node's estimate and keep it."""
        xhat, P = check_estimate(self.watched, state, len(self.system.M), after)
        size = float(np.abs(xhat).max())
        self._last[node] = CheckedEstimate(node, after, xhat - self.offset, P, size)
        self.estimates.append(self._last[node])

    def end(self) -> None:
        """Keep the present estimates as those at the end of a slot or round."""
        self.ends.append(dict(self._last))

    def step(self, node: int, method: str, *arguments: Any, checks: bool = True) -> None:
        """Call a method that returns the node's next state."""
        self.states[node] = self.watched.call(method, self.states[node], *arguments)
        if checks:
            self.show(node, self.states[node], method)

    def emit(self, node: int, exchange: Exchange) -> Any:
        """Call emit and return the payload."""
        pair = self.watched.call("emit", self.states[node], exchange)
        both = type(pair) is tuple and len(pair) == 2
        where = f"{self.watched.name}.emit"
        demand(both, where, "must return (state, payload); payload None sends nothing")
        self.states[node], payload = pair
        self.show(node, self.states[node], "emit")
        return payload

    def absorb(self, node: int, messages: Sequence[Message], exchange: Exchange) -> None:
        """Hand over all messages of one instant."""
        self.step(node, "absorb", messages, exchange)
        stopped = self.watched.call("stopped", self.states[node])
        truth = stopped is True or stopped is False
        demand(truth, f"{self.watched.name}.stopped", "must be True or False", stopped)

    def sample(self, node: int, time: float) -> Reading:
        """Return a reading of the node's sensors at ``time``."""
        H, R = self.matrices(node != 1)
        return Reading(self.random.normal(size=len(H)) + H @ self.offset, H, R, time)

    def matrices(self, sees: bool) -> tuple[FloatArray, FloatArray]:
        """Return ``H`` and ``R`` of a node, without rows if it has no sensor."""
        system = self.system
        return (system.H, system.R) if sees else (system.H[:0], system.R[:0, :0])

    def shift(self) -> None:
        """Move the truth, in the run that does so."""
        if self._shift is None:
            return
        self.offset = self._shift.copy()
        for node in self.nodes:
            self.step(node, "shift", self.offset)

    def sums(self) -> dict[str, float]:
        """Return the sums over all nodes of the quantities that ``conserved`` names."""
        where = f"{self.watched.name}.conserved"
        parts = [self.watched.call("conserved", state) for state in self.states]
        same_keys = all(isinstance(p, dict) and p.keys() == parts[0].keys() for p in parts)
        demand(same_keys, where, "must name the same quantities at every node", parts[0])
        terms = {name: [np.atleast_1d(part[name]) for part in parts] for name in parts[0]}
        return {name: math.fsum(np.concatenate(values)) for name, values in terms.items()}

    def compare(self, before: dict[str, float], lost: str) -> None:
        """Check that the conserved sums are as they were before an exchange."""
        after = self.sums()
        for name, total in before.items():
            demand(
                abs(after[name] - total) <= CONSERVED * max(abs(total), 1.0),
                f"{self.watched.name}.conserved",
                f"the sum of {name} over all nodes must survive an exchange with {lost} lost",
                f"{total:.6g} before and {after[name]:.6g} after",
                "let absorb give to one node what it takes from another",
            )


def _make_network(part: Any) -> tuple[range, FloatArray]:
    """Return the nodes and weights (N, N) of a complete graph.

    N is the size of ``pair_weights``, else 3 if the weights allow two links, else 2. Entry [l, i]
    is the weight that node i gives to messages of node l.
    """
    given = part.pair_weights
    count = (3 if part.largest_degree() >= 2.0 else 2) if given is None else len(given)
    if given is None:
        given = np.full((count, count), part.weight(count - 1, count - 1))
    return range(count), np.asarray(given) * (1.0 - np.eye(count))
