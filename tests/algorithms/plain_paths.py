"""Belief propagation over paths of blocks in plain Python, without a limit of the window: what the
kernels of ``block-belief-propagation`` must compute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.parts import Filter, Message, Needs


class Belief(NamedTuple):
    """Mean (K n,) and covariance (K n, K n) of states at several instants."""

    x: np.ndarray
    P: np.ndarray

    def after(self, z: np.ndarray, H: np.ndarray, R: np.ndarray) -> Belief:
        S = H @ self.P @ H.T + R
        K = np.linalg.solve(S, H @ self.P).T
        stays = np.eye(len(self.x)) - K @ H
        return Belief(self.x + K @ (z - H @ self.x), stays @ self.P @ stays.T + K @ R @ K.T)

    def first(self, count: int) -> Belief:
        return Belief(self.x[:count], self.P[:count, :count])


class Path(NamedTuple):
    """``own`` is what a node knows by itself of its states at ``times`` and now; ``heard`` are z, H
    and R of its window by sender; ``seen`` are the readings of pairs that it has, with their times.
    """

    own: Belief
    times: tuple[float, ...]
    heard: Mapping[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    sent: Mapping[int, float]
    seen: tuple[tuple[float, Any], ...]
    now: float
    model: Any
    info: Any

    @property
    def n(self) -> int:
        return len(self.own.x) // (len(self.times) + 1)

    def belief(self, without: int | None = None) -> Belief:
        belief = self.own
        for sender, (z, H, R) in self.heard.items():
            if sender != without:
                wide = np.pad(H, ((0, 0), (0, len(belief.x) - H.shape[1])))
                belief = belief.after(z, wide, R)
        return belief

    def marked(self, time: float) -> Path:
        if self.times and self.times[-1] == time:
            return self
        twice = np.append(np.arange(len(self.own.x)), np.arange(-self.n, 0))
        own = Belief(self.own.x[twice], self.own.P[np.ix_(twice, twice)])
        return self._replace(own=own, times=(*self.times, time))


class Told(NamedTuple):
    times: tuple[float, ...]
    belief: Belief
    without: Mapping[int, Belief]
    seen: tuple[tuple[float, Any], ...]
    blocks: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class PlainPaths(Filter):
    """The filter; ``timing`` is that of one step a slot."""

    needs = Needs(one_way=True, samples=True, blocks=True, own_blocks=True)

    def init(self, model: Any, mean: np.ndarray, cov: np.ndarray, node: Any) -> Path:
        return Path(Belief(np.array(mean), np.array(cov)), (), {}, {}, (), 0.0, model, node)

    def predict(self, state: Path, gap: float) -> Path:
        n, (x, P), b = state.n, state.own, state.belief().x[-state.n :]
        Phi = state.model.transition(b, gap)
        moved, root = state.model.predict(b, np.zeros((n, n)), gap)
        step = scipy.linalg.block_diag(np.eye(len(x) - n), Phi)
        P = step @ P @ step.T
        P[-n:, -n:] += root @ root.T
        x = np.append(x[:-n], moved + Phi @ (x[-n:] - b))
        return state._replace(own=Belief(x, (P + P.T) / 2.0))

    def update(self, state: Path, reading: Any) -> Path:
        wide = np.pad(reading.H, ((0, 0), (len(state.own.x) - state.n, 0)))
        own = state.own.after(reading.y, wide, reading.R)
        seen = *state.seen, *((reading.time, pair) for pair in reading.pairs)
        state = state._replace(own=own, seen=seen, now=reading.time)
        return state.marked(reading.time) if reading.pairs else state

    def emit(self, state: Path, exchange: Any) -> tuple[Path, Told]:
        marked = state.marked(time_of(state, exchange))
        count = len(marked.times) * state.n
        without = {sender: marked.belief(sender).first(count) for sender in marked.heard}
        whole = marked.belief().first(count)
        told = Told(marked.times, whole, without, marked.seen, state.info.blocks)
        return (marked if exchange.slot >= 0 else state), told

    def absorb(self, state: Path, messages: Sequence[Message], exchange: Any) -> Path:
        time, own = time_of(state, exchange), {place.key for place in state.info.blocks}
        seen = [one for message in messages for one in message.payload.seen]
        if any(t == time and pair.other in own for t, pair in seen):
            state = state.marked(time)
        for message in messages:
            told = message.payload
            if told.times[-1] >= state.sent.get(message.sender, 0.0):
                evidence = evidence_of(state, told)
                heard = {**state.heard, message.sender: evidence}
                sent = {**state.sent, message.sender: told.times[-1]}
                state = state._replace(heard=heard, sent=sent)
        return state

    def estimate(self, state: Path) -> tuple[np.ndarray, np.ndarray]:
        x, P = state.belief()
        return x[-state.n :], P[-state.n :, -state.n :]

    def shift(self, state: Any, offset: np.ndarray) -> Any:
        if isinstance(state, Told):
            return state
        x = state.own.x.copy()
        x[-state.n :] += offset
        return state._replace(own=Belief(x, state.own.P))


def time_of(state: Path, exchange: Any) -> float:
    return state.now if exchange.slot >= 0 else exchange.time


def evidence_of(state: Path, told: Told) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All readings of the pair at instants that both remember, with what the sender believes."""
    theirs = told.without.get(state.info.node, told.belief)
    n, K, x = state.n, len(state.times), state.belief().x
    m = len(theirs.x) // len(told.times)
    z, G, G_j, R = [np.zeros(0)], [np.zeros((0, K * n))], [np.zeros((0, len(theirs.x)))], []
    for is_own, t, pair in (
        (own, *one) for own, seen in ((True, state.seen), (False, told.seen)) for one in seen
    ):
        places = {p.key: p for p in (told.blocks if is_own else state.info.blocks)}
        if t not in state.times or t not in told.times or pair.other not in places:
            continue
        k, j, place = state.times.index(t), told.times.index(t), places[pair.other].entries
        mine, other = x[k * n : (k + 1) * n], told.belief.x[j * m : (j + 1) * m]
        value, J, J_other = pair.H(*((mine, other[place]) if is_own else (other, mine[place])))
        row, row_j = np.zeros((len(value), K, n)), np.zeros((len(value), len(told.times), m))
        (row if is_own else row_j)[:, k if is_own else j] = J
        (row_j if is_own else row)[:, j if is_own else k, place] = J_other
        z.append(value)
        G.append(row.reshape(len(value), -1))
        G_j.append(row_j.reshape(len(value), -1))
        R.append(pair.R)
    z_all, G_all, all_j = np.concatenate(z), np.concatenate(G), np.concatenate(G_j)
    noise = scipy.linalg.block_diag(*R) if R else np.zeros((0, 0))
    return z_all - all_j @ theirs.x, G_all, all_j @ theirs.P @ all_j.T + noise
