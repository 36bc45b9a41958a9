"""The matrices of scenarios/blocks/ieee14_areas.toml are those of the branches in its CSV file."""

from __future__ import annotations

import numpy as np
import pandas as pd

import netkf
from tests.conftest import SCENARIOS

AREAS = {1: (1, 2, 5), 2: (3, 4, 7, 8), 3: (6, 11, 12, 13), 4: (9, 10, 14)}
DAMPING, SLACK = 100.0, 10.0


def test_the_matrices_of_the_grid_are_those_of_its_branches() -> None:
    branches = pd.read_csv(SCENARIOS / "data" / "ieee14" / "branches.csv", comment="#")
    assert len(branches) == 20
    scenario = netkf.load(SCENARIOS / "blocks" / "ieee14_areas.toml")
    place: dict[str, dict[int, int]] = {"angles": {}, "injections": {}}
    for one in scenario.layout.places:
        for k, bus in enumerate(AREAS[one.node or 0]):
            place[one.name][bus] = one.first + k
    angles, injections = place["angles"], place["injections"]
    F, flows = np.eye(28), []
    for bus in range(1, 15):
        F[angles[bus], injections[bus]] = 1.0 / DAMPING
    for i, j, x in zip(branches["from"], branches["to"], branches["x"], strict=True):
        row = np.zeros(28)
        row[angles[i]], row[angles[j]] = 1.0 / x, -1.0 / x
        F[angles[i]] -= row / DAMPING
        F[angles[j]] += row / DAMPING
        flows.append(row)
    F[angles[1], angles[1]] -= SLACK / DAMPING
    np.testing.assert_allclose(scenario.linear_plant.F, F, atol=1e-6)
    area = {bus: node for node, buses in AREAS.items() for bus in buses}
    read = [row for sensor in scenario.sensors for row in sensor.H if np.count_nonzero(row) == 2]
    assert len(read) == len(flows)
    for row in flows:
        assert min(np.abs(one - row).max() for one in read) < 1e-4
    # Areas are coupled, and linked, where a branch crosses their border.
    borders = {(area[i], area[j]) for i, j in branches[["from", "to"]].to_numpy().tolist()}
    links = {pair for i, j in borders if i != j for pair in [(min(i, j), max(i, j))]}
    assert links == set(scenario.topology.links)
