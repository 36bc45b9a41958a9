"""Errors of nodes that read increments between events, as forms (``theory.common.forms``).

Between events the exact Kalman filter of such a node is a flow (``numerics.prediction``), in which
the verbs of filters go in short steps.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.riccati import state_units
from netkf.linalg.arrays import FloatArray, IntArray, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.common.forms import MEAN, Forms
from netkf.theory.common.observations import Observation, increment_observations
from netkf.theory.numerics.prediction import NODES, WEIGHTS, ErrorFlow, StateFlow


class IncrementFlows(NamedTuple):
    """Flows of errors in a run with increment sensors.

    groups : flows, each with the indices (K,) of the estimators that share it, so that they are
             propagated together
    reading : the estimators in them, which read increments
    plant : the flow of the true state
    follows : whether errors depend on the state, because the filters' A is not the plant's or a
              clock is wrong: flows are then those of the state and the error together, of which
              only the error has a P
    surprise : the response to an input that is left in the state, or None; n more noises of the
               plant then stand for what drives it, which is known
    """

    groups: list[tuple[ErrorFlow, IntArray]]
    reading: list[int]
    plant: StateFlow
    follows: bool
    surprise: Any

    @property
    def unit(self) -> float:
        """The time (seconds) over which series and quadrature of all flows hold."""
        return min(self.plant.unit, *(flow.unit for flow, _ in self.groups))

    def without(self, silent: Collection[int]) -> IncrementFlows | None:
        """Return the flows of all but ``silent`` estimators (indices), None if all are."""
        kept = [(flow, members[~np.isin(members, list(silent))]) for flow, members in self.groups]
        groups = [(flow, members) for flow, members in kept if len(members)]
        reading = [h for _, members in groups for h in members.tolist()]
        return self._replace(groups=groups, reading=reading) if groups else None

    def advance(
        self,
        forms: Forms,
        state: IntArray,
        estimates: IntArray,
        roots: FloatArray,
        until: tuple[float, float],
    ) -> None:
        """Move state and estimates, rows of ``forms``, between the two times ``until`` (s)."""
        now, end = until
        jumps = np.empty(0) if self.surprise is None else self.surprise.jumps
        for stop in [*jumps[(jumps > now) & (jumps < end)].tolist(), end]:
            steps = math.ceil((stop - now) / self.unit)
            gap = (stop - now) / steps
            for k in range(steps):
                self._step(forms, state, estimates, roots, (now + k * gap, gap))
            now = stop

    def _step(
        self,
        forms: Forms,
        state: IntArray,
        estimates: IntArray,
        roots: FloatArray,
        over: tuple[float, float],
    ) -> None:
        """Advance from a time on over a gap of seconds, at most the ``unit``."""
        start, gap = over
        # The plant's noise at the 8 nodes of the quadrature enters all errors; the noises of the
        # increments take n inputs for each estimate.
        n, common = len(state), self.plant.inputs
        size = 2 * n if self.follows else n
        first = forms.inputs(common + size * len(self.reading))
        used, noise = forms.used, first + common
        x = forms.table[state, :used]
        F, response = self.plant(gap)
        moved = F @ x
        moved[:, first:noise] += response
        for flow, members in self.groups:
            rows, own = estimates[members].reshape(-1), np.zeros((len(members), size, size))
            errors = np.empty((len(members), size, used))
            errors[:, :n] = x
            errors[:, -n:] = x - forms.table[rows, :used].reshape(-1, n, used)
            own[:, -n:, -n:] = roots[members]
            flow.move(errors, own, gap, (first, noise))
            roots[members] = own[:, -n:, -n:]
            forms.table[rows, :used] = (moved - errors[:, -n:]).reshape(-1, used)
            noise += size * len(members)
        forms.table[state, :used] = moved
        if self.surprise is not None:
            # What drives the state is known: its inputs belong to the mean.
            drive = np.sqrt(WEIGHTS * gap)[:, None] * self.surprise.drive(start + NODES * gap)
            known = first + np.arange(common).reshape(len(NODES), -1)[:, -n:].reshape(-1)
            forms.table[:, MEAN] += forms.table[:, known] @ drive.reshape(-1)
            forms.table[:, known] = 0.0


def integration_steps(scenario: Scenario) -> int:
    """Return the least number of steps in which errors are propagated; 0 without increments."""
    if scenario.slotted:
        return 0
    pieces = range(len(scenario.diffusion.pieces))
    flows = [increment_flows(scenario, len(scenario.nodes), piece) for piece in pieces]
    units = [flow.unit for flow in flows if flow is not None]
    return math.ceil(scenario.horizon / min(units)) if units else 0


def increment_flows(
    scenario: Scenario, estimators: int, piece: int = 0, paces: Sequence[float] | None = None
) -> IncrementFlows | None:
    """Return how errors with increments evolve in a ``piece`` of the plant; None without any.
    ``paces`` are the seconds that pass by the clock of each estimator in a second, 1 by default.
    """
    observations = increment_observations(scenario)
    if not any(len(observation.H) for observation in observations):
        return None
    believed, true = scenario.believed_pieces, scenario.diffusion.pieces[piece]
    A, Q = believed[min(piece, len(believed) - 1)]
    plant = true.A, true.B
    B = plant[1] if np.array_equal(plant[1] @ plant[1].T, Q) else square_root(Q)
    if scenario.surprise is not None:
        plant = (plant[0], np.column_stack([plant[1], np.eye(len(A))]))
    paces = [1.0] * estimators if paces is None else paces
    follows = not np.array_equal(A, plant[0]) or any(pace != 1.0 for pace in paces)
    members: dict[tuple[bytes, float], list[int]] = {}
    flows: dict[tuple[bytes, float], ErrorFlow] = {}
    for h, (observation, pace) in enumerate(zip(observations, paces, strict=False)):
        if not len(observation.H):
            continue
        # Estimators with equal sensors and clocks share a flow.
        key = b"|".join(part.tobytes() for part in observation), pace
        members.setdefault(key, []).append(h)
        if key not in flows:
            flows[key] = _error_flow((A, B), plant, observation, pace, follows)
    groups = [(flows[key], np.array(members[key])) for key in flows]
    reading = [h for indices in members.values() for h in indices]
    units = groups[0][0].units[: len(A)]
    return IncrementFlows(groups, reading, StateFlow(*plant, units), follows, scenario.surprise)


def _error_flow(
    believed: tuple[FloatArray, FloatArray],
    plant: tuple[FloatArray, FloatArray],
    observation: Observation,
    pace: float,
    follows: bool,
) -> ErrorFlow:
    """Return the flow of an error, or with ``follows`` of state and error, from A and B that are
    believed and those of the plant; ``pace`` seconds pass by the clock in a second.
    """
    (A, B), H, noise = believed, observation.H, plant[1]
    # The filter moves so much further, and its gain P H' R^-1 is that of its own time.
    A, B, R = pace * A, math.sqrt(pace) * B, pace * observation.R
    units = state_units(A, B @ B.T, H.T @ np.linalg.solve(R, H))
    if follows:
        # d(x, e) = (A x, (A - A_f) x + (A_f - L H) e) dt + (B, B) dw, less the noise of L dv in e.
        # Of dy = H x dt + dv the filter expects pace H xhat dt.
        zero, noise = np.zeros_like(A), np.concatenate([noise, noise])
        B = np.concatenate([np.zeros_like(B), B])
        A = np.block([[plant[0], zero], [plant[0] - A, A]])
        H, units = np.concatenate([(1.0 - pace) * H, pace * H], axis=1), np.tile(units, 2)
    return ErrorFlow(A, B, H, R, observation.root, noise, units)
