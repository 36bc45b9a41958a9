"""The exact covariance of all errors of one run in slots, given its regressors and its messages.

Given these, gains and covariances are deterministic and the errors e_i = x - xhat_i are linear in
the noises, D (10)-(12) and (16): their joint covariance follows slot by slot, with the state itself
as block 0, which the errors follow where the filters' F differs from the plant's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.baselines import Central, Local
from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.intermittent import Intermittent
from netkf.core.arrays import FloatArray, block_diagonal, symmetric
from netkf.core.errors import TheoryError
from netkf.core.streams import Streams
from netkf.plants.linear import Readings
from netkf.scenario.scenario import Scenario
from netkf.theory.coupled import own_steps
from netkf.trace.run import Run
from netkf.trace.schema import CODES

KNOWN = (DiffusionFilter, Gossip, Intermittent, Central, Local)
STEPS = ("init", "predict", "update", "emit", "absorb", "share", "estimate")
Arrived = dict[int, list[int]]


def stacked_slot_errors(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, M n, M n): covariance of the stacked x - xhat_i of M hosts, 1 where all nodes share one,
    and (T, M, n, n), their P.

    For all filters in slots but push-sum; raises TheoryError for that and for users' own.
    """
    algorithm = scenario.filter.algorithm
    known = next((k for k in KNOWN if isinstance(algorithm, k)), None)
    name = type(algorithm).__name__
    if known is None:
        raise TheoryError(f"no exact error covariance for {name}")
    own = own_steps(algorithm, known, STEPS)
    if own:
        raise TheoryError(
            f"the exact error covariance is not known: {name} defines {own[0]} itself"
        )
    errors = _Errors(scenario, Streams(run.seed, run.replica))
    arrived = _arrived(scenario, run)
    whole, covariances, done = [], [], 0
    for slot in np.round(run.times / scenario.slot_plant.period).astype(int).tolist():
        while done < slot:
            here = arrived.get(done, {})
            if not algorithm.predicts:
                errors.filter(done + 1)
            elif isinstance(algorithm, Gossip):
                errors.swap(here)
                errors.adapt(done, {})
            elif isinstance(algorithm, DiffusionFilter):
                errors.adapt(done, {})
                errors.combine(here)
            else:
                errors.adapt(done, here)
            done += 1
        whole.append(errors.of_hosts())
        covariances.append(errors.covariances())
    return np.array(whole), np.array(covariances)


def _arrived(scenario: Scenario, run: Run) -> dict[int, Arrived]:
    """For each slot and receiver, the senders whose messages were in time."""
    log = run.log[run.log["kind"] == CODES["deliver"]]
    slots = scenario.slot_plant.slots_of(log["t"])
    found: dict[int, Arrived] = {}
    for slot, node, peer in zip(
        slots.tolist(), log["node"].tolist(), log["peer"].tolist(), strict=True
    ):
        found.setdefault(slot, {}).setdefault(node, []).append(peer)
    return found


class _Host(NamedTuple):
    """The sensors of one filter, their R as believed and the root of the true one."""

    sensors: list[Readings]
    R: FloatArray
    root: FloatArray


class _Errors:
    """Block 0 is the state, block 1 + i the error of host i; P (M, n, n) as the filters have it."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        nodes, pooled = scenario.nodes, scenario.filter.algorithm.pooled
        self._scenario, self._n = scenario, scenario.plant.n
        groups = [scenario.sensing] if pooled else [(node,) for node in nodes]
        self._hosts = [_host(scenario, streams, group) for group in groups]
        self._root = block_diagonal([host.root for host in self._hosts])
        self._believed: dict[tuple[int, ...], FloatArray] = {}
        self._P = np.stack([scenario.start(node)[1] for node in nodes[: len(groups)]])
        cov = scenario.plant.start_cov
        self._sigma = np.tile(cov, (1 + len(groups), 1 + len(groups)))

    def of_hosts(self) -> FloatArray:
        """The covariance of the errors."""
        return self._sigma[self._n :, self._n :]

    def covariances(self) -> FloatArray:
        """P of the hosts."""
        return self._P.copy()

    def adapt(self, slot: int, arrived: Arrived) -> None:
        """D (6), (7), (12), R (15): update with the readings of a slot, the own ones and those that
        arrived, and predict.
        """
        F, Q = self._scenario.slot_belief
        rows = [_matrix(host, slot, self._n) for host in self._hosts]
        ends = np.cumsum([0, *map(len, rows)])
        moves, noise = [], np.zeros((len(rows) * self._n, ends[-1]))
        for i, node in enumerate(self._scenario.nodes):
            used = sorted({i, *(self._scenario.topology.index[p] for p in arrived.get(node, []))})
            H, R = np.concatenate([rows[j] for j in used]), self._noise(used)
            P = self._P[i]
            L = np.linalg.solve(H @ P @ H.T + R, H @ P @ F.T).T
            closed = F - L @ H
            self._P[i] = symmetric(closed @ P @ closed.T + L @ R @ L.T + Q)
            moves.append(closed)
            columns = np.concatenate([np.arange(ends[j], ends[j + 1]) for j in used])
            noise[i * self._n : (i + 1) * self._n, columns] = L
        self._move(moves, noise @ self._root, predicts=True)

    def _noise(self, hosts: list[int]) -> FloatArray:
        key = tuple(hosts)
        if key not in self._believed:
            self._believed[key] = block_diagonal([self._hosts[j].R for j in hosts])
        return self._believed[key]

    def swap(self, arrived: Arrived) -> None:
        """G (10): what a node received takes the place of its own."""
        index = self._scenario.topology.index
        came = np.arange(len(self._P))
        for node, peers in arrived.items():
            came[index[node]] = index[peers[-1]]
        blocks = np.concatenate([[0], 1 + came])
        entries = (blocks[:, None] * self._n + np.arange(self._n)).reshape(-1)
        self._P, self._sigma = self._P[came], self._sigma[np.ix_(entries, entries)]

    def filter(self, slot: int) -> None:
        """Predict to a slot, then update with its readings."""
        F, Q = self._scenario.slot_belief
        self._P = symmetric(F @ self._P @ F.T + Q)
        self._move([F] * len(self._hosts), np.zeros((len(self._hosts) * self._n, 0)), predicts=True)
        moves, noises = [], []
        for i, host in enumerate(self._hosts):
            H, P = _matrix(host, slot, self._n), self._P[i]
            K = np.linalg.solve(H @ P @ H.T + host.R, H @ P).T
            closed = np.eye(self._n) - K @ H
            self._P[i] = symmetric(closed @ P @ closed.T + K @ host.R @ K.T)
            moves.append(closed)
            noises.append(K @ host.root)
        self._move(moves, block_diagonal(noises), predicts=False)

    def combine(self, arrived: Arrived) -> None:
        """D (8)-(10) with the messages that arrived."""
        scenario, n, nodes = self._scenario, self._n, self._scenario.nodes
        algorithm, index = scenario.filter.algorithm, scenario.topology.index
        assert isinstance(algorithm, DiffusionFilter)
        informations = np.linalg.inv(self._P)
        mixed, P = np.eye(len(self._sigma)), self._P.copy()
        for i, node in enumerate(nodes):
            senders = sorted(arrived.get(node, []))
            own, weights = algorithm.share(
                scenario.own_weights[node], [scenario.weight(node, peer) for peer in senders]
            )
            shares = {i: own} | {index[p]: w for p, w in zip(senders, weights, strict=True)}
            P[i] = symmetric(np.linalg.inv(sum(w * informations[j] for j, w in shares.items())))
            for j, w in shares.items():
                mixed[_block(i, n), _block(j, n)] = w * P[i] @ informations[j]
        self._P = P
        self._sigma = symmetric(mixed @ self._sigma @ mixed.T)

    def _move(self, moves: list[FloatArray], noise: FloatArray, predicts: bool) -> None:
        plant, n = self._scenario.slot_plant, self._n
        whole = block_diagonal([plant.F if predicts else np.eye(n), *moves])
        if predicts:
            follow = plant.F - self._scenario.slot_belief[0]
            whole[n:, :n] = np.tile(follow, (len(moves), 1))
        sigma = whole @ self._sigma @ whole.T
        if predicts:
            sigma = sigma + np.tile(plant.Q, (1 + len(moves), 1 + len(moves)))
        sigma[n:, n:] += noise @ noise.T
        self._sigma = symmetric(sigma)


def _block(host: int, n: int) -> slice:
    return slice((1 + host) * n, (2 + host) * n)


def _host(scenario: Scenario, streams: Streams, nodes: tuple[int, ...]) -> _Host:
    placed = [(node, place) for node in nodes for place in scenario.placed.get(node, ())]
    sensors = [scenario.slot_path(streams, node, place) for node, place in placed]
    believed = [scenario.noise(place.entry, believed=True) for _, place in placed]
    true = [scenario.noise(place.entry, believed=False) for _, place in placed]
    roots = [np.asarray(np.linalg.cholesky(R), dtype=np.float64) for R in true]
    return _Host(sensors, block_diagonal(believed), block_diagonal(roots))


def _matrix(host: _Host, slot: int, n: int) -> FloatArray:
    return np.concatenate([np.zeros((0, n)), *(sensor.matrix(slot) for sensor in host.sensors)])
