"""The push-sum filter: reference cases through scenario files, mass, stop rules, link draws."""

import json

import numpy as np
import pytest

import netkf
from netkf.scenario.writing import to_toml
from tests.cases import FOLDER

CASES = json.loads((FOLDER / "push_sum.json").read_text())["cases"]


def written(case, folder):
    """The scenario file of a case, with its links and readings in tables; a slot a second."""
    rows = ["slot,phase,step,node,peer"]
    for t, (beta, steps) in enumerate(zip(case["beta"], case["beta_c"], strict=True)):
        fates = [(0, 0, beta), *((1, h, up) for h, up in enumerate(steps))]
        for phase, step, up in fates:
            links = [link for link, b in zip(case["edges"], up, strict=True) if b]
            rows += [f"{t + 1},{phase},{step},{i},{j}" for i, j in links]
            rows += [f"{t + 1},{phase},{step},{j},{i}" for i, j in links]
    (folder / "links.csv").write_text("\n".join(rows) + "\n")
    p = max(case["q"])
    rows = [",".join(["t", "node", *(f"y{k}" for k in range(p))])]
    for t, readings in enumerate(case["y"]):
        for node, y in enumerate(readings):
            if y:
                rows.append(",".join([f"{t + 1}.0", str(node), *map(repr, y), *[""] * (p - len(y))]))
    (folder / "readings.csv").write_text("\n".join(rows) + "\n")
    recorded = {"kind": "recorded", "path": "readings.csv"}
    table = {
        "format": 1,
        "name": case["name"],
        "horizon": float(len(case["y"])),
        "probe": 1.0,
        "plant": {"kind": "unknown", "F": case["A"], "Q": case["Q"], "period": 1.0},
        "sensors": [
            {**recorded, "nodes": [node], "H": H, "R": case["R"][node]}
            for node, H in enumerate(case["C"])
            if H
        ],
        "network": {
            "graph": {"kind": "edges", "edges": case["edges"]},
            "activation": {"kind": "recorded", "path": "links.csv"},
        },
        "filter": {
            "kind": "push-sum",
            "gamma": case["gamma"],
            "delta": case["delta"],
            "leader": case["leader"],
            "asymptotic": case["asymptotic_gains"],
            "stop": "paper",
            "tolerance": case["eps"],
            "mean": case["x0"],
            "cov": case["P0"],
        },
    }
    (folder / "case.toml").write_text(to_toml(table))
    return folder / "case.toml"


@pytest.mark.parametrize("case", CASES, ids=lambda c: c["name"])
def test_reference_cases(case, tmp_path):
    run = netkf.simulate(netkf.load(written(case, tmp_path)))
    expected = np.array(case["out"]["xhat"])
    assert run.xhat.shape == expected.shape
    size = np.abs(expected).max(axis=-1, keepdims=True)
    assert (np.abs(run.xhat - expected) <= 1e-12 * size).all()
    P = np.array(case["out"]["P_final"])
    size = np.abs(P).max(axis=(-1, -2), keepdims=True)
    print(np.abs(run.xhat - expected).max(), np.abs(run.P[-1]-P).max())
    assert (np.abs(run.P[-1] - P) <= 1e-12 * size).all()
    stops = run.events[run.events.kind == "stop"]
    first = np.array(case["out"]["stop"]).argmax(axis=0)
    wanted = {(node, float(k)) for node, k in enumerate(first) if k}
    assert {(r.node, np.floor(r.t)) for r in stops.itertuples()} == wanted
