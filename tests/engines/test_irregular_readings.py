"""Readings as people have them: several at one instant, missing values, noise in the row.

The truth is the Kalman filter written plainly, with the rows of H and R that are there.
"""

import itertools

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table

H = np.array([[1.0, 0.0], [1.0, 0.5]])
R = np.array([[0.1, 0.05], [0.05, 0.2]])
A, B = np.array([[0.0, 1.0], [-0.3, -0.1]]), np.array([[0.1], [0.7]])
F, Q = np.array([[1.0, 0.4], [-0.1, 0.9]]), np.array([[0.2, 0.05], [0.05, 0.1]])
ENGINES = ("simpy", "compiled")
FORMS = ("plain", "diagonal", "triangle", "phi")


def draw_rows(form, seed, instants):
    """(t, node, y, H, R) of the values that are there, and the text of their table."""
    rng = np.random.default_rng(seed)
    p = 1 if form == "phi" else 2
    names = {"plain": [], "diagonal": ["R0", "R1"], "triangle": ["R00", "R01", "R11"]}
    noise = ["R0"] if form == "phi" else names[form]
    columns = ["t", "node", *(f"y{k}" for k in range(p)), *noise]
    columns += ["phi0", "phi1"] if form == "phi" else []
    rows, lines = [], [",".join(columns)]
    for t, node in itertools.product(instants, (0, 1)):
        for _ in range(rng.integers(0, 4)):
            y, there = rng.normal(size=p), rng.random(p) < 0.7
            root = rng.normal(size=(p, p))
            own = root @ root.T + 0.1 * np.eye(p)
            if form == "diagonal":
                own = np.diag(np.diag(own))
            own = R[:p, :p] if form == "plain" else own
            phi = rng.normal(size=2)
            upper = {"diagonal": np.diag(own), "triangle": own[np.triu_indices(p)], "phi": own[0]}
            entries = [t, node, *np.where(there, y, np.nan), *upper.get(form, ())]
            entries += [*phi] if form == "phi" else []
            lines.append(",".join("" if e != e else repr(float(e)) for e in entries))
            if there.any():
                ix = np.ix_(there, there)
                rows.append((t, node, y[there], phi[None] if form == "phi" else H[there], own[ix]))
    return rows, "\n".join(lines) + "\n"


def update(xhat, P, rows):
    """Plain Kalman updates, one after the other: noises of rows are independent."""
    for _, _, y, C, noise in rows:
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + noise)
        xhat, P = xhat + K @ (y - C @ xhat), P - K @ C @ P
    return xhat, P


def make(folder, form, slotted, kind, activation, table, **sensor):
    (folder / "readings.csv").write_text(table)
    plant = {"F": F, "Q": Q, "period": 0.5} if slotted else {"A": A, "B": B}
    plant = {key: np.asarray(value).tolist() for key, value in plant.items()}
    entry = {"kind": "recorded", "path": "readings.csv", "nodes": [0, 1]}
    entry |= {"plain": {"H": H.tolist(), "R": R.tolist()}, "phi": {}}.get(
        form, {"H": H.tolist()}
    ) | sensor
    return from_table(
        {
            "format": 1,
            "name": "irregular",
            "horizon": 6.0,
            "probe": 0.5,
            "plant": {"kind": "unknown", "cov": np.eye(2).tolist(), **plant},
            "sensors": [entry],
            "network": {"graph": {"kind": "path", "nodes": 2}, "activation": activation},
            "filter": {"kind": kind},
        },
        folder,
    )


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("form", FORMS)
def test_in_slots_the_central_filter_is_the_plain_one(tmp_path, form, engine):
    rows, table = draw_rows(form, 3, 0.5 * np.arange(1, 12))
    s = make(tmp_path, form, True, "central", {"kind": "broadcast"}, table)
    run = netkf.simulate(s, engine=engine)
    xhat, P = np.zeros(2), np.eye(2)
    for k in range(1, 12):
        xhat, P = update(F @ xhat, F @ P @ F.T + Q, [row for row in rows if row[0] == 0.5 * k])
        np.testing.assert_allclose(run.P[k, 0], P, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(run.xhat[k, 0], xhat, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("form", FORMS)
def test_in_continuous_time_two_nodes_with_all_readings_are_the_plain_filter(
    tmp_path, form, engine
):
    instants = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.9, 11))
    rows, table = draw_rows(form, 4, instants)
    s = make(tmp_path, form, False, "intermittent", {"kind": "readings"}, table)
    run = netkf.simulate(s, engine=engine)
    xhat, P, now = np.zeros(2), np.eye(2), 0.0
    for k, t in enumerate(run.times):
        for instant in [i for i in instants if now < i <= t]:
            xhat, P = advance(xhat, P, instant - now)
            xhat, P = update(xhat, P, [row for row in rows if row[0] == instant])
            now = instant
        at, P_at = advance(xhat, P, t - now)
        for node in (0, 1):
            np.testing.assert_allclose(run.P[k, node], P_at, rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(run.xhat[k, node], at, rtol=1e-9, atol=1e-11)


def advance(xhat, P, gap):
    """Van Loan: the transition and the noise over a gap, by one exponential."""
    from scipy.linalg import expm

    block = expm(np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]) * gap)
    Phi = block[2:, 2:].T
    return Phi @ xhat, Phi @ P @ Phi.T + Phi @ block[:2, 2:]
