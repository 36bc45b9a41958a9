"""The partition filter: coupled blocks, of which each node estimates its own.

The truth is not ours: plain scalar recursions with the exact covariance of all errors beside them,
the Kalman filter of all blocks, that of one block alone, and the errors of many runs.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

import netkf
from netkf.checks.innovations import compute_innovations

AREAS = """
format = 1
name = "areas"
horizon = 12.0
probe = 1.0
seed = 5
[[plants]]
name = "area"
nodes = [1]
F = [[0.8, 0.1], [0.0, 0.7]]
Q = [[0.1, 0.0], [0.0, 0.1]]
period = 1.0
cov = [[1.0, 0.0], [0.0, 2.0]]
coupling = [{ from = [2], A = [[0.2], [0.1]] }]
[[plants]]
name = "area"
nodes = [2]
F = [[0.6]]
Q = [[0.2]]
period = 1.0
cov = [[1.0]]
coupling = [{ from = [1], A = [[0.2, 0.1]] }, { from = [3], A = [[-0.3]] }]
[[plants]]
name = "area"
nodes = [3]
F = [[0.9]]
Q = [[0.3]]
period = 1.0
cov = [[1.5]]
coupling = [{ from = [2], A = [[0.3]] }]
[[sensors]]
of = "area"
nodes = [1]
H = [[1.0, 0.0]]
R = [[0.1]]
[[sensors]]
of = "area"
nodes = [2, 3]
H = [[1.0]]
R = [[0.2]]
[network]
graph = { kind = "edges", edges = [[1, 2], [2, 3]] }
activation = { kind = "broadcast" }
channel = { loss = { kind = "bernoulli", delivery = 0.7 } }
[filter]
kind = "partition"
estimates = "own"
"""
FLOWS = """
[[sensors]]
nodes = [2]
H = [[0.0, 1.0, -1.0, 0.0]]
R = [[0.05]]
[network]"""
F = np.array([[0.8, 0.1, 0.2, 0.0], [0.0, 0.7, 0.1, 0.0], [0.2, 0.1, 0.6, -0.3], [0, 0, 0.3, 0.9]])


def clocked(text: str) -> str:
    """The same areas in continuous time, with A = F - 1."""
    for old, new in (
        ("F = [[0.8, 0.1], [0.0, 0.7]]", "A = [[-0.2, 0.1], [0.0, -0.3]]"),
        ("F = [[0.6]]", "A = [[-0.4]]"),
        ("F = [[0.9]]", "A = [[-0.1]]"),
        ("Q = [[0.1, 0.0], [0.0, 0.1]]", "B = [[0.3, 0.0], [0.0, 0.3]]"),
        ("Q = [[0.2]]", "B = [[0.4]]"),
        ("Q = [[0.3]]", "B = [[0.5]]"),
        ("period = 1.0\n", ""),
        ("R = [[0.1]]", 'R = [[0.1]]\nsampling = { kind = "periodic", period = 0.5 }'),
        ("R = [[0.2]]", 'R = [[0.2]]\nsampling = { kind = "poisson", rate = 2.0 }'),
        ("R = [[0.05]]", 'R = [[0.05]]\nsampling = { kind = "periodic", period = 0.7 }'),
        ('"broadcast"', '"poisson", rate = 3.0, at = "nodes"'),
    ):
        text = text.replace(old, new)
    return text


def load(text: str, folder: Path, **changes: object) -> netkf.Scenario:
    path = folder / "scenario.toml"
    path.write_text(text)
    return netkf.load(path, {key.replace("__", "."): value for key, value in changes.items()})


def uncoupled(text: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith("coupling"))


@pytest.mark.parametrize("text", [AREAS, clocked(AREAS)], ids=["slots", "clocks"])
def test_without_coupling_it_is_the_local_filter(tmp_path: Path, text: str) -> None:
    text = uncoupled(text)
    run = netkf.simulate(load(text, tmp_path))
    alone = load(text, tmp_path, filter={"kind": "local", "estimates": "own"})
    local = netkf.simulate(alone, engine="simpy")
    assert run.count("deliver") > 10
    np.testing.assert_allclose(run.xhat, local.xhat, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.P, local.P, rtol=1e-12)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("text", [AREAS, clocked(AREAS)], ids=["slots", "clocks"])
@pytest.mark.parametrize("estimates", ["own", "own+neighbours", "all"])
@pytest.mark.parametrize("delivery", [1.0, 0.5])
def test_it_is_never_below_the_stacked_kalman_filter(
    tmp_path: Path, text: str, estimates: str, delivery: float
) -> None:
    changes = {"network__channel__loss__delivery": delivery, "filter__estimates": estimates}
    text = text.replace("[network]", FLOWS.replace("R = [[0.05]]", _noise(text)), 1)
    scenario = load(text, tmp_path, **changes)
    run = netkf.simulate(scenario)
    central = netkf.simulate(load(text, tmp_path, filter={"kind": "central"}), engine="simpy")
    for k in range(3):
        view = np.arange(4)[scenario.view(k)]
        above = run.P[:, k][:, : len(view), : len(view)] - central.P[:, 0][:, view][:, :, view]
        assert np.linalg.eigvalsh(above).min() > -1e-10


def _noise(text: str) -> str:
    sampling = '\nsampling = { kind = "periodic", period = 0.7 }' if "sampling" in text else ""
    return "R = [[0.05]]" + sampling


SCALARS = """
format = 1
name = "two areas"
horizon = 9.0
probe = 1.0
[[plants]]
name = "area"
nodes = [1]
F = [[0.8]]
Q = [[0.1]]
period = 1.0
cov = [[1.0]]
coupling = [{ from = [2], A = [[0.3]] }]
[[plants]]
name = "area"
nodes = [2]
F = [[0.9]]
Q = [[0.2]]
period = 1.0
cov = [[0.5]]
coupling = [{ from = [1], A = [[-0.2]] }]
[[sensors]]
kind = "recorded"
path = "y.csv"
of = "area"
nodes = [1, 2]
H = [[1.0]]
R = [[0.1]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "broadcast" }
channel = { loss = { kind = "recorded", path = "lost.csv" } }
[filter]
kind = "partition"
estimates = "own"
"""


def test_two_areas_follow_a_scalar_recursion(tmp_path: Path) -> None:
    """With messages lost in both directions: what was told last is predicted with its bound. The
    exact covariance of all four errors, of what both know of both, is never above the bounds.
    """
    rng, slots = np.random.default_rng(0), range(1, 9)
    y = {(i, slot): round(float(rng.normal()), 3) for i in (1, 2) for slot in slots}
    rows = [f"{slot},{i},{value}" for (i, slot), value in y.items()]
    (tmp_path / "y.csv").write_text("t,node,y0\n" + "\n".join(rows) + "\n")
    lost = {(1, 2): [1, 1, 0, 0, 1, 1, 1, 1], (2, 1): [1, 0, 1, 0, 0, 0, 1, 1]}
    fates = [f"{i},{j},{m},{ok}" for (i, j), all_ok in lost.items() for m, ok in enumerate(all_ok)]
    (tmp_path / "lost.csv").write_text("sender,receiver,message,delivered\n" + "\n".join(fates))
    run = netkf.simulate(load(SCALARS, tmp_path))
    A, Q, R = np.array([[0.8, 0.3], [-0.2, 0.9]]), np.diag([0.1, 0.2]), 0.1
    P0 = np.diag([1.0, 0.5])
    # x[i] and s[i] are what node i knows of both areas. E is the exact covariance of the errors of
    # node 1, of node 2, and of what was known at the start, of both areas each.
    x, s, E = np.zeros((2, 2)), np.tile(np.diag(P0), (2, 1)), np.kron(np.ones((3, 3)), P0)
    base, moves, noise, start = s.copy(), [np.eye(2)] * 2, [np.zeros((2, 2))] * 2, P0
    for slot in slots:
        big, start = np.kron(np.eye(3), A), A @ start @ A.T + Q
        E = big @ E @ big.T + np.kron(np.ones((3, 3)), Q)
        T = np.eye(6)
        for i in range(2):
            x[i] = A @ x[i]
            moves[i], noise[i] = A @ moves[i], A @ noise[i] @ A.T + Q
            s[i] = (np.abs(moves[i]) @ np.sqrt(base[i])) ** 2 + np.diag(noise[i])
            for a in range(2):
                if s[i, a] > start[a, a]:
                    x[i, a], s[i, a], T[2 * i + a] = 0.0, start[a, a], np.eye(6)[4 + a]
        E = T @ E @ T.T
        for i in range(2):
            # The own reading: every node has one in every slot, and begins anew with it.
            own, K, T = 3 * i, s[i, i] / (s[i, i] + R), np.eye(6)
            x[i, i] += K * (y[i + 1, slot] - x[i, i])
            T[own, own], s[i, i] = 1.0 - K, (1.0 - K) * s[i, i]
            E = T @ E @ T.T
            E[own, own] += K**2 * R
            base[i], moves[i], noise[i] = s[i], np.eye(2), np.zeros((2, 2))
        told, T = [(x[i, i], s[i, i]) for i in range(2)], np.eye(6)
        for i, j in ((0, 1), (1, 0)):
            if lost[i + 1, j + 1][slot - 1]:
                assert told[i][1] < s[j, i]
                (x[j, i], s[j, i]), T[2 * j + i] = told[i], np.eye(6)[3 * i]
        base, E = s.copy(), T @ E @ T.T
        assert np.all(np.diag(E)[:4] <= s.reshape(4) * (1 + 1e-12))
        np.testing.assert_allclose(run.xhat[slot, :, 0], np.diag(x), atol=1e-12)
        np.testing.assert_allclose(run.P[slot, :, 0, 0], np.diag(s), rtol=1e-12)


def test_an_area_that_is_known_exactly_is_an_input_of_the_other(tmp_path: Path) -> None:
    """Told and known are both certain then, and S of what was told is zero."""
    text = SCALARS
    for old, new in (
        ("Q = [[0.2]]", "Q = [[0.0]]"),
        ("cov = [[0.5]]\ncoupling = [{ from = [1], A = [[-0.2]] }]", "cov = [[0.0]]"),
        ('kind = "recorded"\npath = "y.csv"\n', ""),
        ('channel = { loss = { kind = "recorded", path = "lost.csv" } }\n', ""),
    ):
        assert old in text
        text = text.replace(old, new)
    run, P = netkf.simulate(load(text, tmp_path)), 1.0
    assert not run.P[:, 1].any()
    assert not run.error[:, 1].any()
    for slot in range(1, 10):
        P = 1.0 / (1.0 / (0.8**2 * P + 0.1) + 1.0 / 0.1)
        assert run.P[slot, 0, 0, 0] == pytest.approx(P, rel=1e-12)


def test_errors_of_many_runs_are_within_the_bounds(tmp_path: Path) -> None:
    runs, level = 16, 1e-4
    scenario = load(AREAS, tmp_path, horizon=6.0)
    ensemble = netkf.monte_carlo(scenario, runs, workers=1)
    n = np.array([2, 1, 1])
    upper = chi2.ppf(1.0 - level / 3, runs * n) / runs
    assert (ensemble.mean_nees[-1] <= upper).all()
    # It is not far from them either: a bound of twice the covariance has half the NEES.
    assert (ensemble.mean_nees[-1] > 0.4 * n).all()


@pytest.mark.one_in(8)
@pytest.mark.parametrize("text", [AREAS, clocked(AREAS)], ids=["slots", "clocks"])
@pytest.mark.parametrize("estimates", ["own", "own+neighbours"])
@pytest.mark.parametrize("seconds", [0.0, 0.3])
def test_P_is_never_below_the_covariance_of_the_error(
    tmp_path: Path, text: str, estimates: str, seconds: float
) -> None:
    """Given the events: messages are lost, and take time."""
    text = text.replace("[network]", FLOWS.replace("R = [[0.05]]", _noise(text)), 1)
    delay = {"kind": "constant", "seconds": seconds}
    changes = {"filter__estimates": estimates, "network__channel__delay": delay}
    scenario = load(text, tmp_path, **changes)
    run = netkf.simulate(scenario)
    exact = netkf.theory.error_covariance(scenario, run)
    assert run.count("deliver") > 10
    for k in range(3):
        n = len(np.arange(4)[scenario.view(k)])
        above = run.P[:, k, :n, :n] - exact[:, k, :n, :n]
        assert np.linalg.eigvalsh(above).min() > -1e-12
        assert np.trace(run.P[-1, k, :n, :n]) < 4.0 * np.trace(exact[-1, k, :n, :n])


@pytest.mark.parametrize("text", [AREAS, clocked(AREAS)], ids=["slots", "clocks"])
def test_theory_takes_states_in_the_order_of_each_node(tmp_path: Path, text: str) -> None:
    """A node keeps its own blocks first: means and covariances of the start must follow."""
    mean = text.replace("cov = [[1.5]]", "cov = [[1.5]]\nmean = [7.0]")
    rows = netkf.theory.assumptions(load(mean, tmp_path))
    assert rows[rows["assumption"].str.startswith("P_i(0)")]["holds"].tolist() == [True]


def test_innovations_are_of_own_blocks(tmp_path: Path) -> None:
    """How errors of two nodes correlate is not known, so readings across a border have no S."""
    run = netkf.simulate(load(AREAS.replace("[network]", FLOWS, 1), tmp_path))
    found = compute_innovations(run)
    assert (found.rows == 1).all()
    assert np.count_nonzero(found.nodes == 2) == run.count("sense") // 3


def test_a_reading_across_a_border_is_used_by_covariance_intersection(tmp_path: Path) -> None:
    text = AREAS.replace("[network]", FLOWS, 1)
    horizon = {"horizon": 1.0}
    with_flow = netkf.simulate(load(text, tmp_path, **horizon))
    without = netkf.simulate(load(AREAS, tmp_path, **horizon))
    np.testing.assert_array_equal(with_flow.P[1, [0, 2]], without.P[1, [0, 2]])
    # Node 2 at slot 1: x2 of area 1 was never told, and is as at the start, predicted.
    P, C = without.P[1, 1, 0, 0], (F @ np.diag([1.0, 2.0, 1.0, 1.5]) @ F.T)[1, 1] + 0.1

    def variance(w: float) -> float:
        return 1.0 / (w / P + 1.0 / (C / (1.0 - w) + 0.05))

    best = minimize_scalar(variance, bounds=(1e-6, 1 - 1e-6), options={"xatol": 1e-9})
    assert with_flow.P[1, 1, 0, 0] == pytest.approx(min(best.fun, P), rel=1e-9)


def test_rows_across_a_border_may_stand_among_others_in_any_order(tmp_path: Path) -> None:
    H, R = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, -1.0, 0.0]]), np.diag([9.0, 0.05])
    y = np.random.default_rng(3).normal(size=(12, 2)).round(3)

    def run(order: list[int]) -> netkf.Run:
        rows = [f"{t},2,{a},{b}" for t, (a, b) in enumerate(y[:, order], 1)]
        (tmp_path / "y.csv").write_text("\n".join(["t,node,y0,y1", *rows]))
        sensor = f'kind = "recorded"\npath = "y.csv"\nnodes = [2]\nH = {H[order].tolist()}\n'
        sensor += f"R = {R[order][:, order].tolist()}\n"
        # Node 1 reads too, and tells what it knows.
        places = AREAS.rindex("[[sensors]]"), AREAS.index("[network]")
        text = AREAS[: places[0]] + "[[sensors]]\n" + sensor + AREAS[places[1] :]
        return netkf.simulate(load(text, tmp_path))

    one, other = run([0, 1]), run([1, 0])
    np.testing.assert_allclose(one.xhat, other.xhat, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.P, other.P, rtol=1e-12)


def test_bounds_do_not_depend_on_probes(tmp_path: Path) -> None:
    text = clocked(AREAS)
    often = netkf.simulate(load(text, tmp_path, probe=0.25, horizon=4.0))
    rarely = netkf.simulate(load(text, tmp_path, probe=2.0, horizon=4.0))
    np.testing.assert_allclose(often.P[::8], rarely.P, rtol=1e-8)
    np.testing.assert_allclose(often.xhat[::8], rarely.xhat, atol=1e-8)


def test_a_silent_neighbour_is_predicted_by_the_exact_flow(tmp_path: Path) -> None:
    """Nothing is heard and nothing read: P is that of the start, predicted by the plant."""
    text = clocked(AREAS).replace("nodes = [2, 3]\nH", "nodes = [3]\nH")
    changes = {"network__channel__loss__delivery": 0.0, "horizon": 4.0}
    run = netkf.simulate(load(text, tmp_path, **changes))
    A, B = F - np.eye(4), np.diag([0.3, 0.3, 0.4, 0.5])
    for k, t in enumerate(run.times):
        nested = np.block([[-A, B @ B.T], [np.zeros((4, 4)), A.T]]) * t
        moved = scipy.linalg.expm(nested)
        Phi = moved[4:, 4:].T
        cov = Phi @ np.diag([1.0, 2.0, 1.0, 1.5]) @ Phi.T + Phi @ moved[:4, 4:]
        # It knows the start of all blocks, and their correlation since then.
        assert run.P[k, 1, 0, 0] == pytest.approx(cov[2, 2], rel=1e-9)


@pytest.mark.parametrize("text", [AREAS, clocked(AREAS)], ids=["slots", "clocks"])
def test_known_inputs_of_all_blocks_shift_means_only(tmp_path: Path, text: str) -> None:
    driven = text.replace(
        "coupling = [{ from = [2], A = [[0.3]] }]",
        "coupling = [{ from = [2], A = [[0.3]] }]\n"
        'input = { kind = "sine", G = [[2.0]], amplitude = 1.0, frequency = 0.1 }',
    )
    assert driven != text
    one, other = (netkf.simulate(load(each, tmp_path)) for each in (driven, text))
    np.testing.assert_array_equal(one.P, other.P)
    np.testing.assert_allclose(one.error, other.error, atol=1e-12)
    assert one.fingerprint == other.fingerprint
    assert np.abs(one.x - other.x)[:, 0].max() > 0.1  # two areas away


@pytest.mark.parametrize("text", [AREAS, clocked(AREAS)], ids=["slots", "clocks"])
def test_it_follows_changes_of_the_plant(tmp_path: Path, text: str) -> None:
    """At the change the coupled areas become other ones, which begin with what is known."""
    key = "A" if "A = [[-0.4]]" in text else "F"
    value = "-0.9" if key == "A" else "0.1"
    line = f"schedule = [{{ from = 5.0, {key} = [[{value}]] }}]\ncoupling = [{{ from = [1]"
    changing = text.replace("coupling = [{ from = [1]", line)
    run, before = (netkf.simulate(load(each, tmp_path)) for each in (changing, text))
    np.testing.assert_allclose(run.P[:6], before.P[:6], rtol=1e-12)
    assert np.all(run.P[7:, 1, 0, 0] < before.P[7:, 1, 0, 0])
    kalman = load(changing, tmp_path, filter={"kind": "central"})
    central = netkf.simulate(kalman, engine="simpy")
    assert np.all(run.P[:, 1, 0, 0] >= central.P[:, 0, 2, 2] * (1 - 1e-12))


def test_a_message_that_took_time_is_predicted_with_what_its_sender_has_of_others(
    tmp_path: Path,
) -> None:
    """Area 1 is told of area 2 at 1 s, as it was half a second ago, when nothing had been read."""
    text = clocked(SCALARS[: SCALARS.index("[[sensors]]")])
    for old, new in (("F = [[0.8]]", "A = [[-0.2]]"), ("Q = [[0.1]]", "B = [[0.3]]")):
        text = text.replace(old, new)
    text = text.replace("horizon = 9.0", "horizon = 2.0").replace(
        "cov = [[0.5]]\ncoupling = [{ from = [1], A = [[-0.2]] }]", "cov = [[9.0]]"
    )
    text += """[[sensors]]
of = "area"
nodes = [2]
H = [[1.0]]
R = [[0.1]]
sampling = { kind = "periodic", period = 0.5, phase = 0.0 }
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "readings" }
channel = { delay = { kind = "constant", seconds = 0.25 } }
[filter]
kind = "partition"
estimates = "own"
"""
    run = netkf.simulate(load(text, tmp_path, horizon=1.2, probe=0.1))
    a, b, c, q1, q2 = -0.2, -0.1, 0.3, 0.09, 0.16

    def law(t: float) -> tuple[np.ndarray, np.ndarray]:
        A, Q = np.array([[a, c], [0.0, b]]), np.diag([q1, q2])
        moved = scipy.linalg.expm(np.block([[-A, Q], [np.zeros((2, 2)), A.T]]) * t)
        return moved[2:, 2:].T, moved[2:, 2:].T @ moved[:2, 2:]

    start = np.diag([1.0, 9.0])
    # Node 2 reads at .5 s; nothing drives it.
    Phi, Q = law(0.5)
    known = (Phi @ start @ Phi.T + Q)[1, 1]
    known = known * 0.1 / (known + 0.1)
    # It arrives at .75 s, and is used from then on: P of area 1 has what it had, and this.
    Phi, Q = law(0.75)
    own = (Phi @ start @ Phi.T + Q)[0, 0]
    Phi, Q = law(0.25)
    told = Phi[1, 1] ** 2 * known + Q[1, 1]
    Phi, Q = law(0.15)
    expected = (Phi[0, 0] * math.sqrt(own) + Phi[0, 1] * math.sqrt(told)) ** 2 + Q[0, 0]
    whole, noise = law(0.9)
    unheard = (whole @ start @ whole.T + noise)[0, 0]
    assert expected < unheard
    assert run.P[9, 0, 0, 0] == pytest.approx(expected, rel=1e-9)
    assert run.P[7, 0, 0, 0] == pytest.approx(
        (law(0.7)[0] @ start @ law(0.7)[0].T + law(0.7)[1])[0, 0], rel=1e-9
    )


def test_rows_that_read_two_unknown_blocks_are_refused(tmp_path: Path) -> None:
    text = AREAS.replace("[network]", FLOWS.replace("-1.0, 0.0", "-1.0, 1.0"), 1)
    with pytest.raises(netkf.ScenarioError, match=r"sensors\[2\].H: must read one block at most"):
        load(text, tmp_path)
    with pytest.raises(netkf.ScenarioError, match=r"must contain all that drives.*partition"):
        load(AREAS, tmp_path, filter={"kind": "block-intersection", "estimates": "own"})
    assert math.isfinite(netkf.simulate(load(AREAS, tmp_path)).P[-1, 0, 0, 0])


def test_readings_of_others_are_not_mixed_by_sigma_points(tmp_path: Path) -> None:
    """Whitened together, each row would depend on all others, whose errors may correlate: rounding
    decided what P was.
    """
    text = """
format = 1
name = "ranges"
horizon = 2.0
probe = 1.0

[[plants]]
name = "place"
nodes = [0, 1, 2]
F = [[0.9, 0.0], [0.0, 0.9]]
Q = [[0.1, 0.0], [0.0, 0.1]]
cov = [[1.0, 0.0], [0.0, 1.0]]
period = 1.0

[[sensors]]
kind = "relative-range"
of = "place"
R = [[0.1]]

[network]
graph = { kind = "complete", nodes = 3 }
activation = { kind = "broadcast" }

[filter]
kind = "partition"
estimates = "own"
"""
    load(text, tmp_path)
    with pytest.raises(netkf.ScenarioError, match=r"filter.linearise: must be \"ekf\".*node 0"):
        load(text, tmp_path, filter__linearise="ukf")
