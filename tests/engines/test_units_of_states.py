"""P does not depend on the units in which the components of a state are written."""

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table

UNITS = np.array([1e-9, 1e3, 30.0])
"""A clock in seconds beside a position in millimetres, say."""
F = np.array([[0.9, 0.2, -0.1], [-0.1, 0.8, 0.2], [0.05, -0.2, 0.95]])
Q = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, -0.05], [0.0, -0.05, 0.1]])
H = np.array([[1.0, 0.4, 0.0], [0.0, -0.5, 1.0]])

SLOTS = ("push-sum", "push-sum asymptotic", "consensus-innovations", "diffusion", "kcf", "icf")
KEYS = {
    "push-sum": {"gamma": 4, "delta": 9.0},
    "push-sum asymptotic": {"gamma": 4, "delta": 9.0, "asymptotic": True},
    "kcf": {"epsilon": 0.05},
}


def scenario(tmp_path, name, units, increments=None):
    n, slotted = len(units), name in SLOTS
    kind = name.split()[0]
    D, inverse = np.diag(units), np.diag(1.0 / units)
    if slotted:
        plant = {"kind": "linear", "F": (D @ F @ inverse).tolist(), "period": 0.5}
        plant["Q"] = (D @ Q @ D).tolist()
    else:
        plant = {"kind": "diffusion", "A": (D @ (F - np.eye(n)) @ inverse).tolist()}
        plant["B"] = (D @ np.linalg.cholesky(Q)).tolist()
    plant["cov"] = cov = (D @ D).tolist()
    sensors = [
        {"nodes": [node], "H": [(row / units).tolist()], "R": [[0.4]]} for node, row in enumerate(H)
    ]
    if not slotted:
        sampling = {"sampling": {"kind": "periodic", "period": 0.25}}
        sensors = [sensor | sampling for sensor in sensors]
    clock = {"kind": "broadcast"} if slotted else {"kind": "poisson", "at": "nodes", "rate": 2.0}
    table = {
        "format": 1,
        "name": "units",
        "horizon": 6.0,
        "probe": 0.5,
        "plant": plant,
        "sensors": sensors,
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": clock,
            "channel": {"loss": {"kind": "bernoulli", "delivery": 0.7}},
        },
        "filter": {"kind": kind, **(KEYS.get(name, {}) if slotted else {})},
    }
    if increments is not None:
        A, B = increments
        # A start of no spread: roots of covariances in other units are those of other draws.
        start = {"cov": np.zeros((n, n)).tolist()}
        plant |= {"A": (D @ A @ inverse).tolist(), "B": (D @ B).tolist(), **start}
        clock["at"] = "links"
        for sensor in sensors:
            del sensor["sampling"]
        table["filter"] |= {"cov": cov} | ({"epsilon": 0.3} if kind == "hybrid" else {})
    return from_table(table, tmp_path)


@pytest.mark.parametrize("name", [*SLOTS, "push-sum clocks", "local clocks"])
def test_P_is_that_of_other_units(tmp_path, name):
    run, other = (
        netkf.simulate(scenario(tmp_path, name, units), seed=2) for units in (np.ones(3), UNITS)
    )
    deviations = np.sqrt(np.einsum("tnii->tni", run.P))
    gap = other.P / (UNITS[:, None] * UNITS) - run.P
    assert np.abs(gap / (deviations[..., None] * deviations[..., None, :])).max() < 1e-6


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("kind", ["hybrid", "local"])
@pytest.mark.parametrize(
    ("A", "B"),
    [
        (F - np.eye(3), np.linalg.cholesky(Q)),
        (np.diag([1.0, 1.0], 1), np.array([[0.0], [0.0], [1.0]])),  # integrators have no norm
    ],
)
def test_increments_are_used_alike_in_other_units(tmp_path, kind, A, B, engine):
    """Lengths of steps went by the largest entries: a run in millimetres took a thousand times
    longer than one in metres, or for ever.
    """

    scenarios = [scenario(tmp_path, kind, units, (A, B)) for units in (np.ones(3), UNITS)]
    period, other_period = (one.diffusion.sensing_period for one in scenarios)
    one, other = (netkf.simulate(one, seed=2, engine=engine) for one in scenarios)
    assert period == other_period
    deviations = np.sqrt(np.einsum("tnii->tni", one.P))
    gap = other.P / (UNITS[:, None] * UNITS) - one.P
    assert np.abs(gap / (deviations[..., None] * deviations[..., None, :])).max() < 1e-12
    if len(B.T) < 3:
        return  # states inside a step that one noise drives: rounding chooses among equal draws
    np.testing.assert_allclose(other.x / UNITS, one.x, rtol=1e-9, atol=1e-9)
    assert np.abs((other.xhat / UNITS - one.xhat) / deviations).max() < 1e-9


@pytest.mark.parametrize(
    ("Q", "holds"),
    [
        (np.diag([1e6, -1e-6]), False),  # a variance is negative, in whatever units
        (np.array([[1e6, 1.1], [1.1, 1e-6]]), False),
        (np.array([[1e6, 0.9], [0.9, 1e-6]]), True),
        (np.array([[1e6, 1.000001], [1.000001, 1e-6]]), True),  # the last of seven digits
        (np.array([[1.0, 1e-17], [1e-17, -1e-18]]), True),  # rounding of zero
        (np.zeros((2, 2)), True),
    ],
)
def test_covariances_are_semidefinite_in_all_units(Q, holds):
    if holds:
        netkf.parts.LinearPlant(F=np.eye(2), Q=Q, period=1.0)
        return
    with pytest.raises(netkf.ScenarioError, match="Q: must be positive semidefinite"):
        netkf.parts.LinearPlant(F=np.eye(2), Q=Q, period=1.0)
