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


@pytest.mark.parametrize("form", ["plain", "triangle"])
def test_filters_size_their_arrays_by_the_largest_reading(tmp_path, form):
    rows, table = draw_rows(form, 5, 0.5 * np.arange(12))
    assert max(sum(r[:2] == (t, n) for r in rows) for t, n, *_ in rows) == 3
    s = make(tmp_path, form, True, "one-bit", {"kind": "broadcast"}, table)
    runs = [netkf.simulate(s, engine=engine) for engine in ENGINES]
    np.testing.assert_allclose(runs[0].P, runs[1].P, rtol=1e-10)
    np.testing.assert_allclose(runs[0].xhat, runs[1].xhat, rtol=1e-10, atol=1e-12)
    assert runs[0].events.equals(runs[1].events)


CLOCK = {"kind": "poisson", "rate": 1.0}
ANCHORS = {3: (0.0, 0.0), 5: (4.0, 0.0), 7: (0.0, 3.0)}
KINDS = {"range": 1, "bearing": 1, "range-bearing": 2}


def h_and_jacobian(kind, x, place):
    d = x[:2] - np.array(place)
    rho = np.hypot(*d)
    rows = {
        "range": ([rho], [d / rho]),
        "bearing": ([np.arctan2(d[1], d[0])], [[-d[1] / rho**2, d[0] / rho**2]]),
    }
    both = [rows["range"][k] + rows["bearing"][k] for k in (0, 1)]
    y, J = rows.get(kind, both)
    return np.array(y), np.array(J)


def wrapped(kind, v):
    if kind != "range":
        v[-1] = (v[-1] + np.pi) % (2.0 * np.pi) - np.pi
    return v


def recorded_places(folder, kind, slotted, columns, lines, graph, **sensor):
    (folder / "readings.csv").write_text("\n".join([columns, *lines]) + "\n")
    plant = {"F": np.eye(2).tolist(), "Q": (0.1 * np.eye(2)).tolist(), "period": 0.5}
    if not slotted:
        plant = {"A": np.zeros((2, 2)).tolist(), "B": np.sqrt(0.2 * np.eye(2)).tolist()}
    return from_table(
        {
            "format": 1,
            "name": "places",
            "horizon": 2.0,
            "probe": 0.5,
            "plant": {"kind": "unknown", "mean": [1.0, 1.0], "cov": np.eye(2).tolist(), **plant},
            "sensors": [{"kind": kind, "path": "readings.csv", **sensor}],
            "network": {"graph": graph},
            "filter": {"kind": "central"},
        },
        folder,
    )


@pytest.mark.parametrize("slotted", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_recorded_ranges_and_bearings_to_anchors(tmp_path, kind, slotted):
    """Node 0 measures to several anchors at one instant, in radians and metres, some by halves."""
    rng, p = np.random.default_rng(2), KINDS[kind]
    places = {"kind": "edges", "edges": [], "nodes": 8}
    lines, rows = [], {}
    for t in (0.5, 1.0, 1.5):
        for anchor in rng.permutation(list(ANCHORS))[: rng.integers(2, 4)]:
            y, there = rng.normal(size=p) + 2.5, np.ones(p, dtype=bool)
            if p == 2 and rng.random() < 0.5:
                there[rng.integers(2)] = False
            entries = [t, 0, anchor, *np.where(there, y, np.nan), *([0.2] * p)]
            lines.append(",".join("" if e != e else str(e) for e in entries))
            rows.setdefault(t, []).append((anchor, y, there))
    columns = ",".join(
        ["t", "node", "to", *(f"y{k}" for k in range(p)), *(f"R{k}" for k in range(p))]
    )
    positions = [list(ANCHORS[k]) for k in sorted(ANCHORS)]
    listed = sorted({int(a) for group in rows.values() for a, *_ in group})
    assert listed == sorted(ANCHORS)
    s = recorded_places(tmp_path, kind, slotted, columns, lines, places, positions=positions)
    run = netkf.simulate(s)
    xhat, P = np.array([1.0, 1.0]), np.eye(2)
    for k in range(1, 4):
        P = P + 0.1 * np.eye(2)
        v, C = [], []
        for anchor, y, there in rows[0.5 * k]:
            # All readings of an instant are linearised at the prediction.
            expected, J = h_and_jacobian(kind, xhat, ANCHORS[int(anchor)])
            v.append(wrapped(kind, y - expected)[there])
            C.append(J[there])
        v, C = np.concatenate(v), np.concatenate(C)
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + 0.2 * np.eye(len(v)))
        xhat, P = xhat + K @ v, P - K @ C @ P
        np.testing.assert_allclose(run.xhat[k, 0], xhat, rtol=1e-10)
        np.testing.assert_allclose(run.P[k, 0], P, rtol=1e-9, atol=1e-12)


def test_ranges_from_the_nodes_of_a_graph_and_their_anchors(tmp_path):
    grid = {"kind": "grid", "rows": 2, "columns": 2}
    lines = ["0.5,0,1.2", "0.5,3,0.4"]
    own = recorded_places(tmp_path, "range", True, "t,node,y0", lines, grid, R=[[0.2]])
    nodes = netkf.simulate(own)
    lines = ["0.5,0,0,1.2", "0.5,0,3,0.4"]
    to = recorded_places(tmp_path, "range", True, "t,node,to,y0", lines, grid, R=[[0.2]])
    np.testing.assert_array_equal(netkf.simulate(to).P, nodes.P)
    np.testing.assert_array_equal(netkf.simulate(to).xhat, nodes.xhat)


@pytest.mark.parametrize(
    ("columns", "line", "sensor", "said"),
    [
        ("t,node,to,y0", "0.5,0,9,1", {}, "a node that the graph does not have, in column to of"),
        ("t,node,to,y0", "0.5,0,1.5,1", {}, "line 2: to must hold integers"),
        ("t,node,to,y0", "0.5,0,3,1", {"positions": [[0.0, 0.0]] * 2}, "in readings.csv: 3"),
        ("t,node,y0", "0.5,0,1", {"sampling": CLOCK}, "samples are at the times of the table"),
        ("t,node,y0", "0.5,0,1", {"R": None}, "add R = ..., or columns R0"),
        ("t,node,y0,R0", "0.5,0,1,-0.1", {}, "line 2: the noise R of the row must be positive"),
        ("t,node,y0,R0", "0.5,0,1,", {"R": None}, "line 2: R0 is missing"),
    ],
)
def test_mistakes_in_tables_of_ranges(tmp_path, columns, line, sensor, said):
    entry = {key: value for key, value in {"R": [[0.2]], **sensor}.items() if value is not None}
    grid = {"kind": "grid", "rows": 2, "columns": 2}
    with pytest.raises(netkf.ScenarioError) as refused:
        recorded_places(tmp_path, "range", True, columns, [line], grid, **entry)
    assert said in str(refused.value)
    assert str(refused.value).startswith("sensors[0].")


@pytest.mark.parametrize(
    ("columns", "line", "said"),
    [
        (
            "t,node,y0,y1,R0,R1",
            "0.5,0,1,2,0.1,0",
            "line 2: the noise R of the row must be positive",
        ),
        ("t,node,y0,y1,R00,R01,R11", "0.5,0,1,2,1,2,1", "line 2: the noise R of the row must be"),
        (
            "t,node,y0,y1,R00,R01,R11",
            "0.5,0,1,2,1,,1",
            "line 2: R01 is missing, and y0 has a value",
        ),
        ("t,node,y0,y1,R00,R11", "0.5,0,1,2,1,1", "add the column R01"),
        ("t,node,y0,y1,R0", "0.5,0,1,2,1", "add the column R1"),
        ("t,node,y0,y1,R0,R1", "0.5,0,1,2,x,1", "line 2: R0 must be a finite number"),
        # A column of noises that no form has would be ignored.
        ("t,node,y0,y1,R1", "0.5,0,1,2,1", "R0, R1 or R00, R01, R11, not both; got 'R1'"),
        ("t,node,y0,y1,R01,R11", "0.5,0,1,2,0,1", "not both; got 'R01'"),
        ("t,node,y0,y1,R", "0.5,0,1,2,1", "not both; got 'R'"),
        ("t,node,y0,y1,R0,R1,R2", "0.5,0,1,2,1,1,1", "not both; got 'R2'"),
        ("t,node,y0,y1,R0,R1,R00,R01,R11", "0.5,0,1,2,1,1,1,0,1", "not both; got 'R0'"),
        ("t,node,y0,y1,R00,R01,R10,R11", "0.5,0,1,2,1,0,0,1", "not both; got 'R10'"),
    ],
)
def test_mistakes_in_noises_of_rows(tmp_path, columns, line, said):
    with pytest.raises(netkf.ScenarioError) as refused:
        make(tmp_path, "triangle", True, "central", {"kind": "broadcast"}, f"{columns}\n{line}\n")
    assert said in str(refused.value)
    assert "leave out" not in str(refused.value)


def test_a_variance_that_is_missing_is_not_said_to_be_0(tmp_path):
    table = "t,node,y0,y1,R0,R1\n0.5,0,1,2,0.1,\n"
    with pytest.raises(netkf.ScenarioError, match=r"R1 is missing, and y1 has a value; write it$"):
        make(tmp_path, "triangle", True, "central", {"kind": "broadcast"}, table)


def test_a_row_without_noise_has_that_of_its_sensor_and_filters_believe_rows(tmp_path):
    table = "t,node,y0,y1,R0,R1\n0.5,0,1,2,,\n0.5,1,,2,,0.3\n"
    broadcast = {"kind": "broadcast"}
    s = make(tmp_path, "diagonal", True, "central", broadcast, table, R=R.tolist())
    P = netkf.simulate(s).P[1, 0]
    rows = [(0, 0, np.zeros(2), H, R), (0, 0, np.zeros(1), H[1:], np.array([[0.3]]))]
    np.testing.assert_allclose(P, update(np.zeros(2), F @ F.T + Q, rows)[1], rtol=1e-12)
    with pytest.raises(netkf.ScenarioError, match=r"filter.model.R: .* bring their own noise"):
        s.replace({"filter.model.R": R.tolist()})


WALK = {"kind": "unknown", "F": [[1.0]], "Q": [[0.1]], "cov": [[1.0]]}


def camera(folder, text, **keys):
    (folder / "readings.csv").write_text(text)
    return from_table(
        {
            "format": 1,
            "name": "camera",
            "horizon": 0.5,
            "probe": 1.0 / 30.0,
            "plant": {**WALK, "period": 1.0 / 30.0},
            "sensors": [{"kind": "recorded", "path": "readings.csv", "H": [[1.0]], "R": [[0.1]]}],
            "network": {"graph": {"kind": "path", "nodes": 2}},
            "filter": {"kind": "central"},
            **keys,
        },
        folder,
    )  # fmt: skip


@pytest.mark.parametrize("decimals", [2, 3, 4, 6, 9, 12])
@pytest.mark.parametrize("start", [0.0, 1248275404.12])
def test_stamps_with_few_decimals_are_those_of_the_nearest_slot(tmp_path, decimals, start):
    lines = [f"{start + k / 30:.{min(decimals, 6)}f},0,0.5" for k in range(1, 12)]
    s = camera(tmp_path, "\n".join(["t,node,y0", *lines]), time={"origin": start})
    assert list(s.sensors[0].record.slots(0, 1.0 / 30.0)) == list(range(1, 12))


@pytest.mark.parametrize(
    ("stamp", "off"),
    [("0.034", "0.000667 s after slot 1"), ("0.0330", "0.000333 s before slot 1"), ("0.1", "")],
)
def test_stamps_off_the_slots_say_by_how_much(tmp_path, stamp, off):
    if stamp == "0.1":
        camera(tmp_path, f"t,node,y0\n{stamp},0,1\n")
        return
    with pytest.raises(netkf.ScenarioError) as refused:
        camera(tmp_path, f"t,node,y0\n0.1,0,1\n{stamp},0,1\n")
    assert f"line 3: t must be a slot, a multiple of the period {1 / 30!r}" in str(refused.value)
    assert off in str(refused.value)


def test_two_stamps_on_one_slot_are_one_reading(tmp_path):
    s = camera(tmp_path, "t,node,y0\n0.0333,0,1\n0.0333333,0,1\n")
    P = 1.0 + 0.1
    assert netkf.simulate(s).P[1, 0, 0, 0] == pytest.approx(1.0 / (1.0 / P + 20.0), rel=1e-12)


def test_digits_that_do_not_tell_slots_apart_are_no_slot(tmp_path):
    plant = {**WALK, "period": 0.04}
    with pytest.raises(netkf.ScenarioError, match="after slot 1"):
        camera(tmp_path, "t,node,y0\n0.05,0,1\n", plant=plant, probe=0.04, horizon=0.4)
