"""What is promised of nodes that estimate different blocks of the state."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.filter import takes_columns
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.plants.transitions import Transitions
from netkf.rng.streams import Streams
from netkf.runs.labels import covariance_bias
from netkf.runs.tables import MAX_NODES, format_number, format_table
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import require_every_reading, require_linear
from netkf.theory.common.observations import (
    joseph_update,
    stack_information,
    timed_observations,
)
from netkf.theory.hybrid.limits import central_covariance
from netkf.theory.hybrid.samples import randomly_sampled_sensors

LEAST = "error covariance of the central filter of all blocks, below which no filter is"


def block_promises(scenario: Scenario) -> dict[str, Any]:
    """Return as plain data ``P``, how P compares with the covariance of errors, and by block that
    of the central filter, which no other falls below, ``when``, or the ``reason`` for none.
    """
    reason, when, covariance = None, "steady state", None
    try:
        require_linear(scenario)
        if scenario.slotted or not scenario.sampled_sensors:
            covariance = central_covariance(scenario.last_piece)
        else:
            when, covariance = f"at {scenario.horizon:g} s", central_at_horizon(scenario)
    except TheoryError as error:
        reason = str(error)
    blocks = []
    for node, places in zip(scenario.nodes, scenario.estimated, strict=True):
        for place in places:
            own = None if covariance is None else covariance[place.entries, place.entries]
            trace = None if own is None else np.trace(own)
            blocks.append({"node": node, "block": place.label, "value": own, "trace": trace})
    least = {"when": when, "reason": reason, "blocks": blocks}
    return {"P": _about_P(scenario), "least_error": least}


def _about_P(scenario: Scenario) -> str:
    if covariance_bias(scenario) == "larger":
        return "P is at least the covariance of the error, given the events, by design"
    keeps = scenario.is_linear and not scenario.forgetful_nodes
    if keeps and not scenario.node_filter.timing.talks:
        return "P is the covariance of the error where the filters know plant, sensors and start"
    if takes_columns(scenario.node_filter) and scenario.node_filter.analysis.paper:
        return "P is the covariance of the error, given the events, where all assumptions hold"
    held = "netkf consistency and netkf check compare it with that of the errors"
    if not (scenario.is_linear and takes_columns(scenario.node_filter)):
        held = "netkf consistency compares it with the errors"
    return f"nothing is promised of P: {held}"


def central_at_horizon(scenario: Scenario) -> FloatArray:
    """Return the covariance (n, n) at the horizon of the central filter; else TheoryError."""
    require_every_reading(scenario)
    if scenario.increment_sensors:
        raise TheoryError("samples beside increments: the least error covariance is not computed")
    for node, _ in randomly_sampled_sensors(scenario):
        raise TheoryError(f"node {node} samples at random times: every run has its own")
    central = scenario.replace({"filter": {"kind": "central"}})
    plant, P, now, piece = scenario.diffusion, scenario.plant.start_cov, 0.0, 0
    changes = plant.changes[plant.changes < scenario.horizon].tolist()
    samples = timed_observations(central, Streams(0, 0), join=stack_information)
    for time in sorted({*samples, *changes, scenario.horizon}):
        F, W = Transitions(plant.pieces[piece].A, plant.pieces[piece].B).law(time - now)
        P, now = F @ P @ F.T + W, time
        piece += time in changes
        for observation in samples.get(time, {}).values():
            P = joseph_update(P, observation)
    return P


def block_lines(promises: dict[str, Any]) -> list[str]:
    """Return the lines of ``netkf theory`` on the ``promises`` of :func:`block_promises`."""
    least = promises["least_error"]
    lines = ["", promises["P"], "", f"trace of the {LEAST}, {least['when']}"]
    if least["reason"]:
        return [*lines, f"  not known: {least['reason']}"]
    rows = [[str(b["node"]), b["block"], format_number(b["trace"])] for b in least["blocks"]]
    lines.append(format_table(["node", "block", "trace"], rows[:MAX_NODES]))
    return lines if len(rows) <= MAX_NODES else [*lines, f"{len(rows):,} blocks; --json has all"]
