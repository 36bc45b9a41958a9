"""How many processes and events a run of the SimPy engine must have, from its trace and its
scenario, against SimPy's own count.
"""

import json

import pytest

import netkf
from netkf.cli.main import main
from netkf.engines.simpy.timeline import Timeline
from netkf.rng.streams import Streams
from tests.conftest import SCENARIOS

STEADY = {"kind": "diffusion", "A": [[-0.5]], "B": [[1.0]], "cov": [[1.0]]}
GROWING = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
SENSOR = {"H": [[1.0]], "R": [[0.5]]}
JITTER = {"kind": "periodic", "period": 0.3, "jitter": 0.1, "phase": "random"}
TOGETHER = {"kind": "periodic", "period": 0.25}
INCREMENTS = [{**SENSOR, "nodes": [0, 2]}]
SAMPLES = [
    {**SENSOR, "nodes": [0, 1], "sampling": TOGETHER},
    {**SENSOR, "nodes": [1], "sampling": TOGETHER},
    {**SENSOR, "nodes": [2], "sampling": JITTER},
]
GRAPH = {"kind": "cycle", "nodes": 4}
LOSSY = {"loss": {"kind": "bernoulli", "delivery": 0.7}}
SLOW = {**LOSSY, "delay": {"kind": "exponential", "mean": 0.4}}
ROUNDS = {"kind": "periodic", "period": 0.5, "at": "nodes"}


def poisson(at):
    return {"kind": "poisson", "rate": 3.0, "at": at}


def network(activation, **channel):
    return {"graph": GRAPH, "activation": activation, "channel": channel}


HYBRID = {"kind": "hybrid", "epsilon": 0.3}
CLOCKED = {
    "increments, links": (STEADY, INCREMENTS, network(poisson("links"), **LOSSY), HYBRID),
    "both, directions": (
        STEADY,
        INCREMENTS + SAMPLES,
        network(poisson("directions"), **SLOW),
        HYBRID,
    ),
    "nodes": (STEADY, SAMPLES, network(poisson("nodes"), **SLOW), HYBRID),
    "rounds": (STEADY, SAMPLES, network(ROUNDS, **LOSSY), {"kind": "diffusion"}),
    "readings": (STEADY, SAMPLES, network({"kind": "readings"}, **SLOW), HYBRID),
    "late": (
        STEADY,
        SAMPLES,
        network({"kind": "readings"}, **SLOW),
        {"kind": "intermittent", "window": 0.3},
    ),
    "push-sum": (STEADY, SAMPLES, network(poisson("nodes"), **SLOW), {"kind": "push-sum"}),
    "frames": (GROWING, SAMPLES, network(poisson("links"), **SLOW), HYBRID),
    "central": (STEADY, INCREMENTS + SAMPLES, network(poisson("links")), {"kind": "central"}),
    "local": (STEADY, SAMPLES, network(poisson("links")), {"kind": "local"}),
}


@pytest.fixture
def stepped(monkeypatch):
    """How often SimPy took an event from its queue."""
    steps, step = [], Timeline.step

    def counting(self):
        step(self)
        steps.append(self.now)

    monkeypatch.setattr(Timeline, "step", counting)
    return steps


def rows(run, *kinds):
    return run.events[run.events.kind.isin(kinds)]


def clocks(scenario):
    """Links, directions or nodes that have a clock."""
    at = getattr(scenario.network.activation, "at", None)
    topology = scenario.topology
    if not scenario.filter.algorithm.timing.talks:
        return 0
    return {
        "links": len(topology.links),
        "directions": len(topology.directions),
        "nodes": len(scenario.nodes),
        "readings": 0,
    }[at]


def in_continuous_time(scenario, run):
    """Processes and events of a run, counted by hand."""
    samples = scenario.sample_times(Streams(scenario.seed))
    sampled = {(node, t) for (node, _), times in samples.items() for t in times.tolist()}
    pooled = scenario.node_filter.timing.pooled  # all nodes share one filter
    updates = len({t for _, t in sampled}) if pooled else len(sampled)
    frames = len(scenario.continuous_truth(Streams(scenario.seed)).frame_times)
    delayed = rows(run, "deliver", "late")
    readings = getattr(scenario.network.activation, "at", None) == "readings"
    processes = (
        2  # states are shown, and the origin of coordinates moves
        + len(scenario.increment_sensors)  # a node with increments
        + len(samples)  # a sensor that samples
        + clocks(scenario)
    )
    events = (
        2 * processes  # each begins and ends
        + len(run.times)
        + frames
        + len(rows(run, "sense")) - len(sampled)  # wake-ups of nodes with increments
        + sum(map(len, samples.values()))
        + updates  # a node uses its samples of one instant
        + len(rows(run, "tick"))
        + (len(sampled) if readings else 0)  # a node transmits after its samples
        + int((delayed.age > 0.0).sum())
        + len(rows(run, "absorb"))
    )  # fmt: skip
    return {"processes": processes, "events": events}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", CLOCKED)
def test_simpy_counts_what_the_trace_says_under_clocks(name, build, stepped):
    plant, sensors, net, filters = CLOCKED[name]
    tables = {"plant": plant, "sensors": sensors, "network": net, "filter": filters}
    scenario = build(**tables, horizon=8.0)
    run = netkf.simulate(scenario, engine="simpy")
    assert run.status == "complete"
    if name == "frames":
        assert len(scenario.continuous_truth(Streams(scenario.seed)).frame_times) > 0
    if net["channel"].get("delay"):
        assert (rows(run, "deliver").age > 0.0).any()
    assert run.stats == in_continuous_time(scenario, run)
    assert run.stats["events"] == len(stepped)


SLOTTED = {
    # Stages of a node in one slot: predict, update and one "absorb" for each exchange.
    "gossip_ring": (3, 1),
    "push_sum_planar": (6, 4),  # two more: four exchanges, of the mass and gamma = 3
    "diffusion_regression": (3, 1),
    "intermittent_random10": (3, 1),
    "gossip_periodic": (3, 1),
}


@pytest.mark.parametrize("name", SLOTTED)
def test_simpy_counts_what_happens_in_slots(name, stepped):
    """All nodes, sensors and the clock that they share follow the schedule of every slot."""
    given = netkf.load(SCENARIOS / f"{name}.toml")
    period = given.slot_plant.period
    scenario = given.replace({"horizon": 20 * period, "probe": [0.0, 7 * period]})
    run = netkf.simulate(scenario, engine="simpy")
    stages, exchanges = SLOTTED[name]
    slots, nodes, sensing = 20, len(scenario.nodes), len(scenario.placed_sensors)
    processes = 1 + nodes + sensing + 1
    if scenario.filter.algorithm.timing.predicts:
        events = slots * (1 + nodes * stages + sensing + exchanges)
        events -= (
            scenario.node_filter.timing.first_exchange * (nodes + 1) * exchanges
        )  # gossip begins in slot 1
    else:  # nothing happens in slot 0, whose sample is taken at its end as all are
        events = 2 * slots + (slots - 1) * (nodes * stages + sensing + exchanges)
    delayed = int((rows(run, "deliver", "late").age > 0.0).sum())
    assert run.stats == {"processes": processes, "events": 2 * processes + events + delayed}
    assert run.stats["events"] == len(stepped)


def test_the_manifest_has_the_counts_and_the_compiled_engine_none(tmp_path, ring, capsys):
    file, short = str(SCENARIOS / "poisson_ring.toml"), ["--no-plot", "--set", "horizon=2.0"]
    stable = ["--set", "plant.A=[[0.0, 1.0], [-1.0, -0.1]]"]
    scenario = ring.replace({"horizon": 2.0, "plant.A": [[0.0, 1.0], [-1.0, -0.1]]})
    for name, told in (("simpy", "simpy"), ("processes", "simpy"), ("compiled", "compiled")):
        out = tmp_path / name
        assert main(["run", file, *short, *stable, "--engine", name, "--out", str(out)]) == 0
        manifest = json.loads((out / "manifest.json").read_text())
        assert manifest["engine"] == told
        assert f"engine {told}\n" in capsys.readouterr().out
        run = netkf.simulate(scenario, engine=name)
        assert manifest.get("simpy", {}) == run.stats
        assert bool(run.stats) == (told == "simpy")
