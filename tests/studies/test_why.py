"""``netkf.why`` against searches and replays that are made in another way."""

import itertools
import json
import math
from dataclasses import replace

import networkx as nx
import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.network.deliveries import Deliveries, MessageKey
from netkf.network.losses import Transmission
from netkf.scenario.reading import from_table
from netkf.studies.explanation import InformationSource, Missing, WhatIf, Why
from netkf.studies.information import (
    OUTCOMES,
    KeptReadings,
    find_flow,
    match_messages,
    newest_information,
    rows_until,
    search_back,
)
from netkf.studies.message_sets import Candidate, Replayer, delivering, find_smallest_set
from netkf.studies.why import why
from tests.conftest import SCENARIOS

FLOW = {"kind": "diffusion", "A": [[-0.3]], "B": [[1.0]], "cov": [[1.0]]}
SLOTS = {"kind": "linear", "F": [[0.95]], "Q": [[0.3]], "period": 0.5, "cov": [[1.0]]}
EDGES = {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 3], [3, 4], [1, 3]]}
SENSORS = [{"nodes": [0, 4], "H": [[1.0]], "R": [[0.2]]}]
SAMPLED = [{**SENSORS[0], "sampling": {"kind": "poisson", "rate": 2.0}}]
HALF = {"kind": "bernoulli", "delivery": 0.5}


def tables(plant, activation, kind, sensors=SENSORS, delay=None):
    channel = {"loss": HALF, "symmetric": False, **({"delay": delay} if delay else {})}
    return {
        "plant": plant,
        "sensors": sensors,
        "network": {"graph": EDGES, "activation": activation, "channel": channel},
        "filter": kind,
    }


LATE = {"kind": "uniform", "low": 0.0, "high": 0.5}
CASES = {
    "hybrid": tables(FLOW, {"kind": "poisson", "rate": 2.0}, {"kind": "hybrid", "epsilon": 0.3}),
    "intersection": tables(
        FLOW,
        {"kind": "poisson", "at": "nodes", "rate": 2.0},
        {"kind": "covariance-intersection", "epsilon": 0.3},
        SAMPLED,
        {"kind": "exponential", "mean": 0.3},
    ),
    "refused": tables(
        FLOW, {"kind": "readings"}, {"kind": "intermittent", "window": 0.2}, SAMPLED, LATE
    ),
    "swaps": tables(
        FLOW,
        {"kind": "poisson", "rate": 2.0},
        {"kind": "gossip"},
        SAMPLED,
        {"kind": "exponential", "mean": 0.1},
    ),
    "gossip": tables(SLOTS, {"kind": "matching", "protocol": "maximal"}, {"kind": "gossip"}),
    "late": tables(SLOTS, {"kind": "broadcast"}, {"kind": "intermittent"}, delay=LATE),
    "diffusion": tables(SLOTS, {"kind": "broadcast"}, {"kind": "diffusion"}),
    "readings": tables(
        SLOTS,
        {"kind": "broadcast"},
        {"kind": "diffusion-kalman"},
        [{"nodes": [0, 1, 2, 3, 4], "H": [[1.0]], "R": [[0.2]]}],
    ),
    "push-sum": tables(
        SLOTS, {"kind": "broadcast"}, {"kind": "push-sum", "gamma": 2, "delta": 4.0}
    ),
}


def make(name, folder, horizon=12.0):
    head = {"format": 1, "name": name, "horizon": horizon, "probe": 0.5, "seed": 3}
    return from_table({**head, **CASES[name]}, folder)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The scenario and the run of each case."""
    folder = tmp_path_factory.mktemp("why")
    found = {name: make(name, folder) for name in CASES}
    return {name: (scenario, netkf.simulate(scenario)) for name, scenario in found.items()}


class EventGraph:
    """The events of a run as a graph: an edge for each step along which information can pass.

    Vertices are (node, row). A message that was not used in the run weighs 1, everything else 0.
    """

    def __init__(self, scenario, events, used):
        self.graph = nx.DiGraph()
        self.scenario, self.analysis = scenario, scenario.node_filter.analysis
        self.now = {node: (node, -1) for node in scenario.nodes}
        self.graph.add_nodes_from(self.now.values())
        self.cargo, self.waiting, self.reading = {}, {node: [] for node in scenario.nodes}, {}
        self.time, self.sensed, self.last = {}, {}, []
        for row in events.itertuples():
            self.add(row, used)
            self.last.append(dict(self.now))

    def add(self, row, used):
        here = (row.node, row.Index)
        if row.kind in ("sense", "send", "absorb", "swap"):
            self.time[here] = row.t
        if row.kind == "sense":
            self.reading[row.node] = (*here, "reading")
            self.sensed[self.reading[row.node]] = row.t
            self.step(here)
            self.graph.add_edge(self.reading[row.node], here, weight=0)
        elif row.kind == "send":
            key = (row.node, row.peer, row.message)
            if not self.analysis.tells_estimates(row.phase):
                self.cargo[key] = self.reading[row.node]  # the one just taken, and no more
            else:
                self.step(here)
                self.cargo[key] = here
        elif row.kind == "deliver":
            self.waiting[row.node].append((row.peer, row.node, row.message))
        elif row.kind in ("absorb", "swap"):
            came, self.waiting[row.node] = self.waiting[row.node], []
            if self.analysis.swaps:
                replaced = [key for key in came if key in used]
                sender = max((key[0] for key in replaced), default=None)
                newest = max((key for key in replaced if key[0] == sender), default=None)
                came = [key for key in came if key == newest or key not in used]
            self.step(here, keep=not (self.analysis.swaps and any(key in used for key in came)))
            for key in came:
                self.graph.add_edge(self.cargo[key], here, weight=int(key not in used))

    def step(self, here, keep=True):
        self.graph.add_node(here)
        if keep:
            self.graph.add_edge(self.now[here[0]], here, weight=0)
        self.now[here[0]] = here

    def newest(self, node, row, most=0):
        """The newest reading of each node that reached one after a row, by messages that came and
        at most so many others.
        """
        target = self.last[row][node] if row >= 0 else (node, -1)
        backwards = self.graph.reverse(copy=False)
        sources = set(nx.single_source_dijkstra_path_length(backwards, target, cutoff=most))
        found = {}
        for vertex in sources:
            if vertex in self.sensed:
                when = self.taken(self.sensed[vertex])
                found[vertex[0]] = max(found.get(vertex[0], -math.inf), when)
        return found, sources

    def taken(self, t):
        if not self.scenario.slotted:
            return t
        return math.floor(t / 0.5 + 1e-9) * 0.5


def used_messages(scenario, events):
    """The messages that a receiver used, told from the events alone."""
    used, waiting = set(), {node: [] for node in scenario.nodes}
    for row in events.itertuples():
        if row.kind == "deliver":
            waiting[row.node].append((row.peer, row.node, row.message))
        elif row.kind in ("absorb", "swap"):
            came, waiting[row.node] = waiting[row.node], []
            used |= {max(came)} if scenario.node_filter.analysis.swaps else set(came)
    return used


def rows_before(scenario, events, at):
    """The number of rows that a state shown at a time contains."""
    if not scenario.slotted:
        return int((events.t <= at).sum())
    return int((events.t < (at if scenario.node_filter.timing.predicts else at + 0.5) - 1e-9).sum())


@pytest.mark.parametrize("name", CASES)
def test_the_newest_readings_are_those_of_a_search_in_a_graph_of_events(runs, name):
    scenario, run = runs[name]
    graph = EventGraph(scenario, run.events, used_messages(scenario, run.events))
    random, reached = np.random.default_rng(7), 0
    for _ in range(25):  # 225 in all cases together
        node = int(random.choice(scenario.nodes))
        at = float(random.uniform(0.0, 12.0))
        at = math.floor(at / 0.5) * 0.5 if scenario.slotted else at
        count = rows_before(scenario, run.events, at)
        log = rows_until(scenario, run.log, at)
        assert len(log) == count
        messages = match_messages(log, scenario.node_filter.analysis.swaps, scenario.slotted)
        reach = search_back(find_flow(scenario, log, messages), node)
        found = newest_information(reach, log, KeptReadings(scenario, log, at), 0)
        ours = {n: f.reading for n, f in found.items() if not math.isnan(f.reading)}
        expected, sources = graph.newest(node, count - 1)
        if name == "hybrid":  # continuous readings reach up to the moment of sending
            expected = {
                n: max(graph.time.get(v, 0.0) for v in sources if v[0] == n)
                for n in (0, 4)
                if any(v[0] == n and v[1] >= 0 for v in sources)
            }
            expected |= {node: at} if node in (0, 4) else {}
        assert ours == pytest.approx(expected)
        reached += len(ours.keys() - {node})
    assert reached > 5


@pytest.mark.parametrize(("name", "at"), [("intersection", 4.0), ("late", 9.0), ("gossip", 9.0)])
def test_ages_with_more_messages_are_shortest_paths_in_the_graph_of_all_events(runs, name, at):
    scenario, run = runs[name]
    used = used_messages(scenario, run.events[: rows_before(scenario, run.events, at)])
    gained = 0
    for node in (0, 2, 3):
        found = why(run, node, at, replays=1)
        events = replayed(scenario, run, node, at)
        graph = EventGraph(scenario, events, used)
        for most in range(4):
            expected, _ = graph.newest(node, len(events) - 1, most)
            for source in found.sources:
                reading = (source.reading, *source.with_more)[most]
                assert reading == pytest.approx(expected.get(source.node, math.nan), nan_ok=True)
                gained += reading > source.reading
        for source in found.sources:
            if source.missing:
                assert source.with_more[len(source.missing) - 1] > source.reading or math.isnan(
                    source.reading
                )
    assert gained


def replayed(scenario, run, node, at):
    """The events of the run in which all messages came, up to a time."""
    import pandas as pd

    from netkf.trace.run import event_columns

    replayer = Replayer(scenario, run.seed, run.replica, node, at)
    return pd.DataFrame(event_columns(replayer.full_log, 0, 0))


def recorded(scenario, run, chosen, folder, without_delay=(), engine="auto"):
    """The run again from tables written by hand: the losses of its events but for the chosen ones,
    and where some are without_delay the delays of its events too.
    """
    events, changes = run.events, {}
    lost = [(r.node, r.peer, r.message) for r in events[events.kind == "lost"].itertuples()]
    rows = [(*key, 0) for key in lost if key not in chosen]
    write(folder / "lost.csv", "sender,receiver,message,delivered", rows)
    changes["network.channel.loss"] = {"kind": "recorded", "path": "lost.csv"}
    if without_delay:
        came = events[events.kind.isin(["deliver", "late"])]
        seconds = {(r.peer, r.node, r.message): r.age for r in came.itertuples()}
        sent = [(r.node, r.peer, r.message) for r in events[events.kind == "send"].itertuples()]
        delays = [(*key, 0.0 if key in without_delay else seconds.get(key, 1e3)) for key in sent]
        write(folder / "delays.csv", "sender,receiver,message,seconds", delays)
        changes["network.channel.delay"] = {"kind": "recorded", "path": "delays.csv"}
    object.__setattr__(scenario, "_folder", folder)
    return netkf.simulate(scenario.replace(changes), engine=engine)


def write(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows), ""]))


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("name", "node", "at"),
    [("hybrid", 2, 8.0), ("intersection", 0, 7.0), ("gossip", 1, 7.0), ("late", 3, 9.0)],
)
def test_what_ifs_are_those_of_a_run_from_recorded_losses(runs, name, node, at, tmp_path):
    scenario, run = runs[name]
    found = why(run, node, at, replays=10)
    k = run.times.tolist().index(at)
    assert found.trace == pytest.approx(np.trace(run.P[k, node]), rel=1e-9)
    assert found.error == pytest.approx(np.linalg.norm(run.error[k, node]), rel=1e-9)
    checked = 0
    for what_if in found.what_ifs[1:-1]:
        if any(found.missing[key].outcome != "lost" for key in what_if.messages):
            continue
        engine = "simpy" if scenario.slotted else "auto"  # which takes seconds under clocks
        again = recorded(scenario, run, set(what_if.messages), tmp_path, engine=engine)
        assert what_if.trace == pytest.approx(np.trace(again.P[k, node]), rel=1e-9)
        assert what_if.error == pytest.approx(np.linalg.norm(again.error[k, node]), rel=1e-7)
        checked += abs(what_if.trace - found.trace) > 1e-6
    assert checked
    none_lost = netkf.simulate(scenario.replace({"network.channel.loss": {"kind": "none"}}))
    if name in ("hybrid", "gossip"):  # elsewhere some messages are late or under way
        assert found.what_ifs[-1].trace == pytest.approx(np.trace(none_lost.P[k, node]), rel=1e-9)


CHANNELS = {
    "directions": {"loss": HALF, "symmetric": False},
    "links": {"loss": HALF, "symmetric": True},
    "bursts": {
        "loss": {
            "kind": "gilbert-elliott",
            "to_bad": 0.3,
            "to_good": 0.4,
            "deliver_good": 0.9,
            "deliver_bad": 0.2,
        }
    },
}


@pytest.mark.one_in(12)
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("name", ["gossip", "diffusion", "readings", "push-sum"])
def test_both_engines_deliver_the_chosen_messages(runs, name, channel):
    """Compiled slots draw the messages of many slots together, SimPy one at a time."""
    scenario = runs[name][0].replace({"network.channel": CHANNELS[channel]})
    events = netkf.simulate(scenario).events
    lost = [
        MessageKey(r.node, r.peer, r.message) for r in events[events.kind == "lost"].itertuples()
    ]
    assert len(lost) > 10
    deliveries = Deliveries()
    replayed = delivering(scenario, deliveries)
    for chosen in (frozenset(lost[:1]), frozenset(lost[3::4]), frozenset(lost[-2:]), None):
        deliveries.choose(chosen)
        compiled, simpy = (netkf.simulate(replayed, engine=e) for e in ("compiled", "simpy"))
        pd.testing.assert_frame_equal(compiled.events, simpy.events)
        np.testing.assert_allclose(compiled.xhat, simpy.xhat, rtol=1e-9, atol=1e-12)
        now = compiled.events[compiled.events.kind == "lost"]
        still_lost = [(r.node, r.peer, r.message) for r in now.itertuples()]
        assert still_lost == ([] if chosen is None else [key for key in lost if key not in chosen])


@pytest.mark.parametrize(("name", "outcome"), [("refused", "refused"), ("late", "late")])
def test_a_message_that_came_too_late_is_replayed_without_delay(runs, name, outcome, tmp_path):
    scenario, run = runs[name]
    node, at = 1, 9.0
    k = run.times.tolist().index(at)
    found = why(run, node, at, replays=1)
    mine = [m for m in found.missing.values() if m.outcome == outcome and m.key.receiver == node]
    key = max(mine, key=lambda m: m.sent).key
    outcome = Replayer(scenario, run.seed, 0, node, at).outcome([key])
    again = recorded(scenario, run, set(), tmp_path, without_delay={tuple(key)})
    assert outcome.trace == pytest.approx(np.trace(again.P[k, node]), rel=1e-9)
    assert abs(outcome.trace - found.trace) > 1e-9


@pytest.mark.slow
def test_the_smallest_set_is_that_of_all_sets(tmp_path):
    scenario = make("diffusion", tmp_path, horizon=2.5)
    run, node, at = netkf.simulate(scenario), 2, 2.0
    replayer = Replayer(scenario, run.seed, 0, node, at)
    lost = run.events[(run.events.kind == "lost") & (run.events.t < at)]
    keys = [MessageKey(r.node, r.peer, r.message) for r in lost.itertuples()]
    times = dict(zip(keys, lost.t, strict=True))
    assert len(keys) >= 10
    k = run.times.tolist().index(at)

    def trace(chosen):
        return np.trace(recorded(scenario, run, set(chosen), tmp_path).P[k, node])

    values = {
        chosen: replayer.outcome(chosen).trace
        for size in range(4)
        for chosen in itertools.combinations(keys, size)
    }
    some = list(values)[:: len(values) // 12]
    assert [values[c] for c in some] == pytest.approx([trace(c) for c in some], rel=1e-9)
    best = [min(v for c, v in values.items() if len(c) == size) for size in range(4)]
    assert best[0] > best[1] > best[2] > best[3]
    candidates = [Candidate(key, times[key], 1) for key in keys]
    for size, limit in [(1, best[1]), (2, 0.5 * (best[1] + best[2])), (3, best[3] + 1e-12)]:
        found = find_smallest_set(replayer, candidates, limit, 3, 10**6)
        assert len(found.messages) == size
        assert found.trace == values[tuple(sorted(found.messages, key=keys.index))] <= limit
        assert found.proven
    none = find_smallest_set(replayer, candidates, best[3] - 1e-9, 3, 10**6)
    assert none.messages is None
    assert none.proven
    few = find_smallest_set(replayer, candidates, best[3] - 1e-9, 3, 0)
    assert few.messages is None
    assert not few.proven


def test_the_answer_is_said_in_sentences_a_table_and_json(runs):
    _, run = runs["gossip"]
    found = why(run, 1, 7.0, below=100.0)
    assert found.smallest.messages == ()
    found = why(run, 1, 7.0, replays=50)
    text, document = str(found), found.to_dict()
    assert f"trace P is {found.trace:.4g}" in text
    assert "It last heard node" in text
    assert document == json.loads(json.dumps(document))
    assert document["what_ifs"][0]["trace"] == found.trace
    assert list(found.table["node"]) == [s.node for s in found.sources] == [0, 2, 3, 4]
    ages = [7.0 - s.reading for s in found.sources]
    assert list(found.table["reading_age"]) == pytest.approx(ages, nan_ok=True)
    assert "node 1 at 7 s" in repr(found)


@pytest.mark.parametrize("name", ["hybrid", "swaps", "gossip", "late"])
def test_before_the_first_event_a_node_knows_what_it_began_with(name, runs):
    scenario, run = runs[name]
    for at in (1e-13, min(run.log["t"][0], 0.4) / 2.0):
        found = why(run, 1, at, replays=1)
        # dP = (1 - 0.6 P) dt from P = 1 on; a slot is asked about at its start.
        expected = 1.0 if scenario.slotted else (1.0 - 0.4 * math.exp(-0.6 * at)) / 0.6
        assert found.trace == pytest.approx(expected, rel=1e-9)
        assert all(math.isnan(source.heard) for source in found.sources)


def test_links_that_move_are_explained_between_samples_too():
    scenario = netkf.load(SCENARIOS / "blocks" / "formation.toml", {"horizon": 9.0})
    run = netkf.simulate(scenario, engine="simpy")
    for at in (7.3459, 8.77):  # in between a link is seen to have come or gone
        assert math.isfinite(why(run, 4, at, replays=1).trace)


def test_what_cannot_be_answered_is_refused_in_one_line(runs):
    _, run = runs["gossip"]
    with pytest.raises(ScenarioError, match="node: must be a node of the scenario; got 9"):
        why(run, 9, 3.0)
    with pytest.raises(ScenarioError, match="at: must be a finite number"):
        why(run, 1, 12.5)
    with pytest.raises(ScenarioError, match="--trace full"):
        why(replace(run, log=run.log[:0]), 1, 3.0)
    with pytest.raises(ScenarioError, match="other events than its replay"):
        why(replace(run, seed=4), 1, 3.0)
    for name in ("t", "peer", "message"):  # one number of one event
        other = run.log.copy()
        other[name][0] += 1
        with pytest.raises(ScenarioError, match="other events than its replay"):
            why(replace(run, log=other), 1, 3.0)
    with pytest.raises(ScenarioError, match="scenario: is not known"):
        why(replace(run, scenario=None), 1, 3.0)
    cut = replace(run, status="interrupted", times=run.times[:3])
    with pytest.raises(ScenarioError, match="at: lies beyond what was kept"):
        why(cut, 1, 3.0)


def test_an_unstable_run_is_not_asked_about_after_it_diverged(build):
    slots = {"kind": "linear", "F": [[1e29]], "Q": [[1.0]], "period": 0.5, "cov": [[1.0]]}
    network = {"graph": {"kind": "path", "nodes": 2}}
    scenario = build(plant=slots, network=network, filter={"kind": "local"})
    run = netkf.simulate(scenario)
    assert run.status == "diverged"
    with pytest.raises(ScenarioError, match="lies after the run had diverged"):
        why(run, 1, 3.0)


def test_a_record_without_a_row_is_no_reading(build, tmp_path):
    rows = [(0.0, 0, 1.0), (0.5, 0, 0.9), (2.0, 0, 1.1)]
    write(tmp_path / "readings.csv", "t,node,y0", rows)
    model = {"kind": "unknown", "F": [[0.9]], "Q": [[0.1]], "period": 0.5, "cov": [[1.0]]}
    sensor = {"kind": "recorded", "nodes": [0], "path": "readings.csv", "H": [[1.0]], "R": [[0.1]]}
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}}
    scenario = build(
        plant=model, sensors=[sensor], network=network, filter={"kind": "diffusion"}, horizon=4.0
    )
    found = why(netkf.simulate(scenario), 1, 1.5)
    assert found.sources[0].reading == 0.5
    assert math.isnan(found.error)
    assert "error" not in str(found).replace("RMS error", "")
    assert why(netkf.simulate(scenario), 1, 3.0).sources[0].reading == 2.0


def test_messages_of_the_slot_of_a_filtered_sample_are_not_of_its_future(build):
    network = {"graph": {"kind": "path", "nodes": 3}, "activation": {"kind": "broadcast"}}
    filtered = {"kind": "hcmci", "consensus": "information", "steps": 3}
    plant = {"kind": "linear", "F": [[0.9]], "Q": [[0.1]], "period": 0.5, "cov": [[1.0]]}
    found = why(netkf.simulate(build(plant=plant, network=network, filter=filtered)), 1, 2.0)
    assert found.sources[0].heard > 2.0  # sent within the slot from 2.0 to 2.5 s
    assert "(in this slot)" in str(found)
    assert (found.table.known_age.dropna() >= 0.0).all()


@pytest.mark.parametrize(("nodes", "told"), [(6, "and 1 other before"), (7, "and 2 others before")])
def test_who_is_not_named_is_counted(build, nodes, told):
    clock = {"kind": "periodic", "at": "nodes", "period": 0.3, "phase": "random"}
    network = {"graph": {"kind": "complete", "nodes": nodes}, "activation": clock}
    sensors = [{"nodes": [0], "H": [[1.0]], "R": [[0.5]]}]
    scenario = build(network=network, sensors=sensors, filter={"kind": "diffusion"})
    assert told in str(why(netkf.simulate(scenario), 1, 2.0))


def test_many_nodes_whose_readings_one_message_brings_are_counted(build):
    """Labels of replays named all of them: lines of a thousand nodes were thousands wide."""
    clock, sampling = {"kind": "poisson", "at": "nodes", "rate": 3.0}, SAMPLED[0]["sampling"]
    graph, channel = {"kind": "star", "nodes": 12}, {"loss": HALF}
    network = {"graph": graph, "activation": clock, "channel": channel}
    sensors = [{"nodes": [*range(12)], "H": [[1.0]], "R": [[0.5]], "sampling": sampling}]
    intersection = {"kind": "covariance-intersection", "epsilon": 0.05}
    scenario = build(network=network, sensors=sensors, filter=intersection, seed=2)
    labels = [what_if.label for what_if in why(netkf.simulate(scenario), 2, 2.5).what_ifs]
    assert any(label.endswith("others") for label in labels)
    assert len(set(labels)) == len(labels)
    assert max(map(len, labels)) < 60


@pytest.mark.parametrize(("kind", "known"), [("local", {1}), ("central", {0, 1})])
def test_filters_that_do_not_talk_have_no_missing_messages(build, kind, known):
    sensors = [{"nodes": [0, 1], "H": [[1.0]], "R": [[0.5]]}]
    run = netkf.simulate(build(filter={"kind": kind}, sensors=sensors))
    found = why(run, 1, 2.0)
    assert {s.node for s in found.sources if not math.isnan(s.reading)} == known
    assert found.smallest.messages == ()
    assert "No other node sends to node 1." in str(found)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The directories of a run, of an ensemble with all traces, and of a run without one."""
    folder = tmp_path_factory.mktemp("kept")
    scenario = make("diffusion", folder, horizon=4.0)
    netkf.save(netkf.simulate(scenario), scenario, folder / "one")
    toml = str(folder / "one" / "scenario.toml")
    many = ["--runs", "3", "--trace", "full", "--workers", "1", "--no-plot"]
    assert main(["run", toml, *many, "--out", str(folder / "many")]) == 0
    assert main(["run", toml, "--trace", "none", "--no-plot", "--out", str(folder / "none")]) == 0
    return folder, scenario


def test_a_directory_is_explained_as_the_run_in_memory_is(kept, capsys, tmp_path):
    folder, scenario = kept
    asked = ["--node", "2", "--at", "3.5", "--replays", "20"]
    assert main(["why", str(folder / "one"), *asked, "--json", "--out", str(tmp_path / "a")]) == 0
    printed = json.loads(capsys.readouterr().out)
    expected = why(netkf.simulate(scenario), 2, 3.5, replays=20)
    assert printed == expected.to_dict()
    assert json.loads((tmp_path / "a" / "why.json").read_text()) == printed
    assert (tmp_path / "a" / "why.txt").read_text() == f"{expected}\n"
    assert (tmp_path / "a" / "why.csv").read_text().startswith("node,sensor,neighbour,heard")
    assert main(["why", str(folder / "many"), *asked, "--replica", "2"]) == 0
    third = why(netkf.simulate(scenario, replica=2), 2, 3.5, replays=20)
    assert capsys.readouterr().out == f"{third}\n"
    assert third.trace != expected.trace


def test_the_worst_sample_is_explained_by_default(kept, capsys):
    folder, scenario = kept
    assert main(["why", str(folder / "one"), "--replays", "5", "--json"]) == 0
    printed = capsys.readouterr()
    found, run = json.loads(printed.out), netkf.simulate(scenario)
    worst = run.nodes[int(run.sq_error[run.times > 0].mean(axis=0).argmax())]
    assert found["node"] == worst
    assert found["at"] in run.times[1:].tolist()
    assert printed.err.startswith(f"note: node {worst} at {found['at']:.10g} s: the largest error")
    assert main(["why", str(folder / "none")]) == 2
    assert "has no samples of a run" in capsys.readouterr().err


def test_a_directory_that_cannot_be_explained_is_refused_in_one_line(kept, capsys):
    folder, _ = kept
    refused = {
        ("none",): "has no events, and they tell which messages came; run it again with --trace",
        ("many", "--replica", "7"): "has not kept the trace of replica; got 7",
        ("one", "--replica", "7"): "replica: is another one than that of the run, 0; got 7",
        ("one", "--below", "-1"): "below: must be a finite number above 0; got -1",
        ("absent",): "it does not exist",
    }
    for (name, *more), words in refused.items():
        assert main(["why", str(folder / name), "--node", "1", "--at", "2", *more]) == 2
        printed = capsys.readouterr()
        assert words in printed.err
        assert printed.err.count("\n") == 1
        assert not printed.out


def test_a_message_that_is_sent_at_another_time_meets_another_law():
    """In a replay a node that decides may have been silent before: numbers then move in time."""

    class Later(netkf.parts.Loss):
        vectorised = True

        def delivery_probability(self, sent):
            return 0.1 * sent.time

    loss, deliveries = Later(), Deliveries()
    for time in (1.0, 2.0, 1.0):
        sent = Transmission((0, 1), number=np.array([3]), time=np.array([time]))
        assert deliveries.given(loss, sent) == 0.1 * time


HOPS = """
format = 1
name = "hops"
horizon = 8.0
probe = 1.0
[plant]
kind = "linear"
period = 1.0
F = [[0.95]]
Q = [[0.3]]
cov = [[1.0]]
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[0.1]]
[network]
graph = { kind = "path", nodes = 2 }
activation = { kind = "broadcast" }
[network.channel]
loss = { kind = "gilbert-elliott", mean_loss = 0.3, mean_burst = 2.0 }
channels = { hopping = [11, 26], path = "channels.csv" }
[filter]
kind = "intermittent"
"""


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_replays_hop_over_the_channels_of_the_run(tmp_path, engine):
    (tmp_path / "channels.csv").write_text("channel,delivery\n11,0.9\n26,0.2\n")
    (tmp_path / "hops.toml").write_text(HOPS)
    scenario = netkf.load(tmp_path / "hops.toml")
    run = netkf.simulate(scenario, seed=2, engine=engine)
    lost = run.events[run.events.kind == "lost"]
    assert (lost.message % 2 == 1).any()
    found = netkf.why(run, 1, 6.0)
    sure = scenario.replace({"network.channel": {}})
    at = run.times.tolist().index(6.0)
    assert found.trace == pytest.approx(run.P[at, 1, 0, 0], rel=1e-12)
    whole = netkf.simulate(sure, seed=2, engine=engine).P[at, 1, 0, 0]
    assert found.what_ifs[-1].trace == pytest.approx(whole, rel=1e-12)


def test_what_a_node_heard_before_it_went_down_is_not_used_after(build, tmp_path):
    (tmp_path / "lives.csv").write_text("t,node,what\n1.1,0,down\n1.15,0,up\n")
    lives = [{"kind": "recorded", "nodes": [0], "path": "lives.csv"}]
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}}
    sensors = [{"nodes": [1], "H": [[1.0]], "R": [[0.3]]}]
    scenario = build(
        plant={**SLOTS, "period": 1.0}, sensors=sensors, probe=1.0,
        network={**network, "lives": lives}, filter={"kind": "intermittent"},
    )  # fmt: skip
    log = netkf.simulate(scenario).log
    messages = match_messages(log, swaps=False, slotted=True)
    sent = messages.sent[messages.outcome == OUTCOMES.index("unused")]
    assert sent.tolist() == [1.0]


@pytest.mark.parametrize(
    ("kind", "delay", "heard"),
    [
        ("intermittent", 0.0, None),
        # What was read before the node began again comes after it: a reading is not used then.
        ("intermittent", 0.7, None),
        ("diffusion", 0.7, 1.0),
        ("gossip", 0.7, 1.0),
    ],
)
def test_a_node_that_forgets_knows_no_reading_of_before(build, tmp_path, kind, delay, heard):
    (tmp_path / "lives.csv").write_text("t,node,what\n1.1,0,down\n1.4,0,up\n")
    lives = [{"kind": "recorded", "nodes": [0], "path": "lives.csv", "memory": "lost"}]
    every = {"kind": "periodic", "period": 1.0}
    activation = {"gossip": every, "diffusion": {**every, "at": "nodes"}}
    scenario = build(
        plant={"kind": "diffusion", "A": [[0.1]], "B": [[1.0]], "cov": [[4.0]]},
        sensors=[{"nodes": [0, 1], "H": [[1.0]], "R": [[0.3]], "sampling": every}],
        network={
            "graph": {"kind": "path", "nodes": 2},
            "activation": activation.get(kind, {"kind": "readings"}),
            "channel": {"delay": {"kind": "constant", "seconds": delay}},
            "lives": lives,
        },
        filter={"kind": kind}, probe=0.5,
    )  # fmt: skip
    for engine in ("simpy", "compiled"):
        run = netkf.simulate(scenario, engine=engine)
        found = {s.node: s.reading for s in netkf.why(run, 0, 1.8).sources}
        assert {node: None if math.isnan(t) else t for node, t in found.items()} == {
            0: None,
            1: heard,
        }


def test_of_two_messages_at_one_instant_the_newer_was_heard_last(build, tmp_path):
    (tmp_path / "delays.csv").write_text("sender,receiver,message,seconds\n1,0,0,1.0\n1,0,1,0.5\n")
    every = {"kind": "periodic", "period": 0.5}
    scenario = build(
        plant={"kind": "diffusion", "A": [[0.1]], "B": [[1.0]], "cov": [[4.0]]},
        sensors=[{"nodes": [1], "H": [[1.0]], "R": [[0.3]], "sampling": every}],
        network={
            "graph": {"kind": "edges", "edges": [[1, 0]], "directed": True},
            "activation": {"kind": "readings"},
            "channel": {"delay": {"kind": "recorded", "path": "delays.csv", "after": "lose"}},
        },
        filter={"kind": "intermittent"}, probe=0.5,
    )  # fmt: skip
    (source,) = netkf.why(netkf.simulate(scenario), 0, 1.8).sources
    assert (source.heard, source.arrived, source.unheard) == (1.0, 1.5, 1)


def test_sentences_tell_of_each_source_what_its_row_says():
    """Node 1 asked about: itself, two neighbours with sensors, and node 4 two links away."""
    nan, lost = math.nan, Missing(4, 2, 7, "lost", 5.0, math.nan)
    rows = [
        (1, True, False, nan, nan, 0, 10.0, 9.5, (1,), (9.5, 9.5, 9.5), 9.5, ()),
        (2, True, True, 7.0, 7.5, 2, 7.0, 6.5, (2, 1), (6.5, 6.5, 6.5), 9.0, ()),
        (3, True, True, 9.0, 9.0, 0, 9.0, 8.5, (3, 1), (8.5, 8.5, 8.5), 9.0, ()),
        (4, True, False, nan, nan, 5, 4.0, 3.0, (4, 2, 1), (3.0, 5.0, 6.0), 8.0, (lost, lost)),
    ]
    sources = tuple(InformationSource(*row) for row in rows)
    why = Why("hand", 1, 10.0, 0, 0, sources, (WhatIf("as it was", (), 2.0, 0.5),), None, {})
    told = " ".join(why.sentences())
    assert "It last heard node 3 at 9 s (1 s before) and node 2 at 7 s (3 s before)" in told
    # Of neighbours alone it is known what was sent to it.
    assert "2 messages sent to it since then were lost, late or not used: 2 of node 2." in told
    readings = "7 s old from node 4 (4 -> 2 -> 1), 3.5 s old from node 2 (2 -> 1) and 1.5 s old"
    assert f"Its newest readings are {readings} from node 3 (3 -> 1)." in told
    # With two more messages: the second of those with one, two and three.
    assert "A newer reading of node 4, 5 s old, would have come with" in told
    assert "old from node 1" not in told
