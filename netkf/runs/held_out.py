"""Errors of predictions of readings that filters do not see: sensors with ``held_out``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.runs.files import require_run
from netkf.runs.readings import RunReadings, collect_readings
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


def held_out_errors(run: Run) -> list[dict[str, Any]]:
    """Return a row for each node of a ``run`` with a sensor that is ``held_out``, of its readings y
    minus H xhat of the node at their instants, after everything that happened until then; in slots
    of the samples. Readings of states that the node does not estimate are left out.

    node          : id
    readings      : number of values, over which the others are means
    mean_square   : squared errors of the predictions
    noise         : R as filters believe it; ``without_noise`` is ``mean_square`` less this
    expected      : diagonal of H P H' + R, what the node claims; nan without P
    nis           : e' (H P H' + R)^-1 e for each value, 1 if P is exact
    bias          : errors

    The run is simulated again. Raises ScenarioError and EngineError.
    """
    return errors_of_replica(require_run(run), run.seed, run.replica)


def errors_of_replica(scenario: Scenario, seed: int, replica: int) -> list[dict[str, Any]]:
    """Return ``held_out_errors`` of a ``replica`` of the runs of ``seed``."""
    held = scenario.held_out_sensors
    got = collect_readings(scenario, seed, replica, held, simulated=True)
    sums: dict[int, list[FloatArray]] = {}
    for node, e, S, R in _errors(scenario, got) if got.run is not None else ():
        known = np.isfinite(S).all()
        nis = float(e @ np.linalg.solve(S, e)) if known else math.nan
        terms = [len(e), e @ e, np.trace(R), np.trace(S), nis, e.sum()]
        sums.setdefault(node, []).append(np.array(terms))
    names = ("mean_square", "noise", "expected", "nis", "bias")
    rows: list[dict[str, Any]] = []
    for node in sorted(sums):
        count, *totals = np.sum(sums[node], axis=0).tolist()
        means = {name: total / count for name, total in zip(names, totals, strict=True)}
        less = means["mean_square"] - means["noise"]
        rows.append({"node": node, "readings": int(count), **means, "without_noise": less})
    return rows


def _errors(
    scenario: Scenario, got: RunReadings
) -> Iterator[tuple[int, FloatArray, FloatArray, FloatArray]]:
    """Yield the node of each reading, its error (p,), the covariance that it claims, and R."""
    run: Any = got.run
    for number, node, _, y, H, R, _ in got.readings:
        i = run.nodes.index(node)
        own, view = scenario.is_estimated[i], np.arange(scenario.plant.n)[scenario.view(i)]
        x = np.zeros(scenario.plant.n)
        x[view] = run.xhat[number, i, own] - got.origin[number][view]
        z, J = (y, H) if isinstance(H, np.ndarray) else H(y, x)
        if np.delete(J, view, axis=1).any():
            continue
        P = run.P[number, i][np.ix_(own, own)]
        yield node, z - J @ x, J[:, view] @ P @ J[:, view].T + R, R
