"""The push-sum filter written plainly along the links of a run: P of every node, and the covariance
of the errors of all nodes together, given which links were up.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.push_sum import PushSum
from netkf.core.arrays import FloatArray, block_diagonal
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

Up = dict[tuple[int, int, int], FloatArray]


def stacked_push_sum_errors(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, N n, N n) and (T, N, n, n): P Fig. 1 with the corrected update of the mass.

    At times before the horizon, since exchanges of a slot that begins there are not in the trace.
    Raises TheoryError for frozen or asymptotic gains and where the filters' F differs from the
    plant's.
    """
    algorithm = scenario.filter.algorithm
    assert isinstance(algorithm, PushSum)
    if algorithm.stop != "never" or algorithm.asymptotic:
        raise TheoryError("the exact errors are known while mass is exchanged in every slot")
    plant = scenario.slot_plant
    if not np.array_equal(scenario.slot_belief[0], plant.F):
        raise TheoryError("the exact errors are known for filters that have the plant's F")
    if any(sensor.varying for sensor in scenario.sensors):
        raise TheoryError("the exact errors are known for sensors whose H is fixed")
    slots = np.round(run.times / plant.period).astype(int).tolist()
    if slots and plant.over(slots[-1], scenario.horizon):
        words = "the exchanges of the slot at the horizon are not in the trace"
        raise TheoryError(f"{words}: sample before it")
    return _Plain(scenario, algorithm, _arrived(scenario, run, algorithm.gamma)).at(slots)


def _arrived(scenario: Scenario, run: Run, gamma: int) -> Up:
    """By slot, phase and step, (N, N): 1 where what j sent reached i in time."""
    index, size, period = scenario.topology.index, len(scenario.nodes), scenario.slot_plant.period
    rows = run.log[run.log["kind"] == CODES["deliver"]]
    sent, length = rows["t"] - rows["age"], scenario.phase_length
    slot = scenario.slot_plant.slots_of(sent)
    since = sent - slot * period - rows["phase"] * length
    step = np.where(rows["phase"] == 0, 0, np.round(since / (length / gamma))).astype(int)
    up: Up = {}
    columns = (slot, rows["phase"], step, rows["node"], rows["peer"])
    for t, phase, k, node, peer in zip(*(c.tolist() for c in columns), strict=True):
        matrix = up.setdefault((t, phase, k), np.zeros((size, size)))
        matrix[index[node], index[peer]] = 1.0
    return up


class _Plain:
    """Slot by slot."""

    def __init__(self, scenario: Scenario, algorithm: PushSum, up: Up) -> None:
        self._scenario, self._filter, self._up = scenario, algorithm, up
        self._n, self._N = scenario.plant.n, len(scenario.nodes)
        self._models = scenario.slot_models
        self._nu = np.array([scenario.topology.degrees[node] + 1 for node in scenario.nodes])

    def _received(self, slot: int, phase: int, step: int) -> FloatArray:
        return self._up.get((slot, phase, step), np.zeros((self._N, self._N)))

    def at(self, slots: list[int]) -> tuple[FloatArray, FloatArray]:
        """At increasing slots."""
        n, N, scenario = self._n, self._N, self._scenario
        own = np.array([m.H.T @ np.linalg.solve(m.R, m.H) for m in self._models])
        z = np.concatenate([np.zeros((N, 1)), np.ones((N, 1)), own.reshape(N, -1)], axis=1)
        z[scenario.topology.index[self._filter.leader], 0] = 1.0
        P = np.array([scenario.start(node)[1] for node in scenario.nodes])
        Sigma = np.tile(scenario.plant.start_cov, (N, N))
        F, Q = scenario.slot_belief
        whole, covariances = [], []
        for slot in range((slots[-1] if slots else 0) + 1):
            if slot > 0:
                received = self._received(slot, 0, 0)
                shares = z / self._nu[:, None]
                z = (self._nu - received.sum(axis=1))[:, None] * shares + received @ shares
                heard, weight = z[:, 0] > 0.0, np.where(z[:, 0] > 0.0, z[:, 0], 1.0)
                learned = z[:, 2:].reshape(N, n, n) / weight[:, None, None]
                G = np.where(heard[:, None, None], learned, own)
                ahead = F @ P @ F.T + Q
                P = np.linalg.solve(np.eye(n) + ahead @ G, ahead)
                P = 0.5 * (P + np.swapaxes(P, -1, -2))
                number = np.where(heard, z[:, 1] / weight, 1.0)
                Sigma = self._averaged(slot, self._sensed(Sigma, P, number))
            if slot in slots:
                whole.append(Sigma)
                covariances.append(P)
        return np.array(whole), np.array(covariances)

    def _sensed(self, Sigma: FloatArray, P: FloatArray, number: FloatArray) -> FloatArray:
        """Step 4: x - xhat after the reading of a slot."""
        n, plant, scenario = self._n, self._scenario.slot_plant, self._scenario
        moves, noise = [], []
        for i, model in enumerate(self._models):
            gain = number[i] * P[i] @ np.linalg.solve(model.R, model.H).T
            moves.append(np.eye(n) - gain @ model.H)
            noise.append(gain @ scenario.observation(scenario.nodes[i])[1] @ gain.T)
        closed = block_diagonal(moves)
        ahead = np.kron(np.eye(self._N), plant.F)
        moved = ahead @ Sigma @ ahead.T + np.tile(plant.Q, (self._N, self._N))
        return np.asarray(closed @ moved @ closed.T + block_diagonal(noise))

    def _averaged(self, slot: int, Sigma: FloatArray) -> FloatArray:
        """Step 5: gamma averaging steps."""
        for step in range(self._filter.gamma):
            received = self._received(slot, 1, step)
            laplacian = np.diag(received.sum(axis=1)) - received
            mixing = np.eye(self._N) - laplacian / self._filter.delta
            whole = np.kron(mixing, np.eye(self._n))
            Sigma = whole @ Sigma @ whole.T
        return Sigma
