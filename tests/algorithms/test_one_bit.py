"""The sign-of-innovations filter: its formula, turns, traffic and the covariance it claims."""

import math

import numpy as np
import pytest

import netkf
from tests.algorithms.test_literature import scenario_of, textbook

COMPLETE = {
    "graph": {"kind": "complete", "nodes": 5},
    "activation": {"kind": "broadcast"},
}
ONE_BIT = {"kind": "one-bit"}


def expected(scenario, run):
    """P - (2 / pi) P h' h P / (h P h' + r), row by row, by the bits of the node whose turn it is;
    rows of correlated noise are decorrelated first.
    """

    def step(slot, x, P, readings):
        if slot % 5 in readings:
            y, H, R = readings[slot % 5]
            inverse = np.linalg.inv(np.linalg.cholesky(R))
            for value, h in zip(inverse @ y, inverse @ H, strict=True):
                b = 1.0 if value >= h @ x[0] else -1.0
                S = h @ P[0] @ h + 1.0
                x = [
                    one + math.sqrt(2.0 / math.pi / S) * b * C @ h
                    for one, C in zip(x, P, strict=True)
                ]
                P = [C - 2.0 / math.pi * np.outer(C @ h, C @ h) / S for C in P]
        return x, P

    found = list(textbook(scenario, run, step))
    return np.stack([x for x, _ in found]), np.stack([P for _, P in found])


@pytest.mark.parametrize("seed", range(3))
def test_the_textbook(seed, tmp_path):
    for n in (1, 2, 4):
        scenario = scenario_of(ONE_BIT, tmp_path, seed, n, network=COMPLETE)
        run = netkf.simulate(scenario)
        xhat, P = expected(scenario, run)
        np.testing.assert_allclose(run.P, P, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(run.xhat, xhat, rtol=1e-10, atol=1e-10)
        # Six slots with exchanges, of which that of node 4, which is blind, is silent.
        assert run.count("send") == 4 * 5


def test_p_describes_the_errors(tmp_path):
    """The paper's Gaussian approximation: NEES near n."""
    scenario = scenario_of(ONE_BIT, tmp_path, 1, network=COMPLETE, probe=[3.0, 6.0])
    runs = [netkf.simulate(scenario, replica=k) for k in range(250)]
    e = np.stack([run.error[:, 0] for run in runs])
    P = runs[0].P[:, 0]
    nees = np.einsum("rta,tab,rtb->rt", e, np.linalg.inv(P), e).mean(axis=0)
    assert (np.abs(nees - 2.0) < 4.5 * 2.0 / math.sqrt(250)).all()


def test_a_row_costs_a_bit(tmp_path):
    scenario = scenario_of(ONE_BIT, tmp_path, network=COMPLETE)
    found = netkf.compare_filters(scenario, ["one-bit", "central"], runs=2, workers=1)
    row = found.rows[0]
    # Rows of the nodes whose turn it is in slots 1 to 6: 2, 3, 2, none, 1, 2.
    assert row.transmissions == 5
    assert row.bytes == pytest.approx((2 + 3 + 2 + 1 + 2) / 8.0)


def test_what_a_bit_is_worth(tmp_path):
    """2/pi of what the reading would take from P, of one row; with losses in `check` too."""
    P, H, R = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[1.0, 0.4]]), np.array([[0.5]])
    whole = P - P @ H.T @ np.linalg.inv(H @ P @ H.T + R) @ H @ P
    found = netkf.theory.one_bit_update(P, H, R)
    np.testing.assert_allclose(P - found, 2.0 / math.pi * (P - whole), rtol=1e-12)
    promise = "a bit lowers P by 2/pi of what its reading would, along the bits of each run"
    for more in ({"network": COMPLETE}, {}):
        scenario = scenario_of(ONE_BIT, tmp_path, 1, horizon=9.0, **more)
        table = netkf.check(scenario, 10, workers=1).table.set_index("promise")
        assert table.loc[promise, "verdict"] == "holds"
