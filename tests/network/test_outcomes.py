"""Losses that many messages share, that change with time or with the channel: closed forms, and
both engines.
"""

import dataclasses
import itertools

import numpy as np
import pytest

import netkf
from netkf.checks.parts.events import loss_law
from netkf.checks.parts.network_rows import LOSS_ROW
from netkf.network.losses import Bernoulli, GilbertElliott, Loss, SharedLoss
from netkf.scenario.usage import record_usage
from netkf.trace.schema import CODES

CLOCKS = """
format = 1
name = "five"
horizon = {horizon}
probe = 1.0
[plant]
kind = "diffusion"
A = [[-0.2]]
B = [[1.0]]
cov = [[1.0]]
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[0.1]]
sampling = {{ kind = "periodic", period = 1.0 }}
[network]
graph = {{ kind = "complete", nodes = 5 }}
activation = {{ kind = "poisson", rate = 2.0, at = "{at}" }}
channel = {{ {channel} }}
[filter]
kind = "hybrid"
epsilon = 0.2
"""
SLOTS = """
format = 1
name = "five"
horizon = {horizon}
probe = 1.0
[plant]
kind = "linear"
period = 1.0
F = [[0.9]]
Q = [[0.1]]
cov = [[1.0]]
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[0.1]]
[network]
graph = {{ kind = "complete", nodes = 5 }}
activation = {{ kind = "broadcast" }}
channel = {{ {channel} }}
[filter]
kind = "kcf"
epsilon = 0.1
"""


@pytest.fixture
def scenario_of(tmp_path):
    def make(text, channel, files=(), horizon=60.0, at="nodes"):
        for name, rows in dict(files).items():
            (tmp_path / name).write_text(rows)
        path = tmp_path / "five.toml"
        path.write_text(text.format(channel=channel, horizon=horizon, at=at))
        return netkf.load(path)

    return make


SCHEDULE = (
    "from,until,sender,receiver,delivery\n0,20,0,1,0.25\n20,40,0,1,0.75\n0,30,1,0,0\n30,50,1,0,1\n"
)
BURSTS = (
    "sender,receiver,to_bad,to_good,deliver_bad\n0,1,0.1,0.3,0.2\n0,2,0.1,0.3,0.0\n"
    "1,0,0.9,0.2,0.1\n"
)
ALL_BURSTS = "sender,receiver,mean_loss,mean_burst\n" + "".join(
    f"{i},{j},{0.2 + 0.02 * i},{2 + j}\n" for i in range(5) for j in range(5) if i != j
)
HOPS = "channel,delivery\n11,0.2\n15,1.0\n26,0.6\n"
KINDS = {
    "shared": ('loss = { kind = "shared", delivery = 0.6, share = 0.7 }', {}),
    "scheduled": (
        'loss = { kind = "scheduled", path = "s.csv", otherwise = 0.5 }',
        {"s.csv": SCHEDULE},
    ),
    "bursts per link": (
        'symmetric = false, loss = { kind = "gilbert-elliott", path = "b.csv", mean_loss = 0.3, '
        "mean_burst = 4.0 }",
        {"b.csv": BURSTS},
    ),
    "shared bursts": (
        'symmetric = false, loss = { kind = "gilbert-elliott", to_bad = 0.1, to_good = 0.3, '
        "deliver_bad = 0.3, shared = true }",
        {},
    ),
    "bursts by a table alone": (
        'symmetric = false, loss = { kind = "gilbert-elliott", path = "b.csv" }',
        {"b.csv": ALL_BURSTS},
    ),
    "hopping": ('channels = { hopping = [11, 15, 26, 11], path = "h.csv" }', {"h.csv": HOPS}),
}


def outcomes(run):
    """Arrays of (sender, receiver, number, time, lost) of all messages of a run."""
    log = run.log
    sends = log[log["kind"] == CODES["send"]]
    gone = log[log["kind"] == CODES["lost"]]
    names = ["node", "peer", "message"]
    lost = set(gone[names].tolist())
    flags = np.array([key in lost for key in sends[names].tolist()])
    return sends["node"], sends["peer"], sends["message"], sends["t"], flags


@pytest.mark.one_in(6)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time", ["nodes", "links", "slots"])
def test_engines_agree(scenario_of, kind, time):
    text = SLOTS if time == "slots" else CLOCKS
    scenario = scenario_of(text, *KINDS[kind], horizon=30.0, at=time)
    runs = [netkf.simulate(scenario, seed=5, engine=engine) for engine in ("simpy", "compiled")]
    assert runs[0].fingerprint == runs[1].fingerprint
    assert np.allclose(runs[0].xhat, runs[1].xhat, rtol=0.0, atol=1e-10)
    lost = outcomes(runs[0])[-1]
    assert 0.05 < lost.mean() < 0.95
    other = netkf.simulate(scenario, seed=5, replica=1)
    assert other.fingerprint != runs[0].fingerprint


def pairs_of_hearers(run):
    """How many messages of two hearers of one broadcast there are, and how many of these pairs were
    both served, both lost.
    """
    node, _, _, t, lost = outcomes(run)
    pairs = served = gone = 0
    order = np.lexsort((node, t))
    for _, group in itertools.groupby(order.tolist(), key=lambda k: (t[k], node[k])):
        flags = lost[list(group)]
        count, down = len(flags), int(flags.sum())
        pairs += count * (count - 1) // 2
        served += (count - down) * (count - down - 1) // 2
        gone += down * (down - 1) // 2
    return pairs, served, gone


@pytest.mark.parametrize("time", ["nodes", "slots"])
def test_two_hearers_are_served_by_the_closed_form(scenario_of, time):
    # With share c: p^2 + c p (1 - p). Six broadcasts of pairs depend on each other, so that the
    # deviation is that of at most as many independent draws as there are broadcasts.
    p, c = 0.6, 0.7
    text = SLOTS if time == "slots" else CLOCKS
    run = netkf.simulate(scenario_of(text, *KINDS["shared"], horizon=1000.0), seed=2)
    pairs, served, _ = pairs_of_hearers(run)
    broadcasts = pairs / 6
    deviation = 0.5 / np.sqrt(broadcasts)
    assert served / pairs == pytest.approx(p**2 + c * p * (1 - p), abs=4.5 * deviation)
    # A law without sharing would be found.
    assert c * p * (1 - p) > 9.0 * deviation
    lost = outcomes(run)[-1]
    assert lost.mean() == pytest.approx(1 - p, abs=4.5 * deviation)


@pytest.mark.parametrize("text", [CLOCKS, SLOTS], ids=["clocks", "slots"])
def test_special_cases_coincide_to_the_bit(scenario_of, text):
    scenario = scenario_of(text, 'loss = { kind = "bernoulli", delivery = 0.6 }', horizon=30.0)

    def run(loss):
        channel = dataclasses.replace(scenario.network.channel, loss=loss)
        network = dataclasses.replace(scenario.network, channel=channel)
        return netkf.simulate(dataclasses.replace(scenario, network=network), seed=3).fingerprint

    expected = run(Bernoulli(delivery=0.6))
    assert run(SharedLoss(delivery=0.6, share=0.0)) == expected
    # A chain whose states deliver alike draws the same numbers for outcomes.
    alike = GilbertElliott(to_bad=0.2, to_good=0.4, deliver_good=0.6, deliver_bad=0.6)
    assert run(alike) == expected
    shared = dataclasses.replace(alike, shared=True)
    assert run(shared) == expected


def test_one_fate_for_all_hearers(scenario_of):
    loss = 'loss = { kind = "shared", delivery = 0.5, share = 1.0 }'
    run = netkf.simulate(scenario_of(CLOCKS, loss, horizon=100.0), seed=2)
    pairs, served, gone = pairs_of_hearers(run)
    assert served + gone == pairs > 1000


def test_a_note_says_that_nothing_is_shared(scenario_of):
    told = [scenario_of(CLOCKS, *KINDS["shared"], at=at).notes for at in ("links", "nodes")]
    assert ["no fate is shared" in " ".join(notes) for notes in told] == [True, False]


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_who_shares_a_fate_hears_nothing_over_a_link_that_is_down(scenario_of, tmp_path, engine):
    rows = [(slot, i, j) for slot in range(1, 9) for i, j in ((0, 1), (2, 3)) if slot % 3]
    lines = [f"{slot},0,0,{i},{j}" for slot, *pair in rows for i, j in (pair, pair[::-1])]
    (tmp_path / "up.csv").write_text("\n".join(["slot,phase,step,node,peer", *lines]))
    channel = 'symmetric = false, loss = { kind = "shared", delivery = 1.0, share = 1.0 }'
    scenario = scenario_of(SLOTS, channel, horizon=9.0)
    changes = {"network.activation": {"kind": "recorded", "path": "up.csv"}}
    log = netkf.simulate(scenario.replace(changes), engine=engine).log
    heard = log[log["kind"] == CODES["deliver"]]
    found = zip(heard["t"].tolist(), heard["peer"].tolist(), heard["node"].tolist(), strict=True)
    assert {(t, i, j) for t, i, j in found if i < j} == set(rows)


def test_a_shared_chain_is_one_state_for_all_hearers(scenario_of):
    loss = (
        'loss = { kind = "gilbert-elliott", mean_loss = 0.4, mean_burst = 5.0, shared = true }, '
        "symmetric = false"
    )
    for text in (CLOCKS, SLOTS):
        run = netkf.simulate(scenario_of(text, loss, horizon=300.0), seed=2)
        pairs, served, gone = pairs_of_hearers(run)
        assert served + gone == pairs
        node, peer, number, _, lost = outcomes(run)
        chosen = (node == 0) & (peer == 1)
        series = lost[chosen][np.argsort(number[chosen])]
        bursts = [len(list(g)) for bad, g in itertools.groupby(series.tolist()) if bad]
        # Geometric bursts of mean 5; their number and spread give the interval.
        assert np.mean(bursts) == pytest.approx(5.0, abs=4.5 * np.sqrt(20.0 / len(bursts)))


def test_a_shared_chain_steps_once_a_transmission(scenario_of):
    """Where a sender tells one neighbour at a time, messages of a link are several steps apart:
    ``check`` promises nothing of their bursts then.
    """
    chain = 'kind = "gilbert-elliott", mean_loss = 0.4, mean_burst = 5.0, shared = true'
    channel = f"loss = {{ {chain} }}, symmetric = false"
    text = CLOCKS.replace('"complete", nodes = 5', '"star", nodes = 5')
    text = text.replace('"poisson", rate = 2.0', '"periodic", period = 1.0')
    scenario = scenario_of(text, channel, horizon=120.0, at="links")
    run = netkf.simulate(scenario.replace({"probe": 100.0}), seed=2, engine="simpy")
    node, peer, number, _, lost = outcomes(run)
    again = []
    for other in (1, 2, 3, 4):
        chosen = (node == 0) & (peer == other)
        series = lost[chosen][np.argsort(number[chosen])]
        again += series[1:][series[:-1]].tolist()
    # A step keeps the state with weight 1 - 1/5 - (1/5) (0.4/0.6); one step alone would give 0.8.
    assert np.mean(again) == pytest.approx(0.4 + 0.6 * (2.0 / 3.0) ** 4, abs=0.12)
    assert loss_law(scenario).chain is None
    assert loss_law(scenario_of(text, channel, at="nodes")).chain is not None


def test_the_schedule_is_followed(scenario_of):
    run = netkf.simulate(scenario_of(CLOCKS, *KINDS["scheduled"], horizon=60.0), seed=1)
    node, peer, _, t, lost = outcomes(run)
    back = (node == 1) & (peer == 0)
    # A row holds from its beginning to before its end.
    assert lost[back & (t < 30.0)].all()
    assert not lost[back & (t >= 30.0) & (t < 50.0)].any()
    samples = {(0.0, 20.0): 0.25, (20.0, 40.0): 0.75, (40.0, 60.0): 0.5}
    totals = dict.fromkeys(samples, (0, 0))
    for replica in range(30):
        one = netkf.simulate(scenario_of(CLOCKS, *KINDS["scheduled"]), seed=1, replica=replica)
        node, peer, _, t, lost = outcomes(one)
        for begin, end in samples:
            chosen = lost[(node == 0) & (peer == 1) & (t >= begin) & (t < end)]
            sent, arrived = totals[begin, end]
            totals[begin, end] = sent + len(chosen), arrived + int((~chosen).sum())
    for interval, p in samples.items():
        sent, arrived = totals[interval]
        assert arrived / sent == pytest.approx(p, abs=4.5 * np.sqrt(p * (1 - p) / sent))


def test_a_row_holds_from_its_beginning_to_before_its_end(scenario_of):
    rows = SCHEDULE + "0,60,2,3,0.4\n-9,0,3,2,0.1\n"
    scenario = scenario_of(CLOCKS, KINDS["scheduled"][0], {"s.csv": rows})
    loss, sent = scenario.network.channel.loss, scenario.transmission((0, 1))
    values = [loss.delivery_probability(sent._replace(time=t)) for t in (0.0, 19.9, 20.0, 40.0)]
    assert values == [0.25, 0.25, 0.75, 0.5]
    # Directions that change lose neighbouring messages alike, whatever others do.
    assert not loss.independent
    assert np.isnan(scenario.mean_delivery((0, 1)))
    assert scenario.mean_delivery((2, 1)) == 0.5
    # The last row ends when the run begins.
    assert loss.use(30.0).used == 4


def test_messages_hop(scenario_of):
    scenario = scenario_of(CLOCKS, *KINDS["hopping"], horizon=400.0)
    run = netkf.simulate(scenario, seed=1)
    _, _, number, _, lost = outcomes(run)
    for hop, p in enumerate((0.2, 1.0, 0.6, 0.2)):
        arrived = ~lost[number % 4 == hop]
        deviation = np.sqrt(p * (1 - p) / len(arrived))
        assert arrived.mean() == pytest.approx(p, abs=4.5 * deviation + 1e-12)
    assert scenario.mean_delivery((0, 1)) == pytest.approx(0.5)


def test_channels_deliver_by_direction(scenario_of):
    pairs = [(i, j) for i in range(5) for j in range(5) if i != j]
    rows = "channel,sender,receiver,delivery\n" + "".join(
        f"{channel},{i},{j},{(channel + i) / 20}\n" for channel in (1, 2) for i, j in pairs
    )
    scenario = scenario_of(
        CLOCKS, 'channels = { hopping = [1, 2], path = "h.csv" }', {"h.csv": rows}
    )
    channels = scenario.network.channel.channels
    assert not scenario.network.channel.independent
    assert channels.on_hops((3, 0)).tolist() == [0.2, 0.25]
    assert channels.on_hops((0, 3)).tolist() == [0.05, 0.1]
    silent = scenario.replace({"filter": {"kind": "local"}})
    used = [record_usage(s, None)["network.channel.channels"]["used"] for s in (scenario, silent)]
    assert used == [40, 0]


@pytest.mark.parametrize("slots", [6, 7, 9])
def test_check_knows_the_hops_of_a_run(scenario_of, slots):
    """The mean over the hops is that of runs that end with the last one."""
    scenario = scenario_of(SLOTS, *KINDS["hopping"], horizon=float(slots))
    verdict = netkf.check(scenario, runs=50, workers=1)
    row = verdict.table.set_index("promise").loc[LOSS_ROW.statement]
    sent = [(0.2, 1.0, 0.6, 0.2)[k % 4] for k in range(slots - 1)]
    assert row["expected"] == pytest.approx(1.0 - np.mean(sent))
    assert row["verdict"] != "broken"


class Dusk(Loss):
    """Weather that all links share: drawn once for a run, and worse as it goes on."""

    independent = False

    def conditions(self, random, horizon):
        return random.random(), horizon

    def delivery_probability(self, sent):
        first, horizon = sent.conditions
        return first * (1.0 - sent.time / horizon)


class VectorDusk(Dusk):
    """The same, for many messages at once."""

    vectorised = True

    def delivery_probability(self, sent):
        first, horizon = sent.conditions
        return np.asarray(first * (1.0 - sent.time / horizon))


@pytest.mark.parametrize("text", [CLOCKS, SLOTS], ids=["clocks", "slots"])
def test_conditions_are_drawn_once_a_run(scenario_of, text):
    scenario = scenario_of(text, 'loss = { kind = "bernoulli", delivery = 0.6 }', horizon=30.0)
    prints = {}
    for loss in (Dusk(), VectorDusk()):
        channel = dataclasses.replace(scenario.network.channel, loss=loss)
        network = dataclasses.replace(scenario.network, channel=channel)
        own = dataclasses.replace(scenario, network=network)
        for engine, replica in itertools.product(("simpy", "compiled"), (0, 1)):
            run = netkf.simulate(own, seed=4, replica=replica, engine=engine)
            prints.setdefault(replica, set()).add(run.fingerprint)
    assert [len(found) for found in prints.values()] == [1, 1]
    assert prints[0] != prints[1]


REFUSALS = {
    "overlap": (
        'loss = { kind = "scheduled", path = "s.csv" }',
        "from,until,sender,receiver,delivery\n0,5,0,1,0.5\n4,9,0,1,0.7\n",
        "network.channel.loss.path: s.csv line 3: overlaps the interval of s.csv line 2",
    ),
    "end before beginning": (
        'loss = { kind = "scheduled", path = "s.csv" }',
        "from,until,sender,receiver,delivery\n5,5,0,1,0.5\n",
        "s.csv line 2: until must be after from",
    ),
    "no probability": (
        'loss = { kind = "scheduled", path = "s.csv" }',
        "from,until,sender,receiver,delivery\n0,5,0,1,1.5\n",
        "s.csv line 2: delivery must be a number from 0 to 1; got 1.5",
    ),
    "no link": (
        'loss = { kind = "scheduled", path = "s.csv" }',
        "from,until,sender,receiver,delivery\n0,5,0,9,0.5\n",
        "s.csv",
    ),
    "a link without a chain": (
        'loss = { kind = "gilbert-elliott", path = "s.csv" }',
        "sender,receiver,mean_loss,mean_burst\n0,1,0.2,3\n",
        "must have a row of each direction",
    ),
    "an impossible chain": (
        'loss = { kind = "gilbert-elliott", path = "s.csv" }',
        "sender,receiver,mean_loss,mean_burst\n0,1,0.9,1\n",
        "s.csv line 2: mean_burst is too short",
    ),
    "chains without numbers": (
        'loss = { kind = "gilbert-elliott", path = "s.csv" }',
        "sender,receiver\n0,1\n1,0\n",
        "s.csv line 2: to_bad is missing",
    ),
    "other transitions": (
        'loss = { kind = "gilbert-elliott", path = "s.csv", shared = true, mean_loss = 0.1, '
        "mean_burst = 2.0 }",
        "sender,receiver,mean_loss,mean_burst\n0,1,0.2,3\n0,2,0.2,4\n",
        "must give all links of a sender the same transitions",
    ),
    "directions that cannot differ": (
        'loss = { kind = "gilbert-elliott", path = "s.csv", mean_loss = 0.1, mean_burst = 2.0 }',
        "sender,receiver,to_bad,to_good\n0,1,0.2,0.3\n1,0,0.2,0.4\n",
        "must give both directions of a link one to_bad and one to_good",
    ),
    "a direction without rows": (
        'channels = { hopping = [11], path = "s.csv" }',
        "sender,receiver,channel,delivery\n0,1,11,0.5\n",
        "must have a row of each direction on each channel",
    ),
    "a channel without rows": (
        'channels = { hopping = [11, 12], path = "s.csv" }',
        "channel,delivery\n11,0.5\n",
        "network.channel.channels.hopping: needs rows of each channel in s.csv; got 12",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(scenario_of, case):
    channel, rows, words = REFUSALS[case]
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario_of(CLOCKS, channel, {"s.csv": rows}, at="links")
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@dataclasses.dataclass(frozen=True, eq=False)
class Half(SharedLoss):
    """Shares half as often as it says."""

    @property
    def fate_share(self):
        return 0.5 * self.share


@pytest.mark.slow
@pytest.mark.parametrize(("law", "expected"), [(SharedLoss, "holds"), (Half, "broken")])
def test_check_knows_the_share(scenario_of, law, expected):
    scenario = scenario_of(CLOCKS, *KINDS["shared"], horizon=60.0)
    channel = dataclasses.replace(scenario.network.channel, loss=law(delivery=0.6, share=0.7))
    network = dataclasses.replace(scenario.network, channel=channel)
    verdict = netkf.check(dataclasses.replace(scenario, network=network), runs=30, seed=1)
    rows = verdict.table.set_index("promise")["verdict"]
    assert rows["hearers of a broadcast lose it together as often as the scenario says"] == expected
    # The errors of all nodes are promised with the share, and measured so.
    if law is SharedLoss:
        assert "broken" not in set(rows), rows
