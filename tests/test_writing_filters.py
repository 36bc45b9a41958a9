"""docs/writing_filters.md: its files run as they stand, and do what the page says."""

import ast
import re
import sys

import numpy as np
import pandas as pd
import pytest
import scipy.linalg

import netkf
from netkf.cli.main import main
from netkf.scenario.reading import from_table
from netkf.testing import check_filter
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "writing_filters.md").read_text()
FILES = dict(re.findall(r"```(?:python|toml)\n# (\S+)\n(.*?)```", PAGE, re.S))
ACTIVATIONS = [
    {"kind": "poisson", "rate": 3.0, "at": "nodes"},
    {"kind": "poisson", "rate": 3.0, "at": "directions"},
    {"kind": "readings"},
]
EPSILON, PERIOD, COUNT = 0.2, 0.5, 24
A = np.array([[0.1, 0.3], [-0.3, 0.0]])
B = 0.3 * np.eye(2)
SENSORS = {0: [[1.0, 0.0]], 1: [[0.0, 1.0]], 3: [[1.0, 1.0]]}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the files of the page; its modules are forgotten afterwards."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = [name.removesuffix(".py") for name in FILES if name.endswith(".py")]
    yield tmp_path
    for name in modules:
        sys.modules.pop(name, None)


def test_the_kalman_consensus_filter_is_one_class_of_under_40_lines():
    filter_ = ast.parse(FILES["kcf.py"]).body[-1]
    assert filter_.name == "Kcf"
    assert filter_.end_lineno - filter_.lineno < 40


def test_the_scripts_of_the_page_run(folder):
    for name in FILES:
        if name.endswith(".py"):
            exec(compile((folder / name).read_text(), name, "exec"), {"__name__": name})
    from averaging import Averaging

    check_filter(Averaging, gain=0.3)


def test_the_scenarios_of_the_page_run_in_both_kinds_of_time(folder):
    for name in ("kcf_slots.toml", "kcf_clocks.toml"):
        run = netkf.simulate(netkf.load(folder / name), engine="simpy")
        assert run.status == "complete"
        assert np.abs(run.error).max() < 10.0


@pytest.mark.parametrize("name", ["kcf_slots.toml", "kcf_clocks.toml"])
def test_the_kernels_are_the_methods(folder, name):
    """A custom filter whose verbs are kernels runs in both engines, as the one in plain Python."""
    plain = netkf.load(folder / name)
    text = (folder / name).read_text().replace("kcf:Kcf", "kcf_kernels:Kcf")
    (folder / "kernels.toml").write_text(text)
    kernels = netkf.load(folder / "kernels.toml")
    expected = netkf.simulate(plain, engine="auto")
    assert "simpy" in expected.engine
    for engine in ("simpy", "compiled"):
        run = netkf.simulate(kernels, engine=engine)
        assert run.engine == engine
        pd.testing.assert_frame_equal(run.events, expected.events)
        np.testing.assert_allclose(run.xhat, expected.xhat, rtol=0, atol=1e-10)
        np.testing.assert_allclose(run.P, expected.P, rtol=0, atol=1e-10)
    assert netkf.simulate(kernels).engine == "compiled"


def test_a_class_that_changes_nothing_is_compiled_and_one_that_changes_a_method_is_not(folder):
    (folder / "derived.py").write_text(
        "from netkf.parts import Kcf\n\n\nclass Same(Kcf):\n    pass\n\n\n"
        "class Deaf(Kcf):\n    def absorb(self, state, messages, exchange):\n"
        "        return state\n"
    )
    text = (folder / "kcf_slots.toml").read_text()
    runs = {}
    for name in ("derived:Same", "derived:Deaf", "kcf", "local"):
        (folder / "s.toml").write_text(
            text.replace("kcf:Kcf", name).replace(
                "epsilon = 0.2", "" if name == "local" else "epsilon = 0.2"
            )
        )
        runs[name] = netkf.simulate(netkf.load(folder / "s.toml"))
    assert runs["derived:Same"].engine == "compiled"
    assert runs["derived:Deaf"].engine == "simpy"
    np.testing.assert_array_equal(runs["derived:Same"].P, runs["kcf"].P)
    np.testing.assert_allclose(runs["derived:Deaf"].P, runs["local"].P, rtol=0, atol=1e-10)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("activation", ACTIVATIONS, ids=["nodes", "directions", "readings"])
def test_consensus_brings_blind_nodes_to_the_truth(folder, activation):
    """Node 3 and 5 see nothing: what they know they heard."""
    scenario = netkf.load(folder / "kcf_clocks.toml")
    scenario = scenario.replace({"network.activation": activation, "horizon": 60.0})
    apart = np.abs(netkf.simulate(scenario).error[20:, [3, 5]]).mean()
    deaf = scenario.replace({"network.channel.loss": {"kind": "bernoulli", "delivery": 0.0}})
    assert apart < 0.7 * np.abs(netkf.simulate(deaf).error[20:, [3, 5]]).mean()


def plain(y):
    """The filter of the page's first formula, written with matrices, on a ring of four."""
    n = 2
    block = scipy.linalg.expm(PERIOD * np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]))
    F = block[n:, n:].T
    Q = F @ block[:n, n:]
    xhat, P = [np.zeros(n)] * 4, [2.0 * np.eye(n)] * 4
    for k in range(COUNT):
        xbar = [F @ x for x in xhat]
        P = [F @ p @ F.T + Q for p in P]
        xhat = list(xbar)
        for i, rows in SENSORS.items():
            H = np.array(rows)
            K = P[i] @ H.T @ np.linalg.inv(H @ P[i] @ H.T + 0.5 * np.eye(1))
            xhat[i] = xbar[i] + K @ (y[i][k] - H @ xbar[i])
            P[i] = (np.eye(n) - K @ H) @ P[i]
        for i in range(4):
            for j in ((i - 1) % 4, (i + 1) % 4):
                xhat[i] = xhat[i] + EPSILON * (xbar[j] - xbar[i])
    return np.array(xhat), np.array(P), F, Q


@pytest.mark.parametrize("slots", [True, False], ids=["slots", "clocks"])
def test_both_kinds_of_time_are_the_formula(folder, slots):
    """Recorded readings at k T, exchanges at k T: the same numbers from one class."""
    random = np.random.default_rng(1)
    y = {i: random.normal(size=(COUNT, 1)) for i in SENSORS}
    rows = [
        f"{PERIOD * (k + 1)!r},{i},{float(y[i][k, 0])!r}" for i in SENSORS for k in range(COUNT)
    ]
    rows += [f"0.0,{i},0.0" for i in SENSORS if slots]  # filtered: slot 0 is not read
    (folder / "y.csv").write_text("t,node,y0\n" + "\n".join(rows) + "\n")
    xhat, P, F, Q = plain(y)
    if slots:
        plant = {"F": F.tolist(), "Q": Q.tolist(), "period": PERIOD}
        activation = {"kind": "broadcast"}
    else:
        plant = {"A": A.tolist(), "B": B.tolist()}
        activation = {"kind": "periodic", "period": PERIOD, "at": "nodes"}
    table = {
        "format": 1,
        "name": "formula",
        "horizon": PERIOD * (COUNT + (0 if slots else 0.5)),
        "probe": [PERIOD * COUNT],
        "plant": {"kind": "unknown", "cov": [[2.0, 0.0], [0.0, 2.0]], **plant},
        "sensors": [
            {"kind": "recorded", "nodes": [i], "path": "y.csv", "H": H, "R": [[0.5]]}
            for i, H in SENSORS.items()
        ],
        "network": {"graph": {"kind": "cycle", "nodes": 4}, "activation": activation},
        "filter": {"kind": "kcf:Kcf", "epsilon": EPSILON},
    }
    run = netkf.simulate(from_table(table, folder), engine="simpy")
    np.testing.assert_allclose(run.P[-1], P, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(run.xhat[-1], xhat, rtol=1e-10, atol=1e-12)


def test_a_filter_without_covariance_runs_from_the_command_line(folder, capsys):
    assert main(["run", "averaging.toml", "--trust"]) == 0
    said = capsys.readouterr().out
    rows = [line.split() for line in said.splitlines() if re.match(r" +(\d|all) ", line)]
    assert len(rows) == 6
    for _, error, *others in rows:
        assert float(error) < 1.0
        assert others == ["-"] * 2
    run = netkf.simulate(netkf.load(folder / "averaging.toml"))
    assert run.status == "complete"
    assert np.isnan(run.P).all()
    assert np.isfinite(run.xhat).all()
