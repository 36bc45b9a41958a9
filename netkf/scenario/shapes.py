"""Checks of shapes: of arrays, of what regressor and nonlinear sensors read, and of weights."""

from __future__ import annotations

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.regressors import RegressorSensor
from netkf.scenario.derived import DerivedScenario


def require_shape(key: str, value: FloatArray, shape: tuple[int | None, ...], why: str) -> None:
    """Raise ScenarioError at ``key`` unless ``value`` has the ``shape`` (None: any length)."""
    fits = len(value.shape) == len(shape) and all(
        length is None or actual == length
        for actual, length in zip(value.shape, shape, strict=True)
    )
    if not fits:
        expected = " x ".join("any" if length is None else str(length) for length in shape)
        actual_shape = " x ".join(map(str, value.shape))
        rule = f"must be {expected}, not {actual_shape}, because {why}"
        raise ScenarioError(key, rule, value, "correct the shape")


def check_schedule(scenario: DerivedScenario, why: str) -> None:
    """Raise ScenarioError for wrong shapes in ``plant.schedule``, or a change between slots."""
    plant, n = scenario.plant, scenario.plant.n
    for k, change in enumerate(getattr(plant, "schedule", ())):
        for name, value in change.matrices.items():
            key, width = f"plant.schedule[{k}].{name}", None if name == "B" else n
            if isinstance(plant, NonlinearDiffusion):
                # Noise is drawn step by step, of one number of components.
                width = plant.B.shape[1]
            if name == "G":
                if plant.input is None:
                    rule = "belongs to a plant with an input"
                    raise ScenarioError(key, rule, value, "add [plant.input], or leave it out")
                width = plant.input.m
            require_shape(key, value, (n, width), why)
        if not scenario.slotted:
            continue
        period, start = scenario.slot_plant.period, float(plant.schedule_times[k])
        if scenario.slot_plant.slot_time(round(start / period)) != start:
            rule = f"must be a multiple of plant.period = {period:.15g}, where a slot begins"
            remedy = f"give {period * round(start / period):.15g}"
            raise ScenarioError(f"plant.schedule[{k}].from", rule, start, remedy)


def check_changes_on_grid(scenario: DerivedScenario, period: float) -> None:
    """Raise ScenarioError unless changes are points of the grid of ``period`` seconds."""
    for k, change in enumerate(scenario.plant.changes.tolist()):
        nearest = scenario.time_grid.instant(round(change / period) * period)
        if change < scenario.horizon and nearest != change:
            key, other = f"plant.schedule[{k}].from", "plant.sensing_period"
            rule = f"must be a multiple of {other} = {period:.15g}, where sensors read increments"
            remedy = f"give {nearest:.15g}, or another {other}"
            raise ScenarioError(key, rule, change, remedy)


def check_regressor(scenario: DerivedScenario, key: str, sensor: RegressorSensor) -> None:
    """Raise ScenarioError for wrong shapes of a regressor at ``key``, or continuous time."""
    if not scenario.slotted:
        rule = "belongs to plants in slots (linear), and this plant is in continuous time"
        remedy = "change the plant or use a linear sensor"
        raise ScenarioError(f"{key}.kind", rule, "regressor", remedy)
    m, q = len(sensor.A), sensor.B.shape[1]
    why = f"{key}.A has {m} rows"
    require_shape(f"{key}.B", sensor.B, (m, None), why)
    require_shape(
        f"{key}.C", sensor.C, (scenario.plant.n, m), f"the state has {scenario.plant.n} components"
    )
    require_shape(f"{key}.start", sensor.start, (m,), why)
    require_shape(f"{key}.xi_cov", sensor.xi_cov, (q, q), f"{key}.B has {q} columns")
    require_shape(f"{key}.R", sensor.R, (1, 1), "a regressor gives one number a slot")


def check_weights(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if a matrix ``filter.weights`` (N, N) does not fit nodes and links."""
    weights, nodes = scenario.node_filter.link_weights.matrix, scenario.nodes
    if weights is None:
        return
    require_shape("filter.weights", weights, (len(nodes),) * 2, f"there are {len(nodes)} nodes")
    links = set(scenario.topology.directions)
    for sender, receiver in np.argwhere(weights > 0.0).tolist():
        pair = (nodes[sender], nodes[receiver])
        if sender != receiver and pair not in links:
            raise ScenarioError(
                f"filter.weights[{sender}][{receiver}]",
                f"must be 0, because no link goes from node {pair[0]} to node {pair[1]}",
                float(weights[sender, receiver]),
                "add the link; rows are senders, columns receivers",
            )
