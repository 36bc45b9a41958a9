"""Gaussian belief propagation over blocks of the state and readings of pairs of nodes.

The variable of a node is the path of its block: its states at the instants of readings and now. Its
own evidence is the motion of the block with the node's own readings, and a reading of a pair is a
factor of two paths. A message is what its sender believes of its own path without what it knows
from the receiver, together with its readings of the receiver's block; with these and its own
readings of the sender the receiver has independent evidence of its own path (Weiss and Freeman,
"Correctness of belief propagation in Gaussian graphical models of arbitrary topology", Neural
Computation 13, 2001).

It is the path and not the present state alone, because noise of the plant makes everything that is
known of two nodes depend on each other: messages about the present would be counted again in the
next slot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.algorithms.belief_propagation import MAX_STEPS, is_forest
from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, PairReading, Reading
from netkf.algorithms.registry import built_in
from netkf.algorithms.rows import Rows, pair_rows, stacked, updated
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray, square_root, symmetric

MAX_WINDOW = 1000
"""A message of more states could not be sent: a larger value is a mistake."""


ROUNDING = 1e-9
"""Relative deviation of traces that rounding explains."""


class JointEstimate(NamedTuple):
    """What is known of states at several instants: ``x`` (K n,) with covariance P (K n, K n)."""

    x: FloatArray
    P: FloatArray


SeenPairs = tuple[tuple[float, PairReading], ...]
"""Readings of pairs with their times."""


class PathState(NamedTuple):
    """The ``own`` evidence of a ``node`` about its ``blocks`` (n states) at the K ``times`` of its
    window and now, in this order; by sender the evidence ``heard`` of its window, as readings
    with unit noise, and when it was ``sent``; and the readings of pairs that the node has ``seen``.
    ``now`` is the time of its last readings.
    """

    own: JointEstimate
    times: tuple[float, ...]
    heard: Mapping[int, Rows]
    sent: Mapping[int, float]
    seen: SeenPairs
    now: float
    model: Any
    node: int
    blocks: tuple[Place, ...]

    @property
    def n(self) -> int:
        """The number of states of the node's blocks."""
        return len(self.own.x) // (len(self.times) + 1)

    def belief(self, without: int | None = None) -> JointEstimate:
        """Return all evidence together, or all but that of the sender ``without``."""
        evidence = [rows for sender, rows in self.heard.items() if sender != without]
        if not evidence:
            return self.own
        z, H, R = stacked(evidence, self.own.x[: -self.n])
        x, P, _ = updated(*self.own, Rows(z, np.pad(H, ((0, 0), (0, self.n))), R))
        return JointEstimate(x, P)

    @property
    def uncertainty(self) -> float:
        """The trace of the covariance of the present state."""
        return float(np.trace(self.belief().P[-self.n :, -self.n :]))

    def marked(self, time: float, window: int) -> PathState:
        """Return the state with the present in its window of so many instants."""
        if self.times and self.times[-1] == time:
            return self
        n, K = self.n, len(self.times)
        full = len(self.times) == window
        # The present twice; then, if the window is full, without the oldest.
        order = np.append(np.arange((K + 1) * n), np.arange(K * n, (K + 1) * n))
        times, heard = (*self.times, time), dict(self.heard)
        for sender, (z, H, R) in self.heard.items():
            heard[sender] = Rows(z, np.pad(H, ((0, 0), (0, n))), R)
            if full:
                # What the evidence says without the oldest state.
                rest = scipy.linalg.null_space(H[:, :n].T)
                later = heard[sender].H[:, n:]
                heard[sender] = Rows(rest.T @ z, rest.T @ later, np.eye(rest.shape[1]))
        if full:
            order, times = order[n:], times[1:]
        own = JointEstimate(self.own.x[order], self.own.P[np.ix_(order, order)])
        seen = tuple(one for one in self.seen if one[0] >= times[0])
        return self._replace(own=own, times=times, heard=heard, seen=seen)


class PathMessage(NamedTuple):
    """What a node sends: its ``belief`` at the ``times`` of its window, the last of them now; by
    receiver what it believes ``without`` what it knows from that one; and the readings of pairs
    that it has ``seen``.
    """

    times: tuple[float, ...]
    belief: JointEstimate
    without: Mapping[int, JointEstimate]
    seen: SeenPairs
    blocks: tuple[Place, ...]


def note_loops(scenario: Any) -> tuple[str, ...]:
    """Return a note for the user where the graph of a ``netkf.Scenario`` has loops."""
    rule = "the graph has loops, on which evidence returns and counts again; P is too small"
    return () if is_forest(scenario) else (f"block-belief-propagation: {rule}",)


def refuse_moving_bits(scenario: Any) -> None:
    """Raise ScenarioError where few bits would say states that are counted from a response."""
    if scenario.network.quantise and scenario.plant.linear and scenario.knows_input:
        raise ScenarioError(
            "network.quantise",
            "cannot stand beside an input that the block-belief-propagation filter knows: its "
            "messages are of states at several times",
            scenario.network.quantise.bits,
            "remove it",
        )


@built_in("block-belief-propagation")
@dataclass(frozen=True, eq=False)
class BlockBeliefPropagation(Filter):
    """Each node estimates a block of its own by what its neighbours believe of theirs and what both
    have read of each other.

    steps   messages on each directed link in a slot
    window  instants that nodes remember. A message replaces that which was heard before, of which
            only what it says of the window is kept, unless that makes P smaller than the new one

    On a tree P is the covariance of the error, whatever is lost, late or out of order, also with
    noise of the plant: lost messages keep the last one heard. With a window as long as the run it
    is that of the Kalman filter with all readings that have reached the node; if nothing is lost
    and ``steps`` is the diameter of the tree, that of all blocks. A shorter window makes P larger.
    Where links form loops P is too small. What is not linear is linearised at beliefs.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)
    window: int = field(integer(low=1, high=MAX_WINDOW), default=10)

    needs = Needs(
        one_way=True,
        samples=True,
        blocks=True,
        own_blocks=True,
        check=refuse_moving_bits,
        notes=note_loops,
    )

    @property
    def timing(self) -> Timing:
        """The only exchange of a slot has ``steps`` steps."""
        return Timing(steps=lambda _: self.steps)

    @property
    def analysis(self) -> Analysis:
        """The size of a message to one receiver."""
        return Analysis("belief_propagation", affine=True, payload_numbers=self._numbers)

    def _numbers(self, n: int, _rows: int, _phase: int) -> float:
        size = self.window * n
        return 2 * size + size * (size + 1) // 2

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> PathState:
        """Return the state at time 0, at which errors of different nodes are independent."""
        places = node.blocks or (Place("plant", None, 0, len(mean)),)
        own = JointEstimate(np.array(mean), np.array(cov))
        return PathState(own, (), {}, {}, (), 0.0, model, node.node, places)

    def predict(self, state: PathState, gap: float) -> PathState:
        """Return the state ``gap`` seconds later: the present moves, the window does not."""
        n, (x, P) = state.n, state.own
        # Dynamics that are not linear are linearised at the belief, the best estimate.
        b = state.belief().x[-n:]
        Phi = state.model.transition(b, gap)
        moved, root = state.model.predict(b, np.zeros((n, n)), gap)
        x = np.concatenate([x[:-n], moved + Phi @ (x[-n:] - b)])
        step = scipy.linalg.block_diag(np.eye(len(x) - n), Phi)
        P = step @ P @ step.T
        P[-n:, -n:] += root @ root.T
        return state._replace(own=JointEstimate(x, symmetric(P)))

    def update(self, state: PathState, reading: Reading) -> PathState:
        """Return the state after the readings of its own block; those of pairs are kept."""
        x, P = state.own
        H = np.pad(reading.H, ((0, 0), (len(x) - state.n, 0)))
        x, P, _ = updated(x, P, Rows(reading.y, H, reading.R))
        seen = *state.seen, *((reading.time, pair) for pair in reading.pairs)
        state = state._replace(own=JointEstimate(x, P), seen=seen, now=reading.time)
        return state.marked(reading.time, self.window) if reading.pairs else state

    def emit(self, state: PathState, exchange: Exchange) -> tuple[PathState, PathMessage]:
        """Return what the node believes of its path. In slots the present becomes part of it:
        others may have read the block.
        """
        marked = state.marked(_time(state, exchange), self.window)
        n = state.n

        def past_of(belief: JointEstimate) -> JointEstimate:
            return JointEstimate(belief.x[:-n], belief.P[:-n, :-n])

        without = {sender: past_of(marked.belief(without=sender)) for sender in marked.heard}
        message = PathMessage(
            marked.times, past_of(marked.belief()), without, marked.seen, state.blocks
        )
        return marked if exchange.slot >= 0 else state, message

    def absorb(
        self, state: PathState, messages: Sequence[Message], exchange: Exchange
    ) -> PathState:
        """Return the state with the evidence of each sender replaced by that of its message, unless
        the one that the node has was sent later.
        """
        time = _time(state, exchange)
        own = {place.key for place in state.blocks}
        told = {message.sender: message.payload for message in messages}
        if any(t == time and pair.other in own for one in told.values() for t, pair in one.seen):
            state = state.marked(time, self.window)
        for sender, message in told.items():
            if message.times[-1] < state.sent.get(sender, 0.0):
                continue
            rows = evidence_of(state, message, message.without.get(state.node, message.belief))
            after = state._replace(
                heard={**state.heard, sender: rows},
                sent={**state.sent, sender: message.times[-1]},
            )
            # What was kept of an older message may say more, if windows are short.
            if after.uncertainty <= (1.0 + ROUNDING) * state.uncertainty:
                state = after
        return state

    def estimate(self, state: PathState) -> tuple[FloatArray, FloatArray]:
        """Return xhat (n,) and P (n, n)."""
        n, (x, P) = state.n, state.belief()
        return x[-n:], P[-n:, -n:]

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state with ``offset`` (n,) added to the present; states of the window, of which
        messages are made, keep the coordinates of their time.
        """
        if isinstance(state, PathMessage):
            return state
        x = state.own.x.copy()
        x[-state.n :] += offset
        return state._replace(own=JointEstimate(x, state.own.P))


def _time(state: PathState, exchange: Exchange) -> float:
    """Return the time of the readings of this instant, in slots that of the node's last ones."""
    return state.now if exchange.slot >= 0 else exchange.time


def evidence_of(state: PathState, message: PathMessage, belief: JointEstimate) -> Rows:
    """Return what a message with the sender's ``belief`` says of the window of a node, as readings
    with unit noise: all readings of the pair at instants that both remember.
    """
    n, m, known = state.n, len(belief.x) // len(message.times), state.belief()
    mine, theirs = (dict(zip(t, range(len(t)), strict=True)) for t in (state.times, message.times))
    # By instant.
    x, x_j = (p.x.reshape(-1, k, *p.x.shape[1:]) for p, k in ((known, n), (message.belief, m)))
    found, both = list[Rows](), ((True, state.seen), (False, message.seen))
    for is_own, t, pair in ((own, *one) for own, seen in both for one in seen):
        if t not in mine or t not in theirs:
            continue
        k, j = mine[t], theirs[t]
        ends = (x[k], message.blocks, x_j[j]) if is_own else (x_j[j], state.blocks, x[k])
        for z, H, R in pair_rows([pair], *ends):
            H_k, H_j = (H[:, :n], H[:, n:]) if is_own else (H[:, m:], H[:, :m])
            G = np.zeros((len(z), len(state.times) * n))
            G_j = np.zeros((len(z), len(belief.x)))
            G[:, k * n : (k + 1) * n], G_j[:, j * m : (j + 1) * m] = H_k, H_j
            found.append(Rows(z - G_j @ belief.x, np.hstack([G, G_j]), R))
    K = len(state.times) * n
    z, H, R = stacked(found, np.concatenate([known.x[:K], belief.x]))
    # The root of H P H' + R, without the squares: near each other nodes have large derivatives.
    roots = np.hstack([H[:, K:] @ square_root(belief.P), np.linalg.cholesky(R)])
    root = np.asarray(np.linalg.qr(roots.T, mode="r")).T
    z, H = (scipy.linalg.solve_triangular(root, part, lower=True) for part in (z, H[:, :K]))
    if len(H) > K:
        # As many readings as states say the same.
        turned, H = np.linalg.qr(H)
        z = turned.T @ z
    return Rows(z, H, np.eye(len(H)))
