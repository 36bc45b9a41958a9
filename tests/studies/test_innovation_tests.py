"""Innovations of single runs against plain formulas; healthy models are accused as rarely as
stated, broken ones with the power that is stated, at the node and from the time on.
"""

import json
import re

import numpy as np
import pandas as pd
import pytest
import scipy.signal
import scipy.stats

import netkf
from netkf.checks.innovations import Innovations, compute_innovations
from netkf.cli.main import main
from netkf.scenario.reading import from_table
from netkf.studies.innovation_tests import (
    Stretch,
    _bias,
    _ends_of,
    _inflation,
    find_stretch,
    format_innovations,
    judge_innovations,
    ljung_box,
    whiteness_p,
)
from netkf.studies.tables import format_consistency
from tests.conftest import SCENARIOS
from tests.plants.test_faults import CURVED

WALK = {
    "format": 1,
    "name": "walk",
    "horizon": 60.0,
    "probe": 60.0,
    "plant": {"kind": "diffusion", "A": [[-0.1]], "B": [[0.5]], "cov": [[1.0]]},
    "sensors": [
        {
            "nodes": [0, 1, 2],
            "H": [[1.0]],
            "R": [[0.4]],
            "sampling": {"kind": "poisson", "rate": 2.0},
        }
    ],
    "network": {"graph": {"kind": "cycle", "nodes": 4}},
    "filter": {"kind": "local"},
}

ALWAYS = {"kind": "poisson", "rate": 2.0}


def drawn(random, readings=120, nodes=4, rows=1, change=None):
    """White innovations of nodes, some of which ``change(node, times, z)`` replaces."""
    parts = []
    for node in range(nodes):
        z, times = random.standard_normal((readings, rows)), np.arange(readings) + 0.5
        parts.append((times, node, z if change is None else change(node, times, z)))
    z = np.concatenate([part[2] for part in parts])
    times = np.concatenate([part[0] for part in parts])
    owners = np.repeat(np.arange(nodes), readings)
    order, ones = np.argsort(times, kind="stable"), [np.ones(rows)] * len(z)
    nis = (z**2).sum(axis=1)
    log_density = scipy.stats.norm.logpdf(z).sum(axis=1)
    return Innovations(
        times[order], owners[order], np.full(len(z), rows), nis[order], list(z[order]),
        list(z[order]), ones, log_density[order],
    )  # fmt: skip


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return from_table(WALK, tmp_path_factory.mktemp("walk"))


def test_a_bias_is_that_of_weighted_least_squares(walk):
    """Of values v with deviations d; correlated ones count for less, by Student's quantile."""
    recorded = drawn(np.random.default_rng(8), nodes=1)
    d = np.geomspace(0.2, 5.0, 120)
    v = np.concatenate(recorded.whitened) * d + 0.4
    recorded = recorded._replace(values=list(v[:, None]), deviations=list(d[:, None]))
    row = judge_innovations(walk, recorded, 0.96).rows[0]
    assert row.bias == pytest.approx(np.average(v, weights=d**-2.0))
    error = (d**-2.0).sum() ** -0.5
    assert row.bias_reach == pytest.approx(scipy.stats.norm.isf(0.01 / 2.0) * error)
    *_, reach, _, _ = _bias(recorded, np.arange(120), np.zeros(120, dtype=int), 4.0, 0.01)
    assert reach == pytest.approx(scipy.stats.t.isf(0.01 / 2.0, 120 / 4.0 - 1.0) * 2.0 * error)
    # Of two components the one that is further from 0, by Bonferroni's inequality.
    *_, reach, _, which = _bias(recorded, np.arange(120), np.arange(120) % 2, 1.0, 0.01)
    sums, weights = ((d**-2.0 * x).reshape(60, 2).sum(axis=0) for x in (v, 1.0))
    assert which == np.argmax(np.abs(sums) / np.sqrt(weights))
    assert reach == pytest.approx(scipy.stats.norm.isf(0.01 / 4.0) * weights[which] ** -0.5)


def broken(tests):
    return [row.node for row in tests.rows if row.verdict.startswith("BROKEN")]


def test_the_statistic_is_that_of_ljung_and_box():
    values = np.random.default_rng(1).normal(3.0, 2.0, 50).cumsum()
    d, n, h = values - values.mean(), len(values), 7
    total = 0.0
    for k in range(1, h + 1):
        r = sum(d[i] * d[i - k] for i in range(k, n)) / sum(d * d)
        total += r**2 / (n - k)
    assert ljung_box(values, h) == pytest.approx(n * (n + 2) * total)
    statistic, p = whiteness_p([values], h, 0.01)
    assert statistic == ljung_box(values, h)
    assert p == pytest.approx(scipy.stats.chi2.sf(statistic, h))


def test_short_series_of_white_noise_are_rejected_as_rarely_as_stated():
    """Chi-square alone rejects 30 values about three times as often at 0.002."""
    random, level = np.random.default_rng(2), 0.002
    columns = random.standard_normal((2000, 30))
    chi_square = [scipy.stats.chi2.sf(ljung_box(one, 6), 6) for one in columns]
    rejected = sum(
        whiteness_p([one], 6, level)[1] < level
        for one, p in zip(columns, chi_square, strict=True)
        if p < level
    )
    assert sum(p < level for p in chi_square) > 8
    assert rejected <= 11  # more in one of 1000 tests


@pytest.mark.parametrize("rows", [1, 2])
def test_right_models_are_accused_as_rarely_as_stated(walk, rows):
    random = np.random.default_rng(3)
    accused = sum(
        not judge_innovations(walk, drawn(random, rows=rows, nodes=2), 0.8) for _ in range(60)
    )
    assert accused <= 20  # at most 20 % are; more in one of 100 tests


def test_correlated_innovations_count_as_often_as_they_are_independent(walk):
    """Of gossip, a chain z <- 0.8 z + noise: sums of it vary (1 + 0.8) / (1 - 0.8) times more."""
    gossip = walk.replace({"filter": {"kind": "gossip"}, "network.activation": ALWAYS})
    random, accused, found = np.random.default_rng(5), 0, []

    def chain(node, times, z):
        z[1:] *= 0.6
        for k in range(1, len(z)):
            z[k] += 0.8 * z[k - 1]
        return z

    for _ in range(60):
        recorded = drawn(random, readings=400, nodes=2, change=chain)
        accused += not judge_innovations(gossip, recorded, 0.8)
        found.append(_inflation([np.concatenate(recorded.whitened)[recorded.nodes == 0]]))
    assert accused <= 20  # of which 54 are if every innovation counts
    assert np.median(found) == pytest.approx(9.0, rel=0.15)


@pytest.mark.slow
def test_what_is_stated_as_detectable_is_found(walk):
    random = np.random.default_rng(4)
    row = judge_innovations(walk, drawn(random), 0.99).rows[2]

    def larger(node, times, z):
        return z * np.sqrt(row.nis_detectable) if node == 2 else z

    def biased(node, times, z):
        return z + row.bias_detectable if node == 2 else z

    def correlated(node, times, z):
        rho = row.correlation_detectable
        return np.sqrt(1.0 - rho**2) * scipy.signal.lfilter([1.0], [1.0, -rho], z, axis=0)

    for change in (larger, biased, correlated):
        found = [
            broken(judge_innovations(walk, drawn(random, change=change), 0.99)) for _ in range(20)
        ]
        assert sum(2 in nodes for nodes in found) >= 14  # 18 are expected; fewer in one of 500


def test_a_stretch_lasts_from_its_first_reading_to_its_last():
    times = np.array([0.5, 1.0, 2.0, 3.0, 5.0])
    assert _ends_of(Stretch(1, 4, 0.0), times) == (1.0, 3.0)
    assert np.isnan(_ends_of(Stretch(0, 5, 0.0), times)).all()


@pytest.mark.parametrize("kind", ["noise", "offset"])
def test_a_fault_is_found_at_its_node_since_its_beginning(walk, kind):
    def fault(node, times, z):
        late = (node == 1) & (times[:, None] > 80.0)
        return np.where(late, 3.0 * z if kind == "noise" else z + 2.0, z)

    random = np.random.default_rng(5)
    for _ in range(4):
        tests = judge_innovations(walk, drawn(random, change=fault), 0.99)
        assert broken(tests) == [1]
        assert tests.rows[1].since == pytest.approx(80.0, abs=8.0)
        assert np.isnan(tests.rows[1].until)


def test_a_fault_that_passes_is_found_by_its_stretch(walk):
    def fault(node, times, z):
        return np.where((node == 3) & (abs(times[:, None] - 50.0) < 5.0), 4.0 * z, z)

    tests = judge_innovations(walk, drawn(np.random.default_rng(6), change=fault), 0.99)
    assert broken(tests) == [3]
    assert (tests.rows[3].since, tests.rows[3].until) == pytest.approx((45.5, 54.5), abs=3.0)


def test_the_stretch_is_the_best_of_all_and_its_p_counts_them():
    z = np.random.default_rng(7).standard_normal(40)
    z[20:30] *= 5.0
    found = find_stretch(z**2, np.ones(40, dtype=int), z)
    gains, tails = {}, []
    for j in range(40):
        for k in range(j + 1, 41):
            S, m, mean = (z[j:k] ** 2).sum(), k - j, z[j:k].sum()
            gains[j, k] = max(0.5 * (S - m - m * np.log(S / m)), 0.5 * mean**2 / m)
            law = scipy.stats.chi2(m)
            tails += [law.sf(S), law.cdf(S), scipy.stats.norm.sf(abs(mean) / m**0.5)]
    assert (found.first, found.end) == max(gains, key=gains.get)
    assert found.p == pytest.approx(4 * 820 * min(tails), abs=0.0)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", ["local", "central", "intermittent", "gossip", "diffusion"])
def test_runs_of_filters_with_the_right_model_are_not_accused(walk, kind):
    activation = (
        {"kind": "readings"} if kind == "intermittent" else {"kind": "poisson", "rate": 2.0}
    )
    at = {"at": "nodes"} if kind == "diffusion" else {}
    talks = {} if kind in ("local", "central") else {"network.activation": {**activation, **at}}
    given = walk.replace({**talks, "filter": {"kind": kind}})
    runs = [netkf.simulate(given, seed=seed, engine="simpy") for seed in range(3)]
    tests = [netkf.innovations(run, 0.999) for run in runs]
    assert all(tests)
    assert {one.law.kind for one in tests} == {
        {"gossip": "exact", "diffusion": "smaller"}.get(kind, "white")
    }


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        ("local", {"R": [[0.04]]}),
        ("local", {"B": [[0.05]]}),
        ("central", {"R": [[0.04]]}),
        ("central", {"B": [[0.05]]}),
        ("diffusion", {"R": [[0.04]]}),
    ],
)
def test_a_wrong_noise_is_found(walk, kind, wrong):
    talks = {"network.activation": {"kind": "poisson", "rate": 2.0, "at": "nodes"}}
    given = walk.replace(
        {**(talks if kind == "diffusion" else {}), "filter": {"kind": kind, "model": wrong}}
    )
    assert not netkf.innovations(netkf.simulate(given, engine="simpy"))


def test_slots_and_records_without_truth(tmp_path):
    """A record of a random walk: the right model, one with a sensor that sticks, a wrong Q."""
    random, slots = np.random.default_rng(8), np.arange(1, 200)
    x = np.cumsum(random.normal(0.0, 0.5, len(slots)))
    y = x + random.normal(0.0, 1.0, (2, len(slots)))
    stuck = y.copy()
    stuck[1, 120:] = stuck[1, 120]
    for name, values in (("right", y), ("stuck", stuck)):
        rows = [pd.DataFrame({"t": slots, "node": i, "y0": values[i]}) for i in (0, 1)]
        pd.concat(rows).to_csv(tmp_path / f"{name}.csv", index=False)
    table = {
        **WALK,
        "horizon": 200.0,
        "plant": {"kind": "unknown", "F": [[1.0]], "Q": [[0.25]], "period": 1.0, "cov": [[0.01]]},
        "sensors": [{"kind": "recorded", "path": "right.csv", "H": [[1.0]], "R": [[1.0]]}],
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "central"},
    }
    given = from_table(table, tmp_path)
    tests = netkf.innovations(given)
    assert tests
    assert sum(row.log_likelihood for row in tests.rows) == pytest.approx(
        netkf.log_likelihood(given), abs=1e-8
    )
    found = netkf.innovations(given.replace({"sensors.0.path": "stuck.csv"}))
    assert 1 in broken(found)
    assert found.rows[1].since == pytest.approx(121.0, abs=15.0)
    assert not netkf.innovations(given.replace({"plant.Q": [[2.5e-3]]}))


NAMED = {
    **WALK,
    "horizon": 2.0,
    "probe": 1.0,
    "plant": {
        "kind": "diffusion",
        "A": [[-0.1, 1.0], [0.0, -0.3]],
        "B": [[0.0], [0.5]],
        "states": ["height", "speed"],
        "units": ["m", "m/s"],
    },
    "sensors": [
        {
            **WALK["sensors"][0],
            "nodes": [0, 2],
            "H": [[1.0, 0.0], [0.0, -1.0]],
            "R": np.eye(2).tolist(),
        },
        {
            **WALK["sensors"][0],
            "nodes": [1],
            "H": [[1.0, 0.0], [2.0, 0.0]],
            "R": np.eye(2).tolist(),
        },
        {
            "sampling": WALK["sensors"][0]["sampling"],
            "kind": "range-bearing",
            "nodes": [2],
            "R": np.eye(2).tolist(),
            "positions": [[0.0, 0.0]],
        },
    ],
}


def test_what_is_biased_has_its_name_and_unit(tmp_path):
    """The second values of nodes are shifted: those read the speed, twice the height, and either
    the speed or a bearing.
    """
    scenario = from_table(NAMED, tmp_path)

    def shifted(node, times, z):
        return z + np.array([0.0, 3.0])

    rng = np.random.default_rng(7)
    recorded = drawn(rng, nodes=3, rows=2, change=shifted)
    linear = scenario.replace({"sensors": NAMED["sensors"][:2]})
    tests = judge_innovations(linear, recorded, 0.99)
    assert [row.component for row in tests.rows] == [1, 1, 1]
    assert [row.label for row in tests.rows] == ["speed (m/s)", "", "speed (m/s)"]
    assert "biased in speed (m/s)" in tests.rows[0].verdict
    shown = format_innovations(tests).splitlines()
    assert [re.split(r"  +", line.strip())[4] for line in (shown[0], *shown[2:5])] == [
        *("of", "speed (m/s)", "y1", "speed (m/s)"),
    ]
    assert "in speed (m/s)" in shown[-1]
    # Of two sensors at different times nobody can tell which one the second values come from.
    assert [scenario.label_of_value(2, 1, np.full(9, size)) for size in (2, 4)] == [
        *("", "speed (m/s)"),
    ]
    assert scenario.label_of_value(2, 3, np.full(9, 4)) == "bearing (rad)"
    assert scenario.what_is_read(2).endswith("range in height (m), speed (m/s), bearing (rad)")
    unnamed = linear.replace({"plant.states": None, "plant.units": None})
    assert judge_innovations(unnamed, recorded, 0.99).rows[0].label == ""
    alone = judge_innovations(from_table(WALK, tmp_path), drawn(rng), 0.99)
    assert " of " not in format_innovations(alone).splitlines()[0]


def test_nodes_have_the_names_of_the_scenario(tmp_path):
    names = ["attic", "cellar", "roof", "shed"]
    graph = {"kind": "edges", "nodes": names, "edges": [[names[k], names[k + 1]] for k in range(3)]}
    sensors = [{**WALK["sensors"][0], "nodes": names}]
    scenario = from_table(WALK | {"network": {"graph": graph}, "sensors": sensors}, tmp_path)
    tests = judge_innovations(scenario, drawn(np.random.default_rng(7)), 0.99)
    assert [str(row.node) for row in tests.rows] == names
    assert [line.split()[0] for line in format_innovations(tests).splitlines()[2:6]] == names


@pytest.mark.parametrize("kind", ["central", "local"])
def test_values_of_a_node_are_told_apart(tmp_path, kind):
    """The central filter takes them one by one, and sensors have times of their own, or rows with
    missing values, or read alike: biases do not cancel. A bad sensor is that of its node.
    """
    clock = WALK["sensors"][0]["sampling"]
    fault = {"kind": "biased", "size": [2.0, -2.0]}
    pair = {"nodes": [1], "H": np.eye(2).tolist(), "R": np.eye(2).tolist(), "sampling": clock}
    apart = [
        {**pair, "H": [row], "R": [[1.0]], "fault": {**fault, "size": [size]}}
        for row, size in zip(np.eye(2).tolist(), fault["size"], strict=True)
    ]
    alike = [{**one, "H": [[1.0, 0.0]]} for one in apart]
    for sensors in ([{**pair, "fault": fault}], apart, alike):
        changed = {"horizon": 60.0, "sensors": sensors, "filter": {"kind": kind}}
        (row,) = netkf.innovations(from_table({**NAMED, **changed}, tmp_path)).rows
        assert (row.node, row.label in ("height (m)", "speed (m/s)")) == (1, True)
        assert abs(row.bias) > 1.0
        assert f"biased in {row.label}" in row.verdict


def test_consistency_names_the_states(tmp_path):
    scenario = from_table({**NAMED, "sensors": NAMED["sensors"][:1]}, tmp_path)
    found = netkf.consistency(scenario, 10, engine="simpy", workers=1)
    assert found.states == "states: height (m), speed (m/s)"  # and so in --json
    assert found.states in format_consistency(found).splitlines()


@pytest.mark.slow
def test_the_command_says_which_node(capsys):
    path = str(SCENARIOS / "ulb_library.toml")
    arguments = ["innovations", path, "--set", 'filter={kind="central"}', "--set", "horizon=2400.0"]
    assert main(arguments) == 1
    out, err = capsys.readouterr()
    assert "node 1, 2, 3" in err
    assert "found with probability 0.9 at every node" in out
    assert main([*arguments, "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)["rows"]
    # Mote 9 reads .6 degrees less than the others.
    assert min(rows, key=lambda row: row["bias"])["node"] == 9
    assert main(["innovations", path, "--set", "sensors=[]"]) == 2


def test_a_node_with_too_few_readings_does_not_hide_what_others_would_show(tmp_path):
    """No infinity is printed: neither beside its bias nor as what is found at all nodes."""
    table = {**WALK, "filter": {"kind": "hybrid", "epsilon": 0.3}}
    network = {**WALK["network"], "activation": {"kind": "poisson", "rate": 1.0}}
    scenario = from_table({**table, "network": network}, tmp_path)
    for readings, last in ((120, "found with"), (2, "if the model")):
        recorded = drawn(np.random.default_rng(3), readings, nodes=3)
        kept = np.flatnonzero((recorded.nodes != 2) | (recorded.times < 3.0))
        lists = [[values[k] for k in kept] for values in recorded[4:7]]
        arrays = [values[kept] for values in (*recorded[:4], recorded[7])]
        fewer = Innovations(*arrays[:4], *lists, arrays[4])
        shown = format_innovations(judge_innovations(scenario, fewer, 0.99))
        assert "not judged: too few" in shown
        assert "inf" not in shown
        assert shown.splitlines()[-1].startswith(last)


@pytest.mark.parametrize(
    ("kind", "linearise"), [("icf", "ukf"), ("diffusion", "ckf"), ("central", "ekf")]
)
def test_a_replay_has_the_sigma_points_of_the_run(tmp_path, kind, linearise):
    """Nodes that start at one place: the sign of a rounding error decides on a direction."""
    text = CURVED.format(fault="", filter=kind, estimates="all").replace("lives", "# lives")
    text = text.replace("relative-range", "relative-range-bearing").replace("path", "complete")
    text = text.replace("R = [[0.2]]", "R = [[0.2, 0.0], [0.0, 0.05]]").replace("= 2 }", "= 4 }")
    path = tmp_path / "one_place.toml"
    path.write_text(text.replace("nodes = [0, 1]\nperiod", "nodes = [0, 1, 2, 3]\nperiod"))
    changes = {"filter.linearise": linearise, "filter.gate": {"probability": 0.9}, "seed": 1}
    run = netkf.simulate(netkf.load(path).replace(changes), engine="simpy")
    # The central filter is no node of the network.
    nodes = [-1] if kind == "central" else [0, 1, 2, 3]
    assert [row.node for row in netkf.innovations(run).rows] == nodes


def test_only_readings_that_are_recorded_count():
    """A slot at the horizon is replayed for its sample, and has no events."""
    run = netkf.simulate(netkf.load(SCENARIOS / "push_sum_planar.toml", {"horizon": 20.0}))
    sensed = run.events[run.events["kind"] == "sense"]
    found = compute_innovations(run)
    assert len(sensed)
    assert sorted(found.nodes.tolist()) == sorted(sensed["node"].tolist())
    assert found.times.max() == sensed["t"].max() < 20.0
