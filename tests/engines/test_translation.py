"""Filters whose messages are one vector of the state, on nodes that estimate different blocks: the
Kalman consensus filter of the documentation against its formula, block by block.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.scenario.reading import from_table
from tests.conftest import ROOT
from tests.engines.agreement import assert_agree

PAGE = (ROOT / "docs" / "writing_filters.md").read_text()
NODES, LINKS, EPSILON = (1, 2, 3, 4), ((1, 2), (2, 3), (3, 4)), 0.3
RATES = {"pose": (0.9, 0.2), "target": (0.8, 0.1)}
BLOCKS: dict[Any, dict[int, list[tuple[str, int]]]] = {
    "own": {i: [("pose", i)] for i in NODES},
    "own+neighbours": {
        1: [("pose", 1), ("pose", 2)],
        2: [("pose", 2), ("pose", 1), ("pose", 3)],
        3: [("pose", 3), ("pose", 2), ("pose", 4)],
        4: [("pose", 4), ("pose", 3)],
    },
    "shared": {i: [("target", 0)] for i in NODES},
    "named": {i: [("pose", i), ("target", 0)] for i in NODES},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    for name, text in re.findall(r"```python\n# (kcf\S*)\n(.*?)```", PAGE, re.S):
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in ("kcf", "kcf_kernels"):
        sys.modules.pop(name, None)


def scenario(folder: Path, estimates: str, kind: str = "kcf:Kcf", **changes: Any) -> Any:
    named = {"named": ["pose", "target"], "shared": ["target"]}
    names = named.get(estimates, ["pose"])
    for name in names:
        rng = np.random.default_rng(len(name))
        rows = [f"{t},{i},{y:.3f}" for i in NODES for t, y in enumerate(rng.normal(size=5), 1)]
        (folder / f"{name}.csv").write_text("t,node,y0\n" + "\n".join(rows) + "\n")
    plants = [
        {"name": name, "F": [[F]], "Q": [[Q]], "period": 1.0, "cov": [[1.0]]}
        | ({"nodes": list(NODES)} if name == "pose" else {})
        for name, (F, Q) in RATES.items()
    ]
    sensor = {"kind": "recorded", "H": [[1.0]], "R": [[0.1]], "nodes": list(NODES)}
    table = {
        "format": 1,
        "name": "own states",
        "horizon": 5.0,
        "probe": 1.0,
        "plants": plants,
        "sensors": [sensor | {"of": name, "path": f"{name}.csv"} for name in names],
        "network": {
            "graph": {"kind": "edges", "edges": [list(link) for link in LINKS]},
            "activation": {"kind": "broadcast"},
        },
        "filter": {
            "kind": kind,
            "epsilon": EPSILON,
            "estimates": names if estimates == "named" else estimates,
        },
    }
    return from_table(table, folder).replace(changes)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", ["kcf:Kcf", "kcf_kernels:Kcf"])
@pytest.mark.parametrize("estimates", BLOCKS)
def test_the_consensus_filter_of_the_page_speaks_of_common_blocks(
    folder: Path, estimates: str, kind: str
) -> None:
    run = netkf.simulate(scenario(folder, estimates, kind), engine="simpy")
    blocks = BLOCKS[estimates]
    tables = {p.stem: pd.read_csv(p) for p in folder.glob("*.csv")}
    readings = {
        (name, row.node, row.t): row.y0 for name, t in tables.items() for row in t.itertuples()
    }
    xhat = {(i, block): 0.0 for i in NODES for block in blocks[i]}
    P = dict.fromkeys(xhat, 1.0)
    for slot in range(1, 5):
        prior = {}
        for (i, block), x in xhat.items():
            F, Q = RATES[block[0]]
            prior[i, block] = F * x
            variance = F * P[i, block] * F + Q
            y = readings.get((block[0], i, slot)) if block[1] in (0, i) else None
            K = 0.0 if y is None else variance / (variance + 0.1)
            xhat[i, block] = F * x + K * ((y or 0.0) - F * x)
            P[i, block] = (1.0 - K) * variance
        for i, block in xhat:
            heard = [j for link in LINKS if i in link for j in link if j != i]
            told = [prior[j, block] - prior[i, block] for j in heard if block in blocks[j]]
            xhat[i, block] += EPSILON * sum(told)
        for k, i in enumerate(NODES):
            n = len(blocks[i])
            expected = [xhat[i, block] for block in blocks[i]]
            np.testing.assert_allclose(run.xhat[slot, k, :n], expected, atol=1e-12)
            expected = [P[i, block] for block in blocks[i]]
            np.testing.assert_allclose(np.diag(run.P[slot, k])[:n], expected, atol=1e-12)
    # Nodes that have no block in common tell each other nothing.
    assert run.count("send") == (0 if estimates == "own" else 6 * 4)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("estimates", ["named", "own+neighbours"])
@pytest.mark.parametrize("clocks", [False, True])
def test_compiled_code_translates_as_python_does(
    folder: Path, estimates: str, clocks: bool
) -> None:
    changes = {**CLOCKED, "network.channel": {}} if clocks else {}
    lossy = {"network.channel.loss": {"kind": "bernoulli", "delivery": 0.7}}
    one = scenario(folder, estimates, "kcf_kernels:Kcf", **changes, **lossy)
    run = assert_agree(one)
    assert run.count("deliver") > 5
    late = one.replace({"network.channel.delay": {"kind": "constant", "seconds": 0.1}})
    if clocks:
        with pytest.raises(netkf.EngineError, match="translate and that take time"):
            netkf.simulate(late, engine="compiled")


CLOCKED: dict[str, Any] = {
    "plants.0": {"name": "pose", "nodes": list(NODES), "A": [[-0.4]], "B": [[0.6]], "cov": [[1.0]]},
    "plants.1": {"name": "target", "A": [[-0.1]], "B": [[0.3]], "cov": [[1.0]]},
    "network.activation": {"kind": "periodic", "period": 0.7, "at": "nodes"},
    "network.channel": {"delay": {"kind": "constant", "seconds": 0.4}},
}


def test_what_is_told_late_of_one_block_leaves_the_others(folder: Path) -> None:
    """Of own poses nothing is told, so that they are as alone, also where messages take time."""
    both, shared, alone = (
        netkf.simulate(scenario(folder, estimates, **CLOCKED))
        for estimates in ("named", "shared", "own")
    )
    assert both.count("deliver") == shared.count("deliver") > 20
    assert alone.count("send") == 0
    np.testing.assert_allclose(both.xhat[:, :, 0], alone.xhat[:, :, 0], atol=1e-12)
    np.testing.assert_allclose(both.xhat[:, :, 1], shared.xhat[:, :, 0], atol=1e-12)


@pytest.mark.parametrize("kind", ["kcf", "hybrid", "hcmci", "diffusion-kalman", "one-bit"])
def test_other_messages_are_refused_by_name(folder: Path, kind: str) -> None:
    settings: dict[str, Any] = {"kind": kind, "estimates": "own"}
    if kind == "hybrid":
        settings["epsilon"] = 0.3
    changes = {"filter": settings, **(CLOCKED if kind in ("hybrid", "hcmci") else {})}
    with pytest.raises(netkf.ScenarioError, match=r"filter.estimates: .*say no blocks.*translate"):
        scenario(folder, "own", **changes)


TUPLES = """
from dataclasses import dataclass

import kcf
from netkf.parts import Needs


def translate(payload, own, common):
    read = common.before(own[0]).copy()
    read[common.mine] = payload[0][common.theirs]
    return read, payload[1]


@dataclass(frozen=True, eq=False)
class Tuples(kcf.Kcf):
    needs = Needs(translate=translate)

    def emit(self, state, exchange):
        return state, (state.prior, "a prediction")

    def absorb(self, state, messages, exchange):
        assert all(m.payload[1] == "a prediction" for m in messages)
        return super().absorb(state, [m._replace(payload=m.payload[0]) for m in messages], exchange)
"""


@pytest.mark.parametrize("changes", [{}, CLOCKED], ids=["slots", "late under clocks"])
def test_a_class_says_how_its_messages_are_read(folder: Path, changes: dict[str, Any]) -> None:
    (folder / "tuples.py").write_text(TUPLES)
    run, expected = (
        netkf.simulate(scenario(folder, "named", kind, **changes))
        for kind in ("tuples:Tuples", "kcf:Kcf")
    )
    sys.modules.pop("tuples")
    assert run.count("deliver") == expected.count("deliver") > 20
    np.testing.assert_allclose(run.xhat, expected.xhat, atol=1e-12)


@pytest.mark.slow
def test_what_is_told_late_leaves_blocks_whose_dynamics_are_not_linear(folder: Path) -> None:
    unicycle = {
        **{"name": "pose", "nodes": list(NODES), "f": "unicycle", "step": 0.05},
        **{"input": {"kind": "constant", "value": [1.0, 0.8]}, "B": np.diag([0.1] * 3).tolist()},
        **{"mean": [0.0, 0.0, 0.5], "cov": np.diag([0.1] * 3).tolist()},
    }
    H = {"sensors.0.H": [[1.0, 0.0, 0.0]]}
    both, alone = (
        netkf.simulate(scenario(folder, estimates, **{**CLOCKED, "plants.0": unicycle, **H}))
        for estimates in ("named", "own")
    )
    assert both.count("deliver") > 20
    np.testing.assert_allclose(both.xhat[:, :, :3], alone.xhat[:, :, :3], atol=1e-10)


AFFINE = """
from dataclasses import dataclass

import kcf
import tuples
from netkf.parts import Analysis


@dataclass(frozen=True, eq=False)
class Affine(kcf.Kcf):
    analysis = Analysis(affine=True)
    shift = kcf.Kcf.shift


@dataclass(frozen=True, eq=False)
class AffineTuples(tuples.Tuples):
    analysis = Analysis(affine=True)

    def shift(self, state, offset):
        if not hasattr(state, "xhat"):
            return state[0] + offset, state[1]
        return super().shift(state, offset)
"""


@pytest.mark.slow
@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["affine:Affine", "affine:AffineTuples"])
def test_errors_of_translated_messages_are_exact(folder: Path, kind: str) -> None:
    """By the recursion of all poses and estimates together, written plainly."""
    for name, text in {"tuples": TUPLES, "affine": AFFINE}.items():
        (folder / f"{name}.py").write_text(text)
    drawn = {"kind": "linear", "H": [[1.0]], "R": [[0.1]], "nodes": list(NODES), "of": "pose"}
    given = scenario(folder, "own+neighbours", kind, sensors=[drawn])
    exact = netkf.theory.error_covariance(given, netkf.simulate(given))
    (F, Q), blocks = RATES["pose"], BLOCKS["own+neighbours"]
    rows = {key: 4 + k for k, key in enumerate((i, b[1]) for i in NODES for b in blocks[i])}
    size, P, C = 4 + len(rows), dict.fromkeys(rows, 1.0), np.zeros((4 + len(rows),) * 2)
    C[:4, :4] = np.eye(4)
    for slot in range(1, 5):
        x, prior = (np.eye(size) * F for _ in range(2))
        noise = np.zeros((size, 8))
        noise[:4, :4] = np.eye(4) * np.sqrt(Q)
        M, moved = x.copy(), noise.copy()
        for (i, b), row in rows.items():
            P[i, b] = F * P[i, b] * F + Q
            K = P[i, b] / (P[i, b] + 0.1) if i == b else 0.0
            P[i, b] *= 1.0 - K
            M[row] += K * (x[b - 1] - prior[row])
            moved[row] += K * noise[b - 1]
            moved[row, 3 + i] += K * np.sqrt(0.1)
        for (i, b), row in rows.items():
            for j in [j for link in LINKS if i in link for j in link if j != i]:
                if (j, b) in rows:
                    M[row] += EPSILON * (prior[rows[j, b]] - prior[row])
        C = M @ C @ M.T + moved @ moved.T
        for k, i in enumerate(NODES):
            E = np.zeros((len(blocks[i]), size))
            for a, (_, b) in enumerate(blocks[i]):
                E[a, b - 1], E[a, rows[i, b]] = 1.0, -1.0
            n = len(E)
            np.testing.assert_allclose(exact[slot, k, :n, :n], E @ C @ E.T, rtol=1e-9, atol=1e-12)
    if kind == "affine:Affine":
        late = given.replace(CLOCKED | {"sensors.0.sampling": {"kind": "periodic", "period": 1.0}})
        verdict = netkf.consistency(late, runs=10, workers=1)
        assert all(
            np.isfinite(row.expected) and "BROKEN" not in row.verdict for row in verdict.rows
        )
    sys.modules.pop("tuples")
    sys.modules.pop("affine")
