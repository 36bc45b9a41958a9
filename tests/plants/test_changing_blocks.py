"""Blocks that change at stated times, estimated whole or in part: each piece has blocks again."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import netkf

TWO = """
format = 1
name = "two blocks"
horizon = 9.0
probe = 1.0
[[plants]]
name = "pose"
nodes = [1, 2]
F = [[0.9]]
Q = [[0.2]]
period = 1.0
cov = [[2.0]]
schedule = [{ from = 3.0, F = [[0.5]] }]
[[plants]]
name = "drift"
nodes = [2]
F = [[0.7]]
Q = [[0.1]]
period = 1.0
cov = [[1.0]]
schedule = [{ from = 6.0, Q = [[0.4]] }]
coupling = [{ from = "pose", A = [[0.3]] }]
[[sensors]]
of = "pose"
nodes = [1, 2]
H = [[1.0]]
R = [[0.1]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "broadcast" }
[filter]
kind = "block-intersection"
estimates = "own"
"""
CLOCKS = [
    ("F = [[0.9]]\nQ = [[0.2]]\nperiod = 1.0", "A = [[-0.1]]\nB = [[0.4]]"),
    ("F = [[0.7]]\nQ = [[0.1]]\nperiod = 1.0", "A = [[-0.3]]\nB = [[0.3]]"),
    ("F = [[0.5]] }", "A = [[-0.7]] }"),
    ("Q = [[0.4]] }", "B = [[0.6]] }"),
    ("R = [[0.1]]", 'R = [[0.1]]\nsampling = { kind = "periodic", period = 1.0 }'),
    ('"broadcast"', '"readings"'),
]


def load(folder: Path, clocked: bool) -> netkf.Scenario:
    text = TWO
    for old, new in CLOCKS if clocked else ():
        assert old in text
        text = text.replace(old, new)
    (folder / "scenario.toml").write_text(text)
    return netkf.load(folder / "scenario.toml")


@pytest.mark.parametrize("clocked", [False, True], ids=["slots", "clocks"])
def test_pieces_of_blocks_are_blocks(tmp_path: Path, clocked: bool) -> None:
    scenario = load(tmp_path, clocked)
    rates, noises = ([-0.1, -0.7, -0.7], [0.3, 0.3, 0.6]) if clocked else ([0.9, 0.5, 0.5], None)
    for number, rate in enumerate(rates):
        piece = scenario.piece(number)
        plant = piece.plant
        moves = plant.A if clocked else plant.F
        assert not len(plant.changes)
        assert moves[0, 0] == moves[1, 1] == rate
        assert moves[2].tolist() == [0.0, 0.3, -0.3 if clocked else 0.7]
        noise = plant.B[2, 2] if noises else plant.Q[2, 2]
        assert noise == (noises or [0.1, 0.1, 0.4])[number]
        np.testing.assert_array_equal(plant.start_cov, np.diag([2.0, 2.0, 1.0]))
        assert piece.estimated == scenario.estimated
        assert netkf.simulate(piece).status == "complete"
    assert scenario.last_piece.plants[0].plant.schedule == ()


@pytest.mark.parametrize("clocked", [False, True], ids=["slots", "clocks"])
def test_own_blocks_follow_their_changes(tmp_path: Path, clocked: bool) -> None:
    """Node 1 has one state, and nothing that node 2 tells is of it."""
    run, P = netkf.simulate(load(tmp_path, clocked)), 2.0
    for k in range(1, 9):
        # In slots F of the slot that begins moves the state; the change at 3 s is in slot 3.
        old = k <= 3
        if clocked:
            a = -0.1 if old else -0.7
            P = math.exp(2 * a) * P + 0.16 * (math.exp(2 * a) - 1.0) / (2 * a)
        else:
            P = (0.9 if old else 0.5) ** 2 * P + 0.2
        P = P * 0.1 / (P + 0.1)
        assert run.P[k, 0, 0, 0] == pytest.approx(P, rel=1e-9)
