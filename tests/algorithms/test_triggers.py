"""Event triggers: what they send, what silence says, and streams that nothing else draws from."""

import math
from dataclasses import replace
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest

import netkf
from netkf.algorithms.filter import Exchange, Reading
from netkf.algorithms.stochastic_trigger import ScheduledReadings, TriggeredMessages
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, store
from netkf.scenario.reading import from_table
from netkf.scenario.schema import scenario_schema
from netkf.scenario.writing import as_table, to_toml
from netkf.trace.schema import CODES
from tests.algorithms.test_literature import ALL, GRAPH, scenario_of, states
from tests.algorithms.test_track_fusion import kalman

EVENT = {"kind": "event-triggered", "trigger": "consensus", "thresholds": [1.0, 3.0]}
SURE = {"graph": GRAPH, "activation": {"kind": "broadcast"}}
STOCHASTIC = {
    **{"kind": "event-triggered", "trigger": "stochastic", "Y": 2.0},
    "inner": {"kind": "intermittent"},
}


@pytest.mark.parametrize("seed", range(3))
def test_without_thresholds_it_is_consensus_on_information(seed, tmp_path):
    """Sends in every slot, and with losses too."""
    ours = {**EVENT, "thresholds": [0.0, 0.0]}
    hcmci = {"kind": "hcmci", "consensus": "information"}
    xhat, P = states(ours, tmp_path, seed=seed, network=SURE)
    x, C = states(hcmci, tmp_path, seed=seed, network=SURE)
    np.testing.assert_allclose(xhat, x, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(P, C, rtol=1e-10, atol=1e-12)


def test_event_triggers_by_plain_formulas(tmp_path):
    """Who is silent, and what is used in its place: the whole filter once more."""
    alpha, delta = 1.5, 2.0
    algorithm = {**EVENT, "thresholds": [alpha, delta]}
    scenario = scenario_of(algorithm, tmp_path, 1, network=SURE, horizon=12.0, probe=1.0)
    run = netkf.simulate(scenario)
    N, F, Q = 5, scenario.plant.F, scenario.plant.Q
    sends = run.log[run.log["kind"] == CODES["send"]]
    happened = {(int(t), node) for t, node in zip(sends["t"], sends["node"], strict=True)}
    degrees, readings = scenario.topology.degrees, readings_of(scenario, run)
    x, P = [np.zeros(2)] * N, [scenario.plant.cov] * N
    last, silent = {}, 0
    for slot in range(1, 12):
        x, P = [F @ one for one in x], [F @ C @ F.T + Q for C in P]
        last = {j: (F @ m, F @ C @ F.T + Q) for j, (m, C) in last.items()}
        for j, reading in readings(slot).items():
            x[j], P[j] = kalman(x[j], P[j], reading)
        pairs = {}
        for j in range(N):
            if j in last:
                d, ratios = x[j] - last[j][0], np.linalg.eigvals(np.linalg.inv(P[j]) @ last[j][1])
                near = d @ np.linalg.inv(P[j]) @ d < alpha
                near &= ratios.min() >= 1.0 / (1.0 + delta) and ratios.max() <= 1.0 + delta
            if j not in last or not near:
                last[j] = pairs[j] = x[j], P[j]
                assert (slot, j) in happened
            else:
                factor = (1.0 + math.sqrt(alpha)) ** 2 * (1.0 + delta)
                pairs[j] = last[j][0], factor * last[j][1]
                assert (slot, j) not in happened
                silent += 1
        made = []
        for i in range(N):
            near_by = [b if a == i else a for a, b in scenario.topology.links if i in (a, b)]
            weights = {j: 1.0 / (1.0 + max(degrees[i], degrees[j])) for j in near_by}
            own = 1.0 - sum(weights.values())
            inverse = own * np.linalg.inv(P[i])
            vector = inverse @ x[i]
            for j, weight in weights.items():
                inverse = inverse + weight * np.linalg.inv(pairs[j][1])
                vector = vector + weight * np.linalg.inv(pairs[j][1]) @ pairs[j][0]
            C = np.linalg.inv(inverse)
            made.append((C @ vector, C))
        x, P = map(list, zip(*made, strict=True))
        np.testing.assert_allclose(run.P[slot], P, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(run.xhat[slot], x, rtol=1e-9, atol=1e-9)
    assert silent > 5


def readings_of(scenario, run):
    """A function from slots, in their order, to (y, H, R) by node."""
    from netkf.rng.streams import Streams

    streams = Streams(run.seed, run.replica)
    paths = {
        i: [(scenario.slot_path(streams, i, p), scenario.sensors[p.entry]) for p in places]
        for i, places in scenario.placed_sensors.items()
    }

    def read(slot):
        found = {}
        for i, some in paths.items():
            y = np.concatenate([path.reading(slot, run.x[slot]) for path, _ in some])
            H = np.concatenate([sensor.H for _, sensor in some])
            sizes = np.cumsum([0, *(len(sensor.R) for _, sensor in some)])
            R = np.zeros((len(y), len(y)))
            for a, b, (_, sensor) in zip(sizes, sizes[1:], some, strict=False):
                R[a:b, a:b] = sensor.R
            found[i] = y, H, R
        return found

    return read


def test_event_triggers_send_less_and_claim_no_more(tmp_path):
    scenario = scenario_of(EVENT, tmp_path, 1, network=SURE, horizon=31.0, probe=[10.0, 20.0, 30.0])
    runs = [netkf.simulate(scenario, replica=k) for k in range(60)]
    sent = np.mean([run.count("send") for run in runs])
    assert sent < 0.8 * 30 * 2 * len(scenario.topology.links)
    e, P = np.stack([run.error for run in runs]), np.stack([run.P for run in runs])
    nees = np.einsum("rtia,rtiab,rtib->rti", e, np.linalg.inv(P), e).mean(axis=0)
    # Mean 2 with 60 runs: standard error 0.26.
    assert nees.max() < 2.0 + 4.5 * 2.0 / math.sqrt(60)


def test_stochastic_triggers_by_plain_formulas(tmp_path):
    scenario = scenario_of(STOCHASTIC, tmp_path, 1, network=ALL, horizon=20.0, probe=1.0)
    run = netkf.simulate(scenario)
    F, Q = scenario.plant.F, scenario.plant.Q
    sends = run.log[run.log["kind"] == CODES["send"]]
    happened = {(int(t), node) for t, node in zip(sends["t"], sends["node"], strict=True)}
    readings, x, P, silent = readings_of(scenario, run), np.zeros(2), scenario.plant.cov, 0
    for slot in range(1, 20):
        x, P = F @ x, F @ P @ F.T + Q
        prior = x
        for i, (y, H, R) in readings(slot).items():
            if (slot, i) in happened:
                x, P = kalman(x, P, (y, H, R))
            else:
                x, P = kalman(x, P, (H @ prior, H, R + np.eye(len(H)) / STOCHASTIC["Y"]))
                silent += 1
        np.testing.assert_allclose(run.P[slot], [P] * 5, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(run.xhat[slot], [x] * 5, rtol=1e-9, atol=1e-10)
    assert silent > 15


SCALAR = {
    "plant": {"kind": "linear", "F": [[0.9]], "Q": [[0.5]], "cov": [[1.0]], "period": 1.0},
    "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[0.4]]}],
    "network": {
        "graph": {"kind": "edges", "edges": [[0, 1]]},
        "activation": {"kind": "broadcast"},
    },
}


def test_the_rate_is_that_of_han_and_errors_are_as_large_as_p_says(tmp_path):
    """1 - det(I + Pi Y)^-1/2 given the past, summed over a long run; NEES of mean n."""
    more = {"horizon": 4001.0, "probe": 1.0, **SCALAR}
    scenario = scenario_of(STOCHASTIC, tmp_path, n=1, **more)
    run = netkf.simulate(scenario)
    # Pi from the P of the slot before, from the second slot with an exchange on.
    P = 0.81 * run.P[1:-2, 1, 0, 0] + 0.5
    p = 1.0 - 1.0 / np.sqrt(1.0 + (P + 0.4) * STOCHASTIC["Y"])
    sends = run.log[(run.log["kind"] == CODES["send"]) & (run.log["node"] == 0)]
    count = len(sends) - 1
    z = (count - p.sum()) / math.sqrt((p * (1.0 - p)).sum())
    assert 0.3 < p.mean() < 0.8
    assert abs(z) < 4.0
    # Errors one slot apart correlate: at most 0.9.
    nees = run.error[1:, 1, 0] ** 2 / run.P[1:, 1, 0, 0]
    assert abs(nees.mean() - 1.0) < 4.0 * math.sqrt(2.0 / len(nees) * (1.0 + 0.81) / (1.0 - 0.81))


def test_triggers_move_no_other_stream(tmp_path):
    """Truth, readings, losses are those of a filter that always sends."""
    network = {**ALL, "channel": {"loss": {"kind": "bernoulli", "delivery": 0.7}}}
    runs = [
        netkf.simulate(scenario_of(filter_, tmp_path, 2, network=network), engine="simpy")
        for filter_ in (STOCHASTIC, EVENT, {"kind": "kcf"})
    ]
    delivered = []
    for run in runs:
        rows = run.log[run.log["kind"] == CODES["deliver"]]
        delivered.append(set(rows[["t", "node", "peer"]].tolist()))
    for run, heard in zip(runs[:2], delivered[:2], strict=True):
        np.testing.assert_array_equal(run.x, runs[2].x)
        assert heard < delivered[2]


def test_a_note_says_that_links_should_be_sure(tmp_path):
    lossy = scenario_of(EVENT, tmp_path)
    assert any("messages may be lost" in note for note in lossy.notes)


def table_of(scenario, runs=10):
    found = netkf.check(scenario, runs, confidence=0.999, workers=1)
    return found.table.set_index("promise")


RATE = "nodes send with probability 1 - det(I + Pi Y)^-1/2"
SILENCE = "P is the covariance of the error, given the events"


def test_theory_follows_silence_and_checks_the_rate(tmp_path):
    """A reading with the noise R + Y^-1 more stands for silence; losses break what is promised."""
    scenario = scenario_of(
        STOCHASTIC, tmp_path, 1, network=ALL, horizon=15.0, probe=[2.0, 9.0, 14.0]
    )
    run = netkf.simulate(scenario)
    np.testing.assert_allclose(netkf.theory.error_covariance(scenario, run), run.P, rtol=1e-9)
    table = table_of(scenario, 40)
    assert set(table["verdict"]) <= {"holds", "undecided"}
    assert table.loc[SILENCE, "verdict"] == "holds"
    assert table.loc[RATE, "seen"] == pytest.approx(1.0, abs=0.2)
    lossy = scenario_of(STOCHASTIC, tmp_path, 1, horizon=9.0)
    verdicts = table_of(lossy)["verdict"]
    assert verdicts[[SILENCE, RATE]].tolist() == ["not promised", "not promised"]


@pytest.mark.slow
def test_nodes_that_send_too_often_break_the_rate(tmp_path, monkeypatch):
    """Coins that fall on silence half as often as they should."""
    emit = ScheduledReadings.kernels.emit

    @kernel
    def eager(record, h, m, run):
        store(run.lanes, run.uniform, 0.5 + 0.5 * load(run.lanes, run.uniform))
        emit(record, h, m, run)

    monkeypatch.setattr(
        ScheduledReadings, "kernels", replace(ScheduledReadings.kernels, emit=eager)
    )
    scenario = scenario_of(STOCHASTIC, tmp_path, 1, network=ALL, horizon=15.0)
    assert table_of(scenario, 20).loc[RATE, "verdict"] == "broken"


def test_the_rate_in_closed_form():
    """Han et al. for one row, ``1 - (1 + pi y)^-1/2``, and by integration for two."""
    assert netkf.theory.trigger_rate([[2.0]], [[1.0]], [[0.5]], [[3.0]]) == pytest.approx(
        1.0 - 1.0 / math.sqrt(1.0 + 2.5 * 3.0), rel=1e-12
    )
    H, R, Y = np.array([[1.0], [0.3]]), np.array([[0.5, 0.1], [0.1, 0.4]]), np.diag([2.0, 0.5])
    L = np.linalg.cholesky(2.0 * H @ H.T + R)
    x, w = np.polynomial.hermite_e.hermegauss(160)
    z = np.stack(np.meshgrid(x, x), axis=-1) @ L.T
    silent = (np.outer(w, w) * np.exp(-0.5 * np.einsum("abi,ij,abj->ab", z, Y, z))).sum()
    expected = 1.0 - silent / (2.0 * math.pi)
    assert netkf.theory.trigger_rate([[2.0]], H, R, Y) == pytest.approx(expected, rel=1e-10)


def test_what_is_promised_of_event_triggers(tmp_path):
    bound = "P is at least the second moment of the error: the mean NEES is at most n"
    for network, verdicts in ((SURE, ("holds", "undecided")), ({}, ("not promised",))):
        more = {"network": network} if network else {}
        table = table_of(scenario_of(EVENT, tmp_path, 1, horizon=9.0, **more), 30)
        assert table.loc[bound, "verdict"] in verdicts


def wrapped(inner, Y):
    return {"kind": "event-triggered", "trigger": "stochastic", "inner": inner, "Y": Y}


INNER = [
    {"kind": "hcmci", "steps": 2},
    {"kind": "diffusion-kalman"},
    {"kind": "push-sum", "gamma": 2, "delta": 5.0},
    {"kind": "track-fusion", "rule": "cross-covariance"},
]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("inner", INNER, ids=[str(one["kind"]) for one in INNER])
def test_a_trigger_that_always_fires_changes_nothing(inner, tmp_path):
    """And one that never does leaves the first slot with a reading, and those without sensors."""
    alone, always, never = (
        netkf.simulate(scenario_of(table, tmp_path, 2), engine="simpy")
        for table in (inner, wrapped(inner, 1e30), wrapped(inner, 1e-30))
    )
    np.testing.assert_array_equal(always.xhat, alone.xhat)
    np.testing.assert_array_equal(always.P, alone.P)
    assert always.count("send") == alone.count("send")
    sends = never.log[never.log["kind"] == CODES["send"]]
    # Node 4 of the scenario has no sensor.
    assert set(sends["node"][sends["t"] >= 3.0].tolist()) == {4}
    assert set(sends["node"].tolist()) == {0, 1, 2, 3, 4}


def test_nodes_around_another_filter_send_as_often_as_their_innovations_say(tmp_path):
    """The sum of the probabilities ``1 - exp(-z' Y z / 2)`` given all that happened before."""
    more = {"horizon": 2001.0, "probe": 1.0, **SCALAR}
    scenario = scenario_of(wrapped({"kind": "hcmci", "steps": 2}, [[1.5]]), tmp_path, n=1, **more)
    run = netkf.simulate(scenario)
    readings = readings_of(scenario, run)
    z = [readings(slot)[0][0][0] - 0.9 * run.xhat[slot - 1, 0, 0] for slot in range(1, 2001)]
    p = 1.0 - np.exp(-0.5 * 1.5 * np.square(z[1:]))
    sends = run.log[(run.log["kind"] == CODES["send"]) & (run.log["node"] == 0)]
    # Two steps a slot; the first slot sends in any case.
    count = len(sends) / 2 - 1
    assert 0.3 < p.mean() < 0.8
    assert abs(count - p.sum()) < 4.0 * math.sqrt((p * (1.0 - p)).sum())


@pytest.mark.parametrize(
    ("table", "key"),
    [
        (wrapped({"kind": "central"}, 1.0), "filter.inner"),
        (wrapped({"kind": "hybrid", "epsilon": 0.2}, 1.0), "filter"),
        (wrapped(STOCHASTIC, 1.0), "filter.inner"),
        (wrapped({"kind": "kcf", "epsilon": -1.0}, 1.0), "filter.inner.epsilon"),
        (wrapped({"kind": "nothing"}, 1.0), "filter.inner.kind"),
        (wrapped(3, 1.0), "filter.inner"),
        (wrapped({"kind": "kcf"}, [[1.0, 0.0], [0.0, 0.0]]), "filter.Y"),
        (wrapped({"kind": "kcf"}, np.eye(5).tolist()), "filter.Y"),
        (wrapped({"kind": "kcf"}, -1.0), "filter.Y"),
        ({**EVENT, "inner": {"kind": "hcmci", "steps": 2}}, "filter.inner"),
        ({**EVENT, "thresholds": [1.0]}, "filter.thresholds"),
        ({**EVENT, "thresholds": [1.0, -1.0]}, "filter.thresholds"),
        ({"kind": "event-triggered", "Y": 1.0}, "filter.trigger"),
        ({**EVENT, "trigger": "sometimes"}, "filter.trigger"),
        ({"kind": "track-fusion"}, "filter.rule"),
        ({"kind": "track-fusion", "rule": ["ci"]}, "filter.rule"),
    ],
)
def test_wrong_settings_are_refused_by_their_key(table, key, tmp_path):
    with pytest.raises(netkf.ScenarioError) as refused:
        scenario_of(table, tmp_path)
    assert str(refused.value).startswith(key)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "table", [STOCHASTIC, EVENT, wrapped({"kind": "track-fusion", "rule": "ici"}, [[2.0]])]
)
def test_filters_within_filters_are_written_as_they_are_read(table, tmp_path):
    sensors = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.3]]}]
    scenario = scenario_of(table, tmp_path, sensors=sensors)
    jsonschema.validate(as_table(scenario), scenario_schema())
    (tmp_path / "again.toml").write_text(to_toml(as_table(scenario)))
    assert netkf.load(tmp_path / "again.toml").filter == scenario.filter
    assert scenario.replace({"filter": table}).filter == scenario.filter


def test_after_its_first_reading_a_node_sends_whatever_it_has_told_before():
    """A filter in plain Python: without a reading a node tells what it knows."""
    inner = SimpleNamespace(
        init=lambda *_: None,
        update=lambda state, _: state,
        emit=lambda state, _: (state, "told"),
        estimate=lambda _: (np.zeros(1), np.eye(1)),
    )
    triggered, told = TriggeredMessages(1.0, inner), []
    state = triggered.init(None, np.zeros(1), np.eye(1), None)
    for reads in (False, True, True):
        if reads:
            reading = Reading(np.array([0.1]), np.eye(1), np.eye(1), 1.0)
            state = triggered.update(state, reading)
        state, payload = triggered.emit(state, Exchange(1.0, uniform=0.0))
        told.append(payload)
    assert told == ["told", "told", None]


@pytest.mark.parametrize("several", [False, True])
def test_rows_of_one_record_are_there_together(several, tmp_path):
    """A matrix Y weighs all rows of a node, of which those of one of two records may be missing."""
    (tmp_path / "y.csv").write_text("t,node,y0,y1\n1,0,0.5,0.1\n2,0,0.3,0.2\n")
    one = {"kind": "recorded", "nodes": [0], "path": "y.csv", "R": [[1.0, 0.0], [0.0, 1.0]]}
    sensors = [{**one, "H": [[1.0, 0.0], [0.0, 1.0]]}] * (1 + several)
    table = {
        "format": 1, "name": "rows", "horizon": 4.0, "probe": 1.0, "sensors": sensors,
        "plant": {"kind": "unknown", "F": [[0.9, 0.0], [0.1, 0.8]], "period": 1.0,
                  "Q": [[1.0, 0.0], [0.0, 1.0]], "cov": [[1.0, 0.0], [0.0, 1.0]]},
        "network": {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        "filter": {"kind": "event-triggered", "trigger": "stochastic", "inner": {"kind": "kcf"},
                   "Y": np.eye(2 + 2 * several).tolist()},
    }  # fmt: skip
    if not several:
        assert netkf.simulate(from_table(table, tmp_path), engine="simpy").count("send")
        return
    with pytest.raises(netkf.ScenarioError, match="because some rows of the readings of node 0"):
        from_table(table, tmp_path)
