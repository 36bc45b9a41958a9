"""Filters under clocks over a diffusion with sampled sensors, against replays of a plain reference
(tests/cases/clocks.json), driven through scenario files.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import netkf

CASES = json.loads((Path(__file__).parents[1] / "cases" / "clocks.json").read_text())["cases"]


def table(path, header, rows):
    """A CSV file; returns its name."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([[repr(v) if isinstance(v, float) else v for v in row] for row in rows])
    return path.name


def matrix(value):
    """As TOML."""
    return json.dumps(value)


def scenario_file(case, folder, ids=lambda node: node):
    """The scenario of a case, whose nodes may be called otherwise."""
    n = len(case["A"])
    nodes = range(case["nodes"])
    readings = [
        [t, ids(node), *np.atleast_1d(np.array(y).ravel()).tolist()]
        for t, node, *y in case["readings"]
    ]
    p = max(len(sensor["H"]) for sensor in case["sensors"].values())
    table(folder / "readings.csv", ["t", "node", *(f"y{k}" for k in range(p))], readings)
    at, links = case["activation_at"], [[ids(i), ids(j)] for i, j in case["links"]]
    activation = '{ kind = "readings" }'
    if at != "readings":
        names = ["t", "node"] if at == "nodes" else ["t", "node", "peer"]
        ticks = [[t, *map(ids, who)] for t, *who in case["ticks"]]
        path = table(folder / "ticks.csv", names, ticks)
        activation = f'{{ kind = "recorded", at = "{at}", path = "{path}" }}'
    loss = [[ids(i), ids(j), *rest] for i, j, *rest in case["loss"]]
    table(folder / "loss.csv", ["sender", "receiver", "message", "delivered"], loss)
    delay = '{ kind = "none" }'
    if case["delays"] is not None:
        rows = [[ids(i), ids(j), *rest] for i, j, *rest in case["delays"]]
        path = table(folder / "delays.csv", ["sender", "receiver", "message", "seconds"], rows)
        delay = f'{{ kind = "recorded", path = "{path}" }}'
    sensors = "".join(
        f"""
[[sensors]]
kind = "recorded"
path = "readings.csv"
nodes = [{ids(int(node))}]
H = {matrix(sensor["H"])}
R = {matrix(sensor["R"])}
"""
        for node, sensor in case["sensors"].items()
    )
    settings = "".join(
        f"{name} = {matrix(case[name])}\n" for name in ("epsilon", "weights") if case[name]
    )
    order = sorted(nodes, key=ids)
    starts = [case["start"][str(k)] for k in order]
    file = folder / "case.toml"
    file.write_text(
        f"""
format = 1
name = "case"
horizon = {case["horizon"]}
probe = {matrix(case["probes"])}

[plant]
kind = "unknown"
A = {matrix(case["A"])}
B = {matrix(case["B"])}
mean = {matrix([0.0] * n)}
{sensors}
[network]
graph = {{ kind = "edges", edges = {matrix(links)} }}
activation = {activation}
channel = {{ loss = {{ kind = "recorded", path = "loss.csv" }}, delay = {delay} }}

[filter]
kind = "{case["filter"]}"
{settings}mean = {matrix([start["mean"] for start in starts])}
cov = {matrix([start["cov"] for start in starts])}
"""
    )
    return file


@pytest.mark.one_in(5)
@pytest.mark.parametrize("engine", ["simpy", "auto"])
@pytest.mark.parametrize("case", CASES, ids=[f"{c['filter']}-{c['seed']}" for c in CASES])
def test_replays(case, engine, tmp_path):
    run = netkf.simulate(netkf.load(scenario_file(case, tmp_path)), engine=engine)
    assert run.status == "complete"
    np.testing.assert_allclose(run.P, np.array(case["P"]), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(run.xhat, np.array(case["xhat"]), rtol=1e-9, atol=1e-9)
