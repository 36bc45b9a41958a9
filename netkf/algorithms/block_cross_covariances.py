"""Cooperative localisation with kept cross-covariances: nodes that estimate blocks of their own
keep for each neighbour how the errors of both correlate.

Luft, Schubert, Roumeliotis and Burgard, "Recursive decentralized localization for multi-robot
systems with asynchronous pairwise communication", International Journal of Robotics Research
37(10), 2018.

The cross-covariance of the errors of nodes i and j is ``A_i C A_j'``. What changes the error of one
node alone, a prediction, an own reading and, in approximation, what it hears of a third node,
multiplies its own factor, which needs no message. Two nodes that hear each other compute the same
update from what both have sent, and renew C. In the paper they always hear each other. Here one of
both messages may be lost, and its sender does not know. So a node writes the new C in factors that
both know, those since their last update together, and tells it with its next message: two nodes
know their cross-covariance whatever is lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, PairReading, Reading
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.algorithms.rows import Rows, pair_rows, stacked, updated
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray, symmetric

MAX_STEPS = 1000
"""More than any network needs: a larger value is a mistake."""
MAX_CONDITION = 1e10
"""Condition number of a factor that is inverted, beyond which too many digits would be lost."""
NEVER = -1.0
"""The time of the last update with a node that was never heard: errors are independent."""


class Tie(NamedTuple):
    """What a node keeps for a neighbour: the factors of their cross-covariance, A (n, n) of its own
    and C (n, n') that both share, twice.

    base, core : A and C since the time ``since``, of the last update known to be that of both nodes
    last, seen : A and C since the last update by this node, at the time ``when``
    """

    base: FloatArray
    core: FloatArray
    since: float
    last: FloatArray
    seen: FloatArray
    when: float

    def moved(self, T: FloatArray) -> Tie:
        """Return the tie after the node's error was multiplied by ``T`` (n, n)."""
        return self._replace(base=T @ self.base, last=T @ self.last)

    def of(self, n: int) -> Tie:
        """Return the tie with C (n, n') for a neighbour with a block of ``n`` states."""
        if self.when != NEVER or self.core.shape[1] == n:
            return self
        nothing = np.zeros((len(self.base), n))
        return self._replace(core=nothing, seen=nothing)


class PairMessage(NamedTuple):
    """What a node sends: the estimate ``xhat`` (n,) of its ``blocks`` with covariance P (n, n) and
    ``ties`` by neighbour, all before the readings of this instant; and these, its ``own`` and those
    of ``pairs``.
    """

    xhat: FloatArray
    P: FloatArray
    ties: Mapping[int, Tie]
    blocks: tuple[Place, ...]
    own: Rows
    pairs: tuple[PairReading, ...] = ()


class PairState(NamedTuple):
    """Estimate ``xhat`` (n,) of a ``node``, its covariance P (n, n), the ``ties`` by neighbour, and
    what it sends at this instant.
    """

    xhat: FloatArray
    P: FloatArray
    ties: Mapping[int, Tie]
    model: Any
    node: int
    message: PairMessage

    def moved(self, T: FloatArray, but: int | None = None) -> dict[int, Tie]:
        """Return the ties after the node's error was multiplied by ``T`` (n, n), but for one."""
        return {k: tie if k == but else tie.moved(T) for k, tie in self.ties.items()}

    def told(self, pairs: tuple[PairReading, ...] = ()) -> PairState:
        """Return the state that tells its estimate as it is, without own readings to use."""
        own = stacked([], self.xhat)
        message = PairMessage(self.xhat, self.P, self.ties, self.message.blocks, own, pairs)
        return self._replace(message=message)


class Joint(NamedTuple):
    """Estimate ``x`` (n + n',) and covariance P of two nodes together before the readings of an
    instant, as both know them: the ``own`` ones of the first, and the ``others``, those of the
    second and of the pair; the ``tie`` of the first after all of them, and whether it may use them.
    """

    x: FloatArray
    P: FloatArray
    own: Rows
    others: Rows
    tie: Tie
    usable: bool


def require_both_ways(scenario: Any) -> None:
    """Raise ScenarioError if links of a ``netkf.Scenario`` go one way."""
    if scenario.topology.directed:
        rule = "must have links that go both ways for block-cross-covariances, whose nodes answer"
        remedy = 'leave directed out, or write kind = "block-intersection"'
        raise ScenarioError("network.graph.directed", rule, True, remedy)


@built_in("block-cross-covariances")
@dataclass(frozen=True, eq=False)
class BlockCrossCovariances(Filter):
    """Each node estimates a block of its own and keeps the cross-covariances with its neighbours,
    with whom it uses all that either has read at an instant, of itself and of the other.

    steps   of a slot, in which pairs take turns: nodes i and j exchange in step (i + j) % steps

    Two nodes that hear each other are the Kalman filter of both blocks; whatever is lost between
    two, P is the covariance of the error. With more nodes the cross-covariance with a third is
    approximated as if the readings of a pair had been own ones, and nothing is proved of P: the
    more pairs have nodes in common the more overconfident it is, most where they exchange at once,
    as pairs of one step do, and under clocks all of one instant. Both nodes are updated if both
    transmit at the instant of the readings; one that hears nothing then is not. A message that took
    time is used for nothing.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=8)

    needs = Needs(one_way=True, samples=True, blocks=True, own_blocks=True, check=require_both_ways)
    # To one receiver, of whom it says two factors and two cores.
    analysis = Analysis(
        paper="block_cross_covariances",
        affine=True,
        payload_numbers=lambda n, *_: n + n * (n + 1) // 2 + 4 * n * n,
    )

    @property
    def timing(self) -> Timing:
        """The only exchange of a slot has ``steps`` steps."""
        return Timing(steps=lambda _: self.steps, decides=True)

    def _has_turn(self, node: int, other: int, exchange: Exchange) -> bool:
        """Return True if two nodes (ids) exchange now; under clocks they do whenever they can."""
        return exchange.slot < 0 or (node + other) % self.steps == exchange.step

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> PairState:
        """Return the state at time 0, at which errors of different nodes are independent."""
        places = node.blocks or (Place("plant", None, 0, len(mean)),)
        one, nothing = np.eye(len(mean)), np.zeros((len(mean), 0))
        ties = {k: Tie(one, nothing, NEVER, one, nothing, NEVER) for k in node.senders}
        xhat, P = np.array(mean), np.array(cov)
        message = PairMessage(xhat, P, ties, places, stacked([], xhat))
        return PairState(xhat, P, ties, model, node.node, message)

    def predict(self, state: PairState, gap: float) -> PairState:
        """Return the state ``gap`` seconds later; the noise of the plant is the block's own."""
        Phi = state.model.transition(state.xhat, gap)
        xhat, root = state.model.predict(state.xhat, first_root(state.P), gap)
        P = symmetric(root @ root.T)
        return state._replace(xhat=xhat, P=P, ties=state.moved(Phi)).told()

    def update(self, state: PairState, reading: Reading) -> PairState:
        """Return the state after the readings of its own block; those of pairs are kept for the
        exchange of this instant.
        """
        own = Rows(reading.y, reading.H, reading.R)
        xhat, P, stays = updated(state.xhat, state.P, own)
        message = state.message._replace(own=own, pairs=reading.pairs)
        return state._replace(xhat=xhat, P=P, ties=state.moved(stays), message=message)

    def emit(self, state: PairState, exchange: Exchange) -> tuple[PairState, PairMessage | None]:
        """Return the estimate with the factors of all ties, and the readings of this instant; None
        if no pair has its turn.
        """
        talks = any(self._has_turn(state.node, j, exchange) for j in state.ties)
        return state, state.message if talks else None

    def absorb(
        self, state: PairState, messages: Sequence[Message], exchange: Exchange
    ) -> PairState:
        """Return the state after the updates with all senders, one after the other."""
        mine, joints = state.message, {}
        for message in messages:
            told: PairMessage = message.payload
            # Nodes that estimate the same blocks, as all do in one plant, are no pairs.
            is_pair = message.age == 0.0 and told.blocks != mine.blocks
            if is_pair and self._has_turn(state.node, message.sender, exchange):
                ties = mine.ties[message.sender], told.ties[state.node]
                joints[message.sender] = joint_of(mine, told, ties, exchange.time)
        if not joints:
            return state
        renewed = {j: joint.tie for j, joint in joints.items()}
        state = state._replace(ties={**state.ties, **renewed})
        for j, joint in joints.items():
            if joint.usable and len(joint.others.z):
                state = self._heard(state, j, joint)
        # Each pair has one turn: those that are left are about others.
        return state.told(state.message.pairs)

    def _heard(self, state: PairState, j: int, joint: Joint) -> PairState:
        """Return the state after the readings of node ``j`` and of the pair."""
        n = len(state.xhat)
        x, P, _ = updated(joint.x, joint.P, joint.own)
        # What other senders of this instant have changed since.
        X = state.ties[j].last @ P[:n, n:]
        x = np.concatenate([state.xhat, x[n:]])
        P = np.block([[state.P, X], [X.T, P[n:, n:]]])
        x, P, _ = updated(x, P, joint.others)
        ties = state.moved(ratio(P[:n, :n], state.P), but=j)
        return state._replace(xhat=x[:n], P=P[:n, :n], ties=ties)

    def estimate(self, state: PairState) -> tuple[FloatArray, FloatArray]:
        """Return xhat (n,) and P (n, n)."""
        return state.xhat, state.P

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state, or a message, with ``offset`` (n,) added to the estimate."""
        if isinstance(state, PairState):
            state = state._replace(message=self.shift(state.message, offset))
        return state._replace(xhat=state.xhat + offset)


def joint_of(mine: PairMessage, theirs: PairMessage, ties: tuple[Tie, Tie], time: float) -> Joint:
    """Return what two nodes with these ``ties`` know together at a ``time``: both compute the same,
    each for itself.
    """
    n, m = len(mine.xhat), len(theirs.xhat)
    A, C, A_j, since = shared_factors(ties[0].of(m), ties[1].of(n))
    X = A @ C @ A_j.T
    own = mine.own._replace(H=np.pad(mine.own.H, ((0, 0), (0, m))))
    others = [theirs.own._replace(H=np.pad(theirs.own.H, ((0, 0), (n, 0))))]
    others += pair_rows(mine.pairs, mine.xhat, theirs.blocks, theirs.xhat)
    for z, H, R in pair_rows(theirs.pairs, theirs.xhat, mine.blocks, mine.xhat):
        others.append(Rows(z, np.roll(H, n, axis=1), R))
    x = np.concatenate([mine.xhat, theirs.xhat])
    P = np.block([[mine.P, X], [X.T, theirs.P]])
    # Own readings are used by both nodes alone, if nothing else is.
    stay, stay_j = (updated(one.xhat, one.P, one.own)[2] for one in (mine, theirs))
    A, A_j = stay @ A, stay_j @ A_j
    usable, X = can_invert(A) and can_invert(A_j), stay @ X @ stay_j.T
    seen = stacked([own, *others], x)
    if usable and len(seen.z):
        # An error does not correlate with the innovations that have updated it: so this is the
        # cross-covariance, whether the other node hears them too or not.
        X = updated(x, P, seen)[1][:n, n:]
        C = np.linalg.solve(A, np.linalg.solve(A_j, X.T).T)
    tie = Tie(A, C, since, np.eye(n), X, time)
    return Joint(x, P, own, stacked(others, x), tie, usable)


def shared_factors(mine: Tie, theirs: Tie) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return A (n, n), C (n, n') and A_j (n', n') of two nodes, from the ties of both, and the time
    since when A and A_j count.
    """
    if mine.when == theirs.when:
        return mine.last, mine.seen, theirs.last, mine.when
    # Of two nodes one may know later that an update was that of both; the other has not been
    # updated since.
    since = max(mine.since, theirs.since)
    A, A_j = (tie.base if tie.since == since else tie.last for tie in (mine, theirs))
    return A, mine.core if mine.when > theirs.when else theirs.core.T, A_j, since


def can_invert(A: FloatArray) -> bool:
    """Return True if the columns of a factor A (n, n), in whatever units, are independent."""
    sizes = np.linalg.norm(A, axis=0)
    return bool(sizes.all() and np.linalg.cond(A / sizes) < MAX_CONDITION)


def ratio(after: FloatArray, before: FloatArray) -> FloatArray:
    """Return ``after before^-1`` (n, n) of two covariances (n, n), the factor by which an own
    reading would have multiplied the error.
    """
    units = np.sqrt(np.where(np.diag(before) > 0.0, np.diag(before), 1.0))
    scale = np.outer(units, units)
    # Singular where something is known for certain.
    scaled = (after / scale) @ np.linalg.pinv(before / scale, hermitian=True)
    return np.asarray(units[:, None] * scaled / units)
