"""Places of nodes: delivery by distance and links by range, against what positions say."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf.checks.records.events import event_fault
from netkf.core.errors import NetkfError, TheoryError
from netkf.network.losses import DistanceLoss, Transmission
from netkf.rng.streams import Streams
from netkf.scenario.reading import from_table, parse_toml
from netkf.scenario.usage import record_usage
from netkf.scenario.writing import as_table, resolve_defaults, to_toml
from netkf.theory.errors import error_covariance, error_law
from netkf.theory.promises import compute_promises, promises_text
from netkf.trace.schema import CODES
from tests.engines.agreement import assert_agree
from tests.reference import kalman_update

LOGISTIC = {"kind": "logistic", "half": 6.0, "width": 2.0}
FIXED = "node,x,y\n0,0,0\n1,3,4\n2,0,5\n3,10,0\n"
MOVING = """t,node,x,y
0,0,0,0
0,1,3,4
0,2,0,5
0,3,10,0
10,3,1,1
20,1,30,40
20,1,30,40
900,1,0,0
"""
SAMPLED = {"nodes": [0, 3], "H": [[1.0]], "R": [[0.5]]}
PERIODIC = {"sampling": {"kind": "periodic", "period": 0.5}}
FLOW = {"kind": "diffusion", "A": [[-0.1]], "B": [[1.0]], "cov": [[1.0]]}
SLOTS = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]}
CLOCKS = {
    "links": {"kind": "poisson", "rate": 2.0},
    "directions": {"kind": "poisson", "rate": 2.0, "at": "directions"},
    "nodes": {"kind": "renewal", "distribution": "constant", "mean": 0.3, "at": "nodes"},
    "readings": {"kind": "readings"},
    "broadcast": {"kind": "broadcast"},
    "matching": {"kind": "matching", "protocol": "uniform-maximal"},
}
FILTERS = {"broadcast": {"kind": "intermittent"}, "matching": {"kind": "gossip"}}
SLOTTED = ("broadcast", "matching")
SYMMETRIC = ("links", "matching", "broadcast")
"""Those whose two directions share one draw in a symmetric channel."""


def scenario(folder, clock="links", loss=None, graph=None, positions=None, horizon=30.0, **more):
    """Four nodes, of which 0 and 3 have a sensor."""
    slotted = clock in SLOTTED
    table = {
        "format": 1, "name": "places", "horizon": horizon, "probe": 1.0, "seed": 5,
        "sensors": [SAMPLED if slotted else SAMPLED | PERIODIC],
        "network": {
            "graph": graph or {"kind": "complete", "nodes": 4},
            "activation": CLOCKS[clock],
            "channel": {"loss": loss or {"kind": "distance", "delivery": LOGISTIC}},
        },
        "filter": FILTERS.get(clock, {"kind": "hybrid", "epsilon": 0.3}),
    } | more  # fmt: skip
    if not {"plant", "plants"} & set(more):
        table["plant"] = SLOTS if slotted else FLOW
    if positions is not None:
        (folder / "places.csv").write_text(positions)
        table["network"]["positions"] = "places.csv"
    return from_table(table, folder)


def robots(clock, nodes=(0, 1, 2, 3), spread=4.0, **more):
    """The plants of nodes whose state is where they are, and the sensors that read it."""
    eye, slotted = [[1.0, 0.0], [0.0, 1.0]], clock in SLOTTED
    dynamics = {"F": [[0.9, 0.1], [-0.1, 0.9]], "Q": eye, "period": 1.0}
    if not slotted:
        dynamics = {"A": [[-0.1, 0.2], [-0.2, -0.1]], "B": eye}
    plant = {"name": "pose", "nodes": list(nodes), **dynamics, "position": [0, 1], **more}
    plant["cov"] = [[spread, 0.0], [0.0, spread]]
    sensor = {"nodes": [0, 3], "of": "pose", "H": [[1.0, 0.0]], "R": [[0.5]]}
    return {"plants": [plant], "sensors": [sensor if slotted else sensor | PERIODIC]}


def rows(run, kind):
    return run.log[run.log["kind"] == CODES[kind]]


def logistic(distance):
    return 1.0 / (1.0 + math.exp((distance - 6.0) / 2.0))


def place_of(points):
    """A function of node and time that reads the rows of MOVING plainly."""

    def place(node, time):
        listed = [(t, x, y) for t, k, x, y in points if k == node and t <= time]
        return max(listed)[1:]

    return place


MOVED = place_of([tuple(map(float, line.split(","))) for line in MOVING.split()[1:]])


def from_states(moving, at, owners=(0, 1, 2, 3)):
    """The same of a scenario of robots: its states at ``at`` (K,), asked for as probe times."""
    asked = moving.replace({"probe": np.unique([0.0, *at]).tolist()})
    run = netkf.simulate(asked, engine="simpy")
    states = dict(zip(run.times.tolist(), run.x, strict=True))
    first = {node: 2 * k for k, node in enumerate(owners)}
    return lambda node, time: states[time][first[node] : first[node] + 2]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("clock", CLOCKS)
def test_equal_distances_lose_what_bernoulli_loses(tmp_path, clock):
    """At one distance of all nodes the events are those of Bernoulli losses, to the bit, in both
    engines for places that are fixed, and for those of a table and of the state in SimPy.
    """
    p, path = logistic(5.0), {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 3]]}
    table = "node,x,y\n0,0,0\n1,3,4\n2,0,0\n3,5,0\n"
    timed = "t," + table.replace("\n", "\n0,").removesuffix("0,")
    bernoulli = scenario(tmp_path, clock, {"kind": "bernoulli", "delivery": p}, path)
    wanted = netkf.simulate(bernoulli, engine="simpy")
    assert len(rows(wanted, "lost")) > 20
    fixed = scenario(tmp_path, clock, None, path, table)
    assert netkf.simulate(fixed, engine="simpy").fingerprint == wanted.fingerprint
    assert netkf.simulate(fixed, engine="compiled").fingerprint == wanted.fingerprint
    still = scenario(tmp_path, clock, None, path, timed)
    assert netkf.simulate(still).fingerprint == wanted.fingerprint
    assert_agree(fixed)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("source", ["table", "state"])
def test_each_message_meets_the_distance_at_its_sending(tmp_path, clock, source):
    """Each message is lost where its draw is not below the delivery at the distance of its ends
    then; the draws are replayed from their streams, the places computed plainly.
    """
    if source == "table":
        moving, place = scenario(tmp_path, clock, positions=MOVING), MOVED
    else:
        moving = scenario(tmp_path, clock, **robots(clock, spread=9.0))
    run = assert_agree(moving)
    sent, lost = rows(run, "send"), rows(run, "lost")
    if source == "state":
        # In slots everything of a slot happens at its state.
        times = np.floor(sent["t"]) if clock in SLOTTED else sent["t"]
        place = from_states(moving, times)
    gone, wrong, streams = {tuple(row) for row in lost[["node", "peer", "message"]].tolist()}, 0, {}
    for t, i, j, k in sent[["t", "node", "peer", "message"]].tolist():
        ends = (min(i, j), max(i, j)) if clock in SYMMETRIC else (i, j)
        draws = streams.setdefault(ends, Streams(5, 0).generator("loss", *ends).random(4000))
        now = math.floor(t) if source == "state" and clock in SLOTTED else t
        p = logistic(math.dist(place(i, now), place(j, now)))
        wrong += ((i, j, k) in gone) != (draws[k] >= p)
    assert wrong == 0
    assert 20 < len(lost) < len(sent) - 20


def test_delivered_shares_are_the_logistic_curve(tmp_path):
    """The delivered share of each direction lies in its exact binomial interval."""
    fixed = scenario(tmp_path, "directions", positions=FIXED, horizon=300.0)
    run = netkf.simulate(fixed)
    points = {0: (0, 0), 1: (3, 4), 2: (0, 5), 3: (10, 0)}
    assert fixed.topology.positions == points
    sent = rows(run, "send")
    lost = rows(run, "lost")
    for i, j in fixed.topology.directions:
        n = int(((sent["node"] == i) & (sent["peer"] == j)).sum())
        k = n - int(((lost["node"] == i) & (lost["peer"] == j)).sum())
        p = logistic(math.dist(points[i], points[j]))
        assert scipy.stats.binomtest(k, n, p).pvalue > 1e-4
        assert fixed.mean_delivery((i, j)) == pytest.approx(p, abs=1e-15)


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("clock", ["links", "broadcast"])
def test_nodes_of_a_table_hear_robots(tmp_path, clock, timed):
    """Nodes 1 and 2 stand where a table says, 0 and 3 are where their state says."""
    graph = {"kind": "range", "nodes": 4, "radius": 3.0}
    rows_ = "t,node,x,y\n0,1,1,0\n0,2,0,-1\n" if timed else "node,x,y\n1,1,0\n2,0,-1\n"
    mixed = scenario(tmp_path, clock, None, graph, rows_, **robots(clock, nodes=(0, 3)))
    run = netkf.simulate(mixed)
    sent = rows(run, "send")
    times = np.floor(sent["t"]) if clock in SLOTTED else sent["t"]
    moved = from_states(mixed, times, (0, 3))
    still = {1: (1.0, 0.0), 2: (0.0, -1.0)}
    for t, (i, j) in zip(times.tolist(), sent[["node", "peer"]].tolist(), strict=True):
        ends = (still[k] if k in still else moved(k, t) for k in (i, j))
        assert math.dist(*ends) <= 3.0
    met = {(i, j) for i, j in sent[["node", "peer"]].tolist()}
    assert {(0, 1), (3, 2)} <= met


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("clock", "filtering"),
    [
        ("links", {"kind": "hybrid", "epsilon": 0.3}),
        ("directions", {"kind": "kcf", "epsilon": 0.1}),
        ("nodes", {"kind": "track-fusion", "rule": "ci"}),
        ("readings", {"kind": "intermittent"}),
        ("matching", {"kind": "gossip"}),
        ("broadcast", {"kind": "push-sum", "gamma": 2, "delta": 4.5}),
        ("broadcast", {"kind": "icf", "steps": 1}),
    ],
)
def test_filters_know_what_they_hear(tmp_path, clock, filtering):
    """P of filters whose links come and go is what their equations give for the events."""
    graph = {"kind": "range", "nodes": 4, "radius": 5.5}
    moving = scenario(tmp_path, clock, None, graph, MOVING, filter=filtering)
    run = assert_agree(moving)
    law = error_law(moving, run)
    np.testing.assert_allclose(run.P, law.P, rtol=1e-10)


def test_table_of_delivery_is_linear_and_ends_are_constant():
    loss = DistanceLoss(delivery=[[1.0, 0.9], [3.0, 0.5], [4.0, 0.1]])
    at = [Transmission((0, 1), distance=d) for d in (0.0, 1.0, 2.0, 3.5, 4.0, 50.0, 1e9)]
    found = [loss.delivery_probability(one) for one in at[:-1]]
    assert found == pytest.approx([0.9, 0.9, 0.7, 0.3, 0.1, 0.1], abs=1e-15)
    assert DistanceLoss(delivery=LOGISTIC).delivery_probability(at[-1]) < 1e-300


@pytest.mark.parametrize("clock", ["nodes", "readings", "broadcast"])
def test_recorded_places_replay_to_the_bit(tmp_path, clock):
    graph, lossy = {"kind": "range", "nodes": 4, "radius": 3.0}, {"kind": "bernoulli"}
    moving = scenario(tmp_path, clock, lossy | {"delivery": 0.8}, graph, **robots(clock))
    run = netkf.simulate(moving, seed=3)
    twin = netkf.load(netkf.export_recorded(run, tmp_path / "twin")[-1])
    assert not twin.links_follow_state
    replay = netkf.simulate(twin)
    assert replay.fingerprint == run.fingerprint
    np.testing.assert_array_equal(replay.xhat, run.xhat)


@pytest.mark.one_in(12)
@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("source", ["table", "state"])
def test_nothing_is_sent_out_of_range(tmp_path, clock, source):
    """A link of a range graph carries messages just while its ends are in range, whatever ticks;
    `link` events are the changes, as they are seen.
    """
    graph = {"kind": "range", "nodes": 4, "radius": 5.5 if source == "table" else 3.0}
    more = {"positions": MOVING} if source == "table" else robots(clock)
    moving = scenario(tmp_path, clock, {"kind": "bernoulli", "delivery": 0.8}, graph, **more)
    run = assert_agree(moving)
    log = run.log
    slotted = clock in SLOTTED and source == "state"
    times = np.floor(log["t"]) if slotted else log["t"]
    place = MOVED if source == "table" else from_states(moving, times[times < 30.0])

    def in_range(i, j, t):
        return math.dist(place(i, t), place(j, t)) <= graph["radius"]

    up, changes = set(), 0
    events = log[["kind", "node", "peer", "message"]].tolist()
    for t, (kind, i, j, flag) in zip(times.tolist(), events, strict=True):
        if kind == CODES["send"]:
            assert in_range(i, j, t)
            assert (min(i, j), max(i, j)) in up
        if kind == CODES["link"]:
            assert i < j
            assert flag == in_range(i, j, t) == ((i, j) not in up)
            up ^= {(i, j)}
            changes += 1
    assert changes > 6
    if clock != "links":
        return
    ticks, sent = rows(run, "tick"), rows(run, "send")
    heard = [in_range(i, j, t) for t, i, j in ticks[["t", "node", "peer"]].tolist()]
    assert len(sent) == 2 * sum(heard)
    assert 0 < sum(heard) < len(ticks)


@pytest.mark.parametrize("clock", ["links", "broadcast"])
def test_truth_and_clocks_do_not_depend_on_who_hears_whom(tmp_path, clock):
    graph = {"kind": "range", "nodes": 4, "radius": 3.0}
    none = {"kind": "none"}
    moving = scenario(tmp_path, clock, none, graph, **robots(clock))
    static = moving.replace({"network.graph": {"kind": "complete", "nodes": 4}})
    one, other = (netkf.simulate(s, engine="simpy") for s in (moving, static))
    np.testing.assert_array_equal(one.x, other.x)
    for kind in ("tick", "sense"):
        assert rows(one, kind).tobytes() == rows(other, kind).tobytes()
    assert len(rows(one, "send")) < len(rows(other, "send"))


@pytest.mark.one_in(6)
@pytest.mark.parametrize("clock", ["links", "directions", "nodes"])
def test_unicycles_that_send_late(tmp_path, clock):
    """Predictions are cut where nodes send to somebody, or broadcast to nobody."""
    graph = {"kind": "range", "nodes": 4, "radius": 2.0}
    driven = {"kind": "constant", "value": [0.5, 0.4]}
    plant = {
        "kind": "nonlinear", "name": "pose", "nodes": [0, 1, 2, 3], "f": "unicycle", "step": 0.2,
        "B": (0.1 * np.eye(3)).tolist(), "cov": np.eye(3).tolist(), "input": driven,
        "position": [0, 1],
    }  # fmt: skip
    sensor = {"kind": "range", "of": "pose", "nodes": [0, 3], "positions": [[5, 0], [0, 5]]}
    moving = scenario(
        tmp_path, clock, {"kind": "none"}, graph, plants=[plant],
        sensors=[sensor | {"R": [[0.1]]} | PERIODIC],
    ).replace({"network.channel.delay": {"kind": "exponential", "mean": 0.2}})  # fmt: skip
    run = assert_agree(moving)
    assert 4 < len(rows(run, "send")) < 700
    assert len(rows(run, "link")) > 6


@pytest.mark.parametrize("source", ["table", "state"])
@pytest.mark.parametrize("clock", ["links", "broadcast"])
def test_summary_counts_components(tmp_path, source, clock):
    """Shares of time in summary.json against union-find over the states of the run."""
    graph = {"kind": "range", "nodes": 4, "radius": 5.5 if source == "table" else 3.0}
    more = {"positions": MOVING} if source == "table" else robots(clock)
    moving = scenario(tmp_path, clock, {"kind": "none"}, graph, **more)
    run = netkf.simulate(moving)
    netkf.save(run, moving, tmp_path / "out")
    entry = json.loads((tmp_path / "out" / "summary.json").read_text())["connectivity"]
    counts, ups = [], dict.fromkeys(moving.topology.links, 0)
    for t, x in zip(run.times.tolist(), run.x, strict=True):
        parts = {k: k for k in range(4)}
        for i, j in ups:
            a, b = (MOVED(k, t) if source == "table" else x[2 * k : 2 * k + 2] for k in (i, j))
            if math.dist(a, b) <= graph["radius"]:
                ups[i, j] += 1
                parts = {k: parts[i] if v == parts[j] else v for k, v in parts.items()}
        counts.append(len(set(parts.values())))
    assert entry["samples"] == len(counts) == 31
    assert entry["components"] == pytest.approx(np.mean(counts), abs=1e-12)
    assert entry["connected"] == pytest.approx(np.mean([c == 1 for c in counts]), abs=1e-12)
    found = {(row["node"], row["peer"]): row["up"] for row in entry["links"]}
    assert found == pytest.approx({link: k / 31 for link, k in ups.items()}, abs=1e-12)


@pytest.mark.parametrize("clock", CLOCKS)
def test_messages_in_range_are_no_fault_of_the_record(tmp_path, clock):
    positions = MOVING.replace("10,3,1,1", "10,3,20,20")
    graph = RANGE | {"radius": 5.5}
    moving = scenario(tmp_path, clock, graph=graph, positions=positions)
    run = netkf.simulate(moving)
    assert len(rows(run, "send")) > 0
    assert event_fault(moving, run) == ""


def test_bits_that_nobody_in_range_hears_are_no_fault_of_the_filter(tmp_path):
    """Their sender uses them, and the log has no messages of it."""
    moving = scenario(
        tmp_path, "broadcast", {"kind": "none"}, RANGE, MOVING, filter={"kind": "one-bit"}
    )
    assert netkf.check(moving, runs=10, workers=1)


@pytest.mark.parametrize("clock", ["nodes", "broadcast", "matching"])
@pytest.mark.parametrize("kind", ["drawn", "recorded", "unknown"])
def test_a_target_beside_robots_that_links_follow(tmp_path, clock, kind):
    """Nodes estimate the target, and summaries and promises know that the robots matter."""
    given = robots(clock)
    plant, dynamics = dict(given["plants"][0]), SLOTS if clock in SLOTTED else FLOW
    if kind == "recorded":
        lines = [f"{t},{i},{i},{t}" for t in range(32) for i in range(4)]
        (tmp_path / "poses.csv").write_text("t,node,x0,x1\n" + "\n".join(lines))
        plant |= {"kind": kind, "path": "poses.csv"} | (
            {} if clock in SLOTTED else {"interpolate": "linear"}
        )
    if kind == "unknown":
        del plant["position"]
        plant["kind"] = kind
    target = {k: v for k, v in dynamics.items() if k != "kind"} | {"name": "target"}
    sensors = [{**given["sensors"][0], "of": "target", "H": [[1.0]]}]
    graph = {"kind": "path", "nodes": 4} if kind == "unknown" else RANGE
    more = {"plants": [plant, target], "sensors": sensors}
    filtering = {**FILTERS.get(clock, {"kind": "hybrid", "epsilon": 0.3}), "estimates": "shared"}
    one = scenario(tmp_path, clock, {"kind": "none"}, graph, **more, filter=filtering)
    netkf.save(run := netkf.simulate(one), one, tmp_path / "run")
    assert run.xhat.shape[-1] == 1
    assert "central filter of all blocks" in promises_text(one, compute_promises(one))
    with pytest.raises(TheoryError, match="not drawn or that links follow"):
        netkf.theory.covariance_bound(one, run.times)
    if kind == "drawn":
        assert netkf.check(one, runs=10, workers=1)


def test_intermittent_filter_by_hand(tmp_path):
    """P and estimates of an intermittent filter whose links move, from the messages of the log."""
    graph = {"kind": "range", "nodes": 4, "radius": 5.5}
    moving = scenario(tmp_path, "broadcast", None, graph, MOVING)
    run = netkf.simulate(moving)
    arrived = {tuple(row) for row in rows(run, "deliver")[["t", "node", "peer"]].tolist()}
    P = {node: np.eye(1) for node in range(4)}
    for slot, (t, found) in enumerate(zip(run.times.tolist(), run.P, strict=True)):
        for node in range(4):
            np.testing.assert_allclose(found[node], P[node], rtol=1e-12)
            heard = sum((float(t), node, peer) in arrived for peer in (0, 3))
            for _ in range(heard + (node in (0, 3))):
                _, P[node] = kalman_update(np.zeros(1), P[node], np.zeros(1), np.eye(1), [[0.5]])
            P[node] = 0.81 * P[node] + np.eye(1)
        assert slot < 31
    assert 20 < len(arrived) < 120


def test_names_units_and_origin(tmp_path):
    """Nodes by name, stamps in milliseconds from an origin; the row before 0 holds at 0."""
    rows_ = "t;node;x;y\n999000;a;9;9\n999500;a;0;0\n1000000;b;3;4\n1010000;b;0;1\n"
    graph = {"kind": "range", "nodes": ["b", "a"], "radius": 2.0}
    clock = {"kind": "periodic", "period": 0.5}
    network = {"graph": graph, "activation": clock, "positions": "places.csv"}
    sensor = SAMPLED | {"nodes": ["a"]} | PERIODIC
    more = {"time": {"unit": "ms", "origin": 1000}, "network": network, "sensors": [sensor]}
    (tmp_path / "places.csv").write_text(rows_)
    named = scenario(tmp_path, **more)
    run = netkf.simulate(named)
    sent = rows(run, "send")["t"]
    assert sent.min() == 10.0
    assert [str(node) for node in named.nodes] == ["b", "a"]
    use = record_usage(named, None)["network.positions"]
    assert use == {"path": "places.csv", "rows": 4, "used": 3, "merged": 0, "unused": 1}
    again = from_table(parse_toml(to_toml(as_table(named))), tmp_path)
    assert netkf.simulate(again).fingerprint == run.fingerprint


def test_nodes_of_a_range_graph_are_those_that_are_placed(tmp_path):
    """Of a table, with names too, of plants, and of both."""
    graph = {"kind": "range", "radius": 5.5}
    given = scenario(tmp_path, graph=graph | {"nodes": 4}, positions=MOVING)
    placed = scenario(tmp_path, graph=graph, positions=MOVING)
    assert netkf.simulate(placed).fingerprint == netkf.simulate(given).fingerprint
    text = MOVING.replace(",3,1,1", ",x,1,1").replace("0,3,", "0,x,").replace("0,0,0", "0,base,0")
    sensors = [SAMPLED | PERIODIC | {"nodes": ["x", "base"]}]
    by_name = scenario(tmp_path, graph=graph, positions=text, sensors=sensors)
    assert sorted(map(str, by_name.nodes)) == ["1", "2", "base", "x"]
    again = by_name.replace({"seed": 6})
    assert dict(again.topology.names) == dict(by_name.topology.names)
    mixed = scenario(
        tmp_path, graph=graph, positions="node,x,y\n7,1,0\n", **robots("links", (0, 3))
    )
    assert mixed.nodes == (0, 3, 7)
    with pytest.raises(NetkfError, match=r"network.graph.nodes: is missing"):
        scenario(tmp_path, graph=graph)


def test_rows_are_counted(tmp_path):
    moving = scenario(tmp_path, positions=MOVING)
    use = record_usage(moving, None)["network.positions"]
    assert use == {"path": "places.csv", "rows": 8, "used": 6, "merged": 1, "unused": 1}
    fixed = scenario(tmp_path, positions=FIXED + "1,3,4\n")
    use = record_usage(fixed, None)["network.positions"]
    assert use == {"path": "places.csv", "rows": 5, "used": 4, "merged": 1, "unused": 0}


@pytest.mark.parametrize("clock", ["links", "broadcast"])
def test_round_trip(tmp_path, clock):
    graph = {"kind": "range", "nodes": 4, "radius": 3.0}
    for more in ({"positions": MOVING}, robots(clock)):
        moving = scenario(tmp_path, clock, None, graph, **more)
        run = netkf.simulate(moving)
        for table in (as_table(moving), resolve_defaults(moving)):
            again = from_table(parse_toml(to_toml(table)), tmp_path)
            assert netkf.simulate(again).fingerprint == run.fingerprint


def test_theory_promises_nothing_of_links_that_move(tmp_path):
    moving = scenario(tmp_path, positions=MOVING)
    assert math.isnan(moving.mean_delivery((0, 1)))
    assert not moving.delivers_all
    assert moving.links_move
    assert not moving.links_follow_state
    lossless = scenario(
        tmp_path, loss={"kind": "none"}, graph={"kind": "range", "nodes": 4, "radius": 9.0},
        positions=FIXED,
    )  # fmt: skip
    assert not lossless.delivers_all
    # Given their events errors are Gaussian, unless these tell of the state.
    assert error_covariance(moving, netkf.simulate(moving)).shape[1] == 4
    coupled = scenario(tmp_path, **robots("links"))
    assert coupled.links_follow_state
    with pytest.raises(TheoryError, match="events tell of it"):
        error_covariance(coupled, netkf.simulate(coupled))
    # No number of runs decides such rows. A filter that does not talk has the law of its samples.
    table = netkf.check(coupled, runs=10, workers=1).table.set_index("promise")
    rows = table[table.index.str.contains("errors have|P is at least|P follows")]
    assert set(rows["verdict"]) == {"not promised"}
    alone = coupled.replace({"filter": {"kind": "local"}})
    run = netkf.simulate(alone)
    np.testing.assert_allclose(error_covariance(alone, run), run.P, rtol=1e-9, atol=1e-12)


def place(rows_, **more):
    return lambda folder: scenario(folder, positions=rows_, **more)


def plants(**more):
    return lambda folder: scenario(folder, **robots("links", **more))


RANGE = {"kind": "range", "nodes": 4, "radius": 1.0}
REFUSED = {
    "places.csv line 3 names a node that the graph does not have": place("node,x,y\n0,0,0\n9,1,1"),
    "places.csv must place every node; got [3]": place(FIXED.replace("3,10,0\n", "")),
    "places.csv lines 2 and 6: a node must have one position": place(FIXED + "0,1,1\n"),
    "the first place of node 3 must be at t <= 0": place(MOVING.replace("0,3,10,0", "5,3,10,0")),
    "network.graph.radius: must be": place(FIXED, graph={"kind": "range", "nodes": 4, "radius": 0}),
    "network.graph: needs the distances": lambda folder: scenario(
        folder, loss={"kind": "none"}, graph=RANGE
    ),
    "network.channel.loss: needs the distances": scenario,
    "network.channel.loss.delivery.half: is missing": lambda folder: scenario(
        folder, loss={"kind": "distance", "delivery": {"kind": "logistic", "width": 1.0}}
    ),
    "network.channel.loss.delivery: must have increasing": lambda folder: scenario(
        folder, loss={"kind": "distance", "delivery": [[1.0, 0.5], [0.5, 1.0]]}
    ),
    "network.channel.loss.delivery: must have probabilities": lambda folder: scenario(
        folder, loss={"kind": "distance", "delivery": [[1.0, 1.5]]}
    ),
    "plants[0].position: must be different entries of the 2 states": plants(position=[0, 2]),
    "plants[0].position: must be as many coordinates": lambda folder: scenario(
        folder, positions="node,x,y\n3,0,0\n",
        **(robots("links", (0, 1, 2), position=[0]) | {"sensors": []}),
    ),
    "must leave out nodes whose place is part of the state": lambda folder: scenario(
        folder, positions="node,x,y\n3,0,0\n", **robots("links")
    ),
    "plants[0].position: cannot say who hears whom": lambda folder: scenario(
        folder, plants=robots("links")["plants"],
        sensors=[{"nodes": [0], "of": "pose", "H": [[1.0, 0.0]], "R": [[0.5]]}],
    ),
    "plants[0].position: cannot be that of a block that all nodes share": lambda folder: scenario(
        folder, sensors=[],
        plants=[{"name": "team", "A": [[0.0]], "B": [[1.0]], "position": [0]}],
    ),
    "plant.position: is not a key here": lambda folder: scenario(
        folder, plant=FLOW | {"position": [0]}
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_refusals_are_one_line(tmp_path, message):
    with pytest.raises(NetkfError) as caught:
        REFUSED[message](tmp_path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
