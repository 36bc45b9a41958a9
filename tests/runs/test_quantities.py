"""What means over time hide: recomputed from the tables of runs, and against closed forms."""

import json
import math

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.runs.connectivity import newest_heard
from netkf.runs.quantities import NETWORK, NetworkSink, sample_quantities
from netkf.scenario.reading import from_table
from netkf.trace.schema import CODES
from tests.conftest import SCENARIOS

BASE = """
format = 1
name = "ages"
horizon = {horizon}
probe = {probe}
[plant]
kind = "diffusion"
A = [[-1.0]]
B = [[1.0]]
[[sensors]]
nodes = {sensing}
H = [[1.0]]
R = [[1.0]]
{more}
"""


def scenario_of(tmp_path, more, sensing="[0]", horizon=2000.0, probe=2000.0):
    file = tmp_path / "ages.toml"
    text = BASE.format(more=more, sensing=sensing, horizon=horizon, probe=probe)
    if "[filter]" not in text:
        text += '\n[filter]\nkind = "hybrid"\nepsilon = 0.3\ncov = [[1.0]]\n'
    file.write_text(text)
    return netkf.load(file)


def network(scenario, seed=1, engine="simpy"):
    """The quantities NETWORK by name, each (N + 1,)."""
    sink = NetworkSink(scenario, seed, 0)
    netkf.simulate(scenario, seed, engine=engine, sinks=[sink])
    return dict(zip(NETWORK, sink.values(complete=True).T, strict=True))


def run_directory(tmp_path, file, *options):
    out = tmp_path / "out"
    assert main(["run", str(file), "--out", str(out), "--no-plot", *options]) == 0
    return json.loads((out / "summary.json").read_text()), out


ORDERS = {"quantile_50": 0.5, "quantile_90": 0.9, "quantile_99": 0.99}


def by_pandas(lengths, level):
    found = {name: lengths.quantile(order) for name, order in ORDERS.items()}
    return {"worst_instant": lengths.max(), "time_above": (lengths > level).mean(), **found}


@pytest.mark.parametrize("known", [True, False])
def test_samples_of_a_run_by_pandas(known, tmp_path):
    """Errors, or roots of trace P where the truth is unknown."""
    level = 1.0
    options = ["--set", f"metrics.level={level}"]
    if not known:
        options += ["--set", 'plant.kind="unknown"', "--set", "plant.mean=[0.0, 0.0]"]
        readings = "".join(f"{0.5 * k},{k % 2 * 3},0.3\n" for k in range(1, 30))
        (tmp_path / "readings.csv").write_text("t,node,y0\n" + readings)
        sensor = 'kind = "recorded", path = "readings.csv", nodes = [0, 3], R = [[0.25]]'
        options += ["--set", f"sensors=[{{ {sensor}, H = [[1.0, 0.0]] }}]"]
    (tmp_path / "ring.toml").write_text((SCENARIOS / "poisson_ring.toml").read_text())
    summary, out = run_directory(tmp_path, tmp_path / "ring.toml", *options)
    states = pd.read_parquet(out / "states.parquet")
    states = states[states.t > 0.0]
    states["length"] = np.sqrt(states.sq_error if known else states.P00 + states.P11)
    for row in summary["nodes"]:
        own = states[states.node == row["node"]]
        assert {k: row[k] for k in by_pandas(own.length, level)} == pytest.approx(
            by_pandas(own.length, level)
        )
        assert row["worst_at"] == own.t[own.length.idxmax()]
    overall = by_pandas(states.length, level)
    assert {k: summary["overall"][k] for k in overall} == pytest.approx(overall)


def test_samples_of_an_ensemble_by_pandas(tmp_path):
    """Means over the runs of the quantities of each run, with their standard errors."""
    options = ["--runs", "6", "--trace", "full", "--set", "metrics.level=1.0"]
    summary, out = run_directory(tmp_path, SCENARIOS / "poisson_ring.toml", *options)
    states = pd.read_parquet(out / "states.parquet")
    states = states[states.t > 0.0].assign(length=lambda d: np.sqrt(d.sq_error))
    for row in (*summary["nodes"], summary["overall"]):
        own = states[states.node == row["node"]] if "node" in row else states
        each = pd.DataFrame([by_pandas(one.length, 1.0) for _, one in own.groupby("run")])
        for name in each:
            assert row[name] == pytest.approx(each[name].mean())
            assert row[f"{name}_se"] == pytest.approx(each[name].std() / math.sqrt(6))
    assert not set(NETWORK) & set(summary["overall"])


def ages_by_hand(scenario, log, sources):
    """Time average and maximum of each age, by plain dictionaries."""
    nodes, end = scenario.nodes, scenario.horizon
    analysis = scenario.node_filter.analysis
    period = scenario.slot_plant.period if scenario.slotted else 0.0
    known = {i: dict.fromkeys(sources, 0.0) for i in nodes}
    history = {(i, s): [(0.0, 0.0)] for i in nodes for s in sources}
    flying, waiting = {}, {i: [] for i in nodes}
    kinds = {code: kind for kind, code in CODES.items()}
    for row in log:
        kind, i, j, t = kinds[row["kind"]], int(row["node"]), int(row["peer"]), float(row["t"])
        key = int(row["message"])
        if kind == "sense" and i in sources and i not in scenario.increment_sensors:
            known[i][i] = t // period * period if period else t
        elif kind == "send":
            told = dict(known[i]) if analysis.tells_estimates(int(row["phase"])) else {}
            if i in sources:
                told[i] = t if i in scenario.increment_sensors else known[i][i]
            flying[i, j, key] = told
        elif kind in ("lost", "late"):
            flying.pop((i, j, key) if kind == "lost" else (j, i, key))
        elif kind == "deliver":
            waiting[i].append((j, key, flying.pop((j, i, key))))
        elif kind in ("absorb", "swap"):
            if analysis.swaps:
                waiting[i] = [max(waiting[i], key=lambda one: one[:2])]
            for *_, told in waiting[i]:
                for s, time in told.items():
                    known[i][s] = time if analysis.swaps else max(known[i][s], time)
                    history[i, s].append((t, known[i][s]))
            waiting[i] = []
        elif kind == "crash":
            waiting[i] = []
    mean, worst = {}, {}
    for (i, s), steps in history.items():
        if i != s:
            stops = [t for t, _ in steps[1:]] + [end]
            pieces = [(t, stop, v) for (t, v), stop in zip(steps, stops, strict=True)]
            area = sum((b - a) * (0.5 * (a + b) - v) for a, b, v in pieces)
            mean.setdefault(i, []).append(area / end)
            worst.setdefault(i, []).append(max(b - v for _, b, v in pieces))
    return mean, worst


SHORT = {"horizon": 1.0, "probe": 0.5}
FILTERS = {
    "combining": {},
    "swapping": {"filter": {"kind": "gossip"}},
    "samples": {"sensors.0.sampling": {"kind": "poisson", "rate": 1.0}},
    "delayed": {"network.channel.delay": {"kind": "exponential", "mean": 1.0}},
    "late in slots": {**SHORT, "network.channel.delay": {"kind": "exponential", "mean": 0.01}},
    "crashes in slots": {
        **SHORT,
        "network.lives": [{"kind": "crashes", "nodes": [1, 2], "mean_up": 0.5, "mean_down": 0.1}],
    },
}


@pytest.mark.parametrize("case", [*FILTERS, "readings alone", "swaps in slots"])
def test_ages_by_hand(case):
    """Messages that combine, replace, are delayed or tell readings only; many in flight."""
    files = {"readings alone": "intermittent_random10", "swaps in slots": "gossip_ring"}
    files |= dict.fromkeys(("crashes in slots", "late in slots"), "push_sum_planar")
    scenario = netkf.load(SCENARIOS / f"{files.get(case, 'poisson_ring')}.toml")
    scenario = scenario.replace(FILTERS.get(case, {}))
    run = netkf.simulate(scenario, seed=4, engine="simpy")
    mean, worst = ages_by_hand(scenario, run.log, set(scenario.sensing_nodes))
    for size in (len(run.log), 7):  # blocks do not matter
        sink = NetworkSink(scenario, 4, 0)
        for first in range(0, len(run.log), size):
            sink.events(run.log[first : first + size])
        found = dict(zip(NETWORK, sink.values(complete=True).T, strict=True))
        for k, node in enumerate(scenario.nodes):
            if node in mean:
                assert found["mean_age"][k] == pytest.approx(np.mean(mean[node]), rel=1e-12)
                assert found["worst_age"][k] == pytest.approx(max(worst[node]), rel=1e-12)
    assert found["mean_age"][-1] == pytest.approx(np.nanmean(found["mean_age"][:-1]))
    assert found["worst_age"][-1] == np.nanmax(found["worst_age"][:-1])


def test_of_two_messages_of_an_instant_a_swap_takes_the_newest(tmp_path):
    """The first takes a second and comes with the next one, which takes no time."""
    (tmp_path / "delays.csv").write_text(
        "sender,receiver,message,seconds\n0,1,0,1.0\n0,1,1,0.0\n1,0,0,0.0\n1,0,1,0.0\n"
    )
    (tmp_path / "samples.csv").write_text("t,node\n0.75,0\n1.75,0\n")
    (tmp_path / "pair.toml").write_text(
        """
format = 1
name = "pair"
horizon = 3.0
probe = 1.0
plant = { kind = "diffusion", A = [[-1.0]], B = [[1.0]] }
filter = { kind = "gossip" }
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[1.0]]
sampling = { kind = "recorded", path = "samples.csv" }
[network]
graph = { kind = "path", nodes = 2 }
activation = { kind = "periodic", period = 1.0 }
channel = { delay = { kind = "recorded", path = "delays.csv" } }
"""
    )
    # It is t until 2 s, when the reading of 1.75 s comes.
    assert network(netkf.load(tmp_path / "pair.toml"))["mean_age"][1] == (2.0 + 0.75) / 3.0


PATH = """
[network]
graph = {{ kind = "path", nodes = {nodes} }}
activation = {{ {clock}, at = "directions" }}
channel = {{ loss = {{ kind = "bernoulli", delivery = {p} }}, symmetric = false }}
"""
GAMMA = 'kind = "renewal", distribution = "gamma", shape = 3.0, mean = 0.6'
CLOSED = {
    # Heard at rate 2 p: exponential gaps, E[X^2] / (2 E[X]) = 1 / (2 p).
    "poisson": ('kind = "poisson", rate = 2.0', 2, 0.4, 1.0 / (2.0 * 0.4)),
    # Gamma gaps of mean m and shape k: m (k + 1) / (2 k).
    "renewal": (GAMMA, 2, 1.0, 0.6 * 4.0 / 6.0),
    # K periods of 1 between two heard, K geometric: (2 - p) / (2 p).
    "periodic": ('kind = "periodic", period = 1.0', 2, 0.4, (2.0 - 0.4) / (2.0 * 0.4)),
    # Two relays in a row, each memoryless: ages add.
    "relay": ('kind = "poisson", rate = 2.0', 3, 1.0, 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CLOSED)
def test_mean_ages_by_closed_forms(case, tmp_path):
    clock, nodes, p, expected = CLOSED[case]
    scenario = scenario_of(tmp_path, PATH.format(clock=clock, nodes=nodes, p=p))
    found = network(scenario)["mean_age"][nodes - 1]
    # About 800 renewals or more, so that the mean has a standard error below 4 %.
    assert found == pytest.approx(expected, rel=0.12)


def test_nobody_hears_anybody(tmp_path):
    """The age is the time since 0; filters that do not talk have none."""
    more = PATH.format(clock='kind = "poisson", rate = 2.0', nodes=2, p=0.0)
    scenario = scenario_of(tmp_path, more, horizon=8.0, probe=1.0)
    found = network(scenario)
    assert found["mean_age"].tolist()[1:] == [4.0, 4.0]
    assert found["worst_age"].tolist()[1:] == [8.0, 8.0]
    assert np.isnan(found["mean_age"][0])  # the only sensor is its own
    silent = network(scenario.replace({"filter": {"kind": "local"}}))
    assert np.isnan(silent["mean_age"]).all()


LIVES = """
[network]
graph = {{ kind = "path", nodes = 3 }}
activation = {{ kind = "periodic", period = 1.0, at = "nodes" }}
[[network.lives]]
nodes = [1]
kind = "duty"
period = 10.0
up = 6.0
phase = 0.5
memory = "{memory}"
[network.energy]
joules_per_packet = 0.25
joules_per_byte = 0.5
[network.radio]
frame_bytes = 10
"""


def test_a_node_that_sleeps_divides_the_network(tmp_path):
    """Up in [0.5, 6.5) of each 10 s: 6 of 10 samples at whole seconds; then 0 - 1 - 2 are one part,
    else 0 and 2 are two of one node each.
    """
    more = LIVES.format(memory="kept")
    file_scenario = scenario_of(tmp_path, more, horizon=200.0, probe=1.0)
    assert file_scenario.network.energy.joules_per_byte == 0.5
    summary, _ = run_directory(tmp_path, tmp_path / "ages.toml", "--set", "metrics.level=0.5")
    entry = summary["connectivity"]
    assert [row["time_connected"] for row in summary["nodes"]] == [1.0, 120 / 201, 1.0]
    assert entry["connected"] == summary["overall"]["time_connected"] == 120 / 201
    assert entry["components"] == pytest.approx((120 + 81 * 2) / 201)
    assert [link["up"] for link in entry["links"]] == [120 / 201] * 2
    # An estimate with its covariance is two numbers of 8 bytes, sent in two frames of at most 10.
    for row in (*summary["nodes"], summary["overall"]):
        assert row["bytes"] == 16.0 * row["transmissions"]
        assert row["joules"] == pytest.approx(row["transmissions"] * (2 * 0.25 + 16.0 * 0.5))
    assert summary["overall"]["transmissions"] == summary["messages"]["transmissions"]


def test_who_forgets_knows_nothing_of_others(tmp_path):
    """Node 1 hears node 0 every second while it is up; what it kept goes on ageing while it is
    down, and what it lost is as old as the run.
    """
    ages = {}
    for memory in ("kept", "lost"):
        scenario = scenario_of(tmp_path, LIVES.format(memory=memory), horizon=200.0, probe=1.0)
        ages[memory] = network(scenario)["worst_age"][1]
    # Down from 6.5 s to 10.5 s after its last message at 6 s, heard again at 11 s.
    assert ages["kept"] == pytest.approx(5.0)
    # From 196.5 s to the end at 200 s it knows nothing.
    assert ages["lost"] == pytest.approx(200.0)


def test_contacts_connect(tmp_path):
    """Two links of a path, in contact in [0, 40] and [20, 60] of 100 s: both for 21 of the samples
    at 0, 1, .. 100 s.
    """
    rows = "from,until,node,peer\n0,40,0,1\n20,60,1,2\n"
    (tmp_path / "contacts.csv").write_text(rows)
    more = """
[network]
graph = { kind = "path", nodes = 3 }
activation = { kind = "contacts", path = "contacts.csv", clock = { kind = "poisson", rate = 1.0 } }
"""
    scenario = scenario_of(tmp_path, more, horizon=100.0, probe=1.0)
    shares = network(scenario)["time_connected"]
    # A node of a pair is in the largest part, and so is each of three that are alone.
    alone = 101 - 61
    assert shares.tolist() == [(41 + alone) / 101, 1.0, (41 + alone) / 101, 21 / 101]


def test_a_link_connects_as_long_as_its_directions_both_do(tmp_path):
    """In contact in [0, 40] and back in [0, 20] of 100 s: 41 and 21 samples at 0, 1, .. 100 s."""
    (tmp_path / "contacts.csv").write_text("from,until,node,peer\n0,40,0,1\n0,20,1,0\n")
    more = """
[network]
graph = { kind = "path", nodes = 2 }
activation = { kind = "contacts", path = "contacts.csv", at = "directions", clock = CLOCK }
""".replace("CLOCK", '{ kind = "poisson", rate = 1.0 }')
    scenario_of(tmp_path, more, horizon=100.0, probe=1.0)
    summary, _ = run_directory(tmp_path, tmp_path / "ages.toml")
    assert [link["up"] for link in summary["connectivity"]["links"]] == [21 / 101]
    assert summary["connectivity"]["connected"] == 21 / 101


def test_who_goes_down_is_gone_at_the_sample_of_that_instant_and_the_radius_is_in_range(tmp_path):
    (tmp_path / "lives.csv").write_text("t,node,what\n3,1,down\n")
    (tmp_path / "places.csv").write_text("node,x,y\n0,0,0\n1,0.6,0.8\n")
    more = """
[network]
graph = { kind = "range", radius = 1.0, nodes = 2 }
positions = "places.csv"
activation = { kind = "poisson", rate = 1.0 }
[[network.lives]]
kind = "recorded"
nodes = [1]
path = "lives.csv"
"""
    scenario_of(tmp_path, more, horizon=5.0, probe=1.0)
    summary, _ = run_directory(tmp_path, tmp_path / "ages.toml")
    # Up at 0, 1, 2 of the samples at 0, .. 5 s; then who is up is alone, and connected.
    assert [link["up"] for link in summary["connectivity"]["links"]] == [0.5]
    assert [row["time_connected"] for row in summary["nodes"]] == [1.0, 0.5]


def test_links_over_which_nothing_was_ever_heard_are_down(tmp_path):
    rows = [f"{i},{1 - i},{k},0\n" for i in (0, 1) for k in range(40)]
    (tmp_path / "losses.csv").write_text("sender,receiver,message,delivered\n" + "".join(rows))
    more = """
[network]
graph = { kind = "path", nodes = 2 }
activation = { kind = "periodic", period = 0.5 }
channel = { loss = { kind = "recorded", path = "losses.csv" } }
"""
    scenario = scenario_of(tmp_path, more, horizon=10.0, probe=0.5)
    assert network(scenario)["time_connected"][-1] == 0.0


def test_the_newest_message_that_has_come_may_have_overtaken_others():
    arrived, sent, t = np.array([[1.0, 2.0, 3.0], [0.5, 0.2, 2.5], [0.9, 1.0, 3.0]])
    assert newest_heard(arrived, sent, t).tolist() == [0.0, 0.5, 2.5]
    assert newest_heard(arrived, sent, np.array([2.0])).tolist() == [0.5]


def test_a_run_that_ended_early_has_ages_up_to_its_last_event(tmp_path):
    more = """
[network]
graph = { kind = "path", nodes = 2 }
activation = { kind = "periodic", period = 1.0 }
channel = { loss = { kind = "bernoulli", delivery = 0.0 } }
"""
    scenario = scenario_of(tmp_path, more, horizon=9.0, probe=9.0)
    sink, log = NetworkSink(scenario, 1, 0), netkf.simulate(scenario, engine="simpy").log
    sink.events(log[log["t"] <= 4.0])
    assert sink.values(complete=False)[1, :2].tolist() == [2.0, 4.0]


def test_slots_without_a_row_bring_no_reading(tmp_path):
    """Rows of slots 1 and 3 of 0 .. 7: the oldest that node 1 knows is of 3 s, at 8 s."""
    (tmp_path / "y.csv").write_text("t,node,y0\n1,0,0.5\n3,0,0.1\n")
    sensor = {"kind": "recorded", "nodes": [0], "path": "y.csv", "H": [[1.0]], "R": [[1.0]]}
    table = {
        "format": 1, "name": "rows", "horizon": 8.0, "probe": 1.0, "sensors": [sensor],
        "plant": {"kind": "unknown", "F": [[0.9]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]},
        "network": {
            "graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"},
        },
        "filter": {"kind": "kcf", "epsilon": 0.1},
    }  # fmt: skip
    assert network(from_table(table, tmp_path))["worst_age"][1] == 5.0


def test_what_a_node_had_heard_when_it_went_down_is_lost(tmp_path):
    """Node 1 hears one message of node 0, in the slot in which it goes down, and all of node 2."""
    rows = [f"{i},{j},{k},{int((i, j, k) == (0, 1, 2) or i == 2)}\n"
            for i, j in ((0, 1), (1, 0), (1, 2), (2, 1)) for k in range(9)]  # fmt: skip
    (tmp_path / "losses.csv").write_text("sender,receiver,message,delivered\n" + "".join(rows))
    (tmp_path / "lives.csv").write_text("t,node,what\n3.1,1,down\n3.2,1,up\n")
    table = {
        "format": 1, "name": "lost", "horizon": 8.0, "probe": 1.0,
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
        "plant": {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]},
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": {"kind": "broadcast", "phase": 0.3},
            "channel": {"loss": {"kind": "recorded", "path": "losses.csv"}, "symmetric": False},
            "lives": [{"kind": "recorded", "nodes": [1], "path": "lives.csv"}],
        },
        "filter": {"kind": "kcf", "epsilon": 0.1},
    }  # fmt: skip
    scenario = from_table(table, tmp_path)
    log = netkf.simulate(scenario, 1, engine="simpy").log
    heard = log[(log["kind"] == CODES["deliver"]) & (log["peer"] == 0)]
    assert heard["t"].tolist() == [3.0]
    assert network(scenario)["worst_age"][1] == 8.0


def test_one_sample_that_is_nan_leaves_nothing_of_its_node_and_of_all(ring):
    squares = np.ones((4, len(ring.nodes)))
    squares[2, 1] = np.nan
    found = sample_quantities(ring, squares)
    assert np.isnan(found[[1, -1]]).all()
    assert (found[0] == found[0, 0]).all()


def test_bytes_are_those_of_each_exchange(tmp_path):
    file = SCENARIOS / "push_sum_planar.toml"
    scenario = netkf.load(file).replace({"horizon": 1.0})
    found, run = network(scenario), netkf.simulate(scenario, 1, engine="simpy")
    sends = run.events[run.events["kind"] == "send"].drop_duplicates(["t", "node", "phase"])
    sizes = [scenario.message_size(node, phase)
             for node, phase in zip(sends["node"], sends["phase"], strict=True)]  # fmt: skip
    assert len(set(sizes)) > 1
    assert found["bytes"][-1] == sum(sizes)


def test_both_engines_and_ensembles_agree(tmp_path):
    file = SCENARIOS / "gossip_ring.toml"
    scenario = netkf.load(file).replace({"horizon": 20.0, "network.channel.loss": LOSS})
    one = network(scenario, engine="simpy")
    other = network(scenario, engine="compiled")
    assert {k: v.tolist() for k, v in one.items() if k != "joules"} == {
        k: v.tolist() for k, v in other.items() if k != "joules"
    }
    wanted = scenario.replace({"metrics.network": True})
    each = [NetworkSink(scenario, 1, k) for k in range(3)]
    for k, sink in enumerate(each):
        netkf.simulate(scenario, 1, k, sinks=[sink])
    means = np.mean([sink.values(complete=True)[:, :5] for sink in each], axis=0)
    rows = netkf.sweep(wanted, {"seed": [1]}, runs=3)
    assert rows[["mean_age", "worst_age", "bytes"]].to_numpy()[0] == pytest.approx(
        means[-1, [0, 1, 4]]
    )


LOSS = {"kind": "bernoulli", "delivery": 0.7}


def test_no_error_is_above_a_level_whose_square_is_beyond_the_range_of_numbers():
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"metrics.level": 1e300})
    found = sample_quantities(scenario, np.ones((len(scenario.times), len(scenario.nodes))))
    assert (found[:, -1] == 0.0).all()
