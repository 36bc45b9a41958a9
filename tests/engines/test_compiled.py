"""The compiled engine: the events and states of the processes engine, and words where it cannot."""

import dataclasses
import os
import tomllib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st

import netkf
from netkf.algorithms.hybrid import Hybrid
from netkf.core.errors import EngineError, ScenarioError
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.linalg import compiling
from netkf.linalg.compiling import kernel
from netkf.network.channels import ChannelSampler
from netkf.network.clocks import Poisson
from netkf.network.losses import Bernoulli
from netkf.rng.streams import Streams
from netkf.scenario.reading import from_table
from netkf.trace.recorder import Fingerprint, MemorySink, Recorder
from netkf.trace.schema import EVENT
from tests.conftest import ANNOUNCE, SCENARIOS, scenario_files, with_slow
from tests.engines.agreement import assert_agree

SHORT = {
    "intel_lab.toml": 1.5,
    "intel_lab_radio.toml": 3.0,
    "diffusion_regression.toml": 300.0,
    "ulb_library.toml": 600.0,
}


LONG = [SCENARIOS / "intel_lab.toml"]
"""Its event loop is compiled for nothing else."""


@pytest.mark.one_in(6)
@pytest.mark.parametrize("file", with_slow(scenario_files(), LONG), ids=lambda file: file.stem)
def test_every_scenario_agrees(file):
    scenario = netkf.load(file)
    refusal = CompiledEngine().refusal(scenario)
    if refusal is not None:
        pytest.skip(refusal)
    horizon = min(scenario.horizon, SHORT.get(file.name, 40.0))
    assert_agree(scenario.replace({"horizon": horizon}))


@pytest.mark.one_in(6)
@pytest.mark.parametrize(
    "file",
    [f for f in scenario_files() if tomllib.loads(f.read_text())["filter"]["kind"] == "hybrid"],
    ids=lambda file: file.stem,
)
def test_every_scenario_in_continuous_time_agrees_with_covariance_intersection(file):
    scenario = netkf.load(file).replace({"filter.kind": "covariance-intersection"})
    horizon = min(scenario.horizon, SHORT.get(file.name, 20.0))
    assert assert_agree(scenario.replace({"horizon": horizon})).count("absorb") > 50


STOPPING = [(1e-2, "fresh"), (1e-6, "held"), (1e-16, "fresh"), (0.0, "held")]
SLOTS = {
    "local": ("gossip_ring", {"filter": {"kind": "local"}}),
    "central": ("gossip_ring", {"filter": {"kind": "central"}}),
    "own fates": ("push_sum_planar", {"network.channel.symmetric": False, "filter.gamma": 3}),
    "drift": ("push_sum_planar", {"network.channel.symmetric": False, "probe": [3.0]}),
    "held": ("push_sum_planar", {"filter.links": "held", "filter.gamma": 3}),
    "limits": ("push_sum_planar", {"filter.asymptotic": True}),
    "lossless": ("push_sum_planar", {"network.channel.loss": {"kind": "none"}}),
    "late": ("gossip_ring", {"network.channel.delay": {"kind": "exponential", "mean": 0.2}}),
    "wakeup": ("gossip_ring", {"network.activation.protocol": "node-wakeup"}),
    "lazy": (
        "gossip_ring",
        {"network.activation": {"kind": "matching", "protocol": "one-edge", "lazy": 0.5}},
    ),
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SLOTS)
@pytest.mark.parametrize("rows", [1 << 15, 50])
def test_slots_made_together_agree(monkeypatch, name, rows):
    """Also where few are made at once."""
    monkeypatch.setattr("netkf.engines.compiled.slot_run.MAX_EVENT_ROWS", rows)
    file, changes = SLOTS[name]
    scenario = netkf.load(SCENARIOS / f"{file}.toml")
    assert_agree(scenario.replace({"horizon": 12.0 * scenario.slot_plant.period, **changes}))


@pytest.mark.one_in(10)
@pytest.mark.parametrize(
    ("stop", "tolerance", "links"),
    [
        *((stop, size, links) for stop in ("safe", "paper") for size, links in STOPPING),
        ("safe", 1e-16, "held"),
        ("paper", 1e-2, "held"),
    ],
)
def test_push_sum_stops_in_the_same_slots(stop, tolerance, links):
    """1e-16 is where rounding decides; more are drawn below."""
    planar = netkf.load(SCENARIOS / "push_sum_planar.toml")
    rule = {"filter.stop": stop, "filter.tolerance": tolerance, "filter.links": links}
    ways = {"network.channel.symmetric": links == "fresh"}
    run = assert_agree(planar.replace({"horizon": 15.0, **rule, **ways}))
    stops = tolerance >= 1e-6 or (stop == "paper" and tolerance > 0.0)
    assert run.count("stop") == (10 if stops else 0)


def entries(rows, columns, size=1.0):
    entry = st.floats(-size, size).map(lambda value: round(value, 2))
    row = st.lists(entry, min_size=columns, max_size=columns)
    return st.lists(row, min_size=rows, max_size=rows)


CLOCKS = st.sampled_from(
    [
        {"kind": "poisson", "rate": 3.0},
        {"kind": "poisson", "rate": 1.0, "rates": [[0, 1, 9.0]]},
        {"kind": "renewal", "distribution": "gamma", "shape": 3.0, "mean": 0.3},
        {"kind": "renewal", "distribution": "weibull", "shape": 0.8, "rate": 3.0},
        {"kind": "renewal", "distribution": "uniform", "low": 0.1, "high": 0.5},
        {"kind": "renewal", "distribution": "constant", "mean": 0.25},
        {"kind": "periodic", "period": 0.25},
        {"kind": "periodic", "period": 0.2, "phase": "random", "jitter": 0.1},
    ]
)
LOSSES = st.sampled_from(
    [
        {"kind": "none"},
        {"kind": "bernoulli", "delivery": 0.6},
        {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 2.5},
    ]
)
DELAYS = st.sampled_from(
    [
        {"kind": "none"},
        {"kind": "constant", "seconds": 0.25},
        {"kind": "exponential", "mean": 0.3},
        {"kind": "uniform", "low": 0.0, "high": 0.6},
        {"kind": "lognormal", "mean": 0.2, "sigma": 1.0},
    ]
)
GRAPHS = st.sampled_from(
    [
        {"kind": "path", "nodes": 2},
        {"kind": "cycle", "nodes": 4},
        {"kind": "complete", "nodes": 4},
        {"kind": "edges", "edges": [[0, 1], [1, 7], [7, 9], [0, 9], [0, 7]]},
    ]
)
FILTERS = st.sampled_from(
    [
        {"kind": "hybrid", "epsilon": 0.25},
        {"kind": "hybrid", "epsilon": 0.25, "model": {"R": [[3.0]]}},
        {"kind": "covariance-intersection", "epsilon": 0.25},
        {"kind": "covariance-intersection", "epsilon": 0.3, "model": {"R": [[3.0]]}},
        {"kind": "local"},
        {"kind": "central"},
    ]
)
PROBES = st.sampled_from([0.5, 0.37, [0.0, 0.111, 0.112, 1.9], [3.0]])


@st.composite
def scenarios(draw):
    n = draw(st.integers(1, 2))
    sensors = [
        {"nodes": nodes, "H": draw(entries(1, n)), "R": [[draw(st.floats(0.01, 1.0))]]}
        for nodes in ([0], [0, 1])
    ]
    start = np.eye(n) * draw(st.sampled_from([0.0, 1.0, 100.0]))
    plant = {"kind": "diffusion", "A": draw(entries(n, n)), "B": np.eye(n).tolist()}
    return {
        "format": 1,
        "name": "drawn",
        "horizon": 3.0,
        "seed": draw(st.integers(0, 2**20)),
        "probe": draw(PROBES),
        "plant": {**plant, "cov": start.tolist()},
        "sensors": sensors[: draw(st.integers(0, 2))],
        "network": {
            "graph": draw(GRAPHS),
            "activation": draw(CLOCKS),
            "channel": {
                "loss": draw(LOSSES),
                "delay": draw(DELAYS),
                "symmetric": draw(st.booleans()),
            },
        },
        "filter": draw(FILTERS),
    }


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(scenarios())
def test_drawn_scenarios_agree(tables):
    if tables["filter"]["kind"] in {"local", "central"}:
        del tables["network"]["activation"], tables["network"]["channel"]
    if tables["network"]["graph"].get("edges") and "rates" in tables["network"].get(
        "activation", {}
    ):
        tables["network"]["activation"] = {"kind": "poisson", "rate": 2.0}
    assert_agree(from_table(tables, SCENARIOS))


MATCHINGS = st.sampled_from(
    [
        {"protocol": "maximal"},
        {"protocol": "one-edge", "lazy": 0.3},
        {"protocol": "node-wakeup"},
        {"protocol": "independent", "p": 0.4},
    ]
)
SLOT_FILTERS = st.sampled_from(
    [
        {"kind": "gossip"},
        {"kind": "intermittent"},
        {"kind": "diffusion"},
        {"kind": "diffusion", "on_loss": "keep-own", "model": {"R": [[2.0]]}},
        {"kind": "push-sum", "gamma": 2, "delta": 4.0},
        {"kind": "push-sum", "gamma": 3, "delta": 5.0, "links": "held"},
        {"kind": "push-sum", "gamma": 1, "delta": 5.0, "asymptotic": True},
        {"kind": "local"},
        {"kind": "central"},
    ]
)

LITERATURE = st.sampled_from(
    [
        {"kind": "icf", "steps": 2},
        {"kind": "kcf", "epsilon": 0.3},
        {"kind": "diffusion-kalman"},
        {"kind": "one-bit"},
        {"kind": "track-fusion", "rule": "ci"},
        {"kind": "track-fusion", "rule": "cross-covariance"},
        {"kind": "belief-propagation", "steps": 2},
        {"kind": "consensus-innovations"},
        {"kind": "event-triggered", "trigger": "consensus"},
    ]
)

STOPS = st.fixed_dictionaries(
    {
        "kind": st.just("push-sum"),
        "gamma": st.integers(1, 2),
        "delta": st.just(5.0),
        "stop": st.sampled_from(["safe", "paper"]),
        "tolerance": st.sampled_from([0.5, 0.1, 1e-3, 1e-16]),
        "links": st.sampled_from(["fresh", "held"]),
        "leader": st.integers(0, 1),
        "asymptotic": st.sampled_from([False, False, False, True]),
    }
)


@st.composite
def slotted(draw, filters=SLOT_FILTERS):
    # Two states are unrolled, one and five share what is compiled for any number.
    n = draw(st.sampled_from([1, 2, 5]))
    F, H = np.array(draw(entries(n, n))), draw(entries(1, n))
    start = draw(st.sampled_from([0.5, 1.0, 100.0]))
    plant = {"kind": "linear", "F": (F + np.eye(n)).tolist(), "Q": np.eye(n).tolist()}
    regressor = {"kind": "regressor", "nodes": [1], "A": [[0.5]], "B": [[1.0]], "R": [[0.3]]}
    regressor |= {"C": np.ones((n, 1)).tolist(), "start": [1.0], "xi_cov": [[0.5]]}
    algorithm = draw(filters)
    others = [{"nodes": [0, 1], "H": np.ones((1, n)).tolist(), "R": [[1.0]]}]
    if algorithm["kind"] != "push-sum":  # which wants H to be fixed
        others.append(regressor)
    sensors = [
        {"nodes": [0], "H": H, "R": [[draw(st.floats(0.01, 1.0))]]},
        draw(st.sampled_from(others)),
    ]
    matched = algorithm["kind"] == "gossip"
    activation = {"kind": "matching", **draw(MATCHINGS)} if matched else {"kind": "broadcast"}
    channel = {"loss": draw(LOSSES), "delay": draw(DELAYS), "symmetric": draw(st.booleans())}
    network = {"graph": draw(GRAPHS), "activation": activation, "channel": channel}
    if algorithm["kind"] in {"local", "central"}:
        network = {"graph": network["graph"]}
    return {
        "format": 1,
        "name": "drawn",
        "horizon": 8.0,
        "seed": draw(st.integers(0, 2**20)),
        "probe": draw(st.sampled_from([1.0, 3.0, [0.0, 5.0]])),
        "plant": {**plant, "period": 1.0, "cov": (start * np.eye(n)).tolist()},
        "sensors": sensors,
        "network": network,
        "filter": algorithm,
    }


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(slotted(LITERATURE))
def test_drawn_scenarios_of_the_literature_agree(tables):
    try:
        scenario = from_table(tables, SCENARIOS)
    except ScenarioError:
        reject()
    assert_agree(scenario)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(slotted())
def test_drawn_scenarios_in_slots_agree(tables):
    try:
        scenario = from_table(tables, SCENARIOS)
    except ScenarioError:
        reject()
    assert_agree(scenario)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(slotted(STOPS))
def test_drawn_push_sum_that_stops_agrees(tables):
    try:
        scenario = from_table(tables, SCENARIOS)
    except ScenarioError:
        reject()
    run = assert_agree(scenario)
    assert run.count("stop") == 0 or not tables["filter"]["asymptotic"]


def test_recorded_slots_readings_and_late_messages_agree(tmp_path):
    (tmp_path / "pairs.csv").write_text("slot,node,peer\n1,0,1\n1,2,3\n2,1,2\n4,4,0\n4,2,1\n")
    ring = netkf.load(SCENARIOS / "gossip_ring.toml").replace({"horizon": 6.0, "probe": 1.0})
    recorded = {"kind": "recorded", "path": tmp_path / "pairs.csv"}
    run = assert_agree(ring.replace({"network.activation": recorded}))
    assert run.count("tick") == 5
    late = {"network.channel.delay": {"kind": "constant", "seconds": 0.6}}
    run = assert_agree(ring.replace(late))
    assert run.count("swap") == 0 < run.count("late")


@pytest.mark.parametrize("stop", ["never", "safe", "paper"])
def test_many_lots_of_slots_are_one_run(monkeypatch, stop):
    ring = netkf.load(SCENARIOS / "push_sum_planar.toml").replace({"horizon": 10.0})
    ring = ring.replace({"filter.stop": stop, "filter.tolerance": 1e-3})
    whole = netkf.simulate(ring, engine="compiled")
    monkeypatch.setattr("netkf.engines.compiled.slot_run.MAX_EVENT_ROWS", 100)
    pieces = netkf.simulate(ring, engine="compiled")
    assert pieces.fingerprint == whole.fingerprint
    assert pieces.sums == whole.sums
    np.testing.assert_array_equal(pieces.P, whole.P)


def test_growth_in_slots_is_reported_alike(build):
    plant = {"kind": "linear", "F": [[3.0]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]}
    network = {"graph": {"kind": "path", "nodes": 2}}
    grown = build(
        horizon=900.0,
        probe=50.0,
        plant=plant,
        network=network,
        filter={"kind": "local"},
        sensors=[{"nodes": [0], "H": [[1.0]], "R": [[0.5]]}],
    )
    assert assert_agree(grown).status == "diverged"


def test_recorded_ticks_and_losses_agree(ring, tmp_path):
    (tmp_path / "ticks.csv").write_text("t,node,peer\n0.5,0,1\n0.5,2,1\n0.75,5,0\n9.5,3,4\n")
    (tmp_path / "lost.csv").write_text("sender,receiver,message,delivered\n0,1,0,0\n5,0,0,0\n")
    changes = {
        "network.activation": {"kind": "recorded", "path": tmp_path / "ticks.csv"},
        "network.channel.loss": {"kind": "recorded", "path": tmp_path / "lost.csv"},
    }
    run = assert_agree(ring.replace(changes))
    assert run.count("lost") == 2
    assert run.count("tick") == 4


POISSON, TOGETHER = {"kind": "poisson", "rate": 40.0}, {"kind": "periodic", "period": 0.05}


@pytest.mark.parametrize(
    ("clock", "delay"),
    [
        (POISSON, {"kind": "exponential", "mean": 2.0}),
        (POISSON, {"kind": "none"}),
        (TOGETHER, {"kind": "none"}),
        (TOGETHER | {"at": "nodes"}, {"kind": "none"}),
        (TOGETHER, {"kind": "constant", "seconds": 0.2}),
    ],
)
def test_windows_rows_visits_and_mail_end_anywhere(ring, monkeypatch, clock, delay):
    """Whatever is handed over in blocks, the run does not change."""
    busy = ring.replace(
        {
            "horizon": 4.0,
            "network.activation": clock,
            "network.channel.delay": delay,
            "network.channel.symmetric": False,
        }
    )
    whole = netkf.simulate(busy, engine="compiled")
    module = "netkf.engines.compiled"
    monkeypatch.setattr("netkf.trace.recorder.BLOCK", 7)
    monkeypatch.setattr(f"{module}.flow.FIRST_ROWS", 6)
    monkeypatch.setattr(f"{module}.flow.FIRST_MESSAGES", 2)
    monkeypatch.setattr(f"{module}.flow.MAX_BUFFERED_SAMPLES", 2)
    for room in ("plants.paths", "engines.compiled.draws", "engines.compiled.flow"):
        monkeypatch.setattr(f"netkf.{room}.BLOCK", 3)
    monkeypatch.setattr(f"{module}.draws.MAX_STEP_BLOCKS", 1)
    monkeypatch.setattr(f"{module}.visits.MAX_VISITS", 1)
    monkeypatch.setattr(f"{module}.ticks.TICKS", 5)
    monkeypatch.setattr(f"{module}.ticks.MIN_TICKS_PER_ENTITY", 0)
    pieces = netkf.simulate(busy, engine="compiled")
    assert pieces.fingerprint == whole.fingerprint
    np.testing.assert_array_equal(pieces.P, whole.P)
    np.testing.assert_allclose(pieces.xhat, whole.xhat, rtol=0.0, atol=1e-12)  # of the path


@pytest.mark.parametrize("kind", ["intermittent", "push-sum", "hybrid"])
def test_messages_and_history_that_need_more_room(ring, monkeypatch, kind):
    clock = {"kind": "poisson", "rate": 9.0, "at": "nodes"}
    clock = {"kind": "readings"} if kind == "intermittent" else clock
    sampling = {"kind": "periodic", "period": 0.05}
    case = ring.replace(
        {
            "horizon": 4.0,
            "sensors.0.sampling": sampling,
            "network.activation": clock,
            "network.channel": {"delay": {"kind": "exponential", "mean": 0.7}},
            "filter": {"kind": kind, **({"epsilon": 0.3} if kind == "hybrid" else {})},
        }
    )
    monkeypatch.setattr("netkf.engines.compiled.flow.FIRST_MESSAGES", 1)
    monkeypatch.setattr("netkf.algorithms.records.FIRST_PAST", 1)
    monkeypatch.setattr("netkf.engines.compiled.ticks.TICKS", 30)
    monkeypatch.setattr("netkf.engines.compiled.ticks.MIN_TICKS_PER_ENTITY", 0)
    assert assert_agree(case).count("absorb") > 50


def test_growth_beyond_numbers_is_reported_alike(build):
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    grown = build(horizon=600.0, probe=10.0, plant=plant, filter={"kind": "local"})
    assert assert_agree(grown).status == "diverged"


@pytest.mark.slow
def test_covariances_beyond_all_bounds_take_their_time_and_no_more(build):
    """Far from the only sensor nobody knows anything, and resets bring it P of 1e20."""
    plant = {"kind": "diffusion", "A": [[0.0, 1.0], [-1.0, 0.2]], "B": [[0.0], [1.0]]}
    clock = {"graph": {"kind": "path", "nodes": 8}, "activation": {"kind": "poisson", "rate": 2.0}}
    far = build(
        horizon=300.0,
        probe=1.0,
        plant={**plant, "cov": [[1.0, 0.0], [0.0, 1.0]]},
        sensors=[{"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.1]]}],
        network=clock,
        filter={"kind": "hybrid", "epsilon": 0.02},
    )
    run = netkf.simulate(far, engine="compiled")
    assert run.P[-1, 7].max() > 1e25 > 1e3 > run.P[-1, 0].max()
    assert run.fingerprint == netkf.simulate(far, engine=SimpyEngine()).fingerprint


def test_replicas_side_by_side_are_those_one_after_the_other(ring):
    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(netkf.simulate, ring, replica=k, engine="compiled") for k in range(4)]
        beside = [job.result() for job in jobs]
    for k, run in enumerate(beside):
        alone = netkf.simulate(ring, replica=k, engine="compiled")
        assert run.fingerprint == alone.fingerprint
        np.testing.assert_array_equal(run.P, alone.P)


class Cautious(Hybrid):
    """A user's filter that is the hybrid one, with a method in plain Python."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)


class Halved(Bernoulli):
    """A user's loss: half of what it says."""

    def delivery_probability(self, sent):
        return 0.5 * super().delivery_probability(sent)


def test_a_filter_of_ones_own_is_refused_by_name_and_auto_takes_the_other(ring):
    algorithm = Cautious(epsilon=0.3)
    own = dataclasses.replace(ring, filter=dataclasses.replace(ring.filter, algorithm=algorithm))
    with pytest.raises(EngineError, match=r'filter .*Cautious.*; use engine="simpy"'):
        netkf.simulate(own, engine="compiled")
    run = netkf.simulate(own)
    assert run.engine == "simpy"
    assert run.fingerprint == netkf.simulate(ring, engine="compiled").fingerprint


def test_a_loss_of_ones_own_runs_in_both(ring):
    channel = dataclasses.replace(ring.network.channel, loss=Halved(delivery=0.8))
    network = dataclasses.replace(ring.network, channel=channel)
    assert assert_agree(dataclasses.replace(ring, network=network)).count("lost") > 100


class Certain(Bernoulli):
    """A user's loss that is no probability."""

    def delivery_probability(self, sent):
        return np.nan if sent.number > 3 else 1.0


class Stuck(Poisson):
    """A user's clock that stays where it is after some ticks."""

    def ticks(self, link, origin, index, now, random, count):
        times = super().ticks(link, origin, index, now, random, count)
        return np.minimum(times, 1.5)


@pytest.mark.parametrize("engine", [SimpyEngine(), "compiled", "processes"], ids=str)
def test_parts_of_ones_own_that_break_the_rules_are_refused_by_name(ring, engine):
    channel = dataclasses.replace(ring.network.channel, loss=Certain(delivery=0.8))
    lossy = dataclasses.replace(ring.network, channel=channel)
    words = (
        r"Certain: the delivery probability of message 4 on link .* must be in \[0, 1\]; got nan"
    )
    with pytest.raises(ScenarioError, match=words):
        netkf.simulate(dataclasses.replace(ring, network=lossy), engine=engine)
    stuck = dataclasses.replace(ring.network, activation=Stuck(rate=2.0))
    words = r"Stuck: ticks of link .* must increase, after 1.5 s"
    with pytest.raises(ScenarioError, match=words):
        netkf.simulate(dataclasses.replace(ring, network=stuck), engine=engine)


def test_auto_is_compiled_where_it_can_be(ring):
    assert netkf.simulate(ring).engine == "compiled"


def test_what_is_compiled_is_announced(ring, monkeypatch, capsys, tmp_path):
    """Once for each start of a run, also if only verbs of a second filter are not on disk."""

    @kernel
    def first(x):
        return x[0]

    @kernel
    def second(x):
        return x[0]

    @kernel
    def third(x):
        return x[0]

    gossip, numbers = netkf.load(SCENARIOS / "gossip_ring.toml"), np.zeros(1)
    for scenario in (ring, gossip):
        netkf.simulate(scenario, engine="compiled")
    monkeypatch.setattr(compiling, "announce", ANNOUNCE)
    for scenario in (ring, gossip):
        netkf.simulate(scenario, engine="compiled")
    assert capsys.readouterr().err == ""  # what is kept on disk is not compiled again
    monkeypatch.setattr(compiling, "_cache_folder", lambda chosen: tmp_path)
    for scenario, kernels in ((ring, (first, second)), (gossip, (third,))):
        netkf.simulate(scenario, engine="compiled")
        for made in kernels:
            made(numbers)
        assert capsys.readouterr().err.count("netkf: compiling ") == 1
    netkf.simulate(ring, engine="simpy")
    assert not compiling._announcing[0]


BURSTS = {"mean_loss": 0.3, "mean_burst": 3.0}


def test_fates_drawn_at_once_are_those_drawn_one_by_one():
    for loss in ({"kind": "bernoulli", "delivery": 0.5}, {"kind": "gilbert-elliott", **BURSTS}):
        for delay in ({"kind": "lognormal", "mean": 1.0, "sigma": 0.5}, {"kind": "none"}):
            scenario = netkf.load(SCENARIOS / "poisson_ring.toml").replace(
                {"network.channel": {"loss": loss, "delay": delay}}
            )
            one, other = (
                ChannelSampler(
                    scenario.network.channel, (0, 1), lambda p: Streams(1).generator(p, 0, 1)
                )
                for _ in range(2)
            )
            singles = [one.draw() for _ in range(100)]
            for many, column in zip(other.draws(100), zip(*singles, strict=True), strict=True):
                assert many.tolist() == list(column)


def test_a_block_of_rows_is_recorded_like_one_row_after_the_other():
    rows = [(0.5 * k, k % 3, k, -1, -1, -1, np.nan) for k in range(10)]
    hashes = Fingerprint(), Fingerprint()
    one, other = (Recorder([fingerprint]) for fingerprint in hashes)
    counting = Recorder([MemorySink()], counts_only=True)
    for row in rows:
        one.append(row)
    one.flush()
    for recorder in (other, counting):
        for row in rows[:2]:
            recorder.append(row)
        recorder.extend(np.array(rows[2:7], dtype=EVENT))
        recorder.extend(np.array(rows[7:], dtype=EVENT))
    assert str(hashes[0]) == str(hashes[1])
    assert one.total == other.total == counting.total == 10
    assert one.count("sense") == counting.count("sense") == 4


def test_code_compiled_from_sources_long_gone_is_removed(tmp_path):
    names = [f"netkf-{k:016x}" for k in range(6)]
    for k, name in enumerate(names):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (k, k))
    (tmp_path / "other").mkdir()
    folder = compiling._cache_folder.__wrapped__(str(tmp_path))
    assert folder.parent == tmp_path
    left = sorted({path.name for path in tmp_path.iterdir()} - {folder.name})
    assert left == [*names[3:], "other"]
