"""Messages of few bits: the error of numbers, and what it does to a filter."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf.algorithms.traits import Timing
from netkf.checks.check import find_checks
from netkf.checks.equations import WITHOUT_PAPER
from netkf.core.errors import ScenarioError
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.network.quantise import Encoder, Quantisation
from netkf.parts import Filter, Filtering
from netkf.rng.streams import Streams
from netkf.runs.summary import PromisedTraces, SummarySink, summarise
from netkf.scenario.reading import from_table
from netkf.trace.recorder import Recorder
from netkf.trace.schema import CODES
from tests.conftest import SCENARIOS

SLOTS = """
format = 1
name = "few-bits"
horizon = {horizon}
probe = 1.0
[plant]
kind = "linear"
period = 1.0
F = [[0.9]]
Q = [[{Q}]]
mean = [2.0]
[[sensors]]
nodes = [0, 1, 2]
H = [[1.0]]
R = [[{R}]]
[network]
graph = {{ kind = "complete", nodes = 3 }}
activation = {{ kind = "broadcast" }}
{quantise}
[filter]
kind = "{filter}"
{more}
cov = [[1.0]]
mean = [0.5]
"""
L, W = 0.3, np.full((3, 3), 1.0 / 3.0)


@pytest.fixture
def scenario_of(tmp_path):
    def make(bits=3, limit=8.0, horizon=30.0, Q=0.1, R=0.5, filter_="constant-gain"):
        more = {"constant-gain": f"gain = [[{L}]]"}.get(filter_, "")
        quantise = f"quantise = {{ bits = {bits}, range = {limit} }}" if bits else ""
        text = SLOTS.format(horizon=horizon, Q=Q, R=R, filter=filter_, more=more, quantise=quantise)
        (tmp_path / "bits.toml").write_text(text)
        return netkf.load(tmp_path / "bits.toml")

    return make


def test_errors_are_uniform_over_a_step_whatever_is_sent():
    quantisation = Quantisation(bits=4, range=3.0)
    random, z = np.random.default_rng(1), np.tile(np.linspace(-2.8, 2.8, 20), 2000)
    received, clipped = quantisation.apply(z, random)
    step = 6.0 / 16.0
    error = (received - z).reshape(2000, 20)
    assert clipped == 0
    assert scipy.stats.kstest(error.ravel(), "uniform", (-step / 2.0, step)).pvalue > 1e-4
    # Moments for each value: none depends on it (five deviations of 2000 draws).
    spread = step / np.sqrt(12.0)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=5.0 * spread / np.sqrt(2000.0))
    fourth = step**4 / 80.0 - (step**2 / 12.0) ** 2
    off = 5.0 * np.sqrt(fourth / 2000.0)
    np.testing.assert_allclose((error**2).mean(axis=0), step**2 / 12.0, atol=off)
    assert quantisation.variance == pytest.approx(step**2 / 12.0)


def test_values_beyond_the_range_are_clipped_and_counted():
    received, clipped = Quantisation(bits=8, range=1.0).apply(
        np.array([-5.0, 0.3, 7.0, np.inf]), np.random.default_rng(2)
    )
    assert clipped == 3
    np.testing.assert_allclose(received, [-1.0, 0.3, 1.0, 1.0], atol=2.0 / 256.0)
    assert (abs(received) <= 1.0).all()


def test_what_is_within_half_a_step_of_the_ends_is_clipped_as_often_as_dither_carries_it_out():
    quantisation, count = Quantisation(bits=4, range=3.0), 20_000
    random = np.random.default_rng(3)
    for below in (0.5, 0.25, 0.0):  # steps below the end
        z = np.full(count, 3.0 - below * quantisation.step)
        for sign in (1.0, -1.0):
            received, clipped = quantisation.apply(sign * z, random)
            off = 5.0 * np.sqrt(0.25 / count)
            assert clipped / count == pytest.approx(0.5 - below, abs=off if below < 0.5 else 0.0)
            bias = sign * (received - sign * z).mean() / quantisation.step
            assert bias == pytest.approx(below - 0.5, abs=2.0 * off)


def test_triangles_stay_triangles_and_symmetric_matrices_symmetric():
    encoder = Encoder(Quantisation(bits=5, range=4.0), np.random.default_rng(3))
    root = np.array([[1.0, 0.0, 0.0], [0.5, 2.0, 0.0], [-1.0, 0.2, 3.0]])
    (lower, upper, both, count, name), _ = encoder.encode(
        (root, root.T, root @ root.T / 4.0, 7, "x")
    )
    assert (lower[np.triu_indices(3, 1)] == 0.0).all()
    assert (lower[np.tril_indices(3)] != root[np.tril_indices(3)]).all()
    assert (upper[np.tril_indices(3, -1)] == 0.0).all()
    assert (upper[np.triu_indices(3)] != root.T[np.triu_indices(3)]).all()
    assert np.array_equal(both, both.T)
    assert (count, name) == (7, "x")


def test_numbers_of_any_width_are_of_few_bits():
    quantisation = Quantisation(bits=5, range=4.0)
    sent = 1.3, [np.float64(-0.7), np.array([0.4, 2.0], dtype=np.float32)], True
    (one, (other, array), flag), clipped = Encoder(quantisation, np.random.default_rng(3)).encode(
        sent
    )
    errors = np.array([one - 1.3, other + 0.7, *(array - [0.4, 2.0])])
    assert (errors != 0.0).all()
    assert (np.abs(errors) <= 0.5 * quantisation.step + 1e-6).all()
    assert (flag, clipped) == (True, 0)


@dataclass(frozen=True)
class Told:
    xhat: np.ndarray
    about: dict


def test_numbers_in_any_payload_of_a_user_are_of_few_bits():
    quantisation = Quantisation(bits=5, range=4.0)
    encoder = Encoder(quantisation, np.random.default_rng(3))
    sent = Told(np.array([1.3, 9.0]), {"gap": 0.7, "of": (3, "x")})
    received, clipped = encoder.encode(sent)
    errors = np.array([received.xhat[0] - 1.3, received.about["gap"] - 0.7])
    assert (errors != 0.0).all()
    assert (np.abs(errors) <= 0.5 * quantisation.step).all()
    assert (received.about["of"], clipped, sent.xhat[0]) == ((3, "x"), 1, 1.3)


@dataclass(frozen=True, eq=False)
class Sure(Filter):
    """Tells the same number again and again, and keeps what it hears."""

    timing = Timing(schedule=("exchange",))
    told = (0.3,)

    def emit(self, state, exchange):
        return state, self.told

    def absorb(self, state, messages, exchange):
        return state._replace(xhat=np.array([messages[0].payload[0]])) if messages else state


def test_each_transmission_of_the_same_payload_takes_its_own_dither(scenario_of):
    few = {"filter": Filtering(Sure()), "network.quantise": {"bits": 3, "range": 1.0}}
    heard = netkf.simulate(scenario_of(bits=0, filter_="local").replace(few)).xhat[1:, 0, 0]
    assert len(np.unique(heard)) == len(heard)
    assert np.abs(heard - 0.3).max() <= 0.125


def test_nothing_is_received_as_nothing(scenario_of):
    """A node of push-sum that no mass has reached must not divide by the error of its weight."""
    changes = {
        "filter": {"kind": "push-sum", "gamma": 1, "delta": 4.1},
        "network.graph": {"kind": "path", "nodes": 3},
    }
    scenario = scenario_of(bits=30, filter_="icf", horizon=4.0).replace(changes)
    plain = scenario_of(bits=0, filter_="icf", horizon=4.0).replace(changes)
    np.testing.assert_allclose(netkf.simulate(scenario).P, netkf.simulate(plain).P, rtol=1e-4)


def test_zeros_but_for_rounding_are_received_as_zeros_in_both_engines():
    """Information about states that no reading shows is 0 in one engine, and 1e-17 in the other."""
    quantisation, random = Quantisation(bits=3, range=1.0), np.random.default_rng(1)
    received, _ = quantisation.apply(np.array([0.0, 1e-17, -1e-12, 1e-3]), random)
    assert (received == 0.0).tolist() == [True, True, True, False]
    scenario = netkf.load(SCENARIOS / "nonlinear" / "range_tracking.toml").replace(
        {
            "horizon": 15.0,
            "filter": {"kind": "belief-propagation"},
            "plant.schedule": [{"from": 1.0, "F": (0.8 * np.eye(4)).tolist()}],
            "network.quantise": {"bits": 3, "range": 1.0},
        }
    )
    one, other = (netkf.simulate(scenario, engine=name) for name in ("simpy", "compiled"))
    np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-9)
    np.testing.assert_allclose(one.P, other.P, atol=1e-9)


def plain_run(slots, bits, limit, seed, drive=0.0):
    """Estimates (T, 3) of the filter with a constant gain whose nodes hear quantised estimates; the
    state is z <- 0.9 z + drive from z = 2, without noise.
    """
    z = 2.0
    draws = [Streams(seed).generator("dither", i) for i in range(3)]
    step, x, found = 2.0 * limit / 2.0**bits, np.full(3, 0.5), [np.full(3, 0.5)]
    for _ in range(1, slots):
        x, z = 0.9 * x + drive, 0.9 * z + drive
        x = x + L * (z - x)
        told = np.zeros(3)
        for i in range(3):
            # An estimate, and the root of its covariance: two numbers a message.
            u = step * (draws[i].random(1)[0] - 0.5)
            draws[i].random(1)
            level = np.clip(np.floor((x[i] + u + limit) / step), 0.0, 2.0**bits - 1.0)
            told[i] = (level + 0.5) * step - limit - u
        x = np.array(
            [x[i] / 3.0 + sum(told[j] for j in range(3) if j != i) / 3.0 for i in range(3)]
        )
        found.append(x)
    return np.array(found)


def test_hearers_use_what_is_received_all_the_same(scenario_of):
    run = netkf.simulate(scenario_of(Q=0.0, R=1e-24), seed=5)
    np.testing.assert_allclose(run.xhat[:, :, 0], plain_run(31, 3, 8.0, 5), rtol=1e-9, atol=1e-9)


def test_numbers_are_those_of_absolute_states_beside_an_input(scenario_of):
    driven = scenario_of(Q=0.0, R=1e-24).replace(
        {"plant.input": {"kind": "constant", "G": [[1.0]], "value": [0.7]}}
    )
    run = netkf.simulate(driven, seed=5)
    np.testing.assert_allclose(run.xhat[:, :, 0], plain_run(31, 3, 8.0, 5, 0.7), atol=1e-9)


def test_a_predictor_swaps_numbers_of_absolute_states(tmp_path):
    """Readings say nothing: each node predicts what the other one told it of the same slot."""
    constant = {"kind": "constant", "G": [[1.0]], "value": [0.7]}
    plant = {"kind": "linear", "period": 1.0, "F": [[0.9]], "Q": [[0.0]], "cov": [[0.0]]}
    table = {
        "format": 1,
        "name": "swaps",
        "horizon": 30.0,
        "probe": 1.0,
        "plant": plant | {"input": constant},
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1e24]]}],
        "network": {
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "matching", "protocol": "one-edge"},
            "quantise": {"bits": 4, "range": 8.0},
        },
        "filter": {"kind": "gossip", "mean": [[0.5], [3.0]], "cov": [[1.0]]},
    }
    run = netkf.simulate(from_table(table, tmp_path), seed=5)
    draws = [Streams(5).generator("dither", i) for i in range(2)]
    x = 0.9 * np.array([0.5, 3.0]) + 0.7  # no swap in slot 0
    for k in range(1, 30):
        u = np.array([random.random(2)[0] for random in draws]) - 0.5
        told = np.clip(np.floor(x + u + 8.0), 0.0, 15.0) + 0.5 - 8.0 - u
        x = 0.9 * told[::-1] + 0.7
        np.testing.assert_allclose(run.xhat[k + 1, :, 0], x, atol=1e-9)


def plain_intersection(slots, bits, limit, seed):
    """Estimates and P (T, 3) of the diffusion filter with metropolis weights, of the same state:
    hearers invert the P that they receive.
    """
    draws = [Streams(seed).generator("dither", i) for i in range(3)]
    step, x, P = 2.0 * limit / 2.0**bits, np.full(3, 0.5), np.ones(3)
    found = [(x, P)]
    for k in range(slots - 1):
        gain = P / (P + 0.5)
        x, P = 0.9 * (x + gain * (2.0 * 0.9**k - x)), 0.81 * (1.0 - gain) * P + 0.1
        u = step * (np.array([random.random(2) for random in draws]).T - 0.5)
        level = np.floor((np.array([x, np.sqrt(P)]) + u + limit) / step)
        told, root = (np.clip(level, 0.0, 2.0**bits - 1.0) + 0.5) * step - limit - u
        # Row i has what node i uses: its own and those heard.
        own = np.eye(3, dtype=bool)
        information = np.where(own, 1.0 / P[:, None], root**-2.0) / 3.0
        P = 1.0 / information.sum(axis=1)
        x = P * (information * np.where(own, x[:, None], told)).sum(axis=1)
        found.append((x, P))
    return np.array(found).transpose(1, 0, 2)


def test_what_follows_from_other_numbers_of_a_message_is_not_sent(scenario_of):
    scenario = scenario_of(bits=6, Q=0.0, R=1e-24, filter_="diffusion").replace(
        {"filter.model": {"Q": [[0.1]], "R": [[0.5]]}}
    )
    run = netkf.simulate(scenario, seed=5, engine="simpy")
    xhat, P = plain_intersection(31, 6, 8.0, 5)
    np.testing.assert_allclose(run.xhat[:, :, 0], xhat, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.P[:, :, 0, 0], P, rtol=1e-9, atol=1e-9)


N3 = 3
TRIANGLE = N3 * (N3 + 1) // 2
PLANTS = {
    "slots": {"kind": "linear", "period": 1.0, "F": 0.9 * np.eye(N3), "Q": np.zeros((N3, N3))},
    "clocks": {"kind": "diffusion", "A": -0.1 * np.eye(N3), "B": np.zeros((N3, N3))},
}


@pytest.mark.parametrize(
    ("time", "filtering", "numbers"),
    [
        # An estimate with its covariance; information relative to an estimate.
        ("slots", {"kind": "diffusion"}, N3 + TRIANGLE),
        ("slots", {"kind": "hcmci"}, 2 * (N3 + TRIANGLE) + N3),
        ("slots", {"kind": "icf"}, N3 + TRIANGLE + N3),
        # Mass, or the estimates of the second exchange: the other one is zero.
        ("slots", {"kind": "push-sum", "gamma": 1, "delta": 4.0}, 2 + TRIANGLE + N3),
        ("clocks", {"kind": "covariance-intersection", "epsilon": 0.3}, N3 + TRIANGLE),
        ("clocks", {"kind": "push-sum"}, 1 + N3 + TRIANGLE),
        # Each neighbour is told another thing, and so would be others: two payloads at the ends.
        ("clocks", {"kind": "belief-propagation"}, 2 * (N3 + TRIANGLE + 2 * N3)),
    ],
)
def test_each_number_of_a_message_is_sent_once(time, filtering, numbers, monkeypatch, tmp_path):
    sizes, apply = [], Quantisation.apply

    def counted(self, values, random):
        sizes.append(values.size)
        return apply(self, values, random)

    monkeypatch.setattr(Quantisation, "apply", counted)
    sampling = {"sampling": {"kind": "periodic", "period": 1.0}} if time == "clocks" else {}
    activation = {"kind": "broadcast"}
    if time == "clocks":
        activation = {"kind": "periodic", "period": 0.7, "at": "nodes"}
    table = {
        "format": 1,
        "name": "numbers",
        "horizon": 3.0,
        "probe": [0.0, 1.0],
        "plant": PLANTS[time] | {"cov": np.eye(N3)},
        "sensors": [{"nodes": [0, 1], "H": [[1.0, 0.5, 0.2]], "R": [[1.0]], **sampling}],
        "network": {
            "graph": {"kind": "path", "nodes": 2},
            "activation": activation,
            "quantise": {"bits": 20, "range": 100.0},
        },
        "filter": filtering,
    }
    run = netkf.simulate(from_table(table, tmp_path), engine="simpy")
    # Of two nodes each has one hearer.
    assert run.count("send") > 0
    assert sum(sizes) == numbers * run.count("send")


def test_the_steady_error_is_that_of_the_plain_recursion(scenario_of):
    """e <- W (I - L H)(F e + w) + L v with the messages' noise of variance step^2 / 12."""
    run = netkf.simulate(scenario_of(horizon=1000.0, Q=0.1, R=0.5), seed=3)
    others, expected = W - np.diag(np.diag(W)), {}
    for variance in (4.0 / 12.0, 0.0):
        S = np.eye(3)
        for _ in range(300):
            S = 0.81 * S + 0.1
            S = W @ ((1.0 - L) ** 2 * S + L**2 * 0.5 * np.eye(3)) @ W.T
            S = S + variance * others @ others.T
        expected[variance] = S
    error = (run.x[:, None] - run.xhat)[51:, :, 0]
    blocks = np.einsum("bti,btj->bij", *[error.reshape(19, 50, 3)] * 2) / 50.0
    off = 5.0 * blocks.std(axis=0, ddof=1) / np.sqrt(19.0)
    with_noise, without = expected.values()
    assert (np.abs(blocks.mean(axis=0) - with_noise) < off).all()
    assert (np.abs(blocks.mean(axis=0) - without) > off)[np.diag_indices(3)].all()


LOSS = {"kind": "bernoulli", "delivery": 0.6}
SHARED = {"kind": "shared", "delivery": 0.6, "share": 0.5}
DELAY = {"kind": "exponential", "mean": 0.3}
AT_NODES = {"kind": "poisson", "rate": 1.0, "at": "nodes"}
LIVES = [{"kind": "duty", "nodes": [1, 2], "period": 7.0, "up": 4.0}]
TRIGGERED = {"kind": "event-triggered", "trigger": "consensus", "thresholds": [0.1, 0.1],
             "inner": {"kind": "hcmci", "consensus": "information"}}  # fmt: skip


def few_bits(folder, time, filtering, network):
    """Four nodes on a cycle, two with sensors; numbers beyond 0.6 are clipped."""
    # Under clocks belief propagation keeps messages, and takes no noise.
    is_still = time == "clocks" and filtering["kind"] == "belief-propagation"
    noise = {} if is_still else {{"slots": "Q", "clocks": "B"}[time]: 0.5 * np.eye(N3)}
    plant = PLANTS[time] | {"cov": np.eye(N3), **noise}
    sampling = {"sampling": {"kind": "periodic", "period": 1.0}} if time == "clocks" else {}
    sensor = {"nodes": [0, 1], "H": [[1.0, 0.5, 0.2]], "R": [[1.0]], **sampling}
    quantise = {"bits": 5, "range": 0.6}
    graph = {"kind": "cycle", "nodes": 4}
    table = {"format": 1, "name": "few", "horizon": 15.0, "probe": 1.0, "plant": plant}
    table |= {"sensors": [sensor], "filter": filtering}
    table["network"] = {"graph": graph, "quantise": quantise, **network}
    return from_table(table, folder)


@pytest.mark.parametrize(
    ("time", "filtering", "network"),
    [
        ("slots", {"kind": "diffusion"}, {}),
        ("slots", {"kind": "hcmci", "steps": 2}, {"channel": {"loss": LOSS}}),
        ("slots", {"kind": "icf", "steps": 3}, {"lives": LIVES}),
        ("slots", {"kind": "gossip"}, {"activation": {"kind": "matching", "protocol": "maximal"}}),
        ("slots", TRIGGERED, {"channel": {"loss": SHARED}}),
        ("slots", {"kind": "push-sum", "gamma": 2, "delta": 4.1}, {"channel": {"loss": LOSS}}),
        ("slots", {"kind": "belief-propagation", "steps": 2},
         {"channel": {"loss": LOSS}, "lives": LIVES}),
        ("clocks", {"kind": "hybrid", "epsilon": 0.3}, {"channel": {"loss": LOSS}}),
        ("clocks", {"kind": "covariance-intersection", "epsilon": 0.3},
         {"activation": AT_NODES, "channel": {"loss": LOSS, "delay": DELAY}}),
        ("clocks", {"kind": "hcmci", "consensus": "information"}, {"lives": LIVES}),
        ("clocks", {"kind": "push-sum"}, {"activation": AT_NODES}),
        ("clocks", {"kind": "belief-propagation"}, {"channel": {"loss": LOSS, "delay": DELAY}}),
        ("clocks", {"kind": "belief-propagation"}, {"activation": AT_NODES, "lives": LIVES}),
    ],
)  # fmt: skip
def test_compiled_code_quantises_as_simpy(time, filtering, network, tmp_path):
    """Rows of clips stand where SimPy has them, and runs of a batch are those of their own."""
    activation = {"kind": "broadcast"} if time == "slots" else {"kind": "poisson", "rate": 1.0}
    scenario = few_bits(tmp_path, time, filtering, {"activation": activation, **network})
    one, other = (netkf.simulate(scenario, seed=3, engine=name) for name in ("simpy", "compiled"))
    assert one.count("clip") > 0
    assert one.fingerprint == other.fingerprint
    np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-10)
    np.testing.assert_allclose(one.P, other.P, rtol=1e-10, atol=1e-10)
    for batch in CompiledEngine().run_many(scenario, 3, range(10)):
        for k, replica in enumerate(batch.replicas):
            alone = netkf.simulate(scenario, seed=3, replica=replica, engine="compiled")
            np.testing.assert_array_equal(alone.xhat, batch.xhat[k])
            counts = np.bincount(alone.log["kind"], minlength=batch.counts.shape[1])
            np.testing.assert_array_equal(counts, batch.counts[k])


@pytest.mark.parametrize("kind", ["constant-gain", "hcmci"])
def test_many_bits_are_none(scenario_of, kind):
    changes = {"filter": {"kind": "hcmci", "steps": 2}} if kind == "hcmci" else {}
    run, exact = (
        netkf.simulate(scenario_of(bits=bits, limit=64.0).replace(changes), seed=1, engine="simpy")
        for bits in (48, 0)
    )
    np.testing.assert_allclose(run.xhat, exact.xhat, atol=1e-10)
    np.testing.assert_allclose(run.P, exact.P, atol=1e-10)
    assert not run.count("clip")


def test_a_summary_says_what_was_clipped(scenario_of):
    sink = SummarySink()
    recorder = Recorder([sink])
    scenario = scenario_of(limit=0.4)
    SimpyEngine().run(scenario, Streams(1), recorder, lambda _: None)
    run = netkf.simulate(scenario, seed=1)
    rows = run.log[run.log["kind"] == CODES["clip"]]
    promised = PromisedTraces(None, np.nan, np.nan, "")
    notes = summarise(scenario, sink, promised, {"sent": 0, "delivered": 0, "lost": 0})["notes"]
    count = rows["message"].sum()
    assert notes == [
        f"{count} numbers were with the dither beyond the range of messages, -0.4 to 0.4, "
        "and clipped"
    ]


def test_sizes_of_messages_follow_from_the_bits(scenario_of):
    exact, coded = scenario_of(bits=0), scenario_of(bits=5)
    # An estimate and a root: two numbers, of eight bytes or of five bits.
    assert (exact.message_size(0, 0), coded.message_size(0, 0)) == (16.0, 1.25)


def test_nothing_is_promised_and_it_is_said_why(scenario_of):
    scenario = scenario_of()
    table = netkf.theory.assumptions(scenario)
    row = table[table["assumption"] == "messages arrive as they are sent"].iloc[0]
    assert not row["holds"]
    assert "variance 0.3333" in row["evidence"]
    with pytest.raises(netkf.TheoryError, match=r"variance 0\.3333"):
        netkf.theory.error_covariance(scenario, netkf.simulate(scenario, seed=1))
    assert find_checks(scenario) is WITHOUT_PAPER


def test_nodes_that_estimate_different_blocks_quantise_alike_in_both_engines():
    areas = netkf.load(SCENARIOS / "blocks" / "ieee14_areas.toml").replace({"horizon": 6.0})
    few = areas.replace({"network.quantise": {"bits": 6, "range": 0.1}})
    one, other = (netkf.simulate(few, engine=name) for name in ("simpy", "compiled"))
    assert one.count("clip") > 0
    assert one.fingerprint == other.fingerprint
    np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-10)
    np.testing.assert_allclose(one.P, other.P, atol=1e-10)
    fine = netkf.simulate(areas.replace({"network.quantise": {"bits": 48, "range": 100.0}}))
    exact = netkf.simulate(areas)
    np.testing.assert_allclose(fine.xhat, exact.xhat, atol=1e-9)
    np.testing.assert_allclose(fine.P, exact.P, atol=1e-9)


def test_beside_an_input_messages_of_a_part_are_those_of_all_blocks():
    """Nodes of the partition filter keep the whole state, of which they estimate a part."""
    areas = netkf.load(SCENARIOS / "blocks" / "ieee14_areas.toml").replace({"horizon": 6.0})
    pushed = {"kind": "constant", "G": [[1.0]] * 3, "value": [0.01]}
    driven = areas.replace({"plants.0.input": pushed})
    fine = netkf.simulate(driven.replace({"network.quantise": {"bits": 48, "range": 100.0}}))
    exact = netkf.simulate(driven)
    np.testing.assert_allclose(fine.xhat, exact.xhat, atol=1e-9)
    np.testing.assert_allclose(fine.P, exact.P, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"network.quantise": {"bits": 0, "range": 1.0}}, "network.quantise.bits"),
        ({"network.quantise": {"bits": 60, "range": 1.0}}, "network.quantise.bits"),
        ({"network.quantise": {"bits": 8, "range": 0.0}}, "network.quantise.range"),
        ({"network.quantise": {"bits": 8}}, "network.quantise.range"),
        ({"filter": {"kind": "one-bit"}}, "network.quantise"),
        ({"filter": {"kind": "intermittent"}}, "network.quantise"),
    ],
)
def test_what_has_no_meaning_is_refused(scenario_of, changes, key):
    with pytest.raises(ScenarioError) as error:
        scenario_of().replace(changes)
    assert key in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_drawn_does_not_depend_on_who_hears(scenario_of, tmp_path):
    """Nobody hears a node whose receivers are down: its channel loses that message in the twin."""
    text = (scenario_of() and (tmp_path / "bits.toml").read_text()).replace(
        "[filter]",
        '[[network.lives]]\nkind = "duty"\nnodes = [1, 2]\nperiod = 7.0\nup = 4.0\n[filter]',
    )
    (tmp_path / "down.toml").write_text(text)
    run = netkf.simulate(netkf.load(tmp_path / "down.toml"), engine="simpy")
    assert run.count("lost") > 0
    netkf.export_recorded(run, tmp_path / "twin")
    twin = netkf.simulate(netkf.load(tmp_path / "twin" / "scenario.toml"), engine="simpy")
    np.testing.assert_array_equal(twin.xhat, run.xhat)


FLOW = """import numpy as np

F = np.array([[0.9, 0.1], [0.0, 0.8]])


class Flow:
    def f(self, x, u, t):
        return F @ x + u[0]

    def jacobian(self, x, u, t):
        return F
"""


@pytest.mark.parametrize(
    ("kind", "keys"),
    [
        ("belief-propagation", {"steps": 2}),
        ("gossip", {}),
        pytest.param("hcmci", {"steps": 2}, marks=pytest.mark.slow),
        pytest.param("track-fusion", {"rule": "ci"}, marks=pytest.mark.slow),
    ],
)
def test_beside_an_input_all_numbers_are_those_of_absolute_states(
    tmp_path, monkeypatch, kind, keys
):
    """As those of the same plant written as one that is not linear, where nothing is counted from
    the response to the input.
    """
    (tmp_path / "flows.py").write_text(FLOW)
    monkeypatch.syspath_prepend(tmp_path)
    law = {"Q": [[0.2, 0.0], [0.0, 0.1]], "period": 1.0, "cov": [[1.0, 0.0], [0.0, 1.0]]}
    constant = {"kind": "constant", "value": [0.7]}
    pairs = {"kind": "matching", "protocol": "maximal"}
    table = {
        "format": 1,
        "name": "few",
        "horizon": 20.0,
        "probe": 1.0,
        "plant": {"kind": "nonlinear", "f": "flows:Flow", **law, "input": constant},
        "sensors": [{"nodes": [0, 2], "H": [[1.0, 0.5]], "R": [[0.3]]}],
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": pairs if kind == "gossip" else {"kind": "broadcast"},
            "quantise": {"bits": 6, "range": 16.0},
        },
        "filter": {"kind": kind, **keys},
    }
    flow = from_table(table, tmp_path)
    linear = {"kind": "linear", "F": [[0.9, 0.1], [0.0, 0.8]], **law}
    linear["input"] = constant | {"G": [[1.0], [1.0]]}
    run, other = (netkf.simulate(s, seed=3) for s in (flow.replace({"plant": linear}), flow))
    np.testing.assert_allclose(run.xhat, other.xhat, atol=1e-9)
    np.testing.assert_allclose(run.P, other.P, atol=1e-9)
