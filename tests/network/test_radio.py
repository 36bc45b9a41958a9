"""Radios: queues, dropped transmissions and frames against closed forms."""

import numpy as np
import pytest

import netkf
from netkf.engines.compiled.engine import CompiledEngine
from netkf.network.radio import Radio
from netkf.trace.schema import CODES
from tests.conftest import SCENARIOS
from tests.engines.agreement import assert_agree
from tests.engines.test_batches import assert_alone

SCENARIO = """
format = 1
name = "radio"
horizon = {horizon}
probe = 20.0
[plant]
kind = "diffusion"
A = [[-0.2]]
B = [[1.0]]
cov = [[1.0]]
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[0.1]]
sampling = {{ kind = "periodic", period = 10.0 }}
[network]
graph = {{ kind = "star", nodes = 4 }}
activation = {{ kind = "poisson", rate = 1.0, at = "nodes" }}
channel = {{ symmetric = false, loss = {{ {loss} }} }}
{radio}
[filter]
kind = "hybrid"
epsilon = 0.2
"""


@pytest.fixture
def scenario_of(tmp_path):
    def make(radio, horizon=100.0, loss='kind = "none"'):
        path = tmp_path / "radio.toml"
        table = f"radio = {{ {radio} }}" if radio else ""
        path.write_text(SCENARIO.format(radio=table, horizon=horizon, loss=loss))
        return netkf.load(path)

    return make


def waits(run):
    """The ages of all messages that arrived from node 0, and the share of those it lost."""
    log = run.log
    arrived = log[(log["kind"] == CODES["deliver"]) & (log["peer"] == 0)]
    sent = ((log["kind"] == CODES["send"]) & (log["node"] == 0)).sum()
    lost = ((log["kind"] == CODES["lost"]) & (log["node"] == 0)).sum()
    return arrived["age"], lost / sent, sent


# A message of the hybrid filter is an estimate and its covariance: 2 numbers, 16 bytes, 128 bits.
AIR = 0.6


@pytest.mark.slow
def test_waiting_is_that_of_the_queue(scenario_of):
    # Poisson arrivals, constant service: the mean waiting time is D rho / (2 (1 - rho)).
    run = netkf.simulate(scenario_of(f"bits_per_second = {128 / AIR}", 8000.0), seed=1)
    ages, lost, _ = waits(run)
    assert lost == 0.0
    assert ages.min() == pytest.approx(AIR, abs=1e-9)
    # The three hearers of a broadcast hear it at one time.
    waiting = np.sort(ages)[::3] - AIR
    expected = AIR * AIR / (2.0 * (1.0 - AIR))
    # Neighbours wait alike: batches of 500 are nearly independent.
    order = (
        run.log[(run.log["kind"] == CODES["deliver"]) & (run.log["peer"] == 0)]["age"][::3] - AIR
    )
    batches = order[: len(order) // 500 * 500].reshape(-1, 500).mean(axis=1)
    deviation = batches.std(ddof=1) / np.sqrt(len(batches))
    assert waiting.mean() == pytest.approx(expected, abs=4.5 * deviation)
    assert expected > 9.0 * deviation


@pytest.mark.slow
def test_a_busy_radio_drops(scenario_of):
    # Of Poisson arrivals at a single server the share rho / (1 + rho) finds it busy.
    radio = f'bits_per_second = {128 / AIR}, queue = "drop"'
    run = netkf.simulate(scenario_of(radio, 8000.0), seed=1)
    ages, lost, sent = waits(run)
    assert np.ptp(ages) < 1e-9
    expected = AIR / (1.0 + AIR)
    assert lost == pytest.approx(
        expected, abs=4.5 * np.sqrt(expected * (1 - expected) / (sent / 3))
    )


def test_an_infinite_rate_is_no_radio(scenario_of):
    prints = [
        netkf.simulate(scenario_of(radio), seed=2, engine="simpy").fingerprint
        for radio in ("", "frame_bytes = 16", "bits_per_second = 1e18")
    ]
    assert len(set(prints)) == 1


@pytest.mark.slow
def test_all_frames_must_arrive(scenario_of):
    # 2 numbers of 10 bytes in frames of 8 bytes: 3 frames.
    loss = 'kind = "bernoulli", delivery = 0.8'
    radio = "frame_bytes = 8, bytes_per_number = 10"
    scenario = scenario_of(radio, 5000.0, loss)
    assert scenario.mean_delivery((0, 1)) == pytest.approx(0.8**3)
    assert scenario.transmission((0, 1)).hearers == (1, 2, 3)
    _, lost, sent = waits(netkf.simulate(scenario, seed=3))
    assert 1.0 - lost == pytest.approx(0.8**3, abs=4.5 * 0.5 / np.sqrt(sent))
    table = netkf.check(scenario_of(radio, 60.0, loss), runs=20, seed=1).table
    assert "broken" not in set(table["verdict"])


@pytest.mark.slow
def test_check_of_a_busy_radio_promises_nothing_of_arrivals(scenario_of):
    for queue in ("wait", "drop"):
        radio = f'bits_per_second = {128 / AIR}, queue = "{queue}"'
        table = netkf.check(scenario_of(radio, 60.0), runs=20, seed=1).table
        assert "broken" not in set(table["verdict"]), table[table["verdict"] == "broken"]


def test_a_filter_that_exchanges_nothing_in_a_slot_has_no_longest_message():
    radio = {"bits_per_second": 20000.0, "queue": "drop"}
    scenario = netkf.load(SCENARIOS / "push_sum_planar.toml").replace({"network.radio": radio})
    assert scenario.longest_delay > 0.0
    for kind in ("central", "local"):
        assert scenario.replace({"filter": {"kind": kind}}).longest_delay == 0.0


@pytest.mark.one_in(2)
@pytest.mark.parametrize("radio", ["queue = 'wait'", "queue = 'drop'", "frame_bytes = 6"])
@pytest.mark.parametrize("at", ["nodes", "links", "readings"])
def test_both_engines_wait_alike(scenario_of, at, radio):
    """Transmissions of a node wait for each other whichever clock makes them; a node that is down
    makes none.
    """
    changes = {
        "network.activation": {"kind": "poisson", "rate": 1.5, "at": at},
        "network.channel.loss": {"kind": "shared", "delivery": 0.8, "share": 0.5},
        "network.lives": [{"nodes": [0], "kind": "crashes", "mean_up": 5.0, "mean_down": 2.0}],
        "sensors.0.sampling": {"kind": "poisson", "rate": 2.0},
    }
    if at == "readings":
        changes["network.activation"] = {"kind": "readings"}
    rate = f"bits_per_second = {128 / AIR}, {radio}"
    scenario = scenario_of(rate, 20.0).replace({**changes, "probe": 4.0})
    run = assert_agree(scenario)
    assert run.count("lost")
    arrived = run.log[run.log["kind"] == CODES["deliver"]]
    assert arrived["age"].min() >= AIR - 1e-9
    assert_alone(scenario, CompiledEngine(), 5, range(2), fingerprint=True)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_each_exchange_of_a_slot_has_messages_of_its_own_size(scenario_of, engine):
    plant = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 10.0, "cov": [[1.0]]}
    changes = {
        "plant": plant,
        "sensors": [{"nodes": [0, 1], "H": [[1.0]], "R": [[0.1]]}],
        "network.activation": {"kind": "broadcast"},
        "filter": {"kind": "diffusion-kalman"},
    }
    scenario = scenario_of("bits_per_second = 1280.0, frame_bytes = 8", 200.0).replace(changes)
    log, frames = netkf.simulate(scenario, engine=engine).log, set()
    for phase in (0, 1):
        size = scenario.message_size(0, phase)
        ages = log["age"][(log["kind"] == CODES["deliver"]) & (log["phase"] == phase)]
        np.testing.assert_allclose(ages, 8.0 * size / 1280.0, atol=1e-9)
        frames.add(Radio(frame_bytes=8).frames(size))
    assert len(frames) == 2
    lossy = {"network.channel.loss": {"kind": "bernoulli", "delivery": 0.7}}
    assert_agree(scenario.replace(lossy))


def test_messages_of_a_slot_in_several_frames_arrive_as_often_as_is_stated():
    """Three frames of the first exchange, one of each of the next three: .7^3 and .7."""
    planar = netkf.load(SCENARIOS / "push_sum_planar.toml")
    scenario = planar.replace({"network.radio": {"frame_bytes": 32}, "horizon": 10.0})
    stated = 0.25 * 0.7**3 + 0.75 * 0.7
    link = scenario.topology.directions[0]
    assert scenario.mean_delivery(link) == pytest.approx(stated)
    run = netkf.simulate(scenario)
    sent, heard = (int((run.log["kind"] == CODES[kind]).sum()) for kind in ("send", "deliver"))
    assert abs(heard / sent - stated) < 5.0 * np.sqrt(0.25 / sent)
    rows = netkf.check(scenario, runs=10).rows
    assert not [row.promise for row in rows if row.verdict == "broken"]


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_radio_is_free_at_the_instant_at_which_a_message_ends(scenario_of, engine):
    clock = {"kind": "periodic", "period": 0.1, "at": "nodes"}
    scenario = scenario_of('bits_per_second = 1280.0, queue = "drop"', 40.0)
    run = netkf.simulate(scenario.replace({"network.activation": clock}), engine=engine)
    assert run.count("send") == 6 * 399
    assert not run.count("lost")


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_radio_sends_from_the_instant_of_going_up_to_that_of_going_down(
    scenario_of, tmp_path, engine
):
    (tmp_path / "lives.csv").write_text("t,node,what\n0,0,down\n3,0,up\n5.5,0,down\n")
    changes = {
        "network.activation": {"kind": "periodic", "period": 1.0, "at": "nodes"},
        "network.lives": [{"nodes": [0], "kind": "recorded", "path": "lives.csv"}],
    }
    scenario = scenario_of("bits_per_second = 256.0", 20.0).replace(changes)
    log = netkf.simulate(scenario, engine=engine).log
    heard = log[(log["kind"] == CODES["deliver"]) & (log["node"] == 1)]
    assert heard["t"].tolist() == [3.5, 4.5, 5.5]


def test_deliveries_of_several_frames(scenario_of, tmp_path):
    """Means over states of a link or over channels say nothing of their powers."""
    frames, mean = "frame_bytes = 8, bytes_per_number = 10", 'kind = "bernoulli", delivery = 0.8'
    bernoulli = scenario_of(frames, loss=mean)
    assert bernoulli.mean_delivery((0, 1)) == pytest.approx(0.8**3)
    bursts = 'kind = "gilbert-elliott", mean_loss = 0.2, mean_burst = 3.0'
    assert np.isnan(scenario_of(frames, loss=bursts).mean_delivery((0, 1)))
    (tmp_path / "h.csv").write_text("channel,delivery\n1,0.5\n2,1.0\n")
    hops = {"network.channel.channels": {"hopping": [1, 2], "path": "h.csv"}}
    assert np.isnan(bernoulli.replace(hops).mean_delivery((0, 1)))
    assert scenario_of("", loss=mean).replace(hops).mean_delivery((0, 1)) == pytest.approx(0.6)


def test_frames_are_counted():
    assert [Radio(frame_bytes=8).frames(size) for size in (0, 1, 8, 9, 16, 17)] == [
        1,
        1,
        1,
        2,
        2,
        3,
    ]


@pytest.mark.parametrize("queue", ["wait", "drop"])
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_radios_send_what_nobody_hears_and_nothing_of_nodes_that_are_down(
    scenario_of, tmp_path, engine, queue
):
    radio = f'bits_per_second = {128 / AIR}, queue = "{queue}"'
    # Every second node 1 is out of range.
    rows = [f"{t},1,{t % 2},0" for t in range(200)]
    (tmp_path / "places.csv").write_text("\n".join(["t,node,x,y", "0,0,0,0", *rows]))
    changes = {
        "network.graph": {"kind": "range", "radius": 0.5},
        "network.positions": "places.csv",
        "network.lives": [{"nodes": [0], "kind": "crashes", "mean_up": 4.0, "mean_down": 2.0}],
    }
    run = netkf.simulate(scenario_of(radio, 200.0).replace(changes), seed=4, engine=engine)
    rows = run.events[run.events.node == 0]
    falls, sent = rows.t[rows.kind == "crash"], rows[rows.kind == "send"].set_index("t").message
    free, arrivals, lost, fell, unheard = 0.0, {}, set(), 0, 0
    for t in rows.t[rows.kind == "transmit"]:
        down, begin = min(falls[falls > t], default=np.inf), max(t, free)
        if begin == t or queue == "wait":
            free, fell = min(begin + AIR, down), fell + (begin + AIR > down)
        arrives = begin + AIR <= down and (begin == t or queue == "wait")
        unheard += t not in sent.index
        if t in sent.index and arrives:
            arrivals[sent[t]] = begin + AIR
        elif t in sent.index:
            lost.add(sent[t])
    assert fell > 5
    assert unheard > 5
    heard = run.events[(run.events.kind == "deliver") & (run.events.node == 1)]
    expected = {number: t for number, t in arrivals.items() if t < 200.0}
    assert dict(zip(heard.message, heard.t, strict=True)) == pytest.approx(expected, abs=1e-9)
    assert set(rows.message[rows.kind == "lost"]) == lost
