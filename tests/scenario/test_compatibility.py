"""What goes together, and what is refused in one line; what a run used of its records."""

import pytest

import netkf
from netkf.scenario.reading import from_table
from netkf.scenario.usage import record_usage, usage_notes
from netkf.scenario.writing import resolve_defaults

SAMPLES = {"kind": "periodic", "period": 0.5}
SENSOR = {"nodes": [0], "H": [[1.0]], "R": [[0.5]]}
SAMPLED = [{**SENSOR, "sampling": SAMPLES}]
SLOTS = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 0.5, "cov": [[1.0]]}
DIFFUSION = {"kind": "diffusion", "A": [[-0.5]], "B": [[1.0]], "cov": [[1.0]]}
FILTERS = {
    "hybrid": {"kind": "hybrid", "epsilon": 0.5},
    "covariance-intersection": {"kind": "covariance-intersection", "epsilon": 0.5},
    "gossip": {"kind": "gossip"},
    "intermittent": {"kind": "intermittent"},
    "diffusion": {"kind": "diffusion"},
    "push-sum": {"kind": "push-sum"},
}
CLOCKS = {
    **{at: {"kind": "poisson", "rate": 1.0, "at": at} for at in ("links", "directions", "nodes")},
    "readings": {"kind": "readings"},
}
RUNS = {
    "hybrid": "links directions nodes readings",
    "covariance-intersection": "links directions nodes readings",
    "gossip": "links",
    "intermittent": "readings",
    "diffusion": "directions nodes readings",
    "push-sum": "nodes",
}
PATH = {"kind": "path", "nodes": 2}
DIRECTED = {"kind": "edges", "edges": [[0, 1], [2, 1]], "directed": True}


def network(clock, graph=PATH, **channel):
    return {"graph": graph, "activation": clock, "channel": channel}


def line(build, **tables):
    with pytest.raises(netkf.ScenarioError) as caught:
        build(**tables)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert "; " in text
    return text


@pytest.mark.parametrize("at", CLOCKS)
@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_under_every_clock(name, at, build):
    tables = {"sensors": SAMPLED, "filter": FILTERS[name], "network": network(CLOCKS[at])}
    if at in RUNS[name].split():
        assert build(**tables).network.activation.at == at
        # The sums of push-sum must find a way back.
        graph = {**DIRECTED, "edges": [[0, 1], [1, 2], [2, 0]]} if name == "push-sum" else DIRECTED
        directed = {**tables, "network": network(CLOCKS[at], graph)}
        if at == "links":
            assert line(build, **directed).startswith("network.graph.directed: must be false for")
        else:
            assert build(**directed).topology.directed
    else:
        text = line(build, **tables)
        key = "kind" if at == "readings" else "at"
        assert text.startswith(f"network.activation.{key}: must be one that the {name} filter")
        assert repr(at) in text


REFUSED = {
    "increments-intermittent": (
        {"filter": FILTERS["intermittent"], "network": network(CLOCKS["readings"])},
        "sensors[0].sampling: is missing, and the intermittent filter uses samples",
    ),
    "increments-push-sum": (
        {"filter": FILTERS["push-sum"], "network": network(CLOCKS["nodes"])},
        "sensors[0].sampling: is missing, and the push-sum filter uses samples",
    ),
    "readings-without-samples": (
        {"network": network(CLOCKS["readings"])},
        "network.activation.kind: needs a sensor that takes samples, and there is none",
    ),
    "matching-over-a-diffusion": (
        {"network": network({"kind": "matching", "protocol": "one-edge"})},
        "network.activation.kind: belongs to plants in slots (linear), and this plant is in cont",
    ),
    "broadcast-over-a-diffusion": (
        {"network": network({"kind": "broadcast"})},
        "network.activation.kind: belongs to plants in slots (linear), and this plant is in cont",
    ),
    "clocks-in-slots": (
        {"plant": SLOTS, "filter": FILTERS["diffusion"], "network": network(CLOCKS["nodes"])},
        "network.activation.kind: belongs to plants in continuous time (diffusion), and this plant",
    ),
    "hybrid-in-slots": (
        {"plant": SLOTS, "network": network({"kind": "broadcast"})},
        "filter.kind: belongs to plants in continuous time (diffusion), and this plant is in slots",
    ),
    "push-sum-in-slots": (
        {
            "plant": SLOTS,
            "filter": {"kind": "push-sum", "delta": 3.0},
            "network": network({"kind": "broadcast"}),
        },
        "filter.gamma: is missing for a plant in slots",
    ),
    "sampling-in-slots": (
        {
            "plant": SLOTS,
            "sensors": SAMPLED,
            "filter": FILTERS["diffusion"],
            "network": network({"kind": "broadcast"}),
        },
        "sensors[0].sampling",
    ),
    "sampling-rates": (
        {"sensors": [{**SENSOR, "sampling": {"kind": "poisson", "rates": [[0, 1, 1.0]]}}]},
        "sensors[0].sampling.rates",
    ),
    "sampling-at": (
        {"sensors": [{**SENSOR, "sampling": {"kind": "poisson", "rate": 1.0, "at": "nodes"}}]},
        "sensors[0].sampling.at",
    ),
    "sampling-fast": (
        {"sensors": [{**SENSOR, "sampling": {"kind": "poisson", "rate": 1e9}}], "horizon": 9.0},
        "sensors[0].sampling",
    ),
    "sampling-word": (
        {"sensors": [{**SENSOR, "sampling": "often"}]},
        'sensors[0].sampling: must be "continuous" or a clock',
    ),
    "at-word": (
        {"network": network({"kind": "poisson", "rate": 1.0, "at": "edges"})},
        'network.activation.at: must be one of "links", "directions", "nodes"',
    ),
    "at-of-readings": (
        {"sensors": SAMPLED, "network": network({"kind": "readings", "at": "nodes"})},
        "network.activation.at: is not a key here",
    ),
    "node-ticks": (
        {"network": network({"kind": "poisson", "rate": 1e9, "at": "nodes"})},
        "network.activation: must make at most 1e+09 ticks of a node up to the horizon",
    ),
    "window": (
        {
            "sensors": SAMPLED,
            "filter": {"kind": "intermittent", "window": 0.0},
            "network": network(CLOCKS["readings"]),
        },
        "filter.window: must be a finite number above 0",
    ),
    "unknown-drawn": (
        {"plant": {"kind": "unknown", "A": [[-0.5]], "B": [[1.0]]}, "sensors": SAMPLED},
        "sensors[0].kind: must be recorded where the plant's state is unknown",
    ),
    "epsilon-of-two-senders": (
        {
            "filter": {"kind": "hybrid", "epsilon": 0.6},
            "network": network(CLOCKS["nodes"], DIRECTED),
        },
        "filter.epsilon: must be at most 1 / 2, because node 1 has 2 links",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_go_together_is_refused(name, build):
    tables, start = REFUSED[name]
    assert line(build, **tables).startswith(start)


TABLES = {
    "nodes-with-peer": ("ticks", "t,node,peer\n0.5,0,1\n", "nodes", "must have no column peer"),
    "links-without-peer": ("ticks", "t,node\n0.5,0\n", "links", "columns t, node, peer"),
    "stranger": ("ticks", "t,node\n0.5,7\n", "nodes", "names a node that the graph does not have"),
    "no-direction": (
        "ticks",
        "t,node,peer\n0.5,0,5\n",
        "directions",
        "must be a link of the graph",
    ),
    "at-zero": ("ticks", "t,node\n0.0,0\n", "nodes", "t must be above 0"),
    "negative": ("delay", "0,1,0,-0.5\n", "deliver", "seconds must be at least 0"),
    "infinite": ("delay", "0,1,0,inf\n", "deliver", "seconds must be a finite number"),
    "twice": ("delay", "0,1,0,0.5\n0,1,0,0.25\n", "deliver", "one value a message"),
    "no-link": ("delay", "0,5,0,0.5\n", "deliver", "must be a link of the graph"),
    "after": ("delay", "0,1,0,0.5\n", "forget", "must be one of"),
    "loss-after": ("loss", "0,1,0,1\n", "forget", "must be one of"),
}


@pytest.mark.parametrize("name", TABLES)
def test_records_that_do_not_fit_are_refused(name, build, tmp_path):
    what, text, setting, words = TABLES[name]
    column = {"delay": "seconds", "loss": "delivered"}.get(what)
    head = f"sender,receiver,message,{column}\n" if column else ""
    (tmp_path / "table.csv").write_text(head + text)
    if column:
        part = {"kind": "recorded", "path": "table.csv", "after": setting}
        found = line(build, network=network(CLOCKS["links"], **{what: part}))
        assert found.startswith(f"network.channel.{what}.")
    else:
        clock = {"kind": "recorded", "path": "table.csv", "at": setting}
        found = line(build, network=network(clock))
        assert found.startswith("network.activation.path: table.csv")
    assert words in found


def test_nobody_needs_all_nodes_joined_where_links_go_one_way(build):
    apart = {"kind": "edges", "edges": [[0, 1], [2, 3]]}
    assert "network.graph: must be connected" in line(
        build, network=network(CLOCKS["nodes"], apart)
    )
    assert build(network=network(CLOCKS["nodes"], {**apart, "directed": True}))


def test_effective_rates_of_every_activation(build):
    channel = {"loss": {"kind": "bernoulli", "delivery": 0.5}}
    rates = {"kind": "poisson", "rate": 1.0, "at": "directions", "rates": [[1, 0, 4.0]]}
    assert build(network=network(rates, **channel)).effective_rates() == {(0, 1): 0.5, (1, 0): 2.0}
    rates = {"kind": "poisson", "rate": 1.0, "at": "nodes", "rates": [[1, 4.0]]}
    assert build(network=network(rates, **channel)).effective_rates() == {(0, 1): 0.5, (1, 0): 2.0}
    reading = build(network=network(CLOCKS["readings"], **channel), sensors=SAMPLED)
    assert reading.effective_rates() == {(0, 1): 1.0, (1, 0): 0.0}


def test_continuous_sampling_is_written_as_absent(build):
    scenario = build(sensors=[{**SENSOR, "sampling": "continuous"}])
    assert scenario == build()
    assert "sampling" not in resolve_defaults(scenario)["sensors"][0]
    again = resolve_defaults(build(sensors=SAMPLED))["sensors"][0]["sampling"]
    assert again == {"kind": "periodic", "period": 0.5, "phase": 0.0, "jitter": 0.0}
    assert resolve_defaults(build(network=network(CLOCKS["readings"]), sensors=SAMPLED))["network"][
        "activation"
    ] == {"kind": "readings"}


def test_push_sum_says_what_it_does_not_use_under_clocks(build):
    filters = {"kind": "push-sum", "gamma": 3, "delta": 3.0}
    made = build(sensors=SAMPLED, filter=filters, network=network(CLOCKS["nodes"]))
    assert "filter.gamma, filter.delta: not used under clocks" in "\n".join(made.notes)


@pytest.mark.parametrize(
    ("B", "cov", "told"),
    [
        ([[0.0], [1.0]], [[0.0, 0.0], [0.0, 0.0]], True),
        ([[0.0], [1.0]], [[1.0, 0.0], [0.0, 1.0]], False),
        ([[1.0, 0.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]], False),
    ],
)
def test_sums_of_a_start_that_is_nearly_certain_lose_digits(tmp_path, B, cov, told):
    """P grows as a power of time at first, and sums keep its inverse."""
    A = [[0.0, 1.0], [0.0, 0.0]]
    sampled = {"nodes": [0, 1], "H": [[1.0, 0.0]], "R": [[1.0]], "sampling": SAMPLES}
    table = {
        "format": 1,
        "name": "sums",
        "horizon": 5.0,
        "probe": 1.0,
        "plant": {"kind": "diffusion", "A": A, "B": B, "cov": cov},
        "sensors": [sampled],
        "network": network(CLOCKS["nodes"]),
        "filter": {"kind": "push-sum"},
    }
    notes = from_table(table, tmp_path).notes
    assert any("lose digits; give filter.cov" in note for note in notes) == told


def test_what_a_run_used_of_its_records(build, tmp_path):
    (tmp_path / "ticks.csv").write_text("t,node\n0.5,0\n0.75,1\n5.0,0\n")
    (tmp_path / "lost.csv").write_text("sender,receiver,message,delivered\n0,1,0,0\n0,1,7,1\n")
    (tmp_path / "late.csv").write_text("sender,receiver,message,seconds\n1,0,0,0.5\n")
    (tmp_path / "samples.csv").write_text("t,node\n0.5,0\n4.0,0\n0.5,1\n")
    scenario = build(
        sensors=[{**SENSOR, "sampling": {"kind": "recorded", "path": "samples.csv"}}],
        network=network(
            {"kind": "recorded", "path": "ticks.csv", "at": "nodes"},
            loss={"kind": "recorded", "path": "lost.csv", "after": "lose"},
            delay={"kind": "recorded", "path": "late.csv"},
        ),
    )
    usage = record_usage(scenario, {(0, 1): 3, (1, 0): 1})
    assert usage == {
        "network.activation": {"path": "ticks.csv", "rows": 3, "used": 2, "merged": 0, "unused": 1},
        "network.channel.loss": {
            "path": "lost.csv",
            "rows": 2,
            "used": 1,
            "merged": 0,
            "unused": 1,
            "beyond": 3,
            "after": "lose",
        },
        "network.channel.delay": {
            "path": "late.csv",
            "rows": 1,
            "used": 1,
            "merged": 0,
            "unused": 0,
            "beyond": 3,
            "after": "deliver",
        },
        "sensors[0].sampling": {
            "path": "samples.csv",
            "rows": 3,
            "used": 1,
            "merged": 0,
            "unused": 2,
        },
    }
    assert usage_notes(usage) == (
        "network.activation: 1 of 3 rows were not used (ticks.csv)",
        "network.channel.loss: 1 of 2 rows were not used (lost.csv)",
        "network.channel.loss: 3 messages are not listed and were lost (lost.csv)",
        "network.channel.delay: 3 messages are not listed and took no time unless lost (late.csv)",
        "sensors[0].sampling: 2 of 3 rows were not used (samples.csv)",
    )
    # A run that refuses what is not listed has ended: what has no delay was lost.
    delay = {**usage["network.channel.delay"], "after": "refuse"}
    assert usage_notes({"network.channel.delay": delay}) == ()
    assert record_usage(build(), {(0, 1): 3}) == {}
